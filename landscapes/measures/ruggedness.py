"""Ruggedness of the losses of a slice: minima and basins, flatness, correlation, variation, information.

Every measure takes losses, shape (u,) or (v, u), at evenly spaced samples of a box whose sides count as 1. Failed
evaluations are NaN; they are left out, never filled in.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from ..identity import plane_of
from ..large import refuse_large
from ..objective import Status
from ..statistics import Estimate, Values, exact_share, fit_line, jackknife, share
from .exploratory import SETTLED, SIZES, distances_of, walk_information

FLAT_SLOPE = 1e-3  # a slope below it is effectively zero [ranges of the losses per side of the box]
NOTABLE = 0.01  # the least depth of a notable minimum, as a fraction of the range
THRESHOLDS = (1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3)  # depths that minima are counted by, as fractions of the range
BEST_SHARE = 0.05  # share of the samples that dispersion calls the best
LAGS, WIDEST = 3, 4  # fewest that an exponent is fitted to; the widest is this part of the side
DISTANCES = sorted({1} | {part * 2**power for power in range(20) for part in (2, 3)})  # in steps
WALKED = 500  # points of a walk
PAIRED = 4096  # most samples whose pairs are gone through one by one, 8 million of them


@dataclass(frozen=True)
class Minima:
    """The local minima of a slice, deepest first: their depths [loss unit] and their samples.

    Depth is persistence: the climb needed to reach a lower minimum. That of the lowest one is the range of the losses.
    """

    depth: Values
    sample: NDArray[np.intp]

    def count(self, depth: float) -> int:
        """Count minima deeper than `depth`."""
        return int((self.depth > depth).sum())


def minima(loss: Values) -> Minima:
    """Find local minima, diagonal neighbours included, by persistence of the sublevel sets (cubical complex)."""
    from gudhi import CubicalComplex

    known = np.isfinite(loss)
    if not known.any():
        return Minima(np.zeros(0), np.zeros(0, np.intp))
    filled = np.where(known, loss, np.inf)
    complex_ = CubicalComplex(top_dimensional_cells=filled)
    complex_.compute_persistence()
    pairs, lasting = complex_.cofaces_of_persistence_pairs()
    born, died = pairs[0].T if len(pairs) and len(pairs[0]) else np.zeros((2, 0), np.intp)
    start = np.concatenate([lasting[0], born]).astype(np.intp)
    value = filled.ravel(order="F")
    depth = np.concatenate([np.full(len(lasting[0]), np.inf), value[died] - value[born]])
    depth = np.where(np.isfinite(depth), depth, span(loss))  # the lowest, and what failures cut off from the rest
    order = np.argsort(-depth, kind="stable")
    places = np.ravel_multi_index(np.unravel_index(start[order], loss.shape, order="F"), loss.shape)
    there = np.isfinite(loss.ravel()[places])
    return Minima(depth[order][there], places[there])


def basins(loss: Values, sample: NDArray[np.intp]) -> Values:
    """Return the shares of the samples that drain to each of these minima (watershed)."""
    from skimage.segmentation import watershed

    markers = np.zeros(loss.shape, np.int32)
    markers.ravel()[sample] = 1 + np.arange(len(sample))
    known = np.isfinite(loss)
    heights = np.where(known, loss, 0.0)
    labels = watershed(heights, markers, mask=known, connectivity=loss.ndim)  # type: ignore[no-untyped-call]
    shares: Values = np.bincount(labels[known], minlength=len(sample) + 1)[1:] / max(known.sum(), 1)
    return shares


def minima_of_halves(loss: Values, depth: float) -> tuple[int, int]:
    """Return the fewest and the most minima deeper than `depth` that every second sample would show."""
    starts = np.ndindex((2,) * loss.ndim)
    counts = [minima(loss[tuple(slice(at, None, 2) for at in start)]).count(depth) for start in starts]
    return min(counts), max(counts)


def span(loss: Values) -> float:
    """Return the range of the losses. Raises ValueError where their differences would overflow."""
    refuse_large(loss)
    known = loss[np.isfinite(loss)]
    return float(known.max() - known.min()) if known.size else math.nan


def half_step(whole: float, shape: Sequence[int]) -> float:
    """Return half a step, between samples of the longer axis, of a ramp through a range; 0 where it is NaN."""
    return float(np.nan_to_num(whole)) / (max(shape) - 1) / 2


def level_samples(loss: Values, depth: float) -> Values:
    """Return 1 for each sample that differs from its neighbours by at most `depth`, 0 for others."""
    most = np.zeros_like(loss)
    for axis in range(loss.ndim):
        apart = np.nan_to_num(np.abs(np.diff(loss, axis=axis)))
        for side in (slice(1, None), slice(-1)):
            near = (slice(None),) * axis + (side,)
            most[near] = np.maximum(most[near], apart)
    return np.where(np.isfinite(loss), (most <= depth).astype(float), np.nan)


def correlation_length(loss: Values, axis: int) -> float:
    """Return the distance at which the autocorrelation along an axis falls to 1/e, in fractions of the box.

    Each line varies about its own mean; lines are weighted by their variance.
    """
    lines = lines_along(loss, axis)
    lines = lines[np.isfinite(lines).any(axis=1)]
    lines = lines - np.nanmean(lines, axis=1, keepdims=True)
    points, before = lines.shape[1], 1.0
    variance = known_mean(lines**2)
    if not variance > 0:
        return math.nan
    for lag in range(1, points):
        now = known_mean(lines[:, :-lag] * lines[:, lag:]) / variance
        if now < 1 / math.e:
            return float((lag - (1 / math.e - now) / (before - now)) / (points - 1))
        before = now if math.isfinite(now) else before
    return 1.0


def holder_exponent(loss: Values, axis: int, floor: float) -> float:
    """Return the exponent of the growth of differences along an axis with distance: |f(x + h) - f(x)| ~ h^exponent.

    The slope of the logarithm of the root mean square of differences over 1, 2, 3, 4, 6, 8, ... steps, up to a quarter
    of the side, against that of the distance: Wang et al. 2023, *Fractal landscapes in policy optimization* (NeurIPS),
    section 5, with differences of samples instead of a Gaussian's. Beyond the correlation length differences stop
    growing in any landscape, so longer distances are left out. So are differences no larger than `floor`. NaN where
    fewer than three distances remain: such a landscape varies within the distance of the samples.
    """
    lines, known = lines_along(loss, axis), list[tuple[float, float]]()
    sides = lines.shape[1] - 1
    longest = sides * min(1 / WIDEST, np.nan_to_num(correlation_length(loss, axis)))
    for lag in (lag for lag in DISTANCES if lag <= longest):
        apart = math.sqrt(known_mean((lines[:, lag:] - lines[:, :-lag]) ** 2))
        if apart > floor:
            known.append((math.log(lag), math.log(apart)))
    return fit_line(*zip(*known, strict=True)).slope if len(known) >= LAGS else math.nan


def total_variation(loss: Values, axis: int) -> float:
    """Return how many times lines along an axis pass through their own range: 1 if monotone, 2 across a bowl."""
    lines = lines_along(loss, axis)
    ranges = sum(span(line) for line in lines[np.isfinite(lines).any(axis=1)])
    return float(np.nansum(np.abs(np.diff(lines, axis=1)))) / ranges if ranges > 0 else math.nan


def information_content(loss: Values) -> tuple[float, float]:
    """Return the information content h_max and log10 of the settling sensitivity eps_s, of a walk over a slice.

    Munoz, Kirley & Halgamuge 2015, IEEE Trans. Evol. Comput. 19(1), eqs. 6 to 9: the walk goes from each point of a
    sample of the box to the nearest remaining one. The sample is up to `WALKED` points of the slice, drawn at random,
    so the result hardly depends on the resolution. Slopes are in ranges of the losses per side of the box, which makes
    slices comparable.
    """
    places, whole = np.argwhere(np.isfinite(loss)), span(loss)
    if len(places) < 3 or not whole > 0:
        return math.nan, math.nan
    some = places[np.random.default_rng(0).permutation(len(places))[:WALKED]]
    entropy, _ = walk_information(distances_of(some / _sides(loss.shape)), loss[tuple(some.T)], whole)
    settled = SIZES[(entropy < SETTLED) & (SIZES > 0)]
    return float(entropy.max()), math.log10(settled[0])


def turns(loss: Values, floor: float = 0.0) -> float:
    """Return the share of steps between samples that turn back, ignoring small steps.

    Small is less than half the step of a ramp through the range of the losses. This is the partial information content
    M of Munoz et al. 2015, eq. 10, with two changes. A walk that never turns has 0, and going back by no more than
    `floor` [loss unit] is no turn.
    """
    turned = 0
    for axis in range(loss.ndim):
        small = span(loss) / (loss.shape[axis] - 1) / 2
        difference = np.diff(lines_along(loss, axis), axis=1)
        walks = np.pad(np.where(np.abs(difference) > small, difference, 0.0).cumsum(axis=1), ((0, 0), (1, 0)))
        turned += count_turns(walks, np.nextafter(floor, np.inf))
    tries = steps(loss)
    return turned / tries if tries else math.nan


def steps(loss: Values) -> int:
    """Count the pairs of neighbours along axes that both have a loss."""
    return sum(int(np.isfinite(np.diff(loss, axis=axis)).sum()) for axis in range(loss.ndim))


def count_turns(lines: Values, depth: float) -> int:
    """Count how often lines, shape (line, sample), turn back by `depth` or more; NaN samples are skipped."""
    high, low = np.full(len(lines), -np.inf), np.full(len(lines), np.inf)
    way, turned = np.zeros(len(lines), int), 0  # 0 while a line has gone nowhere
    for at in lines.T:
        high, low = np.fmax(high, at), np.fmin(low, at)
        with np.errstate(invalid="ignore"):
            down, up = (way >= 0) & (high - at >= depth), (way <= 0) & (at - low >= depth)
        turned += int((way[down | up] != 0).sum())
        way = np.where(down, -1, np.where(up, 1, way))
        high, low = np.where(up | down, at, high), np.where(up | down, at, low)
    return turned


def dispersion(loss: Values) -> float:
    """Return the distance among the best 5 % of the samples, relative to all: 1 scattered, 0 together.

    Lunacek & Whitley 2006, GECCO, as a ratio of mean distances.
    """
    places, losses = np.argwhere(np.isfinite(loss)), loss[np.isfinite(loss)]
    if len(losses) <= 2:
        return math.nan
    best = places[np.argsort(losses, kind="stable")[: max(2, round(BEST_SHARE * len(losses)))]]
    return mean_distance(best, loss.shape) / mean_distance(places, loss.shape)


def mean_distance(places: NDArray[np.intp], shape: tuple[int, ...]) -> float:
    """Return the mean distance of all pairs of samples of a slice of this shape, shape (count, rank).

    There can be more pairs than fit in memory, but there are few different steps between samples. The number of pairs
    for each step is the autocorrelation of the positions, by the Fourier transform, rounded to integers.
    """
    from scipy import fft
    from scipy.spatial.distance import pdist

    if len(places) <= PAIRED:
        return float(pdist(places / _sides(shape)).mean())
    there = np.zeros(shape)
    there[tuple(places.T)] = 1.0
    padded = [fft.next_fast_len(2 * points - 1, real=True) for points in shape]  # so that no end meets the other
    pairs = np.rint(fft.irfftn(np.abs(fft.rfftn(there, padded)) ** 2, padded))
    steps = [np.minimum(np.arange(size), size - np.arange(size)) for size in padded]
    squares = np.ix_(*[(step / side) ** 2 for step, side in zip(steps, _sides(shape), strict=True)])
    return float((pairs * np.sqrt(sum(squares))).sum() / (len(places) * (len(places) - 1)))


def fitness_distance(loss: Values) -> float:
    """Return the correlation of losses with the distance to the lowest sample (Jones & Forrest 1995)."""
    places, losses = np.argwhere(np.isfinite(loss)) / _sides(loss.shape), loss[np.isfinite(loss)]
    if len(losses) < 3 or losses.min() == losses.max():
        return math.nan
    return float(np.corrcoef(losses, np.linalg.norm(places - places[losses.argmin()], axis=1))[0, 1])


@dataclass(frozen=True)
class Ruggedness:
    """The measures of a slice's losses; `floor` [loss unit] is the range that noise or numerics alone would give.

    `minima` counts those deeper than the floor, `minima_halved` those in every second sample; `curve` counts by depths
    in fractions of the range. `zero` and `flat` are shares of samples whose gradient along the plane is exactly and
    effectively zero. `missing` is the share of samples with a loss but without the requested gradient. `level` is the
    share of samples that differ from their neighbours by no more than the noise floor.
    """

    samples: int
    failed: int
    range: float
    floor: float
    minima: int
    minima_halved: tuple[int, int]
    notable: int
    curve: dict[str, int]
    largest_basin: float
    lowest_basin: float
    zero: Estimate | None
    flat: Estimate | None
    missing: Estimate | None
    level: Estimate
    correlation_length: tuple[Estimate, ...]
    holder: tuple[Estimate, ...]
    total_variation: tuple[Estimate, ...]
    information: Estimate
    settling: Estimate
    turns: Estimate
    dispersion: Estimate
    fitness_distance: Estimate


def ruggedness(
    dataset: xr.Dataset,
    *,
    floor: float,
    noise: float | None = None,
    estimate: Callable[..., Estimate] = jackknife,
) -> Ruggedness:
    """Measure the ruggedness of a slice; `estimate` returns a statistic of samples with its interval.

    `noise` [loss unit] is the floor of repeats, by default `floor`. It decides which neighbours are level: their
    numerics are the same, so their difference is a slope, at any resolution.
    """
    loss = losses_of(dataset)
    whole, found = span(loss), minima(loss)
    notable = found.sample[found.depth > max(floor, NOTABLE * whole)]
    shares = basins(loss, notable) if len(notable) else np.full(1, math.nan)
    slopes = box_slopes(dataset) if "grad" in dataset else None

    def share_of(statistic: Callable[[Values], float], samples: Values, tries: int) -> Estimate:
        return exact_share(estimate(statistic, samples), tries)

    def mean_of(flags: Values) -> Estimate:
        return share_of(known_mean, flags, int(np.isfinite(flags).sum()))

    def along_axes(measure: Callable[[Values, int], float], **bounds: float) -> tuple[Estimate, ...]:
        axes = range(loss.ndim)[::-1]  # u first
        return tuple(estimate(lambda part, axis=axis: measure(part, axis), loss, **bounds) for axis in axes)

    return Ruggedness(
        samples=loss.size,
        failed=int((~np.isfinite(loss)).sum()),
        range=whole,
        floor=floor,
        minima=found.count(floor),
        minima_halved=minima_of_halves(loss, floor),
        notable=len(notable),
        curve={f"{part:g}": found.count(max(floor, part * whole)) for part in THRESHOLDS},
        largest_basin=float(shares.max()),
        lowest_basin=float(shares[0]),
        zero=None if slopes is None else mean_of(_below(slopes, 0.0)),
        flat=None if slopes is None else mean_of(_below(slopes, FLAT_SLOPE * whole)),
        missing=missing_gradients(dataset),
        level=mean_of(level_samples(loss, floor if noise is None else noise)),
        correlation_length=along_axes(correlation_length, least=0.0, most=1.0),
        holder=along_axes(partial(holder_exponent, floor=floor), least=0.0),
        total_variation=along_axes(total_variation, least=1.0),
        information=estimate(lambda part: information_content(part)[0], loss, least=0.0, most=1.0),
        settling=estimate(lambda part: information_content(part)[1], loss),
        turns=share_of(partial(turns, floor=floor), loss, steps(loss)),
        dispersion=estimate(dispersion, loss, least=0.0),
        fitness_distance=estimate(fitness_distance, loss, least=-1.0, most=1.0),
    )


def missing_gradients(dataset: xr.Dataset) -> Estimate | None:
    """Return the share of samples without a gradient among those with a loss that requested one, None for none."""
    if "grad" not in dataset or "status" not in dataset:
        return None
    lacking = int((dataset["status"] == Status.NO_GRADIENT).sum())
    having = int(np.isfinite(dataset["grad"].to_numpy()).all(axis=-1).sum())
    return share(lacking, lacking + having) if lacking + having else None


def box_slopes(dataset: xr.Dataset) -> Values:
    """Return the derivatives along the plane's axes, axis last [loss unit per side of the box]."""
    plane = plane_of(dataset)
    grad = dataset["grad"].transpose("v", "u", "dim", missing_dims="ignore").to_numpy()
    slopes: Values = (plane.slope(torch.from_numpy(grad)) * (plane.upper - plane.lower)).numpy()
    return slopes


def _below(slopes: Values, size: float) -> Values:
    length = np.linalg.norm(slopes, axis=-1)
    return np.where(np.isfinite(length), (length <= size).astype(float), np.nan)


def step_slopes(dataset: xr.Dataset) -> Values:
    """Return the derivatives along the axes of the array, axis last [loss unit per step between samples]."""
    slopes: Values = (box_slopes(dataset) / (np.array(plane_of(dataset).resolution) - 1))[..., ::-1]
    return slopes


def losses_of(dataset: xr.Dataset) -> Values:
    """Return the losses of a slice, shape (u,) or (v, u)."""
    return dataset["loss"].transpose("v", "u", missing_dims="ignore").to_numpy().astype(float, copy=False)


def lines_along(values: Values, axis: int, rank: int | None = None) -> Values:
    """Return values of samples as lines along an axis, by default all: shape (line, sample, ...)."""
    last = (rank or values.ndim) - 1
    moved = np.moveaxis(values, axis, last)
    return moved.reshape(-1, *moved.shape[last:])


def known_mean(values: Values) -> float:
    """Return the mean of values, without NaN."""
    with warnings.catch_warnings():  # of nothing at all it is NaN
        warnings.simplefilter("ignore", RuntimeWarning)
        return float(np.nanmean(values))


def _sides(shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the number of steps between samples along each side of the box."""
    return np.array([max(points - 1, 1) for points in shape])
