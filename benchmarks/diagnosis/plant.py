"""How a defect is planted in a system's gradient: the identity with a wrong backward pass, in each library."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

from .systems import System

Spoil = Callable[[Any, Any, Any], Any]
"""Makes the wrong gradient of the library, the right one and the points, both of shape (..., dim)."""
Region = Callable[[Any], Any]  # of points, shape (..., dim), whether they are in it


class _Spoiled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Any, spoil: Spoil) -> Any:
        ctx.save_for_backward(x)
        ctx.spoil = spoil
        return x.clone()

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        return ctx.spoil(torch, slope, *ctx.saved_tensors), None


def in_torch(system: System, spoil: Spoil) -> Callable[[Any], Any]:
    """Return the loss of torch whose backward pass is spoiled."""
    return lambda x: system.loss(torch, _Spoiled.apply(x, spoil))


def in_jax(system: System, spoil: Spoil) -> Callable[[Any], Any]:
    """Return the loss of JAX whose backward pass is spoiled."""

    @jax.custom_vjp
    def identity(x: Any) -> Any:
        return x

    identity.defvjp(lambda x: (x, x), lambda x, slope: (spoil(jnp, slope, x),))
    return lambda x: system.loss(jnp, identity(x))


def right(system: System, x: Any) -> tuple[Any, Any]:
    """Return losses and right gradients of a system as arrays of NumPy."""
    points = torch.from_numpy(np.array(x)).requires_grad_()
    with torch.enable_grad():
        loss = system.loss(torch, points)
        (slope,) = torch.autograd.grad(loss.sum(), points)
    return loss.detach().numpy(), slope.numpy()


def in_numpy(system: System, spoil: Spoil) -> Callable[[Any], Any]:
    """Return the losses and spoiled gradients as arrays of NumPy."""

    def both(x: Any) -> Any:
        loss, slope = right(system, x)
        return loss, spoil(np, slope, x)

    return both


PLANT = {"torch": in_torch, "jax": in_jax, "numpy": in_numpy}


# ---- What is done to a right gradient.


def scaled(factor: float, *which: int) -> Spoil:
    """Multiply the slopes by some parameters, or all."""

    def spoil(xp: Any, slope: Any, x: Any) -> Any:
        dim = slope.shape[-1]
        return slope * xp.asarray(
            [factor if k in (which or range(dim)) else 1.0 for k in range(dim)], dtype=slope.dtype
        )

    return spoil


def within(region: Region, inner: Spoil) -> Spoil:
    """Spoil gradients in a region only."""
    return lambda xp, slope, x: xp.where(region(x)[..., None], inner(xp, slope, x), slope)


def between(which: int, lower: float, upper: float) -> Region:
    """Say which points have a parameter between two values."""
    return lambda x: (x[..., which] > lower) & (x[..., which] < upper)


def permuted(order: Sequence[int]) -> Spoil:
    """Put slopes in another order."""
    return lambda xp, slope, x: slope[..., list(order)] if xp is not jnp else slope[..., jnp.asarray(list(order))]


def transposed(size: int) -> Spoil:
    """Transpose the slopes by the entries of a square matrix."""
    return permuted([column * size + row for row in range(size) for column in range(size)])


def clipped(limit: float) -> Spoil:
    """Limit each slope."""
    return lambda xp, slope, x: xp.clip(slope, -limit, limit)


def clipped_norm(limit: float) -> Spoil:
    """Limit the length of a gradient."""

    def spoil(xp: Any, slope: Any, x: Any) -> Any:
        norm = xp.sqrt((slope**2).sum(-1))[..., None] + 1e-30
        return slope * xp.where(norm > limit, limit / norm, 1.0 + 0 * norm)

    return spoil


def by_units(factors: Sequence[float]) -> Spoil:
    """Give slopes by other units of the parameters."""
    return lambda xp, slope, x: slope * xp.asarray(list(factors), dtype=slope.dtype)
