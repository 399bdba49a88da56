"""Exploratory landscape features of a sample over all parameters, as defined by pflacco (Prager & Trautmann 2024).

A feature takes points `x`, shape (point, dim), and losses `y`, shape (point,), both finite. It is NaN where the sample
does not determine it. Fields have pflacco's names of features, with underscores for dots.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ..statistics import student

Array = NDArray[np.float64]
MAX_COEFFICIENTS = 2000  # of a model that is fitted
MAX_POINTS = 4096  # the first ones of a sample, which are measured
BEST, LEVELS = (0.02, 0.05, 0.10, 0.25), (0.10, 0.25, 0.50)  # shares of the sample
NEAR, FOLDS, EXPLAINED = 0.05, 10, 0.9
SIZES = np.insert(10.0 ** np.linspace(-5, 15, 1000), 0, 0.0)  # of slopes, from which on they count as such
SETTLED, HALF = 0.05, 0.5  # Munoz et al. 2015, eqs. 6 and 8
MIN_MASS, POSITIONS = 0.01, 512  # of a peak of the density of losses, and where the density is computed
GROUPS = 10  # that are left out in turn, for intervals


@dataclass(frozen=True)
class MetaModels:
    """Adjusted R2 of least squares models, and the magnitudes of their coefficients (Mersmann et al. 2011).

    `lin_w_interact` has products of two parameters. `quad_simple` has squares. `quad_w_interact` has the products of
    any two of the parameters and of their squares, so also cubic terms. `quad_simple_cond` is the largest coefficient
    of a square over the smallest.
    """

    lin_simple_adj_r2: float
    lin_simple_intercept: float
    lin_simple_coef_min: float
    lin_simple_coef_max: float
    lin_simple_coef_max_by_min: float
    lin_w_interact_adj_r2: float
    quad_simple_adj_r2: float
    quad_simple_cond: float
    quad_w_interact_adj_r2: float

    @classmethod
    def of(cls, x: Array, y: Array) -> MetaModels:
        """Fit the models."""
        dim = x.shape[1]
        i, j = np.triu_indices(dim, 1)
        both = np.hstack([x, x**2])
        k, m = np.triu_indices(2 * dim, 1)
        linear, quadratic = _fit(x, y), _fit(both, y)
        sizes, squares = np.abs(linear.coefficients), np.abs(quadratic.coefficients[dim:])
        intercept = float(y.mean() - x.mean(axis=0) @ linear.coefficients)
        least, most = float(sizes.min()), float(sizes.max())
        crossed = _fit_products(x, i, j, y)
        return cls(
            linear.adjusted, intercept, least, most, _ratio(most, least), crossed, quadratic.adjusted,
            _ratio(float(squares.max()), float(squares.min())), _fit_products(both, k, m, y),
        )  # fmt: skip

    @staticmethod
    def coefficients(dim: int) -> tuple[int, int, int, int]:
        """Return the number of coefficients of each model without its intercept, the simplest first."""
        return dim, dim + dim * (dim - 1) // 2, 2 * dim, 2 * dim + dim * (2 * dim - 1)


@dataclass(frozen=True)
class Dispersion:
    """Distances among the best 2, 5, 10 and 25 % of the points against those among all (Lunacek & Whitley 2006)."""

    ratio_mean_02: float
    ratio_mean_05: float
    ratio_mean_10: float
    ratio_mean_25: float
    ratio_median_02: float
    ratio_median_05: float
    ratio_median_10: float
    ratio_median_25: float
    diff_mean_02: float
    diff_mean_05: float
    diff_mean_10: float
    diff_mean_25: float
    diff_median_02: float
    diff_median_05: float
    diff_median_10: float
    diff_median_25: float

    @classmethod
    def of(cls, distances: Array, y: Array) -> Dispersion:
        """Compare distances, shape (point, point)."""
        best = [distances[np.ix_(low, low)] for low in (y <= np.quantile(y, BEST)[:, None])]
        found, middles = [], (np.mean, np.median)
        for middle in middles:
            whole, parts = float(middle(_pairs(distances))), [_middle(part, middle) for part in best]
            found.append(([part / whole for part in parts], [part - whole for part in parts]))
        (mean_ratios, mean_differences), (median_ratios, median_differences) = found
        return cls(*mean_ratios, *median_ratios, *mean_differences, *median_differences)


@dataclass(frozen=True)
class InformationContent:
    """Entropy of ups and downs along a tour from each point to the nearest remaining one (Munoz et al. 2015).

    `h_max` is the largest entropy over the thresholds above which a slope counts, and `eps_max` that threshold. From
    `eps_s` on (log10) the entropy is below 0.05. `m0` is the share of steps that turn back, and `eps_ratio` (log10) the
    largest threshold with more than half of that.
    """

    h_max: float
    eps_s: float
    eps_max: float
    eps_ratio: float
    m0: float

    @classmethod
    def of(cls, distances: Array, y: Array) -> InformationContent:
        """Walk the tour from the first point on."""
        entropy, partial = walk_information(distances, y)
        settled, half = SIZES[entropy < SETTLED], SIZES[partial > HALF * partial[0]]
        largest = float(entropy.max())
        eps_max = float(np.median(SIZES[entropy == largest]))
        return cls(largest, _log10(settled[:1]), eps_max, _log10(half[-1:]), float(partial[0]))


@dataclass(frozen=True)
class NearestBetter:
    """Distances to the nearest point against those to the nearest better point (Kerschke et al. 2015)."""

    nn_nb_sd_ratio: float
    nn_nb_mean_ratio: float
    nn_nb_cor: float
    dist_ratio_coeff_var: float
    nb_fitness_cor: float

    @classmethod
    def of(cls, distances: Array, y: Array) -> NearestBetter:
        """Compare distances, shape (point, point)."""
        others = distances.copy()
        np.fill_diagonal(others, np.inf)
        near = others.min(axis=1)
        masked = np.where(y[None, :] < y[:, None], others, np.inf)
        nearest, better = masked.argmin(axis=1), masked.min(axis=1)
        for row in np.flatnonzero(~np.isfinite(better)):  # none is better: the nearest as good one that is not close by
            level = np.where(y == y[row], others[row], np.inf)
            level[np.argsort(others[row])[: math.ceil(NEAR * len(y)) - 1]] = np.inf
            nearest[row], better[row] = level.argmin(), level.min()
        known = np.isfinite(better)
        pointed = np.bincount(nearest[known], minlength=len(y)).astype(float)
        better = np.where(known, better, near)
        ratio = near / better
        return cls(
            float(near.std(ddof=1) / better.std(ddof=1)),
            float(near.mean() / better.mean()),
            _correlation(near, better),
            float(ratio.std(ddof=1) / ratio.mean()),
            _correlation(pointed, y),
        )


@dataclass(frozen=True)
class LossDistribution:
    """Skewness and excess kurtosis of the losses, and the number of peaks of their density with 1 % or more of them.

    pflacco adds the width of a peak to its mean density, where their product is the share of the losses. So
    `number_of_peaks` differs from pflacco's.
    """

    skewness: float
    kurtosis: float
    number_of_peaks: float

    @classmethod
    def of(cls, y: Array) -> LossDistribution:
        """Measure the losses."""
        off, n = y - y.mean(), len(y)
        skewness = (off**3).mean() / off.std(ddof=1) ** 3
        kurtosis = (off**4).mean() / off.std(ddof=1) ** 4 - 3
        return cls(float(skewness), float(kurtosis), float(_peaks(y)) if n else math.nan)


@dataclass(frozen=True)
class LevelSets:
    """Share of points that linear and quadratic discriminants put on the wrong side of a quantile of the losses.

    Cross-validated in ten parts (Mersmann et al. 2011), below 10, 25 and 50 %.
    """

    mmce_lda_10: float
    mmce_qda_10: float
    lda_qda_10: float
    mmce_lda_25: float
    mmce_qda_25: float
    lda_qda_25: float
    mmce_lda_50: float
    mmce_qda_50: float
    lda_qda_50: float

    @classmethod
    def of(cls, x: Array, y: Array) -> LevelSets:
        """Classify the points."""
        found = list[float]()
        for level in LEVELS:
            linear, quadratic = _misclassified(x, y < np.quantile(y, level))
            found += [linear, quadratic, _ratio(linear, quadratic)]
        return cls(*found)


@dataclass(frozen=True)
class FitnessDistance:
    """Losses against distances from the best point (Jones & Forrest 1995): 1 for a cone.

    pflacco divides the covariance by n and the deviations by n - 1, so its correlations and covariances are smaller by
    (n - 1)/n.
    """

    fd_correlation: float
    fd_cov: float
    distance_mean: float
    distance_std: float
    fitness_mean: float
    fitness_std: float

    @classmethod
    def of(cls, x: Array, y: Array, share: float) -> FitnessDistance:
        """Measure a share of the points, the best ones."""
        count = round(share * len(y))
        best = np.argsort(y, kind="stable")[:count]
        x, y = x[best], y[best]
        if count < 2:
            return cls(*[math.nan] * 6)
        away = np.linalg.norm(x - x[0], axis=1)
        covariance = float((away - away.mean()) @ (y - y.mean()) / (count - 1))
        deviations = float(away.std(ddof=1)), float(y.std(ddof=1))
        correlation = _ratio(covariance, math.prod(deviations))
        return cls(correlation, covariance, float(away.mean()), deviations[0], float(y.mean()), deviations[1])


@dataclass(frozen=True)
class PrincipalComponents:
    """Share of the components that explain 90 % of the variance, and the variance explained by the first one.

    Of the points (`x`), and of points with their losses (`init`), by covariances and by correlations.
    """

    expl_var_cov_x: float
    expl_var_cor_x: float
    expl_var_cov_init: float
    expl_var_cor_init: float
    expl_var_pc1_cov_x: float
    expl_var_pc1_cor_x: float
    expl_var_pc1_cov_init: float
    expl_var_pc1_cor_init: float

    @classmethod
    def of(cls, x: Array, y: Array) -> PrincipalComponents:
        """Decompose covariances and correlations."""
        tables = [
            relation(of, rowvar=False) for of in (x, np.column_stack([x, y])) for relation in (np.cov, np.corrcoef)
        ]
        shares = [np.linalg.eigvalsh(np.atleast_2d(table))[::-1] / np.trace(np.atleast_2d(table)) for table in tables]
        counts = [(int((np.cumsum(share) < EXPLAINED).sum()) + 1) / len(share) for share in shares]
        return cls(*counts, *(float(share[0]) for share in shares))


@dataclass(frozen=True)
class Exploratory:
    """All exploratory features of a sample."""

    ela_meta: MetaModels
    disp: Dispersion
    ic: InformationContent
    nbc: NearestBetter
    ela_distr: LossDistribution
    ela_level: LevelSets
    fitness_distance: FitnessDistance
    fitness_distance_all: FitnessDistance
    pca: PrincipalComponents

    @classmethod
    def of(cls, x: Array, y: Array) -> Exploratory:
        """Measure the first 4096 of the points `x`, shape (point, dim), with losses `y`, shape (point,)."""
        x, y = x[:MAX_POINTS], y[:MAX_POINTS]
        return cls._of(x, y, distances_of(x))

    @classmethod
    def _of(cls, x: Array, y: Array, distances: Array) -> Exploratory:
        with np.errstate(divide="ignore", invalid="ignore"):
            return cls(
                ela_meta=MetaModels.of(x, y),
                disp=Dispersion.of(distances, y),
                ic=InformationContent.of(distances, y),
                nbc=NearestBetter.of(distances, y),
                ela_distr=LossDistribution.of(y),
                ela_level=LevelSets.of(x, y),
                fitness_distance=FitnessDistance.of(x, y, 0.1),
                fitness_distance_all=FitnessDistance.of(x, y, 1.0),
                pca=PrincipalComponents.of(x, y),
            )

    @classmethod
    def reach(cls, x: Array, y: Array) -> Exploratory:
        """Return the half-width of the 95 % interval of each feature.

        Delete-a-group jackknife over ten groups of points, with Student's distribution. NaN where fewer points do not
        determine a feature.
        """
        x, y = x[:MAX_POINTS], y[:MAX_POINTS]
        distances, groups, parts = distances_of(x), np.arange(len(y)) % GROUPS, list[list[float]]()
        for one in range(GROUPS):
            left = np.flatnonzero(groups != one)
            parts.append(list(cls._of(x[left], y[left], distances[np.ix_(left, left)]).values()))
        error = np.sqrt((GROUPS - 1) * np.var(parts, axis=0))
        reaches = iter((error * float(student(GROUPS - 1))).tolist())
        kinds = get_type_hints(cls)
        return cls(
            **{one.name: kinds[one.name](*(next(reaches) for _ in fields(kinds[one.name]))) for one in fields(cls)}
        )

    def values(self) -> Iterator[float]:
        """Yield all features, in the order of the fields."""
        for one in fields(self):
            yield from astuple(getattr(self, one.name))


# ---- Models


@dataclass(frozen=True)
class _Fit:
    coefficients: Array
    adjusted: float


def _fit(columns: Array, y: Array) -> _Fit:
    """Fit y by an intercept and columns, shape (point, column); NaN where the points are too few for that."""
    from scipy.linalg import lstsq

    n, p = columns.shape
    if n < p + 2 or p > MAX_COEFFICIENTS:
        return _Fit(np.full(p, np.nan), math.nan)
    centred, off = columns - columns.mean(axis=0), y - y.mean()
    coefficients, _, _, _ = lstsq(centred, off, lapack_driver="gelsd" if p < 500 else "gelsy")
    left = float(((off - centred @ coefficients) ** 2).sum() / (off**2).sum())
    return _Fit(coefficients, 1 - left * (n - 1) / (n - p - 1))


def _fit_products(x: Array, i: NDArray[np.int_], j: NDArray[np.int_], y: Array) -> float:
    """Return the adjusted R2 of a model with columns and their products; NaN where they are too many."""
    p = x.shape[1] + len(i)
    if len(y) < p + 2 or p > MAX_COEFFICIENTS:
        return math.nan
    return _fit(np.hstack([x, x[:, i] * x[:, j]]), y).adjusted


# ---- Distances


def distances_of(x: Array) -> Array:
    """Return the distances between points, shape (point, point)."""
    from scipy.spatial.distance import pdist, squareform

    found: Array = squareform(pdist(x))
    return found


def _pairs(distances: Array) -> Array:
    """Return the distances above zero of a square table."""
    found: Array = distances[np.triu_indices(len(distances), 1)]
    return found[found > 0]


def _middle(distances: Array, middle: Callable[[Array], Any]) -> float:
    known = _pairs(distances)
    return float(middle(known)) if len(known) else math.nan


def walk_information(distances: Array, y: Array, unit: float = 1.0) -> tuple[Array, Array]:
    """Return entropy and share of turns of a walk by the threshold for slopes, shapes (size,) of `SIZES`.

    Losses count in a `unit`. From the first point, the walk always goes to the nearest remaining one (Munoz et al.
    2015, eqs. 6 to 10).
    """
    left, order = np.ones(len(y), bool), [0]
    for _ in range(len(y) - 1):
        left[order[-1]] = False
        order.append(int(np.where(left, distances[order[-1]], np.inf).argmin()))
    slopes = np.diff(y[order]) / unit / distances[order[:-1], order[1:]]
    signs, sizes = np.sign(slopes).astype(np.int8), np.abs(slopes)
    _, first, same = np.unique(np.searchsorted(np.sort(sizes), SIZES), return_index=True, return_inverse=True)
    found = np.array([_information(np.where(sizes < size, 0, signs)) for size in SIZES[first]])
    entropy, partial = found[same].T
    return entropy, partial


def _information(signs: NDArray[np.int8]) -> tuple[float, float]:
    """Return the entropy of unequal neighbours, and the share of turns, of steps -1, 0, 1 (Munoz et al. 2015)."""
    pairs = 3 * signs[:-1] + signs[1:]
    counts = np.bincount(pairs[signs[:-1] != signs[1:]] + 4, minlength=9)
    shares = counts[counts > 0] / len(pairs)
    moved = signs[signs != 0]
    return float(-(shares * np.log(shares)).sum() / math.log(6)), int((np.diff(moved) != 0).sum()) / len(pairs)


# ---- Losses


def _peaks(y: Array) -> int:
    """Count the peaks of the density of losses that contain 1 % or more of them."""
    from scipy.stats import gaussian_kde

    kernel = gaussian_kde(y)
    beyond = 3 * kernel.covariance_factor() * y.std(ddof=1)
    at = np.linspace(y.min() - beyond, y.max() + beyond, POSITIONS)
    density = kernel(at)
    valleys = np.flatnonzero((density[1:-1] < density[:-2]) & (density[1:-1] < density[2:])) + 1
    masses = [part.sum() for part in np.split(density / density.sum(), valleys)]
    return sum(mass >= MIN_MASS for mass in masses)


def _misclassified(x: Array, low: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the share of points in the wrong class by linear and quadratic discriminants, in ten held-out parts."""
    if min(low.sum(), (~low).sum()) < FOLDS:
        return math.nan, math.nan
    x, fold, wrong = x - x.mean(axis=0), _stratify(low), list[tuple[float, float]]()
    parts = [[_Moments.of(x[(fold == one) & (low == side)]) for one in range(FOLDS)] for side in (False, True)]
    for one, test in enumerate(fold == np.arange(FOLDS)[:, None]):
        classes = [_Moments.total(part[:one] + part[one + 1 :]) for part in parts]
        pooled = (classes[0].scatter + classes[1].scatter) / (classes[0].count + classes[1].count - 2)
        separate = [each.scatter / (each.count - 1) for each in classes]
        said = (
            _likelier(classes, [pooled, pooled], x[test])
            if sum(each.count for each in classes) > x.shape[1] + 1
            else None,
            _likelier(classes, separate, x[test]) if min(each.count for each in classes) > x.shape[1] else None,
        )
        wrong.append(tuple(math.nan if a is None else float((a != low[test]).mean()) for a in said))  # type: ignore[arg-type]
    linear, quadratic = np.mean(wrong, axis=0)
    return float(linear), float(quadratic)


def _stratify(low: NDArray[np.bool_]) -> NDArray[np.int_]:
    """Return the fold of each point, with equal shares of both classes, each in its order.

    The class of the first point is dealt out first, as in scikit-learn.
    """
    first = low == low[0]
    order = np.sort(~first)
    fold = np.empty(len(low), int)
    for members, second in ((first, False), (~first, True)):
        fold[members] = np.repeat(np.arange(FOLDS), [int((order[k::FOLDS] == second).sum()) for k in range(FOLDS)])
    return fold


@dataclass(frozen=True, eq=False)
class _Moments:
    """Count, sum and sum of squares of points of one class, shapes (), (dim,) and (dim, dim)."""

    count: int
    sum: Array
    squares: Array

    @classmethod
    def of(cls, x: Array) -> _Moments:
        """Sum up points."""
        return cls(len(x), x.sum(axis=0), x.T @ x)

    @classmethod
    def total(cls, parts: Sequence[_Moments]) -> _Moments:
        """Add parts of the points."""
        squares = np.sum([part.squares for part in parts], axis=0)
        return cls(sum(part.count for part in parts), np.sum([part.sum for part in parts], axis=0), squares)

    @property
    def mean(self) -> Array:
        """The mean point."""
        return self.sum / self.count

    @property
    def scatter(self) -> Array:
        """Sum of squares about the mean."""
        found: Array = self.squares - np.outer(self.sum, self.mean)
        return found


def _likelier(classes: Sequence[_Moments], tables: Sequence[Array], at: Array) -> NDArray[np.bool_] | None:
    """Say which points are more probably of the second class, by Gaussians of these covariances; None if degenerate."""
    from scipy.linalg import solve_triangular

    scores = []
    for each, table in zip(classes, tables, strict=True):
        try:
            root = np.linalg.cholesky(table)
        except np.linalg.LinAlgError:
            return None
        away = np.square(solve_triangular(root, (at - each.mean).T, lower=True)).sum(axis=0)
        scores.append(math.log(each.count) - away / 2 - np.log(np.diag(root)).sum())
    return np.asarray(scores[1] > scores[0])


# ---- Numbers


def _correlation(a: Array, b: Array) -> float:
    return float(np.corrcoef(a, b)[0, 1])


def _ratio(a: float, b: float) -> float:
    return a / b if b else math.nan


def _log10(sizes: Array) -> float:
    return math.log10(sizes[0]) if len(sizes) and sizes[0] > 0 else math.nan
