"""Samples: the results of a scene's variants at the same points, their times, and comparisons of two of them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..landscapes.cost import measure_seconds
from ..landscapes.objective import Evaluation, Objective, Status, evaluate, has_loss
from ..landscapes.plain import finite
from ..landscapes.statistics import CONFIDENCE, Estimate, gradient_error, median_of, p95_of, share, spearman

REPETITION, TURNS = 0.04, 4  # least seconds that repetitions of a quick batch take, each way, and how often
LARGEST = 60.0  # most seconds that a batch larger than the study's points may take
GIVEN_UP = 10.0  # seconds that all points have to take at least, for a variant to be given up at the first
WORTH = 0.9  # of the time of an episode: a larger batch that saves less is not followed by one larger still
RESAMPLES = 999  # of the bootstrap
MIN_ROUNDS, MAX_ROUNDS = 9, 49  # in which two objectives are timed in turn
MIN_SECONDS = 8.0  # that the rounds take together, up to the most rounds
DISTURBED = 1.0  # seconds from which a batch is timed once only
BATCH_SECONDS = 0.2  # that a batch should take to be timed in turn
Array = NDArray[np.float64]
Follow = Callable[[int], None]  # hears how many points are done
Parts = tuple[Evaluation, float]  # what points return, and the seconds of an episode in the best batch
Evaluate = Callable[[Objective, Tensor, Follow], Parts]  # with gradients


def ignore(done: int) -> None:
    """Do nothing."""


@dataclass(frozen=True, eq=False)
class Sample:
    """The results of one variant at the points of a study, and their cost.

    `loss` [objective's unit], shape (point,), NaN where it failed; `grad` [loss unit / width of the box], shape (point,
    dim); `status`, shape (point,). `forward` and `with_gradient` [s per episode] are the best times, in batches of
    `batch`. `refused` is the reason for a refused variant; `error` is the message of the first point that raised.
    """

    loss: Array
    grad: Array
    status: NDArray[np.int8]
    forward: float = 0.0
    with_gradient: float = 0.0
    batch: int = 0
    refused: str = ""
    error: str = ""

    @classmethod
    def of(cls, found: Evaluation, objective: Objective, **more: Any) -> Sample:
        """Return an evaluation with gradients as a sample."""
        grad = cast("Tensor", found.grad) * (objective.space.upper - objective.space.lower)
        return cls(found.loss.numpy(), grad.numpy(), found.status.numpy().astype(np.int8), **more)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the input of `of_arrays`, for a file."""
        return {name: np.asarray(getattr(self, name)) for name in self.__dataclass_fields__}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Sample:
        """Rebuild a sample from its `arrays`."""
        plain = {name: value if value.ndim else value.item() for name, value in arrays.items()}
        known: dict[str, Any] = {name: plain[name] for name in cls.__dataclass_fields__}
        return cls(**known)

    def first(self, points: int) -> Sample:
        """Return the results at the first points."""
        return replace(self, loss=self.loss[:points], grad=self.grad[:points], status=self.status[:points])

    def join(self, more: Sample) -> Sample:
        """Return it with further points of the same variant; seconds are the best of both."""
        return Sample(
            loss=np.concatenate([self.loss, more.loss]),
            grad=np.concatenate([self.grad, more.grad]),
            status=np.concatenate([self.status, more.status]),
            forward=min(self.forward, more.forward),
            with_gradient=min(self.with_gradient, more.with_gradient),
            batch=max(self.batch, more.batch),
        )

    @property
    def quick(self) -> bool:
        """Whether it was timed so briefly that other load on the machine can have disturbed it."""
        return self.forward > 0 and self.batch * self.with_gradient < DISTURBED

    @property
    def fine(self) -> NDArray[np.bool_]:
        """Which points have a finite loss and a finite gradient, shape (point,)."""
        found: NDArray[np.bool_] = self.status == Status.OK
        return found


def evaluate_parts(objective: Objective, x: Float[Tensor, "point dim"], follow: Follow = ignore) -> Parts:
    """Evaluate points in the objective's preferred batches."""
    objective.prepare()
    parts, each, done = list[Evaluation](), math.inf, 0
    for part in torch.split(x, objective.preferred_batch):
        began = time.perf_counter()
        parts.append(evaluate(objective, part, grad=True))
        each = min(each, (time.perf_counter() - began) / len(part))
        follow(done := done + len(part))
    return Evaluation.join(parts, dim=objective.space.dim, grad=True), each


def evaluate_points(
    objective: Objective, x: Float[Tensor, "point dim"], follow: Follow = ignore, *, by: Evaluate = evaluate_parts
) -> Sample:
    """Evaluate losses and gradients in the objective's preferred batches; seconds are those of the best batch."""
    found, each = by(objective, x, follow)
    return Sample.of(found, objective, with_gradient=each)


def measure(
    objective: Objective,
    x: Float[Tensor, "point dim"],
    *,
    follow: Follow = ignore,
    patience: float | None = None,
    limit: float = math.inf,
    by: Evaluate = evaluate_parts,
) -> Sample:
    """Evaluate an objective at the points of a study, then time it.

    Seconds are the best of repetitions, of batches as large as saves time: both take at most `patience` [s] beyond one
    evaluation, if that is given. A variant that takes more than `limit` [s per episode] for its first points, at best,
    is abandoned there: the sample is that of these points.
    """
    alone = REPETITION * (1 if objective.device == "cpu" else TURNS)  # a GPU is nobody else's, and takes no turns
    repetition, largest = (alone, LARGEST) if patience is None else (patience, patience)
    full = min(objective.preferred_batch, len(x))
    objective.prepare()
    began = time.perf_counter()
    evaluate(objective, x[:1], grad=True)  # what is made at first use is made now, a batch's threads too if quick
    took = time.perf_counter() - began
    if took * full < BATCH_SECONDS:
        evaluate(objective, x[:full], grad=True)
    limit = max(limit, GIVEN_UP / len(x))
    if took > limit and (first := _slow_start(objective, x, limit)):
        return first
    found, each = by(objective, x, follow)
    batch, took = _repeat_points(objective, x, _timed_rows(objective, full, each), each, largest)
    forward = _best(objective, batch, grad=False, known=math.inf, repetition=repetition)
    with_gradient = _best(objective, batch, grad=True, known=took, repetition=repetition)
    return Sample.of(found, objective, forward=forward, with_gradient=with_gradient, batch=len(batch))


def _whole(objective: Objective) -> bool:
    """Return whether a part of a batch takes as long as all of it."""
    return objective.device == "cuda" or objective.whole_batches


def _slow_start(objective: Objective, x: Tensor, limit: float) -> Sample | None:
    """Return the sample of the first batch, if even so an episode takes more than `limit` [s]."""
    most = objective.preferred_batch if _whole(objective) else objective.threads
    found, each = evaluate_parts(objective, x[:most])
    rows = len(found.loss)
    at_best = each * rows / most if _whole(objective) else each
    return Sample.of(found, objective, with_gradient=each, batch=rows) if at_best > limit else None


def _timed_rows(objective: Objective, full: int, each: float) -> int:
    """Return the number of points to time: a batch, or fewer on threads if they take long enough."""
    turns = DISTURBED / max(each, 1e-9) / objective.threads
    return full if _whole(objective) else min(full, objective.threads * max(1, math.ceil(turns)))


def _repeat_points(objective: Objective, x: Tensor, rows: int, each: float, largest: float) -> tuple[Tensor, float]:
    """Return the points, repeated up to the useful batch size, and their seconds.

    `rows` points take `each` [s per episode]. More are tried up to the objective's preferred number, or to `largest`
    seconds, as long as that saves time.
    """
    at_once, took = objective.preferred_batch, each * rows
    worth = _whole(objective) or took < BATCH_SECONDS
    while worth and rows < at_once and took * (more := min(4 * rows, at_once)) / rows < largest:
        began = time.perf_counter()
        objective.evaluate(_repeat(x, more), grad=True)
        before, rows, took = took / rows, more, time.perf_counter() - began
        worth = took < BATCH_SECONDS or (_whole(objective) and took / rows < WORTH * before)
    return _repeat(x, rows), took


def repeat_seconds(objective: Objective, points: int, each: float) -> float:
    """Estimate the cost of timing beyond one evaluation of points that take `each` [s per episode]."""
    full = min(objective.preferred_batch, points)
    rows, added = _timed_rows(objective, full, each), each * full if each * full < BATCH_SECONDS else 0.0
    while each * rows < BATCH_SECONDS and rows < objective.preferred_batch:
        rows = min(4 * rows, objective.preferred_batch)
        added += each * rows
    took = each * rows
    both = max(REPETITION, took / 2) + max(REPETITION, took)  # a loss takes about half of that
    turns = TURNS - 1 if objective.device == "cpu" and took < DISTURBED else 0
    return added + both + turns * (took + both)


def _repeat(x: Tensor, rows: int) -> Tensor:
    return x.repeat(-(-rows // len(x)), 1)[:rows]


def time_again(objective: Objective, x: Float[Tensor, "point dim"], sample: Sample) -> Sample:
    """Time a fast objective once more, as `measure` has done; seconds are the best of both."""
    batch = _repeat(x, sample.batch)
    objective.evaluate(batch, grad=True)
    known = {False: sample.forward, True: sample.with_gradient}
    found = {
        grad: min(before, _best(objective, batch, grad=grad, known=math.inf, repetition=REPETITION))
        for grad, before in known.items()
    }
    return replace(sample, forward=found[False], with_gradient=found[True])


def _best(objective: Objective, batch: Tensor, *, grad: bool, known: float, repetition: float) -> float:
    """Return seconds per episode, the least of repetitions; `known` is the earlier time of the batch."""
    best, start = known, time.perf_counter()
    while not math.isfinite(best) or time.perf_counter() - start + best < repetition:
        began = time.perf_counter()
        objective.evaluate(batch, grad=grad)
        best = min(best, time.perf_counter() - began)
    return best / len(batch)


@dataclass(frozen=True, eq=False)
class Turns:
    """The seconds per episode of two objectives timed in turn, each without and with gradient, shape (2, round).

    `batch` is the number of episodes timed at once.
    """

    first: Array
    second: Array
    batch: int

    def ratio(self, *, grad: bool, seed: int) -> Bootstrap:
        """Estimate the ratio of the second's time to the first's: the median of the rounds'."""
        return Bootstrap.of(median_of, self.second[int(grad)] / self.first[int(grad)], seed=seed)


def take_turns(first: Objective, second: Objective, x: Float[Tensor, "point dim"]) -> Turns:
    """Time two objectives in turn at the same points, so that other load on the machine disturbs both alike.

    Each round times both without gradient, then both with it; the order changes from round to round.
    """
    both = (first, second)
    batch = _timed_batch(both, x)
    seconds: dict[bool, list[list[float]]] = {False: [], True: []}
    began, rounds = time.perf_counter(), 0
    while rounds < MIN_ROUNDS or (rounds < MAX_ROUNDS and time.perf_counter() - began < MIN_SECONDS):
        order = (0, 1) if rounds % 2 == 0 else (1, 0)
        for grad, found in seconds.items():
            taken = {number: measure_seconds(both[number], batch, grad=grad) / len(batch) for number in order}
            found.append([taken[0], taken[1]])
        rounds += 1
    table = np.array([seconds[False], seconds[True]])
    return Turns(table[..., 0], table[..., 1], len(batch))


def _timed_batch(both: tuple[Objective, Objective], x: Tensor) -> Tensor:
    """Return enough points to time, at least one per thread; warm both objectives up."""
    most = min(len(x), *(one.preferred_batch for one in both))
    whole = both[0].device == "cuda"  # takes all at once: of one point most would be launches
    rows = most if whole else min(most, max(one.threads for one in both))
    while True:
        for one in both:
            measure_seconds(one, x[:rows], grad=True)
        if rows == most or min(measure_seconds(one, x[:rows], grad=False) for one in both) >= BATCH_SECONDS:
            return x[:rows]
        rows = min(2 * rows, most)


@dataclass(frozen=True)
class Bootstrap:
    """A number and its bootstrap interval (95 %); None where it is not finite or not defined."""

    value: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, statistic: Callable[..., Array], *samples: NDArray[Any], seed: int) -> Bootstrap:
        """Estimate a statistic, a reduction along the last axis, of samples whose entries belong together.

        Percentile bootstrap (Efron 1979). Infinite entries are allowed: they are worse than any number.
        """
        if not samples[0].size:
            return cls(None, None, None)
        rows = np.random.default_rng(seed).integers(samples[0].size, size=(RESAMPLES, samples[0].size))
        again = statistic(*(sample[rows] for sample in samples))
        again = np.append(again[~np.isnan(again)], np.inf if np.isnan(again).all() else [])
        ends = np.quantile(again, ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2), method="nearest")
        return cls(*(finite(float(value)) for value in (statistic(*samples), *ends)))

    def share(self, whole: float | None) -> Bootstrap:
        """Return it as a share of a whole, None where there is none."""
        ends = (self.value, self.low, self.high)
        return Bootstrap(*(value / whole if value is not None and whole else None for value in ends))

    def __str__(self) -> str:
        """Return the number with the ends of its interval, for a sentence."""
        value, low, high = ("?" if end is None else f"{end:z.3g}" for end in (self.value, self.low, self.high))
        return f"{value} ({low} to {high})"


def interval_columns(name: str, found: Bootstrap | Estimate) -> dict[str, float | None]:
    """Return the columns of a table for a number and the ends of its interval."""
    return {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}


def percent(value: float | None) -> str:
    """Return a share in per cent; None means not finite."""
    return "not finite" if value is None else f"{100 * value:.2g} %"


@dataclass(frozen=True)
class LossError:
    """Median and 95th percentile of |loss - reference|, in the loss's unit and as shares of the losses' spread."""

    median: Bootstrap
    p95: Bootstrap
    median_relative: Bootstrap
    p95_relative: Bootstrap


@dataclass(frozen=True)
class GradientError:
    """Medians of the cosine of gradients with the reference's, and of their relative error."""

    cosine: Bootstrap
    relative_error: Bootstrap


@dataclass(frozen=True)
class Seconds:
    """The time of an episode [s], in batches."""

    forward: float
    with_gradient: float


@dataclass(frozen=True)
class Comparison:
    """The comparison of a variant with the reference, at the `compared` points where the reference succeeded.

    A failed episode counts as infinitely far off, so a percentile can be None. Where both have a loss: `spearman`, rank
    correlation of losses; where both have a gradient, `gradient`. `diverged` is the failed share. `missing` is the
    share without a gradient among points with a loss and a reference gradient. `batch` is the number of episodes timed
    at once.
    """

    loss_error: LossError
    spearman: Bootstrap
    gradient: GradientError
    diverged: float | None
    compared: int
    seconds: Seconds
    batch: int
    missing: float | None = None

    @property
    def failed(self) -> Estimate | None:
        """The failed share with its exact interval, None where nothing was compared."""
        return None if self.diverged is None else share(round(self.diverged * self.compared), self.compared)

    def columns(self) -> dict[str, float | None]:
        """Return the columns of tables: errors are shares of the spread, with the ends of 95 % intervals."""
        return {
            "median": self.loss_error.median_relative.value,
            **interval_columns("p95", self.loss_error.p95_relative),
            **{"spearman": self.spearman.value, "cosine": self.gradient.cosine.value},
            **{"relative_error": self.gradient.relative_error.value, "diverged": self.diverged},
        }


def compare(variant: Sample, reference: Sample, *, seed: int) -> Comparison:
    """Compare a variant with the reference, or only at its first points if the variant was abandoned after these.

    The 95th percentile is the next larger error of the sample, not interpolated. Gradients are per width of the box.
    They are equal where both are exactly zero; where one is, their cosine is 0 and they are infinitely far off.
    """
    scale, reference = spread(reference), reference.first(len(variant.loss))
    known = has_loss(reference.status)
    both = known & has_loss(variant.status)
    wanted = both & reference.fine
    gradients = wanted & variant.fine
    error = np.where(has_loss(variant.status), np.abs(variant.loss - reference.loss), np.inf)[known]
    cosine, off = gradient_error(variant.grad[gradients], reference.grad[gradients])
    median, p95 = (Bootstrap.of(of, error, seed=seed) for of in (median_of, p95_of))
    return Comparison(
        LossError(median, p95, median.share(scale), p95.share(scale)),
        Bootstrap.of(spearman, variant.loss[both], reference.loss[both], seed=seed),
        GradientError(Bootstrap.of(median_of, cosine, seed=seed), Bootstrap.of(median_of, off, seed=seed)),
        float(1 - both.sum() / known.sum()) if known.any() else None,
        int(known.sum()),
        Seconds(variant.forward, variant.with_gradient),
        variant.batch,
        float(1 - gradients.sum() / wanted.sum()) if wanted.any() else None,
    )


def spread(reference: Sample) -> float | None:
    """Return the reference of errors: the 5th to 95th percentile of the reference's losses; None without one."""
    loss = reference.loss[has_loss(reference.status)]
    return loss_range(loss) or None


def loss_range(loss: Array) -> float:
    """Return the 5th to 95th percentile of losses, 0 without any."""
    return float(np.subtract(*np.percentile(loss, (95, 5)))) if loss.size else 0.0


def pareto_front(seconds: Sequence[float], error: Sequence[float]) -> list[int]:
    """Return the numbers of those that no other beats in both, by time; non-finite ones are always beaten."""
    known = [k for k in range(len(seconds)) if np.isfinite(seconds[k]) and np.isfinite(error[k])]
    best, kept = np.inf, []
    for k in sorted(known, key=lambda k: (seconds[k], error[k])):
        if error[k] < best:
            best = error[k]
            kept.append(k)
    return kept
