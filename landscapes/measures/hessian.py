"""The Hessian of an objective at a point: the record of its spectrum, each number with its error, and its meaning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from ..convert import NOT_JSON
from ..curvature import Array, Curvature, Spectrum, StepChange, ends
from ..statistics import Estimate, mean

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figure import Picture

Sign = Literal["positive", "negative", "cannot tell"]
Kind = Literal["convex", "concave", "saddle", "convexity cannot be told"]
UNTOLD: Sign = "cannot tell"
BOX_UNITS = "box units: every parameter runs from 0 to 1 between its bounds"
SYMMETRIC, ROUNDED = 3.0, 1e-9  # asymmetry, by what differences explain and beyond rounding, that no loss has
PARTS, LEAST_PART = 3, 0.1  # components of a direction that are named, and how large they are at least
NAMED = 3  # eigenvalues that a warning names


@dataclass(frozen=True)
class Eigenpair:
    """An eigenvalue [loss unit, in box units] with its largest `error`, and its place, 1 the largest.

    The error combines `residual`, the norm of Hv - value v; `difference`, the change of Hv from the step to a quarter
    of it; and contradictions by losses. `by_losses` is the curvature of the losses along the direction, NaN where not
    measured. `along` names the largest components of the unit vector.
    """

    place: int
    value: float
    error: float
    residual: float
    difference: float
    by_losses: float
    disputed: bool
    along: dict[str, float]

    derived: ClassVar = ("sign",)

    @property
    def sign(self) -> Sign:
        """Whether it is positive or negative, undecided where the error is larger than the value."""
        if not abs(self.value) > self.error:
            return UNTOLD
        return "positive" if self.value > 0 else "negative"

    def direction(self) -> str:
        """Return the largest components of the direction in words."""
        return " ".join(f"{value:+.2f} {name}" for name, value in self.along.items())


@dataclass(frozen=True, eq=False)
class Hessian:
    """The Hessian of an environment at a point, in box units: every parameter runs from 0 to 1 in its bounds.

    `pairs` are its largest and smallest eigenvalues, descending, each with its error [`loss_unit`]; `whole`: all `dim`
    were computed. `point` are the parameters' own values; it was `moved` [box] off a bound. Differences are of
    `source`, gradients or losses (and `why` these), over `step` [box], chosen among `steps`. `trace`, `condition` (the
    largest eigenvalue by the smallest, by magnitude) and `negative` (share of eigenvalues that are certainly negative)
    have 95 % intervals or bounds; NaN means unknown. `undecided` is the share with an undecided sign. `asymmetry` is
    the Frobenius norm of the antisymmetric part relative to that of the symmetric one; differences explain
    `asymmetry_explained` of it.

    Arrays, which hessian.npz has: `values` and `errors` of all known eigenvalues, shape (known,), `vectors`, shape
    (known, dim), and of a sampled spectrum `nodes` and `weights`, shape (probe, step), else empty.
    """

    identity: dict[str, Any]
    env: str
    fidelity: str
    through: str
    point: dict[str, float]
    moved: float
    loss: float
    loss_unit: str
    gradient: float
    dim: int
    source: str
    why: str
    whole: bool
    step: float
    steps: tuple[StepChange, ...]
    pairs: tuple[Eigenpair, ...]
    trace: Estimate
    condition: Estimate
    negative: Estimate
    undecided: float
    asymmetry: float
    asymmetry_explained: float
    episodes: int
    failures: tuple[str, ...]
    provenance: dict[str, Any]
    command: str
    values: Array = field(metadata=NOT_JSON, default_factory=lambda: np.zeros(0))
    errors: Array = field(metadata=NOT_JSON, default_factory=lambda: np.zeros(0))
    vectors: Array = field(metadata=NOT_JSON, default_factory=lambda: np.zeros((0, 0)))
    nodes: Array = field(metadata=NOT_JSON, default_factory=lambda: np.zeros((0, 0)))
    weights: Array = field(metadata=NOT_JSON, default_factory=lambda: np.zeros((0, 0)))

    derived: ClassVar = ("units", "kind", "symmetric", "warnings")

    @property
    def units(self) -> str:
        """The unit of lengths."""
        return BOX_UNITS

    @property
    def kind(self) -> Kind:
        """The type of the landscape at the point, by the signs of all eigenvalues."""
        signs = {pair.sign for pair in self.pairs}
        if {"positive", "negative"} <= signs:
            return "saddle"
        if UNTOLD in signs or not self.pairs:
            return "convexity cannot be told"
        return "convex" if signs == {"positive"} else "concave"

    @property
    def symmetric(self) -> bool:
        """Whether the matrix is symmetric, as every Hessian is, within the error of differences."""
        return not self.asymmetry > SYMMETRIC * self.asymmetry_explained + ROUNDED

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt these numbers, a sentence each."""
        said = [f"differences are of losses, not of gradients: {self.why}"] if self.why else []
        if not self.symmetric:
            said.append(
                f"the matrix is not symmetric: its antisymmetric part is {self.asymmetry:.2g} of the symmetric one, "
                f"of which differences explain {self.asymmetry_explained:.1g}; so these gradients belong to no loss, "
                f"or they jump: `landscape check {self.env}` shows where"
            )
        if wrong := [pair for pair in self.pairs if pair.disputed]:
            first = "; ".join(f"{one.value:.3g}, and {one.by_losses:.3g} by losses" for one in wrong[:NAMED])
            said.append(
                f"losses and gradients give different curvatures along {len(wrong)} of {len(self.pairs)} directions "
                f"({first}): gradients are wrong, or losses jump; `landscape check {self.env}` shows which"
            )
        if untold := sum(pair.sign == UNTOLD for pair in self.pairs):
            said.append(
                f"{untold} of {len(self.pairs)} eigenvalues are not distinguishable from 0: their errors are as large "
                "as their values, for example because gradients are noisy, jump within the step, or do not change"
            )
        if self.moved:
            said.append(f"the point was moved off the bounds, by at most {self.moved:.2g} of the box")
        if self.failures:
            said.append(f"{len(self.failures)} points failed, the first {self.failures[0]}")
        return tuple(said)

    def table(self) -> pd.DataFrame:
        """Return a row for each eigenvalue, indexed by its `place`, with its error, its sign and its direction."""
        import pandas as pd

        rows = [{**asdict(pair), "sign": pair.sign, "along": pair.direction()} for pair in self.pairs]
        return pd.DataFrame(rows).set_index("place")

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())

    def plot(self, width: float | None = None) -> Picture:
        """Draw the spectrum; `width` is that of a page for print [mm]."""
        from ..draw.figure import figure_of

        return figure_of(self, width)


def conclude(
    curvature: Curvature,
    found: Spectrum,
    *,
    pairs: int,
    identity: dict[str, Any],
    env: str,
    fidelity: str,
    through: str,
    point: dict[str, float],
    loss_unit: str,
    provenance: dict[str, Any],
    command: str,
) -> Hessian:
    """Return the record of a spectrum, with this many `pairs` at either end; the other keywords are fields of it."""
    whole, dim = curvature.whole, curvature.dim
    negative, undecided = _signs(found)
    return Hessian(
        identity=identity,
        env=env,
        fidelity=fidelity,
        through=through,
        point=point,
        loss_unit=loss_unit,
        provenance=provenance,
        command=command,
        moved=curvature.moved,
        loss=float(curvature.centre["loss"]),
        gradient=float(np.linalg.norm(curvature.centre["grad"])) if curvature.source == "gradients" else math.nan,
        dim=dim,
        source=curvature.source,
        why=str(curvature.centre["why"]),
        whole=whole,
        step=found.step,
        steps=found.ladder,
        pairs=tuple(_pair(found, at, dim, curvature.names) for at in ends(len(found.values), pairs).tolist()),
        trace=found.trace,
        condition=_condition(found, whole),
        negative=negative,
        undecided=undecided,
        asymmetry=found.asymmetry,
        asymmetry_explained=found.asymmetry_explained,
        episodes=curvature.episodes,
        failures=tuple(curvature.failures),
        values=found.values,
        errors=found.error,
        vectors=found.vectors,
        nodes=found.nodes,
        weights=found.weights,
    )


def _pair(found: Spectrum, at: int, dim: int, names: Sequence[str]) -> Eigenpair:
    vector = found.vectors[at]
    largest = [part for part in np.argsort(-np.abs(vector), kind="stable")[:PARTS] if abs(vector[part]) >= LEAST_PART]
    return Eigenpair(
        place=at + 1 if at < len(found.values) / 2 else dim - len(found.values) + at + 1,
        value=float(found.values[at]),
        error=float(found.error[at]),
        disputed=bool(found.disputed[at]),
        along={names[part]: float(vector[part]) for part in largest},
        residual=float(found.residual[at]),
        difference=float(found.difference[at]),
        by_losses=float(found.by_losses[at]),
    )


def _condition(found: Spectrum, whole: bool) -> Estimate:
    """Return the largest magnitude of an eigenvalue over the smallest; only a bound where the latter can be 0.

    Where only the ends of a spectrum are known, the smallest magnitude is at an end if all have one sign.
    """
    size, error = np.abs(found.values), found.error
    first = int(size.argmax())
    least, most = (size - error).min(), (size + error).min()
    low = max(1.0, float((size[first] - error[first]) / most)) if most > 0 else math.nan
    one_sign = bool((np.sign(found.values) == np.sign(found.values[0])).all())
    if not least > 0 or not (whole or one_sign):
        return Estimate(math.nan, low, math.nan)
    return Estimate(float(size[first] / size.min()), low, float((size[first] + error[first]) / least))


def _signs(found: Spectrum) -> tuple[Estimate, float]:
    """Return the share of eigenvalues that are certainly negative, with its bounds, and of undecided ones."""
    if not found.nodes.size:
        below, either = float((found.values < -found.error).mean()), float((np.abs(found.values) <= found.error).mean())
        return Estimate(below, below, below + either), either
    error = float(np.median(found.error))
    negative = (found.weights * (found.nodes < -error)).sum(axis=1)
    either = (found.weights * (np.abs(found.nodes) <= error)).sum(axis=1)
    least, most = mean(negative, least=0, most=1), mean(negative + either, least=0, most=1)
    return Estimate(least.value, least.low, most.high), float(either.mean())
