"""Write the table of how near every scene's standard step is to its stability limit, from what the gallery keeps.

    python -m benchmarks.margins [--check]

The table in docs/measures.md has a row for each scene and precision that `landscape extremes ENV` measured: standard's
step, the largest stable one, what the scene does beyond, and how wrong losses are at standard. The records are in
gallery/data/extremes; a scene that has none, or has changed since, is said to be so. With --check nothing is written:
exit code 1 says that the page differs, or that a scene is not measured.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gradscape.gallery.files import DEVICES
from gradscape.landscapes.storage.records import read_json

from .pages import DATA, DOCS, MISSING, UNMEASURED, is_present, scenes, settle_measured

PAGE, NAME = DOCS / "measures.md", "margins"
HEAD = ("scene", "device", "precision", "standard's step [s]", "longest stable [s]", "margin", "beyond", "95 % error")


def margins(data: Path = DATA) -> dict[str, list[Mapping[str, Any]] | str]:
    """Return the kept records of each scene's extremes, or why there is none."""
    found: dict[str, list[Mapping[str, Any]] | str] = {}
    for name in scenes():
        files = (data / "extremes" / f"{name}-{device}.json" for device in DEVICES)
        records = [read_json(file) for file in files if file.exists()]
        present = [
            one for one in records if is_present(name, one["identity"]["model_version"], one["identity"]["engine"])
        ]
        found[name] = present or (UNMEASURED if records else MISSING)
    return found


def rows(found: Mapping[str, list[Mapping[str, Any]] | str]) -> Iterator[list[str]]:
    """Return a row for each scene, device and precision."""
    for name, records in found.items():
        if isinstance(records, str):
            yield [f"`{name}`", *[""] * 4, records, "", ""]
            continue
        for record in records:
            for limit in record["limits"]:
                if limit["knob"] == "dt":
                    yield [f"`{name}`", record["identity"]["device"], *_cells(limit)]


def _cells(limit: Mapping[str, Any]) -> list[str]:
    """Return what a record says of the step: precision, base, limit, margin, what is beyond, error at the base."""
    base = limit["base"]
    (own,) = (rung for rung in limit["rungs"] if rung["values"] == [base])
    error = "" if own["error"] is None else f"{100 * own['error']:.2g} %"
    stable = "" if limit["stable"] is None else f"{limit['stable']:.3g}"
    if limit["failed"] is None:
        return [limit["precision"], f"{base:.3g}", f"at least {stable}", "", "", error]
    margin = "" if limit["margin"] is None else f"{limit['margin']:.2f}"
    return [limit["precision"], f"{base:.3g}", stable, margin, limit["beyond"], error]


def main() -> int:
    """Write the page, or say what is not so."""
    found = margins()
    return settle_measured(__doc__ or "", found, HEAD, rows(found), PAGE, NAME)


if __name__ == "__main__":
    sys.exit(main())
