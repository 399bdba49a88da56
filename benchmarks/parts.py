"""Write the table of what each part of every scene's model is for, from the studies that the gallery keeps.

    python -m benchmarks.parts [--check]

The table in docs/parts.md has a row for each part that a scene names: how far losses move without it, their rank
correlation and the cosine of gradients with those of the full model, what it costs, and the verdict. It is of the
studies by `landscape tradeoff ENV --ladder model` in gallery/data/tradeoff; a part that none has measured since the
scene changed is said to be so. With --check nothing is written: exit code 1 says that the page differs, or that a part
is not measured.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from gradscape.envs.records import ModelPart
from gradscape.envs.registry import entries, environment_class
from gradscape.gallery.files import TradeoffFiles
from gradscape.jobs.report_tables import markdown
from gradscape.landscapes.measures.fidelity import Bootstrap
from gradscape.landscapes.measures.model import MeasuredPart, ModelStudy

from .pages import DATA, DOCS, UNMEASURED, is_present, records, settle

PAGE, NAME = DOCS / "parts.md", "parts"
HEAD = ("scene", "part", "changed to", "95 % of losses move by", "rank", "cosine", "time", "verdict")


def studies(data: Path = DATA) -> dict[str, ModelStudy]:
    """Return the kept study of each scene whose model and fidelity are still what was measured, by name."""
    found = {}
    for name in sorted(entries()):
        for study in map(ModelStudy.of_record, records(name, TradeoffFiles.of_model, data)):
            known = study.identity
            same = environment_class(name).fidelities[study.fidelity].record() == known["settings"]
            if same and is_present(name, known["model_version"], known["engine"]):
                found.setdefault(name, study)
    return found


def rows(found: dict[str, ModelStudy]) -> Iterator[list[str]]:
    """Return a row for each part that a registered scene names."""
    for name in sorted(entries()):
        measured = {part.name: part for part in found[name].parts} if name in found else {}
        for part in environment_class(name).model_parts:
            about = [f"`{name}`", part.name, f"{part.change}{' (missing now)' if part.missing else ''}"]
            yield [*about, *_cells(measured.get(part.name), part)]


def _cells(measured: MeasuredPart | None, part: ModelPart) -> list[str]:
    if measured is None or measured.options != dict(part.options):
        return [*[""] * 4, UNMEASURED]
    found = measured.comparison
    moved = found.loss_error.p95_relative.value
    return [
        "none" if moved is None else f"{100 * moved:.2g} %",
        *(_number(one) for one in (found.spearman, found.gradient.cosine)),
        "none" if measured.cost.value is None else f"{100 * (measured.cost.value - 1):+.0f} %",
        measured.verdict,
    ]


def _number(found: Bootstrap) -> str:
    return "none" if found.value is None else f"{found.value:.2f}"


def main() -> int:
    """Write the page, or say what is not so."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, say what is not so")
    asked = parser.parse_args()
    lines = list(rows(studies()))
    wrong = [f"{line[0]} {line[1]}: {UNMEASURED}" for line in lines if line[-1] == UNMEASURED]
    text, fine = markdown(HEAD, lines), f"all {len(lines)} parts are measured"
    return settle(text, PAGE, NAME, wrong, check=asked.check, fine=fine)


if __name__ == "__main__":
    sys.exit(main())
