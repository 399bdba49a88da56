"""The surface of a landscape in a word, judged at fixed scales: shares of the range and of the box.

A minimum counts from a prominence of 1 % of the range, and so does a turn along a line; a larger noise or numerical
floor raises that. Such a count is true of the landscape if the samples determine the losses between them. That is
tested: losses at random points are compared with a prediction from the samples around them and their gradients. Without
an objective, every other sample is compared with a prediction from the rest. If more than 5 % of the points are off by
1 % of the range or more, the slice is undersampled. Only the turns remain valid then, as a lower bound: finer samples
can only add some.

A landscape that turns often is extremely rugged if differences of losses grow with a power of the distance below 0.7,
from 1/2048 to 1/256 of the box. That needs new evaluations; without them it stays open.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import torch
import xarray as xr

from ..identity import plane_of
from ..lattice import lift_between
from ..objective import Objective, evaluate
from ..plane import Plane
from ..statistics import UNKNOWN, Estimate, Values, exact_share, exactly, fit_line, from_parts, jackknife, share
from .ruggedness import count_turns, known_mean, lines_along, losses_of, minima, span, step_slopes

VERY_SMOOTH, SMOOTH, RUGGED, EXTREME = "very smooth", "smooth with local minima", "rugged", "extremely rugged"
LEAST = 0.01  # of the range: the least prominence that counts, and the error from which samples do not tell a loss
BAND = math.sqrt(2)  # a count is given for this many times the prominence, too, and for as small a part of it
MANY_TURNS = 6.0  # along a side from which a landscape is rugged
ROUGH = 0.7  # the exponent below which it is extremely so
UNDERSAMPLED = 0.05  # share of the places between samples
MOST_FLOOR = 0.1  # of the range that noise or numerics may hide of a smooth surface
SIDE, LEVEL, LARGE = 0.02, 1e-3, 0.2  # a region is level if over this part of the box it ranges over that of the losses
EXPLAINED = 0.05  # share of squared differences between samples that their neighbours leave open; an exponent's is more
ROUNDING = {np.float32: 2.0**-20, np.float64: 2.0**-48}  # of the largest loss that is no difference: eight last digits
PLACES = 96  # between samples, and where differences over short distances begin
WAYS, WAY_POINTS = 16, 32  # minima whose way to a lower one is looked at, and at most so many steps along it
DISTANCES = tuple(2.0**-power for power in (11, 10, 9, 8))  # from there, in parts of the box
EVALUATIONS_PER_PLACE = 1 + len(DISTANCES)
GROUPS = 8  # of starts, one of which is left out at a time


@dataclass(frozen=True, eq=False)
class Between:
    """Losses of a slice's plane at random points: `place` in steps along each axis of the array, and `loss`.

    `rise` is the difference of losses over each of `DISTANCES` from the first ones, shape (start, distance).
    `prominence` [loss unit] is that of the slice's minima, the deepest first; for examined ones it is at most the
    barrier on the straight way to a lower one.
    """

    place: Values
    loss: Values
    rise: Values
    prominence: Values


def look_between(
    objective: Objective,
    datasets: Sequence[xr.Dataset],
    floors: Sequence[float],
    *,
    places: int = PLACES,
    seed: int = 0,
) -> list[Between]:
    """Evaluate losses between the samples of slices, those of all slices in one batch.

    These are five for each of a slice's `places`, and some for each minimum in its samples except the lowest. Along a
    narrow valley, samples show false minima: the straight way to the next one has no barrier.
    """
    planes, losses = [plane_of(one) for one in datasets], [losses_of(one) for one in datasets]
    drawn = [_draw(plane.rank, places, seed) for plane in planes]
    ways = [_ways(loss, floor) for loss, floor in zip(losses, floors, strict=True)]
    x = []
    for plane, part, way in zip(planes, drawn, ways, strict=True):
        steps = np.array(plane.resolution)[::-1] - 1
        x.append(lift_between(plane, np.concatenate([part * steps, *way.points])))
    found = torch.split(evaluate(objective, torch.cat(x), grad=False).loss, [len(one) for one in x])
    return [_between(*each) for each in zip(planes, drawn, ways, found, strict=True)]


def _between(plane: Plane, drawn: Values, ways: _Ways, found: torch.Tensor) -> Between:
    values, steps = found.double().numpy(), np.array(plane.resolution)[::-1] - 1
    places = len(drawn) // EVALUATIONS_PER_PLACE
    rises = np.abs(values[places : len(drawn)].reshape(places, -1) - values[:places, None])
    return Between(drawn[:places] * steps, values[:places], rises, ways.prominences(values[len(drawn) :]))


def _draw(rank: int, places: int, seed: int) -> Values:
    """Return random points in shares of the box, and those at `DISTANCES` from each, along a random axis."""
    generator = np.random.default_rng(seed)
    start = generator.random((places, rank))
    axis = np.eye(rank)[generator.integers(rank, size=places)]
    near = start[:, None] + np.where(start < 0.5, axis, -axis)[:, None] * np.array(DISTANCES)[:, None]
    return np.concatenate([start, near.reshape(-1, rank)])


@dataclass(frozen=True, eq=False)
class _Ways:
    """The straight ways from minima of a slice to the nearest lower ones; `prominence` is from the samples."""

    prominence: Values
    lowest: Values
    points: tuple[Values, ...]

    def prominences(self, losses: Values) -> Values:
        """Return the prominence of each minimum, with the losses at the points of all ways."""
        found = self.prominence.copy()
        ends = np.cumsum([len(one) for one in self.points])
        for number, way in enumerate(np.split(losses, ends[:-1]) if len(ends) else []):
            found[number + 1] = np.fmin(found[number + 1], max(0.0, float(np.max(way) - self.lowest[number])))
        if len(self.points) == WAYS and (found[1 : WAYS + 1] < self.prominence[1 : WAYS + 1] / 2).all():
            found[WAYS + 1 :] = 0.0  # they are less deep than those that are all none
        return found


def _ways(loss: Values, floor: float) -> _Ways:
    whole, known = span(loss), minima(loss) if np.isfinite(loss).any() else None
    if known is None or not whole > floor:
        return _Ways(np.zeros(0), np.zeros(0), ())
    depth = max(floor, LEAST * whole)
    some = int((known.depth > max(floor, depth / BAND)).sum())
    places = np.stack(np.unravel_index(known.sample[:some], loss.shape), axis=-1).astype(float)
    low, points = loss.ravel()[known.sample[:some]], list[Values]()
    rugged = max(turning_points(loss, axis, depth) for axis in range(loss.ndim)) >= MANY_TURNS
    for one in range(1, 1 if rugged else min(some, WAYS + 1)):
        lower = np.flatnonzero((low < low[one]) | ((low == low[one]) & (np.arange(some) < one)))
        apart = np.linalg.norm(places[lower] - places[one], axis=1)
        steps = max(4, min(WAY_POINTS, math.ceil(2 * apart.min())))
        along = (np.arange(1, steps) / steps)[:, None]
        points.append(places[one] + along * (places[lower[apart.argmin()]] - places[one]))
    return _Ways(known.depth, low[1 : len(points) + 1], tuple(points))


@dataclass(frozen=True)
class Surface:
    """The surface of a slice, and its `word`, None where it is flat or not resolved.

    `minima` and `turns` (mean over lines, for each axis, u first) count from `depth` [loss unit]; their intervals are
    counts for a larger and a smaller depth, see `BAND`. `level` is the share of the box in level regions, `holder` the
    exponent over short distances, NaN where unknown. `off` is the share of points between samples whose loss the
    samples do not predict; `probed`: new evaluations tested that. A rugged surface that could be extremely rugged is
    rugged `at_least`. `unresolved` explains why there is no word.
    """

    derived: ClassVar = ("large_flat",)

    range: float
    floor: float
    depth: float
    flat: bool
    minima: Estimate
    turns: tuple[Estimate, ...]
    level: Estimate
    holder: Estimate
    off: Estimate
    probed: bool
    word: str | None
    at_least: bool
    unresolved: str

    @property
    def large_flat(self) -> bool | None:
        """Whether there are large flat regions, None where that is not resolved."""
        if self.flat:
            return None
        low, high = (end if math.isfinite(end) else self.level.value for end in (self.level.low, self.level.high))
        if low >= LARGE:
            return True
        return False if high < LARGE and not self.off.value > UNDERSAMPLED else None

    def describe(self) -> str:
        """Return the numbers behind the word: "4 minima, and at most 2.9 turns along a side"."""
        count, most = self.minima.value, max(self.turns, key=lambda one: one.value).value
        said = f"{count:.0f} {'minimum' if count == 1 else 'minima'} and {most:.1f} turns along a side"
        said += f", deeper than {100 * self.depth / self.range:.2g} % of the range"
        if math.isfinite(self.holder.value):
            said += f"; exponent over short distances {self.holder.value:.2f}"
        return said


def measure_surface(
    dataset: xr.Dataset, *, floor: float = 0.0, own_range: float | None = None, between: Between | None = None
) -> Surface:
    """Judge the surface of a slice, from its samples and, if known, from the losses `between` them.

    `floor` [loss unit] is the difference that noise or numerics alone can make, `own_range` the range of the whole
    environment.
    """
    loss = losses_of(dataset)
    whole, floor = span(loss), max(floor, rounding(loss))
    if not whole > max(floor, LEAST * (own_range or 0.0)):
        none, flat = UNKNOWN, math.isfinite(whole)
        return Surface(whole, floor, floor, flat, none, (none,) * loss.ndim, none, none, none, False, None, False, "")
    depth = max(floor, LEAST * whole)
    slope = step_slopes(dataset) if "grad" in dataset else None
    known = _Samples(loss, slope, depth) if between is None else _Probed(loss, slope, depth, between, floor)
    bands = [max(floor, depth * BAND), depth, max(floor, depth / BAND)]
    counts = [max(1, int((known.prominence > bound).sum())) for bound in bands]
    turned = [[turning_points(loss, axis, bound) for axis in range(loss.ndim)[::-1]] for bound in bands]
    turns = tuple(Estimate(middle, low, high) for low, middle, high in zip(*turned, strict=True))
    words = [_word(max(lines), count) for lines, count in zip(turned, counts, strict=True)]
    word, least, why = _judge(words, known, floor / whole)
    return Surface(
        whole, floor, depth, False, Estimate(*map(float, (counts[1], counts[0], counts[2]))), turns,
        level_share(loss, floor), known.holder, known.off, between is not None, word, least, why,
    )  # fmt: skip


class _Probed:
    """Test by new evaluations whether the samples of a slice determine the losses between them."""

    def __init__(self, loss: Values, slope: Values | None, depth: float, between: Between, floor: float) -> None:
        error = _nearest([np.abs(one - between.loss) for one in _predictions(loss, slope, between.place)], depth)
        self.off = share(int((error > depth).sum()), int(np.isfinite(error).sum()))
        self.prominence, self.holder = between.prominence, short_exponent(between, floor)
        self.smooth = self.holder.low >= ROUGH

    def doubt(self, word: str) -> str:
        """Explain why a word could be wrong; empty where there is no doubt."""
        return ""


class _Samples:
    """Test by every second sample whether the samples of a slice determine the losses between them."""

    def __init__(self, loss: Values, slope: Values | None, depth: float) -> None:
        self.loss, self.slope, self.depth = loss, slope, depth
        self.error, rise = _held_out(loss, slope, depth)
        known = _finite(self.error)
        self.off = share(int((known > depth).sum()), len(known))
        self.minima = minima(loss)
        self.prominence, self.holder = self.minima.depth, UNKNOWN
        self.smooth = bool(len(known)) and float(np.mean(known**2)) < EXPLAINED * float(np.mean(rise**2))

    def doubt(self, word: str) -> str:
        """Explain why a word could be wrong; empty where there is no doubt."""
        every, told = self._halved(), self._told()
        if every != word:
            return f"{word}, but {every} by every second sample"
        if told != (self.prominence > self.depth).sum() and word != RUGGED:
            return "some minima are no deeper than the prediction error of the samples"
        largest, off = self._contradiction()
        if off > UNDERSAMPLED:
            return f"gradients contradict the losses at {100 * off:.0f} % of the steps between samples"
        if largest > self.depth and word == VERY_SMOOTH:
            return f"a step between samples could be a jump, of {100 * largest / span(self.loss):.2g} % of the range"
        return ""

    def _halved(self) -> str:
        part = self.loss[(slice(None, None, 2),) * self.loss.ndim]
        turns = max(turning_points(part, axis, self.depth) for axis in range(part.ndim))
        return _word(turns, minima(part).count(self.depth))

    def _told(self) -> int:
        """Count the minima that are twice as deep as the prediction error of the samples around them."""
        from scipy.ndimage import maximum_filter

        around = maximum_filter(np.nan_to_num(self.error), size=3, mode="nearest").ravel()[self.minima.sample]
        deep = self.minima.depth
        return int(((deep > self.depth) & ((deep > 2 * around) | (np.arange(len(deep)) == 0))).sum())

    def _contradiction(self) -> tuple[float, float]:
        """Return the largest unexplained difference of neighbours, and the share that contradicts gradients."""
        steps, told = list[Values](), list[Values]()
        for axis in range(self.loss.ndim):
            difference = np.diff(self.loss, axis=axis)
            steps.append(np.abs(np.diff(difference, axis=axis)).ravel() / 2)
            if self.slope is not None:
                pairs = np.take(self.slope[..., axis], range(self.loss.shape[axis] - 1), axis)
                pairs = (pairs + np.take(self.slope[..., axis], range(1, self.loss.shape[axis]), axis)) / 2
                told.append(np.abs(difference - pairs).ravel())
        found = _finite(np.concatenate(told or steps))
        if not found.size:
            return 0.0, 0.0
        return float(found.max()), float((found > self.depth).mean()) if told else 0.0


def _judge(words: Sequence[str], known: _Probed | _Samples, hidden: float) -> tuple[str | None, bool, str]:
    """Return the word, whether it is a lower bound, and why there is none; `words` are those of the band of depths."""
    if words[0] == RUGGED:  # also where samples are too few: finer ones only add to the turns
        return (EXTREME, False, "") if known.holder.high < ROUGH else (RUGGED, not known.smooth, "")
    if not known.off.value <= UNDERSAMPLED:
        return None, False, f"the samples do not predict {100 * known.off.value:.0f} % of the points between them"
    if hidden > MOST_FLOOR:
        return None, False, f"noise or numerics hide differences below {100 * hidden:.0f} % of the range"
    if len(set(words)) > 1:
        return None, False, f"{' or '.join(dict.fromkeys(words))}, depending on the depth from which minima count"
    doubt = known.doubt(words[1])
    return (None, False, doubt) if doubt else (words[1], False, "")


def _word(turns: float, count: float) -> str:
    if turns >= MANY_TURNS:
        return RUGGED
    return SMOOTH if count > 1 else VERY_SMOOTH


def turning_points(loss: Values, axis: int, depth: float) -> float:
    """Return how often a line along an axis turns back by at least `depth`, the mean over lines, without NaN.

    A line counts if at least half of its samples have a loss.
    """
    lines = lines_along(loss, axis)
    lines = lines[np.isfinite(lines).mean(axis=1) >= 0.5]
    return count_turns(lines, depth) / len(lines) if len(lines) else math.nan


def level_share(loss: Values, floor: float) -> Estimate:
    """Return the share of the box in regions that are level over 2 % of it, or over a sample's width if that is more.

    Where noise hides that, only an upper bound is known.
    """
    widths = [max(1, round(SIDE * (points - 1))) for points in loss.shape]
    widest = max(width / (points - 1) / SIDE for width, points in zip(widths, loss.shape, strict=True))
    bound = LEVEL * span(loss) * max(1.0, widest)
    windows = np.lib.stride_tricks.sliding_window_view(loss, [width + 1 for width in widths])
    ranges = np.ptp(windows, axis=tuple(range(-loss.ndim, 0)))
    levels = np.where(np.isfinite(ranges), (ranges <= max(bound, floor)).astype(float), np.nan)
    apart = math.prod(points // (width + 1) for points, width in zip(loss.shape, widths, strict=True))
    found = exact_share(jackknife(known_mean, levels, least=0.0, most=1.0), apart)
    return Estimate(math.nan, math.nan, found.high) if floor > bound else found


def short_exponent(between: Between, floor: float) -> Estimate:
    """Return the power of the distance with which losses differ over short distances.

    It uses mean absolute differences, which a few jumps do not lower: over a jump they grow like the distance.
    Distances whose differences are within `floor` [loss unit] are left out; NaN where fewer than three remain.
    """
    rises = between.rise[np.isfinite(between.rise).all(axis=1)]
    seen = rises.mean(axis=0) > max(floor, 0.0) if len(rises) >= 2 * GROUPS else np.zeros(0)
    if seen.sum() < 3:
        return UNKNOWN
    distances = np.log(np.array(DISTANCES)[seen])

    def exponent(part: Values) -> float:
        apart = part[:, seen].mean(axis=0)
        return fit_line(distances, np.log(apart)).slope if (apart > 0).all() else math.nan

    value = exponent(rises)
    parts = [exponent(np.delete(rises, slice(k, None, GROUPS), axis=0)) for k in range(GROUPS)]
    return from_parts(value, parts) if np.isfinite(parts).all() else exactly(value)


def rounding(loss: Values) -> float:
    """Return the difference of losses that rounding can make, by the type in which they were computed."""
    known = loss[np.isfinite(loss)]
    if not known.size:
        return 0.0
    single = bool((known == known.astype(np.float32)).all())
    return float(ROUNDING[np.float32 if single else np.float64] * np.abs(known).max())


def _held_out(loss: Values, slope: Values | None, depth: float) -> tuple[Values, Values]:
    """Return the error of predicting every other sample from the rest, and from the nearest of them.

    It is NaN at the rest.
    """
    even = (slice(None, None, 2),) * loss.ndim
    coarse, error = loss[even], np.full(loss.shape, np.nan)
    at = np.argwhere(np.ones(loss.shape, bool))
    at = at[(at % 2).any(axis=1) & (at <= 2 * (np.array(coarse.shape) - 1)).all(axis=1)]
    truth = loss[tuple(at.T)]
    found = _predictions(coarse, None if slope is None else 2 * slope[even], at / 2)
    error[tuple(at.T)] = _nearest([np.abs(one - truth) for one in found], depth)
    return error, _finite(truth - loss[tuple((at - at % 2).T)])


def _nearest(errors: Sequence[Values], depth: float) -> Values:
    """Return the errors of the prediction that is most often right, or of the nearest if several are equal."""

    def size(error: Values) -> tuple[float, float]:
        known = _finite(error)
        return (float(np.mean(known > depth)), float(np.mean(known))) if known.size else (1.0, math.inf)

    return min(errors, key=size)


def _predictions(loss: Values, slope: Values | None, places: Values) -> list[Values]:
    """Return losses at positions between samples: by straight lines, and by cubics (Hermite).

    Their slopes come from the samples around and, if there are any, from gradients.
    """
    linear = _interpolate(loss, None, places)
    order: Literal[1, 2] = 2 if min(loss.shape) > 2 else 1  # of the differences at the border
    around = np.stack([np.gradient(loss, axis=axis, edge_order=order) for axis in range(loss.ndim)], axis=-1)
    cubics = [_interpolate(loss, one, places) for one in (around, slope) if one is not None]
    return [linear, *(np.where(np.isfinite(cubic), cubic, linear) for cubic in cubics)]


def _interpolate(loss: Values, slope: Values | None, places: Values) -> Values:
    """Interpolate between the samples around each position, with slopes by a step along each axis, or without.

    With them each cell is bicubic, its mixed derivative by differences of the gradients: exact for a quadratic.
    """
    rank = loss.ndim
    cell = np.clip(np.floor(places).astype(int), 0, np.array(loss.shape) - 2)
    t = places - cell
    value = [[1 - t, t]] if slope is None else [[(1 + 2 * t) * (1 - t) ** 2, t**2 * (3 - 2 * t)]]
    if slope is not None:
        value.append([t * (1 - t) ** 2, t**2 * (t - 1)])
    derivatives = {(0,) * rank: loss}
    if slope is not None:
        derivatives |= {tuple(int(k == axis) for k in range(rank)): slope[..., axis] for axis in range(rank)}
        if rank == 2:
            mixed = np.gradient(slope[..., 0], axis=1) + np.gradient(slope[..., 1], axis=0)
            derivatives[1, 1] = mixed / 2
    found = np.zeros(len(places))
    for orders, array in derivatives.items():
        for corner in np.ndindex((2,) * rank):
            weight = np.prod([value[orders[k]][corner[k]][:, k] for k in range(rank)], axis=0)
            found = found + weight * array[tuple((cell + np.array(corner)).T)]
    return found


def _finite(values: Values) -> Values:
    return values[np.isfinite(values)]
