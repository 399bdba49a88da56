"""Stability: an objective's results at a setting, whether they are right, and up to which value it is stable."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..landscapes.objective import Evaluation, Objective, Status
from ..landscapes.sampling.memory import MemoryBound
from .references import evaluate_reference
from .samples import Evaluate, Follow, Parts, Sample, ignore, loss_range
from .variants import one_line

ACCURATE, INACCURATE, UNJUDGED, REFUSED = "accurate", "inaccurate", "not judged", "refused"
STABLE = (ACCURATE, INACCURATE, UNJUDGED)  # outcomes of a setting at which every point has a finite gradient
Array = NDArray[np.float64]


def refuse(why: str) -> Sample:
    """Return the sample of a refused setting."""
    return Sample(np.zeros(0), np.zeros((0, 0)), np.zeros(0, dtype=np.int8), refused=why)


def is_stable(sample: Sample) -> bool:
    """Return whether all points have a finite loss and a finite gradient."""
    return not sample.refused and bool(sample.fine.all())


def evaluate_bound(objective: Objective, x: Float[Tensor, "point dim"], follow: Follow) -> Parts:
    """Evaluate points in batches that fit into the device's memory."""
    began = time.perf_counter()
    found = MemoryBound(objective).evaluate(x, grad=True)
    return found, (time.perf_counter() - began) / len(x)


evaluate_kept = partial(evaluate_reference, by=evaluate_bound)


def ask(objective: Objective, x: Float[Tensor, "point dim"], by: Evaluate = evaluate_bound) -> Sample:
    """Evaluate an objective at the points of a study; an error is a result, too.

    A ValueError refuses the setting. So does too little memory for a single point, which shows nothing about the
    setting. Any other error belongs to a point: points are then evaluated one by one.
    """
    try:
        found, error = _ask_together(objective, x, by)
    except (ValueError, MemoryError) as refusal:
        return refuse(_line(refusal))
    return Sample.of(found, objective, error=error)


def _ask_together(objective: Objective, x: Float[Tensor, "point dim"], by: Evaluate) -> tuple[Evaluation, str]:
    """Evaluate all points, one by one where that raises, and return the first error, too."""
    try:
        found, _ = by(objective, x, ignore)
        return found, found.error
    except (OSError, ValueError, MemoryError):  # of the system or of the setting, not of a point
        raise
    except Exception as raised:
        parts = [_ask_alone(objective, row[None]) for row in x] if len(x) > 1 else [_failed(x)]
        return Evaluation.join(parts, dim=x.shape[1], grad=True), _line(raised)


def _ask_alone(objective: Objective, row: Float[Tensor, "one dim"]) -> Evaluation:
    try:
        return MemoryBound(objective).evaluate(row, grad=True)
    except (OSError, MemoryError):
        raise
    except Exception:
        return _failed(row)


def _failed(x: Tensor) -> Evaluation:
    status = torch.full((len(x),), Status.ERROR, dtype=torch.int8)
    return Evaluation.from_results(x.new_full((len(x),), torch.nan), torch.full_like(x, torch.nan), status)


def _line(error: Exception) -> str:
    return (
        one_line(error) if isinstance(error, ValueError | MemoryError) else f"{type(error).__name__}: {one_line(error)}"
    )


@dataclass(frozen=True)
class Cell:
    """The outcome of a setting: `values` of settings, in the order of their map or of a limit's one setting.

    `outcome` is accurate, inaccurate or not judged where all points are fine, else the name of the most frequent
    failure (NONFINITE, ESCAPED, ERROR, NO_GRADIENT), or refused. `share` is that of the fine points. `error` is the
    95th percentile of |loss - reference's|, as a share of the spread of the reference's losses there, over the fine
    points. `loss` is their median |loss| [objective's unit] and `slope` their largest gradient [loss unit / width of
    the box].
    """

    values: tuple[float, ...]
    outcome: str
    share: float
    error: float | None = None
    loss: float | None = None
    slope: float | None = None
    why: str = ""

    @property
    def stable(self) -> bool:
        """Whether every point has a finite loss and a finite gradient."""
        return self.outcome in STABLE

    @property
    def accurate(self) -> bool:
        """Whether its losses are right, too."""
        return self.outcome == ACCURATE


def judge(values: Sequence[float], answer: Sample, reference: Sample | None, *, tolerance: float) -> Cell:
    """Return the outcome of a setting, and whether its finite losses are right, compared with those of the reference.

    Losses are accurate if they are off by at most `tolerance` of the spread at 95 % of the points. There is no verdict
    where there is no reference, or where it fails at half of the points or more.
    """
    if answer.refused:
        return Cell(tuple(values), REFUSED, 0.0, why=answer.refused)
    fine = answer.fine
    error = None if reference is None else loss_error(answer, reference)
    known: dict[str, Any] = {"share": float(fine.mean()), "error": error, "why": answer.error}
    if fine.any():
        slope = float(torch.from_numpy(answer.grad[fine]).norm(dim=1).max())
        known |= {"loss": float(np.median(np.abs(answer.loss[fine]))), "slope": slope}
    if not fine.all():
        codes, counts = np.unique(answer.status[~fine], return_counts=True)
        return Cell(tuple(values), Status(int(codes[counts.argmax()])).name, **known)
    if error is None:
        return Cell(tuple(values), UNJUDGED, **known)
    return Cell(tuple(values), ACCURATE if error <= tolerance else INACCURATE, **known)


def loss_error(answer: Sample, reference: Sample) -> float | None:
    """Return the 95th percentile of loss errors as a share of the spread of the reference's losses.

    It uses the points where both are fine. None where there are none, where the reference fails at half of all points
    or more, and where its losses have no spread.
    """
    if reference.refused or reference.fine.mean() <= 0.5:
        return None
    both = answer.fine & reference.fine
    width = loss_range(reference.loss[reference.fine])
    if not both.any() or not width:
        return None
    off = np.abs(answer.loss - reference.loss)[both] / width
    return float(np.quantile(off, 0.95, method="higher"))


@dataclass(frozen=True)
class Axis:
    """The scale of a setting, logarithmic, or linear over a `span`; `settle` returns the nearest possible value."""

    settle: Callable[[float], float]
    span: float = 0.0

    def middle(self, a: float, b: float) -> float:
        """Return the value half way between two."""
        return self.settle((a + b) / 2 if self.span else math.sqrt(a * b))

    def apart(self, a: float, b: float) -> float:
        """Return the distance of two values, relative to the smaller one, or to the span."""
        return abs(a - b) / self.span if self.span else max(a, b) / min(a, b) - 1

    def spread(self, low: float, high: float, count: int) -> list[float]:
        """Return this many values in a range, or fewer where there are none between, in ascending order."""
        values = np.linspace(low, high, count) if self.span else np.geomspace(low, high, count)
        return sorted({self.settle(float(value)) for value in values})


def bisect(
    stable: float, failed: float, is_stable: Callable[[float], bool], axis: Axis, width: float
) -> tuple[float, float]:
    """Return a stable and an unstable value at most a `width` apart, between two such values.

    It stops earlier where the setting has no value between them.
    """
    while axis.apart(stable, failed) > width:
        middle = axis.middle(stable, failed)
        if not min(stable, failed) < middle < max(stable, failed):
            break
        stable, failed = (middle, failed) if is_stable(middle) else (stable, middle)
    return stable, failed


def bracket(values: Sequence[float], stable: Sequence[bool]) -> tuple[float | None, float | None]:
    """Return the last stable value before the first failure and that failure, each None where there is none.

    `values` lead away from a surely stable value; if the first one already fails, no value is stable.
    """
    failed = next((at for at, fine in enumerate(stable) if not fine), None)
    if failed is None:
        return values[-1], None
    return (values[failed - 1] if failed else None), values[failed]


def islands(values: Sequence[float], stable: Sequence[bool]) -> tuple[tuple[float, float], ...]:
    """Return the stable ranges beyond the first failure, each by its first value and its last."""
    found: list[tuple[float, float]] = []
    failed = next((at for at, fine in enumerate(stable) if not fine), len(values))
    for at in range(failed, len(values)):
        if stable[at]:
            joins = bool(found) and stable[at - 1]
            first = found.pop()[0] if joins else values[at]
            found.append((first, values[at]))
    return tuple(found)
