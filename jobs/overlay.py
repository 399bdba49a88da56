"""Runs to lay over a slice, or over a new one that is sampled for them: what is refused, the plane, the files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import xarray as xr

from ..envs.registry import as_environment
from ..landscapes.identity import MODEL_VERSION, plane_of, stored_identity
from ..landscapes.objective import Objective, failed
from ..landscapes.overlay import best_point, overlay, principal_plane
from ..landscapes.plane import Plane
from ..landscapes.slice import Slice
from ..landscapes.storage.files import tidy, visible_files
from ..landscapes.storage.paths import slice_exists
from ..landscapes.storage.store import open_slice
from ..landscapes.verification import RESAMPLE, verify_dataset
from .folder import OVERLAY, SLICE_STORE, folder_named, run_tables
from .job import Job
from .scene import environment_of, named_point
from .slice import SliceJob, slice_work
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from torch import Tensor

    from ..landscapes.draw.figures.page import Picture


PICTURE, STREAM = OVERLAY.files
PCA, BEST = "pca", "best"
MUST = ("objective", "options")  # agree between slice and runs
SHOULD = ("fidelity", "settings", "engine", MODEL_VERSION)  # as well


@dataclass(frozen=True)
class OverlayPlane:
    """The plane of a new slice: through a point of runs, along their principal directions, with another resolution.

    `through` is the best point of all runs (best) or of one run's folder, or any other that a slice can go through;
    `principal` takes the runs' two principal directions instead of the slice's own, and `resolution` is by default the
    slice's.
    """

    through: str | None = None
    principal: bool = False
    resolution: int | None = None

    @classmethod
    def of(cls, through: str | None, plane: str | None, resolution: int | None) -> OverlayPlane | None:
        """Return the plane to sample, None where nothing asks for one. Raises ValueError for what makes no plane."""
        if plane not in (None, PCA):
            raise ValueError(f"--plane takes pca, the runs' principal plane; got {plane!r}")
        if not (through or plane):
            if resolution:
                raise ValueError("--resolution is for a new slice; give --through or --plane, too")
            return None
        return cls(through, plane is not None, resolution)

    def shape(self, present: Plane) -> tuple[int, ...]:
        """Return how many points the new slice has along each axis."""
        return (self.resolution,) * present.rank if self.resolution else present.resolution

    def make(self, present: Plane, tables: Sequence[xr.Dataset], objective: Objective) -> Plane:
        """Return the plane of the new slice: parallel to the one that is present, or the runs' principal one.

        Raises ValueError where there is no such point of the objective to go through, and where the run it goes through
        searched another number of parameters.
        """
        shape = self.shape(present)
        point = None
        if self.through:
            point = self._point(self.through, tables, objective)
            if len(point) != present.dim:
                raise ValueError(f"{self.through} searched {len(point)} parameters; the slice has {present.dim}")
        if self.principal:
            return principal_plane(tables, resolution=shape, through=point)
        assert point is not None  # as one of the two is asked for
        return replace(present.shift_to(point), resolution=shape)

    @staticmethod
    def _point(through: str, tables: Sequence[xr.Dataset], objective: Objective) -> Tensor:
        if through == BEST:
            return best_point(tables)[0]
        return best_point(run_tables([through]))[0] if Path(through).is_dir() else named_point(objective, through)


@dataclass(frozen=True)
class OverlaySummary:
    """Record the content of an overlay; `farthest` is the largest distance from the plane [half-widths of the box]."""

    runs: int
    points: int
    outside: int
    failed: int
    farthest: float
    files: list[str]
    skipped: int = 0  # rows of tables that hold no point

    def outcome(self) -> str:
        """Say it in a line."""
        counted = f"{self.runs} run{'s' if self.runs > 1 else ''}, {self.points} points"
        skipped = f", {self.skipped} row{'s' if self.skipped > 1 else ''} skipped" if self.skipped else ""
        where = f"{self.outside} outside the map, {self.failed} failed{skipped}"
        return f"{counted}: {where}; the farthest point is {self.farthest:.2g} half-widths of the box from the plane"


@dataclass(frozen=True, eq=False, repr=False)
class Overlay:
    """Record runs over a slice: `runs` are their data, to which `landscapes.overlay` adds the position of each point.

    `slice` is the slice under them, or the new one that was sampled for them. `files` are in `folder`.
    """

    slice: Slice
    runs: Sequence[xr.Dataset]
    folder: Path
    files: list[str]

    @cached_property
    def summary(self) -> OverlaySummary:
        """The numbers of runs and points in the overlay."""
        return OverlaySummary(
            runs=len(self.runs),
            points=sum(run.sizes["evaluation"] for run in self.runs),
            outside=sum(int(run["outside"].sum()) for run in self.runs),
            failed=sum(int(failed(run["status"]).sum()) for run in self.runs),
            farthest=max(float(run["distance"].max().round(9)) for run in self.runs),
            files=self.files,
            skipped=sum(int(run.attrs.get("skipped", 0)) for run in self.runs),
        )

    def plot(self, *, width: float | None = None) -> Picture:
        """Draw the runs over the slice as a matplotlib figure; `width` is for print [mm]."""
        from ..landscapes.draw.figures.overlay import overlay_figure

        return overlay_figure(self.slice.data, self.runs, width=width)

    def __repr__(self) -> str:
        """Return in a line what it shows."""
        return f"<Overlay of {self.summary.outcome()}, in {self.folder}>"


@dataclass(frozen=True, kw_only=True)
class OverlayJob(Job[Overlay]):
    """Runs to lay over a slice; with a `plane` over one that is sampled there first in the same folder, on `device`."""

    results = OVERLAY
    slice: Slice
    runs: Sequence[xr.Dataset]
    plane: OverlayPlane | None = None
    device: str = "auto"

    @classmethod
    def of(
        cls,
        slice: Slice,
        runs: Sequence[xr.Dataset],
        *,
        command: str,
        plane: OverlayPlane | None = None,
        device: str = "auto",
        out: Path | None = None,
        prints: Sequence[float] = (),
        watch: Watch | None = None,
    ) -> OverlayJob:
        """Refuse runs that cannot be laid over the slice, before anything is computed, and warn of other simulations.

        Raises ValueError for those, for slices that are lines, and where the folder holds something else.
        """
        for run in runs:
            check_run(slice.data, run, watch or Watch())
        overlay(slice.data, runs)
        ours = stored_identity(slice.data)
        how = [plane.through, PCA if plane.principal else None, plane.resolution] if plane else [None, None, None]
        identity = [ours, [stored_identity(run) for run in runs], how]
        folder = out or folder_named(["overlay", ours["objective"]], identity)
        OVERLAY.check(folder, allowed=[file for file in visible_files(folder) if slice_exists(file / SLICE_STORE)])
        return cls(slice=slice, runs=runs, folder=folder, command=command, plane=plane, device=device, prints=prints)

    def work(self) -> list[Work]:
        """Return the new slice, if there is to be one."""
        if self.plane is None:
            return []
        shape = self.plane.shape(plane_of(self.slice.data))
        return [slice_work(self._objective(), shape, int("grad" in self.slice.data))]

    def compute(self, watch: Watch) -> Overlay:
        """Sample the new slice, if there is to be one, lay the runs over it and draw them.

        Raises StoreMismatchError where a slice is to be cut again that its objective gives other numbers for.
        """
        beneath = self._sample(watch, self.plane) if self.plane else self.slice
        return self._draw(Overlay(beneath, overlay(beneath.data, self.runs), self.folder, []))

    def write(self, found: Overlay) -> list[str]:
        """Leave nothing but the files that are drawn."""
        tidy(self.folder)
        return found.files

    def outcome(self, found: Overlay) -> str:
        """Say in a line what it shows."""
        return found.summary.outcome()

    def _sample(self, watch: Watch, spec: OverlayPlane) -> Slice:
        """Sample the new slice."""
        env = self._objective()
        if self.slice.folder is not None:
            with watch.busy(PREPARING):
                verify_dataset(env, self.slice.data, self.slice.folder, todo=RESAMPLE)
        plane = spec.make(plane_of(self.slice.data), self.runs, env)
        gradients = int("grad" in self.slice.data)
        job = SliceJob.of(env, plane, command=self.command, root=self.folder, gradients=gradients, boxed=spec.principal)
        job.run(watch)
        return Slice(open_slice(job.folder / SLICE_STORE), job.folder, lambda: env)

    def _objective(self) -> Objective:
        """Return what the slice was sampled from."""
        found = self.slice.remake() if self.slice.remake else environment_of(self.slice.data, self.device)
        return found if self.device == "auto" else as_environment(found).remake(device=self.device)

    def _draw(self, drawn: Overlay) -> Overlay:
        from ..landscapes.draw.recordings.runs import save_stream

        save_stream(drawn.slice.data, drawn.runs, self.folder / STREAM)
        return replace(drawn, files=[PICTURE, STREAM, *self.draw(drawn.plot)])


def check_run(dataset: xr.Dataset, run: xr.Dataset, watch: Watch) -> None:
    """Raise ValueError for a run of another landscape than a slice's; warn where it is simulated otherwise."""
    refuse_other_landscape(dataset, run)
    ours, theirs, name = stored_identity(dataset), stored_identity(run), _name(run)
    if differ := [one for one in SHOULD if ours.get(one) != theirs.get(one)]:
        shown = [one for one in differ if one != "settings"]
        settings = (f"{one} {ours.get(one)!r} of the slice, {theirs.get(one)!r} of the run" for one in shown)
        watch.note(
            f"warning: slice and run ({name}) are simulated differently ({'; '.join(settings)}), so losses differ"
        )


def refuse_other_landscape(dataset: xr.Dataset, run: xr.Dataset) -> None:
    """Raise ValueError for a run of another landscape than a slice's."""
    ours, theirs = stored_identity(dataset), stored_identity(run)
    for setting in MUST:
        if ours.get(setting) != theirs.get(setting):
            raise ValueError(
                f"the slice and the run ({_name(run)}) are of different landscapes: {setting} is {ours.get(setting)!r} "
                f"for the slice and {theirs.get(setting)!r} for the run; use a slice of the run's own landscape"
            )


def _name(run: xr.Dataset) -> str:
    known = stored_identity(run)
    return f"{known.get('objective')}, {known.get('method')}, seed {known.get('seed')}"
