"""The box of parameters a landscape is spanned by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """Name the parameters of an objective, their units and their bounds.

    `lower` and `upper` become float64, shape (dim,), in the parameters' own units. The bounds say where a landscape is
    looked at, and an objective is not asked beyond them unless it invites that (`Objective`).
    """

    names: tuple[str, ...]
    lower: Float[Tensor, " dim"]
    upper: Float[Tensor, " dim"]
    units: tuple[str, ...]

    def __post_init__(self) -> None:
        dim = len(self.names)
        object.__setattr__(self, "lower", self.lower.detach().to("cpu", torch.float64))
        object.__setattr__(self, "upper", self.upper.detach().to("cpu", torch.float64))
        for field, size in (("units", len(self.units)), ("lower", self.lower.numel()), ("upper", self.upper.numel())):
            if size != dim:
                raise ValueError(f"ParameterSpace has {dim} names; {field} must have as many, got {size}")
        if len(set(self.names)) != dim:
            raise ValueError(f"ParameterSpace needs distinct names; got {', '.join(self.names)}")
        if not bool((self.lower < self.upper).all()):
            raise ValueError("ParameterSpace needs lower < upper in every dimension")

    @classmethod
    def box(cls, names: Sequence[str], lower: float, upper: float, unit: str = "") -> ParameterSpace:
        """Return a space whose parameters share their bounds and their unit."""
        dim = len(names)
        bound = torch.ones(dim, dtype=torch.float64)
        return cls(tuple(names), lower * bound, upper * bound, (unit,) * dim)

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.names)

    @property
    def center(self) -> Float[Tensor, " dim"]:
        """Middle of the box."""
        return (self.lower + self.upper) / 2

    @property
    def labels(self) -> tuple[str, ...]:
        """Names with units, as an axis shows them."""
        return tuple(f"{name} [{unit}]" if unit else name for name, unit in zip(self.names, self.units, strict=True))

    def from_unit(self, u: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Map the unit cube onto the box."""
        return self.lower + u * (self.upper - self.lower)

    def to_unit(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Map the box onto the unit cube."""
        return (x - self.lower) / (self.upper - self.lower)

    def uniform(self, count: int, *, seed: int) -> Float[Tensor, "count dim"]:
        """Draw points uniformly from the box; the same seed gives the same points."""
        generator = torch.Generator().manual_seed(seed)
        return self.from_unit(torch.rand(count, self.dim, generator=generator, dtype=torch.float64))

    def index(self, parameter: str | int) -> int:
        """Return the number of a parameter given by name or by number."""
        if isinstance(parameter, str) and parameter in self.names:
            return self.names.index(parameter)
        try:
            number = int(parameter)
        except ValueError:
            raise ValueError(f"no parameter is called {parameter!r}; there are {', '.join(self.names)}") from None
        if not 0 <= number < self.dim:
            raise ValueError(f"parameters are numbered 0 to {self.dim - 1}; got {number}")
        return number
