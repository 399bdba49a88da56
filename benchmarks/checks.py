"""Write the table of what `landscape check` says of every scene, from the records that it printed.

    for each ENV:  landscape check ENV --device cpu --json > FOLDER/ENV-cpu.json
    python -m benchmarks.checks FOLDER

The table in BENCHMARKS.md gets a row for each file of the folder: how many checks passed, warned and do not apply, the
noise of repeats, the error of slopes at the step where it is least and over an optimiser's step, the largest gradients
in the box and beyond, and the longest time step at which a scene is finite.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gradscape.jobs.report_tables import markdown
from gradscape.landscapes.storage.records import read_json

from .pages import ROOT, settle

PAGE, NAME = ROOT / "BENCHMARKS.md", "checks"
HEAD = (
    *("environment", "device", "", "pass, warn, n/a", "noise", "gradient's error, at step", "over 0.01 of the box"),
    *("largest \\|grad\\| in the box", "beyond", "finite up to"),
)
BOX = ("status", "corners", "centre", "dt 1x", "horizon 1x")
STEPS = ("dt 8x", "dt 4x", "dt 2x", "dt 1x")
Check = Mapping[str, Any]


def row(record: Mapping[str, Any]) -> list[str]:
    """Return the row of a record."""
    checks: dict[str, Check] = {one["check"]: one for one in record["checks"]}
    counts = Counter(one["outcome"] for one in record["checks"])
    noise, slopes = checks["determinism"]["numbers"], checks["finite differences"]["numbers"]
    useful = checks["an optimiser's step"]["numbers"]
    largest = {
        name: one["numbers"]["largest_gradient"]
        for name, one in checks.items()
        if one["numbers"].get("largest_gradient") is not None
    }
    beyond = max((name for name in largest if name not in BOX), key=largest.__getitem__, default=None)
    return [
        f"`{record['env']}`",
        record["device"],
        "passes" if record["passed"] else "fails",
        f"{counts['pass']}, {counts['warn']}, {counts['skip']}",
        f"{max(noise['loss'], noise['gradient']):.1e}".replace("0.0e+00", "0"),
        f"{slopes['error']:.1e}, {slopes['step']:.0e}",
        f"{useful['error']:.2g}",
        f"{max(largest[name] for name in BOX if name in largest):.1e}",
        f"{largest[beyond]:.1e}, {beyond}" if beyond else "",
        next((name for name in STEPS if name in checks and _is_finite(checks[name])), "none"),
    ]


def _is_finite(check: Check) -> bool:
    return not sum(check["numbers"].get(kind) or 0 for kind in ("non-finite", "escaped", "error"))


def rows(folder: Path) -> Iterator[list[str]]:
    """Return a row for each record of a folder."""
    for file in sorted(folder.glob("*.json")):
        yield row(read_json(file))


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the records are")
    asked = parser.parse_args(arguments)
    found = list(rows(asked.folder))
    if not found:
        parser.error(f"{asked.folder} holds no records; `landscape check ENV --json > FOLDER/ENV-cpu.json` makes one")
    return settle(markdown(HEAD, found), PAGE, NAME, [], check=False, fine=f"{len(found)} records are in the table")


if __name__ == "__main__":
    sys.exit(main())
