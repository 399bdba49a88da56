"""Directions to cut a landscape along: random ones, the gradient, the Hessian's.

Directions are found in the unit cube, where each parameter's bounds are one apart, so that units do not decide; each
function returns them in parameters' own units: one step along a row is as long as a side of the cube.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh
from torch import Tensor

from .objective import Objective, evaluate, name_of
from .space import ParameterSpace

Array = NDArray[np.float64]
STEP = 1e-3  # of differences of gradients, in sides of the cube: rounding is 1e-16 / 1e-3, the third derivative's 1e-6
SMALL = 1e-9  # of the gradient's length: curvature below it is rounding


def orthonormal(generator: np.random.Generator, dim: int, rank: int = 2) -> Array:
    """Draw so many orthonormal directions of the cube, shape (rank, dim), evenly over all of them."""
    frame, scale = np.linalg.qr(generator.standard_normal((dim, rank)))
    return cast(Array, (frame * np.sign(np.diag(scale))).T)


def random_directions(space: ParameterSpace, seed: int) -> Float[Tensor, "2 dim"]:
    """Return two random directions, orthonormal in the cube; the same seed gives the same.

    Raises ValueError where the space has one parameter.
    """
    _require_two(space, "random directions")
    return scale_to(space, orthonormal(np.random.default_rng(seed), space.dim))


def gradient_directions(objective: Objective, point: Float[Tensor, " dim"]) -> Float[Tensor, "2 dim"]:
    """Return the gradient at a point, and the direction orthogonal to it that changes it most.

    Along a direction d the gradient g changes by H d, so that d H^2 d is largest for the second: the leading singular
    vector of the Hessian on what is orthogonal to the gradient, by power iteration of differences of gradients.

    Raises ValueError where there is no gradient to follow, and where the space has one parameter.
    """
    space = objective.space
    _require_two(space, "the gradient and what changes it")
    slope = _Slope(objective, point)
    here = slope.at(np.zeros((1, space.dim)))[0]
    length = float(np.linalg.norm(here))
    if not length > 0:
        raise ValueError(f"{name_of(objective)} has a gradient of zero there; cut along something else than gradient")
    first = here / length

    def onto(vector: Array) -> Array:
        return cast(Array, vector - first * (first @ vector))

    def product(vector: Array) -> Array:  # H^2 on what is orthogonal to the gradient
        return onto(slope.hessian(slope.hessian(onto(vector.ravel()))))

    if not float(np.linalg.norm(product(_start(space.dim)))) > (SMALL * length) ** 2:
        raise ValueError(f"{name_of(objective)} has no curvature beside its gradient there; cut along random:0 instead")
    second = onto(_leading(product, space.dim, 1, name_of(objective))[1][0])
    return scale_to(space, np.stack([first, _with_sign(second / np.linalg.norm(second))]))


def hessian_directions(
    objective: Objective, point: Float[Tensor, " dim"]
) -> tuple[Float[Tensor, "2 dim"], tuple[float, float]]:
    """Return the two eigenvectors of the Hessian at a point with the largest eigenvalues in magnitude, and these.

    Eigenvalues are second derivatives in the cube [loss unit]. By Lanczos iteration (ARPACK, Lehoucq et al. 1998) of
    products with the Hessian, each a central difference of two gradients.

    Raises ValueError where a gradient is not finite, where the iteration does not converge, and for one parameter.
    """
    space = objective.space
    _require_two(space, "the Hessian's directions")
    slope = _Slope(objective, point)
    if not slope.hessian(_start(space.dim)).any():
        raise ValueError(f"{name_of(objective)} has no curvature there; cut along random:0 instead")
    values, vectors = _leading(slope.hessian, space.dim, 2, name_of(objective))
    return scale_to(space, np.stack([_with_sign(one) for one in vectors])), (float(values[0]), float(values[1]))


def scale_to(space: ParameterSpace, directions: Array) -> Float[Tensor, "rank dim"]:
    """Return directions of the cube in the parameters' own units."""
    return torch.from_numpy(directions.copy()) * (space.upper - space.lower)


class _Slope:
    """Gradients of an objective near a point, in the cube [loss unit]."""

    def __init__(self, objective: Objective, point: Float[Tensor, " dim"]) -> None:
        space = objective.space
        self.objective, self.width = objective, (space.upper - space.lower)
        middle = space.to_unit(point)
        if not getattr(objective, "beyond_box", False):  # differences stay inside
            middle = middle.clamp(STEP, 1 - STEP)
        self.point = space.from_unit(middle)

    def at(self, offsets: Array) -> Array:
        """Return the gradients at offsets from the point, shape (count, dim) both."""
        x = self.point + torch.from_numpy(offsets) * self.width
        found = evaluate(self.objective, x, grad=True)
        if found.grad is None or not bool(found.grad.isfinite().all()):
            raise ValueError(f"{name_of(self.objective)} has no finite gradient there; cut through another point")
        return cast(Array, (found.grad * self.width).numpy())

    def hessian(self, vector: Array) -> Array:
        """Return the Hessian's product with a vector."""
        length = float(np.linalg.norm(vector))
        if not length > 0:
            return np.zeros(vector.size)
        step = STEP * vector.ravel() / length
        ahead, behind = self.at(np.stack([step, -step]))
        return cast(Array, (ahead - behind) * (length / (2 * STEP)))


def _leading(product: object, dim: int, count: int, name: str) -> tuple[Array, Array]:
    """Return the leading eigenvalues of a symmetric operator, the largest in magnitude first, and their vectors."""
    if dim <= count + 1:  # too few for Lanczos
        whole = np.stack([np.asarray(product(row)) for row in np.eye(dim)])  # type: ignore[operator]
        values, vectors = np.linalg.eigh((whole + whole.T) / 2)
    else:
        try:
            values, vectors = eigsh(
                LinearOperator((dim, dim), matvec=product, dtype=float), k=count, v0=_start(dim), tol=1e-6
            )
        except ArpackNoConvergence as error:
            raise ValueError(
                f"the Hessian of {name} has no leading directions that can be told apart: {error}"
            ) from error
    order = np.argsort(-np.abs(values), kind="stable")[:count]
    return values[order], vectors.T[order]


def _start(dim: int) -> Array:
    """Return the direction that iterations begin with, the same each time."""
    return np.random.default_rng(0).standard_normal(dim)


def _with_sign(vector: Array) -> Array:
    """Return a direction whose largest component is positive."""
    return cast(Array, vector * np.sign(vector[np.abs(vector).argmax()]))


def _require_two(space: ParameterSpace, what: str) -> None:
    if space.dim < 2:
        raise ValueError(f"{what} need two parameters and more; there is one: give --dims 0")
