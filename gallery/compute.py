"""Make the missing parts of the gallery's figures: slices first, because all other parts are made from them."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from ..jobs.watch import Stopped, Watch, Work
from ..jobs.workers import workers
from ..landscapes.capacity import require
from ..landscapes.cost import duration
from ..landscapes.lattice import count_gradients
from ..landscapes.storage.files import full, is_full, tidy
from .figures import Figure
from .league import LeaguePart, LeagueSlicePart
from .parts import CompanionPart, EpisodePart, FidelityPart, FigurePart, ReportPart, SearchPart, SlicePart, SweepPart

T = TypeVar("T")
PARTS: dict[str, type[FigurePart]] = {
    "slices": SlicePart,
    "companions": CompanionPart,
    "sweeps": SweepPart,
    "episodes": EpisodePart,
    "searches": SearchPart,
    "reports": ReportPart,
    "fidelities": FidelityPart,
    "league": LeaguePart,
    "league-slices": LeagueSlicePart,
}
IF_NAMED = {"league"}  # parts that take so long that they are made where they are asked for, and not with all others


def compute_parts(
    figures: Sequence[Figure],
    root: Path,
    watch: Watch,
    *,
    parts: Sequence[str] = (),
    device: str = "auto",
    scheduler: str | None = None,
) -> list[str]:
    """Make the missing parts of these figures in `root`, and return the names of the figures that failed.

    Without `parts` it makes all kinds except the league. A figure that fails does not stop the others. Raises
    ValueError for an unknown part or a missing device, Stopped when it is interrupted, and DiskFullError when the disk
    is full. The same call continues after the last two.
    """
    if unknown := set(parts) - set(PARTS):
        raise ValueError(f"--part takes {', '.join(PARTS)}; got {', '.join(sorted(unknown))}")
    _check_device(device)
    watch.plan(_slice_work(SlicePart(figure, root, device) for figure in figures))
    work = _Work(root, watch)
    with workers(scheduler, device) as executor:
        for name, kind in PARTS.items():
            if name in parts or (not parts and name not in IF_NAMED):
                sound = [figure for figure in figures if figure.id not in work.failed]
                work.make(name, [kind(figure, root, device, executor) for figure in sound])
    tidy(root)
    return sorted(work.failed)


def _slice_work(parts: Iterable[SlicePart]) -> Iterator[Work]:
    """Yield the samples that the figures' slices still lack; a plan does not include the other parts."""
    for part in parts:
        if left := part.count_left():
            env, figure = part.scene().make(), part.figure
            having = count_gradients((figure.resolution,) * len(figure.dims), figure.gradients)
            having = round(left * having / figure.resolution ** len(figure.dims))
            yield Work(env, left - having, having, 8.0 * left * (2 + env.space.dim))


def change_figures(figures: Sequence[Figure], fidelity: str | None, resolution: int | None, root: Path) -> list[Figure]:
    """Return the figures with another fidelity and resolution, where these are given.

    Raises ValueError if this machine has too little memory or disk for so many points.
    """
    from ..landscapes.storage.arrays import need_of

    if resolution:
        rank = max(len(figure.dims) for figure in figures)
        require("resolution", resolution, lambda points: need_of((points,) * rank, rank, grad=True), root)
    return [
        replace(figure, fidelity=fidelity or figure.fidelity, resolution=resolution or figure.resolution)
        for figure in figures
    ]


def _check_device(device: str) -> None:
    from ..envs.engines.runtime import cuda_available

    if device == "cuda" and not cuda_available():
        raise ValueError("--device cuda needs a CUDA device, and none was found; use --device cpu or auto")


@dataclass(frozen=True)
class Computed:
    """The folder, the number of figures computed in it, and the figures that failed."""

    folder: Path
    figures: int
    failed: tuple[str, ...]


@dataclass(frozen=True)
class _Work:
    """The work in `root`, and the names of the figures that failed."""

    root: Path
    watch: Watch
    failed: set[str] = field(default_factory=set)

    def make(self, name: str, parts: Sequence[FigurePart]) -> None:
        """Announce the cost of one kind of part, and make the missing ones."""
        left = [part for part in parts if not self._try(part, part.there)]
        left = self._sound(left)
        self.watch.note(f"{name}: {len(parts) - len(left)} of {len(parts)} are done already")
        self._announce(name, left)
        for part in left:
            if part.figure.id not in self.failed and not part.there():  # figures may share what one of them made
                self.watch.note(f"{part.figure.id}: {part.label()}")
                if outcome := self._try(part, partial(part.make, self.watch)):
                    self.watch.note(outcome)

    def _announce(self, name: str, parts: Sequence[FigurePart]) -> None:
        """Announce the total time, estimated from the first figure of each scene."""
        rates: dict[str, float] = {}
        total = 0.0
        for part in {part.shared: part for part in parts}.values():
            kind = json.dumps([part.figure.env, part.figure.options])
            if kind not in rates:
                rate = self._try(part, part.seconds_each)
                if rate is None:
                    continue
                rates[kind] = rate
            total += rates[kind] * part.count_left()
        if left := self._sound(parts):
            self.watch.note(f"{name}: {len(left)} to make, about {duration(total)} in all")

    def _sound(self, parts: Sequence[FigurePart]) -> list[FigurePart]:
        return [part for part in parts if part.figure.id not in self.failed]

    def _try(self, part: FigurePart, work: Callable[[], T]) -> T | None:
        """Return the result of a part's work; report a failure and return None."""
        try:
            return work()
        except KeyboardInterrupt as stop:
            kept = str(stop) if isinstance(stop, Stopped) else f"finished parts are kept in {self.root}"
            raise Stopped(f"in {part.figure.id}, {kept}") from stop
        except Exception as error:
            if is_full(error):
                raise full(error, f"finished parts are kept in {self.root}") from error
            why = " ".join(str(error).split())
            self.watch.note(f"{part.figure.id} failed: {type(error).__name__}: {why}")
            self.failed.add(part.figure.id)
            return None
        finally:
            gc.collect()  # an environment may hold gigabytes of the GPU
