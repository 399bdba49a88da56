"""The Hessian of an objective at a point, in box units: by differences, with a chosen step and an error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .objective import Evaluation, Objective, Status, in_box
from .sampling.memory import MemoryBound
from .statistics import Estimate, mean, ratio
from .verification import LAST_PLACE

Array = NDArray[np.float64]
Arrays = Mapping[str, Any]
Keep = Callable[[str, Callable[[], Arrays]], Arrays]  # keep(name, compute): what was computed before, or is now

QUARTER = 4.0  # the ratio of neighbouring steps: a power of two, so that steps are exact
STEPS = tuple(QUARTER**-k for k in range(2, 11))  # of the box, 0.06 to 1e-6
SAFETY = 2.0  # an error by its change to a quarter of the step: 16/15 where it goes with the step squared, and a margin
SURPRISE, SMALL = 10.0, 1e-6  # changes, by those along the tried directions and by the largest eigenvalue: look again
EDGE = QUARTER**-5  # the least distance from the bounds: a point that is nearer is moved inwards
FINE = 64  # roundings of a parameter that are the least step
TRIED = {"gradients": 2, "losses": 4}  # directions along which steps are tried
MATRIX, LOSSES = 100, 30  # most parameters of the whole matrix by gradients, and by losses
LANCZOS = 32  # Lanczos steps from each probe
RESTARTS, VECTORS, LEAST_TOLERANCE = 12, 40, 1e-6  # of ARPACK: at most, kept at once, and of half the spectrum's range
REPEATS, NOISE = 8, 18  # that tell the noise of the loss at the point, and the episodes which that takes
DEVIATIONS = 5.0  # of that noise, by which losses may seem to curve otherwise
ROUNDING = float(np.finfo(np.float64).eps)
SAID = 3  # points that an error names, and parameters of each


class FailedPointsError(ValueError):
    """Points that the Hessian needs have failed."""


@dataclass(frozen=True)
class StepChange:
    """The change of products with the Hessian [loss unit] from a step [box] to a quarter of it."""

    step: float
    change: float


@dataclass(frozen=True, eq=False)
class Differences:
    """Second derivatives along unit directions, by steps: NaN where a point failed.

    `product` [loss unit] of the Hessian with each direction, by gradients, shape (step, direction, dim), without
    columns where there are none. `curvature` [loss unit] along each direction, by losses, shape (step, direction).
    """

    product: Array
    curvature: Array

    @property
    def by_gradients(self) -> bool:
        """Whether there are gradients."""
        return bool(self.product.shape[-1])

    @property
    def known(self) -> Array:
        """The values compared between steps: products, or curvatures of losses, shape (step, value)."""
        return (self.product if self.by_gradients else self.curvature).reshape(len(self.curvature), -1)


class Curvature:
    """Differences of an objective around a point `z` of the unit box; losses in their unit, lengths in box units.

    They are differences of gradients, or of losses where the objective has none. A point within `EDGE` of a bound is
    moved inwards, by at most `moved`, unless the objective allows points outside. `keep` stores results by name. Raises
    ValueError for a point outside the bounds.
    """

    def __init__(self, objective: Objective, x: Float[Tensor, " dim"], *, keep: Keep | None = None) -> None:
        space = objective.space
        self.objective, self.names = MemoryBound(objective), space.names
        self.lower, self.width = space.lower.numpy(), (space.upper - space.lower).numpy()
        given = (x.numpy() - self.lower) / self.width
        if not objective.beyond_box and not bool(in_box(space, x[None]).all()):
            raise ValueError(f"{objective.name} has no Hessian outside its bounds; got point {x.tolist()}")
        self.z = given if objective.beyond_box else np.clip(given, EDGE, 1 - EDGE)
        self.moved = float(np.abs(self.z - given).max())
        self.keep: Keep = keep or (lambda name, compute: compute())
        self.episodes = 0
        self.failures: list[str] = []
        self.follow: Callable[[int], None] = lambda episodes: None

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.z)

    @cached_property
    def centre(self) -> Arrays:
        """The `loss` and the gradient `grad` at the point, the latter of shape (0,) where there is none, and `why`.

        Raises FailedPointsError where the point itself fails. Raises ValueError where it has no gradients and too many
        parameters for differences of losses.
        """
        found = self._part("centre", self._centre)
        self.count(1)
        if not np.isfinite(found["loss"]) or not np.isfinite(found["grad"]).all():
            raise FailedPointsError(f"{self.objective.name} has no finite loss and gradient at this point: {self._bad}")
        return found

    @property
    def source(self) -> str:
        """The quantity that is differenced: gradients or losses."""
        return "gradients" if len(self.centre["grad"]) else "losses"

    @property
    def whole(self) -> bool:
        """Whether the whole matrix is computed, not only products with it."""
        return self.source == "losses" or self.dim <= MATRIX

    def _at(self, offsets: Array, *, grad: bool) -> dict[str, Any]:
        """Return losses, shape (point,), and gradients in box units, shape (point, dim), at offsets from the point.

        Failed ones are NaN; `failed` describes them. Without gradients there are no columns.
        """
        points = torch.from_numpy(self.lower + (self.z + offsets) * self.width)
        parts = torch.split(points, self.objective.preferred_batch)
        done = [self.objective.evaluate(part, grad=grad) for part in parts]
        found = Evaluation.join(done, dim=self.dim, grad=grad)
        slope = np.zeros((len(offsets), 0)) if found.grad is None else found.grad.numpy() * self.width
        return {"loss": found.loss.numpy(), "grad": slope, "failed": np.array(self._describe_failed(found, offsets))}

    def differences(self, directions: Array, steps: Sequence[float], name: str) -> Differences:
        """Return central differences along unit directions, shape (direction, dim), with each of some steps [box].

        Parts of the work are stored under the name and a number, each with the directions of one batch.
        """
        grad = self.source == "gradients"
        size = max(1, self.objective.preferred_batch // (2 * len(steps)))
        parts = []
        for number, start in enumerate(range(0, len(directions), size)):
            rows = directions[start : start + size]
            parts.append(self._part(f"{name}-{number}", lambda rows=rows: self._differences(rows, steps, grad)))  # type: ignore[misc]
            self.count(2 * len(steps) * len(rows))
        product, curvature = (np.concatenate([part[key] for part in parts], axis=1) for key in ("product", "curvature"))
        return Differences(product, curvature)

    def count(self, episodes: int) -> None:
        """Count episodes, and report the progress."""
        self.episodes += episodes
        self.follow(self.episodes)

    def refuse_failed(self, values: Array) -> Array:
        """Return values that are all finite. Raises FailedPointsError where some are not."""
        if not np.isfinite(values).all():
            raise FailedPointsError(
                f"{self.objective.name} failed near this point, so it has no Hessian there: {self._bad}; choose "
                "another point with --through"
            )
        return values

    def ladder(self, *, seed: int = 0) -> list[StepChange]:
        """Return the change of second derivatives along a few random directions from each step to a quarter of it.

        Steps that leave the box, that rounding of a parameter spoils, or at which a point fails are left out. Raises
        FailedPointsError where none remains.
        """
        room = float("inf") if self.objective.beyond_box else float(np.minimum(self.z, 1 - self.z).min())
        precision, count = str(self.centre["precision"]), min(self.dim, TRIED[self.source])
        size = np.maximum(np.abs(self.lower), np.abs(self.lower + self.width)) / self.width
        least = FINE * LAST_PLACE[precision] * float(size.max())
        steps = [step for step in STEPS if least <= step <= room]
        if len(steps) < 2:
            steps = [min(max(EDGE, least), room) / by for by in (1, QUARTER)]
        directions = _unit(np.random.default_rng(seed).standard_normal((count, self.dim)))
        known = self.differences(directions, steps, "ladder").known
        change = np.linalg.norm(known[1:] - known[:-1], axis=1)
        found = [StepChange(step, float(one)) for step, one in zip(steps, change, strict=False) if np.isfinite(one)]
        if not found:
            self.refuse_failed(known)
        return found

    def _part(self, name: str, compute: Callable[[], Arrays]) -> Arrays:
        """Return a part of the work, and record which of its points failed."""
        found = self.keep(name, compute)
        self.failures.extend(found["failed"].tolist())
        return found

    def _centre(self) -> Arrays:
        zero, why = np.zeros((1, self.dim)), ""
        try:
            found = self._at(zero, grad=True)
        except ValueError as error:  # it has none
            found, why = self._at(zero, grad=False), str(error)
            if self.dim > LOSSES:
                raise ValueError(
                    f"{self.objective.name} has no gradients ({error}); differences of losses take at most {LOSSES} "
                    f"parameters, and it has {self.dim}; give it gradients (gs.from_torch, gs.from_jax, or "
                    "gs.from_numpy of a function that also returns them)"
                ) from None
        known = {"loss": found["loss"][0], "grad": found["grad"][0], "failed": found["failed"], "why": np.array(why)}
        return {**known, "precision": np.array(self.objective.precision)}  # which losses tell, of some

    def _differences(self, directions: Array, steps: Sequence[float], grad: bool) -> Arrays:
        away = np.array(steps)[:, None, None] * directions
        found = self._at(np.stack([away, -away]).reshape(-1, self.dim), grad=grad)
        ahead, behind = found["loss"].reshape(2, len(steps), -1)
        slopes = found["grad"].reshape(2, len(steps), len(directions), -1)
        h = np.array(steps)[:, None]
        return {
            "product": (slopes[0] - slopes[1]) / (2 * h[..., None]),
            "curvature": (ahead - 2 * self.centre["loss"] + behind) / h**2,
            "failed": found["failed"],
        }

    def _describe_failed(self, found: Evaluation, offsets: Array) -> list[str]:
        said = []
        for row in torch.nonzero(found.status != Status.OK).ravel().tolist():
            largest = np.argsort(-np.abs(offsets[row]), kind="stable")[:SAID]
            moved = ", ".join(f"{self.names[at]} {offsets[row, at]:+.2g}" for at in largest if offsets[row, at])
            where = f"at {moved} of the box from there" if moved else "there"
            why = f" ({found.error})" if found.error and found.status[row] == Status.ERROR else ""
            said.append(f"{Status(int(found.status[row])).name} {where}{why}")
        return said

    @property
    def _bad(self) -> str:
        """The first few failed points, in words."""
        more = len(self.failures) - SAID
        return "; ".join(self.failures[:SAID]) + (f"; and {more} more points" if more > 0 else "")


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues [loss unit] of a Hessian in box units, descending, with their errors.

    `values`, shape (pair,), with unit `vectors`, shape (pair, dim): all, or those at both ends. `residual` |Hv - value
    v| and `difference`, the change of Hv with the step, shapes (pair,). `by_losses`, the curvature of losses along a
    vector, and its `loss_error`; NaN where not measured. `nodes` and `weights` are Ritz values by probe and their
    shares of the spectrum, shape (probe, step), empty for a whole matrix. `ladder` is the change of second derivatives
    at each step, and `step` is the one used.
    """

    step: float
    ladder: tuple[StepChange, ...]
    values: Array
    vectors: Array
    residual: Array
    difference: Array
    by_losses: Array
    loss_error: float
    trace: Estimate
    asymmetry: float
    asymmetry_explained: float
    nodes: Array
    weights: Array

    @property
    def disputed(self) -> NDArray[np.bool_]:
        """Which eigenvalues the losses contradict by more than the errors of both."""
        return np.abs(self.by_losses - self.values) > self._own_error + self.loss_error

    @property
    def error(self) -> Array:
        """The largest distance of an eigenvalue from each value [loss unit], shape (pair,).

        A symmetric matrix has an eigenvalue within |Hv - value v| of any value (Parlett 1998, theorem 4.5.1). The error
        of Hv itself, contradictions by losses, and rounding are added.
        """
        return np.where(self.disputed, np.abs(self.by_losses - self.values), self._own_error)

    @property
    def _own_error(self) -> Array:
        rounded = ROUNDING * self.vectors.shape[1] * float(np.abs(self.values).max())
        error: Array = self.residual + SAFETY * self.difference + rounded
        return error


def measure_spectrum(curvature: Curvature, *, pairs: int, probes: int, seed: int = 0) -> Spectrum:
    """Return the Hessian's spectrum, at the step of the ladder where differences change least.

    The next best step is also tried if points fail at this step. The same happens if differences change far more than
    along the tested directions, as at a kink that these miss. Raises FailedPointsError where points fail at all steps,
    ValueError where the objective has no gradients and too many parameters.
    """
    ladder = tuple(curvature.ladder(seed=seed))
    best: Spectrum | None = None
    for number, tried in enumerate(sorted(ladder, key=lambda one: one.change)):
        try:
            if curvature.whole:
                found = _whole_spectrum(curvature, tried.step, ladder, pairs)
            else:
                found = _partial_spectrum(curvature, tried.step, ladder, pairs, probes, seed)
        except FailedPointsError:
            if best is None and number + 1 == len(ladder):
                raise
            continue
        if best is None or found.error.max() < best.error.max():
            best = found
        change, expected = found.difference.max(), SURPRISE * curvature.dim * tried.change
        if change <= max(expected, SMALL * np.abs(found.values).max()):
            break
    if best is None:
        raise FailedPointsError(f"{curvature.objective.name} failed near this point at every step")
    return best


def _whole_spectrum(curvature: Curvature, step: float, ladder: tuple[StepChange, ...], pairs: int) -> Spectrum:
    """Return all eigenvalues of the symmetric part of the matrix."""
    both = curvature.refuse_failed(_matrix(curvature, step))
    raw, change = both[0], both[0] - both[1]
    symmetric, skew = (raw + raw.T) / 2, (raw - raw.T) / 2
    values, columns = np.linalg.eigh(symmetric)
    values, vectors = values[::-1], _oriented(columns.T[::-1])
    residual, difference = (np.linalg.norm(vectors @ one.T, axis=1) for one in (skew, change))
    shown = ends(len(values), pairs)
    seen = _examine(curvature, step, vectors[shown], values[shown])
    residual[shown], difference[shown] = np.maximum(residual[shown], seen[0]), np.maximum(difference[shown], seen[1])
    by_losses = np.full(len(values), np.nan)
    by_losses[shown] = seen[2]
    off = SAFETY * max(abs(float(np.trace(change))), float(np.linalg.norm(np.diag(change))))
    off += ROUNDING * float(np.abs(values).sum())
    trace = float(np.trace(raw))
    size = float(np.linalg.norm(symmetric))
    return Spectrum(
        step=step, ladder=ladder, values=values, vectors=vectors, residual=residual, difference=difference,
        by_losses=by_losses, loss_error=_loss_error(curvature, step), trace=Estimate(trace, trace - off, trace + off),
        asymmetry=ratio(float(np.linalg.norm(skew)), size),
        asymmetry_explained=ratio(SAFETY * float(np.linalg.norm(change)), size),
        nodes=np.zeros((0, 0)), weights=np.zeros((0, 0)),
    )  # fmt: skip


def _matrix(curvature: Curvature, step: float) -> Array:
    """Return the matrix column by column, with the step and with a quarter of it, shape (2, dim, dim)."""
    steps, axes = (step, step / QUARTER), np.eye(curvature.dim)
    found = curvature.differences(axes, steps, f"columns-{step:g}")
    if found.by_gradients:
        return np.swapaxes(found.product, 1, 2)
    first, second = np.triu_indices(curvature.dim, 1)
    whole = np.stack([np.diag(one) for one in found.curvature])
    for sign in (1, -1) if len(first) else ():
        along = (axes[first] + sign * axes[second]) / np.sqrt(2)
        # v'Hv of (e_i + e_j) / sqrt 2, less that of (e_i - e_j) / sqrt 2, is 2 H_ij.
        half = sign * curvature.differences(along, steps, f"diagonals{sign}-{step:g}").curvature / 2
        whole[:, first, second] += half
        whole[:, second, first] += half
    return whole


def _partial_spectrum(
    curvature: Curvature, step: float, ladder: tuple[StepChange, ...], pairs: int, probes: int, seed: int
) -> Spectrum:
    """Return the ends of the spectrum by ARPACK, and its density by Lanczos' method from random probes."""
    dim, signs = curvature.dim, np.random.default_rng(seed).choice([-1.0, 1.0], (probes, curvature.dim))
    starts = signs / np.sqrt(dim)
    both = curvature.differences(starts, (step, step / QUARTER), f"starts-{step:g}").product
    first, change = curvature.refuse_failed(both[0]), curvature.refuse_failed(both[0] - both[1])
    found = _lanczos(curvature, step, starts, first)
    noise = float(np.linalg.norm(change, axis=1).max())
    vectors = _extremes(curvature, step, found, min(pairs, (dim - 1) // 2), noise)
    seen = _examine(curvature, step, vectors)
    order = np.argsort(-seen[3], kind="stable")
    skew = starts @ first.T - first @ starts.T
    size = float(np.sqrt(dim * np.square(first).sum(axis=1).mean()))
    skewness = dim * float(np.linalg.norm(skew)) / 2 / np.sqrt(probes * (probes - 1)) if probes > 1 else np.nan
    off = SAFETY * dim * float(np.abs((starts * change).sum(axis=1)).max())
    trace = mean(dim * (starts * first).sum(axis=1))  # Hutchinson 1990
    return Spectrum(
        step=step, ladder=ladder, values=seen[3][order], vectors=_oriented(vectors[order]), residual=seen[0][order],
        difference=seen[1][order], by_losses=seen[2][order], loss_error=_loss_error(curvature, step),
        trace=Estimate(trace.value, trace.low - off, trace.high + off), asymmetry=ratio(skewness, size),
        asymmetry_explained=ratio(SAFETY * float(np.sqrt(dim * np.square(change).sum(axis=1).mean())), size),
        nodes=found.nodes, weights=found.weights,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Krylov:
    """Lanczos' method from several starts: `basis`, shape (step, start, dim), and Ritz values with their weights.

    `ritz` are the coefficients of the Ritz vectors, shape (start, step, step).
    """

    basis: Array
    nodes: Array
    weights: Array
    ritz: Array

    def vectors(self, count: int) -> Array:
        """Return the Ritz vectors at both ends from the first start, shape (2 count, dim)."""
        shown = ends(self.nodes.shape[1], count)
        return _unit(self.ritz[0][:, shown].T @ self.basis[:, 0])


def _lanczos(curvature: Curvature, step: float, starts: Array, first: Array) -> _Krylov:
    """Run Lanczos' method from all starts at the same time, and orthogonalise twice; `first` are the first products.

    Ritz values weigh the squares of the first components of their vectors (Ubaru, Chen & Saad 2017).
    """
    basis, product, count = [starts], first, min(LANCZOS, curvature.dim)
    projected = np.zeros((len(starts), count, count))
    for j in range(count):
        if j:
            name = f"lanczos-{step:g}-{j}"
            product = curvature.refuse_failed(curvature.differences(basis[j], (step,), name).product[0])
        held, rest = np.stack(basis), product
        projected[:, j, j] = (basis[j] * product).sum(axis=1)
        for _ in range(2):
            rest = rest - np.einsum("jnd,jn->nd", held, np.einsum("jnd,nd->jn", held, rest))
        length = np.linalg.norm(rest, axis=1)
        length[length < 1e-14 * np.linalg.norm(product, axis=1)] = 0.0  # the start's own subspace is exhausted
        if j + 1 < count:
            projected[:, j, j + 1] = projected[:, j + 1, j] = length
            basis.append(np.divide(rest, length[:, None], out=np.zeros_like(rest), where=length[:, None] > 0))
    nodes, ritz = np.linalg.eigh(projected)
    return _Krylov(np.stack(basis), nodes, ritz[:, 0] ** 2, ritz)


def _extremes(curvature: Curvature, step: float, known: _Krylov, count: int, noise: float) -> Array:
    """Return unit vectors at both ends of the spectrum, shape (2 count, dim), to the error of the differences.

    Where ARPACK does not converge they are the Ritz vectors, whose residuals give their error. The spectrum is shifted
    to its middle, so that both its ends are large.
    """
    from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

    vectors = known.vectors(count)
    low, high = float(known.nodes.min()), float(known.nodes.max())
    middle, half = (low + high) / 2, (high - low) / 2
    if not half > 0:
        return vectors
    asked = 0

    def product(v: Array) -> Array:
        nonlocal asked
        asked, v = asked + 1, np.ravel(v)
        length = float(np.linalg.norm(v)) or 1.0
        name = f"product-{step:g}-{asked}"
        found = curvature.differences(v[None] / length, (step,), name).product[0, 0]
        shifted: Array = length * curvature.refuse_failed(found) - middle * v
        return shifted

    operator = LinearOperator((curvature.dim,) * 2, matvec=product, dtype=np.float64)
    tolerance, kept = max(LEAST_TOLERANCE, noise / half), min(curvature.dim, max(VECTORS, 4 * count + 1))
    begin = vectors.sum(axis=0)
    try:
        _, columns = eigsh(operator, 2 * count, which="BE", v0=begin, ncv=kept, maxiter=RESTARTS, tol=tolerance)
    except ArpackError:
        return vectors
    return _unit(columns.T)


def _examine(
    curvature: Curvature, step: float, vectors: Array, values: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """Return |Hv - value v|, the change of Hv to a quarter of the step, curvatures by losses, and the values.

    The values are v'Hv where none are given. Without gradients the first two are those of v'Hv alone.
    """
    found = curvature.differences(vectors, (step, step / QUARTER), f"pairs-{step:g}")
    curvature.refuse_failed(found.known)
    if not found.by_gradients:
        by_losses = found.curvature[0]
        values = by_losses if values is None else values
        return np.abs(by_losses - values), np.abs(np.diff(found.curvature, axis=0)[0]), by_losses, values
    product = found.product[0]
    values = (vectors * product).sum(axis=1) if values is None else values
    residual = np.linalg.norm(product - values[:, None] * vectors, axis=1)
    return residual, np.linalg.norm(product - found.product[1], axis=1), found.curvature[0], values


def _loss_error(curvature: Curvature, step: float) -> float:
    """Return the error of the losses' second difference over a step, from noise and rounding of losses."""
    from .measures.noise import noise

    rounding = LAST_PLACE[str(curvature.centre["precision"])]

    def measure() -> Arrays:
        x = torch.from_numpy(curvature.lower + curvature.z * curvature.width)[None]
        return {"deviation": np.array(noise(curvature.objective, x, rounding=rounding, repeats=REPEATS).deviation)}

    curvature.count(NOISE)
    deviation = float(np.nan_to_num(curvature.keep("noise", measure)["deviation"]))
    deviation = max(deviation, rounding * abs(float(curvature.centre["loss"])))
    return float(DEVIATIONS * np.sqrt(6) * deviation / step**2)


def ends(size: int, count: int) -> NDArray[np.int64]:
    """Return the positions of the first and the last `count`, or all where they meet."""
    return np.arange(size) if size <= 2 * count else np.r_[:count, size - count : size]


def _unit(rows: Array) -> Array:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    unit: Array = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
    return unit


def _oriented(rows: Array) -> Array:
    """Return rows with the largest component of each positive."""
    largest = np.take_along_axis(rows, np.abs(rows).argmax(axis=1)[:, None], axis=1)
    oriented: Array = rows * np.where(largest < 0, -1.0, 1.0)
    return oriented
