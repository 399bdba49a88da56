"""The verdict on a slice at twice its resolution, estimated from a random tenth of its cells.

The cells are drawn in blocks, two along each axis, which are sampled again, half a step apart. What can be measured
within a block is measured there twice, of all samples and of the slice's own alone. The mean of the difference is added
to what the whole slice shows (a difference estimator), with Student's interval. A turn is seen there where two
successive steps turn back. Gradients are taken of a block's inner samples alone: those on its border have no difference
across to be compared with. How many minima and jumps there are is no such measure: what is known of these stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..identity import plane_of
from ..lattice import has_all_gradients, lift_between
from ..objective import Objective, evaluate
from ..statistics import Estimate, Values, mean
from .classify import judge, likeness
from .discontinuities import Jumps
from .gradient_quality import agreement
from .noise import noise_floor
from .ruggedness import FLAT_SLOPE, Ruggedness, box_slopes

PART = 0.1  # of the cells
SIDE = 5  # samples along a block's side at twice the resolution: two cells
LOCAL = ("turns", "level", "flat", "cosine", "uphill")
LOWEST = {"cosine": -1.0}  # of a measure; the others are shares


@dataclass(frozen=True)
class DoubledResolution:
    """Hold the local measures of a slice as they would be at twice its resolution, and which words would change.

    A word would `appear` or `go` only where the whole interval of a measure is on the other side of its threshold.
    """

    blocks: int
    episodes: int
    measures: dict[str, Estimate]
    appear: tuple[str, ...]
    go: tuple[str, ...]


def doubling_episodes(shape: Sequence[int]) -> tuple[int, int]:
    """Return how many losses and how many gradients, at most, are evaluated for a slice of such a shape."""
    inner, border = _places(len(shape), every=True)
    return _drawn(shape) * len(border), _drawn(shape) * len(inner)


def double_resolution(
    objective: Objective,
    dataset: xr.Dataset,
    found: Ruggedness,
    jumps: Jumps | None,
    cosine: Values,
    *,
    deviation: float,
    seed: int = 0,
) -> DoubledResolution | None:
    """Measure blocks of a slice at twice its resolution; None where there are none of samples that did not fail.

    `found`, `jumps` and `cosine` are what its words are from, `deviation` [loss unit] is that of the losses' noise.
    """
    loss = dataset["loss"].transpose("v", "u", missing_dims="ignore").to_numpy()
    blocks = [
        block
        for block in np.argwhere(np.ones([(points - 1) // 2 for points in loss.shape])) * 2
        if np.isfinite(loss[_part(block, 3)]).all()
    ]
    chosen = np.random.default_rng(seed).permutation(len(blocks))[: _drawn(loss.shape)]
    if len(chosen) < 2:
        return None
    drawn = np.array([blocks[at] for at in np.sort(chosen)])
    losses, slopes, episodes = _sample(objective, dataset, loss, drawn)
    steps = np.array(loss.shape) - 1
    noise = float(np.nan_to_num(noise_floor(deviation, found.samples)))
    rules = partial(_measure, floor=found.floor, noise=noise, whole=found.range, deviation=deviation)
    own = tuple([slice(None), *[slice(None, None, 2)] * loss.ndim])
    now = [rules(*block, steps) for block in zip(losses[own], slopes[own], strict=True)]
    then = [rules(*block, 2 * steps) for block in zip(losses, slopes, strict=True)]
    average, uphill = likeness(cosine)
    flat = found.flat.value if found.flat is not None else np.nan
    whole = {
        "turns": found.turns.value,
        "level": found.level.value,
        "flat": flat,
        "cosine": average,
        "uphill": uphill,
    }
    estimates = {}
    for at, name in enumerate(LOCAL):
        estimates[name] = _moved(whole[name], np.array(then)[:, at] - np.array(now)[:, at], LOWEST.get(name, 0.0))
    appear, go = _changes(found, jumps, whole, estimates)
    return DoubledResolution(len(drawn), episodes, estimates, appear, go)


def _drawn(shape: Sequence[int]) -> int:
    blocks: float = math.prod(points - 1 for points in shape) / 2 ** len(shape)
    return math.ceil(PART * blocks)


def _part(block: NDArray[np.intp], side: int) -> tuple[slice, ...]:
    return tuple(slice(at, at + side) for at in block.tolist())


def _sample(
    objective: Objective, dataset: xr.Dataset, loss: Values, drawn: NDArray[np.intp]
) -> tuple[Values, Values, int]:
    """Return the losses of blocks at twice the resolution and their slopes per side of the box, axes as the array's."""
    plane, rank = plane_of(dataset), loss.ndim
    slope = box_slopes(dataset)[..., ::-1]
    losses = np.full((len(drawn), *[SIDE] * rank), np.nan)
    slopes = np.full((*losses.shape, rank), np.nan)
    own = tuple([slice(None, None, 2)] * rank)
    for number, block in enumerate(drawn):
        losses[number][own], slopes[number][own] = loss[_part(block, 3)], slope[_part(block, 3)]
    sides, episodes = (plane.upper - plane.lower).numpy(), 0
    for new, grad in zip(_places(rank, every=not has_all_gradients(dataset)), (True, False), strict=True):
        places = (drawn[:, None, :] + new / 2).reshape(-1, rank)
        answer = evaluate(objective, lift_between(plane, places), grad=grad)
        at, episodes = tuple([slice(None), *new.T]), episodes + len(places)
        losses[at] = answer.loss.numpy().reshape(len(drawn), -1)
        if answer.grad is not None:
            slopes[at] = (plane.slope(answer.grad).numpy() * sides)[:, ::-1].reshape(len(drawn), -1, rank)
    return losses, slopes, episodes


def _places(rank: int, *, every: bool) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the places of a block, in half steps, of new gradients and of new losses alone.

    Gradients are within it, at `every` place there or only at those that are not the slice's own; losses on its border.
    """
    at = np.indices([SIDE] * rank)
    new, inner = (at % 2).any(axis=0), ((at > 0) & (at < SIDE - 1)).all(axis=0)
    return np.argwhere(inner & (new | every)), np.argwhere(~inner & new)


def _measure(
    loss: Values,
    slope: Values,
    steps: NDArray[np.intp],
    *,
    floor: float,
    noise: float,
    whole: float,
    deviation: float,
) -> list[float]:
    """Return the measures `LOCAL` of a block whose samples are one of so many steps of the slice apart."""
    inner = tuple([slice(1, -1)] * loss.ndim)
    rises, turned = list[Values](), list[Values]()
    for axis in range(loss.ndim):
        difference = np.diff(loss, axis=axis)
        sign = np.sign(np.where(np.abs(difference) > max(floor, whole / steps[axis] / 2), difference, 0.0))
        before, after = (np.take(sign, range(start, start + loss.shape[axis] - 2), axis) for start in (0, 1))
        turned.append((before * after < 0).ravel())
        central = np.take(loss, range(2, loss.shape[axis]), axis) - np.take(loss, range(loss.shape[axis] - 2), axis)
        across = tuple(slice(None) if other == axis else slice(1, -1) for other in range(loss.ndim))
        rises.append(central[across] * steps[axis] / 2)
    apart = [np.abs(loss[inner] - loss[_shifted(loss.ndim, axis, way)]) for axis in range(loss.ndim) for way in (-1, 1)]
    cosine = agreement(slope[inner], np.stack(rises, axis=-1), math.sqrt(2) * deviation * float(steps.max()) / 2)[
        "cosine"
    ]
    average, uphill = likeness(cosine)
    level = float((np.max(apart, axis=0) <= noise).mean())
    sizes = np.linalg.norm(slope[inner], axis=-1)
    sizes = sizes[np.isfinite(sizes)]
    flat = float((sizes <= FLAT_SLOPE * whole).mean()) if sizes.size else math.nan
    return [float(np.concatenate(turned).mean()), level, flat, average, uphill]


def _shifted(rank: int, axis: int, way: int) -> tuple[slice, ...]:
    """Return the inner samples of a block moved by one along an axis."""
    moved = slice(2, None) if way > 0 else slice(None, -2)
    return tuple(moved if other == axis else slice(1, -1) for other in range(rank))


def _moved(value: float, differences: Values, least: float) -> Estimate:
    """Return a measure of the whole slice with the mean difference of its blocks added."""
    by = mean(differences)
    ends = [float(np.clip(value + one, least, 1.0)) for one in (by.value, by.low, by.high)]
    return Estimate(*ends)


def _changes(
    found: Ruggedness, jumps: Jumps | None, whole: dict[str, float], estimates: dict[str, Estimate]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the words that would appear, and those that would go."""
    now = judge(found, jumps, whole["cosine"], whole["uphill"]).words
    appear, go = set[str](), set[str]()
    for name, one in estimates.items():
        if np.isfinite([one.low, one.high]).all():
            ends = [set(_words(found, jumps, whole | {name: end})) for end in (one.low, one.high)]
            appear |= (ends[0] & ends[1]) - set(now)
            go |= set(now) - (ends[0] | ends[1])
    return tuple(sorted(appear)), tuple(sorted(go))


def _words(found: Ruggedness, jumps: Jumps | None, values: dict[str, float]) -> tuple[str, ...]:
    turns, level, flat = (Estimate(*[values[name]] * 3) for name in ("turns", "level", "flat"))
    changed = replace(found, turns=turns, level=level, flat=flat if found.flat is not None else None)
    return judge(changed, jumps, values["cosine"], values["uphill"]).words
