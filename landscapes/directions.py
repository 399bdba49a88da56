"""Directions of slices: random, along the gradient, along the curvature; lines between points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .curvature import Curvature, measure_spectrum
from .objective import Objective
from .plane import Plane
from .space import ParameterSpace

Array = NDArray[np.float64]
BEYOND = 0.1  # of a line's samples, past each of its ends
SHARES = "shares of the box"


def orthonormal(generator: np.random.Generator, dim: int) -> Array:
    """Draw two orthonormal directions, uniformly; shape (2, dim)."""
    frame, scale = np.linalg.qr(generator.standard_normal((dim, 2)))
    directions: Array = (frame * np.sign(np.diag(scale))).T
    return directions


def random_directions(space: ParameterSpace, seed: int) -> tuple[Array, list[str]]:
    """Return two random directions, orthonormal in widths of the box, and their labels."""
    _two(space)
    labels = [f"random direction {axis} [{SHARES}]" for axis in (1, 2)]
    return orthonormal(np.random.default_rng(seed), space.dim), labels


def filter_directions(space: ParameterSpace, x: Float[Tensor, " dim"], seed: int, name: str) -> tuple[Array, list[str]]:
    """Return two random directions, filter-normalised at a point (Li et al. 2018), in the parameters' own units.

    Gaussian noise is scaled filter by filter, so that each filter of a direction has the norm of that filter at the
    point; biases do not change. As in the paper, the directions are not made orthogonal. Raises ValueError where the
    space of `name` has no filters, and where all of them are zero at the point.
    """
    filters, here = space.filters, x.numpy()
    if not filters:
        raise ValueError(
            f"{name} does not say which of its {space.dim} parameters are the weights of one neuron; make its space "
            "with ParameterSpace.of_weights({'weight': (8, 3), 'bias': (8,)}), or slice along random:SEED"
        )
    norms = np.array([np.linalg.norm(here[own]) for own in filters])
    if not norms.any():
        raise ValueError(
            f"all filters of {name} are zero at this point, so directions have no length there; choose another point "
            "with --through"
        )
    noise, found = np.random.default_rng(seed).standard_normal((2, space.dim)), np.zeros((2, space.dim))
    for own, norm in zip(filters, norms, strict=True):
        drawn = noise[:, own]
        found[:, own] = drawn * (norm / np.linalg.norm(drawn, axis=1, keepdims=True))
    return found, [f"filter-normalised direction {axis} [filter norms]" for axis in (1, 2)]


def gradient_directions(objective: Objective, x: Float[Tensor, " dim"]) -> tuple[Array, list[str]]:
    """Return the gradient's direction, and the orthogonal one along which the gradient changes most.

    The second is H g without its part along g. Both are orthonormal in widths of the box. Raises ValueError where the
    gradient is zero or unknown, and where its change has no orthogonal part.
    """
    _two(objective.space)
    curvature = Curvature(objective, x)
    g = curvature.centre["grad"]
    if not len(g):
        raise ValueError(f"{objective.name} has no gradients to slice along; slice along random:SEED instead")
    if not (size := float(np.linalg.norm(g))):
        raise ValueError(f"{objective.name} has a zero gradient at this point; choose another point with --through")
    first = g / size
    step = min(curvature.ladder(), key=lambda one: one.change).step
    change = curvature.refuse_failed(curvature.differences(first[None], (step,), "gradient").product[0, 0])
    second = change - (change @ first) * first
    if not np.linalg.norm(second) > 1e-6 * np.linalg.norm(change):  # what differences of gradients can tell from none
        raise ValueError(
            f"{objective.name}'s gradient changes only along itself at this point; slice along random:SEED instead"
        )
    labels = [f"gradient [{SHARES}]", f"where the gradient turns most [{SHARES}]"]
    return np.stack([first, second / np.linalg.norm(second)]), labels


def hessian_directions(objective: Objective, x: Float[Tensor, " dim"]) -> tuple[Array, list[str]]:
    """Return the two eigenvectors of the Hessian with the largest curvatures, by magnitude, in widths of the box.

    They are those of `landscape hessian`; the largest component of each is positive. Raises ValueError where points
    fail, where there is no curvature, and where there are no gradients and too many parameters.
    """
    _two(objective.space)
    found = measure_spectrum(Curvature(objective, x), pairs=2, probes=1)
    if not np.abs(found.values).max():
        raise ValueError(f"{objective.name} has no curvature at this point; choose another point with --through")
    order = np.argsort(-np.abs(found.values), kind="stable")[:2]
    labels = [
        f"Hessian's direction {axis + 1}, curvature {found.values[at]:.3g} \N{PLUS-MINUS SIGN} {found.error[at]:.2g} "
        f"[{SHARES}]"
        for axis, at in enumerate(order)
    ]
    return found.vectors[order], labels


def _two(space: ParameterSpace) -> None:
    if space.dim < 2:
        raise ValueError("two directions need at least two parameters; got one")


def joining(
    space: ParameterSpace, points: Sequence[Float[Tensor, " dim"]], names: Sequence[str], resolution: int
) -> Plane:
    """Return the line from one point to another, or the plane through three: the first at 0, the others at 1.

    A line's ends are samples, and it continues a little beyond them within the box. Raises ValueError where points are
    equal or on one line.
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
    """Return the height of the barrier between 0 and 1 [loss unit]: the largest loss above the straight line.

    That line joins the losses of both ends (Frankle et al. 2020, Garipov et al. 2018). Between samples the barrier can
    be higher. NaN where an end or any sample between failed.
    """
    between = (u > -1e-9) & (u < 1 + 1e-9)
    at, height = u[between], loss[between]
    if len(at) < 2 or abs(at[0]) > 1e-9 or abs(at[-1] - 1) > 1e-9 or not np.isfinite(height).all():
        return float("nan")
    return float((height - (1 - at) * height[0] - at * height[-1]).max())
