"""A result's folder: what its files are called, what it is called itself, and whose it is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.plain import digest, plain_json, plain_name
from ..landscapes.storage import paths
from ..landscapes.storage.files import other_files, refuse_others, visible_files
from ..landscapes.storage.paths import slice_exists
from ..optim import runs
from ..studies import KINDS

if TYPE_CHECKING:
    import xarray as xr

SLICE_STORE, RUN_STORE = paths.SLICE, runs.RUN
SLICE_FILE = paths.SLICE + paths.ARCHIVE  # what a slice's store is once it is finished
IDENTITY = "identity"  # in a record: what was checked or compared, and how
ROOT = Path("out")  # where results go that are given no folder


@dataclass(frozen=True)
class Results:
    """Record the name of a kind of result, and the files that it leaves in its folder.

    `store` holds the data: a folder with other files but without the store is not of this kind. `picture` is also drawn
    for print, in files named after it.
    """

    kind: str
    files: tuple[str, ...]
    picture: str = ""
    store: str = ""

    def check(self, folder: Path, allowed: Iterable[Path] = ()) -> None:
        """Raise ValueError where a folder holds other files than those of such a result, or than those `allowed`."""
        if self.store and slice_exists(folder / self.store):
            return
        held = visible_files(folder) if self.store else other_files(folder, self.files, self.picture)
        refuse_others(folder, set(held) - set(allowed), self.kind)

    def refuse_another(self, folder: Path, identity: dict[str, Any]) -> None:
        """Raise StoreMismatchError where the record in a folder has another identity."""
        from ..landscapes.identity import check_identity
        from ..landscapes.storage.records import read_json, reading

        path = folder / self.files[0]
        if path.exists():
            with reading(path, f"write elsewhere with --out, or delete {path}"):
                found = read_json(path)[IDENTITY]
            wanted = plain_json(identity, f"a {self.kind}'s identity")
            check_identity(folder, wanted=wanted, found=found, what=self.kind)


SUMMARY = "summary.json"
SLICE = Results("slice", (SLICE_FILE, "landscape.png", SUMMARY), "landscape.png", SLICE_STORE)
RUN = Results("run", (RUN_STORE, "progress.png", SUMMARY), "progress.png", RUN_STORE)
SWEEP = Results("sweep", ("frames", SLICE_FILE, "sweep.mp4", "sweep.gif", "sweep.rrd", SUMMARY))
RACE_FIGURES = "race.json"
RACE = Results("race", (RACE_FIGURES, "race.png"), "race.png")
LEAGUE = Results("league", ("league.json", "league.png"), "league.png")
OVERLAY = Results("overlay", ("overlay.png", "overlay.rrd"), "overlay.png")
COMPARISON = Results("comparison", ("compare.json", "compare.png"), "compare.png")
SURFACE = Results("surface", ("surface.png", "surface.gltf"), "surface.png")
EPISODE = Results(
    "episode", ("episode.png", "episode.mp4", "episode.gif", "episode.rrd", "episode.json"), "episode.png"
)
REPORT = Results(
    "report",
    ("report.json", "measures.json", "gradient-quality.png", "gradient-quality.npz", "report.html"),
    "gradient-quality.png",
)
REPORTS = Results("set of reports", ("report.json", "report.md"))
STUDIES = {kind: Results(f"{kind} study", (f"{kind}.json", f"{kind}.png"), f"{kind}.png") for kind in KINDS}
CARD = Results("report card", ("card.json", "card.html", "card.npz", "card.png"), "card.png")
PAIRS = Results("study of pairs", ("pairs.json",))
CHECK = Results("check", ("check.json", "check.png"), "check.png")
HESSIAN = Results("Hessian", ("hessian.json", "hessian.npz", "hessian.png"), "hessian.png")
REMEDY = Results("study of remedies", ("remedy.json", "remedy.npz", "remedy.png"), "remedy.png")
ADVICE = Results("advice", ("advice.json",))
CENSUS = Results("census", ("census.json", "census.npz", "census.png"), "census.png")


def folder_named(parts: Iterable[object], settings: Any, root: Path = ROOT) -> Path:
    """Return a folder named after `parts`, unique for these settings and always the same for them."""
    return root / "-".join([*(plain_name(str(part)) for part in parts), digest(settings)])


def store_in(path: Path, store: str) -> Path:
    """Return the store in a results folder, finished or not, or the path itself."""
    return path / store if slice_exists(path / store) else path


def run_tables(paths: Sequence[str]) -> list[xr.Dataset]:
    """Return what runs, or all runs of races, evaluated; those without an episode are left out.

    Raises ValueError where a path holds no run, and where there is no episode at all.
    """
    from ..optim.runs.store import RunStore

    tables = []
    for path in paths:
        found = [store_in(Path(path), RUN_STORE)]
        if not Path(path, RUN_STORE).exists() and (members := sorted(Path(path).glob(f"*/{RUN_STORE}"))):
            found = members
        tables += [RunStore.open(store).dataset() for store in found]
    if not any(table.sizes["evaluation"] for table in tables):
        raise ValueError(f"{', '.join(paths)}: the runs have no episodes yet; `landscape optimize` evaluates them")
    return [table for table in tables if table.sizes["evaluation"]]
