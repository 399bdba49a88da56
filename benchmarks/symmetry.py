"""Measure the numerical floor of every scene at draft and standard, for the table of docs/fidelities.md.

    python -m benchmarks.symmetry [ENV ...] [--fidelities draft standard] [--points 32] [--device auto]
        [--out symmetry] [--data gallery/data/floors.json]

Each is a `landscape study symmetry` in its own folder under --out, which continues after a stop. A new row replaces one
with the same scene, fidelity and device in --data; `python -m docs.pages.tables` writes the table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from docs.pages.tables import FLOORS, scenes

import gradscape as gs
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.identity import StoreMismatchError
from gradscape.landscapes.storage.records import read_json, write_record
from gradscape.studies.symmetry import SymmetryRecord


def study(scene: str, fidelity: str, asked: argparse.Namespace) -> SymmetryRecord:
    """Return the study of a scene; a folder with another study is started again."""
    how: dict[str, Any] = {"fidelity": fidelity, "points": asked.points, "device": asked.device}
    how["out"] = asked.out / f"{scene}-{fidelity}"
    try:
        found = gs.study("symmetry", scene, **how)
    except StoreMismatchError:
        found = gs.study("symmetry", scene, **how, force=True)
    assert isinstance(found, SymmetryRecord)  # of that kind
    return found


def row(found: SymmetryRecord) -> dict[str, Any]:
    """Return the stored part of a study."""
    parts = ("env", "fidelity", "device", "points", "floor", "replicas", "identity", "command")
    return {name: to_json(getattr(found, name)) for name in parts}


def replace_row(rows: list[dict[str, Any]], new: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows with a new one, which replaces one with the same scene, fidelity and device."""
    key = ("env", "fidelity", "device")
    left = [one for one in rows if any(one[name] != new[name] for name in key)]
    return sorted([*left, new], key=lambda one: [one[name] for name in key])


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested scenes, and print the floor of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("only", nargs="*", metavar="ENV", help="scenes, by default all")
    parser.add_argument("--fidelities", nargs="+", default=["draft", "standard"])
    parser.add_argument("--points", type=int, default=32)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path, default=Path("symmetry"))
    parser.add_argument("--data", type=Path, default=FLOORS)
    asked = parser.parse_args(arguments)
    for scene in asked.only or scenes():
        for fidelity in asked.fidelities:
            found = study(scene, fidelity, asked)
            rows = read_json(asked.data)["floors"] if asked.data.exists() else []
            write_record(asked.data, {"floors": replace_row(rows, row(found))})
            print(f"{scene} {fidelity} on {found.device}: {found.sentences()[0]}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
