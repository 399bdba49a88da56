"""Gradients that are right for the program but wrong for the physics: the time step changes them, but not slopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np
import torch
from numpy.typing import NDArray

from ..objective import Objective
from .evidence import Evidence
from .examination import Examination
from .probe import Lines, Probe
from .slopes import Kind, Ladder

LINES = 12  # along which time steps are compared, at most
FEWEST_LINES = 5
STEPS = (1e-2, 3e-2)  # of the box: slopes of the motion itself, which single steps of time do not change
STABLE = 0.2  # relative difference of slopes over both, where the motion has one


def compare_time_steps(seen: Examination, finer: Mapping[float, Callable[[], Objective]]) -> Evidence:
    """Compare gradients at the time step, half and a quarter of it with differences at the finest.

    Returns `physics`, the median relative difference of gradients and these slopes; the same for gradients at the other
    steps, as `at_2` and `at_4`; and `ratio`, the median of gradients over slopes. Empty where slopes over one and three
    hundredths of the box differ, where time steps are refused, or where too few lines remain.
    """
    rows = seen.rows(Kind.AGREES, Kind.KINK)[:LINES]
    if len(rows) < FEWEST_LINES or not finer:
        return {}
    lines = seen.random.lines.rows(torch.tensor(rows))
    slopes: dict[float, NDArray[np.float64]] = {1.0: lines.slope.numpy()}
    with suppress(ValueError):  # a time step is refused
        for factor, make in sorted(finer.items()):
            probe = Probe(made := make(), made.precision)
            found = probe.gradient(lines.u)
            along = Lines.through(probe, lines.u, lines.direction, torch.arange(len(rows)), found)
            slopes[factor] = along.slope.numpy()
        near, far = Ladder(along, STEPS, along.walk(probe, list(STEPS)), ()).differences.numpy()
        return _compare(slopes, near, far)
    return {}


def _compare(
    slopes: Mapping[float, NDArray[np.float64]], near: NDArray[np.float64], far: NDArray[np.float64]
) -> Evidence:
    with np.errstate(invalid="ignore", divide="ignore"):
        stable = np.abs(near - far) <= STABLE * np.maximum(np.abs(near), np.abs(far))
        known = stable & (near != 0) & np.all([np.isfinite(one) for one in slopes.values()], axis=0)
        if known.sum() < FEWEST_LINES:
            return {}
        off = {factor: _off(one[known], near[known]) for factor, one in slopes.items()}
        ratio = float(np.median(slopes[1.0][known] / near[known]))
    found = {f"at_{factor:g}": value for factor, value in off.items() if factor != 1}
    return {"physics": off[1.0], "ratio": ratio, "lines": float(known.sum()), **found}


def _off(slope: NDArray[np.float64], wanted: NDArray[np.float64]) -> float:
    return float(np.median(np.abs(slope - wanted) / np.maximum(np.abs(slope), np.abs(wanted))))
