"""Randomised smoothing: the gradient of a loss under a Gaussian, estimated from pairs of points.

The smoothed loss is L(x) = E f(x + s w), w ~ N(0, I), in the unit cube; f is mirrored at the bounds. Pairs are of w and
-w. All estimates are those of Suh et al. 2022, "Do differentiable simulators give better policy gradients?", except for
the mixing of the two orders.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

Order = Literal["first", "zeroth", "mixed"]
ORDERS: tuple[Order, ...] = get_args(Order)


def reflect(u: Float[Tensor, "*batch dim"]) -> tuple[Float[Tensor, "*batch dim"], Float[Tensor, "*batch dim"]]:
    """Return the mirror images in the unit cube of points outside it, and the sign of that map's derivative."""
    folded = torch.remainder(u, 2.0)
    return 1 - (1 - folded).abs(), torch.where(folded <= 1, 1.0, -1.0)


def smoothed_gradient(
    half: Float[Tensor, "batch pair"],
    first: Float[Tensor, "batch pair dim"] | None,
    w: Float[Tensor, "pair dim"],
    known: Tensor,
    order: Order,
) -> Float[Tensor, "batch dim"]:
    """Return gradients of the smoothed loss from the known pairs, shape (batch, pair), NaN where there is none.

    `half` is (f(x + s w) - f(x - s w)) / 2s, `first` the mean of a pair's two gradients; without these the estimate is
    of zeroth order.
    """
    half = torch.where(known, half, 0.0)
    if first is None or order == "zeroth":
        return mean_of_pairs(half[..., None] * w, known)
    first = torch.where(known[..., None], first, 0.0)
    return mean_of_pairs(first if order == "first" else mix_orders(half, first, w, known), known)


def mix_orders(
    half: Float[Tensor, "batch pair"],
    first: Float[Tensor, "batch pair dim"],
    w: Float[Tensor, "pair dim"],
    known: Tensor,
) -> Float[Tensor, "batch pair dim"]:
    """Return each pair's gradient estimate: zeroth order, with first order of the other pairs as a control variate.

    With g the mean first-order gradient of the other pairs, (half - c g.w) w + c g has the mean of half w for all g and
    c, because both are independent of w. `c`, from 0 to 1, is the slope of half over g.w among the other pairs: near 1
    where gradients explain the differences of losses, near 0 where they do not.
    """
    g, correction = _control(half, first, w, known)
    return correction + g


def shrunk_gradient(
    half: Float[Tensor, "batch pair"],
    first: Float[Tensor, "batch pair dim"],
    w: Float[Tensor, "pair dim"],
    known: Tensor,
) -> Float[Tensor, "batch dim"]:
    """Return the mixed estimate with a smaller first-order correction, the smaller the more it is noise.

    The noise of the correction (half - c g.w) w grows with the number of parameters, even if gradients explain
    everything important. Its mean over the pairs is shrunk by 1 - (expected square of its noise) / (its square), at
    least 0 (the positive part of James and Stein 1961). This estimate is biased, unlike that of `mix_orders`. Where all
    gradients are zero, only the correction shows where the loss falls, and all of it is kept.
    """
    g, correction = _control(half, first, w, known)
    mean, count = mean_of_pairs(correction, known), known.sum(dim=1)
    spread = torch.where(known[..., None], correction - mean[:, None], 0.0).square().sum(dim=(1, 2))
    noise = spread / (count * (count - 1)).clamp(min=1)
    kept = 1 - noise / mean.square().sum(dim=1).clamp(min=torch.finfo(torch.float64).tiny)
    kept = torch.where((first == 0).flatten(1).all(dim=1), 1.0, kept.clamp(min=0))
    found: Tensor = mean_of_pairs(g, known) + kept[:, None] * mean
    return found


def _control(half: Tensor, first: Tensor, w: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return c g and (half - c g.w) w of each pair, shapes (batch, pair, dim), as in `mix_orders`."""
    count = known.sum(dim=1, keepdim=True).double()
    others = (count - 1).clamp(min=1)[..., None]
    g = (first.sum(dim=1, keepdim=True) - first) / others
    along = torch.einsum("bkd,jd->bkj", g, w)  # of pair j, by the gradient that leaves out pair k
    apart = known[:, None, :] & ~torch.eye(len(w), dtype=torch.bool)
    along_others = torch.where(apart, along, 0.0)
    size = along_others.square().sum(dim=2)
    c = torch.where(size > 0, (along_others * half[:, None, :]).sum(dim=2) / size.clamp(min=torch.finfo().tiny), 0.0)
    g = c.clamp(0, 1)[..., None] * g
    return g, (half - (g * w).sum(dim=-1))[..., None] * w


def mean_of_pairs(values: Tensor, known: Tensor) -> Tensor:
    """Return means over the known pairs, NaN where there is none."""
    seen = known.reshape(*known.shape, *[1] * (values.ndim - known.ndim))
    mean: Tensor = torch.where(seen, values, 0.0).sum(dim=1) / seen.sum(dim=1)
    return mean
