"""The line or plane through parameter space on which a landscape is sampled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .space import LINEAR, LOG10, ParameterSpace, as_tensor, as_whole, from_values, scaled_labels, tensor_of, to_values

DECADE = "decade"

Bound = float | Sequence[float] | NDArray[Any] | Tensor


@dataclass(frozen=True, eq=False)
class Plane:
    """Span a line (rank 1) or a plane (rank 2) through parameter space.

    A point with plane coordinates `u` has parameters `origin + u @ basis`. `origin` [parameters' own units] is float64
    of shape (dim,). `basis` [parameter unit / plane unit] is float64 of shape (rank, dim), with independent rows of any
    length and angle. `lower` and `upper` [plane units], shape (rank,), bound the samples, with `resolution` points per
    axis including both ends. `labels` name the axes with their units: "speed, segment 3 [m/s]". `scales` are "log10"
    for axes along a logarithmic parameter, whose coordinate is the decimal logarithm of its value.
    """

    origin: Float[Tensor, " dim"]
    basis: Float[Tensor, "rank dim"]
    lower: Float[Tensor, " rank"]
    upper: Float[Tensor, " rank"]
    resolution: tuple[int, ...]
    labels: tuple[str, ...]
    scales: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for field in ("origin", "basis", "lower", "upper"):
            object.__setattr__(self, field, as_tensor(getattr(self, field), f"Plane's {field}"))
        object.__setattr__(
            self, "resolution", tuple(as_whole(n, "a slice's resolution", least=2) for n in self.resolution)
        )
        object.__setattr__(self, "scales", tuple(self.scales) or (LINEAR,) * len(self.basis))
        self._check()

    def _check(self) -> None:
        if self.basis.ndim != 2 or self.basis.shape[0] not in (1, 2):
            raise ValueError(f"Plane needs one or two directions; got a basis of shape {tuple(self.basis.shape)}")
        if self.origin.shape != self.basis.shape[1:]:
            raise ValueError(f"Plane needs an origin of shape ({self.dim},); got {tuple(self.origin.shape)}")
        sizes = {"lower": self.lower.numel(), "upper": self.upper.numel()}
        sizes |= {"resolution": len(self.resolution), "labels": len(self.labels), "scales": len(self.scales)}
        for field, size in sizes.items():
            if size != self.rank:
                raise ValueError(f"Plane of rank {self.rank} needs {self.rank} values of {field}; got {size}")
        if not bool((self.lower < self.upper).all()) or not bool((self.upper - self.lower).isfinite().all()):
            raise ValueError(
                f"Plane needs finite lower < upper on every axis; got {self.lower.tolist()} to {self.upper.tolist()}"
            )
        if not bool(self.origin.isfinite().all()) or not bool(self.basis.isfinite().all()):
            raise ValueError("Plane needs a finite origin and finite directions; got NaN or infinity")
        unit = self.basis / self.basis.norm(dim=1, keepdim=True)
        if not bool(unit.isfinite().all()) or int(torch.linalg.matrix_rank(unit)) < self.rank:
            raise ValueError("Plane needs directions that are neither zero nor parallel; change one of them")

    @classmethod
    def through(
        cls,
        space: ParameterSpace,
        origin: Float[Tensor, " dim"],
        dims: Sequence[str | int],
        *,
        resolution: int | Sequence[int],
        window: float | tuple[Bound, Bound] | None = None,
    ) -> Plane:
        """Vary one or two parameters, given by name or number, and keep the others as at `origin`.

        The plane coordinate is the parameter's own value, or its decimal logarithm if `space` says so. `window` is None
        for the parameters' bounds, or a fraction of them for a window of that size around `origin`, moved to stay
        inside the bounds if it fits. It can also be a pair (lower, upper) of values in the parameters' units, each one
        number or one per axis. Raises ValueError where parameters, point, resolution or window do not fit the space.
        """
        numbers = [space.index(dim) for dim in dims]
        if len(numbers) not in (1, 2) or len(set(numbers)) != len(numbers):
            raise ValueError(
                f"a slice varies one or two different parameters; got {', '.join(map(str, dims)) or 'none'}"
            )
        origin = as_tensor(origin, "a slice's point")
        if origin.shape != (space.dim,):
            raise ValueError(f"a slice takes a point of shape ({space.dim},); got shape {tuple(origin.shape)}")
        scales = tuple(space.scales[number] for number in numbers)
        lower, upper = _bounds(space.lower[numbers], space.upper[numbers], origin[numbers], window, scales)
        start = origin.clone()
        start[numbers] = 0
        basis = torch.eye(space.dim, dtype=torch.float64)[numbers]
        labels = tuple(space.labels[number] for number in numbers)
        return cls(start, basis, lower, upper, _per_axis(resolution, len(numbers)), labels, scales)

    @classmethod
    def span(
        cls,
        origin: Float[Tensor, " dim"],
        directions: Float[Tensor, "rank dim"],
        *,
        resolution: int | Sequence[int],
        window: tuple[Bound, Bound] = (-1.0, 1.0),
        labels: Sequence[str] | None = None,
    ) -> Plane:
        """Span a plane by any directions, unchanged: coordinate 1 is one whole `directions[i]` from `origin`.

        Raises ValueError where the directions are zero or parallel, or sizes do not match.
        """
        origin, directions = (as_tensor(t, "a slice's point and directions") for t in (origin, directions))
        rank = len(directions)
        lower, upper = _ends(window, rank)
        named = labels or [f"along direction {axis + 1}" for axis in range(rank)]
        return cls(origin, directions, lower, upper, _per_axis(resolution, rank), tuple(named))

    @classmethod
    def principal(
        cls,
        points: Float[Tensor, "count dim"],
        *,
        rank: int = 2,
        resolution: int | Sequence[int],
        margin: float = 0.1,
        about: Float[Tensor, " dim"] | None = None,
    ) -> Plane:
        """Lay a plane through the principal directions of a run's points.

        The origin is their mean, or the point `about` which directions are computed. Directions have unit length, the
        largest component positive. The axes cover the projected points and a `margin`, as a fraction of their range.
        Parameters count in their own units, so use comparable ones. Raises ValueError where the points are too few, not
        finite, or spread in fewer directions than `rank`.
        """
        points = as_tensor(points, "a principal plane")
        if points.ndim != 2 or len(points) <= rank:
            raise ValueError(
                f"{rank} principal directions need more than {rank} points; got shape {tuple(points.shape)}"
            )
        if not bool(points.isfinite().all()):
            raise ValueError("a principal plane takes finite points; got NaN or infinity")
        mean = points.mean(dim=0) if about is None else about
        _, scale, directions = torch.linalg.svd(points - mean, full_matrices=False)
        if len(scale) < rank or not bool(scale[rank - 1] > 1e-12 * scale[0]):
            raise ValueError(f"{rank} principal directions need points that spread in {rank} directions; these do not")
        basis = directions[:rank]
        basis = basis * basis.gather(1, basis.abs().argmax(dim=1, keepdim=True)).sign()
        u = (points - mean) @ basis.T
        pad = margin * (u.amax(dim=0) - u.amin(dim=0))
        share = 100 * scale**2 / (scale**2).sum()
        what = "variance" if about is None else "squared distances"
        labels = tuple(f"principal direction {axis + 1} ({share[axis]:.3g} % of {what})" for axis in range(rank))
        return cls(mean, basis, u.amin(dim=0) - pad, u.amax(dim=0) + pad, _per_axis(resolution, rank), labels)

    @property
    def rank(self) -> int:
        """1 for a line, 2 for a plane."""
        return len(self.basis)

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return self.basis.shape[1]

    @property
    def names(self) -> tuple[str, ...]:
        """Axis labels without their units."""
        return tuple(_split_label(label)[0] for label in self.labels)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the axes, empty where they have none."""
        return tuple(_split_label(label)[1] for label in self.labels)

    @property
    def coordinate_units(self) -> tuple[str, ...]:
        """Units of the coordinates: decades along a logarithmic axis, else those of the axes."""
        return tuple(DECADE if scale == LOG10 else unit for unit, scale in zip(self.units, self.scales, strict=True))

    @property
    def scaled_labels(self) -> tuple[str, ...]:
        """Labels of columns of coordinates; those of `to_values` are `labels`."""
        return scaled_labels(self.labels, self.scales)

    def to_values(self, u: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch rank"]:
        """Return the values along the axes, in their units, at plane coordinates `u`."""
        return to_values(u, self.scales)

    def lift(self, u: Float[Tensor, "*batch rank"]) -> Float[Tensor, "*batch dim"]:
        """Return the parameters at plane coordinates `u`; each row's bits are independent of its batch."""
        return self.origin + (tensor_of(u, "lift")[..., :, None] * self.basis).sum(dim=-2)

    def project(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch rank"]:
        """Return the plane coordinates nearest to `x` (least squares in the parameters' own units)."""
        u: Float[Tensor, "*batch rank"] = (tensor_of(x, "project") - self.origin) @ torch.linalg.pinv(self.basis)
        return u

    def distance(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch"]:
        """Return the distance of `x` from the plane (Euclidean, in the parameters' own units)."""
        x = tensor_of(x, "distance")
        off: Float[Tensor, "*batch dim"] = x - self.lift(self.project(x))
        return off.square().sum(dim=-1).sqrt()

    def slope(self, grad: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch rank"]:
        """Return the derivatives along the plane's axes [loss unit / plane unit] (chain rule, so any basis)."""
        return (tensor_of(grad, "slope")[..., None, :] * self.basis).sum(dim=-1)

    def shift_to(self, x: Float[Tensor, " dim"]) -> Plane:
        """Return the parallel plane through `x`, with the same coordinates and the same window."""
        x = tensor_of(x, "moved")
        return replace(self, origin=x - self.project(x) @ self.basis)

    def cell_bounds(self) -> tuple[Float[Tensor, " rank"], Float[Tensor, " rank"]]:
        """Return the area of a picture of the samples: their box and half a sample's width around it."""
        half = (self.upper - self.lower) / (torch.tensor(self.resolution, dtype=torch.float64) - 1) / 2
        return self.lower - half, self.upper + half

    def axes(self) -> tuple[Float[Tensor, " points"], ...]:
        """Return the sampled coordinates of each axis, ascending, both ends included."""
        return tuple(
            torch.linspace(float(low), float(high), count, dtype=torch.float64)
            for low, high, count in zip(self.lower, self.upper, self.resolution, strict=True)
        )

    def grid(self) -> Float[Tensor, "*shape dim"]:
        """Return the parameters at every sample, indexed (v, u, dim), or (u, dim) on a line."""
        axes = torch.meshgrid(*reversed(self.axes()), indexing="ij")
        return self.lift(torch.stack(axes[::-1], dim=-1))

    def record(self) -> dict[str, Any]:
        """Return the plane as plain numbers and strings, exactly."""
        tensors = {name: getattr(self, name).tolist() for name in ("origin", "basis", "lower", "upper")}
        scales = {"scales": list(self.scales)} if LOG10 in self.scales else {}
        return tensors | {"resolution": list(self.resolution), "labels": list(self.labels)} | scales

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Plane:
        """Rebuild a plane from its `record`, bit for bit."""
        origin, basis, lower, upper = (
            torch.tensor(record[name], dtype=torch.float64) for name in ("origin", "basis", "lower", "upper")
        )
        resolution, labels, scales = tuple(record["resolution"]), tuple(record["labels"]), record.get("scales", ())
        return cls(origin, basis, lower, upper, resolution, labels, scales)


def _per_axis(resolution: int | Sequence[int], rank: int) -> tuple[Any, ...]:
    return tuple(resolution) if _is_sequence(resolution) else (resolution,) * rank


def _split_label(label: str) -> tuple[str, str]:
    name, bracket, unit = label.removesuffix("]").partition(" [")  # a unit may hold brackets, a name does not
    return (name, unit) if bracket and label.endswith("]") else (label, "")


def _as_bound(bound: Bound, rank: int) -> Float[Tensor, " rank"]:
    values = as_tensor(bound, "window")
    if values.ndim > 1 or (values.ndim == 1 and len(values) != rank):
        raise ValueError(f"window needs one number per axis, {rank} in all; got {bound}")
    return values.expand(rank).clone()


def _is_sequence(values: object) -> TypeGuard[Sequence[Any]]:
    return isinstance(values, list | tuple) or getattr(values, "ndim", 0) > 0


def _ends(window: Sequence[Bound], rank: int) -> tuple[Float[Tensor, " rank"], Float[Tensor, " rank"]]:
    if len(window) != 2:
        raise ValueError(f"window takes a pair (lower, upper); got {len(window)} values")
    return _as_bound(window[0], rank), _as_bound(window[1], rank)


def _scaled(end: Float[Tensor, " rank"], scales: tuple[str, ...]) -> Float[Tensor, " rank"]:
    for scale, value in zip(scales, end.tolist(), strict=True):
        if scale == LOG10 and not value > 0:
            raise ValueError(f"window takes positive values along a logarithmic parameter; got {value:g}")
    return from_values(end, scales)


def _bounds(
    lower: Float[Tensor, " rank"],
    upper: Float[Tensor, " rank"],
    center: Float[Tensor, " rank"],
    window: float | tuple[Bound, Bound] | None,
    scales: tuple[str, ...],
) -> tuple[Float[Tensor, " rank"], Float[Tensor, " rank"]]:
    if window is None:
        return lower.clone(), upper.clone()
    if _is_sequence(window):
        start, end = _ends(window, len(lower))
        return _scaled(start, scales), _scaled(end, scales)
    fraction = float(as_tensor(window, "window"))
    if not 0 < fraction < np.inf:
        raise ValueError(f"window as a fraction of the bounds must be positive and finite; got {fraction}")
    width = fraction * (upper - lower)
    start = (center - width / 2).clamp(torch.minimum(lower, upper - width), torch.maximum(lower, upper - width))
    return start, start + width
