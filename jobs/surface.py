"""A slice to draw as a lit surface, with runs draped on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..landscapes.identity import stored_identity
from ..landscapes.storage.files import tidy
from .folder import SLICE_STORE, SURFACE, folder_named, run_tables, store_in
from .job import Job
from .overlay import refuse_other_landscape
from .watch import Watch

if TYPE_CHECKING:
    import xarray as xr

PICTURE, MODEL = SURFACE.files


@dataclass(frozen=True, kw_only=True)
class SurfaceJob(Job[Path]):
    """A slice to draw as a surface, with what `placed` has of runs over it; it finds nothing but its folder."""

    results = SURFACE
    dataset: xr.Dataset
    placed: Sequence[xr.Dataset]

    @classmethod
    def of(cls, slice_: Path, runs: Sequence[str], out: Path | None = None, prints: Sequence[float] = ()) -> SurfaceJob:
        """Lay the runs over the slice in a folder; results go to `out`, by default to one named after all of them.

        Raises ValueError where there is no slice or no run, where a run searched another landscape, and where `out`
        holds something else.
        """
        from ..landscapes.overlay import overlay
        from ..landscapes.storage.store import open_slice

        dataset = open_slice(store_in(slice_, SLICE_STORE))
        tables = run_tables(runs) if runs else []
        for table in tables:
            refuse_other_landscape(dataset, table)
        placed = overlay(dataset, tables) if tables else []
        ours = stored_identity(dataset)
        content = [ours, [stored_identity(table) for table in tables]]
        folder = out or folder_named(["surface", ours["objective"]], content)
        SURFACE.check(folder)
        return cls(dataset=dataset, placed=placed, folder=folder, prints=prints)

    def compute(self, watch: Watch) -> Path:
        """Draw the surface."""
        from ..landscapes.draw.render.surface import save_surface

        with watch.busy("drawing"):
            save_surface(self.dataset, self.placed, self.folder / PICTURE, self.folder / MODEL)
        return self.folder

    def write(self, found: Path) -> list[str]:
        """Draw it for pages, too."""
        from ..landscapes.draw.figures.page import save_prints
        from ..landscapes.draw.render.surface import surface_figure

        draw = partial(surface_figure, self.dataset, self.placed)
        printed = save_prints(lambda width: draw(width=width), self.folder / PICTURE, self.prints)
        tidy(self.folder)
        return [PICTURE, MODEL, *printed]
