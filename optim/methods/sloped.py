"""The covariance of a function and of its slopes, by hand.

It is GPyTorch's `RBFKernelGrad` without its bookkeeping: Rasmussen & Williams 2006, eq. 9.1. Each point has 1 + dim
rows, its value and its slopes. A point whose slopes are not known has 1 in a column after its coordinates, which others
may be without: rows of such slopes depend on nothing, so that they change neither a mean nor a variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from gpytorch.kernels import RBFKernelGrad
from jaxtyping import Bool, Float
from torch import Tensor

from .radial import Matrix, Pull


@dataclass(frozen=True)
class Sloped:
    """The squared-exponential covariance k(u, v) = exp(-sum_j (u_j - v_j)^2 / scale_j^2 / 2), and its derivatives."""

    scale: Float[Tensor, " dim"]

    profile = "rbf with slopes"

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.scale)

    def _lacking(self, u: Float[Tensor, "point column"]) -> Bool[Tensor, " row"]:
        """Return which rows of points are slopes that are not known."""
        found = torch.zeros(len(u), 1 + self.dim, dtype=torch.bool)
        if u.shape[1] > self.dim:
            found[:, 1:] = u[:, self.dim :] == 1
        return found.flatten()

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
        rows = (block * value[..., None, None]).permute(0, 2, 1, 3).flatten(2).flatten(0, 1)
        left, right = self._lacking(u), self._lacking(v)
        if not (left.any() or right.any()):
            return rows
        apart = rows.masked_fill(left[:, None] | right, 0.0)
        same = (u[:, None] == v).all(dim=2).repeat_interleave(1 + self.dim, 0).repeat_interleave(1 + self.dim, 1)
        each = torch.eye(1 + self.dim, dtype=torch.bool).repeat(len(u), len(v))
        return torch.where(left[:, None] & right & same & each, 1.0, apart)

    def across(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> tuple[Matrix, Pull]:
        """Return those of the points' values with all rows of others, and what pulls slopes by them back to `u`."""
        value, slope = self._between(u, v)
        rows = value[..., None] * torch.cat([torch.ones_like(value)[..., None], slope], dim=2)
        known = ~self._lacking(v).reshape(len(v), -1)
        rows = rows * known

        def pull(weights: Matrix) -> Float[Tensor, "point dim"]:
            each = weights.reshape(rows.shape) * known
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
        apart = (u[:, None, : self.dim] - v[:, : self.dim]) / self.scale
        return torch.exp(-0.5 * apart.square().sum(dim=2)), apart / self.scale
