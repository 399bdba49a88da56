"""The report card of several engines' gradients: what `check` finds of each, and its landscape on one plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from ..checks.finding import FAIL, UNEXPECTED, WARN
from ..convert import NOT_JSON

if TYPE_CHECKING:
    import pandas as pd
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

    from ..draw.figure import Picture

Outcome = Literal["passes", "fails", "not installed"]
Checks = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Grade:
    """Say what was found of one engine in one scene.

    `env`, `fidelity` and `options` make the environment, `dims` span its slice. `versions` are those of the packages
    that it is simulated by, `counts` how many checks ended how, and `finding` is the first that failed, or warns, in
    a sentence. `check` and `slice` are the commands that make both again.
    """

    scene: str
    engine: str
    env: str
    fidelity: str
    options: dict[str, Any]
    dims: list[str]
    versions: dict[str, str]
    outcome: Outcome
    finding: str
    counts: dict[str, int]
    check: str
    slice: str


@dataclass(frozen=True, eq=False)
class CardSlice:
    """Hold a small slice: where it lies, its losses, their slopes by both axes [loss unit per side], and statuses."""

    u: Float[NDArray[Any], " u"]
    v: Float[NDArray[Any], " v"]
    loss: Float[NDArray[Any], "v u"]
    slope: Float[NDArray[Any], "v u 2"]
    status: Int[NDArray[Any], "v u"]
    labels: tuple[str, str]
    loss_unit: str


@dataclass(frozen=True, eq=False)
class Card:
    """Hold the grades, and for drawing the slice of each that was sampled, by its place among them."""

    grades: tuple[Grade, ...]
    created: str
    device: str
    command: str
    slices: Mapping[int, CardSlice] = field(default_factory=dict, metadata=NOT_JSON)

    def table(self) -> pd.DataFrame:
        """Return a row for each engine in each scene: `outcome`, `finding`, `check`."""
        import pandas as pd

        rows = [(one.scene, one.engine, one.outcome, one.finding, one.check) for one in self.grades]
        columns = ["scene", "engine", "outcome", "finding", "check"]
        return pd.DataFrame(rows, columns=columns).set_index(["scene", "engine"])

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())

    def plot(self, width: float | None = None) -> Picture:
        """Draw the slices, a row for each scene; `width` is that of a page for print [mm]."""
        from ..draw.figure import figure_of

        return figure_of(self, width)

    @property
    def failed(self) -> int:
        """How many engines in scenes fail."""
        return sum(one.outcome == "fails" for one in self.grades)

    def engines(self) -> list[str]:
        """Return what was measured, packages with their versions."""
        return list(dict.fromkeys(f"{name} {at}" for one in self.grades for name, at in one.versions.items()))


def first_finding(checks: Checks) -> str:
    """Say in a sentence what is worst of the checks: the first that failed, else the first that warns."""
    bad = [one for one in checks if one["outcome"] in (FAIL, UNEXPECTED)]
    found = bad or [one for one in checks if one["outcome"] == WARN]
    if not found:
        return ""
    others = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
    why = f": {found[0]['why']}" if found[0]["why"] else ""
    return f"{found[0]['check']}: {found[0]['figure']}{why}{others}"


def count_outcomes(checks: Checks) -> dict[str, int]:
    """Count how many checks ended how."""
    ends = [str(one["outcome"]) for one in checks]
    return {end: ends.count(end) for end in dict.fromkeys(ends)}
