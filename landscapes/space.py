"""The box of parameters of a landscape, and their scales."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

LINEAR, LOG10 = SCALES = ("linear", "log10")


@dataclass(frozen=True)
class Log:
    """Bound a parameter, in its own unit, that is treated by its decimal logarithm."""

    lower: float
    upper: float
    unit: str = ""

    def __post_init__(self) -> None:
        for field in ("lower", "upper"):
            object.__setattr__(self, field, float(as_tensor(getattr(self, field), f"log's {field} bound")))
        if not 0 < self.lower < self.upper < math.inf:
            raise ValueError(
                f"log takes the bounds of a logarithmic parameter, 0 < lower < upper; got {self.lower:g} to "
                f"{self.upper:g}"
            )


def log(lower: float, upper: float, unit: str = "") -> Log:
    """Bound a parameter of a `ParameterSpace` that is treated by its decimal logarithm.

        ParameterSpace({"k": log(1e-2, 1e6, "N/m"), "c": (0, 5)})

    The bounds are in the parameter's own unit. Raises ValueError unless 0 < lower < upper.
    """
    return Log(lower, upper, unit)


@dataclass(frozen=True, eq=False, init=False)
class ParameterSpace:
    """Name the parameters of an objective, their units, their bounds and their scales.

        ParameterSpace({"kp": (0, 2, "N/m"), "kd": (0, 0.5)})
        ParameterSpace({"k": log(1e-2, 1e6, "N/m"), "c": (0, 5)})
        ParameterSpace(["k", "c"], lower=[1e-2, 0], upper=[1e6, 5], units=["N/m", ""], scales=["log10", "linear"])

    Bounds are any numbers in the parameters' own units; a parameter without a unit has none. A point `x` has, for each
    parameter, its value, or its decimal logarithm if its scale is "log10". `evaluate`, slices, searches and checks use
    such points, and `lower` and `upper`, float64 of shape (dim,), bound them. `to_values` and `from_values` convert. An
    objective is evaluated only inside the bounds, unless it allows more (`Objective`). `arrays` are the shapes, by
    name, of the arrays whose numbers the parameters are, in order; only a space `of_weights` has any.

    Raises ValueError where names, bounds, units or scales do not match.
    """

    names: tuple[str, ...]
    lower: Float[Tensor, " dim"]
    upper: Float[Tensor, " dim"]
    units: tuple[str, ...]
    scales: tuple[str, ...]
    arrays: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType({})
    outputs: ClassVar[Literal["first", "last"]] = "first"

    def __init__(
        self,
        names: Sequence[str] | Mapping[str, Sequence[Any] | Log],
        lower: Sequence[float] | Float[Tensor, " dim"] | None = None,
        upper: Sequence[float] | Float[Tensor, " dim"] | None = None,
        units: Sequence[str] | None = None,
        scales: Sequence[str] | None = None,
    ) -> None:
        if isinstance(names, Mapping):
            if not (lower is None and upper is None and units is None and scales is None):
                raise ValueError(
                    "ParameterSpace takes either a mapping from names to bounds and units, or separate lists; got both"
                )
            lower, upper, units, scales = _columns(names)
        if isinstance(names, str) or lower is None or upper is None:
            raise ValueError(f"ParameterSpace takes names, lower and upper bounds; got {names!r}, {lower}, {upper}")
        names = tuple(map(str, names))
        units = ("",) * len(names) if units is None else units
        scales = (LINEAR,) * len(names) if scales is None else scales
        for field, value in (("names", names), ("units", tuple(map(str, units))), ("scales", tuple(map(str, scales)))):
            object.__setattr__(self, field, value)
        for field, bound in (("lower", lower), ("upper", upper)):
            values = as_tensor(bound, f"ParameterSpace's {field}").clone()  # what becomes of the caller's is no bound
            object.__setattr__(self, field, values if values.ndim else values[None])
        self._check()
        for field in ("lower", "upper"):
            object.__setattr__(self, field, self.from_values(getattr(self, field)))

    def _check(self) -> None:
        sizes = {field: (len(getattr(self, field)),) for field in ("units", "scales")}
        for field, shape in (*sizes.items(), ("lower", self.lower.shape), ("upper", self.upper.shape)):
            if tuple(shape) != (self.dim,):
                raise ValueError(
                    f"ParameterSpace has {self.dim} names; {field} must have as many, got shape {tuple(shape)}"
                )
        if len(set(self.names)) != self.dim or not self.dim:
            raise ValueError(f"ParameterSpace needs distinct names; got {', '.join(self.names) or 'none'}")
        for name, scale, low, high in zip(
            self.names, self.scales, self.lower.tolist(), self.upper.tolist(), strict=True
        ):
            if scale not in SCALES:
                raise ValueError(f"ParameterSpace takes the scales {' and '.join(SCALES)}; got {scale!r} for {name}")
            if not (low < high and np.isfinite(high - low)):
                raise ValueError(f"ParameterSpace needs finite lower < upper for {name}; got {low:g} to {high:g}")
            if scale == LOG10 and not low > 0:
                raise ValueError(
                    f"ParameterSpace needs lower > 0 for {name}, whose scale is log10; got {low:g} to {high:g}"
                )

    @classmethod
    def box(cls, names: Sequence[str], lower: float, upper: float, unit: str = "") -> ParameterSpace:
        """Return a space whose parameters all have the same bounds and unit."""
        dim = len(names)
        return cls(tuple(names), [lower] * dim, [upper] * dim, (unit,) * dim)

    @classmethod
    def of_weights(
        cls,
        shapes: Mapping[str, Sequence[int]],
        reach: float | Mapping[str, float] = 1.0,
        *,
        outputs: Literal["first", "last"] = "first",
    ) -> ParameterSpace:
        """Return the space of a network's weights, array by array, each number between -`reach` and `reach`.

            ParameterSpace.of_weights({"hidden.weight": (8, 3), "hidden.bias": (8,), "out.weight": (1, 8)}, 3.0)
            ParameterSpace.of_weights({name: one.shape for name, one in net.named_parameters()})

        A point contains the arrays one after another, each flattened row by row. `reach` can be given for each array by
        its name. The outputs of a layer are the first axis of an array, as in torch, or the last, as in Flax. The
        weights of one output are a filter (`filters`). Bounds only define random points and fractions of the box;
        functions of weights are also evaluated outside them.

        Raises ValueError for an invalid shape, and where an array has no reach.
        """
        if outputs not in ("first", "last"):
            raise ValueError(f"of_weights takes outputs='first' or 'last'; got {outputs!r}")
        arrays = {str(name): tuple(as_whole(n, f"a side of {name}", least=1) for n in shapes[name]) for name in shapes}
        if isinstance(reach, Mapping) and (lacking := [name for name in arrays if name not in reach]):
            raise ValueError(f"of_weights takes a reach of each array; got none of {', '.join(lacking)}")
        names, upper = list[str](), list[float]()
        for name, shape in arrays.items():
            names += [" ".join(filter(None, (name, ",".join(map(str, at))))) for at in np.ndindex(shape)]
            upper += [float(reach[name] if isinstance(reach, Mapping) else reach)] * math.prod(shape)
        found = cls(names, [-one for one in upper], upper)
        object.__setattr__(found, "arrays", arrays)
        object.__setattr__(found, "outputs", outputs)
        return found

    @property
    def filters(self) -> list[NDArray[np.intp]]:
        """The numbers of the parameters of each filter: the weights of one output of one layer, without biases."""
        found, first = list[NDArray[np.intp]](), 0
        for shape in self.arrays.values():
            own = first + np.arange(math.prod(shape)).reshape(shape)
            first += own.size
            if len(shape) > 1:
                found += list(own.reshape(shape[0], -1) if self.outputs == "first" else own.reshape(-1, shape[-1]).T)
        return found

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.names)

    @property
    def center(self) -> Float[Tensor, " dim"]:
        """Middle of the box."""
        return (self.lower + self.upper) / 2

    @property
    def is_linear(self) -> bool:
        """Whether a point has the parameters' own values, because none of them is logarithmic."""
        return LOG10 not in self.scales

    @property
    def labels(self) -> tuple[str, ...]:
        """Names with units, as on axes and for columns of values."""
        return tuple(map(labelled, self.names, self.units))

    @property
    def scaled_labels(self) -> tuple[str, ...]:
        """Labels of columns of points `x`: a logarithmic parameter is "log10 k [N/m]"."""
        return scaled_labels(self.labels, self.scales)

    def to_values(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Return the parameters' own values at points `x`; each row's bits are independent of its batch."""
        return to_values(tensor_of(x, "to_values"), self.scales)

    def from_values(self, values: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Return the points with the parameters' own values.

        Raises ValueError where one on a logarithmic scale is not positive.
        """
        values = tensor_of(values, "from_values")
        if self.is_linear:
            return values
        for name, scale, column in zip(self.names, self.scales, values.unbind(-1), strict=True):
            if scale == LOG10 and bool((column <= 0).any()):
                raise ValueError(
                    f"{name} is on a logarithmic scale and takes positive values; got {float(column.min()):g}"
                )
        return from_values(values, self.scales)

    def chain(
        self, values: Float[Tensor, "*batch dim"], grad: Float[Tensor, "*batch dim"]
    ) -> Float[Tensor, "*batch dim"]:
        """Return gradients by `x`, given those by the parameters' own `values`: dL/dx = dL/dvalue * value * ln 10."""
        if self.is_linear:
            return grad
        return torch.where(_logarithmic(self.scales), grad * values * math.log(10), grad)

    def from_unit(self, u: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Map the unit cube onto the box."""
        return self.lower + tensor_of(u, "from_unit") * (self.upper - self.lower)

    def to_unit(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Map the box onto the unit cube."""
        return (tensor_of(x, "to_unit") - self.lower) / (self.upper - self.lower)

    def uniform(self, count: int, *, seed: int) -> Float[Tensor, "count dim"]:
        """Draw points uniformly from the box; the same seed gives the same points.

        Raises ValueError where the count or the seed is no integer.
        """
        generator = torch.Generator().manual_seed(as_whole(seed, "a seed"))
        count = as_whole(count, "a count of points")
        return self.from_unit(torch.rand(count, self.dim, generator=generator, dtype=torch.float64))

    def sobol(self, count: int, *, seed: int) -> Float[Tensor, "count dim"]:
        """Return points spread evenly over the box, from a scrambled Sobol sequence; a seed gives the same points."""
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
            raise ValueError(
                f"no parameter is called {parameter!r}; the parameters are {', '.join(self.names)}"
            ) from None
        if not 0 <= number < self.dim:
            raise ValueError(f"parameters are numbered 0 to {self.dim - 1}; got {number}")
        return number


def labelled(name: str, unit: str) -> str:
    """Return a name with its unit, for axes and columns."""
    return f"{name} [{unit}]" if unit else name


def to_values(x: Float[Tensor, "*batch dim"], scales: Sequence[str]) -> Float[Tensor, "*batch dim"]:
    """Return values of points on their scales: 10^x in logarithmic columns.

    NumPy computes them, as the last bits of torch's powers depend on the place in a batch.
    """
    if LOG10 not in scales:
        return x
    chosen, found = _logarithmic(scales), x.detach().clone()
    found[..., chosen] = torch.from_numpy(_power_of_ten(found[..., chosen].numpy()))
    return found


def _power_of_ten(exponents: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 10^x; of all numbers with this logarithm the one of twelve digits, where there is one.

    So bounds return unchanged: 10^log10(5) is 5.000000000000001 in NumPy's rounding, outside a bound of 5.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.asarray(np.power(10.0, exponents))
        digits = values / np.power(10.0, np.floor(exponents)) * 1e11
        near = np.abs(digits - np.rint(digits)) < 0.02  # what rounding of logarithms up to 40 may change
    short = np.array([float(f"{value:.12g}") for value in values[near].tolist()])
    values[near] = np.where(np.log10(short) == exponents[near], short, values[near])
    return values


def from_values(values: Float[Tensor, "*batch dim"], scales: Sequence[str]) -> Float[Tensor, "*batch dim"]:
    """Return points on their scales, the decimal logarithm in logarithmic columns, NaN where there is none."""
    if LOG10 not in scales:
        return values
    chosen, found = _logarithmic(scales), values.detach().clone()
    with np.errstate(divide="ignore", invalid="ignore"):
        found[..., chosen] = torch.from_numpy(np.log10(found[..., chosen].numpy()))
    return found


def scaled_labels(labels: Sequence[str], scales: Sequence[str]) -> tuple[str, ...]:
    """Return what columns of points on their scales are called, given what columns of values are."""
    return tuple(f"{LOG10} {label}" if scale == LOG10 else label for label, scale in zip(labels, scales, strict=True))


def _logarithmic(scales: Sequence[str]) -> Bool[Tensor, " dim"]:
    return torch.tensor([scale == LOG10 for scale in scales])


def sobol(count: int, dim: int, *, seed: int) -> Float[Tensor, "count dim"]:
    """Return the first points of a scrambled Sobol sequence in the unit cube, float64."""
    engine = torch.quasirandom.SobolEngine(dim, scramble=True, seed=seed)  # type: ignore[no-untyped-call]
    points: Tensor = engine.draw(count, dtype=torch.float64)
    return points


def as_whole(value: object, what: str, *, least: int = 0) -> int:
    """Return an integer of 64 bits not below `least`; otherwise raises ValueError, which names `what` it is."""
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
    """Return the stride of gradients: 0 for none, 1 for all samples. Raises ValueError for no integer."""
    return as_whole(int(gradients) if isinstance(gradients, bool) else gradients, "gradients")


def tensor_of(x: object, who: str) -> Float[Tensor, "*shape"]:
    """Return a tensor unchanged, and convert any other numbers."""
    return x if isinstance(x, Tensor) else as_tensor(x, who)


def as_tensor(x: object, who: str) -> Float[Tensor, "*shape"]:
    """Return numbers in a tensor, an array or lists as a float64 tensor on the CPU.

    Raises ValueError, naming `who` takes them, for anything else and for masked arrays.
    """
    if isinstance(x, Tensor):
        if x.is_complex() or x.dtype == torch.bool:
            raise ValueError(f"{who} takes numbers; got a tensor of {x.dtype}")
        return x.detach().to("cpu", torch.float64)
    if any(map(np.ma.is_masked, x if isinstance(x, list | tuple) else [x])):
        raise ValueError(
            f"{who} takes numbers; got an array with masked ones (`.filled(numpy.nan)` turns them into failures)"
        )
    try:
        values = np.asarray(x)
        if values.dtype.kind not in "iuf":
            raise TypeError(f"an array of {values.dtype}" if values.ndim else type(x).__name__)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{who} takes numbers, as a tensor, an array or lists; got {error}") from None
    return torch.from_numpy(np.array(values, dtype=np.float64, order="C"))


def _columns(
    named: Mapping[str, Sequence[Any] | Log],
) -> tuple[list[float], list[float], list[str], list[str]]:
    """Return bounds, units and scales of parameters given as name: (lower, upper), (lower, upper, unit) or log(...)."""
    rows = list[tuple[Any, ...]]()
    for name, bounds in named.items():
        if isinstance(bounds, Log):
            rows.append((bounds.lower, bounds.upper, bounds.unit, LOG10))
        elif isinstance(bounds, str) or not hasattr(bounds, "__len__") or len(bounds) not in (2, 3):
            raise ValueError(
                f"parameter {name!r} needs (lower, upper), (lower, upper, unit) or log(lower, upper, unit); got "
                f"{bounds!r}"
            )
        else:
            rows.append((*(*bounds, "")[:3], LINEAR))
    lower, upper, units, scales = (list(column) for column in zip(*rows, strict=True)) if rows else ([], [], [], [])
    return lower, upper, units, scales
