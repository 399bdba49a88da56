"""The box of parameters a landscape is spanned by."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False, init=False)
class ParameterSpace:
    """Name the parameters of an objective, their units and their bounds.

        ParameterSpace({"kp": (0, 2, "N/m"), "kd": (0, 0.5)})
        ParameterSpace(["kp", "kd"], lower=[0, 0], upper=[2, 0.5], units=["N/m", ""])

    `lower` and `upper`, numbers of any kind, become float64, shape (dim,), in the parameters' own units, which are none
    where they are not given. The bounds say where a landscape is looked at, and an objective is not asked beyond them
    unless it invites that (`Objective`). Raises ValueError where names, bounds or units do not belong together.
    """

    names: tuple[str, ...]
    lower: Float[Tensor, " dim"]
    upper: Float[Tensor, " dim"]
    units: tuple[str, ...]

    def __init__(
        self,
        names: Sequence[str] | Mapping[str, Sequence[Any]],
        lower: Sequence[float] | Float[Tensor, " dim"] | None = None,
        upper: Sequence[float] | Float[Tensor, " dim"] | None = None,
        units: Sequence[str] | None = None,
    ) -> None:
        if isinstance(names, Mapping):
            if not (lower is None and upper is None and units is None):
                raise ValueError("ParameterSpace takes names with their bounds and units, or each of them; got both")
            lower, upper, units = _columns(names)
        if isinstance(names, str) or lower is None or upper is None:
            raise ValueError(f"ParameterSpace takes names, lower and upper bounds; got {names!r}, {lower}, {upper}")
        names = tuple(map(str, names))
        units = ("",) * len(names) if units is None else units
        for field, value in (("names", names), ("units", tuple(map(str, units)))):
            object.__setattr__(self, field, value)
        for field, bound in (("lower", lower), ("upper", upper)):
            values = as_tensor(bound, f"ParameterSpace's {field}").clone()  # what becomes of the caller's is no bound
            object.__setattr__(self, field, values if values.ndim else values[None])
        self._check()

    def _check(self) -> None:
        for field, shape in (("units", (len(self.units),)), ("lower", self.lower.shape), ("upper", self.upper.shape)):
            if tuple(shape) != (self.dim,):
                raise ValueError(
                    f"ParameterSpace has {self.dim} names; {field} must have as many, got shape {tuple(shape)}"
                )
        if len(set(self.names)) != self.dim or not self.dim:
            raise ValueError(f"ParameterSpace needs distinct names; got {', '.join(self.names) or 'none'}")
        for name, low, high in zip(self.names, self.lower.tolist(), self.upper.tolist(), strict=True):
            if not (low < high and np.isfinite(high - low)):
                raise ValueError(f"ParameterSpace needs finite lower < upper for {name}; got {low:g} to {high:g}")

    @classmethod
    def box(cls, names: Sequence[str], lower: float, upper: float, unit: str = "") -> ParameterSpace:
        """Return a space whose parameters share their bounds and their unit."""
        dim = len(names)
        return cls(tuple(names), [lower] * dim, [upper] * dim, (unit,) * dim)

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
        return self.lower + tensor_of(u, "from_unit") * (self.upper - self.lower)

    def to_unit(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Map the box onto the unit cube."""
        return (tensor_of(x, "to_unit") - self.lower) / (self.upper - self.lower)

    def uniform(self, count: int, *, seed: int) -> Float[Tensor, "count dim"]:
        """Draw points uniformly from the box; the same seed gives the same points.

        Raises ValueError where the count or the seed is no whole number.
        """
        generator = torch.Generator().manual_seed(as_whole(seed, "a seed"))
        count = as_whole(count, "a count of points")
        return self.from_unit(torch.rand(count, self.dim, generator=generator, dtype=torch.float64))

    def sobol(self, count: int, *, seed: int) -> Float[Tensor, "count dim"]:
        """Return points spread evenly over the box, of a scrambled Sobol sequence; the same seed gives the same."""
        return self.from_unit(sobol(count, self.dim, seed=seed))

    def index(self, parameter: str | int) -> int:
        """Return the number of a parameter given by name or by number.

        Raises ValueError where there is none.
        """
        if isinstance(parameter, str) and parameter in self.names:
            return self.names.index(parameter)
        try:
            number = int(parameter) if isinstance(parameter, str) else operator.index(parameter)
        except (TypeError, ValueError):
            raise ValueError(f"no parameter is called {parameter!r}; there are {', '.join(self.names)}") from None
        if not 0 <= number < self.dim:
            raise ValueError(f"parameters are numbered 0 to {self.dim - 1}; got {number}")
        return number


def sobol(count: int, dim: int, *, seed: int) -> Float[Tensor, "count dim"]:
    """Return the first points of a scrambled Sobol sequence in the unit cube, float64."""
    engine = torch.quasirandom.SobolEngine(dim, scramble=True, seed=seed)  # type: ignore[no-untyped-call]
    points: Tensor = engine.draw(count, dtype=torch.float64)
    return points


def as_whole(value: object, what: str, *, least: int = 0) -> int:
    """Return a whole number of 64 bits that is not below `least`; raises ValueError, which says `what` it is, else."""
    try:
        number = least - 1 if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type] # as it tells
    except TypeError:
        number = least - 1
    if number < least:
        raise ValueError(f"{what} is a whole number of at least {least}; got {value!r}")
    if number >= 1 << 63:
        raise ValueError(f"{what} is a whole number below 2^63; got {value!r}")
    return number


def as_stride(gradients: bool | int) -> int:
    """Return at every how many samples gradients are: 0 for none, 1 for all. Raises ValueError for no whole number."""
    return as_whole(int(gradients) if isinstance(gradients, bool) else gradients, "gradients")


def tensor_of(x: object, who: str) -> Float[Tensor, "*shape"]:
    """Return a tensor as it is, and one of any other numbers."""
    return x if isinstance(x, Tensor) else as_tensor(x, who)


def as_tensor(x: object, who: str) -> Float[Tensor, "*shape"]:
    """Return numbers, whole or floating, of a tensor, an array or lists as a float64 tensor on the CPU.

    Raises ValueError, which says `who` takes them, for what is no number, and for what an array masks.
    """
    if isinstance(x, Tensor):
        if x.is_complex() or x.dtype == torch.bool:
            raise ValueError(f"{who} takes numbers; got a tensor of {x.dtype}")
        return x.detach().to("cpu", torch.float64)
    if any(map(np.ma.is_masked, x if isinstance(x, list | tuple) else [x])):
        raise ValueError(
            f"{who} takes numbers; got an array that masks some (`.filled(numpy.nan)` makes them failures)"
        )
    try:
        values = np.asarray(x)
        if values.dtype.kind not in "iuf":
            raise TypeError(f"an array of {values.dtype}" if values.ndim else type(x).__name__)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{who} takes numbers, as a tensor, an array or lists; got {error}") from None
    return torch.from_numpy(np.array(values, dtype=np.float64, order="C"))


def _columns(named: Mapping[str, Sequence[Any]]) -> tuple[list[float], list[float], list[str]]:
    """Return lower bounds, upper bounds and units of parameters given as name: (lower, upper) or (..., unit)."""
    for name, bounds in named.items():
        if isinstance(bounds, str) or not hasattr(bounds, "__len__") or len(bounds) not in (2, 3):
            raise ValueError(f"parameter {name!r} needs (lower, upper) or (lower, upper, unit); got {bounds!r}")
    rows = [(*bounds, "")[:3] for bounds in named.values()]
    lower, upper, units = (list(column) for column in zip(*rows, strict=True)) if rows else ([], [], [])
    return lower, upper, units
