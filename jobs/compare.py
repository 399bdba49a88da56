"""Two slices of one plane to compare; the second is sampled first if it does not exist."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.measures.slice_comparison import (
    SliceComparison,
    check_finished,
    check_landscapes,
    check_planes,
    compare_slices,
    loss_unit,
    parameters,
)
from ..landscapes.objective import Objective
from ..landscapes.slice import Slice
from ..landscapes.space import scaled_labels
from ..landscapes.storage.files import visible_files
from ..landscapes.storage.paths import slice_exists
from ..landscapes.storage.store import open_slice
from .folder import COMPARISON, IDENTITY, SLICE_STORE, folder_named
from .job import Job
from .slice import SliceJob, slice_work
from .watch import Watch, Work

if TYPE_CHECKING:
    import xarray as xr

RECORD = COMPARISON.files[0]


@dataclass(frozen=True, kw_only=True)
class CompareJob(Job[SliceComparison]):
    """Two slices to compare; `other` is the second, or an objective to sample on the first one's plane.

    `identity` says what is compared; `force` begins the second slice again where it lies in the folder.
    """

    results = COMPARISON
    slice: Slice
    other: Slice | Objective
    identity: dict[str, Any]
    force: bool = False

    @classmethod
    def of(
        cls,
        slice: Slice,
        other: Slice | Objective,
        *,
        command: str,
        out: Path | None = None,
        force: bool = False,
        prints: Sequence[float] = (),
    ) -> CompareJob:
        """Refuse what cannot be compared, before anything is computed.

        Raises ValueError for slices that do not lie on one plane, are not finished, or are of other parameters or
        units, and where the folder holds something else or another comparison, which `force` replaces.
        """
        ours = slice.data
        if isinstance(other, Slice):
            theirs = other.data
            check_landscapes(parameters(ours), parameters(theirs), loss_unit(ours), loss_unit(theirs))
            check_planes(slice.plane, other.plane)
            check_finished(ours, theirs)
            identity = {"a": slice.identity, "b": other.identity}
        else:
            names = scaled_labels(other.space.names, other.space.scales)
            check_landscapes(parameters(ours), names, loss_unit(ours), other.loss_unit)
            check_finished(ours)
            identity = {"a": slice.identity, "b": other.identity()}
        named = [str(one.get("objective", "slice")) for one in identity.values()]
        folder = out or folder_named(["compare", *dict.fromkeys(named)], identity)
        COMPARISON.check(folder, allowed=[file for file in visible_files(folder) if slice_exists(file / SLICE_STORE)])
        if not force:
            COMPARISON.refuse_another(folder, identity)
        return cls(
            slice=slice, other=other, identity=identity, folder=folder, command=command, force=force, prints=prints
        )

    def work(self) -> list[Work]:
        """Return the second slice, if there is none."""
        if isinstance(self.other, Slice):
            return []
        return [slice_work(self.other, self.slice.plane.resolution, int("grad" in self.slice.data))]

    def compute(self, watch: Watch) -> SliceComparison:
        """Sample the second slice, if there is none, and compare them."""
        theirs = self.other.data if isinstance(self.other, Slice) else self._sample(self.other, watch)
        return compare_slices(self.slice.data, theirs, command=self.command)

    def record(self, found: SliceComparison) -> Any:
        """Return what is written of it, with what was compared."""
        return {**super().record(found), IDENTITY: self.identity}

    def _sample(self, objective: Objective, watch: Watch) -> xr.Dataset:
        """Sample the objective where the first slice is sampled; return its slice."""
        boxed = bool(self.slice.identity.get("boxed"))
        how: dict[str, Any] = {"gradients": int("grad" in self.slice.data), "boxed": boxed, "force": self.force}
        job = SliceJob.of(objective, self.slice.plane, command=self.command, root=self.folder, **how)
        job.run(watch)
        return open_slice(job.folder / SLICE_STORE)
