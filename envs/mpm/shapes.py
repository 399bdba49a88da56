"""Solid shapes, filled evenly with particles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.space import sobol

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A box: its centre and its widths [m]."""

    center: Point
    widths: Point

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return float(np.prod(self.widths))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m]."""
        return np.subtract(self.center, np.divide(self.widths, 2)), np.add(self.center, np.divide(self.widths, 2))

    def place(self, u: Float[Tensor, "particle 3"]) -> Float[Tensor, "particle 3"]:
        """Map the unit cube onto the shape so that even stays even."""
        return u.new_tensor(self.center) + (u - 0.5) * u.new_tensor(self.widths)


@dataclass(frozen=True)
class Ball:
    """A ball: its centre and its radius [m]."""

    center: Point
    radius: float

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return 4.0 / 3.0 * float(np.pi) * self.radius**3

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m]."""
        return np.subtract(self.center, self.radius), np.add(self.center, self.radius)

    def place(self, u: Float[Tensor, "particle 3"]) -> Float[Tensor, "particle 3"]:
        """Map the unit cube onto the shape so that even stays even."""
        height, angle = 2 * u[:, 1] - 1, 2 * torch.pi * u[:, 2]
        around = (1 - height**2).sqrt()
        direction = torch.stack([around * angle.cos(), height, around * angle.sin()], dim=1)
        return u.new_tensor(self.center) + self.radius * u[:, :1] ** (1 / 3) * direction


@dataclass(frozen=True)
class Ring:
    """A flat ring that stands on `center`: inner and outer radius and height [m]."""

    center: Point
    inner: float
    outer: float
    height: float

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return float(np.pi) * (self.outer**2 - self.inner**2) * self.height

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m]."""
        return np.subtract(self.center, [self.outer, 0.0, self.outer]), np.add(
            self.center, [self.outer, self.height, self.outer]
        )

    def place(self, u: Float[Tensor, "particle 3"]) -> Float[Tensor, "particle 3"]:
        """Map the unit cube onto the shape so that even stays even."""
        radius = (self.inner**2 + u[:, 0] * (self.outer**2 - self.inner**2)).sqrt()
        angle = 2 * torch.pi * u[:, 2]
        offset = torch.stack([radius * angle.cos(), self.height * u[:, 1], radius * angle.sin()], dim=1)
        return u.new_tensor(self.center) + offset


Shape = Box | Ball | Ring


def shares(shapes: Sequence[Shape], total: int) -> list[int]:
    """Return how many of `total` particles each shape gets, by volume."""
    ends = np.cumsum([shape.volume for shape in shapes])
    bounds = np.rint(np.concatenate([[0.0], ends / ends[-1]]) * total).astype(int)
    return [int(count) for count in np.diff(bounds)]


def fill(shape: Shape, count: int) -> np.ndarray:
    """Return particles that fill a shape evenly (a scrambled Sobol sequence) [m], shape (particle, 3)."""
    return np.asarray(shape.place(sobol(count, 3, seed=0)).numpy())
