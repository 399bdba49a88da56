"""The record of a study of convergence, as it is written, read, shown and drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..identity import MODEL_VERSION, current_identity
from ..plain import number, optional, text
from .convergence import UNMOVED, Shapes, Verdict
from .distributions import Distributions
from .divergence import Divergence, interval
from .fidelity import Bootstrap
from .tradeoff import RefusedVariant

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figures.page import Picture


@dataclass(frozen=True)
class Level:
    """Hold one level of a knob: its `width`, which refinement lowers, its fidelity, and what an episode takes [s]."""

    name: str
    width: float
    fidelity: dict[str, Any]
    seconds: float

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Level:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        width, seconds = number(record["width"]), number(record["seconds"])
        return cls(text(record["name"]), width, dict(record["fidelity"]), seconds)


@dataclass(frozen=True)
class Move:
    """Hold how losses and gradients move from a level to the next finer one.

    `median` and `p95` of |difference|, as shares of the spread; medians of the gradients' `cosine` and relative error;
    so many points are `compared`. `width` is that of the coarser level.
    """

    coarse: str
    fine: str
    width: float
    median: Bootstrap
    p95: Bootstrap
    cosine: Bootstrap
    relative_error: Bootstrap
    compared: int

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Move:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(
            text(record["coarse"]),
            text(record["fine"]),
            number(record["width"]),
            Bootstrap.of_record(record["median"]),
            Bootstrap.of_record(record["p95"]),
            Bootstrap.of_record(record["cosine"]),
            Bootstrap.of_record(record["relative_error"]),
            record["compared"],
        )


@dataclass(frozen=True)
class KnobConvergence:
    """Hold what the levels of one knob show, from coarse to fine.

    `order` is the observed one, `per_point` each point's, `designed` the one that the scene is built for. `moved` is
    the 95th percentile of what refining the reference once moves, as a share of the spread, and `met` whether that is
    rounding or within a tenth of standard's error; `met_from` names the first level from which it is. `floor` is what
    the median of |difference| does not fall below, None where it still falls.
    """

    knob: str
    levels: tuple[Level, ...]
    moves: tuple[Move, ...]
    verdict: Verdict
    order: Bootstrap
    per_point: tuple[float | None, ...]
    shapes: Shapes
    designed: float | None
    floor: float | None
    moved: Bootstrap | None
    met: bool | None
    met_from: str | None

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> KnobConvergence:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        verdict: Any = text(record["verdict"])
        return cls(
            text(record["knob"]),
            tuple(map(Level.of_record, record["levels"])),
            tuple(map(Move.of_record, record["moves"])),
            verdict,
            Bootstrap.of_record(record["order"]),
            tuple(optional(number, one) for one in record["per_point"]),
            Shapes(**record["shapes"]),
            optional(number, record["designed"]),
            optional(number, record["floor"]),
            optional(Bootstrap.of_record, record["moved"]),
            record["met"],
            optional(text, record["met_from"]),
        )

    def say(self) -> str:
        """Say by which order it converges, or that it does not."""
        said = [f"{self.knob}: {self.verdict}"]
        if self.verdict == "too few levels" and self.moves:
            said.append(f"losses move by {_percent(self.moves[-1].p95.value)} (95 % of points) to the finest")
        if self.order.value is not None:
            count = self.shapes
            said[0] += f", order {interval(self.order)}"
            said.append(f"{count.monotone} points monotone, {count.oscillating} oscillating, {count.growing} growing")
        if self.designed is not None:
            match = {True: "as observed", False: "not as observed", None: "not held against it"}[self.as_designed]
            said.insert(1, f"designed {self.designed:g}, {match}")
        if self.floor is not None:
            said.append(f"differences do not fall below {_percent(self.floor)}")
        if self.met_from is not None and self.verdict != "unmoved":
            said.append(f"within a tenth of standard's error from {self.met_from} on")
        return "; ".join(said)

    @property
    def as_designed(self) -> bool | None:
        """Whether the interval of the observed order holds the designed one, None where one of both is not known."""
        if self.designed is None or self.order.low is None or self.order.high is None:
            return None
        return self.order.low <= self.designed <= self.order.high


@dataclass(frozen=True)
class Remainder:
    """Hold how far a named fidelity is from Richardson's limit, as shares of the spread."""

    name: str
    median: Bootstrap
    p95: Bootstrap

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Remainder:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(text(record["name"]), Bootstrap.of_record(record["median"]), Bootstrap.of_record(record["p95"]))


@dataclass(frozen=True)
class ConvergenceRule:
    """Say whether the reference is one: refining it moves losses by rounding or less than a tenth of standard's error.

    `off` is that error. Both are 95th percentiles, as shares of the spread; `moved` is by the `knob` that moves them
    most, and `failing` are the knobs that move them by more.
    """

    off: Bootstrap
    moved: Bootstrap | None
    knob: str | None
    met: bool | None
    failing: tuple[str, ...]

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> ConvergenceRule:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(
            Bootstrap.of_record(record["off"]),
            optional(Bootstrap.of_record, record["moved"]),
            optional(text, record["knob"]),
            record["met"],
            tuple(map(text, record["failing"])),
        )

    def say(self) -> str:
        """Say it in a sentence."""
        off, moved = (_percent(one.value if one else None) for one in (self.off, self.moved))
        if self.met is None:
            return f"whether the reference is converged is not known: it moves by {moved}, standard is off by {off}"
        if self.met and self.moved is not None and (self.moved.value or 0.0) <= UNMOVED:
            return f"the reference is converged to rounding: it moves by {moved} at most"
        if self.met:
            return f"the reference is converged: it moves by {moved} at most where standard is off by {off}"
        said = f"the reference is not converged: refining its {self.knob} moves it by {moved} where standard is off by"
        return f"{said} {off}, and a tenth of that is allowed; it fails in {', '.join(self.failing)}"


@dataclass(frozen=True)
class Convergence:
    """Hold the self-convergence of a scene about its reference, at the same points.

    `spread` is the 5th to 95th percentile of the reference's losses [`loss_unit`], None where they are all equal:
    differences are in the loss's unit then. `remainders` are empty where some knob has no limit. `divergence` is None
    of a scene without a motion, `distributions` of one whose motion is not chaotic.
    """

    env: str
    reference: str
    points: int
    seed: int
    loss_unit: str
    spread: float | None
    knobs: tuple[KnobConvergence, ...]
    rule: ConvergenceRule
    remainders: tuple[Remainder, ...]
    divergence: Divergence | None
    distributions: Distributions | None
    refused: tuple[RefusedVariant, ...]
    identity: dict[str, Any]
    provenance: dict[str, Any]
    command: str

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Convergence:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        identity = current_identity(record["identity"])
        number(identity[MODEL_VERSION])
        for said in (identity["engine"], identity["device"]):
            text(said)
        return cls(
            text(record["env"]),
            text(record["reference"]),
            record["points"],
            record["seed"],
            text(record["loss_unit"]),
            optional(number, record["spread"]),
            tuple(map(KnobConvergence.of_record, record["knobs"])),
            ConvergenceRule.of_record(record["rule"]),
            tuple(map(Remainder.of_record, record["remainders"])),
            optional(Divergence.of_record, record["divergence"]),
            optional(Distributions.of_record, record["distributions"]),
            tuple(RefusedVariant(text(one["name"]), text(one["why"])) for one in record["refused"]),
            identity,
            dict(record["provenance"]),
            text(record["command"]),
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        return asdict(self)

    def table(self) -> pd.DataFrame:
        """Return a row for each knob and refinement, indexed by `knob`, `coarse` and `fine`.

        Columns: `median` and `p95` of |difference| and the latter's interval, as shares of the spread; `cosine` and
        `relative_error` of gradients; `compared` points; of the knob, `order` with its interval, `designed`, `verdict`
        and `met`, whether the reference meets the rule.
        """
        import pandas as pd

        rows = [_columns(knob, move) for knob in self.knobs for move in knob.moves]
        return pd.DataFrame(rows).set_index(["knob", "coarse", "fine"])

    def sentences(self) -> list[str]:
        """Say what was found: by which order each knob converges, whether the reference is one, what is left to win."""
        said = [*(knob.say() for knob in self.knobs), self.rule.say(), *self.say_remainders()]
        said += [self.divergence.say()] if self.divergence else []
        return said + ([self.distributions.say()] if self.distributions else [])

    def say_remainders(self) -> list[str]:
        """Say how far named fidelities are from Richardson's limit, or which knobs have none."""
        if not self.remainders:
            without = [one.knob for one in self.knobs if one.verdict == "does not converge"] or ["too few levels"]
            return [f"there is no limit to extrapolate to, because of {', '.join(without)}"]
        return [
            f"{one.name} is {_percent(one.median.value)} (median) and {_percent(one.p95.value)} (95 % of points, "
            f"{_percent(one.p95.low)} to {_percent(one.p95.high)}) from Richardson's limit"
            for one in self.remainders
        ]

    def plot(self, width: float | None = None) -> Picture:
        """Draw what refinement moves over the width of the levels, for a screen, or for a page so wide [mm]."""
        from ..draw.figures.convergence import convergence_figure

        return convergence_figure(self, width=width)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def _columns(knob: KnobConvergence, move: Move) -> dict[str, Any]:
    return {
        **{"knob": knob.knob, "coarse": move.coarse, "fine": move.fine},
        **{"median": move.median.value, "p95": move.p95.value, "p95_low": move.p95.low, "p95_high": move.p95.high},
        **{"cosine": move.cosine.value, "relative_error": move.relative_error.value, "compared": move.compared},
        **{"order": knob.order.value, "order_low": knob.order.low, "order_high": knob.order.high},
        **{"designed": knob.designed, "verdict": knob.verdict, "met": knob.met},
    }


def _percent(value: float | None) -> str:
    return "more than a number can say" if value is None else f"{100 * value:.2g} %"
