"""Directions to cut a landscape along: random, along the gradient, along the curvature; lines between points."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .objective import Objective, evaluate
from .plane import Plane
from .space import ParameterSpace

Array = NDArray[np.float64]
STEP = 1e-4  # of the box: differences of float64 gradients lose eps / STEP = 2e-12 to rounding, STEP**2 to truncation
BEYOND = 0.1  # of a line's samples, past each of its ends
SHARES = "shares of the box"


def orthonormal(generator: np.random.Generator, dim: int) -> Array:
    """Draw two orthonormal directions, evenly over all of them; shape (2, dim)."""
    frame, scale = np.linalg.qr(generator.standard_normal((dim, 2)))
    directions: Array = (frame * np.sign(np.diag(scale))).T
    return directions


def random_directions(space: ParameterSpace, seed: int) -> tuple[Array, list[str]]:
    """Return two random directions, orthonormal in widths of the box, and what they are called."""
    _two(space)
    labels = [f"random direction {axis} [{SHARES}]" for axis in (1, 2)]
    return orthonormal(np.random.default_rng(seed), space.dim), labels


def gradient_directions(objective: Objective, x: Float[Tensor, " dim"]) -> tuple[Array, list[str]]:
    """Return the gradient's direction, and the one orthogonal to it that changes it most: of H g without g.

    Both are orthonormal in widths of the box. Raises ValueError where the gradient is zero or not known, and where its
    change has no part orthogonal to it.
    """
    _two(objective.space)
    curvature = _Curvature(objective, x)
    g = curvature.gradient(np.zeros(objective.space.dim))
    if not (size := float(np.linalg.norm(g))):
        raise ValueError(f"{objective.name} has a gradient of zero at this point; cut it through another")
    first = g / size
    change = curvature(first)
    second = change - (change @ first) * first
    if not np.linalg.norm(second) > 1e-6 * np.linalg.norm(change):  # what differences of gradients can tell from none
        raise ValueError(
            f"{objective.name}'s gradient changes along itself only at this point; cut along random:SEED instead"
        )
    labels = [f"gradient [{SHARES}]", f"where the gradient turns most [{SHARES}]"]
    return np.stack([first, second / np.linalg.norm(second)]), labels


def hessian_directions(objective: Objective, x: Float[Tensor, " dim"]) -> tuple[Array, list[str]]:
    """Return the two eigenvectors of the Hessian with the largest curvatures, by magnitude, in widths of the box.

    Products with the Hessian are central differences of gradients; the largest component of each direction is
    positive. Raises ValueError where gradients are not known or all zero, and where Lanczos' method does not converge.
    """
    dim = objective.space.dim
    _two(objective.space)
    curvature = _Curvature(objective, x)
    values, vectors = _eigen(curvature, dim, objective.name)
    if not np.abs(values).max():
        raise ValueError(f"{objective.name} has no curvature at this point; cut it through another")
    order = np.argsort(-np.abs(values), kind="stable")[:2]
    frame = vectors[:, order].T
    frame = frame * np.sign(np.take_along_axis(frame, np.abs(frame).argmax(axis=1)[:, None], axis=1))
    labels = [f"Hessian's direction {axis + 1}, curvature {values[at]:.3g} [{SHARES}]" for axis, at in enumerate(order)]
    return frame, labels


def _eigen(curvature: Callable[[Array], Array], dim: int, name: str) -> tuple[Array, Array]:
    """Return leading eigenvalues and eigenvectors; of up to three parameters all, which Lanczos' method cannot."""
    from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

    if dim <= 3:
        whole = np.stack([curvature(row) for row in np.eye(dim)])
        values, vectors = np.linalg.eigh((whole + whole.T) / 2)
        return values, vectors
    start = np.random.default_rng(0).standard_normal(dim)
    try:
        operator = LinearOperator((dim, dim), matvec=lambda v: curvature(np.ravel(v)), dtype=np.float64)
        values, vectors = eigsh(operator, k=2, which="LM", v0=start, tol=1e-6)
    except ArpackError as error:
        raise ValueError(
            f"the Hessian of {name} has no clear leading directions at this point ({error}); cut through another"
        ) from None
    return values, vectors


class _Curvature:
    """Multiply by the Hessian at a point, in widths of the box."""

    def __init__(self, objective: Objective, x: Float[Tensor, " dim"]) -> None:
        space = objective.space
        self.objective, self.width = objective, (space.upper - space.lower).numpy()
        step = STEP * torch.from_numpy(self.width)
        self.x = torch.maximum(torch.minimum(x, space.upper - step), space.lower + step).numpy()  # room to every side

    def gradient(self, *offsets: Array) -> Array:
        """Return gradients [loss unit] at offsets from the point, one of shape (dim,) for one."""
        points = torch.from_numpy(self.x + np.stack(offsets) * self.width)
        found = evaluate(self.objective, points, grad=True).grad
        if found is None or not bool(found.isfinite().all()):
            raise ValueError(f"{self.objective.name} has no finite gradient at this point; cut it through another")
        grad: Array = found.numpy() * self.width
        return grad[0] if len(offsets) == 1 else grad

    def __call__(self, direction: Array) -> Array:
        offset = STEP * direction / max(float(np.linalg.norm(direction)), np.finfo(float).tiny)
        ahead, behind = self.gradient(offset, -offset)
        product: Array = (ahead - behind) / (2 * STEP) * np.linalg.norm(direction)
        return product


def _two(space: ParameterSpace) -> None:
    if space.dim < 2:
        raise ValueError("two directions take two parameters and more; got one")


def joining(
    space: ParameterSpace, points: Sequence[Float[Tensor, " dim"]], names: Sequence[str], resolution: int
) -> Plane:
    """Return the line from one point to another, or the plane through three: the first at 0, the others at 1.

    A line's ends are samples, and it continues a little beyond them where the box does. Raises ValueError where
    points are the same or lie on a line.
    """
    along = torch.stack([point - points[0] for point in points[1:]])
    labels = [f"from {names[0]} to {name}" for name in names[1:]]
    if len(along) == 2:
        return Plane.span(points[0], along, resolution=resolution, window=(-0.25, 1.25), labels=labels)
    past = int(BEYOND * resolution)
    step = 1 / max(resolution - 1 - 2 * past, 1)
    ends = [(points[0] - past * step * along[0]), (points[1] + past * step * along[0])]
    before, after = (past if bool(((end >= space.lower) & (end <= space.upper)).all()) else 0 for end in ends)
    step = 1 / (resolution - 1 - before - after)
    window = (-before * step, 1 + after * step)
    return Plane.span(points[0], along, resolution=resolution, window=window, labels=labels)


def barrier(u: Array, loss: Array) -> float:
    """Return the height of the barrier between 0 and 1 [loss unit]: the most that losses lie above the straight line.

    That line joins the losses of both ends (Frankle et al. 2020, Garipov et al. 2018). It is of the samples: a lower
    bound where the landscape is finer. NaN where an end or any sample between failed.
    """
    between = (u > -1e-9) & (u < 1 + 1e-9)
    at, height = u[between], loss[between]
    if len(at) < 2 or abs(at[0]) > 1e-9 or abs(at[-1] - 1) > 1e-9 or not np.isfinite(height).all():
        return float("nan")
    return float((height - (1 - at) * height[0] - at * height[-1]).max())
