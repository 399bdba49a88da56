"""Pairs of parameters worth slicing: sensitivity, interaction, ruggedness and gradients, from shared samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..objective import Objective, evaluate
from ..plain import finite
from ..space import ParameterSpace, sobol
from .features import evaluate_parts

if TYPE_CHECKING:
    from ..storage.checkpoint import Checkpoint

STEP, LINE = 0.025, 5  # of a short line: distance of its points in widths of the box, how many they are
MAX_SAMPLES, MIN_SAMPLES, MAX_EPISODES = 16, 4, 2000  # base points by default; episodes up to which they are the most
CROSSED = 8  # the most sensitive parameters, whose pairs are varied together
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Design:
    """Points to evaluate: `base`, each with a short line and one far move along every parameter.

    Radial design (Campolongo et al. 2011): from each of `samples` base points every parameter is moved alone, to its
    value in a second point. All coordinates in widths of the box; `base`, `far`, shape (sample, dim).
    """

    space: ParameterSpace
    base: Array
    far: Array

    @classmethod
    def sobol(cls, space: ParameterSpace, samples: int, *, seed: int) -> Design:
        """Return the design with this many base points."""
        both = sobol(samples, 2 * space.dim, seed=seed).numpy()
        return cls(space, both[:, : space.dim], both[:, space.dim :])

    @property
    def episodes(self) -> int:
        """Count the episodes: samples x (1 + 5 dim + crossed pairs); one of each sample has a gradient."""
        crossed = min(self.space.dim, CROSSED)
        return len(self.base) * (1 + LINE * self.space.dim + crossed * (crossed - 1) // 2)

    @property
    def offsets(self) -> Array:
        """Offsets of the other points of each short line from the base point, shape (sample, dim, 4).

        Two on either side; near the border of the box the line is shifted inwards by whole steps.
        """
        half = LINE // 2
        below, above = (np.floor(room / STEP).astype(int) for room in (self.base, 1 - self.base))
        first = np.clip(np.full_like(below, -half), np.maximum(-below, -LINE + 1), above - LINE + 1)
        steps = first[..., None] + np.arange(LINE)
        others: Array = STEP * steps[steps != 0].reshape(*self.base.shape, LINE - 1)
        return others

    def move_one(self, rows: range) -> Float[Tensor, "point dim"]:
        """Return lines and far moves of some base points, shape (row * dim * 5, dim), in the parameters' units."""
        dim = self.space.dim
        points = np.tile(self.base[rows, None, None, :], (1, dim, LINE, 1))
        for axis in range(dim):
            points[:, axis, :-1, axis] += self.offsets[rows, axis]
            points[:, axis, -1, axis] = self.far[rows, axis]
        return self._native(points)

    def move_pairs(self, rows: range, pairs: list[tuple[int, int]]) -> Float[Tensor, "point dim"]:
        """Return base points with two parameters moved far, shape (row * pair, dim)."""
        points = np.tile(self.base[rows, None, :], (1, len(pairs), 1))
        for number, pair in enumerate(pairs):
            points[:, number, list(pair)] = self.far[rows][:, list(pair)]
        return self._native(points)

    def starts(self, rows: range) -> Float[Tensor, "point dim"]:
        """Return base points."""
        return self._native(self.base[rows])

    def _native(self, points: Array) -> Float[Tensor, "point dim"]:
        return self.space.from_unit(torch.from_numpy(np.asarray(points)).reshape(-1, self.space.dim))


@dataclass(frozen=True, eq=False)
class Responses:
    """Losses and gradients at a design's points; NaN where an episode failed.

    `loss`, shape (sample,); `grad` [loss unit / width of the box], shape (sample, dim); `line`, shape
    (sample, dim, 4), at `offsets` from there [width of the box]; `far`, shape (sample, dim); `cross`, shape
    (sample, pair), of the `pairs`.
    """

    loss: Array
    grad: Array
    line: Array
    offsets: Array
    far: Array
    cross: Array
    pairs: list[tuple[int, int]]

    @property
    def failed(self) -> int:
        """How many episodes failed."""
        return sum(int(np.isnan(losses).sum()) for losses in (self.loss, self.line, self.far, self.cross))

    @property
    def spread(self) -> float:
        """The standard deviation of losses over the box."""
        return float(np.nanstd(np.append(self.loss, self.far)))

    def total(self) -> Array:
        """Return total sensitivity indices, shape (dim,): half far moves' mean square by variance (Jansen 1999)."""
        return _mean(np.square(self.far - self.loss[:, None]), axis=0) / (2 * self.spread**2)

    def interaction(self) -> Array:
        """Return superset importances of `pairs` as shares of the variance (Liu & Owen 2006, eq. 10), shape (pair,).

        The contribution of all effects that involve both parameters; zero if the loss is a sum of functions of either.
        """
        first, second = (self.far[:, [pair[k] for pair in self.pairs]] for k in (0, 1))
        return _mean(np.square(self.loss[:, None] - first - second + self.cross), axis=0) / (4 * self.spread**2)

    def ruggedness(self) -> Array:
        """Return how much losses go up and down along a tenth of the box, in standard deviations, shape (dim,).

        Total variation of a short line beyond the difference of its ends; zero where it is monotone.
        """
        middle = np.broadcast_to(self.loss[:, None, None], (*self.far.shape, 1))
        along = np.argsort(np.concatenate([self.offsets, np.zeros((*self.far.shape, 1))], axis=2), axis=2)
        line = np.take_along_axis(np.concatenate([self.line, middle], axis=2), along, axis=2)
        excess = np.abs(np.diff(line, axis=2)).sum(axis=2) - np.abs(line[:, :, -1] - line[:, :, 0])
        return _mean(excess, axis=0) / self.spread

    def slopes(self) -> tuple[Array, Array]:
        """Return sums of |gradient - slope of the line| and of |gradient| + |slope|, by parameter, shapes (dim,).

        The slope is the central difference over a twentieth of the box [loss unit / width of the box]; base points too
        near the border are left out.
        """
        inner = np.abs(self.offsets.mean(axis=2)) < STEP / 8
        slope = np.where(inner, (self.line[:, :, 2] - self.line[:, :, 1]) / (2 * STEP), np.nan)
        return np.nansum(np.abs(self.grad - slope), axis=0), np.nansum(np.abs(self.grad) + np.abs(slope), axis=0)


def default_samples(dim: int) -> int:
    """Return the default number of base points in this dimension: 16, fewer for more than 20 parameters."""
    return max(MIN_SAMPLES, min(MAX_SAMPLES, MAX_EPISODES // (1 + LINE * dim + CROSSED * (CROSSED - 1) // 2)))


def explore(
    objective: Objective, design: Design, checkpoint: Checkpoint, *, follow: Callable[[int], None] = lambda done: None
) -> Responses:
    """Evaluate a design in parts; results already in `checkpoint` are not evaluated again.

    `follow` receives the number of finished episodes. Only pairs of the parameters with the largest total indices are
    crossed.
    """
    groups = list(_groups(objective, design))
    done = 0
    first = []
    for number, rows in enumerate(groups):
        moves = partial(_evaluate_moves, objective, design, rows)
        first.append(checkpoint.load_or_compute(f"moved-{number}", moves))
        follow(done := done + len(rows) * (1 + LINE * design.space.dim))
    loss, grad, line, far = (np.concatenate([part[name] for part in first]) for name in ("loss", "grad", "line", "far"))
    alone = Responses(loss, grad, line, design.offsets, far, np.empty((len(loss), 0)), [])
    sensitive = np.argsort(-alone.total(), kind="stable")[:CROSSED]
    pairs = list(combinations(sorted(int(axis) for axis in sensitive), 2))
    cross = []
    for number, rows in enumerate(groups):
        evaluate_pairs = partial(_evaluate_pairs, objective, design, rows, pairs)
        cross.append(checkpoint.load_or_compute(f"crossed-{number}", evaluate_pairs)["loss"])
        follow(done := done + len(rows) * len(pairs))
    return Responses(loss, grad, line, design.offsets, far, np.concatenate(cross), pairs)


@dataclass(frozen=True)
class Pair:
    """The reasons to slice a pair of parameters, given by their numbers `dims`; None where not measured.

    `sensitivity`: total index of the pair, the sum of both minus their `interaction` where that was measured. It is the
    share of the variance that a slice shows on average. `ruggedness`: sum of both. `disagreement`: |gradient - slope|
    by |gradient| + |slope|, summed over both, 0 where gradients equal the slope, 1 where they are zero or opposite.
    `score`: sensitivity x (1 + all others), where an interaction that was not measured counts as 0. Fields have the
    same names in files.
    """

    dims: tuple[int, int]
    score: float
    sensitivity: float | None
    interaction: float | None
    ruggedness: float | None
    disagreement: float | None


def rank(found: Responses) -> list[Pair]:
    """Return all pairs of parameters, those with the largest score first."""
    dim = found.far.shape[1]
    i, j = np.triu_indices(dim, 1)
    total, rugged, (apart, size) = found.total(), found.ruggedness(), found.slopes()
    crossed = dict(zip(found.pairs, found.interaction(), strict=True))
    interaction = np.array([crossed.get((int(a), int(b)), np.nan) for a, b in zip(i, j, strict=True)])
    weight = size[i] + size[j]
    sensitivity, rugged_pair = total[i] + total[j] - np.nan_to_num(interaction), rugged[i] + rugged[j]
    disagreement = np.divide(apart[i] + apart[j], weight, out=np.zeros(len(i)), where=weight > 0)
    score = sensitivity * (1 + np.nan_to_num(interaction) + rugged_pair + disagreement)
    columns = (sensitivity, interaction, rugged_pair, disagreement)
    return [
        Pair((int(i[k]), int(j[k])), float(score[k]), *(finite(float(values[k])) for values in columns))
        for k in np.argsort(-np.nan_to_num(score), kind="stable")
    ]


def _groups(objective: Objective, design: Design) -> list[range]:
    """Group base points so that the points moved from them fill a batch."""
    size = -(-objective.preferred_batch // (LINE * design.space.dim))
    edges = [*range(0, len(design.base), size), len(design.base)]
    return [range(low, high) for low, high in pairwise(edges)]


def _evaluate_moves(objective: Objective, design: Design, rows: range) -> dict[str, Array]:
    start = evaluate(objective, design.starts(rows), grad=True)
    widths = design.space.upper - design.space.lower
    grad = start.grad * widths if start.grad is not None else torch.empty(0)
    moves = evaluate_parts(objective, design.move_one(rows), grad=False)
    moved = moves.loss.numpy().reshape(len(rows), design.space.dim, -1)
    return {"loss": start.loss.numpy(), "grad": grad.numpy(), "line": moved[:, :, :-1], "far": moved[:, :, -1]}


def _evaluate_pairs(
    objective: Objective, design: Design, rows: range, pairs: list[tuple[int, int]]
) -> dict[str, Array]:
    found = evaluate_parts(objective, design.move_pairs(rows, pairs), grad=False)
    return {"loss": found.loss.numpy().reshape(len(rows), len(pairs))}


def _mean(values: Array, axis: int) -> Array:
    """Return the mean of known values, NaN for none."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        found: Array = np.where(known, values, 0.0).sum(axis) / known.sum(axis)
    return found
