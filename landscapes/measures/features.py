"""Landscape features over all parameters of an objective: exploratory ones, and those from gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..capacity import Need
from ..objective import Evaluation, Objective, evaluate
from ..space import sobol
from ..statistics import RESAMPLES, UNKNOWN, Estimate, middle_95
from .exploratory import GROUPS, MAX_COEFFICIENTS, MAX_POINTS, Array, Exploratory, MetaModels
from .polynomials import GradientModel, degrees_of, fit_with_gradients

POINTS, LEAST = 50, 10  # points for each parameter, and how many of them need a loss
BASE = 128  # points from which every parameter is varied for Sobol' indices
BLOCKS = 100  # groups of points that are resampled for an active subspace
SHOWN, NAMED, ENOUGH = 10, 5, 0.95  # eigenvalues kept, parameters named, share of the squared gradients
ROUNDINGS, RATE = 100.0, 1e10  # that losses have to differ by; floating-point operations a second (one core)
UNDETERMINED, UNRESOLVED, WORTHLESS = "not determined", "not resolved", -100.0  # [%]


@dataclass(frozen=True)
class ActiveSubspace:
    """Eigenvalues of the mean of grad grad^T in sides of the box (Constantine, Dow & Wang 2014).

    `shares` are the largest ones, relative to their sum. `participation` is (sum)^2 / sum of squares: how many
    directions matter. `directions` is the number that has 95 % of the sum. `leading` has the largest components of the
    first eigenvector.
    """

    gradients: int
    shares: tuple[Estimate, ...]
    participation: Estimate
    directions: Estimate
    leading: dict[str, float]


@dataclass(frozen=True)
class SobolIndices:
    """Shares of the variance by each parameter alone (`first`) and with all its interactions (`total`).

    Estimators of Saltelli et al. 2010 and of Jansen 1999 at `points` base points, each with every parameter varied.
    `bound` is the upper bound of the total from gradients (Sobol' & Kucherenko 2009). `interaction` is 1 minus the sum
    of `first`. `failed` counts the points without a loss.
    """

    points: int
    failed: int
    first: dict[str, Estimate]
    total: dict[str, Estimate]
    bound: dict[str, Estimate]
    interaction: Estimate

    @property
    def unexplained(self) -> list[str]:
        """The parameters whose total index exceeds the bound from gradients, both intervals considered."""
        return [name for name, total in self.total.items() if name in self.bound and total.low > self.bound[name].high]


class FeatureRow(NamedTuple):
    """A feature in a table: its name, its value, and its meaning."""

    name: str
    value: str
    meaning: str


@dataclass(frozen=True)
class Features:
    """Features over all parameters, from `points` in the box, in sides of the box and ranges of the sampled losses.

    `why` explains why there is no result, and is empty where there is one. `reach` is half the width of the 95 %
    interval of each exploratory feature. These and polynomials use only the first `measured` points.
    """

    parameters: int
    points: int
    failed: int
    measured: int
    seed: int
    lowest: float
    range: float
    why: str = ""
    exploratory: Exploratory | None = None
    reach: Exploratory | None = None
    models: tuple[GradientModel, ...] = ()
    subspace: ActiveSubspace | None = None
    sobol: SobolIndices | None = None

    def rows(self) -> list[FeatureRow]:
        """Return the main features in words, with 95 % intervals."""
        said = f"{self.points} points, {self.failed} failed"
        rows = [FeatureRow("Sample", said, "scrambled Sobol' sequence over all parameters")]
        if self.why or self.exploratory is None or self.reach is None:
            return [*rows, FeatureRow("All features", "cannot tell", self.why)]
        words = _Words(self.exploratory, self.reach)
        rows += _model_rows(words, self.parameters, self.measured)
        rows += map(_fitted_row, self.models)
        rows += _subspace_rows(self.subspace, self.parameters) if self.subspace else []
        rows += _sobol_rows(self.sobol) if self.sobol else []
        return [*rows, *_distance_rows(words, self.measured), *_loss_rows(words)]


def effort(dim: int) -> tuple[int, int]:
    """Return the numbers of losses and of gradients that `measure_features` evaluates."""
    return BASE * (dim + 2), POINTS * dim


def need_of(dim: int) -> Need:
    """Return the memory of the points, their gradients and their distances."""
    points = POINTS * dim
    measured, blocks = min(points, MAX_POINTS), min(points, BLOCKS)
    terms = max(count for _, count in degrees_of(dim))
    tables = 6 * measured**2 + 2 * blocks * dim**2 + 3 * measured * terms + 6 * terms**2
    return Need(8.0 * (4 * points * dim + tables + 3 * RESAMPLES * BASE * dim))


def own_seconds(dim: int) -> float:
    """Return the approximate time of `measure_features` itself in seconds (one core)."""
    n, times = min(POINTS * dim, MAX_POINTS), 1 + GROUPS
    polynomials = sum(50 * count**3 / 3 + 4 * n * count**2 for _, count in degrees_of(dim))
    models = sum(4 * n * count**2 for count in MetaModels.coefficients(dim) if count <= min(n - 2, MAX_COEFFICIENTS))
    levels = 30 * (n * dim**2 + dim**3)
    return 1 + (polynomials + times * (models + levels + n**2 * (dim + 60))) / RATE


def measure_features(
    objective: Objective, *, seed: int, rounding: float, follow: Callable[[int], None] = lambda done: None
) -> Features:
    """Sample an objective over its box, and measure its features.

    `rounding` is the engine's relative precision. `follow` receives the number of evaluated points. Missing gradients
    are left out, and so are features of gradients where there are fewer than 10 for each parameter.
    """
    space, dim = objective.space, objective.space.dim
    unit = sobol(POINTS * dim, dim, seed=seed)
    found = evaluate_parts(objective, space.from_unit(unit), grad=True, follow=follow)
    loss = found.loss.numpy()
    there = np.isfinite(loss)
    x, y = unit.numpy()[there], loss[there]
    lowest, span = (float(y.min()), float(np.ptp(y))) if len(y) else (math.nan, math.nan)
    measured = min(len(y), MAX_POINTS)
    bare = Features(dim, len(loss), int((~there).sum()), measured, seed, lowest, span, _refuse(y, dim, rounding))
    if bare.why:
        follow(sum(effort(dim)))
        return bare
    y = (y - lowest) / span
    grad = np.full_like(x, np.nan) if found.grad is None else (found.grad * (space.upper - space.lower)).numpy()[there]
    slopes = grad / span
    known = np.isfinite(slopes).all(axis=1)
    enough = known.sum() >= LEAST * dim
    rng = np.random.default_rng(seed)
    varied = _vary(objective, seed, lambda done: follow(len(loss) + done))
    return replace(
        bare,
        exploratory=Exploratory.of(x, y),
        reach=Exploratory.reach(x, y),
        models=fit_with_gradients(x[known], y[known], slopes[known], rng) if enough else (),
        subspace=active_subspace(slopes[known], space.names, rng) if enough else None,
        sobol=sobol_indices(*varied, slopes[known] * span if enough else None, space.names, rng),
    )


def _refuse(y: Array, dim: int, rounding: float) -> str:
    """Explain why losses give no result; empty where they do."""
    if len(y) < LEAST * dim:
        return f"{len(y)} points have a loss; at least {LEAST * dim} are needed, {LEAST} for each parameter"
    if np.ptp(y) <= ROUNDINGS * rounding * np.abs(y).max():
        return f"all losses are equal up to rounding: {y.min():.6g} to {y.max():.6g}"
    return ""


def evaluate_parts(
    objective: Objective,
    x: Float[Tensor, "point dim"],
    *,
    grad: bool,
    follow: Callable[[int], None] = lambda done: None,
) -> Evaluation:
    """Evaluate an objective in its preferred batches; `follow` receives the number of finished points."""
    parts, done = list[Evaluation](), 0
    for rows in torch.split(x, objective.preferred_batch):
        parts.append(evaluate(objective, rows, grad=grad))
        follow(done := done + len(rows))
    return Evaluation.join(parts, dim=objective.space.dim, grad=grad)


# ---- Directions


def active_subspace(slopes: Array, names: Sequence[str], rng: np.random.Generator) -> ActiveSubspace:
    """Decompose the mean of grad grad^T, from gradients of shape (point, dim), with bootstrap intervals over points."""
    blocks = np.arange(len(slopes)) % min(len(slopes), BLOCKS)
    tables = np.stack([slopes[blocks == one].T @ slopes[blocks == one] for one in range(blocks.max() + 1)])
    sizes, vectors = np.linalg.eigh(tables.sum(axis=0))
    if sizes[-1] <= 0:
        return ActiveSubspace(len(slopes), (), UNKNOWN, UNKNOWN, {})
    times = rng.multinomial(len(tables), np.full(len(tables), 1 / len(tables)), size=RESAMPLES)
    drawn = [_spectrum(np.linalg.eigvalsh(np.tensordot(one, tables, 1))) for one in times.astype(float)]
    share, participation, directions = _spectrum(sizes)
    leading = np.argsort(-np.abs(vectors[:, -1]), kind="stable")[:NAMED]
    sign = np.sign(vectors[leading[0], -1])
    return ActiveSubspace(
        gradients=len(slopes),
        shares=tuple(middle_95(float(share[k]), [one[0][k] for one in drawn]) for k in range(min(SHOWN, len(share)))),
        participation=middle_95(participation, [one[1] for one in drawn]),
        directions=middle_95(directions, [one[2] for one in drawn]),
        leading={names[k]: float(sign * vectors[k, -1]) for k in leading},
    )


def _spectrum(sizes: Array) -> tuple[Array, float, float]:
    """Return eigenvalues as shares, the largest first, their participation ratio, and the number that makes 95 %."""
    share = np.clip(sizes[::-1], 0, None) / np.clip(sizes, 0, None).sum()
    return share, float(1 / np.square(share).sum()), float((np.cumsum(share) < ENOUGH).sum() + 1)


# ---- Sobol' indices


def _vary(objective: Objective, seed: int, follow: Callable[[int], None]) -> tuple[Array, Array, Array]:
    """Return losses at base points and at others, shapes (base,), and with one parameter of the other, (base, dim)."""
    space, dim = objective.space, objective.space.dim
    both = sobol(BASE, 2 * dim, seed=seed + 1)
    base, far = both[:, :dim], both[:, dim:]
    ends = evaluate_parts(objective, space.from_unit(torch.cat([base, far])), grad=False, follow=follow).loss.numpy()
    varied, at_once = list[Array](), max(1, objective.preferred_batch // dim)
    for rows in torch.split(torch.arange(BASE), at_once):
        points = base[rows, None, :].repeat(1, dim, 1)
        points.diagonal(dim1=1, dim2=2).copy_(far[rows])
        found = evaluate_parts(objective, space.from_unit(points.reshape(-1, dim)), grad=False)
        varied.append(found.loss.numpy().reshape(len(rows), dim))
        follow(2 * BASE + (int(rows[-1]) + 1) * dim)
    return ends[:BASE], ends[BASE:], np.concatenate(varied)


def sobol_indices(
    base: Array, far: Array, varied: Array, slopes: Array | None, names: Sequence[str], rng: np.random.Generator
) -> SobolIndices:
    """Estimate Sobol' indices of losses, shapes (base,), (base,) and (base, dim), and bounds by `slopes`.

    Intervals are a bootstrap over base points with all losses.
    """
    failed = sum(int((~np.isfinite(one)).sum()) for one in (base, far, varied))
    there = np.isfinite(base) & np.isfinite(far) & np.isfinite(varied).all(axis=1)
    base, far, varied = base[there], far[there], varied[there]
    first, total, bound = (dict[str, Estimate]() for _ in range(3))
    interaction = UNKNOWN
    if len(base) > 1 and np.ptp(base):
        rows = rng.integers(len(base), size=(RESAMPLES, len(base)))
        drawn = [_indices(base[one], far[one], varied[one]) for one in rows]
        (alone, whole), n = _indices(base, far, varied), len(names)
        first = {names[k]: middle_95(float(alone[k]), [one[0][k] for one in drawn]) for k in range(n)}
        total = {names[k]: middle_95(float(whole[k]), [one[1][k] for one in drawn]) for k in range(n)}
        interaction = middle_95(1 - float(alone.sum()), [1 - float(one[0].sum()) for one in drawn])
    if slopes is not None and total:
        bound = _bounds(slopes, float(np.var(np.concatenate([base, far]))), names, rng)
    return SobolIndices(len(base), failed, first, total, bound, interaction)


def _indices(base: Array, far: Array, varied: Array) -> tuple[Array, Array]:
    """Return first indices (Saltelli et al. 2010, table 2 b) and total ones (Jansen 1999, table 2 f), shapes (dim,)."""
    both = np.concatenate([base, far])
    variance = float(both.var())
    moved = varied - base[:, None]
    first: Array = ((far - both.mean())[:, None] * moved).mean(axis=0) / variance
    return first, np.square(moved).mean(axis=0) / (2 * variance)


def _bounds(slopes: Array, variance: float, names: Sequence[str], rng: np.random.Generator) -> dict[str, Estimate]:
    """Return upper bounds of total indices: mean squares of gradients by pi^2 times the variance."""
    squares = np.square(slopes) / (math.pi**2 * variance)
    times = rng.multinomial(len(squares), np.full(len(squares), 1 / len(squares)), size=RESAMPLES)
    drawn = times @ squares / len(squares)
    return {name: middle_95(float(squares[:, k].mean()), drawn[:, k]) for k, name in enumerate(names)}


# ---- In words


@dataclass(frozen=True)
class _Words:
    """Write exploratory features with their intervals, each with a name like "ic.h_max"."""

    found: Exploratory
    reach: Exploratory

    def number(self, *names: str) -> str:
        """Write features as numbers."""
        return ", ".join(_number(get(self.found), get(self.reach)) for get in map(attrgetter, names))

    def percent(self, *names: str) -> str:
        """Write features as percentages."""
        return ", ".join(_percent(get(self.found), get(self.reach)) for get in map(attrgetter, names))

    def resolved(self, name: str) -> str:
        """Write a ratio as a number, unless its interval includes zero."""
        value, reach = attrgetter(name)(self.found), attrgetter(name)(self.reach)
        return UNRESOLVED if reach >= value else self.number(name)


def _model_rows(words: _Words, dim: int, points: int) -> list[FeatureRow]:
    counts = MetaModels.coefficients(dim)
    said = (
        ("Explained by a linear model", "lin_simple", "losses lie on a plane"),
        ("Explained with products of parameters", "lin_w_interact", "parameters interact in pairs"),
        ("Explained by a quadratic model", "quad_simple", "a parabola for each parameter"),
        ("Explained with all its products", "quad_w_interact", "squares interact, too"),
    )
    rows = []
    for (name, kind, meaning), count in zip(said, counts, strict=True):
        known = math.isfinite(getattr(words.found.ela_meta, f"{kind}_adj_r2"))
        why = f"adjusted R2; 100 %: {meaning}" if known else f"{count} coefficients, {points} points"
        rows.append(FeatureRow(name, words.percent(f"ela_meta.{kind}_adj_r2"), why))
    steep, curved = words.resolved("ela_meta.lin_simple_coef_max_by_min"), words.resolved("ela_meta.quad_simple_cond")
    return [
        *rows,
        FeatureRow("Steepest over least steep parameter", steep, "in the linear model"),
        FeatureRow("Most over least curved parameter", curved, "in the quadratic model"),
    ]


def _fitted_row(model: GradientModel) -> FeatureRow:
    kind = f"polynomial of degree {model.degree}{' without products' if model.separable else ''}"
    alone = f"held-out R2; from losses alone {_share(model.losses_alone)}; {model.coefficients} coefficients"
    return FeatureRow(f"Explained with gradients by a {kind}", _share(model.with_gradients), alone)


def _subspace_rows(found: ActiveSubspace, dim: int) -> list[FeatureRow]:
    leading = ", ".join(f"{name} {part:+.2f}" for name, part in found.leading.items())
    first = _share(found.shares[0]) if found.shares else UNDETERMINED
    return [
        FeatureRow(
            "Effective dimension", _estimate(found.participation), f"of {dim}: participation ratio of gradients"
        ),
        FeatureRow("Directions with 95 %", _estimate(found.directions, "{:.0f}"), "of the mean squared gradient"),
        FeatureRow("The first direction has", first, leading or "all gradients are zero"),
    ]


def _sobol_rows(found: SobolIndices) -> list[FeatureRow]:
    if not found.total:
        return [FeatureRow("Sobol' indices", "cannot tell", f"{found.failed} points failed")]
    rows = []
    for name in sorted(found.total, key=lambda one: -found.total[one].value)[:NAMED]:
        rows.append(FeatureRow(f"Variance by {name}", _share(found.total[name]), f"alone {_share(found.first[name])}"))
    source = f"Sobol' indices, {found.points} base points, {found.failed} points failed"
    resolved = found.interaction.high - found.interaction.low <= 1
    rows.append(FeatureRow("Variance by interactions", _share(found.interaction) if resolved else UNRESOLVED, source))
    if found.bound:
        more = ", ".join(found.unexplained[:NAMED]) or "of no parameter"
        rows.append(FeatureRow("More variance than gradients allow", more, "jumps, or wrong gradients"))
    return rows


def _distance_rows(words: _Words, points: int) -> list[FeatureRow]:
    dispersion = words.number(*(f"disp.ratio_mean_{best}" for best in ("02", "05", "10", "25")))
    better, attracted = words.number("nbc.nn_nb_mean_ratio"), words.number("nbc.nb_fitness_cor")
    entropy, turns = words.number("ic.h_max"), words.percent("ic.m0")
    return [
        FeatureRow("Dispersion of the best 2, 5, 10, 25 %", dispersion, f"1 scattered, 0 together; of {points} points"),
        FeatureRow("Information content", entropy, "of steps to the nearest remaining point: 0 level, 1 rugged"),
        FeatureRow("Steps that turn back", turns, "of the same steps"),
        FeatureRow("Nearest over nearest better point", better, "mean distances; small: better points are far away"),
        FeatureRow("Loss and number of points it attracts", attracted, "correlation; near -1: one funnel"),
    ]


def _loss_rows(words: _Words) -> list[FeatureRow]:
    plane, quadric = (words.percent(*(f"ela_level.mmce_{kind}_{q}" for q in (10, 25, 50))) for kind in ("lda", "qda"))
    best = f"1: a cone; of the best 10 %: {words.number('fitness_distance.fd_correlation')}"
    alone = f"of the variance, by correlations; of the points alone {words.percent('pca.expl_var_pc1_cor_x')}"
    peaks = f"{words.found.ela_distr.number_of_peaks:.0f}"
    return [
        FeatureRow("Skewness of the losses", words.number("ela_distr.skewness"), "above 0: few high losses"),
        FeatureRow("Excess kurtosis", words.number("ela_distr.kurtosis"), "0: normal; above: far outliers"),
        FeatureRow("Peaks of their density", peaks, "above 1: plateaus or levels"),
        FeatureRow("Wrong side of a plane", plane, "points below the 10, 25, 50 % quantile; by chance: 10, 25, 50 %"),
        FeatureRow("Wrong side of a quadric", quadric, "the same, by quadratic discriminants"),
        FeatureRow("Fitness-distance correlation", words.number("fitness_distance_all.fd_correlation"), best),
        FeatureRow("First component of points and losses", words.percent("pca.expl_var_pc1_cor_init"), alone),
    ]


def _number(value: float, reach: float = math.nan) -> str:
    if not math.isfinite(value):
        return UNDETERMINED
    said = f"{value:z.2f}" if abs(value) < 1000 else f"{value:.2g}"
    return (f"{said} ± {reach:.2f}" if math.isfinite(reach) else said).replace("-", "\N{MINUS SIGN}")


def _percent(value: float, reach: float = math.nan) -> str:
    if not math.isfinite(value):
        return UNDETERMINED
    said = f"{100 * value:z.0f} ± {100 * reach:.0f} %" if math.isfinite(reach) else f"{100 * value:z.0f} %"
    return said.replace("-", "\N{MINUS SIGN}")


def _share(estimate: Estimate) -> str:
    return _estimate(Estimate(*(100 * one for one in vars(estimate).values())), "{:z.0f} %")


def _estimate(estimate: Estimate, form: str = "{:.1f}") -> str:
    if not math.isfinite(estimate.value):
        return UNDETERMINED
    if form.endswith("%") and estimate.high < WORTHLESS:
        return "nothing: the mean predicts better"
    value, low, high = (form.format(one).replace("-", "\N{MINUS SIGN}") for one in vars(estimate).values())
    return f"{value} ({low.removesuffix(' %')} to {high})"
