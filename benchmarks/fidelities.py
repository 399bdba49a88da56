"""Write the table of what every fidelity claims and keeps, from the trade-offs that the gallery keeps.

    python -m benchmarks.fidelities [--check] [--keep-before]

The table in docs/fidelities.md holds, for every scene, draft and standard before they were set by measurement and as
they are now: rank correlation, median cosine of gradients and 95 % loss error against the reference, and milliseconds.
"Before" is `benchmarks/data/fidelities-before.json`, which --keep-before writes from the trade-offs that lie in
gallery/data/tradeoff at that moment; "now" are those that lie there, where they are of the scene's present code and
settings: of a scene that changed since, the table says so. With --check nothing is written: exit code 1 says that the
page differs, that a scene was changed since it was measured, or that a fidelity without an exception breaks its claim.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gradscape.envs.registry import environment_class
from gradscape.gallery.files import TradeoffFiles
from gradscape.jobs.report_tables import markdown
from gradscape.landscapes.measures.choice import CLAIMS, Claim, Shortfall
from gradscape.landscapes.measures.fidelity import Comparison

from .pages import DATA, DOCS, ROOT, UNMEASURED, is_present, records, scenes, settle

PAGE, NAME = DOCS / "fidelities.md", "fidelities"
BEFORE = ROOT / "benchmarks" / "data" / "fidelities-before.json"
CHAOTIC: dict[str, str] = {}  # scenes whose motion is, and by which measurement: their gradients promise nothing
HEAD = ("scene", "fidelity", "device", "rank", "cosine", "95 % error", "ms", "claim")


@dataclass(frozen=True)
class Row:
    """Hold what was measured of a named fidelity of a scene: `settings` by name, and `measured` as files have it.

    `model_version` is that of the scene, 0 where it was not kept.
    """

    scene: str
    device: str
    name: str
    settings: dict[str, Any]
    measured: dict[str, Any]
    model_version: int = 0

    @property
    def comparison(self) -> Comparison:
        """What was measured, as a record."""
        return Comparison.of_record(self.measured)

    @property
    def present(self) -> bool:
        """Whether that is what the scene is now."""
        same = environment_class(self.scene).fidelities[self.name].record() == self.settings
        return same and is_present(self.scene, self.model_version)

    def shortfall(self, claim: Claim) -> Shortfall:
        """Return how far it falls short of a claim."""
        return Shortfall.of(self.comparison, claim, chaotic=self.scene in CHAOTIC)


def kept(data: Path = DATA) -> list[Row]:
    """Return what the trade-offs in the gallery's data say of draft and standard, of one device for each scene."""
    return [row for name in scenes() for row in _rows(name, data)]


def _rows(name: str, data: Path) -> list[Row]:
    """Return the rows of the first device whose record is of the present scene, else of the first there is."""
    found = [list(_read(name, record)) for record in records(name, TradeoffFiles.of, data)]
    return next((rows for rows in found if all(row.present for row in rows)), found[0] if found else [])


def _read(name: str, record: dict[str, Any]) -> Iterator[Row]:
    """Yield what a record says of each claim's fidelity: of the variant with its settings, else of its name."""
    known = record["identity"]
    rungs = [one for one in record["rungs"] if all(one[key] == known[key] for key in ("device", "engine", "options"))]
    for claim in CLAIMS:
        now = environment_class(name).fidelities[claim.name].record()
        same = [one for one in rungs if {**one["fidelity"], "name": claim.name} == now]
        for one in (same or [one for one in rungs if one["name"] == claim.name])[:1]:
            settings, measured = {**one["fidelity"], "name": claim.name}, {key: one[key] for key in MEASURED}
            yield Row(name, one["device"], claim.name, settings, measured, known["model_version"])


MEASURED = ("loss_error", "spearman", "gradient", "diverged", "compared", "seconds", "batch")


def before(path: Path = BEFORE) -> list[Row]:
    """Return what the fidelities kept before they were set by measurement."""
    return [Row(**one) for one in json.loads(path.read_text())]


def keep_before(data: Path = DATA, path: Path = BEFORE) -> None:
    """Keep what the trade-offs say now as what was before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(row) for row in kept(data)], indent=1) + "\n")


def table(old: Sequence[Row], new: Sequence[Row]) -> str:
    """Return the table in Markdown: a row for each fidelity, each number before and now where they differ."""
    past = {(row.scene, row.name): row for row in old}
    lines = []
    for scene in scenes():
        for claim in CLAIMS:
            now = next((row for row in new if (row.scene, row.name) == (scene, claim.name)), None)
            lines.append(_line(scene, claim, past.get((scene, claim.name)), now))
    return markdown(HEAD, lines)


def _line(scene: str, claim: Claim, was: Row | None, now: Row | None) -> list[str]:
    current = now if now is not None and now.present else None
    known = [row for row in (was, current) if row is not None] or [row for row in (now,) if row is not None]
    if not known:
        return [f"`{scene}`", claim.name, "", *[""] * 4, "not measured"]
    devices, *numbers = (_change(column) for column in zip(*([row.device, *_cells(row)] for row in known), strict=True))
    verdict = _change([_verdict(row, claim) for row in known])
    return [f"`{scene}`", claim.name, devices, *numbers, verdict if current else f"{verdict} → {UNMEASURED}"]


def _cells(row: Row) -> list[str]:
    found, error = row.comparison, row.comparison.loss_error.p95_relative.value
    numbers = [
        "none" if value is None else f"{value:.3f}" for value in (found.spearman.value, found.gradient.cosine.value)
    ]
    return [*numbers, "none" if error is None else _percent(error), f"{1e3 * found.seconds.with_gradient:.3g}"]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def _verdict(row: Row, claim: Claim) -> str:
    lack = row.shortfall(claim)
    said = "kept" if lack.kept else f"short in {lack.by}"
    return said + (", chaotic" if row.scene in CHAOTIC else "")


def _change(values: Iterable[str]) -> str:
    return " → ".join(dict.fromkeys(values))


def changed(rows: Sequence[Row]) -> list[str]:
    """Name the fidelities of scenes that are no longer what was measured."""
    return [f"{row.scene} {row.name}" for row in rows if not row.present]


def short(rows: Sequence[Row]) -> list[str]:
    """Say which fidelities that were measured of the present scene break their claim, and in what."""
    claims: Mapping[str, Claim] = {claim.name: claim for claim in CLAIMS}
    found = [(row, row.shortfall(claims[row.name])) for row in rows if row.present]
    return [
        f"{row.scene} {row.name}: {lack.value:.3g} times what may lack in {lack.by}"
        for row, lack in found
        if not lack.kept
    ]


def main() -> int:
    """Write the page, or say what is not so."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, say what is not so")
    parser.add_argument("--keep-before", action="store_true", help="keep the present trade-offs as what was before")
    asked = parser.parse_args()
    if asked.keep_before:
        keep_before()
    rows = kept()
    text = table(before(), rows)
    wrong = [f"{name}: {UNMEASURED}" for name in changed(rows)]
    wrong += short(rows)
    return settle(text, PAGE, NAME, wrong, check=asked.check, fine=f"all {len(rows)} fidelities keep what they claim")


if __name__ == "__main__":
    sys.exit(main())
