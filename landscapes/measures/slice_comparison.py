"""Compare two slices of one plane: losses, their order, gradients, and their largest differences."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
import xarray as xr

from ..convert import NOT_JSON
from ..identity import (
    ABSENT,
    differing_settings,
    plane_of,
    simulator_parts,
    stored_identity,
    stored_provenance,
    stored_scales,
)
from ..large import refuse_large
from ..lattice import sampled_lattice
from ..objective import Status
from ..space import scaled_labels
from ..statistics import Estimate, Values, exactly, gradient_error, jackknife, median_of, p95_of, spearman
from .ruggedness import box_slopes, span

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figure import Picture
    from ..plane import Plane

PLACING = ("plane", "cut", "boxed", "parameters")  # in a slice's identity: where it lies, not what it is of
PARTS = {"basis": "directions", "lower": "lower ends", "upper": "upper ends", "origin": "points they go through"}
ROUNDING = 1e-9  # planes that are no farther apart, relatively, are the same
ANYTHING = "give the name of an environment as B to sample it on A's plane"
POINTS, RANGE = "of the points", "of A's range"  # what shares are of


@dataclass(frozen=True)
class LossDifference:
    """The differences of losses [loss unit]: `median`, 95th percentile, `largest`; and the `range` of A's losses.

    The largest estimates nothing and has no interval.
    """

    derived: ClassVar = ("shares",)

    median: Estimate
    p95: Estimate
    largest: Estimate
    range: float

    @property
    def shares(self) -> dict[str, Estimate]:
        """Return the three as shares of the range, NaN where all of A's losses are equal."""
        whole = self.range or math.nan
        return {name: _share(getattr(self, name), whole) for name in ("median", "p95", "largest")}


@dataclass(frozen=True)
class SlopeDifference:
    """The differences of gradients along the plane, whose sides count as 1: two that are exactly zero agree.

    Medians of `cosine` and of `ratio`, B's length to A's; `opposing` is the share of points with a cosine below 0.
    """

    cosine: Estimate
    opposing: Estimate
    ratio: Estimate


@dataclass(frozen=True)
class Parting:
    """The point with the largest difference: coordinates by the labels of the plane's axes, and both losses."""

    place: dict[str, float]
    a: float
    b: float


@dataclass(frozen=True)
class StatusPair:
    """The number of points with one status in A and another in B."""

    a: str
    b: str
    points: int


@dataclass(frozen=True, eq=False, repr=False)
class SliceComparison:
    """The comparison of B with A, two slices of one plane; `a` and `b` are their names.

    Of `points`, `compared` have a loss in both; `statuses` counts those with different statuses. `slopes` and `cosine`
    are None where either has no gradients, `parting` where no point is compared. `differing` has both values of every
    differing setting, by its name. `data` are the samples: of refined slices the finest common lattice. It contains,
    NaN where either has none: `difference`, B's losses minus A's [loss unit], and `cosine`, that of the angle between
    gradients along the plane.
    """

    a: str
    b: str
    loss_unit: str
    points: int
    compared: int
    statuses: tuple[StatusPair, ...]
    loss: LossDifference
    spearman: Estimate
    slopes: SlopeDifference | None
    parting: Parting | None
    differing: dict[str, tuple[str, str]]
    data: tuple[xr.Dataset, xr.Dataset] = field(metadata=NOT_JSON)
    difference: xr.DataArray = field(metadata=NOT_JSON)
    cosine: xr.DataArray | None = field(metadata=NOT_JSON)
    command: str

    @property
    def shared(self) -> dict[str, tuple[str, str]]:
        """The differing settings that both slices have."""
        return {name: values for name, values in self.differing.items() if ABSENT not in values}

    def settings(self) -> list[str]:
        """Return a line for each differing setting, and one for those that only one of the two has."""
        said = [f"{name}: {a} in A, {b} in B" for name, (a, b) in self.shared.items()]
        for side, letter in enumerate("AB"):
            if alone := [name for name, values in self.differing.items() if values[1 - side] == ABSENT]:
                said.append(f"only {letter} has {', '.join(alone)}")
        return said

    def table(self) -> pd.DataFrame:
        """Return a row for each number, indexed by `measure`: its `value`, its interval `low` to `high`, its `unit`.

        The unit of a share names its whole.
        """
        import pandas as pd

        rows = [(name, one.value, one.low, one.high, unit) for name, one, unit in self._numbers()]
        return pd.DataFrame(rows, columns=["measure", "value", "low", "high", "unit"]).set_index("measure")

    def _numbers(self) -> list[tuple[str, Estimate, str]]:
        """Return each number with its name and unit."""
        names = {
            "median": "median difference", "p95": "difference, 95 % of the points", "largest": "largest difference",
        }  # fmt: skip
        rows = [("loss in both", exactly(self.compared / self.points), POINTS)]
        rows += [(name, getattr(self.loss, field), self.loss_unit) for field, name in names.items()]
        shares = self.loss.shares
        rows += [(f"{name}, relative", shares[field], RANGE) for field, name in names.items()]
        rows += [("rank correlation", self.spearman, "")]
        if self.slopes:
            rows += [("cosine of gradients, median", self.slopes.cosine, "")]
            rows += [("opposing gradients", self.slopes.opposing, POINTS)]
            rows += [("length of gradients, B to A, median", self.slopes.ratio, "")]
        return rows

    def plot(self, width: float | None = None) -> Picture:
        """Draw both losses on one scale, their difference, and the cosine of gradients.

        It returns a matplotlib figure; `width` is that of a page [mm], None that of a screen.
        """
        from ..draw.figure import figure_of

        return figure_of(self, width)

    def __repr__(self) -> str:
        """Return the compared slices and the result in a line."""
        return f"<SliceComparison of {self.a} and {self.b}: rank correlation {self.spearman.value:.3g}>"

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def compare_slices(a: xr.Dataset, b: xr.Dataset, *, command: str = "") -> SliceComparison:
    """Compare the slice B with the slice A of the same plane.

    Intervals leave out blocks of the plane in turn (`statistics.jackknife`), because neighbours depend on each other:
    they cover what another part of the plane could have given. The 95th percentile is the next larger difference.
    Raises ValueError where the two differ in plane, parameters or units, or are not complete.
    """
    check_landscapes(parameters(a), parameters(b), loss_unit(a), loss_unit(b))
    check_planes(plane_of(a), plane_of(b))
    check_finished(a, b)
    a, b = _on_one_lattice(a, b)
    differing = differing_settings(*(_settings(one) for one in (a, b)))
    losses, cosine = [one["loss"].to_numpy() for one in (a, b)], _cosine(a, b)
    refuse_large(np.stack(losses))
    apart, names = np.abs(losses[1] - losses[0]), _names(a, b, differing)
    known = np.isfinite(apart)
    return SliceComparison(
        a=names[0],
        b=names[1],
        loss_unit=loss_unit(a),
        points=apart.size,
        compared=int(known.sum()),
        statuses=_statuses(a, b),
        loss=LossDifference(
            _over_blocks(median_of, apart, least=0),
            _over_blocks(p95_of, apart, least=0),
            exactly(float(apart[known].max()) if known.any() else math.nan),
            span(np.where(known, losses[0], np.nan)) if known.any() else math.nan,
        ),
        spearman=_over_blocks(spearman, *losses, least=-1, most=1),
        slopes=None if cosine is None else _compare_slopes(a, b, cosine.to_numpy()),
        parting=_part(a, losses, apart) if known.any() else None,
        differing=differing,
        data=(a, b),
        difference=b["loss"].copy(data=losses[1] - losses[0]).rename("difference"),
        cosine=cosine,
        command=command,
    )


def check_landscapes(ours: Sequence[str], theirs: Sequence[str], unit: str, other: str) -> None:
    """Raise ValueError where B has other parameters than A, or losses in another unit."""
    if list(ours) != list(theirs):
        pairs = zip(ours, theirs, strict=False)
        first = next(((x, y) for x, y in pairs if x != y), (f"{len(ours)} of them", f"{len(theirs)}"))
        raise ValueError(
            f"slices to compare need the same parameters; A has {first[0]} where B has {first[1]}, so compare "
            "landscapes of one space"
        )
    if unit != other:
        raise ValueError(
            f"losses to compare need the same unit; A's is {unit or 'none'} and B's {other or 'none'}, so compare "
            "landscapes with the same loss"
        )


def check_planes(ours: Plane, theirs: Plane) -> None:
    """Raise ValueError where two planes, or their samples, differ, and name the difference."""
    if ours.resolution != theirs.resolution:
        sizes = (" x ".join(map(str, one.resolution)) for one in (ours, theirs))
        raise ValueError("slices to compare need the same points; A has {} and B {}; ".format(*sizes) + ANYTHING)
    for name, said in PARTS.items():
        one, other = getattr(ours, name), getattr(theirs, name)
        if not torch.allclose(one, other, rtol=ROUNDING, atol=ROUNDING * float(one.abs().max())):
            values = _name_axes(ours, theirs) if name == "basis" else _where_apart(one, other)
            raise ValueError(f"slices to compare need the same plane; the {said} differ: {values}; {ANYTHING}")


def check_finished(*slices: xr.Dataset) -> None:
    """Raise ValueError where samples are missing."""
    for name, dataset in zip("AB", slices, strict=False):
        if missing := int((dataset["status"] == Status.MISSING).sum()):
            raise ValueError(f"{missing} samples of {name} are missing; finish sampling it first")


def _name_axes(ours: Plane, theirs: Plane) -> str:
    return " and ".join(f"{name} is along {', '.join(one.names)}" for name, one in (("A", ours), ("B", theirs)))


def _where_apart(one: torch.Tensor, other: torch.Tensor) -> str:
    at = int((one - other).abs().argmax())
    return f"number {at} is {float(one[at]):.6g} in A and {float(other[at]):.6g} in B"


def parameters(dataset: xr.Dataset) -> list[str]:
    """Return the names of a slice's parameters, with their scales."""
    return list(scaled_labels([str(name) for name in dataset["dim"].to_numpy()], stored_scales(dataset)))


def loss_unit(dataset: xr.Dataset) -> str:
    """Return the unit of a slice's losses, empty where they have none."""
    return str(dataset["loss"].attrs.get("units", ""))


def _on_one_lattice(a: xr.Dataset, b: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Return two slices as `sampled_lattice` does, on the same lattice, v before u."""
    a, b = (one.transpose("v", "u", ..., missing_dims="ignore") for one in (a, b))
    lacking = [one["status"].to_numpy() == Status.INTERPOLATED for one in (a, b)]
    either = lacking[0] | lacking[1]
    marked = (
        one.assign(status=one["status"].copy(data=np.where(either, Status.INTERPOLATED, one["status"].to_numpy())))
        for one in (a, b)
    )
    first, second = (sampled_lattice(one) for one in marked)
    return first, second


def _settings(dataset: xr.Dataset) -> dict[str, Any]:
    """Return the settings of a slice, from its identity, and the versions of packages that made it."""
    identity = {name: value for name, value in stored_identity(dataset).items() if name not in PLACING}
    settings = {name: value for name, value in identity.get("settings", {}).items() if name != "name"}  # the fidelity's
    return {**identity, "settings": settings, "versions": stored_provenance(dataset).get("versions", {})}


def _names(a: xr.Dataset, b: xr.Dataset, differing: dict[str, tuple[str, str]]) -> list[str]:
    """Name objective and fidelity of both; if these are equal, the first differing setting."""
    known = [stored_identity(one) for one in (a, b)]
    names = [" · ".join(simulator_parts(one)) for one in known]
    if names[0] == names[1] and differing:
        setting, values = next(iter(differing.items()))
        short = setting.rpartition(".")[2]
        return [f"{name} · {short} {value.strip(chr(39))}" for name, value in zip(names, values, strict=True)]
    return names


def _statuses(a: xr.Dataset, b: xr.Dataset) -> tuple[StatusPair, ...]:
    """Count the pairs of different statuses, the most frequent first."""
    pairs = Counter(zip(*(one["status"].to_numpy().ravel().tolist() for one in (a, b)), strict=True))
    return tuple(
        StatusPair(Status(one).name.lower(), Status(other).name.lower(), count)
        for (one, other), count in pairs.most_common()
        if one != other
    )


def _compare_slopes(a: xr.Dataset, b: xr.Dataset, cosine: Values) -> SlopeDifference:
    return SlopeDifference(
        _over_blocks(median_of, cosine, least=-1, most=1),
        _over_blocks(_opposing, cosine, least=0, most=1),
        _over_blocks(median_of, _ratio(box_slopes(a), box_slopes(b)), least=0),
    )


def _opposing(cosine: Values) -> Values:
    return np.asarray((cosine < 0).mean())


def _cosine(a: xr.Dataset, b: xr.Dataset) -> xr.DataArray | None:
    """Return the cosine between gradients along the plane, NaN where either failed; None without gradients."""
    if "grad" not in a or "grad" not in b:
        return None
    ours, theirs = (box_slopes(one) for one in (a, b))
    found, _ = gradient_error(*(one.reshape(-1, one.shape[-1]) for one in (theirs, ours)))
    known = np.isfinite(ours).all(axis=-1) & np.isfinite(theirs).all(axis=-1)
    return a["loss"].copy(data=np.where(known, found.reshape(known.shape), np.nan)).rename("cosine").drop_attrs()


def _ratio(ours: Values, theirs: Values) -> Values:
    """Return the length of slopes, theirs to ours: 1 of two that are zero, NaN where either is unknown."""
    lengths = [np.linalg.norm(one, axis=-1) for one in (ours, theirs)]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((lengths[0] == 0) & (lengths[1] == 0), 1.0, lengths[1] / lengths[0])


def _part(dataset: xr.Dataset, losses: Sequence[Values], apart: Values) -> Parting:
    """Return the point of the largest difference."""
    at = np.unravel_index(np.nanargmax(apart), apart.shape)
    plane = plane_of(dataset)
    u = (float(axis[index]) for axis, index in zip(plane.axes(), at[::-1], strict=True))
    return Parting(dict(zip(plane.scaled_labels, u, strict=True)), *(float(loss[at]) for loss in losses))


def _over_blocks(
    statistic: Callable[..., Values], *fields: Values, least: float = -math.inf, most: float = math.inf
) -> Estimate:
    """Estimate a statistic of matching fields over the plane, where none of them is NaN."""
    known = ~np.any([np.isnan(one) for one in fields], axis=0)
    numbers = np.where(known, np.arange(known.size).reshape(known.shape), np.nan)

    def of(some: Values) -> float:
        rows = some[~np.isnan(some)].astype(np.intp)
        return float(statistic(*(one.ravel()[rows] for one in fields))) if len(rows) else math.nan

    return jackknife(of, numbers, least=least, most=most)


def _share(estimate: Estimate, whole: float) -> Estimate:
    return Estimate(estimate.value / whole, estimate.low / whole, estimate.high / whole)
