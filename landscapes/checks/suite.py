"""All checks of an objective: the protocol of an objective, its gradients, and its extremes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Objective, ObjectiveWrapper, Status, evaluate, failed
from ..sampling.memory import ADVICE, is_out_of_memory
from . import extremes
from . import gradients as gradient_checks
from .extremes import ExtremeCase
from .finding import FAIL, SKIP, UNEXPECTED, Finding, one_line, skip, verdict, within
from .subject import Subject, difference

REPEATS = 3


def check(
    objective: Objective,
    *,
    points: int = 4,
    seed: int = 0,
    precision: str = "float64",
    twin: Callable[[], Objective] | None = None,
    variants: Sequence[ExtremeCase] = (),
    horizons: Mapping[float, Callable[[], Objective]] | None = None,
    other_mode: Callable[[], Objective] | None = None,
    expected: Mapping[str, str] | None = None,
    follow: Callable[[str], None] | None = None,
) -> Iterator[Finding]:
    """Check an objective at `points` random points of its box, and yield what was found, check by check.

    `precision`, float32 or float64, is what it computes in; thresholds follow from it. `twin` makes the same objective
    in the other precision: gradients are judged in float64 where there is one. `variants` are further ways to push it.
    `horizons` make it with episodes so many times as long, in float64 where there is a twin; `other_mode` makes it with
    gradients by the other mode of automatic differentiation, forward or reverse. `expected` holds the checks that are
    known to fail, with the reason: such a failure is excused, and a pass is not. `follow` is called with the name of
    each check before it runs.

    Raises ValueError where there are fewer than 2 points; what the objective raises is a finding.
    """
    if points < 2:
        raise ValueError(f"check takes at least 2 points, to compare rows of a batch; got {points}")
    known, announce = expected or {}, follow or (lambda name: None)
    x = objective.space.uniform(points, seed=seed)
    announce("shapes")
    shapes = _try("shapes", lambda: _check_shapes(objective, x))
    yield shapes.excuse(known)
    if shapes.outcome == FAIL:
        yield Finding("all else", SKIP, "not checked", "evaluations of the wrong form can be judged no further")
        return
    announce("repeats")
    try:
        subject = Subject.observe(objective, x, precision=precision, seed=seed, repeats=REPEATS)
    except Exception as error:
        yield _failure("determinism", error).excuse(known)
        return
    left = dict(known)
    for name, run in _checks(subject, _other(subject, twin), variants, horizons or {}, other_mode):
        announce(name)
        left.pop(name, None)
        yield _try(name, run).excuse(known)
    for name in left:
        yield Finding(name, UNEXPECTED, "not checked", "a failure is expected of it, but there is no such check")


def episodes(dim: int, points: int, horizons: Sequence[float] = ()) -> tuple[int, int]:
    """Return about how many episodes `check` takes without variants: losses alone, and with gradients.

    Those of other `horizons`, factors of the length, count by their lengths.
    """
    plain = 2 * points * gradient_checks.SLOPES * (len(gradient_checks.DIFFERENCE_STEPS) + 1) + points
    plain += gradient_checks.place_episodes(dim)
    longer, sloped = (round(count * sum(horizons)) for count in gradient_checks.growth_episodes(1))
    return plain + longer, sloped + points * (REPEATS + 8) + 3 * len(extremes.corners(dim)) + 10


def _other(subject: Subject, twin: Callable[[], Objective] | None) -> Callable[[], Subject] | None:
    """Return what evaluates the twin at the same points, once."""
    if twin is None:
        return None
    precision = "float32" if subject.precision == "float64" else "float64"
    return cache(lambda: Subject.observe(twin(), subject.x, precision=precision, seed=subject.seed, repeats=2))


def _checks(
    subject: Subject,
    other: Callable[[], Subject] | None,
    variants: Sequence[ExtremeCase],
    horizons: Mapping[float, Callable[[], Objective]],
    other_mode: Callable[[], Objective] | None,
) -> Iterator[tuple[str, Callable[[], Finding]]]:
    for name, run in PROMISES.items():
        yield name, partial(run, subject)
    exact = other if subject.precision == "float32" else lambda: subject
    best = exact or (lambda: subject)
    for name, judge in SLOPES.items():
        yield name, lambda judge=judge: judge(best())  # type: ignore[misc]
    yield "gradcheck", lambda: _gradcheck(subject, exact)
    yield "second backward", lambda: gradient_checks.second_backward(subject)
    yield "forward against reverse", lambda: _check_modes(subject, other_mode)
    yield "growth over horizons", lambda: gradient_checks.check_growth(best(), horizons)
    yield from extremes.checks(subject, other, variants)


def _gradcheck(subject: Subject, exact: Callable[[], Subject] | None) -> Finding:
    if exact is None:
        return skip("not checked", f"it computes in {subject.precision} only")
    return gradient_checks.gradcheck(exact())


def _check_modes(subject: Subject, other_mode: Callable[[], Objective] | None) -> Finding:
    """Hold gradients of the forward mode of automatic differentiation against those of the reverse mode."""
    if other_mode is None:
        return skip("n/a", "it has one mode of differentiation only")
    try:
        found = evaluate(other_mode(), subject.x, grad=True)
    except ValueError as refusal:
        return skip("not checked", one_line(refusal))
    apart, limit = subject.differences(found, subject.first), 10 * subject.eps ** (1 / 3)
    figure = f"gradients up to {apart[1]:.1e} of the largest component apart"
    return within(max(apart), limit, figure, "one of the two is wrong")


def _try(name: str, run: Callable[[], Finding]) -> Finding:
    """Run a check; what it raises is a failure of the objective's, whatever it is."""
    try:
        return replace(run(), check=name)
    except Exception as error:
        return _failure(name, error)


def _failure(name: str, error: Exception) -> Finding:
    first = (str(error).strip().splitlines() or [""])[0].rstrip(":")  # others' messages may go on for pages
    why = f"{first}; {ADVICE}" if is_out_of_memory(error) else first
    return Finding(name, FAIL, f"raised {type(error).__name__}", why)


def _check_shapes(objective: Objective, x: Float[Tensor, "batch dim"]) -> Finding:
    """Hold losses, gradients and statuses of several rows and of one against the protocol."""
    wrong = []
    for rows in (x, x[:1]):
        raw = objective.evaluate(rows, grad=True)
        evaluate(_Given(objective, raw), rows, grad=True)
        for field, tensor in (("loss", raw.loss), ("grad", raw.grad)):
            if tensor is not None and tensor.dtype != torch.float64:
                wrong.append(f"{field} must be float64; got {tensor.dtype}")
        if raw.status.is_floating_point():
            wrong.append(f"status must be of a whole-number type; got {raw.status.dtype}")
        if raw.loss.requires_grad or (raw.grad is not None and raw.grad.requires_grad):
            wrong.append("loss and grad must be detached; got tensors that require gradients")
    shape = f"loss ({len(x)},), grad ({len(x)}, {x.shape[1]}), status ({len(x)},)"
    return verdict(not wrong, shape, "; ".join(dict.fromkeys(wrong)))


class _Given(ObjectiveWrapper):
    """An objective whose evaluation is there already."""

    def __init__(self, objective: Objective, evaluation: Evaluation) -> None:
        super().__init__(objective)
        self._evaluation = evaluation

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        return self._evaluation


def _check_status(subject: Subject) -> Finding:
    found = subject.objective.evaluate(subject.x)
    counts, wrong = extremes.count_endings(found)
    missing = extremes.describe_missing(subject.objective.space, subject.x, found)
    return verdict(not (wrong or missing), extremes.describe_counts(counts), missing or wrong)


def _check_refusal_of_shapes(subject: Subject) -> Finding:
    x, dim = subject.x, subject.objective.space.dim
    shapes = {"(2, dim + 1)": x.new_zeros(2, dim + 1), "(dim,)": x[0], "(1, 1, dim)": x[None, :1]}
    taken = [shape for shape, wrong in shapes.items() if not _refuses(subject.objective, wrong)]
    why = f"ValueError is wanted; x of shape {' and '.join(taken)} was taken"
    return verdict(not taken, f"{len(shapes) - len(taken)} of {len(shapes)} shapes refused", why)


def _refuses(objective: Objective, x: Tensor) -> bool:
    try:
        objective.evaluate(x)
    except ValueError:
        return True
    return False


def _check_refusal_of_nan(subject: Subject) -> Finding:
    """Check that nan is refused by a ValueError, or by a status of its row that changes no other row."""
    x = subject.x.clone()
    x[0, -1] = torch.nan
    try:
        found = evaluate(subject.objective, x, grad=True)
    except ValueError:
        return verdict(True, "refused")
    others = subject.rows(torch.arange(1, len(x)))
    clean = subject.agree(found.rows(slice(1, None)), others)
    status = Status(int(found.status[0]))
    why = "the other rows changed with it" if not clean else f"a row of nan was given a loss and status {status.name}"
    return verdict(bool(failed(status)) and clean, f"answered by status {status.name}", why)


def _check_determinism(subject: Subject) -> Finding:
    loss, grad = subject.noise
    figure = f"same bits in {REPEATS} repeats"
    if max(loss, grad) > 0:
        figure = f"{REPEATS} repeats differ by {loss:.1e} of the loss range, {grad:.1e} of the largest gradient"
    limits = subject.repeatable
    numbers = {"loss": loss, "gradient": grad, "limit": limits[0], "gradient_limit": limits[1]}
    ok, why = loss <= limits[0] and grad <= limits[1], f"at most {limits[0]:.0e} and {limits[1]:.0e} is wanted"
    return verdict(ok, figure, why, numbers)


def _check_rows_alone(subject: Subject) -> Finding:
    """Evaluate the first row and the last by themselves."""
    rows = torch.tensor([0, len(subject.x) - 1])
    parts = [subject.evaluate(subject.x[row][None]) for row in rows]
    return _compare(subject, Evaluation.join(parts, dim=subject.x.shape[1], grad=True), rows)


def _check_order_of_rows(subject: Subject) -> Finding:
    order = torch.arange(len(subject.x)).flip(0).roll(1)
    return _compare(subject, subject.evaluate(subject.x[order]), order)


def _compare(subject: Subject, found: Evaluation, rows: Tensor) -> Finding:
    apart = subject.differences(found, subject.rows(rows))
    limits = subject.tolerances
    figure = "same bits" if max(apart) == 0 else f"loss {apart[0]:.1e} of its range, gradient {apart[1]:.1e} apart"
    why = f"at most {limits[0]:.0e} and {limits[1]:.0e} is wanted: a row depends on the rows it is evaluated with"
    return verdict(all(a <= limit for a, limit in zip(apart, limits, strict=True)), figure, why)


def _check_empty_batch(subject: Subject) -> Finding:
    found = subject.objective.evaluate(subject.x[:0])
    fields = {"loss": found.loss, "grad": found.grad, "status": found.status}
    shapes = {field: tuple(tensor.shape) for field, tensor in fields.items() if tensor is not None}
    wanted: dict[str, Any] = {"loss": (0,), "grad": (0, subject.objective.space.dim), "status": (0,)}
    figure = ", ".join(f"{field} {shape}" for field, shape in shapes.items())
    return verdict(shapes == wanted, figure, f"wanted {wanted}")


def _check_loss_without_gradient(subject: Subject) -> Finding:
    found = evaluate(subject.objective, subject.x, grad=False)
    apart = difference(found.loss, subject.first.loss) / subject.scale
    return within(apart, subject.tolerances[0], f"{apart:.1e} of the loss range apart", "the loss depends on grad=")


SLOPES: Mapping[str, Callable[[Subject], Finding]] = {
    "finite differences": gradient_checks.check_slopes,
    "an optimiser's step": gradient_checks.check_usefulness,
    "special places": gradient_checks.check_special_places,
}
PROMISES: Mapping[str, Callable[[Subject], Finding]] = {
    "status": _check_status,
    "refusal of a wrong shape": _check_refusal_of_shapes,
    "refusal of nan": _check_refusal_of_nan,
    "determinism": _check_determinism,
    "rows alone": _check_rows_alone,
    "rows in another order": _check_order_of_rows,
    "empty batch": _check_empty_batch,
    "loss without gradient": _check_loss_without_gradient,
}
