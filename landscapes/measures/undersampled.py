"""Features that the samples of a slice miss: jumps, ridges and ripples finer than they are, as a share of its cells.

A cell lies between neighbouring samples: two along a line, four in a plane. It is undersampled if the loss between them
differs from the prediction of the samples, in one of two ways. First, at a point halfway, it differs from both the mean
of the samples around it and the prediction of their gradients (exact for a quadratic). The difference exceeds half a
step of a ramp through the range of the losses. Second, a difference of that size keeps more than a quarter of itself
when its interval is halved three times, as a jump does; a slope, however steep, keeps an eighth.

Cells are drawn at random from three strata, with new evaluations of their losses only:

- contradicted: along an edge, the gradients at both ends do not explain the difference between them, or send the cubic
  through both (Hermite) beyond the ends. That is the trace of a hidden feature. The edge is bisected.
- steep: along an edge the loss changes by more than half a step, as its gradients predict. The edge is bisected, too.
- quiet: all others. The loss is evaluated in the middle, because a feature without a trace can only be found by chance.

In a slice without gradients, or with gradients at only some samples, differences of neighbouring losses replace them.
Interpolated cells of a refined slice count as resolved; their accuracy is reported separately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..convert import from_attribute, to_attribute
from ..identity import plane_of
from ..large import LARGE, in_unit, unit_of
from ..lattice import has_all_gradients, lift_between
from ..objective import Objective, Status, evaluate
from ..plane import Plane
from ..statistics import Estimate, Values, share
from .ruggedness import half_step, losses_of, span, step_slopes

ATTRIBUTE = "unresolved"  # the attribute of a slice that holds its record
COST = {True: 5, False: 10}  # samples of a slice, with or without gradients, that cost ten times as much as a loss
HALVINGS, KEPT = 3, 1 / 4  # of an edge, and what a jump keeps more than of its height; a slope keeps an eighth
PLACES = np.arange(1, 16) / 16  # of an edge, where its cubic is looked at
ROUNDING = 2.0**-20  # of the largest loss: what float32 may add up to is no difference
SUSPECTED = 1 / 2  # of the evaluations, at most, goes to where samples contradict each other

CONTRADICTED, STEEP, QUIET = "contradicted", "steep", "quiet"
Cells = NDArray[np.intp]  # lower corners of cells, shape (count, rank), in array order


@dataclass(frozen=True)
class Undersampled:
    """The `share` of a slice's cells whose loss its samples miss.

    Of `cells` between samples that did not fail, `probed` were examined, `found` were undersampled, and `undecided`
    ones had a failed evaluation, in `episodes` evaluations. A difference counts from `least` [loss unit].
    """

    share: Estimate
    least: float
    cells: int
    probed: int
    found: int
    undecided: int
    episodes: int

    def format_share(self) -> str:
        """Return the share with its interval, empty where it is unknown."""
        if not math.isfinite(self.share.value):
            return ""
        value, low, high = (100 * part for part in (self.share.value, self.share.low, self.share.high))
        interval = f" ({_round(low)} to {_round(high)} %)" if low else f" (95 % upper bound {_round(high)} %)"
        return f"{_round(value)} %{interval if high > low else ''}"

    def describe(self) -> str:
        """Give the share of undersampled cells in a line; empty where it is unknown."""
        said = self.format_share()
        return f"undersampled cells: {said}" if said else ""

    def attribute(self) -> dict[str, str]:
        """Return the text of the attribute in which a slice stores it."""
        return to_attribute(ATTRIBUTE, self)

    @classmethod
    def of(cls, dataset: xr.Dataset) -> Undersampled | None:
        """Read it from a slice, None where the slice has none."""
        return from_attribute(cls, dataset.attrs, ATTRIBUTE)


def find_undersampled(
    objective: Objective, dataset: xr.Dataset, *, floor: float = 0.0, seed: int = 0
) -> Undersampled | None:
    """Look between the samples of a slice, at most at a tenth of its own cost; None where that is too little.

    `floor` [loss unit] is the least difference above the noise. A slice with zero range has steps of zero, so any
    difference above rounding counts.
    """
    unit, dataset = unit_of(dataset["loss"].to_numpy()), in_unit(dataset)
    loss = losses_of(dataset)
    slope = _step_slopes(dataset, loss)
    least = _least(loss, floor / unit)
    strata = _strata(loss, slope, least)
    budget = probes(_evaluated(dataset), grad=has_all_gradients(dataset))
    cells = sum(map(len, strata.values()))
    if not cells:
        return None
    look = _Look(objective, plane_of(dataset), loss, slope, least, unit)
    generator, parts = np.random.default_rng(seed), list[tuple[int, int, Values]]()
    for name, stratum in strata.items():
        most = _most(name, strata, budget, budget - look.episodes)
        if len(stratum) and not most:
            return None
        drawn = stratum[np.sort(generator.permutation(len(stratum))[:most])]
        parts.append((len(stratum), len(drawn), look.middles(drawn) if name == QUIET else look.edges(drawn, name)))
    decided = [result[np.isfinite(result)] for _, _, result in parts]
    return Undersampled(
        share=_combine(
            [(count, int(one.sum()), len(one)) for (count, _, _), one in zip(parts, decided, strict=True)],
            of=math.prod(points - 1 for points in loss.shape) if _evaluated(dataset) < loss.size else cells,
        ),
        least=least * unit,
        cells=cells,
        probed=sum(drawn for _, drawn, _ in parts),
        found=int(sum(one.sum() for one in decided)),
        undecided=sum(drawn - len(one) for (_, drawn, _), one in zip(parts, decided, strict=True)),
        episodes=look.episodes,
    )


def probes(samples: int, *, grad: bool) -> int:
    """Return the largest number of losses to evaluate between this many samples.

    That is a tenth of the cost of the samples, if a gradient costs as much as the loss itself; it costs more.
    """
    return samples // COST[grad]


def _most(name: str, strata: dict[str, Cells], budget: int, left: int) -> int:
    """Return how many cells of a stratum can be examined with the remaining evaluations.

    Suspected cells get half of the budget, or what they need of it; the others share the rest by their numbers.
    """
    if name == QUIET:
        return left
    steep, quiet = len(strata[STEEP]), len(strata[QUIET])
    part = SUSPECTED * budget if name == CONTRADICTED else left * steep / max(steep + quiet, 1)
    return min(max(1, int(part) // HALVINGS), left // HALVINGS)


def _round(percent: float) -> str:
    return f"{percent:.1f}" if 0 < percent < 1 else f"{percent:.0f}"


def contradicted_cells(dataset: xr.Dataset) -> NDArray[np.bool_]:
    """Return which cells between the samples of a slice are contradicted, with a corner less along each axis.

    A cell with a failed or unsampled corner does not count. A difference counts from the value in the slice's own
    record, or from half a step of a ramp through the range.
    """
    known, unit, dataset = Undersampled.of(dataset), unit_of(dataset["loss"].to_numpy()), in_unit(dataset)
    loss = losses_of(dataset)
    least = known.least / unit if known and math.isfinite(known.least) else _least(loss, 0.0)
    found = np.zeros([points - 1 for points in loss.shape], dtype=bool)
    found[tuple(_strata(loss, _step_slopes(dataset, loss), least)[CONTRADICTED].T)] = True
    return found


def _least(loss: Values, floor: float) -> float:
    """Return the smallest difference that counts: half a step of a ramp, and no less than noise and rounding."""
    known = np.isfinite(loss)
    least = max(floor, half_step(span(loss), loss.shape))
    return float(max(least, ROUNDING * np.abs(loss[known]).max())) if known.any() else float(least)


def _step_slopes(dataset: xr.Dataset, loss: Values) -> Values:
    """Return the derivatives by a step from sample to sample along each axis of the array, axis last."""
    if not has_all_gradients(dataset):
        return np.stack([np.gradient(loss, axis=axis) for axis in range(loss.ndim)], axis=-1)
    return np.clip(step_slopes(dataset), -LARGE, LARGE)  # no loss continues like that, and sums of them are numbers


def _strata(loss: Values, slope: Values, least: float) -> dict[str, Cells]:
    """Return the lower corners of the cells of each stratum; a cell with a corner that failed is in none."""
    gap, surprise = (_of_cells(edges) for edges in _edges(loss, slope))
    whole = np.isfinite(gap)
    contradicted = whole & (surprise > least)
    steep = whole & ~contradicted & (gap > least)
    kinds = {CONTRADICTED: contradicted, STEEP: steep, QUIET: whole & ~contradicted & ~steep}
    return {name: np.argwhere(where) for name, where in kinds.items()}


def _edges(loss: Values, slope: Values) -> tuple[list[Values], list[Values]]:
    """Return the differences along the edges of each axis, and the parts that gradients do not explain."""
    gaps, surprises = list[Values](), list[Values]()
    for axis in range(loss.ndim):
        low, high = _pairs(loss, axis)
        gaps.append(np.abs(high - low))
        surprises.append(np.nan_to_num(_surprise(low, high, *_pairs(slope[..., axis], axis))))
    return gaps, surprises


def _surprise(low: Values, high: Values, start: Values, end: Values) -> Values:
    """Return how far the gradients at the ends of edges contradict their losses.

    The measure is the trapezoidal rule, or how far the cubic through both goes beyond the ends.
    """
    found: Values = np.abs(high - low - (start + end) / 2)
    top, bottom = np.maximum(low, high), np.minimum(low, high)
    for at in PLACES:
        between = low + (high - low) * at**2 * (3 - 2 * at) + at * (1 - at) * (start * (1 - at) - end * at)
        found = np.maximum(found, np.maximum(between - top, bottom - between))
    return found


def _pairs(values: Values, axis: int) -> tuple[Values, Values]:
    count = values.shape[axis]
    return np.take(values, range(count - 1), axis), np.take(values, range(1, count), axis)


def _of_cells(edges: Sequence[Values]) -> Values:
    """Return the largest value of the edges of each cell, NaN where one is."""
    rank, most = len(edges), list[Values]()
    for axis, values in enumerate(edges):
        windows = sliding_window_view(values, [1 if other == axis else 2 for other in range(rank)])
        most.append(windows.max(axis=tuple(range(rank, 2 * rank))))
    found: Values = np.maximum.reduce(most)
    return found


@dataclass
class _Look:
    """Examine cells of a slice by new evaluations, and count them.

    The result is 1 for an undersampled cell, 0 for another one, NaN where an evaluation failed.
    """

    objective: Objective
    plane: Plane
    loss: Values
    slope: Values
    least: float
    unit: float  # of losses, slopes and `least`
    episodes: int = 0

    def ask(self, at: Values) -> Values:
        """Return losses at positions between samples, shape (count, rank), in steps along each axis of the array."""
        if not len(at):
            return np.zeros(0)
        self.episodes += len(at)
        losses: Values = evaluate(self.objective, lift_between(self.plane, at), grad=False).loss.numpy() / self.unit
        return losses

    def middles(self, cells: Cells) -> Values:
        """Compare the middles of cells with all their corners."""
        corners = [np.array(corner) for corner in np.ndindex((2,) * self.loss.ndim)]
        middle = cells.astype(np.float64) + 0.5
        return self._off(self.ask(middle), [cells + corner for corner in corners], middle)

    def edges(self, cells: Cells, kind: str) -> Values:
        """Bisect the steepest or most contradicted edge of each cell, towards the larger difference."""
        low, high = self._worst(cells, kind)
        below, above = self.loss[tuple(low.T)], self.loss[tuple(high.T)]
        low, high, first = low.astype(float), high.astype(float), np.abs(above - below)
        ends = [low.astype(int), high.astype(int)]
        found, open_ = np.zeros(len(cells)), np.ones(len(cells), bool)
        for halving in range(HALVINGS):
            middle = (low + high) / 2
            between = np.full(len(cells), np.nan)
            between[open_] = self.ask(middle[open_])
            found[open_ & ~np.isfinite(between)] = np.nan
            if not halving:
                found = np.maximum(found, self._off(between, ends, middle))
            left = np.abs(between - below) >= np.abs(above - between)
            high, above = np.where(left[:, None], middle, high), np.where(left, between, above)
            low, below = np.where(left[:, None], low, middle), np.where(left, below, between)
            open_ &= (found == 0) & (np.abs(above - below) > self.least)
        return np.where(open_ & (np.abs(above - below) > KEPT * first), 1.0, found)

    def _worst(self, cells: Cells, kind: str) -> tuple[Cells, Cells]:
        """Return the ends of the edge of each cell to bisect."""
        measure = _edges(self.loss, self.slope)[kind == CONTRADICTED]
        rank = self.loss.ndim
        edges = [
            (axis, np.array(corner)) for axis in range(rank) for corner in np.ndindex((2,) * rank) if not corner[axis]
        ]
        values = np.stack([measure[axis][tuple((cells + corner).T)] for axis, corner in edges], axis=-1)
        chosen = values.argmax(axis=-1) if len(cells) else np.zeros(0, int)
        low = cells + np.array([corner for _, corner in edges])[chosen]
        return low, low + np.eye(rank, dtype=int)[np.array([axis for axis, _ in edges])[chosen]]

    def _off(self, found: Values, around: Sequence[Cells], at: Values) -> Values:
        """Return where losses differ from both the mean of the samples `around` and their gradients, NaN if failed.

        The mean of f + g d / 2 over samples on opposite sides is the loss between them where it is quadratic.
        """
        losses = [self.loss[tuple(one.T)] for one in around]
        off = np.abs(found - np.mean(losses, axis=0))
        rises = [(self.slope[tuple(one.T)] * (at - one)).sum(axis=-1) for one in around]
        off = np.fmin(off, np.abs(found - np.mean(losses, axis=0) - np.mean(rises, axis=0) / 2))
        return np.where(np.isfinite(found), (off > self.least).astype(float), np.nan)


def _evaluated(dataset: xr.Dataset) -> int:
    """Return the number of evaluated samples of a slice; a refined one interpolates others."""
    return int((dataset["status"] != Status.INTERPOLATED).sum())


def _combine(strata: Sequence[tuple[int, int, int]], *, of: int) -> Estimate:
    """Return the share over strata, each a count of cells, of hits and of tries, and its interval.

    It is a share `of` all cells. Each stratum has its exact binomial interval, none where all of it was examined; they
    are combined by their variances (Zou & Donner 2008, Stat. Med. 27, eqs. 3 and 4).
    """
    value, below, above = 0.0, 0.0, 0.0
    for count, hits, tries in strata:
        if not count:
            continue
        one = share(hits, tries) if tries < count else Estimate(*[hits / tries] * 3)
        weight = count / of
        value += weight * one.value
        below += (weight * (one.value - one.low)) ** 2
        above += (weight * (one.high - one.value)) ** 2
    return Estimate(value, max(0.0, value - math.sqrt(below)), min(1.0, value + math.sqrt(above)))
