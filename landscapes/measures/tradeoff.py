"""Accuracy against speed of a scene, as it is measured, read and drawn: the variants, and which of them no other beats.

The file's keys are those of its first version: variants are its `rungs`, and what a variant changes is its `ladder`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..identity import MODEL_VERSION, current_identity
from ..plain import number, optional, text
from .fidelity import Comparison, ConvergenceOrder, convergence_order, pareto_front

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figures.page import Picture


@dataclass(frozen=True)
class MeasuredVariant:
    """Hold one way to simulate a scene and what was measured of it.

    `changed` names the setting that differs from a named fidelity, "named" where none does; `fidelity` holds the
    settings by name, and `memory` what an episode takes [bytes] as the scene estimates it.
    """

    name: str
    changed: str
    fidelity: dict[str, Any]
    engine: str
    device: str
    options: dict[str, Any]
    memory: int | None
    comparison: Comparison

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> MeasuredVariant:
        """Read a variant from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(
            text(record["name"]),
            text(record["ladder"]),
            dict(record["fidelity"]),
            text(record["engine"]),
            text(record["device"]),
            dict(record["options"]),
            record["memory"],
            Comparison.of_record(record),
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        return {
            "name": self.name,
            "ladder": self.changed,
            "fidelity": self.fidelity,
            "engine": self.engine,
            "device": self.device,
            "options": self.options,
            "memory": self.memory,
            **asdict(self.comparison),
        }

    @property
    def seconds(self) -> float:
        """What an episode with gradient takes [s]."""
        return self.comparison.seconds.with_gradient

    def is_otherwise(self, other: MeasuredVariant) -> bool:
        """Say whether they differ in more than time step and precision."""
        return self._others() != other._others()

    def _others(self) -> tuple[Any, ...]:
        same = {**self.fidelity, "name": "", "dt": 0, "precision": ""}
        return same, self.engine, self.device, self.options


@dataclass(frozen=True)
class RefusedVariant:
    """Say which variant the scene or its engine refused, and why."""

    name: str
    why: str


@dataclass(frozen=True)
class Tradeoff:
    """Hold the variants of a scene at the same points, all held against the first of them, the reference.

    `spread` is the 5th to 95th percentile of the reference's losses [`loss_unit`], None where they are all equal.
    """

    env: str
    reference: str
    points: int
    seed: int
    loss_unit: str
    spread: float | None
    reference_failed: int
    variants: tuple[MeasuredVariant, ...]
    refused: tuple[RefusedVariant, ...]
    orders: tuple[ConvergenceOrder, ...]
    identity: dict[str, Any]
    provenance: dict[str, Any]
    command: str

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Tradeoff:
        """Read a trade-off from plain JSON; raises TypeError and KeyError for what is none."""
        identity = current_identity(record["identity"])
        number(identity[MODEL_VERSION])
        for said in (identity["engine"], identity["device"]):
            text(said)
        dict(identity["options"])
        return cls(
            text(record["env"]),
            text(record["reference"]),
            record["points"],
            record["seed"],
            text(record["loss_unit"]),
            optional(number, record["spread"]),
            record["reference_failed"],
            tuple(map(MeasuredVariant.of_record, record["rungs"])),
            tuple(RefusedVariant(text(one["name"]), text(one["why"])) for one in record["refused"]),
            tuple(
                ConvergenceOrder(tuple(one["rungs"]), number(one["order"]), number(one["standard_error"]))
                for one in record["orders"]
            ),
            identity,
            dict(record["provenance"]),
            text(record["command"]),
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON, by the keys of the file."""
        return {
            "env": self.env,
            "reference": self.reference,
            "points": self.points,
            "seed": self.seed,
            "loss_unit": self.loss_unit,
            "spread": self.spread,
            "reference_failed": self.reference_failed,
            "rungs": [one.record() for one in self.variants],
            "refused": [asdict(one) for one in self.refused],
            "orders": [
                {"rungs": list(one.variants), "order": one.order, "standard_error": one.standard_error}
                for one in self.orders
            ],
            "identity": self.identity,
            "provenance": self.provenance,
            "command": self.command,
        }

    @property
    def front(self) -> list[str]:
        """The Pareto front: the variants quicker than the reference that no other beats in both, quickest first."""
        rows = sorted(self.variants, key=lambda one: one.seconds)
        others = rows[: [row.name for row in rows].index(self.reference)]  # a slower one is beaten by it
        errors = [math.inf if (off := row.comparison.p95(relative=False)) is None else off for row in others]
        return [others[number].name for number in pareto_front([row.seconds for row in others], errors)]

    def table(self) -> pd.DataFrame:
        """Return a row for each variant, the quickest first, indexed by `name`.

        Columns: `changed`; `median` and `p95`, loss errors as shares of the spread, with the ends of the latter's 95 %
        interval; `spearman`, `cosine`, `relative_error`, `diverged`; `forward` and `with_gradient` [s per episode];
        `memory` [bytes per episode]; `front`, whether it is on the Pareto front.
        """
        import pandas as pd

        front, rows = set(self.front), sorted(self.variants, key=lambda one: one.seconds)
        return pd.DataFrame([{**_columns(row), "front": row.name in front} for row in rows]).set_index("name")

    def plot(self, width: float | None = None) -> Picture:
        """Draw loss errors over the time of an episode, for a screen, or for a page so wide [mm]."""
        from ..draw.figures.tradeoff import tradeoff_figure

        return tradeoff_figure(self.record(), width=width)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def _columns(variant: MeasuredVariant) -> dict[str, Any]:
    found = variant.comparison
    p95 = found.loss_error.p95_relative
    return {
        "name": variant.name,
        "changed": variant.changed,
        "median": found.loss_error.median_relative.value,
        "p95": p95.value,
        "p95_low": p95.low,
        "p95_high": p95.high,
        "spearman": found.spearman.value,
        "cosine": found.gradient.cosine.value,
        "relative_error": found.gradient.relative_error.value,
        "diverged": found.diverged,
        **asdict(found.seconds),
        "memory": variant.memory,
    }


def fit_orders(variants: tuple[MeasuredVariant, ...]) -> tuple[ConvergenceOrder, ...]:
    """Fit the order of convergence in dt of the variants that differ in it, and in precision at most, from the first.

    With another resolution the errors would level off at that of the resolution.
    """
    reference, found = variants[0], list[ConvergenceOrder]()
    for precision in ("float32", "float64"):
        members = [
            (one.fidelity["dt"], error, one.name)
            for one in variants
            if not one.is_otherwise(reference)
            and one.fidelity["precision"] == precision
            and one.fidelity["dt"] > reference.fidelity["dt"]
            and (error := one.comparison.loss_error.median.value)
        ]
        dt, errors, names = list(zip(*sorted(members, reverse=True), strict=True)) or ((), (), ())
        if fit := convergence_order(dt, errors, names):
            found.append(fit)
    return tuple(found)
