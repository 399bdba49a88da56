"""Polynomials fitted to losses and gradients, and the share of held-out points that they explain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from ..statistics import RESAMPLES, UNKNOWN, Estimate, middle_95
from .exploratory import MAX_COEFFICIENTS, MAX_POINTS, Array

FOLDS, ROUNDS = 10, 3  # parts of the points that are held out, and rounds of weighting
PROBES = 16  # random vectors, for the trace of a matrix
MAX_DEGREE, MAX_WEIGHT = 4, 1e6


@dataclass(frozen=True)
class GradientModel:
    """Held-out R2 of a polynomial with `coefficients`, fitted to losses alone and with their gradients.

    A `separable` one has no products of parameters. `of_gradients` is the R2 of the model's gradients. An equation of a
    gradient has `weight` times that of a loss: the ratio of the residual variances (feasible generalised least
    squares).
    """

    degree: int
    separable: bool
    coefficients: int
    losses_alone: Estimate
    with_gradients: Estimate
    of_gradients: Estimate
    weight: float


def degrees_of(dim: int) -> list[tuple[int, int]]:
    """Return the degrees of the fitted polynomials, and the number of coefficients of each.

    Where squares and products of all parameters are too many, that of degree 2 has only squares.
    """
    counts = [(degree, math.comb(dim + degree, degree)) for degree in range(1, MAX_DEGREE + 1)]
    counts[1] = counts[1] if counts[1][1] <= MAX_COEFFICIENTS else (2, 1 + 2 * dim)
    return [(degree, count) for degree, count in counts if count <= MAX_COEFFICIENTS]


def fit_with_gradients(x: Array, y: Array, slopes: Array, rng: np.random.Generator) -> tuple[GradientModel, ...]:
    """Fit polynomials to losses, shape (point,), and gradients, shape (point, dim), and test them on other points.

    One for each degree up to 4, with no more coefficients than data.
    """
    x, y, slopes = 2 * x[:MAX_POINTS] - 1, y[:MAX_POINTS], slopes[:MAX_POINTS] / 2  # parameters from -1 to 1
    found, dim = list[GradientModel](), x.shape[1]
    for degree, count in degrees_of(dim):
        model = _Polynomial.of(x, degree, separable=count < math.comb(dim + degree, degree))
        found.append(_hold_out(model, y, slopes, rng))
    return tuple(found)


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
    alone_explains, both_explain = (_explained(np.square(one), np.square(off_mean), rng) for one in (off_alone, off))
    of_slopes = _explained(np.square(slope_off).sum(axis=1), np.square(slope_mean).sum(axis=1), rng)
    return GradientModel(
        degree=model.degree,
        separable=model.separable,
        coefficients=model.values.shape[1],
        losses_alone=alone_explains,
        with_gradients=both_explain,
        of_gradients=of_slopes,
        weight=float(np.median(weights)),
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
        """Fit the model with the weight that its own residuals give by their degrees of freedom, and return both."""
        weight, least = 1.0, np.finfo(float).eps * float(np.square(y).mean())
        for _ in range(ROUNDS):
            found, used = equations.solve(weight), equations.used_by_losses(weight)
            off, slope_off = np.square(y - self.losses(found))[rows], np.square(slopes - self.slopes(found))[rows]
            left = max(off.size - used, 1.0), max(slope_off.size - (len(found) - used), 1.0)
            ratio = (float(off.sum()) / left[0] + least) / (float(slope_off.sum()) / left[1] + least)
            weight = min(max(ratio, 1 / MAX_WEIGHT), MAX_WEIGHT)
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
        return self._solve(weight, self.right + weight * self.slopes_right)

    def used_by_losses(self, weight: float) -> float:
        """Return how many coefficients the losses determine, rather than the gradients: a trace by random vectors."""
        probes = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(self.right), PROBES))
        return float((probes * self._solve(weight, self.losses @ probes)).sum() / PROBES)

    def _solve(self, weight: float, right: Array) -> Array:
        from scipy.linalg import LinAlgError, solve

        if self.points * (1 + self.dim * (weight > 0)) <= len(right):
            return np.full_like(right, np.nan)
        try:
            found: Array = solve(self.losses + weight * self.slopes, right, assume_a="pos")
        except LinAlgError:
            return np.full_like(right, np.nan)
        return found


def _without(factors: tuple[int, ...], axis: int) -> tuple[int, ...]:
    at = factors.index(axis)
    return factors[:at] + factors[at + 1 :]


def _explained(left: Array, whole: Array, rng: np.random.Generator) -> Estimate:
    """Return 1 - sum of `left` by sum of `whole`, shapes (point,), with its bootstrap interval over points."""
    if not np.isfinite(left).all() or not whole.sum():
        return UNKNOWN
    rows = rng.integers(len(left), size=(RESAMPLES, len(left)))
    return middle_95(1 - float(left.sum() / whole.sum()), 1 - left[rows].sum(axis=1) / whole[rows].sum(axis=1))
