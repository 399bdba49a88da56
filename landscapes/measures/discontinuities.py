"""Discontinuities of a loss: differences between neighbouring samples that do not vanish on a finer look."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..identity import plane_of
from ..objective import Objective, evaluate
from ..plane import Plane
from ..statistics import Estimate, share

HALVINGS = 12  # a gap between samples is looked into down to 1/4096 of it
EVALUATIONS_PER_PAIR = 2 + HALVINGS
PERSISTS = 3  # halvings over which a jump keeps more than half of its height, and a slope an eighth
Count = Callable[[Tensor], Mapping[str, Tensor]]


@dataclass(frozen=True)
class Jump:
    """Hold where a jump is [plane units] and its height [loss unit].

    `event` says whether some event happens more or less often on its other side, None where the objective counts none.
    """

    place: tuple[float, ...]
    height: float
    event: bool | None


@dataclass(frozen=True)
class Jumps:
    """Hold the jumps that were `found`, the highest first, and how often they occur between neighbouring samples.

    Of `neighbours` pairs of samples `steep` differ by at least `least` [loss unit]; `checked` of these were looked into
    and `undecided` could not be, as an evaluation there failed.
    """

    derived: ClassVar = ("share", "explained_by_events")

    found: tuple[Jump, ...]
    least: float
    neighbours: int
    steep: int
    checked: int
    undecided: int

    @property
    def share(self) -> Estimate:
        """Share of all pairs of neighbours with a jump between them; no interval where every steep one was checked."""
        decided, part = self.checked - self.undecided, self.steep / self.neighbours if self.neighbours else math.nan
        if self.steep == 0:
            return Estimate(0.0, 0.0, 0.0)
        found = share(len(self.found), decided)
        if decided == self.steep:
            return Estimate(found.value * part, found.value * part, found.value * part)
        return Estimate(found.value * part, found.low * part, found.high * part)

    @property
    def explained_by_events(self) -> Estimate | None:
        """Share of the jumps across which an event is counted differently, None where there is no jump or no event."""
        explained = [jump.event for jump in self.found]
        return share(sum(map(bool, explained)), len(explained)) if explained and None not in explained else None


def find_jumps(
    objective: Objective,
    datasets: Sequence[xr.Dataset],
    *,
    least: Sequence[float],
    most: int = 64,
    seed: int = 0,
    events: Count | None = None,
) -> list[Jumps]:
    """Look for jumps between neighbouring samples of slices, by new evaluations; those of all slices are in one batch.

    A jump is at least as high as its slice's bound in `least` [loss unit]. At most so many pairs of a slice, drawn at
    random from those that differ by as much, are bisected towards the larger half: a jump keeps its height, a slope
    loses half of it every time.
    """
    planes = [plane_of(dataset) for dataset in datasets]
    pairs = [_steep_pairs(*one) for one in zip(datasets, planes, least, strict=True)]
    drawn = [ends[np.sort(np.random.default_rng(seed).permutation(len(ends))[:most])] for ends, _ in pairs]
    bisected = _bisect(objective, planes, [torch.from_numpy(ends) for ends in drawn])
    jumps = []
    for plane, (ends, neighbours), bound, (low, high, gaps) in zip(planes, pairs, least, bisected, strict=True):
        decided = gaps.isfinite().all(dim=0)
        last, earlier = gaps[-1], gaps[-1 - PERSISTS]
        found = decided & (last >= bound) & (last > earlier / 2)
        counted = _differ(events, plane.lift(low[found]), plane.lift(high[found])) if events else None
        place, undecided = (low + high)[found] / 2, int((~decided).sum())
        events_there = [None] * len(place) if counted is None else counted.tolist()
        each = map(Jump, map(tuple, place.tolist()), last[found].tolist(), events_there)
        highest_first = tuple(sorted(each, key=lambda jump: -jump.height))
        jumps.append(Jumps(highest_first, bound, neighbours, len(ends), len(low), undecided))
    return jumps


def _steep_pairs(dataset: xr.Dataset, plane: Plane, least: float) -> tuple[NDArray[np.float64], int]:
    """Return the ends of pairs that differ so much, shape (pairs, 2, rank), and how many pairs there are."""
    loss = dataset["loss"].transpose("v", "u", missing_dims="ignore").to_numpy()
    axes = [axis.numpy() for axis in plane.axes()]
    places = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], axis=-1)
    pairs, neighbours = [np.zeros((0, 2, plane.rank))], 0
    for axis in range(loss.ndim):
        apart = np.abs(np.diff(loss, axis=axis))
        neighbours += int(np.isfinite(apart).sum())
        first, second = (np.delete(places, at, axis=axis) for at in (-1, 0))
        with np.errstate(invalid="ignore"):
            pairs.append(np.stack([first, second], axis=-2)[(apart >= least) & (apart > 0)])
    return np.concatenate(pairs), neighbours


def _bisect(
    objective: Objective, planes: Sequence[Plane], ends: Sequence[Float[Tensor, "pairs end rank"]]
) -> list[tuple[Tensor, Tensor, Float[Tensor, "halvings pairs"]]]:
    """Halve every pair towards the larger difference; return its last ends and the difference after each halving."""
    counts = [len(one) for one in ends]
    low, high = torch.cat(list(ends)).unbind(dim=1)

    def losses(u: Float[Tensor, "pairs rank"]) -> Float[Tensor, " pairs"]:
        x = [plane.lift(part) for plane, part in zip(planes, torch.split(u, counts), strict=True)]
        return evaluate(objective, torch.cat(x), grad=False).loss

    below, above = losses(low), losses(high)  # again: a slice may come from another device
    gaps = [(above - below).abs()]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        between = losses(middle)
        left = (between - below).abs() >= (above - between).abs()
        high, above = torch.where(left[:, None], middle, high), torch.where(left, between, above)
        low, below = torch.where(left[:, None], low, middle), torch.where(left, below, between)
        gaps.append((above - below).abs() + 0 * between)  # NaN once a middle failed
    halved = torch.split(torch.stack(gaps), counts, dim=1)
    return list(zip(torch.split(low, counts), torch.split(high, counts), halved, strict=True))


def _differ(events: Count, low: Float[Tensor, "jumps dim"], high: Float[Tensor, "jumps dim"]) -> Tensor | None:
    before, after = events(low), events(high)
    if not before:
        return None
    return torch.stack([before[name].cpu() != after[name].cpu() for name in before]).any(dim=0)
