"""The extremes of a scene, as they are measured, read and drawn: limits of its knobs, and maps of pairs of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..identity import current_identity
from ..plain import number, optional, plain, text
from .stability import Cell

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figures.page import Picture


@dataclass(frozen=True)
class Limit:
    """Hold how far one knob can be turned, in one precision, from `base`, where the scene has it.

    `end` says which way: largest or smallest. `stable` is the last value before the first failure, `failed` the first
    one that was seen to fail, either None where there is none; `islands` are stable stretches beyond that. In the same
    way losses are right up to `accurate` and no more at `wrong`: bisected of a knob that the reference does not share,
    else by rungs. `rungs` are the values that were scanned, in order, whatever happened at them; `dearer` counts those
    left out as too dear.
    """

    knob: str
    unit: str
    precision: str
    end: str
    base: float
    stable: float | None
    failed: float | None
    beyond: str
    accurate: float | None
    wrong: float | None
    islands: tuple[tuple[float, float], ...]
    rungs: tuple[Cell, ...]
    dearer: int = 0

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Limit:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(
            knob=text(record["knob"]),
            unit=text(record["unit"]),
            precision=text(record["precision"]),
            end=text(record["end"]),
            beyond=text(record["beyond"]),
            base=number(record["base"]),
            stable=optional(number, record["stable"]),
            failed=optional(number, record["failed"]),
            accurate=optional(number, record["accurate"]),
            wrong=optional(number, record["wrong"]),
            islands=tuple((number(low), number(high)) for low, high in record["islands"]),
            rungs=_cells(record["rungs"]),
            dearer=int(number(record["dearer"])),
        )

    @property
    def margin(self) -> float | None:
        """The base as a share of the largest stable value, or of the smallest one its inverse; None without one.

        Below one the scene is stable; where nothing failed it is that share of the farthest value that was tried.
        """
        return self._share(self.stable)

    @property
    def accurate_margin(self) -> float | None:
        """The base as a share of the largest accurate value, or of the smallest one its inverse; None without one."""
        return self._share(self.accurate)

    def _share(self, end: float | None) -> float | None:
        if not end or not self.base:
            return None
        return self.base / end if self.end == "largest" else end / self.base


@dataclass(frozen=True)
class StabilityMap:
    """Hold how a scene ended at a grid of two knobs, in one precision.

    `cells` go along `x` first, then along `y`. `boundary` has for values of `y` the last stable value along x and the
    first that failed, between which the limit lies; values of y at which nothing or all of x failed have none.
    `accurate_boundary` is the same of the last accurate value and the first that is not, where the reference does not
    share x.
    """

    x: str
    y: str
    units: tuple[str, str]
    precision: str
    base: tuple[float, float]
    xs: tuple[float, ...]
    ys: tuple[float, ...]
    cells: tuple[Cell, ...]
    boundary: tuple[tuple[float, float, float], ...]  # y, stable x, failed x
    accurate_boundary: tuple[tuple[float, float, float], ...]

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> StabilityMap:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        first, second = record["units"]
        at, along = record["base"]
        return cls(
            x=text(record["x"]),
            y=text(record["y"]),
            units=(text(first), text(second)),
            precision=text(record["precision"]),
            base=(number(at), number(along)),
            xs=tuple(map(number, record["xs"])),
            ys=tuple(map(number, record["ys"])),
            cells=_cells(record["cells"]),
            boundary=_boundary(record["boundary"]),
            accurate_boundary=_boundary(record["accurate_boundary"]),
        )


@dataclass(frozen=True)
class RefusedSetting:
    """Say which setting the scene refused, or had no reference for, and why."""

    name: str
    why: str


@dataclass(frozen=True)
class Extremes:
    """Hold what a scene does where its knobs are turned far, at the same points everywhere.

    `fidelity` is what the knobs are turned from, `reference` the one whose losses tell whether finite ones are right,
    within `accuracy` of their spread; limits are known to a relative `width`.
    """

    env: str
    fidelity: str
    reference: str
    points: int
    seed: int
    width: float
    accuracy: float
    limits: tuple[Limit, ...]
    maps: tuple[StabilityMap, ...]
    refused: tuple[RefusedSetting, ...]
    identity: dict[str, Any]
    provenance: dict[str, Any]
    command: str

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Extremes:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(
            env=text(record["env"]),
            fidelity=text(record["fidelity"]),
            reference=text(record["reference"]),
            points=int(number(record["points"])),
            seed=int(number(record["seed"])),
            width=number(record["width"]),
            accuracy=number(record["accuracy"]),
            limits=tuple(map(Limit.of_record, record["limits"])),
            maps=tuple(map(StabilityMap.of_record, record["maps"])),
            refused=tuple(RefusedSetting(text(one["name"]), text(one["why"])) for one in record["refused"]),
            identity=current_identity(record["identity"]),
            provenance=dict(record["provenance"]),
            command=text(record["command"]),
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON, by the names of its fields; limits with their margin."""
        limits = [{**asdict(one), "margin": one.margin, "accurate_margin": one.accurate_margin} for one in self.limits]
        found: dict[str, Any] = plain({**asdict(self), "limits": limits})
        return found

    @property
    def precisions(self) -> list[str]:
        """The precisions that were tried, in order."""
        return list(dict.fromkeys(one.precision for one in self.limits))

    def table(self) -> pd.DataFrame:
        """Return a row for each end of each knob in each precision, indexed by `knob`, `end` and `precision`.

        Columns: `base`; `stable` and `failed`, between which the limit lies; `margin`; `beyond`, what happens there;
        `accurate` and `wrong`, up to where losses are right and where no more; `error`, at the last stable rung;
        `islands`.
        """
        import pandas as pd

        rows = [
            {
                **{name: getattr(one, name) for name in ("knob", "end", "precision", "base", "stable", "failed")},
                **{name: getattr(one, name) for name in ("margin", "beyond", "accurate", "wrong", "islands")},
                "error": last_error(one.rungs),
            }
            for one in self.limits
        ]
        return pd.DataFrame(rows).set_index(["knob", "end", "precision"])

    def plot(self, width: float | None = None) -> Picture:
        """Draw losses' errors over the knobs, and the maps, for a screen, or for a page so wide [mm]."""
        from ..draw.figures.extremes import extremes_figure

        return extremes_figure(self, width=width)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def last_error(rungs: Sequence[Cell]) -> float | None:
    """Return the loss error at the last rung before the first failure: how wrong losses get while they are finite."""
    error = None
    for cell in rungs:
        if not cell.stable:
            break
        error = cell.error
    return error


def _boundary(found: Sequence[Sequence[Any]]) -> tuple[tuple[float, float, float], ...]:
    return tuple((number(y), number(low), number(high)) for y, low, high in found)


def _cells(found: Sequence[Mapping[str, Any]]) -> tuple[Cell, ...]:
    return tuple(
        Cell(
            tuple(map(number, one["values"])),
            text(one["outcome"]),
            number(one["share"]),
            error=optional(number, one["error"]),
            loss=optional(number, one["loss"]),
            slope=optional(number, one["slope"]),
            why=text(one["why"]),
        )
        for one in found
    )
