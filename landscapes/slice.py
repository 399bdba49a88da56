"""A sampled slice of a landscape for users: its numbers, its plane, its picture, its measures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from .identity import errors_of, plane_of, simulator_parts, stored_identity, stored_provenance
from .objective import Objective, Status
from .plane import Plane

if TYPE_CHECKING:
    import pandas as pd

    from .draw.figure import Picture
    from .measures.floor import Floor
    from .measures.profile import Profile


class HasData(Protocol):
    """The part of a run that a slice needs: its table of evaluations."""

    @property
    def data(self) -> xr.Dataset:
        """Every evaluation of the run."""


@dataclass(frozen=True, eq=False, repr=False)
class Slice:
    """The samples of a slice.

    `data` is an xarray dataset of loss(v, u), grad(v, u, dim) unless sampled without, and status(v, u); a line has no
    v. Along a logarithmic parameter a coordinate is the decimal logarithm of the value, and has the attribute `scale`,
    "log10"; gradients are with respect to it. `folder` contains its files, None for one in memory. `remake` makes its
    objective again, for further evaluations. `floor_map` has the standard deviation between replicas of the objective
    at every sample, deviation(v, u), None where it was not measured.
    """

    data: xr.Dataset
    folder: Path | None = None
    remake: Callable[[], Objective] | None = None
    floor_map: xr.Dataset | None = None

    @cached_property
    def identity(self) -> dict[str, Any]:
        """The settings that decide the numbers, as plain JSON."""
        return stored_identity(self.data)

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """How the slice was made: command, date, versions, the loss's unit."""
        return stored_provenance(self.data)

    @cached_property
    def plane(self) -> Plane:
        """The line or plane that was sampled."""
        return Plane.from_record(self.identity["plane"])

    @property
    def slope(self) -> NDArray[np.float64]:
        """The gradient along the plane's axes, shape (v, u, axis) or (u, axis) [loss unit per unit of the axis].

        Raises ValueError for a slice that was sampled without gradients.
        """
        if "grad" not in self.data:
            raise ValueError("this slice was sampled without gradients; sample it again with gradients=True")
        found: NDArray[np.float64] = self.plane.slope(torch.from_numpy(self.data["grad"].to_numpy())).numpy()
        return found

    @property
    def floor(self) -> Floor | None:
        """The numerical floor: the differences between replicas of the objective, None where it was not measured."""
        from .measures.slice_floor import floor_of

        return floor_of(self.data)

    @property
    def errors(self) -> str:
        """The number of points that raised and the first message, in a line; empty where none did."""
        return errors_of(self.data)

    def minima(self, depth: float = 0.01) -> pd.DataFrame:
        """Return the local minima deeper than a share of the range of the losses, deepest first, a row each.

        The columns are the values along the plane's axes, the loss there, and the depth: the climb needed to reach a
        lower minimum (persistence). The depth of the lowest is the range of the losses. In a refined slice, the finest
        complete lattice counts.
        """
        import pandas as pd

        from .lattice import sampled_lattice
        from .measures.ruggedness import losses_of, minima, span

        data = sampled_lattice(self.data)
        loss = losses_of(data)
        found = minima(loss)
        deep = found.depth > depth * span(loss)
        places = np.unravel_index(found.sample[deep], loss.shape)[::-1]  # u first
        axes = [axis[torch.from_numpy(at)] for axis, at in zip(plane_of(data).axes(), places, strict=True)]
        values = self.plane.to_values(torch.stack(axes, dim=-1))
        columns = dict(zip(self.plane.labels, values.numpy().T, strict=True))
        return pd.DataFrame({**columns, "loss": loss.ravel()[found.sample[deep]], "depth": found.depth[deep]})

    def plot(self, runs: Sequence[HasData] = (), *, width: float | None = None) -> Picture:
        """Draw the slice, a loss map over its gradients or a profile over a line, with runs on top.

        It returns a matplotlib figure, which notebooks show. `width` draws it for a page of this width [mm]. Raises
        ValueError where a run has other parameters than the slice.
        """
        if runs:
            from .draw.figures.overlay import overlay_figure
            from .overlay import overlay

            return overlay_figure(self.data, overlay(self.data, [run.data for run in runs]), width=width)
        if self.plane.rank == 2:
            from .draw.figures.contour import landscape_figure

            return landscape_figure(self.data, floor=self.floor_map, width=width)
        from .draw.figures.profile import profile_figure

        points = self.plane.lift(self.plane.axes()[0][:, None])
        events = dict(self.remake().events(points)) if self.remake is not None else {}
        return profile_figure(self.data, events=events, floor=self.floor_map, width=width)

    def report(self, points: int = 6, seed: int = 0) -> Profile:
        """Measure the landscape of the slice: ruggedness, noise, jumps, gradients at several scales, with a verdict.

        `points` x `points` points of the slice are evaluated again, with points near them. Raises ValueError for a
        slice without gradients, for an incomplete one, and for one whose objective cannot be made again. Raises
        StoreMismatchError where the objective now gives other numbers than those in the slice.
        """
        from .lattice import sampled_lattice
        from .measures.profile import measure_profile
        from .objective import BoxedObjective
        from .verification import LAST_PLACE, RESAMPLE, verify_dataset

        if missing := int((self.data["status"] == Status.MISSING).sum()):
            raise ValueError(f"{missing} samples of this slice are missing; finish sampling it first")
        if self.remake is None or "grad" not in self.data:
            lacking = "its objective" if "grad" in self.data else "gradients"
            raise ValueError(f"a report needs {lacking}, which this slice lacks; sample it with gradscape.slice")
        objective = self.remake()
        if self.folder is not None:
            verify_dataset(objective, self.data, self.folder, todo=RESAMPLE)
        rounding = LAST_PLACE[self.identity.get("settings", {}).get("precision", "float64")]
        return measure_profile(
            BoxedObjective(objective) if self.identity.get("boxed") else objective, sampled_lattice(self.data),
            rounding=rounding, points=points, seed=seed, events=objective.events,
        )  # fmt: skip

    def __repr__(self) -> str:
        """Return the slice and its result in a line."""
        about = simulator_parts(self.identity)
        points = " x ".join(map(str, self.plane.resolution))
        loss = self.data["loss"]
        low, high = float(loss.min()), float(loss.max())
        finite = f"losses from {low:.4g} to {high:.4g}" if low <= high else "no finite loss"
        where = f" in {self.folder}" if self.folder else ""
        raised = f"; {self.errors}" if self.errors else ""
        numerics = f"; {self.floor.sentence()}" if self.floor else ""
        over = ", ".join(self.plane.labels)
        return f"<Slice of {' · '.join(about)} over {over}: {points} points, {finite}{numerics}{raised}{where}>"
