"""Numbers that distinguish the causes of wrong gradients; `causes` compares them with the signatures in its files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..space import ParameterSpace
from .probe import Probe
from .slopes import Judgement, Kind, Ladder

STEADY = 0.02  # of a ratio is what others may be off by, to be the same
MATCHES = 0.02  # of the largest component is what permuted gradients may be off by
SATURATED = 1e-4  # relative difference of components that are cut off at the same length
NEAR = (1e-9, 1e-4)  # of the box: how far apart points are that gradients are compared at, in float64 and float32
NO_SLOPE = (Kind.FLAT, Kind.ZERO)  # lines whose slope is 0
TRIED = 32  # steps that are tried for the difference which a gradient may be
STEPS_TRIED = (1e-4, 0.3)  # of the box,
COMMON_STEPS = (0.2, 0.1, 0.05, 0.02, 0.01, 5e-3, 2e-3, 1e-3, 1e-4)
CROSSINGS = 4  # of which so many, at most, that fit are tried at other components
FIRST_TRIED, OTHERS, HELD = 3, 6, 0.8  # components that it is found at, and others, of which a share has to agree
SAME_DIFFERENCE = 1e-3  # relative error of a difference that a gradient is
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Samples:
    """Components of gradients, and slopes by differences [loss unit per side of the box]: an entry per axis line."""

    exact: Array
    slope: Array
    error: Array
    axis: NDArray[np.int64]
    point: NDArray[np.int64]

    @classmethod
    def of(cls, axes: Ladder, *, wrong: bool) -> Samples:
        """Return the lines with a known slope by differences, or only those with wrong gradients."""
        rows = [
            row
            for row, one in enumerate(axes.judged)
            if (one.slope is not None or one.kind in NO_SLOPE) and (not wrong or one.kind == Kind.WRONG)
        ]
        judged = [axes.judged[row] for row in rows]
        found = [(one.exact, *((one.slope.value, one.slope.error) if one.slope else (0.0, 0.0))) for one in judged]
        numbers = np.array(found).reshape(-1, 3)
        index = torch.tensor(rows, dtype=torch.long)
        axis, point = axes.axis[index], axes.lines.point[index]
        along = axes.lines.direction[index, axis].numpy()  # ahead or back, whichever leads into the box
        exact, slope, error = numbers.T
        return cls(exact * along, slope * along, error, axis.numpy(), point.numpy())

    def __len__(self) -> int:
        return len(self.exact)

    def matrix(self, dim: int) -> tuple[Array, Array]:
        """Return gradients and slopes, shape (point, dim), of the points where every component is known."""
        exact, slope = [], []
        for point in np.unique(self.point):
            rows = np.flatnonzero(self.point == point)
            at = {int(self.axis[row]): row for row in rows}
            if len(at) == dim:
                order = [at[axis] for axis in range(dim)]
                exact.append(self.exact[order])
                slope.append(self.slope[order])
        shape = (len(exact), dim)
        return np.array(exact).reshape(shape), np.array(slope).reshape(shape)


Evidence = dict[str, float]


def ratios(exact: Array, slope: Array, error: Array) -> Evidence:
    """Return features of the ratios of gradients to slopes: `ratio`, `steady`, `zero`, `near`, `below`."""
    clear = np.abs(slope) > 5 * error
    if not clear.any():
        return {}
    found = exact[clear] / slope[clear]
    room = np.maximum(STEADY, 3 * error[clear] / np.abs(slope[clear]))
    ratio = _mode(found, room)
    return {
        "ratio": ratio,
        "steady": float((np.abs(found - ratio) <= room * max(abs(ratio), 0.1)).mean()),
        "zero": float((exact == 0).mean()),
        "near": float(np.median(np.abs(found - 1))),
        "below": float(((found > -STEADY) & (found < 1)).mean()),
        "clear": float(clear.sum()),
    }


def _mode(found: Array, room: Array) -> float:
    """Return the ratio closest to the most others."""
    support = [int((np.abs(found - one) <= room * max(abs(one), 0.1)).sum()) for one in found]
    best = found[int(np.argmax(support))]
    near = np.abs(found - best) <= room * max(abs(best), 0.1)
    return float(np.median(found[near]))


def per_parameter(samples: Samples, space: ParameterSpace) -> Evidence:
    """Return whether each parameter has its own constant ratio (`own`), equal to its range or one over it (`units`)."""
    clear = np.abs(samples.slope) > 5 * samples.error
    width = (space.upper - space.lower).numpy()
    own, units = [], []
    for axis in np.unique(samples.axis[clear]):
        rows = clear & (samples.axis == axis)
        found = samples.exact[rows] / samples.slope[rows]
        middle = float(np.median(found))
        own.append(float((np.abs(found - middle) <= STEADY * max(abs(middle), 1e-12)).mean()))
        spans = (width[axis], 1 / width[axis])
        units.append([abs(middle / span - 1) <= STEADY for span in spans])
    if not own:
        return {}
    different = float(np.abs(np.log(width[np.unique(samples.axis[clear])])).max())
    return {
        "own": float(np.mean(own)),
        "units": float(np.mean(units, axis=0).max()) if different > STEADY else 0.0,
    }


def exchanged(exact: Array, slope: Array) -> Evidence:
    """Return whether components are exchanged: `permuted`, and `transposed` where as in a matrix.

    `exact` and `slope` have shape (point, dim), with at least two points.
    """
    from scipy.optimize import linear_sum_assignment

    dim = exact.shape[1]
    known = np.isfinite(exact).all(axis=1) & np.abs(slope).any(axis=1)
    exact, slope = exact[known], slope[known]
    count = len(exact)
    if count < 2 or dim < 2:
        return {}
    scale = np.abs(slope).max(axis=1, keepdims=True)
    cost = np.abs(exact[:, :, None] - slope[:, None, :]).__truediv__(scale[:, :, None]).mean(axis=0)
    rows, columns = linear_sum_assignment(cost)
    fits = float((cost[rows, columns] <= MATCHES).mean())
    moved = float((columns != rows).mean())
    transposed = 0.0
    for side in range(2, dim // 2 + 1):
        if dim % side == 0:
            order = np.arange(dim).reshape(side, dim // side).T.ravel()
            back = np.argsort(order)
            for one in (order, back):
                off = cost[np.arange(dim), one]
                if (one != np.arange(dim)).any() and (off <= MATCHES).all():
                    transposed = 1.0
    return {"permuted": fits if moved > 0 else 0.0, "moved": moved, "transposed": transposed}


def cut_off(probe: Probe, samples: Samples, others: Samples) -> Evidence:
    """Return the share of wrong components with the same length in the parameters' units, the largest there is."""
    width = probe.width.numpy()
    wrong = np.abs(samples.exact) / width[samples.axis]
    if len(wrong) < 3:
        return {}
    longest = float(wrong.max())
    same = np.abs(wrong - longest) <= SATURATED * longest
    steeper = np.abs(samples.slope) / width[samples.axis] > longest * (1 - SATURATED)
    right = np.abs(others.exact) / width[others.axis]
    beyond = bool(len(right)) and bool((right > longest * (1 + SATURATED)).any())
    return {"saturated": 0.0 if beyond else float((same & steeper).mean()), "length": longest}


def same_length(grad: Float[Tensor, "point dim"]) -> Evidence:
    """Return the share of gradients with the length of the longest, in the parameters' units."""
    sizes = grad.norm(dim=1)
    sizes = sizes[sizes.isfinite() & (sizes > 0)]
    if len(sizes) < 3:
        return {}
    longest = sizes.max()
    return {"norm_saturated": float(((sizes - longest).abs() <= SATURATED * longest).double().mean())}


def cosine(exact: Array, slope: Array) -> Evidence:
    """Return the median cosine of gradients and slopes, shape (point, dim), and the median ratio of their lengths."""
    if not len(exact):
        return {}
    sizes = np.linalg.norm(exact, axis=1), np.linalg.norm(slope, axis=1)
    known = (sizes[0] > 0) & (sizes[1] > 0)
    if not known.any():
        return {}
    angle = (exact * slope).sum(axis=1)[known] / (sizes[0] * sizes[1])[known]
    return {"cosine": float(np.median(angle)), "length_ratio": float(np.median((sizes[0] / sizes[1])[known]))}


@dataclass(frozen=True, eq=False)
class _AxisSlope:
    """A component of a gradient at a point: its value, and differences along its axis."""

    probe: Probe
    u: Float[Tensor, " dim"]
    axis: int
    exact: float

    def difference(self, step: float, side: int) -> float:
        """Return a central difference, or with `side` 1 and 2 one ahead and one behind; NaN outside the box."""
        offset = torch.zeros_like(self.u)
        offset[self.axis] = step
        ahead, here, behind = self.probe.loss(torch.stack([self.u + offset, self.u, self.u - offset])).tolist()
        return float([(ahead - behind) / (2 * step), (ahead - here) / step, (here - behind) / step][side])

    def agrees(self, step: float, side: int) -> bool | None:
        """Return whether the component is the difference over a step; None where that leads outside the box."""
        found = self.difference(step, side)
        if not np.isfinite(found):
            return None
        return abs(found - self.exact) <= SAME_DIFFERENCE * max(abs(self.exact), abs(found))

    def matching_steps(self, side: int, width: float) -> list[float]:
        """Return steps whose difference equals the component; `width` is the parameter's range.

        Common choices come first, as fractions of the box and in the parameter's unit: for an oscillating loss, many
        other steps fit by chance.
        """
        common = [step for one in COMMON_STEPS for step in (one, one / width) if step <= STEPS_TRIED[1]]
        steps = np.geomspace(*STEPS_TRIED, TRIED)
        gaps = np.array([self.difference(step, side) - self.exact for step in steps])
        with np.errstate(invalid="ignore"):
            changes = np.flatnonzero(gaps[:-1] * gaps[1:] <= 0)
        found = [self._halve(float(steps[one]), float(steps[one + 1]), gaps[one], side) for one in changes[:CROSSINGS]]
        return [step for step in common if self.agrees(step, side)] + found

    def _halve(self, low: float, high: float, start: float, side: int) -> float:
        for _ in range(TRIED):
            middle = (low * high) ** 0.5
            gap = self.difference(middle, side) - self.exact
            low, high = (middle, high) if gap * start > 0 else (low, middle)
        return float((low * high) ** 0.5)


def as_difference(probe: Probe, axes: Ladder, rows: Sequence[int]) -> Evidence:
    """Find the step of the finite difference behind a gradient: `difference_step`, as a fraction of the box.

    The step is found at one component by trying many. It has to fit at others, as a fraction of the box or in the
    parameters' own units.
    """
    lines, width = axes.lines, probe.width
    slopes = [
        _AxisSlope(probe, lines.u[row], axis := int(axes.axis[row]), float(lines.grad[row, axis])) for row in rows
    ]
    for one in slopes[:FIRST_TRIED]:
        others = [other for other in slopes if other is not one][:OTHERS]
        for side in (0, 1, 2):
            for step in one.matching_steps(side, float(width[one.axis])):
                for own in (torch.ones_like(width), width[one.axis] / width):
                    tried = [other.agrees(step * float(own[other.axis]), side) for other in others]
                    held = [one for one in tried if one is not None]
                    if len(held) > 1 and np.mean(held) >= HELD:
                        return {"difference_step": step, "one_sided": float(side > 0)}
    return {}


def roughness(probe: Probe, u: Float[Tensor, "point dim"]) -> Evidence:
    """Return the relative difference of gradients at adjacent points: `rough`."""
    apart = NEAR[probe.single]
    near = (u + apart * torch.where(u > 0.5, -1.0, 1.0)).clamp(0, 1)
    here, there = (probe.gradient(one).grad for one in (u, near))
    if here is None or there is None:
        return {}
    sizes = torch.maximum(here.norm(dim=1), there.norm(dim=1))
    known = sizes.isfinite() & (sizes > 0)
    apart = ((here - there).norm(dim=1) / sizes)[known]
    return {"rough": float(apart.quantile(0.5))} if len(apart) else {}


def of_lines(judged: Sequence[Judgement]) -> Evidence:
    """Return the ratios of lines along all parameters at once."""
    known = [one for one in judged if one.kind == Kind.WRONG and one.slope is not None]
    if not known:
        return {}
    numbers = np.array([(one.exact, one.slope.value, one.slope.error) for one in known if one.slope is not None])
    return ratios(*numbers.T)
