"""Covariances that depend on a distance alone, with their slopes by hand.

They are GPyTorch's `RBFKernel` and `MaternKernel` without its bookkeeping and without reverse differentiation, which
take longer than the numbers themselves where a process has a few hundred points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from gpytorch.kernels import Kernel, MaternKernel, RBFKernel
from jaxtyping import Float
from torch import Tensor

Matrix = Float[Tensor, "row column"]
Pull = Callable[[Matrix], Tensor]


class Profile(Protocol):
    """A covariance k as a function of the squared distance s, shape (row, column)."""

    def value(self, squares: Matrix) -> Matrix:
        """Return k, written over s: matrices of thousands of points are to be made once."""

    def both(self, squares: Matrix) -> tuple[Matrix, Matrix]:
        """Return k and dk/ds."""


class SquaredExponential:
    """exp(-s / 2)."""

    def value(self, squares: Matrix) -> Matrix:
        """Return k, written over s."""
        return squares.mul_(-0.5).exp_()

    def both(self, squares: Matrix) -> tuple[Matrix, Matrix]:
        """Return k and dk/ds."""
        value = self.value(squares)
        return value, -0.5 * value


class Matern:
    """Matern's of smoothness 5/2 (Rasmussen & Williams 2006, eq. 4.17)."""

    def value(self, squares: Matrix) -> Matrix:
        """Return k, written over s."""
        root = squares.mul_(5.0).sqrt_()
        polynomial = root.square().div_(3.0).add_(root).add_(1.0)
        return polynomial.mul_(root.neg_().exp_())

    def both(self, squares: Matrix) -> tuple[Matrix, Matrix]:
        """Return k and dk/ds."""
        root = torch.sqrt(5.0 * squares)
        decay = torch.exp(-root)
        return (1.0 + root + 5.0 / 3.0 * squares) * decay, -5.0 / 6.0 * (1.0 + root) * decay


PROFILES: dict[str, Profile] = {"rbf": SquaredExponential(), "matern": Matern()}


@dataclass(frozen=True)
class Radial:
    """A covariance k(s) where s = sum_j (u_j - v_j)^2 / scale_j^2; `profile` is the name of k."""

    profile: str
    scale: Float[Tensor, " dim"]

    @classmethod
    def of(cls, kernel: Kernel) -> Radial:
        """Return what a kernel of GPyTorch computes, as it is now. Raises ValueError for one that is not radial."""
        if isinstance(kernel, RBFKernel):
            profile = "rbf"
        elif isinstance(kernel, MaternKernel) and kernel.nu == 2.5:
            profile = "matern"
        else:
            raise ValueError(f"a radial covariance is an RBFKernel or a MaternKernel of 5/2; got {kernel}")
        return cls(profile, kernel.lengthscale.detach().reshape(-1).clone())

    def between(self, u: Float[Tensor, "row dim"], v: Float[Tensor, "column dim"]) -> tuple[Matrix, Matrix]:
        """Return k of every pair of points of [0, 1]^dim, and dk/ds."""
        return PROFILES[self.profile].both(self._squares(u, v))

    def dense(self, u: Float[Tensor, "row dim"], v: Float[Tensor, "column dim"]) -> Matrix:
        """Return k of every pair of points."""
        return PROFILES[self.profile].value(self._squares(u, v))

    def _squares(self, u: Float[Tensor, "row dim"], v: Float[Tensor, "column dim"]) -> Matrix:
        u, v = (u - 0.5) / self.scale, (v - 0.5) / self.scale
        squares = u.square().sum(dim=1)[:, None] + v.square().sum(dim=1)
        return squares.addmm_(u, v.T, alpha=-2.0).clamp_min_(0.0)

    def across(self, u: Float[Tensor, "row dim"], v: Float[Tensor, "column dim"]) -> tuple[Matrix, Pull]:
        """Return k, and what pulls a function's slopes by k, shape (row, column), back to its slopes by `u`."""
        value, slope = self.between(u, v)

        def pull(weights: Matrix) -> Float[Tensor, "row dim"]:
            pulled = 2.0 * weights * slope
            return (u * pulled.sum(dim=1, keepdim=True) - pulled @ v) / self.scale.square()

        return value, pull

    def within(self, u: Float[Tensor, "row dim"]) -> tuple[Matrix, Pull]:
        """Return k of points with one another, and what pulls symmetric slopes by k back to slopes by length-scales.

        Of sum_ab M_ab (u_aj - u_bj)^2, with M = slopes times dk/ds, products of M with u are taken apart.
        """
        value, slope = self.between(u, u)

        def pull(weights: Matrix) -> Float[Tensor, " dim"]:
            moments, centred = weights * slope, u - 0.5
            spread = moments.sum(dim=1) @ centred.square() - (centred * (moments @ centred)).sum(dim=0)
            return -4.0 * spread / self.scale**3

        return value, pull
