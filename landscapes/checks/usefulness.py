"""The reach of a gradient: compared with loss changes over steps of many lengths, and with the smoothed gradient."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..statistics import Estimate, share
from .probe import Lines, Probe
from .slopes import Ladder

SHORTEST, LONGEST = 1e-6, 0.3  # of the box
OPTIMISER_STEPS = {  # first steps of our methods by a parameter, of the box; a test holds them against their options
    "Adam": 0.025,
    "gradient descent": 0.1,  # at most
    "CMA-ES": 0.25,
}
SMOOTHED = (1e-3, 1e-2, 1e-1)  # widths that the loss is smoothed over, as shares of the box
SMOOTHED_LINES = 24  # at which the smoothed gradient is computed
INNER = 3  # gradients along each
MEANS = 8  # from which something is said
UNKNOWN = Estimate(np.nan, np.nan, np.nan)
RESAMPLED = 200
CONFIDENT = (0.025, 0.975)
CLEAR = 10  # times the noise is what a change is, to have a sign


@dataclass(frozen=True)
class Usefulness:
    """The comparison of a gradient with the loss over one step, a fraction of the box.

    `sign` is the share of slopes with the right sign, `cosine` that of all slopes with differences over the step,
    `error` the median relative error, `compared` the number of changes above the noise. `bias` is the share of the
    slope of the smoothed loss that is missing in the mean of gradients within the width, NaN where not computed: a mean
    of gradients misses the contribution of jumps.
    """

    step: float
    compared: int
    sign: Estimate
    cosine: Estimate
    error: float
    bias: Estimate


def usefulness(probe: Probe, ladder: Ladder) -> tuple[Usefulness, ...]:
    """Return the curve, a record for each step of the ladder from 1e-6 to 0.3 of the box."""
    differences, exact = ladder.differences.numpy(), ladder.lines.slope.numpy()
    noise = np.array([one.noise for one in ladder.judged])
    curve = []
    for number, step in enumerate(ladder.steps):
        if not SHORTEST <= step <= LONGEST:
            continue
        slope = differences[number]
        with np.errstate(invalid="ignore"):
            clear = np.maximum(np.abs(slope), np.abs(exact)) * step > CLEAR * np.nan_to_num(noise)
        seen = np.isfinite(slope) & np.isfinite(exact) & clear
        if step in SMOOTHED or seen.sum() >= len(exact) / 4:
            curve.append(_at(probe, ladder.lines, step, slope, exact, seen))
    return tuple(curve)


def _at(
    probe: Probe,
    lines: Lines,
    step: float,
    slope: NDArray[np.float64],
    exact: NDArray[np.float64],
    seen: NDArray[np.bool_],
) -> Usefulness:
    a, d = exact[seen], slope[seen]
    bias = _bias(probe, lines, step, slope, seen) if step in SMOOTHED else UNKNOWN
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.abs(a - d) / np.maximum(np.abs(a), np.abs(d))
    right = share(int((np.sign(a) == np.sign(d)).sum()), len(a))
    middle = float(np.nanmedian(error)) if len(error) else np.nan
    return Usefulness(step, len(a), right, _cosine(a, d), middle, bias)


def _cosine(a: NDArray[np.float64], d: NDArray[np.float64]) -> Estimate:
    """Return the cosine of gradients' slopes with differences over all lines, with its interval."""
    if len(a) < 2 or not (a.any() and d.any()):
        return UNKNOWN
    return _resampled(
        lambda a, d: float(a @ d / size) if (size := np.linalg.norm(a) * np.linalg.norm(d)) else np.nan, a, d
    )


def _resampled(
    of: Callable[[NDArray[np.float64], NDArray[np.float64]], float], *values: NDArray[np.float64]
) -> Estimate:
    """Return a number of values over lines, with its interval by resampling lines."""
    lines = len(values[0])
    drawn = np.random.default_rng(0).integers(lines, size=(RESAMPLED, lines))
    with np.errstate(invalid="ignore", divide="ignore"):
        found = [of(*(one[rows] for one in values)) for rows in (np.arange(lines), *drawn)]
    low, high = np.nanquantile(found, CONFIDENT)
    return Estimate(float(found[0]), float(low), float(high))


def _bias(probe: Probe, lines: Lines, step: float, slope: NDArray[np.float64], seen: NDArray[np.bool_]) -> Estimate:
    """Compare the mean of gradients along each line with the slope of the loss over all of it."""
    rows = torch.from_numpy(np.flatnonzero(seen)[:SMOOTHED_LINES])
    if not len(rows):
        return UNKNOWN
    generator = torch.Generator().manual_seed(len(rows))
    at = (torch.rand(INNER, len(rows), generator=generator, dtype=torch.float64) + torch.arange(INNER)[:, None]) / INNER
    ahead, behind = (lines.u[rows] + side * step * lines.direction[rows] for side in (1, -1))
    reach = [((one >= 0) & (one <= 1)).all(dim=1).double()[None] for one in (ahead, behind)]
    offset = (at * (reach[0] + reach[1]) - reach[1]) * step  # of the part of the line that lies in the box
    points = lines.u[rows] + offset[..., None] * lines.direction[rows]
    found = probe.gradient(points.reshape(-1, points.shape[-1]).clamp(0, 1))
    if found.grad is None:
        return UNKNOWN
    slopes = (found.grad * probe.width).reshape(points.shape)
    mean = (slopes * lines.direction[rows]).sum(dim=2).mean(dim=0).numpy()
    wanted = slope[rows.numpy()]
    return _lacking(mean, wanted)


def _lacking(mean: NDArray[np.float64], wanted: NDArray[np.float64]) -> Estimate:
    """Return the missing share of the slope in means of gradients, with its interval."""
    known = np.isfinite(mean) & np.isfinite(wanted)
    mean, wanted = mean[known], wanted[known]
    if len(mean) < MEANS or not wanted.any():
        return UNKNOWN
    return _resampled(lambda mean, wanted: float(1 - (mean @ wanted) / (wanted @ wanted)), mean, wanted)
