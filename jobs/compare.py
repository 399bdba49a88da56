"""Two slices of one plane to compare, of which the second may have to be sampled first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.identity import check_identity
from ..landscapes.measures.slice_comparison import (
    check_finished,
    check_landscapes,
    check_planes,
    compare_slices,
    loss_unit,
    parameters,
)
from ..landscapes.measures.slice_comparison_record import SliceComparison
from ..landscapes.objective import Objective
from ..landscapes.plain import plain_json
from ..landscapes.slice import Slice
from ..landscapes.space import scaled_labels
from ..landscapes.storage.files import tidy, visible_files
from ..landscapes.storage.paths import slice_exists
from ..landscapes.storage.records import read_json, reading, write_record
from ..landscapes.storage.store import open_slice
from .folder import COMPARISON, SLICE_STORE, folder_named
from .slice import SliceJob
from .slice_place import identity_of
from .watch import Watch, resumable

if TYPE_CHECKING:
    import xarray as xr

RECORD, PICTURE = COMPARISON.files
IDENTITY = "identity"  # in the record: that of both slices


@dataclass(frozen=True)
class CompareJob:
    """Two slices to compare into `folder`; `other` is the second, or an objective to sample on the first one's plane.

    `identity` says what is compared. `prints` are widths of pages [mm] that the picture is also drawn for; `command` is
    how it is made again; `force` begins the second slice anew where it lies in the folder.
    """

    slice: Slice
    other: Slice | Objective
    identity: dict[str, Any]
    folder: Path
    command: str
    force: bool = False
    prints: Sequence[float] = ()

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

        The folder is by default one under out/ named after both. Raises ValueError for slices that do not lie on one
        plane, are not finished, or are of other parameters or units, and where the folder holds something else;
        StoreMismatchError where it holds another comparison, which `force` replaces.
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
            identity = {"a": slice.identity, "b": identity_of(other)}
        named = [str(one.get("objective", "slice")) for one in identity.values()]
        folder = out or folder_named(["compare", *dict.fromkeys(named)], identity)
        COMPARISON.check(folder, allowed=[file for file in visible_files(folder) if slice_exists(file / SLICE_STORE)])
        if not force:
            _refuse_another(folder / RECORD, identity)
        return cls(slice, other, identity, folder, command, force, prints)

    def run(self, watch: Watch | None = None) -> SliceComparison:
        """Sample the second slice, if there is none, compare them, and write the files.

        Raises Stopped where it is interrupted, and DiskFullError; the same job goes on from what is kept then.
        """
        from ..landscapes.draw.figures.page import save

        watch = watch or Watch()
        theirs = self.other.data if isinstance(self.other, Slice) else self._sample(self.other, watch)
        with resumable(self.say_kept):
            found = compare_slices(self.slice.data, theirs, command=self.command)
            save(found.plot(), self.folder / PICTURE)
            write_record(self.folder / RECORD, {**found.record(), IDENTITY: self.identity})
            tidy(self.folder)
        return found

    def print(self, found: SliceComparison) -> list[str]:
        """Draw it for pages, too, and return the names of the files. Raises DiskFullError."""
        from ..landscapes.draw.figures.page import save_prints

        with resumable(self.say_kept):
            return save_prints(lambda width: found.plot(width), self.folder / PICTURE, self.prints)

    def say_kept(self) -> str:
        """Say what of it is on disk."""
        return f"each file in {self.folder} is whole"

    def _sample(self, objective: Objective, watch: Watch) -> xr.Dataset:
        """Sample the objective where the first slice is sampled; return its slice."""
        boxed = bool(self.slice.identity.get("boxed"))
        how: dict[str, Any] = {"gradients": int("grad" in self.slice.data), "boxed": boxed, "force": self.force}
        job = SliceJob.of(objective, self.slice.plane, command=self.command, root=self.folder, **how)
        summary = job.run(watch)
        watch.note(f"{summary.outcome()}\n{job.folder}: {', '.join(summary.files)}")
        return open_slice(job.folder / SLICE_STORE)


def _refuse_another(path: Path, identity: dict[str, Any]) -> None:
    """Raise StoreMismatchError where there is the record of another comparison."""
    if not path.exists():
        return
    with reading(path, f"write elsewhere with --out, or delete {path}"):
        found = read_json(path)[IDENTITY]
    check_identity(path.parent, wanted=plain_json(identity, "a comparison's identity"), found=found, what="comparison")
