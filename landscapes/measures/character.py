"""The character of a landscape from a few dozen evaluations over all its parameters: enough to choose a search."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Objective, evaluate
from ..space import sobol
from .exploratory import Array, Exploratory
from .features import UNDETERMINED, FeatureRow

STEPS = (0.001, 0.01, 0.1)  # down gradients: root mean square over the parameters, as shares of the box
MIN_EVALUATIONS = 20  # from which on something is said
GRADIENT_EVERY, REPEATED = 4, 2  # one evaluation in four is with gradient; so many losses are repeated
MIN_LOSSES = 8  # or pairs of points, from which on their features are measured
ROUNDING = 1e-12  # of losses: what differs by less is the same
EXPLORED = {  # features of `Exploratory`, as a character calls them
    "linear": "ela_meta.lin_simple_adj_r2",
    "quadratic": "ela_meta.quad_simple_adj_r2",
    "dispersion": "disp.ratio_mean_25",
    "information": "ic.h_max",
    "distance": "fitness_distance_all.fd_correlation",
    "skewness": "ela_distr.skewness",
}


@dataclass(frozen=True)
class Character:
    """Measures over all parameters, in sides of the box; NaN where the evaluations do not determine them.

    `failed` is the share of points without a loss, `flat` that of gradients that are zero or missing. `falls` is the
    share of points where a step of `STEPS` down the gradient lowers the loss. `agreement` is the actual decrease
    relative to the one that the gradient predicts (median, between -1 and 1). `across` is the correlation of loss
    differences between any two points with the prediction of their gradients, which is 1 for a parabola. `convex` is
    the share of pairs between which the gradient grows. `coherence` is the length of the mean of the gradients'
    directions, `steepest` the longest gradient over the median, in powers of ten. `noise` is the difference of repeated
    losses, as a share of their spread. The others are features of `Exploratory`.
    """

    parameters: int
    evaluations: int
    failed: float
    flat: float
    falls: tuple[float, ...]
    agreement: tuple[float, ...]
    across: float
    convex: float
    coherence: float
    steepest: float
    noise: float
    linear: float
    quadratic: float
    dispersion: float
    information: float
    distance: float
    skewness: float

    def rows(self) -> list[FeatureRow]:
        """Return the measures in words."""
        steps = ", ".join(f"{step:.1%}" for step in STEPS)
        return [
            FeatureRow("Points without a loss", _percent(self.failed), ""),
            FeatureRow("Gradients that are zero or missing", _percent(self.flat), "of those at points with a loss"),
            FeatureRow("Steps down a gradient that lower the loss", _several(_percent, self.falls), f"by {steps}"),
            FeatureRow(
                "Decrease, of the gradient's prediction", _several(_percent, self.agreement), "by the same steps"
            ),
            FeatureRow("Loss differences explained by gradients", _number(self.across), "correlation; 1: a parabola"),
            FeatureRow("Pairs of points with upward curvature", _percent(self.convex), "100 %: convex"),
            FeatureRow("Gradients point one way", _number(self.coherence), "length of their mean direction"),
            FeatureRow("Steepest over median gradient", _number(self.steepest), "powers of ten"),
            FeatureRow("Noise", _percent(self.noise), "of repeated losses, relative to their spread"),
            FeatureRow(
                "Explained by a linear, a quadratic model", _several(_percent, (self.linear, self.quadratic)), "R2"
            ),
            FeatureRow("Dispersion of the best quarter", _number(self.dispersion), "1 scattered, 0 together"),
            FeatureRow("Information content", _number(self.information), "0 level, 1 rugged"),
            FeatureRow("Fitness-distance correlation", _number(self.distance), "1: a cone"),
            FeatureRow("Skewness of the losses", _number(self.skewness), "above 0: few high losses"),
        ]


@dataclass(frozen=True)
class CharacterSample:
    """The points of the unit cube for measuring a character: some with gradients, then others that depend on these.

    The `first` have gradients. The `others`, with losses, are steps down some of the gradients, two repeated points,
    and points that continue the Sobol' sequence of the first ones.
    """

    dim: int
    evaluations: int
    seed: int

    @property
    def gradients(self) -> int:
        """The number of points with gradients."""
        return self.evaluations // GRADIENT_EVERY

    @property
    def stepped(self) -> int:
        """The number of points from which steps start: half of the losses are at the ends of steps."""
        return (self.evaluations - self.gradients - REPEATED) // (2 * len(STEPS))

    @cached_property
    def spread(self) -> Array:
        """The points that are spread over the box, those with gradients first."""
        count = self.evaluations - len(STEPS) * self.stepped - REPEATED
        found: Array = sobol(count, self.dim, seed=self.seed).numpy()
        return found

    @property
    def first(self) -> Array:
        """The points with gradients, shape (point, dim)."""
        return self.spread[: self.gradients]

    def ends(self, slopes: Array) -> Array:
        """Return the ends of steps, shape (step, point, dim): down gradients, or in any direction without one."""
        drawn = np.random.default_rng(self.seed).standard_normal((self.stepped, self.dim))
        ways = slopes[: self.stepped]
        largest = np.abs(ways).max(axis=1, keepdims=True)
        known = np.isfinite(largest) & (largest > 0)
        ways = np.where(known, ways / np.where(known, largest, 1.0), drawn)
        ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
        lengths = np.array(STEPS)[:, None, None] * math.sqrt(self.dim)
        found: Array = np.clip(self.first[: self.stepped] - lengths * ways, 0.0, 1.0)
        return found

    def others(self, slopes: Array) -> Array:
        """Return the points whose losses are needed, from gradients at the first ones by sides of the box."""
        ends = self.ends(slopes).reshape(-1, self.dim)
        return np.concatenate([ends, self.first[:REPEATED], self.spread[self.gradients :]])

    def measure(self, loss: Array, slopes: Array, others: Array) -> Character:
        """Measure the character from losses and gradients at the first points, and losses at the others.

        Values that are not finite are missing. Gradients are by sides of the box.
        """
        largest = np.abs(np.concatenate([loss, others])).max(
            initial=0.0, where=np.isfinite(np.concatenate([loss, others]))
        )
        with np.errstate(over="ignore", invalid="ignore"):
            known = (np.where(np.isfinite(one), one / (largest or 1.0), np.nan) for one in (loss, slopes, others))
            return self._measure(*known)

    def _measure(self, loss: Array, slopes: Array, others: Array) -> Character:
        ends, again, more = np.split(others, [len(STEPS) * self.stepped, len(STEPS) * self.stepped + REPEATED])
        losses, lengths = np.concatenate([loss, more]), np.linalg.norm(slopes, axis=1)
        known, steep = np.isfinite(losses), np.isfinite(lengths) & (lengths > 0)
        spread = float(np.std(losses[known])) if known.any() else 0.0
        units = slopes[steep] / lengths[steep, None]
        falls, agreement = self._steps(loss, slopes, ends.reshape(len(STEPS), -1))
        across, convex = _pairs(self.first[steep], loss[steep], slopes[steep])
        moved = np.abs(again - loss[:REPEATED])
        return Character(
            parameters=self.dim,
            evaluations=self.evaluations,
            failed=float((~np.isfinite(np.concatenate([loss, others]))).mean()),
            flat=float((~steep)[np.isfinite(loss)].mean()) if np.isfinite(loss).any() else math.nan,
            falls=falls,
            agreement=agreement,
            across=across,
            convex=convex,
            coherence=float(np.linalg.norm(units.mean(axis=0))) if steep.sum() > 1 else math.nan,
            steepest=float(np.log10(lengths[steep].max() / np.median(lengths[steep]))) if steep.any() else math.nan,
            noise=float(np.fmax.reduce(moved)) / spread if spread and np.isfinite(moved).any() else math.nan,
            **_explore(self.spread[known], losses[known]),
        )

    def _steps(self, loss: Array, slopes: Array, ends: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return by step the share of losses that fall, and the median of the decrease over its prediction."""
        start = self.first[: self.stepped]
        promised = ((self.ends(slopes) - start) * slopes[: self.stepped]).sum(axis=2)
        change = ends - loss[: self.stepped]
        falls, agreement = list[float](), list[float]()
        for told, came in zip(promised, change, strict=True):
            usable = np.isfinite(told) & np.isfinite(came) & (told < 0)
            kept = np.clip(came[usable] / told[usable], -1.0, 1.0)
            falls.append(float((kept > 0).mean()) if usable.any() else math.nan)
            agreement.append(float(np.median(kept)) if usable.any() else math.nan)
        return tuple(falls), tuple(agreement)


def _pairs(x: Array, loss: Array, slopes: Array) -> tuple[float, float]:
    """Return the agreement of loss differences with those of gradients, and the share of pairs whose gradients grow."""
    i, j = np.triu_indices(len(x), 1)
    if len(i) < MIN_LOSSES:
        return math.nan, math.nan
    apart, came = x[j] - x[i], loss[j] - loss[i]
    told = ((slopes[i] + slopes[j]) / 2 * apart).sum(axis=1)
    size = float(np.linalg.norm(told)) * float(np.linalg.norm(came))
    grows = ((slopes[j] - slopes[i]) * apart).sum(axis=1)
    return (float(told @ came) / size if size > 0 else math.nan), float((grows > 0).mean())


def _explore(x: Array, y: Array) -> dict[str, float]:
    """Return features of losses y, shape (point,), at points x, shape (point, dim)."""
    if len(y) < MIN_LOSSES or not np.ptp(y) > ROUNDING * np.abs(y).max():
        return dict.fromkeys(EXPLORED, math.nan)
    found = Exploratory.of(x, (y - y.min()) / np.ptp(y))
    return {name: float(attrgetter(place)(found)) for name, place in EXPLORED.items()}


@dataclass(frozen=True, eq=False)
class Measured:
    """A character, its points, and their losses, NaN where there is none.

    `gradient_cost` is about the cost of a point with gradient, in points without: NaN where programs were compiled.
    """

    character: Character
    x: Float[Tensor, "point dim"]
    loss: Float[Tensor, " point"]
    gradient_cost: float


def measure_character(objective: Objective, *, evaluations: int, seed: int = 0) -> Measured:
    """Evaluate an objective at exactly this many points, a quarter of them with gradients, and measure its character.

    The first point is evaluated alone: it raises ValueError where the objective has no gradients.
    """
    space, sample = objective.space, CharacterSample(objective.space.dim, evaluations, seed)
    x = space.from_unit(torch.from_numpy(sample.first))
    alone = evaluate(objective, x[:1], grad=True)
    began = time.perf_counter()
    first = Evaluation.join([alone, evaluate(objective, x[1:], grad=True)], dim=space.dim, grad=True)
    between = time.perf_counter()
    assert first.grad is not None  # as asked
    slopes = first.grad.numpy() * (space.upper - space.lower).numpy()
    more = space.from_unit(torch.from_numpy(sample.others(slopes)))
    others = evaluate(objective, more, grad=False).loss
    each = (between - began) / (len(x) - 1), (time.perf_counter() - between) / len(more)
    character = sample.measure(first.loss.numpy(), slopes, others.numpy())
    cost = math.nan if objective.own_programs else each[0] / each[1]
    return Measured(character, torch.cat([x, more]), torch.cat([first.loss, others]), cost)


def _number(value: float) -> str:
    return f"{value:z.2f}" if math.isfinite(value) else UNDETERMINED


def _percent(value: float) -> str:
    return f"{100 * value:z.0f} %" if math.isfinite(value) else UNDETERMINED


def _several(form: Callable[[float], str], values: Sequence[float]) -> str:
    return ", ".join(map(form, values))
