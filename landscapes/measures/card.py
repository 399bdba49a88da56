"""The report card of several engines' gradients: the result of `check` for each, and its landscape on one plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from ..checks.diagnosis import Diagnosis
from ..checks.examination import Share, percent
from ..convert import NOT_JSON

if TYPE_CHECKING:
    import pandas as pd
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

    from ..draw.figure import Picture
    from ..objective import Evaluation

Verdict = Literal["passes", "fails", "not decided", "not installed"]
VERDICTS: tuple[Verdict, ...] = ("passes", "fails", "not decided", "not installed")
Answer = Literal["yes", "no", "not decided"]
WRONG_PHYSICS = 0.1  # median error against a closed form from which a gradient is not that of the physics
ROUNDED = 1e-7  # an error that is rounding
UPPER = 0.95  # quantile of the errors against a closed form that is said beside their median


@dataclass(frozen=True)
class FailedCheck:
    """A failed check, its measurement and the reason."""

    check: str
    figure: str
    why: str

    def __str__(self) -> str:
        return f"{self.check}: {self.figure}{f': {self.why}' if self.why else ''}"


@dataclass(frozen=True)
class ClosedFormError:
    """The relative distance of gradients from those of the physics: at the box's centre and at random points.

    `median` and `upper`, the 95 % quantile, are over `points`; they are NaN where a gradient is not finite. `loss` is
    the median error of the losses, as a share of their range: engines with soft contact solve another problem.
    """

    points: int
    centre: float
    median: float
    upper: float
    loss: float

    @classmethod
    def of(cls, found: Evaluation, exact: Evaluation) -> ClosedFormError | None:
        """Compare an evaluation with the closed form's, whose first row is the centre; None without gradients."""
        if found.grad is None or exact.grad is None:
            return None
        length = exact.grad.norm(dim=1).numpy()
        apart = (found.grad - exact.grad).norm(dim=1).numpy() / np.where(length > 0, length, np.nan)
        spread = float(exact.loss.max() - exact.loss.min()) or 1.0
        off = float((found.loss - exact.loss).abs().nanmedian()) / spread
        median, upper = (float(np.quantile(apart, share)) for share in (0.5, UPPER))  # NaN where one is
        return cls(len(apart), float(apart[0]), median, upper, off)


@dataclass(frozen=True)
class Grade:
    """The measurements of one engine in one scene, which give its verdict.

    `env`, `fidelity` and `options` make the environment, `dims` span its slice. `versions` are those of the packages
    that simulate it. `missing` is the line that installs it, empty if it is installed. `power` is the smallest share of
    the box for which the check finds a defect with 95 % probability. `share` is the share of wrong points, `failed` the
    failed checks, and `diagnosis` the most certain one. `closed_form` is None where the scene has none. `seconds` is
    the duration of the check; `check` and `slice` are the commands that make both again.
    """

    scene: str
    engine: str
    env: str
    fidelity: str
    options: dict[str, Any]
    dims: list[str]
    versions: dict[str, str]
    missing: str
    power: float
    share: Share | None
    failed: tuple[FailedCheck, ...]
    diagnosis: Diagnosis | None
    closed_form: ClosedFormError | None
    seconds: float
    check: str
    slice: str

    derived: ClassVar[tuple[str, ...]] = ("verdict", "margin", "unjudged", "program_only")

    @property
    def verdict(self) -> Verdict:
        """Whether its gradients are right: undecided where a defect of that size could have been missed."""
        if self.missing:
            return "not installed"
        if self.failed:
            return "fails"
        return "passes" if self.share is not None and self.share.missed <= self.power else "not decided"

    @property
    def margin(self) -> Answer:
        """Whether gradients are wrong in more of the box than `power`: undecided where the interval contains it."""
        if self.share is None or self.share.judged == 0:
            return "not decided"
        if self.share.low > self.power:
            return "yes"
        most = self.share.high if self.share.wrong else self.share.missed  # without a wrong one the bound is one-sided
        return "no" if most <= self.power else "not decided"

    @property
    def unjudged(self) -> float:
        """Share of the points without a result."""
        if self.share is None or self.share.points == 0:
            return np.nan
        return 1 - self.share.judged / self.share.points

    @property
    def program_only(self) -> bool:
        """Whether gradients are right for the program but not for the physics."""
        return self.verdict == "passes" and self.closed_form is not None and self.closed_form.median > WRONG_PHYSICS

    @property
    def cause(self) -> str:
        """The cause of wrong gradients; empty if it is unknown."""
        return self.diagnosis.cause if self.diagnosis is not None else ""

    @property
    def finding(self) -> str:
        """The worst finding in a sentence: the first diagnosis, else the first failed check."""
        if self.diagnosis is not None:
            return self.diagnosis.what
        return str(self.failed[0]) if self.failed else self.missing

    @property
    def wrong(self) -> str:
        """The share of wrong points, with its interval."""
        return self.share.describe() if self.share is not None and self.share.judged else ""


@dataclass(frozen=True, eq=False)
class CardSlice:
    """A small slice: its position, its losses, their derivatives by both axes [loss unit per side], and statuses."""

    u: Float[NDArray[Any], " u"]
    v: Float[NDArray[Any], " v"]
    loss: Float[NDArray[Any], "v u"]
    slope: Float[NDArray[Any], "v u 2"]
    status: Int[NDArray[Any], "v u"]
    labels: tuple[str, str]
    loss_unit: str


@dataclass(frozen=True, eq=False)
class Card:
    """The grades, and the slice of each that was sampled, by its index among them."""

    grades: tuple[Grade, ...]
    created: str
    device: str
    command: str
    slices: Mapping[int, CardSlice] = field(default_factory=dict, metadata=NOT_JSON)

    def table(self) -> pd.DataFrame:
        """Return a row for each engine in each scene: verdict, shares, cause, finding, error against a closed form."""
        import pandas as pd

        columns = ["scene", "engine", "verdict", "wrong", "low", "high", "judged", "points", "cause", "finding"]
        columns += ["closed_form", "seconds", "check"]
        return pd.DataFrame(map(_row, self.grades), columns=columns).set_index(["scene", "engine"])

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())

    def plot(self, width: float | None = None) -> Picture:
        """Draw the slices, a row for each scene; `width` is that of a page for print [mm]."""
        from ..draw.figure import figure_of

        return figure_of(self, width)

    def count(self, verdict: Verdict) -> int:
        """Count the engines in scenes with a verdict."""
        return sum(one.verdict == verdict for one in self.grades)

    def tally(self) -> str:
        """Count the engines in scenes by verdict, in words."""
        counts = {verdict: self.count(verdict) for verdict in VERDICTS}
        plural = {"passes": "pass", "fails": "fail"}
        said = (f"{n} {verdict if n == 1 else plural.get(verdict, verdict)}" for verdict, n in counts.items() if n)
        return ", ".join(said)

    def engines(self) -> list[str]:
        """Return the tested packages with their versions."""
        return list(dict.fromkeys(f"{name} {at}" for one in self.grades for name, at in one.versions.items()))

    def scenes(self) -> list[tuple[str, list[int]]]:
        """Return each scene with the indices of its grades."""
        names = dict.fromkeys(one.scene for one in self.grades)
        return [(name, [place for place, one in enumerate(self.grades) if one.scene == name]) for name in names]


def _row(one: Grade) -> Sequence[Any]:
    share = one.share or Share(0, 0, 0, np.nan, np.nan, np.nan)
    off = one.closed_form.median if one.closed_form is not None else np.nan
    counts = (share.wrong, share.low, share.high, share.judged, share.points)
    return (one.scene, one.engine, one.verdict, *counts, one.cause, one.finding, off, round(one.seconds, 1), one.check)


def describe_share(value: float) -> str:
    """Write a share in percent, with a digit where it is small, and one above ten times the whole as a factor.

    A share at the level of rounding is "none".
    """
    if not np.isfinite(value):
        return "not finite"
    if value > 10:
        return f"{value:,.0f} times"
    return percent(value) if value >= 1e-3 else f"{100 * value:.1g} %" if value >= ROUNDED else "none"
