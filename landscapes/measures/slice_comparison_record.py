"""What came of holding two slices of one plane against each other: its numbers, its table, its picture."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..identity import ABSENT
from ..plain import plain
from ..statistics import Estimate

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from ..draw.figure import Picture

POINTS, RANGE = "of the points", "of A's range"  # what shares are of


@dataclass(frozen=True)
class LossDifference:
    """Hold how far losses are apart [loss unit]: `median`, 95th percentile, `largest`; and the `range` of A's losses.

    Nothing is estimated by the largest, which has no interval.
    """

    median: Estimate
    p95: Estimate
    largest: Estimate
    range: float

    def shares(self) -> dict[str, Estimate]:
        """Return the three as shares of the range, NaN where A's losses are all the same."""
        whole = self.range or math.nan
        return {name: _share(getattr(self, name), whole) for name in ("median", "p95", "largest")}


@dataclass(frozen=True)
class SlopeDifference:
    """Hold how gradients differ along the plane, whose sides count as 1: two that are exactly zero agree.

    Medians of `cosine` and of `ratio`, B's length to A's; `opposing` is the share of points with a cosine below 0.
    """

    cosine: Estimate
    opposing: Estimate
    ratio: Estimate


@dataclass(frozen=True)
class Parting:
    """Say where losses are farthest apart: coordinates by the labels of the plane's axes, and both losses there."""

    place: dict[str, float]
    a: float
    b: float


@dataclass(frozen=True)
class StatusPair:
    """Count the points that ended in one way in A and in another in B."""

    a: str
    b: str
    points: int


@dataclass(frozen=True, eq=False, repr=False)
class SliceComparison:
    """Hold B against A, two slices of one plane; `a` and `b` name what they are of.

    Of `points`, `compared` have a loss in both; `statuses` counts those that ended differently. `slopes` and `cosine`
    are None where either has no gradients, `parting` where no point is compared. `differing` has both values of every
    setting that is not the same, by its name. `data` are the samples: of refined slices the finest lattice that both
    sampled. Over them, NaN where either has none: `difference`, B's losses less A's [loss unit], and `cosine`, that of
    the angle between gradients along the plane.
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
    data: tuple[xr.Dataset, xr.Dataset]
    difference: xr.DataArray
    cosine: xr.DataArray | None
    command: str

    @property
    def shared(self) -> dict[str, tuple[str, str]]:
        """Those of the settings that differ which both slices have."""
        return {name: values for name, values in self.differing.items() if ABSENT not in values}

    def settings(self) -> list[str]:
        """Return a line for each setting that differs, and one for those that only one of the two has."""
        said = [f"{name}: {a} in A, {b} in B" for name, (a, b) in self.shared.items()]
        for side, letter in enumerate("AB"):
            if alone := [name for name, values in self.differing.items() if values[1 - side] == ABSENT]:
                said.append(f"only {letter} has {', '.join(alone)}")
        return said

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON, by the names of its fields; what is infinite or not known is None."""
        loss, slopes, parting = self.loss, self.slopes, self.parting
        found: dict[str, Any] = plain(
            {
                **{name: getattr(self, name) for name in ("a", "b", "loss_unit", "points", "compared")},
                "statuses": [asdict(one) for one in self.statuses],
                "loss": {**vars(loss), "shares": loss.shares()},
                "spearman": self.spearman,
                "slopes": vars(slopes) if slopes else None,
                "parting": asdict(parting) if parting else None,
                "differing": {name: {"a": a, "b": b} for name, (a, b) in self.differing.items()},
                "command": self.command,
            }
        )
        return found

    def table(self) -> pd.DataFrame:
        """Return a row for each number, indexed by `measure`: its `value`, its interval `low` to `high`, its `unit`.

        The unit of a share is what it is a share of.
        """
        import pandas as pd

        rows = [(name, one.value, one.low, one.high, unit) for name, one, unit in self._numbers()]
        return pd.DataFrame(rows, columns=["measure", "value", "low", "high", "unit"]).set_index("measure")

    def _numbers(self) -> list[tuple[str, Estimate, str]]:
        """Return each number with its name and unit."""
        names = {
            "median": "median difference",
            "p95": "difference, 95 % of the points",
            "largest": "largest difference",
        }
        rows = [("loss in both", exactly(self.compared / self.points), POINTS)]
        rows += [(name, getattr(self.loss, field), self.loss_unit) for field, name in names.items()]
        shares = self.loss.shares()
        rows += [(f"{name}, relative", shares[field], RANGE) for field, name in names.items()]
        rows += [("rank correlation", self.spearman, "")]
        if self.slopes:
            rows += [("cosine of gradients, median", self.slopes.cosine, "")]
            rows += [("opposing gradients", self.slopes.opposing, POINTS)]
            rows += [("length of gradients, B to A, median", self.slopes.ratio, "")]
        return rows

    def plot(self, width: float | None = None) -> Picture:
        """Draw both losses on one scale, their difference, and the cosine of gradients.

        The picture is matplotlib's figure; `width` is that of a page [mm], and none that of a screen.
        """
        from ..draw.figure import figure_of

        return figure_of(self, width)

    def __repr__(self) -> str:
        """Return in a line what is compared and what came out."""
        return f"<SliceComparison of {self.a} and {self.b}: rank correlation {self.spearman.value:.3g}>"

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def exactly(value: float) -> Estimate:
    """Return a number that is of these samples, and estimates nothing."""
    return Estimate(value, math.nan, math.nan)


def _share(estimate: Estimate, whole: float) -> Estimate:
    return Estimate(estimate.value / whole, estimate.low / whole, estimate.high / whole)
