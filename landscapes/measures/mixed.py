"""What a search over mixed variants of a scene found: all that it measured, and what fidelities' names should mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..plain import number, text
from .choice import Choice
from .tradeoff import MeasuredVariant, RefusedVariant, Tradeoff

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figures.page import Picture


@dataclass(frozen=True)
class MixedTradeoff:
    """Hold a search of the front on mixed variants, and what is chosen from it.

    `tradeoff` holds the variants that were measured at all points, `dismissed` those that were given up after the first
    points, and why. `choices` are among variants with the scene's own options, `with_options` those that another
    option would make cheaper or nearer. `device` is where a claim's costs count, by its name; `lines` are of Python.
    The search is `complete` where no neighbour of the front was left; else it ended after `budget` seconds. Where the
    motion is `chaotic`, gradients are no criterion.
    """

    tradeoff: Tradeoff
    choices: tuple[Choice, ...]
    with_options: tuple[Choice, ...]
    dismissed: tuple[RefusedVariant, ...]
    device: dict[str, str]
    lines: tuple[str, ...]
    at_most: float
    budget: float
    spent: float
    complete: bool
    chaotic: bool

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> MixedTradeoff:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(
            Tradeoff.of_record(record["tradeoff"]),
            tuple(map(Choice.of_record, record["choices"])),
            tuple(map(Choice.of_record, record["with_options"])),
            tuple(RefusedVariant(text(one["name"]), text(one["why"])) for one in record["dismissed"]),
            dict(record["device"]),
            tuple(map(text, record["lines"])),
            number(record["at_most"]),
            number(record["budget"]),
            number(record["spent"]),
            bool(record["complete"]),
            bool(record["chaotic"]),
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        return {
            **{name: getattr(self, name) for name in ("device", "at_most", "budget", "spent", "complete", "chaotic")},
            "lines": list(self.lines),
            "tradeoff": self.tradeoff.record(),
            "choices": [one.record() for one in self.choices],
            "with_options": [one.record() for one in self.with_options],
            "dismissed": [asdict(one) for one in self.dismissed],
        }

    def variant(self, name: str) -> MeasuredVariant:
        """Return a measured variant by its name."""
        return next(one for one in self.tradeoff.variants if one.name == name)

    def table(self) -> pd.DataFrame:
        """Return two rows for each claim: the variant that bears its name `today`, and the one `chosen`.

        Columns: `variant`; `rank`, `cosine` and `error`, the 95th percentile of loss errors as a share of the spread,
        each with the ends of its 95 % interval; `seconds` per episode with gradient, on `device`; `shortfall`, the
        largest lack as a ratio to what the claim allows, and `kept`, whether that is at most 1.
        """
        import pandas as pd

        rows = [row for one in self.choices for row in self._rows(one)]
        return pd.DataFrame(rows).set_index(["claim", "which"])

    def _rows(self, one: Choice) -> list[dict[str, Any]]:
        today = ("today", one.claim.name, one.today_seconds, one.today_shortfall)
        chosen = ("chosen", one.variant, one.seconds, one.shortfall)
        return [
            {
                **{"claim": one.claim.name, "which": which, "variant": name},
                **_columns(self.variant(name)),
                **{"seconds": seconds, "device": self.device[one.claim.name]},
                **{"shortfall": shortfall, "kept": shortfall is not None and shortfall <= 1},
            }
            for which, name, seconds, shortfall in (today, chosen)
            if name is not None
        ]

    def plot(self, width: float | None = None) -> Picture:
        """Draw all measured variants, those of today's names and the chosen ones marked."""
        from ..draw.figures.tradeoff import tradeoff_figure

        chosen = {one.claim.name: one.variant for one in self.choices if one.variant is not None}
        return tradeoff_figure(self.tradeoff.record(), width=width, chosen=chosen)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def _columns(variant: MeasuredVariant) -> dict[str, float | None]:
    found = variant.comparison
    parts = {"rank": found.spearman, "cosine": found.gradient.cosine, "error": found.loss_error.p95_relative}
    return {
        name + end: getattr(part, end.lstrip("_") or "value")
        for name, part in parts.items()
        for end in ("", "_low", "_high")
    }
