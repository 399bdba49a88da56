"""Checks at the edges of an objective's domain: it returns a number or a status, never a silent NaN."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from math import comb

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Objective, Status, failed
from ..space import ParameterSpace
from .finding import FAIL, Finding, refused, skip, verdict
from .subject import Subject, difference

CORNERS = 16  # a box of no more corners is checked at all of them
OUTSIDE = (0.01, 0.1)  # how far outside the box, as shares of it
ROWS = 2  # points that a variant is checked at
RISE = 0.1  # of the energy there is at first: what semi-implicit steps may add for a while in a stiff contact
KINDS = {
    "finite": Status.OK,
    "without gradient": Status.NO_GRADIENT,
    "non-finite": Status.NONFINITE,
    "escaped": Status.ESCAPED,
    "error": Status.ERROR,
}
NAMED = 4  # parameters of a point that are named, at most


@dataclass(frozen=True)
class ExtremeCase:
    """Stress an objective in another way: `make` returns it, or raises ValueError where it refuses that.

    It is evaluated at `x`, or else at the first few of the points, and must return a result there. `why` adds to the
    result, or explains why the case does not exist.
    """

    name: str
    make: Callable[[], Objective] | None = None
    why: str = ""
    x: Float[Tensor, "batch dim"] | None = None


def checks(
    subject: Subject, other: Callable[[], Subject] | None, variants: Sequence[ExtremeCase]
) -> Iterator[tuple[str, Callable[[], Finding]]]:
    """Yield the name of each extreme and its check."""
    space, objective = subject.objective.space, subject.objective
    ends = corners(space.dim)
    some = f"{len(ends)} of 2^{space.dim} corners, every two parameters in all four combinations"
    many = f"all {len(ends)} corners" if len(ends) == 2**space.dim else some
    yield "corners", lambda: _check_inside(objective, space.from_unit(ends), many)
    yield "centre", lambda: _check_inside(objective, space.center[None])
    for share in OUTSIDE:
        beyond = space.from_unit(ends + share * (2 * ends - 1))
        yield f"{share:.0%} outside the box", partial(_check_beyond, objective, beyond)
    yield "float32 against float64", lambda: _check_precisions(subject, other)
    for variant in variants:
        yield variant.name, partial(_check_variant, subject, variant)
    yield "energy drift", lambda: _check_energy(subject)


def corners(dim: int) -> Float[Tensor, "corner dim"]:
    """Return all corners of the unit cube, or a few where every two parameters meet in all four combinations.

    Of n rows, the first all zero, columns are the different choices of ceil(n / 2) others (Kleitman and Spencer 1973,
    Families of k-independent sets): two of them share a row, and each has one the other lacks.
    """
    if 2**dim <= CORNERS:
        return torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * dim).view(-1, dim)
    rows = next(n for n in range(3, dim + 3) if comb(n - 1, -(-n // 2)) >= dim)
    found = torch.zeros(rows, dim, dtype=torch.float64)
    for column, chosen in zip(range(dim), combinations(range(1, rows), -(-rows // 2)), strict=False):
        found[list(chosen), column] = 1.0
    return found


def count_endings(found: Evaluation) -> tuple[dict[str, float | None], str]:
    """Count rows by status, and describe errors: loss and gradient must be finite exactly where the status says so."""
    status, none = found.status, found.status == Status.NO_GRADIENT
    counts: dict[str, float | None] = {kind: float((status == code).sum()) for kind, code in KINDS.items()}
    finite = found.loss.isfinite()
    if found.grad is not None:
        finite = finite & found.grad.isfinite().all(dim=1)
        sound = found.grad[finite].abs()
        counts["largest_gradient"] = float(sound.max()) if sound.numel() else None
    wrong = {
        "rows have no status": int(sum(count or 0.0 for kind, count in counts.items() if kind in KINDS)) < len(status),
        "rows of status OK are not finite": bool(((status == Status.OK) & ~finite).any()),
        "rows that failed have a finite loss": bool((failed(status) & found.loss.isfinite()).any()),
        "rows of status NO_GRADIENT have a gradient or no loss": bool((none & (finite | ~found.loss.isfinite())).any()),
    }
    return counts, "; ".join(what for what, so in wrong.items() if so)


def describe_counts(counts: Mapping[str, float | None]) -> str:
    """Describe in a line the statuses of rows."""
    ends = ", ".join(f"{counts[kind]:.0f} {kind}" for kind in KINDS if counts[kind])
    largest = counts.get("largest_gradient")
    return ends + ("" if largest is None else f"; largest |grad| {largest:.1e}")


def describe_missing(space: ParameterSpace, x: Float[Tensor, "batch dim"], found: Evaluation, place: str = "") -> str:
    """Describe where the gradient is NaN although the loss is finite, empty for nowhere; `place` names one point."""
    rows = (found.status == Status.NO_GRADIENT).nonzero().flatten()
    if not len(rows):
        return ""
    values = [f"{name} = {value:.4g}" for name, value in zip(space.names, x[rows[0]].tolist(), strict=True)]
    at = ", ".join([*values[:NAMED], *(["..."] if len(values) > NAMED else [])])
    if place:
        return f"the gradient is NaN at {place} ({at}), where the loss is {float(found.loss[rows[0]]):.4g}"
    share = f"{len(rows) / len(x):.0%}".replace("%", " %")
    return f"the gradient is NaN at {share} of the points (first at {at}), where the loss is finite"


def _check_inside(objective: Objective, x: Float[Tensor, "batch dim"], what: str = "") -> Finding:
    """Check points of the box itself, where a finite loss needs a gradient."""
    found = objective.evaluate(x)
    judged = _judge(found, what)
    missing = describe_missing(objective.space, x, found, "" if len(x) > 1 else "the centre")
    return replace(judged, outcome=FAIL, why=missing) if missing else judged


def _check_beyond(objective: Objective, x: Float[Tensor, "batch dim"]) -> Finding:
    if not objective.beyond_box:
        return skip("not asked", "it is undefined outside its bounds; beyond_box = True allows points there")
    try:
        return _judge(objective.evaluate(x))
    except ValueError as refusal:
        return refused(refusal)


def _judge(found: Evaluation, what: str = "") -> Finding:
    counts, wrong = count_endings(found)
    figure = f"{what}: {describe_counts(counts)}" if what else describe_counts(counts)
    return verdict(not wrong, figure, wrong, counts)


def _check_variant(subject: Subject, variant: ExtremeCase) -> Finding:
    if variant.make is None:
        return skip("n/a", variant.why)
    try:
        objective = variant.make()
    except ValueError as refusal:
        return refused(refusal)
    if objective is subject.objective and variant.x is None:
        found = subject.first.rows(torch.arange(ROWS))
    else:
        found = objective.evaluate(subject.x[:ROWS] if variant.x is None else variant.x)
    judged = _judge(found)
    return replace(judged, why="; ".join(filter(None, (judged.why, variant.why))))


def _check_energy(subject: Subject) -> Finding:
    """Check that the energy of undriven motions does not rise, where the objective has `energy`.

    `energy(x)` returns it over time, shape (batch, step), relative to rest at the lowest point, or None.
    """
    found = subject.objective.energy(subject.x[:ROWS])
    if found is None:
        return skip("n/a", "the objective has no energy")
    first = found[:, :1]
    rise = difference((found - found.cummin(dim=1).values) / first, torch.zeros_like(found))
    left = float((found[:, -1:] / first).mean())
    figure = f"rises by up to {rise:.1e} of its initial value, of which {left:.4g} remains at the end"
    why = f"at most {RISE:g} is allowed: the time steps add energy"
    return verdict(rise <= RISE, figure, why, {"rise": rise, "left": left, "limit": RISE})


def _check_precisions(subject: Subject, other: Callable[[], Subject] | None) -> Finding:
    """Compare an objective with itself in the other precision: gradients agree to a third of float32's digits."""
    if other is None:
        return skip("n/a", f"it computes in {subject.precision} only")
    twin = other()
    both = (subject.first.status == Status.OK) & (twin.first.status == Status.OK)
    loss = difference(subject.first.loss[both], twin.first.loss[both]) / subject.scale
    numbers: dict[str, float | None] = {"both_finite": float(both.sum()), "loss": loss, "gradient": None}
    figure = f"{int(both.sum())} of {len(both)} points finite in both, losses differ by up to {loss:.1e} of their range"
    if subject.first.grad is None or twin.first.grad is None or not bool(both.any()):
        return skip(figure, "no gradients to compare", numbers)
    space, flat = subject.objective.space, max(one.flat(one.first.loss[both]) for one in (subject, twin))
    width = space.upper - space.lower
    ours, theirs = (grad[both] * width for grad in (subject.first.grad, twin.first.grad))
    length = torch.maximum(ours.norm(dim=1), theirs.norm(dim=1))
    apart = torch.where(length > flat, (ours - theirs).norm(dim=1) / length, 0.0)
    error = float(apart.quantile(0.5))
    limit = 10 * max(subject.eps, twin.eps) ** (1 / 3)
    figure, numbers = f"{figure}, gradients by {error:.1e} (median)", {**numbers, "gradient": error, "limit": limit}
    return verdict(error <= limit, figure, f"allowed: at most {limit:.0e}", numbers)
