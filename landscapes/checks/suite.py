"""All checks of an objective: the protocol of an objective, its gradients, and its extremes."""

from __future__ import annotations

import dataclasses
import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Objective, ObjectiveWrapper, Status, evaluate, failed
from ..sampling.memory import ADVICE, is_out_of_memory
from . import examination, extremes, growth
from . import parameters as by_parameter
from .causes import causes
from .conclude import Further, conclude, conclude_jumps, conclude_memory, conclude_physics
from .diagnosis import Diagnosis
from .evidence import Evidence
from .examination import Examination, examine, percent
from .extremes import ExtremeCase
from .finding import FAIL, PASS, SKIP, UNEXPECTED, WARN, Finding, one_line, skip, verdict, within
from .history import observe
from .horizons import FirstWrong, first_wrong_step
from .memory import memory_growth
from .physics import compare_time_steps
from .probe import Lines, Probe
from .slopes import BAD, UNJUDGED, Kind, counts, measure
from .subject import Subject, difference
from .usefulness import Usefulness, usefulness

REPEATS = 3
PROMISE_POINTS = 8  # at which batches, repeats and refusals are checked
POWER = 0.05  # share of the box
FEW_POINTS = 0.75  # of the time that a program of a whole batch takes to compile: that of one of two or three points
CANNOT_TELL = 0.1  # of the points is what has to be judged, to say anything
LATE_POINTS = 2  # at which episodes of other lengths are judged
ON_AVERAGE = ("levels", "length_off")  # numbers of diagnoses of all gradients, though none is wrong by itself
SAID_PLACES, MANY = 3, 6  # places and parameters that are named, at most
OPTIMISER_STEP = 1e-2  # of the box: what a step of a search is long
SIGNS = 0.75  # share of slopes whose sign has to agree over it
USEFUL = 0.5  # what the median relative error of slopes may be over it
LEAST_SHARE = 0.25  # share of slopes to compare for a step to be judged by


@dataclass(eq=False)
class Results:
    """The results of `check` besides findings: measurements, also of calls, and conclusions."""

    examination: Examination | None = None
    calls: Evidence = dataclasses.field(default_factory=dict)
    diagnoses: tuple[Diagnosis, ...] = ()
    usefulness: tuple[Usefulness, ...] = ()


@dataclass(frozen=True)
class Settings:
    """How to check an objective, and its variants.

    `power` is the share of the box in which a defect would be found with 95 % probability. `precision`, float32 or
    float64, is the objective's. `twin` makes it in the other precision; gradients are judged in float64 if possible.
    `variants` are further ways to stress it. `horizons` make it with episodes that many times as long, in float64 if
    possible. `other_mode` makes it with gradients by the other mode of automatic differentiation, forward or reverse.
    `finer` makes it with shorter time steps, by factor, and `make_length` with episodes of one of the `lengths`.
    `expected` has the reason for each expected failure: such a failure is excused, but a pass is not. `memory_seconds`
    are spent on whether memory grows. `follow` receives the name of each check before it runs.
    """

    power: float = POWER
    seed: int = 0
    precision: str = "float64"
    twin: Callable[[], Objective] | None = None
    variants: Sequence[ExtremeCase] = ()
    horizons: Mapping[float, Callable[[], Objective]] = dataclasses.field(default_factory=dict)
    other_mode: Callable[[], Objective] | None = None
    finer: Mapping[float, Callable[[], Objective]] = dataclasses.field(default_factory=dict)
    lengths: Sequence[float] = ()
    make_length: Callable[[float], Objective] | None = None
    expected: Mapping[str, str] = dataclasses.field(default_factory=dict)
    memory_seconds: float = 0.5
    follow: Callable[[str], None] = lambda name: None


def count_others(how: Settings, itself: Callable[[], Objective]) -> float:
    """Count the objectives that a check makes besides `itself`, weighted by their compile time.

    Most are evaluated at a few points. Such a program compiles faster than that of a whole batch, which counts 1.
    """
    whole = {how.twin, how.other_mode, *how.finer.values()} - {None, itself}
    few = {*how.horizons.values(), *(one.make for one in how.variants)} - {None, itself, *whole}
    return len(whole) + FEW_POINTS * len(few)


def check(objective: Objective, settings: Settings | None = None, results: Results | None = None) -> Iterator[Finding]:
    """Check an objective and yield the findings, check by check; everything else is left in `results`.

    An error of the objective is a finding.
    """
    how, results = settings or Settings(), results or Results()
    x = objective.space.uniform(PROMISE_POINTS, seed=how.seed)
    how.follow("shapes")
    shapes = _try("shapes", lambda: _check_shapes(objective, x))
    yield shapes.excuse(how.expected)
    if shapes.outcome == FAIL:
        if "writes to what it has read" in shapes.why or "modified by an inplace operation" in shapes.why:
            (cause,) = [one for one in causes() if one.name == "tape overwritten"]
            results.diagnoses = (Diagnosis(cause.name, FAIL, "certain", shapes.why, cause.remedy),)
        yield Finding("all else", SKIP, "not checked", "evaluations of the wrong form cannot be checked further")
        return
    how.follow("repeats")
    try:
        subject = Subject.observe(objective, x, precision=how.precision, seed=how.seed, repeats=REPEATS)
    except Exception as error:
        yield _failure("determinism", error).excuse(how.expected)
        return
    left = dict(how.expected)
    made = [objective]
    for name, run in _checks(subject, how, results, made):
        how.follow(name)
        left.pop(name, None)
        if name not in PROMISES:
            _give_back(made)
        yield _try(name, run).excuse(how.expected)
    for name in left:
        yield Finding(name, UNEXPECTED, "not checked", "a failure is expected, but there is no such check")


def episodes(dim: int, power: float, horizons: Sequence[float] = ()) -> tuple[int, int]:
    """Return the approximate numbers of episodes of `check` without variants: losses alone, and with gradients.

    Those of other `horizons`, factors of the length, count by their lengths.
    """
    losses, gradients = examination.evaluations(dim, power)
    longer, sloped = (round(count * sum(horizons)) for count in growth.growth_episodes(1))
    return losses + longer, gradients + sloped + PROMISE_POINTS * (REPEATS + 8) + 3 * len(extremes.corners(dim)) + 20


def _other(
    subject: Subject, twin: Callable[[], Objective] | None, made: list[Objective]
) -> Callable[[], Subject] | None:
    """Return a cached evaluation of the twin at the same points; it is added to `made`."""
    if twin is None:
        return None
    precision = "float32" if subject.precision == "float64" else "float64"

    def observe_twin() -> Subject:
        made.append(twin())
        return Subject.observe(made[-1], subject.x, precision=precision, seed=subject.seed, repeats=2)

    return cache(observe_twin)


def _give_back(made: Sequence[Objective]) -> None:
    """Free the device memory that environments hold between evaluations, because another one takes all there is."""
    if any(one.device != "cpu" for one in made):
        for one in made:
            one.release()
        gc.collect()


def _checks(
    subject: Subject, how: Settings, results: Results, made: list[Objective]
) -> Iterator[tuple[str, Callable[[], Finding]]]:
    other = _other(subject, how.twin, made)
    for name, run in PROMISES.items():
        yield name, partial(_keep_promise, run, subject, results)
    yield "order of calls", partial(_check_calls, subject, results)
    if other is not None:
        try:
            other()
        except ValueError:  # kernels written for one precision
            other = None
    exact = other if subject.precision == "float32" else None
    best = exact or (lambda: subject)
    yield "gradient", lambda: _check_gradient(best(), how, results)
    for name, judge in JUDGED.items():
        yield name, partial(_of_gradient, judge, results)
    yield "shorter time steps", partial(_check_time_steps, how, results)
    yield "memory", partial(_check_memory, subject, how.memory_seconds, results)
    yield "second backward", lambda: _check_second_backward(subject, results)
    yield "forward against reverse", lambda: _check_modes(subject, how.other_mode)
    yield "growth over horizons", lambda: growth.check_growth(best(), how.horizons)
    yield from extremes.checks(subject, other, how.variants)


def _keep_promise(run: Callable[[Subject], Finding], subject: Subject, results: Results) -> Finding:
    found = run(subject)
    if run is _check_loss_without_gradient:  # which tells a cause
        results.calls["depends"] = float(found.outcome == FAIL)
    return found


def _check_calls(subject: Subject, results: Results) -> Finding:
    """Call the same points in several orders: an evaluation must not depend on others."""
    seen = observe(subject.objective, subject.x)
    results.calls |= seen
    loss, gradient, limits = seen["loss_moves"], seen["gradient_moves"], subject.repeatable
    figure = f"losses differ by {loss:.1e} and gradients by {gradient:.1e} of themselves"
    ok = loss <= limits[0] and gradient <= limits[1] and not (seen["stale"] or seen["grows"])
    return verdict(ok, "same bits" if max(loss, gradient) == 0 else figure, "an evaluation depends on earlier ones")


def _check_gradient(subject: Subject, how: Settings, results: Results) -> Finding:
    """Judge gradients at random points, and conclude what is wrong with them."""
    repeats = subject.noise[0] * subject.scale
    probe = Probe(subject.objective, subject.precision, repeats, subject.noise[1])
    evaluate(subject.objective, subject.x[:1], grad=False)  # the type of losses is known from now on
    probe.precision = subject.objective.precision
    seen = results.examination = examine(probe, how.power, how.seed, how.follow)
    if seen.found.grad is None:
        return skip("no gradient")
    results.diagnoses = conclude(seen, results.calls, _further(subject.objective, seen, how))
    return _judge_gradient(seen, results)


def _judge_gradient(seen: Examination, results: Results) -> Finding:
    share, counted = seen.share, counts(seen.random.judged)
    told = ", ".join(f"{number} {kind}" for kind, number in counted.items() if number)
    numbers: dict[str, float | None] = {
        "wrong": share.wrong,
        "judged": share.judged,
        "points": share.points,
        "low": share.low,
        "high": share.high,
        "missed": share.missed,
        "evaluations": seen.probe.losses + seen.probe.gradients,
    }
    failing = [one.what for one in results.diagnoses if one.outcome == FAIL]
    on_average = any(one.outcome == FAIL and {*ON_AVERAGE} & {*one.numbers} for one in results.diagnoses)
    if share.wrong or on_average or seen.axes.rows(Kind.WRONG):
        figure = f"wrong at {share.describe()}: {told}" if share.wrong else f"{share.points} points: {told}"
        return Finding("", FAIL, figure, "; ".join(failing), numbers, seen.table())
    if counted[Kind.FAILED] == share.points:
        return Finding("", FAIL, f"none of {share.points} points has a loss", "the gradient cannot be checked", numbers)
    if share.judged < CANNOT_TELL * share.points:
        why = f"only {share.judged} of {share.points} points could be judged, too few for a verdict on the gradient"
        return Finding("", WARN, f"cannot tell: {told}", why, numbers, seen.table())
    figure = f"{share.points} points: {told}; a defect in less than {percent(share.missed)} of the box could be missed"
    return Finding("", PASS, figure, "", numbers, seen.table())


def _further(objective: Objective, seen: Examination, how: Settings) -> Further:
    """Return further questions about points whose gradient is NaN or wrong."""

    def point(row: int) -> Float[Tensor, " dim"]:
        u = seen.u[row] if row >= 0 else seen.places[1].lines.u[-1 - row]
        return objective.space.from_unit(u[None])[0]

    def first_wrong(rows: Sequence[int]) -> FirstWrong | None:
        if how.make_length is None or not rows:
            return None
        return first_wrong_step(how.make_length, how.lengths, partial(_is_wrong, seen, list(rows)[:LATE_POINTS]))

    return Further(
        lambda row: _quietly(objective.nan_origin, point(row)),
        lambda row: _quietly(objective.wrong_origin, point(row)),
        first_wrong,
        has_length=bool(how.lengths),
    )


def _quietly(ask: Callable[[Tensor], str], x: Float[Tensor, " dim"]) -> str:
    """Return a result, or nothing after an error."""
    try:
        return ask(x)
    except Exception:
        return ""


def _is_wrong(seen: Examination, rows: Sequence[int], objective: Objective) -> bool:
    """Return whether gradients at some of the points are wrong for another objective, such as a shorter episode."""
    probe, chosen = Probe(objective, objective.precision), torch.tensor(rows)
    lines = seen.random.lines.rows(chosen)
    found = probe.gradient(lines.u)
    ladder = measure(probe, Lines.through(probe, lines.u, lines.direction, torch.arange(len(rows)), found))
    return bool(ladder.rows(*BAD))


def _check_time_steps(how: Settings, results: Results) -> Finding:
    """Compare gradients of shorter time steps with differences at the shortest."""
    seen = results.examination
    if not how.finer or seen is None or seen.found.grad is None:
        return skip("n/a", "it has no time step")
    evidence = compare_time_steps(seen, how.finer)
    if not evidence:
        return skip(
            "not compared", "slopes over one and three hundredths of the box differ, or the scene refuses the steps"
        )
    found = conclude_physics(evidence)
    results.diagnoses += found
    figure = f"gradients differ by {percent(evidence['physics'])} from slopes at a quarter of the step (median)"
    return Finding("", WARN if found else PASS, figure, "; ".join(one.what for one in found), evidence)


def _check_memory(subject: Subject, seconds: float, results: Results) -> Finding:
    """Check whether memory grows with every evaluation."""
    growth = memory_growth(subject.objective, subject.x[:2], seconds=seconds)
    found = conclude_memory(growth)
    results.diagnoses += found
    figure = f"{growth.total / 1e6:.1f} MB more after {growth.evaluations} evaluations"
    return Finding("", WARN if found else PASS, figure, found[0].what if found else "")


def _of_gradient(judge: Callable[[Examination, Results], Finding], results: Results) -> Finding:
    seen = results.examination
    return skip("no gradient") if seen is None or seen.found.grad is None else judge(seen, results)


def _check_places(seen: Examination, results: Results) -> Finding:
    names, ladder = seen.places
    places = ", ".join(dict.fromkeys(names))
    bad = ladder.rows(*BAD)
    if not bad:
        told = sum(one.kind not in UNJUDGED for one in ladder.judged)
        return verdict(True, f"{told} slopes at {places}: all between the one-sided slopes") if told else skip(places)
    said = (seen.describe_place(row) for row in bad)
    figure = f"{len(bad)} of {len(ladder.judged)} slopes at {places} are wrong"
    numbers: dict[str, float | None] = {"wrong": float(len(bad)), "compared": float(len(ladder.judged))}
    return Finding("", FAIL, figure, "; ".join(list(dict.fromkeys(said))[:SAID_PLACES]), numbers)


def _check_parameters(seen: Examination, results: Results) -> Finding:
    rows = seen.parameters()
    verdicts = [row.verdict for row in rows]
    figure = ", ".join(f"{verdicts.count(one)} {one}" for one in dict.fromkeys(verdicts))
    wrong = [row.parameter for row in rows if row.verdict in by_parameter.WRONG]
    stepped = [row.parameter for row in rows if row.verdict == by_parameter.STEPPED]
    if wrong:
        return Finding("", FAIL, figure, f"wrong by {', '.join(wrong[:MANY])}{' and others' * (len(wrong) > MANY)}")
    if stepped:
        said = f"by {', '.join(stepped[:MANY])} the gradient is 0 at all points, but the loss moves in steps"
        return Finding("", WARN, figure, said)
    return verdict(True, figure)


def _check_usefulness(seen: Examination, results: Results) -> Finding:
    """Check the reach of a gradient: useless over an optimiser's step is a warning about the landscape."""
    results.usefulness = usefulness(seen.probe, seen.random)
    if not any(one.outcome == FAIL for one in results.diagnoses):
        results.diagnoses += conclude_jumps(results.usefulness)
    at = next((one for one in results.usefulness if one.step == OPTIMISER_STEP), None)
    if at is None or at.compared < LEAST_SHARE * len(seen.u):
        return skip("no slope to compare", "all are flat, lost in noise, or failed")
    useful = at.sign.value >= SIGNS and at.error <= USEFUL
    figure = (
        f"over {at.step:g} of the box: sign right {percent(at.sign.value)} ({percent(at.sign.low, bare=True)} to "
        f"{percent(at.sign.high)}), median relative error {at.error:.2g}"
    )
    why = (
        f"gradients are not accurate that far: a search needs the right sign at {SIGNS:.0%} of points and an error of "
        f"at most {USEFUL:g}"
    )
    numbers = {
        "step": at.step,
        "sign": at.sign.value,
        "error": at.error,
        "cosine": at.cosine.value,
        "bias": at.bias.value,
    }
    return Finding("", PASS if useful else WARN, figure, "" if useful else why, numbers)


JUDGED = {"special places": _check_places, "parameters": _check_parameters, "usefulness": _check_usefulness}


def _check_second_backward(subject: Subject, results: Results) -> Finding:
    found = growth.second_backward(subject)
    if found.outcome == FAIL and results.examination is not None and not results.diagnoses:
        results.calls["second_backward"] = 1.0
        results.diagnoses = conclude(results.examination, results.calls)
    return found


def _check_modes(subject: Subject, other_mode: Callable[[], Objective] | None) -> Finding:
    """Compare gradients of the forward mode of automatic differentiation with those of the reverse mode."""
    if other_mode is None:
        return skip("n/a", "it has only one mode of differentiation")
    try:
        found = evaluate(other_mode(), subject.x, grad=True)
    except ValueError as refusal:
        return skip("not checked", one_line(refusal))
    apart, limit = subject.differences(found, subject.first), 10 * subject.eps ** (1 / 3)
    figure = f"gradients differ by up to {apart[1]:.1e} of the largest component"
    return within(max(apart), limit, figure, "one of the two is wrong")


def _try(name: str, run: Callable[[], Finding]) -> Finding:
    """Run a check; any error is a failure of the objective."""
    try:
        return replace(run(), check=name)
    except Exception as error:
        return _failure(name, error)


def _failure(name: str, error: Exception) -> Finding:
    first = (str(error).strip().splitlines() or [""])[0].rstrip(":")  # others' messages may go on for pages
    why = f"{first}; {ADVICE}" if is_out_of_memory(error) else first
    return Finding(name, FAIL, f"raised {type(error).__name__}", why)


def _check_shapes(objective: Objective, x: Float[Tensor, "batch dim"]) -> Finding:
    """Check losses, gradients and statuses of several rows and of one against the protocol."""
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
    """An objective with a given evaluation."""

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
    taken = list(shapes)
    for shape, wrong in shapes.items():
        with suppress(ValueError):
            subject.objective.evaluate(wrong)
            continue
        taken.remove(shape)
    why = f"it must raise ValueError; it accepted x of shape {' and '.join(taken)}"
    return verdict(not taken, f"{len(shapes) - len(taken)} of {len(shapes)} shapes refused", why)


def _check_refusal_of_nan(subject: Subject) -> Finding:
    """Check that NaN gives a ValueError, or a status of its row without changes to other rows."""
    x = subject.x.clone()
    x[0, -1] = torch.nan
    try:
        found = evaluate(subject.objective, x, grad=True)
    except ValueError:
        return verdict(True, "refused")
    others = subject.first.rows(torch.arange(1, len(x)))
    clean = subject.agree(found.rows(slice(1, None)), others)
    status = Status(int(found.status[0]))
    why = "it changed the other rows" if not clean else f"a row of nan got a loss and status {status.name}"
    return verdict(bool(failed(status)) and clean, f"answered by status {status.name}", why)


def _check_determinism(subject: Subject) -> Finding:
    loss, grad = subject.noise
    figure = f"same bits in {REPEATS} repeats"
    if max(loss, grad) > 0:
        figure = f"{REPEATS} repeats differ by {loss:.1e} of the loss range, {grad:.1e} of the largest gradient"
    limits = subject.repeatable
    numbers = {"loss": loss, "gradient": grad, "limit": limits[0], "gradient_limit": limits[1]}
    ok, why = loss <= limits[0] and grad <= limits[1], f"at most {limits[0]:.0e} and {limits[1]:.0e} is allowed"
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
    apart = subject.differences(found, subject.first.rows(rows))
    limits = subject.tolerances
    figure = (
        "same bits" if max(apart) == 0 else f"loss differs by {apart[0]:.1e} of its range, gradient by {apart[1]:.1e}"
    )
    why = f"at most {limits[0]:.0e} and {limits[1]:.0e} is allowed: a row depends on the other rows of its batch"
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
    return within(
        apart, subject.tolerances[0], f"losses differ by {apart:.1e} of their range", "the loss depends on grad="
    )


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
