"""A sampled slice of a landscape, as one works with it: its numbers, its plane, its picture, what is measured of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

from .identity import stored_identity, stored_provenance
from .objective import Objective
from .plane import Plane

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Draw = Callable[..., "Figure"]


@dataclass(frozen=True, eq=False)
class Slice:
    """Hold the samples of a slice: `data` is an xarray dataset of loss(v, u), grad(v, u, dim) and status(v, u).

    `folder` is where its files are, None of one in memory. `remake` makes the objective again that it was sampled from,
    for what has to be evaluated anew.
    """

    data: xr.Dataset
    folder: Path | None = None
    remake: Callable[[], Objective] | None = None

    @cached_property
    def plane(self) -> Plane:
        """The line or plane that was sampled."""
        return Plane.from_record(self.identity["plane"])

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What decides the numbers, as plain JSON: scene, options, fidelity, device, engine, code, plane."""
        return stored_identity(self.data)

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """What else is known of how it was made: command, date, versions, the loss's unit."""
        return stored_provenance(self.data)
