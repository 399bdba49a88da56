"""The census of an environment, as it is measured, read and drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..identity import current_identity
from ..plain import number, optional, or_nan, plain, text
from ..statistics import Estimate
from .census import MEASURES, CensusDesign, SurveyedSlice, ordered
from .census_statistics import QUANTILES, Parts, Spread, bootstrap, divide, spread, word_shares

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figure import Picture


@dataclass(frozen=True)
class CensusedSlice:
    """Say what one slice of a census is: the numbers of its base point and cut, its axes, range and words.

    `range` [loss unit] is from its lowest to its highest loss, None where all failed; `measures` are by the order of
    `census.MEASURES`; `failed` is the share of its samples without a loss.
    """

    base: int
    cut: int
    axes: tuple[str, ...]
    range: tuple[float, float] | None
    failed: float
    measures: tuple[float | None, ...]
    words: tuple[str, ...]


@dataclass(frozen=True)
class Census:
    """Hold what many slices of an environment are like.

    `words` says of every word which share of the slices it fits, `spreads` and `parts` say of every measure how it is
    distributed and what its variance goes with. `other` is the fidelity that some slices were measured at, too, empty
    where there is none. Slices have gradients at every so many samples along each axis, `gradients`. `losses`
    [loss unit] are those of the slices, shape (slice, v, u), in a file of their own.
    """

    env: str
    fidelity: str
    other: str
    loss_unit: str
    along: str
    resolution: int
    gradients: int
    seed: int
    episodes: int
    slices: tuple[CensusedSlice, ...]
    words: dict[str, Estimate]
    spreads: dict[str, Spread]
    parts: dict[str, Parts]
    identity: dict[str, Any]
    provenance: dict[str, Any]
    command: str
    losses: NDArray[np.float32] = field(repr=False, compare=False)

    @classmethod
    def of_record(cls, record: Mapping[str, Any], losses: NDArray[np.float32]) -> Census:
        """Read it from plain JSON and the losses; raises TypeError and KeyError for what is none."""
        return cls(
            env=text(record["env"]),
            fidelity=text(record["fidelity"]),
            other=text(record["other"]),
            loss_unit=text(record["loss_unit"]),
            along=text(record["along"]),
            resolution=int(number(record["resolution"])),
            gradients=int(number(record.get("gradients", 1))),  # 0.1 had them everywhere
            seed=int(number(record["seed"])),
            episodes=int(number(record["episodes"])),
            command=text(record["command"]),
            slices=tuple(map(_slice, record["slices"])),
            words={word: Estimate.of_record(one) for word, one in record["words"].items()},
            spreads={name: _spread(one) for name, one in record["spreads"].items()},
            parts={name: Parts(**{key: or_nan(one[key]) for key in _PARTS}) for name, one in record["parts"].items()},
            identity=current_identity(record["identity"]),
            provenance=dict(record["provenance"]),
            losses=losses,
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON, by the names of its fields, without the losses."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "losses"}
        fields["slices"] = [asdict(one) for one in self.slices]
        for name in ("words", "spreads", "parts"):
            fields[name] = {key: asdict(one) for key, one in fields[name].items()}
        return {name: plain(value) for name, value in fields.items()}

    @property
    def order(self) -> list[int]:
        """The numbers of the slices, the least rugged first."""
        return ordered([np.array([np.nan if m is None else m for m in one.measures]) for one in self.slices])

    def table(self) -> pd.DataFrame:
        """Return a row for each measure, indexed by `measure`.

        Columns: the quantiles over the slices, `median` with `low` and `high`, and the shares of the variance that go
        with `base`, `cut`, `both`, `resolution` and `fidelity`.
        """
        import pandas as pd

        rows = []
        for name, one in self.spreads.items():
            quantiles = dict(zip([f"{q:.0%}" for q in QUANTILES], one.quantiles, strict=True))
            middle = {"median": one.median.value, "low": one.median.low, "high": one.median.high}
            rows.append({"measure": name, **quantiles, **middle, **asdict(self.parts[name])})
        return pd.DataFrame(rows).set_index("measure")

    def plot(self, width: float | None = None) -> Picture:
        """Draw every slice small, the least rugged first, for a screen, or for a page so wide [mm]."""
        from ..draw.figure import figure_of

        return figure_of(self, width)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


_PARTS = tuple(Parts.__dataclass_fields__)


def conclude(
    design: CensusDesign,
    found: Sequence[SurveyedSlice],
    others: Mapping[int, SurveyedSlice],
    *,
    seed: int,
    **about: Any,
) -> Census:
    """Sum up the slices of a design, and those that were measured at another fidelity, too, by their numbers."""
    drawn = bootstrap(design.places, seed=seed)
    shape = len(design.bases), len(design.cuts)
    whole, halved = (
        np.array([getattr(one, name) for one in found]).reshape(*shape, -1) for name in ("measures", "halved")
    )
    spreads, parts = {}, {}
    for k, name in enumerate(MEASURES):
        spreads[name] = spread(whole[..., k].ravel(), drawn)
        other = {at: float(one.measures[k]) for at, one in others.items()}
        parts[name] = divide(whole[..., k], halved[..., k], other, design.places)
    places = zip(design.places, found, strict=True)
    return Census(
        along="random" if design.cuts[0].dims is None else "pairs",
        resolution=design.resolution,
        gradients=design.gradients,
        seed=seed,
        episodes=sum(one.episodes for one in (*found, *others.values())),
        slices=tuple(_sum_up(one, *place, design.plane(*place).labels) for place, one in places),
        words=word_shares([one.words for one in found], drawn),
        spreads=spreads,
        parts=parts,
        losses=np.array([one.loss for one in found], dtype=np.float32),
        **about,
    )


def _sum_up(found: SurveyedSlice, base: int, cut: int, axes: tuple[str, ...]) -> CensusedSlice:
    known = found.loss[np.isfinite(found.loss)]
    ends = (float(known.min()), float(known.max())) if known.size else None
    measures = tuple(None if not np.isfinite(one) else float(one) for one in found.measures)
    return CensusedSlice(base, cut, axes, ends, 1 - known.size / found.loss.size, measures, found.words)


def _slice(record: Mapping[str, Any]) -> CensusedSlice:
    ends = record["range"]
    return CensusedSlice(
        base=int(number(record["base"])),
        cut=int(number(record["cut"])),
        axes=tuple(map(text, record["axes"])),
        range=None if ends is None else (number(ends[0]), number(ends[1])),
        failed=number(record["failed"]),
        measures=tuple(optional(number, one) for one in record["measures"]),
        words=tuple(map(text, record["words"])),
    )


def _spread(record: Mapping[str, Any]) -> Spread:
    return Spread(tuple(map(or_nan, record["quantiles"])), Estimate.of_record(record["median"]))
