"""What each part of a scene's model is for: what leaving it out, or putting it in, changes and costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from ..identity import current_identity
from ..objective import has_loss
from ..plain import number, optional, text
from .fidelity import Bootstrap, Comparison, Sample, Seconds, compare
from .tradeoff import RefusedVariant

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figures.page import Picture

BEYOND = 2.0  # times the noise, above which a difference is the part's
SAME_ORDER = 0.99  # rank correlation from which on the order of losses counts as kept: that of a standard fidelity
OFTEN = 0.05  # share of points above which a model without the part fails where the full one does not


class Effect(StrEnum):
    """Say what a part does to the landscape, in the words of its verdict."""

    NOTHING = "moves nothing beyond the noise"
    GRADIENTS = "changes gradients, not losses"
    LOSSES = "changes losses, not their order"
    ORDER = "changes the order"
    FAILURE = "fails where the full model does not"


class Price(StrEnum):
    """Say what a changed part does to the time of an episode."""

    SAVES = "saves time"
    NOTHING = "costs nothing measurable"
    COSTS = "takes longer"


@dataclass(frozen=True)
class Noise:
    """Hold the full model, evaluated again with parameters moved by their last digit, against itself.

    `comparison` is over all repeats; `largest` is the largest difference of losses and `digit` the last digit of the
    largest loss [loss unit], `rounding` the relative precision of the engine. A model that is not deterministic, or
    chaotic, has much noise.
    """

    comparison: Comparison
    largest: float
    digit: float
    rounding: float

    @classmethod
    def of(cls, repeats: Sample, full: Sample, *, rounding: float, seed: int) -> Noise:
        """Hold repeats of the full model against it, point by point; those where either fails are no difference."""
        fine = has_loss(repeats.status) & has_loss(full.status)
        largest = np.abs(repeats.loss - full.loss)[fine].max(initial=0.0)
        digit = rounding * np.abs(full.loss)[fine].max(initial=0.0)
        return cls(compare(repeats, full, seed=seed), float(largest), float(digit), rounding)

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Noise:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        sizes = {name: number(record[name]) for name in ("largest", "digit", "rounding")}
        return cls(Comparison.of_record(record["comparison"]), **sizes)


@dataclass(frozen=True)
class MeasuredPart:
    """Hold what changing a part of the model does: `change` says how it is changed, by which `options`.

    A `missing` part is one that the full model leaves out, and that its options put in. `moved` is the share of points
    whose loss moves beyond the noise; `cost` and `cost_forward` are the time of an episode with and without gradient,
    as ratios to the full model's, measured in turn with it.
    """

    name: str
    change: str
    options: dict[str, Any]
    missing: bool
    comparison: Comparison
    moved: float | None
    cost: Bootstrap
    cost_forward: Bootstrap
    effect: Effect
    price: Price

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> MeasuredPart:
        """Read a part from plain JSON; raises TypeError, KeyError and ValueError for what is none."""
        return cls(
            text(record["name"]),
            text(record["change"]),
            dict(record["options"]),
            bool(record["missing"]),
            Comparison.of_record(record["comparison"]),
            optional(number, record["moved"]),
            Bootstrap.of_record(record["cost"]),
            Bootstrap.of_record(record["cost_forward"]),
            Effect(record["effect"]),
            Price(record["price"]),
        )

    @property
    def verdict(self) -> str:
        """What is found of the part, in words."""
        return f"{self.effect}; {self.price}"


@dataclass(frozen=True)
class ModelStudy:
    """Hold the parts of a scene's model at the same points, all held against the full model at one fidelity.

    `options` are the full model's. `spread` is the 5th to 95th percentile of its losses [`loss_unit`], None where they
    are all equal; `failed` points are left out, it fails there; `seconds` is what an episode of it takes.
    """

    env: str
    fidelity: str
    points: int
    seed: int
    loss_unit: str
    spread: float | None
    failed: int
    seconds: Seconds
    noise: Noise
    parts: tuple[MeasuredPart, ...]
    refused: tuple[RefusedVariant, ...]
    identity: dict[str, Any]
    provenance: dict[str, Any]
    command: str

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> ModelStudy:
        """Read a study from plain JSON; raises TypeError, KeyError and ValueError for what is none."""
        return cls(
            text(record["env"]),
            text(record["fidelity"]),
            record["points"],
            record["seed"],
            text(record["loss_unit"]),
            optional(number, record["spread"]),
            record["failed"],
            Seconds(**{way: number(record["seconds"][way]) for way in ("forward", "with_gradient")}),
            Noise.of_record(record["noise"]),
            tuple(map(MeasuredPart.of_record, record["parts"])),
            tuple(RefusedVariant(text(one["name"]), text(one["why"])) for one in record["refused"]),
            current_identity(record["identity"]),
            dict(record["provenance"]),
            text(record["command"]),
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        return {
            **asdict(self),
            "parts": [asdict(one) for one in self.parts],
            "refused": list(map(asdict, self.refused)),
        }

    @property
    def present(self) -> tuple[MeasuredPart, ...]:
        """The parts that the full model has."""
        return tuple(part for part in self.parts if not part.missing)

    @property
    def missing(self) -> tuple[MeasuredPart, ...]:
        """The parts that it leaves out."""
        return tuple(part for part in self.parts if part.missing)

    def table(self) -> pd.DataFrame:
        """Return a row for each part, those that the model has first, indexed by `name`.

        Columns: `change`, `missing`; `median` and `p95`, of how far losses move as shares of the spread, with the ends
        of the latter's 95 % interval; `moved`, the share of points beyond the noise; `spearman`, `cosine`,
        `relative_error`, `diverged`; `cost`, the time of an episode with gradient as a ratio to the full model's, with
        the ends of its interval; `effect` and `price`, the verdict.
        """
        import pandas as pd

        columns = [_columns(part) for part in (*self.present, *self.missing)]
        return pd.DataFrame(columns, columns=list(columns[0]) if columns else ["name"]).set_index("name")

    def plot(self, width: float | None = None) -> Picture:
        """Draw how far losses move over the time that is saved, for a screen, or for a page so wide [mm]."""
        from ..draw.figures.model import model_figure

        return model_figure(self, width=width)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def _columns(part: MeasuredPart) -> dict[str, Any]:
    found = part.comparison
    p95 = found.loss_error.p95_relative
    return {
        "name": part.name,
        "change": part.change,
        "missing": part.missing,
        "median": found.loss_error.median_relative.value,
        "p95": p95.value,
        "p95_low": p95.low,
        "p95_high": p95.high,
        "moved": part.moved,
        "spearman": found.spearman.value,
        "cosine": found.gradient.cosine.value,
        "relative_error": found.gradient.relative_error.value,
        "diverged": found.diverged,
        "cost": part.cost.value,
        "cost_low": part.cost.low,
        "cost_high": part.cost.high,
        "effect": part.effect.value,
        "price": part.price.value,
    }


def share_moved(part: Sample, full: Sample, noise: Noise) -> float | None:
    """Return the share of points whose loss moves by more than twice the largest noise; None without points."""
    fine = has_loss(part.status) & has_loss(full.status)
    limit = BEYOND * max(noise.largest, noise.digit)
    return float((np.abs(part.loss - full.loss)[fine] > limit).mean()) if fine.any() else None


def judge_effect(found: Comparison, noise: Noise, moved: float | None) -> Effect:
    """Say by fixed rules what a part does.

    It fails where more than one point in twenty fails. It moves losses where one of them moves by more than twice the
    largest noise, or their median or 95th percentile by more than twice that of the noise; and their order where the
    rank correlation is below 0.99 and below the interval of the noise's own. It moves gradients where their median
    relative error is more than twice the noise's, or where more than one point in twenty has lost its own.
    """
    if found.diverged is None or round(found.diverged, 9) > OFTEN:
        return Effect.FAILURE
    own = noise.comparison
    errors = [(found.loss_error.median, own.loss_error.median), (found.loss_error.p95, own.loss_error.p95)]
    if not moved and not any(_exceeds(one, other, noise.digit) for one, other in errors):
        slopes = found.gradient.relative_error, own.gradient.relative_error
        if round(found.missing or 0.0, 9) > OFTEN:
            return Effect.GRADIENTS
        return Effect.GRADIENTS if _exceeds(*slopes, noise.rounding) else Effect.NOTHING
    rank, low = found.spearman.value, own.spearman.low
    kept = SAME_ORDER if low is None else min(SAME_ORDER, low)
    return Effect.ORDER if rank is not None and rank < kept else Effect.LOSSES


def _exceeds(found: Bootstrap, noise: Bootstrap, least: float) -> bool:
    return _size(found) > BEYOND * max(_size(noise), least)


def _size(found: Bootstrap) -> float:
    return np.inf if found.value is None else found.value


def judge_price(cost: Bootstrap) -> Price:
    """Say whether the interval of a ratio of times excludes 1."""
    if cost.high is not None and cost.high < 1:
        return Price.SAVES
    return Price.COSTS if cost.low is not None and cost.low > 1 else Price.NOTHING
