"""Landscape features over all parameters of an objective: the exploratory ones, and those that gradients give."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..capacity import Need
from ..objective import Evaluation, Objective, evaluate
from ..space import sobol
from ..statistics import Estimate
from .exploratory import GROUPS, MAX_COEFFICIENTS, MAX_POINTS, Array, Exploratory, MetaModels

POINTS, LEAST = 50, 10  # points for each parameter, and how many of them need a loss
BASE = 128  # points from which every parameter is varied for Sobol' indices
FOLDS, ROUNDS = 10, 3  # parts of the points that are held out, and rounds of weighting
RESAMPLES, BLOCKS = 200, 100  # of the bootstrap, and groups of points that it resamples for an active subspace
SHOWN, NAMED, ENOUGH = 10, 5, 0.95  # eigenvalues kept, parameters named, share of the squared gradients
MAX_DEGREE, LARGEST_WEIGHT = 4, 1e6
ROUNDINGS, RATE = 100.0, 1e10  # that losses have to differ by; floating-point operations a second (one core)
UNDETERMINED, WORTHLESS = "not determined", -100.0  # [%]


@dataclass(frozen=True)
class GradientModel:
    """Held-out R2 of a polynomial of so many `coefficients`, fitted to losses alone and with their gradients.

    A `separable` one has no products of parameters. `of_gradients` is the R2 of the model's slopes. An equation of a
    gradient has `weight` times that of a loss: the ratio of the variances that the model leaves (feasible generalised
    least squares).
    """

    degree: int
    separable: bool
    coefficients: int
    losses_alone: Estimate
    with_gradients: Estimate
    of_gradients: Estimate
    weight: float


@dataclass(frozen=True)
class ActiveSubspace:
    """Eigenvalues of the mean of grad grad^T in sides of the box (Constantine, Dow & Wang 2014).

    `shares` are the largest ones, of their sum. `participation` is (sum)^2 / sum of squares: how many directions count.
    `directions` are as many as hold 95 % of the sum. `leading` has the largest components of the first eigenvector.
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
    `bound` is what gradients allow the total at most (Sobol' & Kucherenko 2009). `interaction` is 1 less the sum of
    `first`. `failed` counts the points without a loss.
    """

    points: int
    failed: int
    first: dict[str, Estimate]
    total: dict[str, Estimate]
    bound: dict[str, Estimate]
    interaction: Estimate

    @property
    def unexplained(self) -> list[str]:
        """The parameters whose total index is above what gradients allow, both intervals considered."""
        return [name for name, total in self.total.items() if name in self.bound and total.low > self.bound[name].high]


class FeatureRow(NamedTuple):
    """A feature as a table has it: what it is called, its value, and what that means."""

    name: str
    value: str
    meaning: str


@dataclass(frozen=True)
class Features:
    """Features over all parameters, of `points` in the box, in sides of the box and in ranges of the sampled losses.

    `why` says why nothing can be told, and is empty where something can. `reach` is half the width of the 95 % interval
    of each exploratory feature. These and polynomials are of the first `measured` points alone.
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
        """Return the chief features in words, with 95 % intervals."""
        said = f"{self.points} points, {self.failed} failed"
        rows = [FeatureRow("Sample", said, "scrambled Sobol' sequence over all parameters")]
        if self.why or self.exploratory is None or self.reach is None:
            return [*rows, FeatureRow("All features", "cannot tell", self.why)]
        found, reach = self.exploratory, self.reach
        rows += _model_rows(found, reach, self.parameters, self.measured)
        rows += map(_fitted_row, self.models)
        rows += _subspace_rows(self.subspace, self.parameters) if self.subspace else []
        rows += _sobol_rows(self.sobol) if self.sobol else []
        return [*rows, *_distance_rows(found, reach, self.measured), *_loss_rows(found, reach)]


def effort(dim: int) -> tuple[int, int]:
    """Return how many losses and how many gradients `measure_features` evaluates."""
    return BASE * (dim + 2), POINTS * dim


def need_of(dim: int) -> Need:
    """Return what the points, their gradients and their distances take."""
    points = POINTS * dim
    measured, blocks = min(points, MAX_POINTS), min(points, BLOCKS)
    terms = max(count for _, count in _degrees(dim))
    tables = 6 * measured**2 + 2 * blocks * dim**2 + 3 * measured * terms + 6 * terms**2
    return Need(8.0 * (4 * points * dim + tables + 3 * RESAMPLES * BASE * dim))


def own_seconds(dim: int) -> float:
    """Return about how many seconds `measure_features` takes itself (one core)."""
    n, times = min(POINTS * dim, MAX_POINTS), 1 + GROUPS
    polynomials = sum(50 * count**3 / 3 + 4 * n * count**2 for _, count in _degrees(dim))
    models = sum(4 * n * count**2 for count in MetaModels.coefficients(dim) if count <= min(n - 2, MAX_COEFFICIENTS))
    levels = 30 * (6 * n * dim**2 + 30 * dim**3)
    return 1 + (polynomials + times * (models + levels + n**2 * (dim + 60))) / RATE


def _degrees(dim: int) -> list[tuple[int, int]]:
    """Return the degrees of the polynomials that are fitted, and how many coefficients each has.

    Where squares and products of all parameters are too many, that of degree 2 has squares alone.
    """
    counts = [(degree, math.comb(dim + degree, degree)) for degree in range(1, MAX_DEGREE + 1)]
    counts[1] = counts[1] if counts[1][1] <= MAX_COEFFICIENTS else (2, 1 + 2 * dim)
    return [(degree, count) for degree, count in counts if count <= MAX_COEFFICIENTS]


def measure_features(
    objective: Objective, *, seed: int, rounding: float, follow: Callable[[int], None] = lambda done: None
) -> Features:
    """Sample an objective over its box, and measure its features.

    `rounding` is the engine's relative precision. `follow` hears how many points are evaluated. Gradients that are
    missing are left out, and features of gradients where fewer than 10 for each parameter are there.
    """
    space, dim = objective.space, objective.space.dim
    unit = sobol(POINTS * dim, dim, seed=seed)
    found = _evaluate(objective, space.from_unit(unit), grad=True, follow=follow)
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
    """Say why nothing can be told of losses; nothing where something can."""
    if len(y) < LEAST * dim:
        return f"{len(y)} points have a loss; {LEAST * dim} are needed, {LEAST} for each parameter"
    if np.ptp(y) <= ROUNDINGS * rounding * np.abs(y).max():
        return f"all losses are the same to rounding: {y.min():.6g} to {y.max():.6g}"
    return ""


def _evaluate(
    objective: Objective, x: Float[Tensor, "point dim"], *, grad: bool, follow: Callable[[int], None]
) -> Evaluation:
    parts, done = list[Evaluation](), 0
    for rows in torch.split(x, objective.preferred_batch):
        parts.append(evaluate(objective, rows, grad=grad))
        follow(done := done + len(rows))
    return Evaluation.join(parts, dim=objective.space.dim, grad=grad)


# ---- Models of losses and gradients


def fit_with_gradients(x: Array, y: Array, slopes: Array, rng: np.random.Generator) -> tuple[GradientModel, ...]:
    """Fit polynomials to losses, shape (point,), and to slopes, shape (point, dim), and test them on other points.

    One of each degree up to 4 that has no more coefficients than are fitted.
    """
    x, y, slopes = 2 * x[:MAX_POINTS] - 1, y[:MAX_POINTS], slopes[:MAX_POINTS] / 2  # parameters from -1 to 1
    models = (
        _Polynomial.of(x, degree, separable=count == 1 + 2 * x.shape[1]) for degree, count in _degrees(x.shape[1])
    )
    return tuple(_hold_out(model, y, slopes, rng) for model in models)


def _hold_out(model: _Polynomial, y: Array, slopes: Array, rng: np.random.Generator) -> GradientModel:
    """Hold out ten parts of the points in turn, and fit a model to the others."""
    off, off_alone, off_mean = np.empty_like(y), np.empty_like(y), np.empty_like(y)
    slope_off, slope_mean, weights = np.empty_like(slopes), np.empty_like(slopes), list[float]()
    whole = model.equations(y, slopes, np.ones(len(y), bool))
    for fold in range(FOLDS):
        test = np.arange(len(y)) % FOLDS == fold
        train = whole.without(model.equations(y, slopes, test))
        alone, (both, weight) = train.solve(0.0), model.fit_weighted(train, y, slopes, ~test)
        off[test], off_alone[test] = y[test] - model.losses(both)[test], y[test] - model.losses(alone)[test]
        off_mean[test] = y[test] - y[~test].mean()
        slope_off[test], slope_mean[test] = (slopes - model.slopes(both))[test], (slopes - slopes[~test].mean(0))[test]
        weights.append(weight)
    of_losses = [_explained(np.square(one), np.square(off_mean), rng) for one in (off_alone, off)]
    of_slopes = _explained(np.square(slope_off).sum(axis=1), np.square(slope_mean).sum(axis=1), rng)
    return GradientModel(
        model.degree, model.separable, model.values.shape[1], *of_losses, of_slopes, float(np.median(weights))
    )


@dataclass(frozen=True, eq=False)
class _Polynomial:
    """Monomials at points: their `values`, shape (point, term), and along each axis the terms that vary and slopes."""

    degree: int
    separable: bool
    values: Array
    along: tuple[tuple[NDArray[np.int_], Array], ...]

    @classmethod
    def of(cls, z: Array, degree: int, *, separable: bool) -> _Polynomial:
        """Return the monomials of `z`, shape (point, dim), up to a degree; those of one parameter if `separable`."""
        dim = z.shape[1]
        chosen = [combinations_with_replacement(range(dim), size) for size in range(degree + 1)]
        factors = [one for size in chosen for one in size if not separable or len(set(one)) < 2]
        values = np.column_stack([z[:, list(one)].prod(axis=1) for one in factors])
        known, along = {one: k for k, one in enumerate(factors)}, []
        for axis in range(dim):
            mine = [k for k, one in enumerate(factors) if axis in one]
            lower = [known[_without(factors[k], axis)] for k in mine]
            powers = np.array([factors[k].count(axis) for k in mine])
            along.append((np.array(mine), powers * values[:, lower]))
        return cls(degree, separable, values, tuple(along))

    def losses(self, coefficients: Array) -> Array:
        """Return the model's losses, shape (point,)."""
        found: Array = self.values @ coefficients
        return found

    def slopes(self, coefficients: Array) -> Array:
        """Return the model's slopes, shape (point, dim)."""
        return np.column_stack([slopes @ coefficients[terms] for terms, slopes in self.along])

    def equations(self, y: Array, slopes: Array, rows: NDArray[np.bool_]) -> _Equations:
        """Return the normal equations of some rows."""
        values = self.values[rows]
        table, right = np.zeros((values.shape[1],) * 2), np.zeros(values.shape[1])
        for (terms, varied), slope in zip(self.along, slopes.T, strict=True):
            mine = varied[rows]
            table[np.ix_(terms, terms)] += mine.T @ mine
            right[terms] += mine.T @ slope[rows]
        return _Equations(int(rows.sum()), values.T @ values, values.T @ y[rows], slopes.shape[1], table, right)

    def fit_weighted(
        self, equations: _Equations, y: Array, slopes: Array, rows: NDArray[np.bool_]
    ) -> tuple[Array, float]:
        """Fit the model with the weight that its own residuals give, and return both."""
        weight, least = 1.0, np.finfo(float).eps * float(np.square(y).mean())
        for _ in range(ROUNDS):
            found = equations.solve(weight)
            off, slope_off = np.square(y - self.losses(found))[rows], np.square(slopes - self.slopes(found))[rows]
            ratio = float((off.mean() + least) / (slope_off.mean() + least))
            weight = min(max(ratio, 1 / LARGEST_WEIGHT), LARGEST_WEIGHT)
        return equations.solve(weight), weight


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of losses at so many `points`, and of their slopes along `dim` axes."""

    points: int
    losses: Array
    right: Array
    dim: int
    slopes: Array
    slopes_right: Array

    def without(self, other: _Equations) -> _Equations:
        """Return the equations without those of some of the points."""
        return _Equations(
            self.points - other.points, self.losses - other.losses, self.right - other.right, self.dim,
            self.slopes - other.slopes, self.slopes_right - other.slopes_right,
        )  # fmt: skip

    def solve(self, weight: float) -> Array:
        """Return the coefficients, slopes weighted; NaN where the equations do not determine them."""
        from scipy.linalg import LinAlgError, solve

        none = np.full_like(self.right, np.nan)
        if self.points * (1 + self.dim * (weight > 0)) <= len(self.right):
            return none
        try:
            table, right = self.losses + weight * self.slopes, self.right + weight * self.slopes_right
            found: Array = solve(table, right, assume_a="pos")
        except LinAlgError:
            return none
        return found


def _without(factors: tuple[int, ...], axis: int) -> tuple[int, ...]:
    at = factors.index(axis)
    return factors[:at] + factors[at + 1 :]


def _explained(left: Array, whole: Array, rng: np.random.Generator) -> Estimate:
    """Return 1 - sum of `left` by sum of `whole`, shapes (point,), with its bootstrap interval over points."""
    if not np.isfinite(left).all() or not whole.sum():
        return Estimate(math.nan, math.nan, math.nan)
    rows = rng.integers(len(left), size=(RESAMPLES, len(left)))
    return _interval(1 - float(left.sum() / whole.sum()), 1 - left[rows].sum(axis=1) / whole[rows].sum(axis=1))


# ---- Directions


def active_subspace(slopes: Array, names: Sequence[str], rng: np.random.Generator) -> ActiveSubspace:
    """Decompose the mean of grad grad^T, of slopes of shape (point, dim), with bootstrap intervals over points."""
    blocks = np.arange(len(slopes)) % min(len(slopes), BLOCKS)
    tables = np.stack([slopes[blocks == one].T @ slopes[blocks == one] for one in range(blocks.max() + 1)])
    sizes, vectors = np.linalg.eigh(tables.sum(axis=0))
    if sizes[-1] <= 0:
        none = Estimate(math.nan, math.nan, math.nan)
        return ActiveSubspace(len(slopes), (), none, none, {})
    times = rng.multinomial(len(tables), np.full(len(tables), 1 / len(tables)), size=RESAMPLES)
    drawn = [_spectrum(np.linalg.eigvalsh(np.tensordot(one, tables, 1))) for one in times.astype(float)]
    share, participation, directions = _spectrum(sizes)
    leading = np.argsort(-np.abs(vectors[:, -1]), kind="stable")[:NAMED]
    sign = np.sign(vectors[leading[0], -1])
    return ActiveSubspace(
        gradients=len(slopes),
        shares=tuple(_interval(float(share[k]), [one[0][k] for one in drawn]) for k in range(min(SHOWN, len(share)))),
        participation=_interval(participation, [one[1] for one in drawn]),
        directions=_interval(directions, [one[2] for one in drawn]),
        leading={names[k]: float(sign * vectors[k, -1]) for k in leading},
    )


def _spectrum(sizes: Array) -> tuple[Array, float, float]:
    """Return eigenvalues as shares, the largest first, their participation ratio, and how many make 95 %."""
    share = np.clip(sizes[::-1], 0, None) / np.clip(sizes, 0, None).sum()
    return share, float(1 / np.square(share).sum()), float((np.cumsum(share) < ENOUGH).sum() + 1)


# ---- Sobol' indices


def _vary(objective: Objective, seed: int, follow: Callable[[int], None]) -> tuple[Array, Array, Array]:
    """Return losses at base points and at others, shapes (base,), and with one parameter of the other, (base, dim)."""
    space, dim = objective.space, objective.space.dim
    both = sobol(BASE, 2 * dim, seed=seed + 1)
    base, far = both[:, :dim], both[:, dim:]
    ends = _evaluate(objective, space.from_unit(torch.cat([base, far])), grad=False, follow=follow).loss.numpy()
    varied, at_once = list[Array](), max(1, objective.preferred_batch // dim)
    for rows in torch.split(torch.arange(BASE), at_once):
        points = base[rows, None, :].repeat(1, dim, 1)
        points.diagonal(dim1=1, dim2=2).copy_(far[rows])
        done = 2 * BASE + int(rows[0]) * dim
        found = _evaluate(
            objective, space.from_unit(points.reshape(-1, dim)), grad=False, follow=lambda n: follow(done + n)
        )
        varied.append(found.loss.numpy().reshape(len(rows), dim))
    return ends[:BASE], ends[BASE:], np.concatenate(varied)


def sobol_indices(
    base: Array, far: Array, varied: Array, slopes: Array | None, names: Sequence[str], rng: np.random.Generator
) -> SobolIndices:
    """Estimate Sobol' indices of losses, shapes (base,), (base,) and (base, dim), and bounds by `slopes`.

    Intervals are a bootstrap over base points, of which those without all losses are left out.
    """
    failed = sum(int((~np.isfinite(one)).sum()) for one in (base, far, varied))
    there = np.isfinite(base) & np.isfinite(far) & np.isfinite(varied).all(axis=1)
    base, far, varied = base[there], far[there], varied[there]
    first, total, bound = (dict[str, Estimate]() for _ in range(3))
    interaction = Estimate(math.nan, math.nan, math.nan)
    if len(base) > 1 and np.ptp(base):
        rows = rng.integers(len(base), size=(RESAMPLES, len(base)))
        drawn = [_indices(base[one], far[one], varied[one]) for one in rows]
        (alone, whole), n = _indices(base, far, varied), len(names)
        first = {names[k]: _interval(float(alone[k]), [one[0][k] for one in drawn]) for k in range(n)}
        total = {names[k]: _interval(float(whole[k]), [one[1][k] for one in drawn]) for k in range(n)}
        interaction = _interval(1 - float(alone.sum()), [1 - float(one[0].sum()) for one in drawn])
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
    """Return upper bounds of total indices: mean squares of slopes by pi^2 times the variance."""
    squares = np.square(slopes) / (math.pi**2 * variance)
    times = rng.multinomial(len(squares), np.full(len(squares), 1 / len(squares)), size=RESAMPLES)
    drawn = times @ squares / len(squares)
    return {name: _interval(float(squares[:, k].mean()), drawn[:, k]) for k, name in enumerate(names)}


def _interval(value: float, drawn: Sequence[float] | Array) -> Estimate:
    """Return a number with the middle 95 % of what a bootstrap drew."""
    low, high = np.quantile(np.asarray(drawn), (0.025, 0.975))
    return Estimate(value, float(low), float(high))


# ---- In words


def _model_rows(found: Exploratory, reach: Exploratory, dim: int, points: int) -> list[FeatureRow]:
    meta, off = found.ela_meta, reach.ela_meta
    kinds = ("lin_simple", "lin_w_interact", "quad_simple", "quad_w_interact")
    names = ("A linear model", "One with products of parameters", "A quadratic model", "One with all its products")
    meanings = (
        "losses lie on a plane",
        "parameters interact in pairs",
        "a parabola for each parameter",
        "squares interact, too",
    )
    rows = []
    for kind, name, meaning, count in zip(kinds, names, meanings, MetaModels.coefficients(dim), strict=True):
        value, near = (getattr(one, f"{kind}_adj_r2") for one in (meta, off))
        said = _percent(value, near) if math.isfinite(value) else UNDETERMINED
        why = f"adjusted R2; 100 %: {meaning}" if math.isfinite(value) else f"{count} coefficients, {points} points"
        rows.append(FeatureRow(f"{name} explains", said, why))
    return [
        *rows,
        FeatureRow(
            "Steepest parameter by the least steep", _number(meta.lin_simple_coef_max_by_min), "of the linear model"
        ),
        FeatureRow("Most curved parameter by the least", _number(meta.quad_simple_cond), "of the quadratic model"),
    ]


def _fitted_row(model: GradientModel) -> FeatureRow:
    kind = f"polynomial of degree {model.degree}{' without products' if model.separable else ''}"
    alone = f"held-out R2; from losses alone {_share(model.losses_alone)}; {model.coefficients} coefficients"
    return FeatureRow(f"With gradients a {kind} explains", _share(model.with_gradients), alone)


def _subspace_rows(found: ActiveSubspace, dim: int) -> list[FeatureRow]:
    leading = ", ".join(f"{name} {part:+.2f}" for name, part in found.leading.items())
    return [
        FeatureRow(
            "Effective dimension", _estimate(found.participation), f"of {dim}: participation ratio of gradients"
        ),
        FeatureRow("Directions with 95 %", _estimate(found.directions, "{:.0f}"), "of the mean squared gradient"),
        FeatureRow("The first direction has", _share(found.shares[0]) if found.shares else UNDETERMINED, leading),
    ]


def _sobol_rows(found: SobolIndices) -> list[FeatureRow]:
    if not found.total:
        return [FeatureRow("Sobol' indices", "cannot tell", f"{found.failed} points failed")]
    largest = sorted(found.total, key=lambda name: -found.total[name].value)[:NAMED]
    rows = [
        FeatureRow(f"Variance by {name}", _share(found.total[name]), f"alone {_share(found.first[name])}")
        for name in largest
    ]
    rows.append(
        FeatureRow("Variance by interactions", _share(found.interaction), f"Sobol' indices at {found.points} points")
    )
    if found.bound:
        said = ", ".join(found.unexplained[:NAMED]) or "none"
        rows.append(FeatureRow("More variance than gradients allow", said, "jumps, or wrong gradients"))
    return rows


def _distance_rows(found: Exploratory, reach: Exploratory, points: int) -> list[FeatureRow]:
    disp, ic, nbc = found.disp, found.ic, found.nbc
    shares = ("02", "05", "10", "25")
    ratios = ", ".join(
        _number(getattr(disp, f"ratio_mean_{one}"), getattr(reach.disp, f"ratio_mean_{one}")) for one in shares
    )
    return [
        FeatureRow("Dispersion of the best 2, 5, 10, 25 %", ratios, f"1 scattered, 0 together; among {points} points"),
        FeatureRow("Information content", _number(ic.h_max, reach.ic.h_max), "of steps to the nearest point left: 0 even, 1 rugged"),
        FeatureRow("Steps that turn back", _percent(ic.m0, reach.ic.m0), "of the same steps"),
        FeatureRow(
            "Nearest point by nearest better", _number(nbc.nn_nb_mean_ratio, reach.nbc.nn_nb_mean_ratio),
            "mean distances; near 1: no funnel is seen",
        ),
        FeatureRow("Loss and how many it attracts", _number(nbc.nb_fitness_cor, reach.nbc.nb_fitness_cor), "correlation; near -1: one funnel"),
    ]  # fmt: skip


def _loss_rows(found: Exploratory, reach: Exploratory) -> list[FeatureRow]:
    losses, off, levels, away = found.ela_distr, reach.ela_distr, found.ela_level, reach.ela_level
    wrong = [
        ", ".join(
            _percent(getattr(levels, f"mmce_{kind}_{one}"), getattr(away, f"mmce_{kind}_{one}")) for one in (10, 25, 50)
        )
        for kind in ("lda", "qda")
    ]
    whole, best = found.fitness_distance_all, found.fitness_distance
    return [
        FeatureRow("Skewness of the losses", _number(losses.skewness, off.skewness), "above 0: few high losses"),
        FeatureRow("Excess kurtosis", _number(losses.kurtosis, off.kurtosis), "0: normal; above: far outliers"),
        FeatureRow("Peaks of their density", f"{losses.number_of_peaks:.0f}", "above 1: plateaus or levels"),
        FeatureRow("Wrong side of a plane", wrong[0], "points below the 10, 25, 50 % quantile, by linear discriminants"),
        FeatureRow("Wrong side of a quadric", wrong[1], "the same, by quadratic ones"),
        FeatureRow(
            "Fitness-distance correlation", _number(whole.fd_correlation, reach.fitness_distance_all.fd_correlation),
            f"1: a cone; of the best 10 %: {_number(best.fd_correlation, reach.fitness_distance.fd_correlation)}",
        ),
        FeatureRow(
            "First component of points and losses", _percent(found.pca.expl_var_PC1_cor_init, reach.pca.expl_var_PC1_cor_init),
            f"of the variance, by correlations; of points alone {_percent(found.pca.expl_var_PC1_cor_x)}",
        ),
    ]  # fmt: skip


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
        return "nothing: the mean is closer"
    value, low, high = (form.format(one).replace("-", "\N{MINUS SIGN}") for one in vars(estimate).values())
    return f"{value} ({low.removesuffix(' %')} to {high})"
