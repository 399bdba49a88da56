"""What a slice came to: how its points ended, the range of its losses, and what its samples hide."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import xarray as xr

from ..landscapes.cost import duration
from ..landscapes.directions import barrier
from ..landscapes.identity import plane_of, stored_identity
from ..landscapes.measures.undersampled import Undersampled, find_undersampled
from ..landscapes.objective import Objective, Status, describe_errors
from ..landscapes.sampling.refine import Refined

JOINED = "joined"  # in the identity of a slice that was cut between points: their names


@dataclass(frozen=True)
class SliceSummary:
    """Say what a slice cost, as `summary.json` beside it has it; `status` counts points, `flat` those without slope.

    Gradients are at every `gradients_every` samples along each axis. `episodes` are those of the samples;
    `undersampled` has those that looked between them, and what they found, None where nothing is known of it.
    `barrier` [loss unit] is that between the ends of a line. `error` is what the first point that raised said.
    """

    env: str | None
    dims: list[str]
    fidelity: str | None
    device: str | None
    options: dict[str, Any] | None
    resolution: list[int]
    gradients: bool
    gradients_every: int
    episodes: int
    resumed: int
    seconds: float
    status: dict[str, int]
    loss: dict[str, float | None]
    flat: int | None
    undersampled: Undersampled | None
    refinement: Refined | None
    command: str
    files: list[str]
    barrier: float | None = None
    error: str = ""

    def outcome(self) -> str:
        """Say in a line what the slice cost and what came out."""
        counts = {kind: count for kind, count in self.status.items() if count}
        ends = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in counts.items())
        raised = f"; {said}" if (said := describe_errors(counts.get("error", 0), self.error)) else ""
        refined = f"; {self.refinement.say()}" if self.refinement else ""
        losses = say_range(self.loss)
        sloped = math.prod(-(-points // self.gradients_every) for points in self.resolution)
        asked = min(sloped, sum(counts.values()) - counts.get("interpolated", 0))
        share = (self.flat or 0) / asked if asked else 0.0
        flat = f"; gradient exactly zero at {share:.1%} of points" if share else ""
        barred = "" if self.barrier is None else f"; barrier of {self.barrier:.4g} above the line between its ends"
        hidden = f"; {said}" if self.undersampled and (said := self.undersampled.describe()) else ""
        spent = f"{self.episodes} episodes in {duration(self.seconds)}"
        return f"{spent}; {ends}{raised}; {losses}{flat}{barred}{refined}{hidden}"


def look_between(objective: Objective, dataset: xr.Dataset) -> dict[str, Any]:
    """Return the attribute of a slice that says which share of its cells is undersampled.

    An objective that raises between them has been sampled all the same: that is warned of, and nothing is said.
    """
    try:
        found = find_undersampled(objective, dataset)
        return found.attribute() if found else {}
    except (OSError, MemoryError):  # lost workers, a full disk: the slice is finished once they are there again
        raise
    except Exception as error:
        said = f"{objective.name} raised between the samples, so what they hide is not known: {error}"
        warnings.warn(said, RuntimeWarning, stacklevel=2)
        return {}


def barrier_of(dataset: xr.Dataset) -> float | None:
    """Return the height of the barrier on a line between two points, None for other slices and where samples failed."""
    if dataset["loss"].ndim != 1 or JOINED not in stored_identity(dataset).get("cut", {}):
        return None
    height = barrier(dataset["u"].to_numpy(), dataset["loss"].to_numpy())
    return height if math.isfinite(height) else None


def count_statuses(dataset: xr.Dataset) -> dict[str, int]:
    """Count the points of a slice by how they ended."""
    status = dataset["status"].to_numpy()
    return {kind.name.lower(): int((status == kind).sum()) for kind in Status}


def range_of(dataset: xr.Dataset) -> dict[str, float | None]:
    """Return the lowest and the highest finite loss of a slice, None where there is none."""
    loss = dataset["loss"].to_numpy()
    if not np.isfinite(loss).any():
        return {"lowest": None, "highest": None}
    return {"lowest": float(np.nanmin(loss)), "highest": float(np.nanmax(loss))}


def say_range(loss: Mapping[str, float | None]) -> str:
    """Say in words what `range_of` returns."""
    low, high = loss["lowest"], loss["highest"]
    return "no finite loss" if low is None else f"losses from {low:.4g} to {high:.4g}"


def flat_points(dataset: xr.Dataset) -> int | None:
    """Count the points whose gradient along the plane is exactly zero, none if gradients are not there."""
    if "grad" not in dataset:
        return None
    slope = plane_of(dataset).slope(torch.from_numpy(dataset["grad"].to_numpy()))
    return int((slope == 0).all(dim=-1).sum())
