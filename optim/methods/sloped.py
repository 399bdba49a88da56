"""The covariance of a function and of its slopes, by hand.

It is GPyTorch's `RBFKernelGrad` without its bookkeeping: Rasmussen & Williams 2006, eq. 9.1. Each point has 1 + dim
rows, its value and its slopes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from gpytorch.kernels import RBFKernelGrad
from jaxtyping import Float
from torch import Tensor

from .radial import Matrix, Pull


@dataclass(frozen=True)
class Sloped:
    """The squared-exponential covariance k(u, v) = exp(-sum_j (u_j - v_j)^2 / scale_j^2 / 2), and its derivatives."""

    scale: Float[Tensor, " dim"]

    profile = "rbf with slopes"

    @classmethod
    def of(cls, kernel: RBFKernelGrad) -> Sloped:
        """Return what a kernel of GPyTorch computes, as it is now."""
        return cls(kernel.lengthscale.detach().reshape(-1).clone())

    def dense(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> Matrix:
        """Return the covariances of all rows of points."""
        value, slope = self._between(u, v)
        curvature = torch.diag(self.scale**-2) - slope[..., :, None] * slope[..., None, :]
        block = torch.cat([torch.cat([torch.ones_like(value)[..., None], slope], dim=2)[..., None, :],
                           torch.cat([-slope[..., None], curvature], dim=3)], dim=2)  # fmt: skip
        rows = (block * value[..., None, None]).permute(0, 2, 1, 3)
        return rows.flatten(2).flatten(0, 1)

    def across(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> tuple[Matrix, Pull]:
        """Return those of the points' values with all rows of others, and what pulls slopes by them back to `u`."""
        value, slope = self._between(u, v)
        rows = value[..., None] * torch.cat([torch.ones_like(value)[..., None], slope], dim=2)

        def pull(weights: Matrix) -> Float[Tensor, "point dim"]:
            each = weights.reshape(rows.shape)
            first = each[..., 0] + (each[..., 1:] * slope).sum(dim=2)
            return (value[..., None] * (each[..., 1:] / self.scale.square() - first[..., None] * slope)).sum(dim=1)

        return rows.flatten(1), pull

    def within(self, u: Float[Tensor, "point dim"]) -> tuple[Matrix, Pull]:
        """Return those of points with one another, and what pulls slopes by them back to slopes by length-scales."""
        with torch.enable_grad():
            scale = self.scale.clone().requires_grad_()
            value = Sloped(scale).dense(u, u)
        return value.detach(), lambda weights: torch.autograd.grad(value, scale, weights)[0]

    def _between(
        self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]
    ) -> tuple[Matrix, Float[Tensor, "point other dim"]]:
        """Return k, and its derivative by the second point divided by k."""
        apart = (u[:, None] - v) / self.scale
        return torch.exp(-0.5 * apart.square().sum(dim=2)), apart / self.scale
