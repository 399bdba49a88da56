"""Samples: what variants of a scene return at the same points, how long they take, and one held against another."""

from __future__ import annotations

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
from ..landscapes.statistics import CONFIDENCE, gradient_error, median_of, p95_of, spearman

REPETITION = 4.0  # least seconds that repetitions of a quick batch take, each way
LARGEST = 60.0  # most seconds that a batch larger than the study's points may take
RESAMPLES = 999  # of the bootstrap
MIN_ROUNDS, MAX_ROUNDS = 9, 49  # in which two objectives are timed in turn
MIN_SECONDS = 8.0  # that the rounds take together, up to the most rounds
BATCH_SECONDS = 0.2  # that a batch should take to be timed in turn
Array = NDArray[np.float64]
Follow = Callable[[int], None]  # hears how many points are done


def _ignore(done: int) -> None:
    """Take no notice."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Hold what one variant returns at the points of a study, and what that costs.

    `loss` [objective's unit], shape (point,), NaN where it failed; `grad` [loss unit / width of the box], shape
    (point, dim); `status`, shape (point,); `forward` and `with_gradient` [s per episode], at best, in batches of
    `batch`. Where the variant was refused `refused` says why; `error` is what the first point that raised said.
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
        """Return what `of_arrays` takes, for a file."""
        return {name: np.asarray(getattr(self, name)) for name in self.__dataclass_fields__}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Sample:
        """Rebuild a sample from its `arrays`."""
        plain = {name: value if value.ndim else value.item() for name, value in arrays.items()}
        known: dict[str, Any] = {name: plain[name] for name in cls.__dataclass_fields__}
        return cls(**known)

    def first(self, points: int) -> Sample:
        """Return what it holds at the first points."""
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
    def fine(self) -> NDArray[np.bool_]:
        """Which points have a finite loss and a finite gradient, shape (point,)."""
        found: NDArray[np.bool_] = self.status == Status.OK
        return found


def evaluate_points(objective: Objective, x: Float[Tensor, "point dim"], follow: Follow = _ignore) -> Sample:
    """Evaluate losses and gradients in the batches that an objective prefers; seconds are those of the best batch."""
    objective.prepare()
    found, seconds = _evaluate_parts(objective, x, follow)
    each = min(took / rows for took, rows in zip(seconds, _rows(objective, x), strict=True))
    return Sample.of(found, objective, with_gradient=each)


def measure(
    objective: Objective, x: Float[Tensor, "point dim"], *, follow: Follow = _ignore, patience: float | None = None
) -> Sample:
    """Evaluate an objective at the points of a study, then time it.

    Seconds are the best of repetitions, of batches as large as the objective prefers, or as patience allows: both take
    at most `patience` [s] beyond one evaluation, where that is given.
    """
    repetition, largest = (REPETITION, LARGEST) if patience is None else (patience, patience)
    full = min(objective.preferred_batch, len(x))
    objective.prepare()
    began = time.perf_counter()
    evaluate(objective, x[:1], grad=True)  # what is made at first use is made now, a batch's threads too if quick
    if (time.perf_counter() - began) * full < repetition:
        evaluate(objective, x[:full], grad=True)
    found, seconds = _evaluate_parts(objective, x, follow)
    batch = _repeat_points(objective, x, full, seconds[0], largest)
    taken = min(seconds[: len(x) // full]) if len(batch) == full else np.inf
    forward = _best(objective, batch, grad=False, known=np.inf, repetition=repetition)
    with_gradient = _best(objective, batch, grad=True, known=taken, repetition=repetition)
    return Sample.of(found, objective, forward=forward, with_gradient=with_gradient, batch=len(batch))


def _rows(objective: Objective, x: Tensor) -> list[int]:
    return [len(part) for part in torch.split(x, objective.preferred_batch)]


def _evaluate_parts(objective: Objective, x: Tensor, follow: Follow) -> tuple[Evaluation, list[float]]:
    """Evaluate points batch by batch; return the seconds of each batch, too."""
    parts, seconds, done = list[Evaluation](), list[float](), 0
    for part in torch.split(x, objective.preferred_batch):
        began = time.perf_counter()
        parts.append(evaluate(objective, part, grad=True))
        seconds.append(time.perf_counter() - began)
        follow(done := done + len(part))
    return Evaluation.join(parts, dim=objective.space.dim, grad=True), seconds


def _repeat_points(objective: Objective, x: Tensor, rows: int, took: float, largest: float) -> Tensor:
    """Return the points repeated to as many as are worth evaluating at once, or to what takes `largest` seconds."""
    at_once = objective.preferred_batch
    while rows < at_once and took * (more := min(4 * rows, at_once)) / rows < largest:
        began = time.perf_counter()
        objective.evaluate(x.repeat(-(-more // len(x)), 1)[:more], grad=True)
        rows, took = more, time.perf_counter() - began
    return x.repeat(-(-rows // len(x)), 1)[:rows]


def _best(objective: Objective, batch: Tensor, *, grad: bool, known: float, repetition: float) -> float:
    """Return seconds per episode, the least of repetitions; `known` is what the batch took before."""
    best, start = known, time.perf_counter()
    while not np.isfinite(best) or time.perf_counter() - start + best < repetition:
        began = time.perf_counter()
        objective.evaluate(batch, grad=grad)
        best = min(best, time.perf_counter() - began)
    return best / len(batch)


@dataclass(frozen=True, eq=False)
class Turns:
    """Hold the seconds per episode of two objectives timed in turn, each without and with gradient, shape (2, round).

    `batch` is how many episodes were timed at once.
    """

    first: Array
    second: Array
    batch: int

    def ratio(self, *, grad: bool, seed: int) -> Bootstrap:
        """Estimate the ratio of the second's time to the first's: the median of the rounds'."""
        return Bootstrap.of(median_of, self.second[int(grad)] / self.first[int(grad)], seed=seed)


def take_turns(first: Objective, second: Objective, x: Float[Tensor, "point dim"]) -> Turns:
    """Time two objectives in turn at the same points, so that whatever else keeps the machine busy disturbs both alike.

    Each round times both without gradient, then both with it; which is first changes from round to round.
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
    """Return as many points as take both long enough to be timed, from as many as there are threads; warm both up."""
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
    """Hold a number and its bootstrap interval (95 %); None where it is not finite or not defined."""

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
        """Return the number with the ends of its interval, as a sentence has it."""
        value, low, high = ("?" if end is None else f"{end:z.3g}" for end in (self.value, self.low, self.high))
        return f"{value} ({low} to {high})"


@dataclass(frozen=True)
class LossError:
    """Hold median and 95th percentile of |loss - reference|, in the loss's unit and as shares of the losses' spread."""

    median: Bootstrap
    p95: Bootstrap
    median_relative: Bootstrap
    p95_relative: Bootstrap


@dataclass(frozen=True)
class GradientError:
    """Hold medians of gradients' cosine with the reference's, and of their relative error."""

    cosine: Bootstrap
    relative_error: Bootstrap


@dataclass(frozen=True)
class Seconds:
    """Hold what an episode takes [s], in batches."""

    forward: float
    with_gradient: float


@dataclass(frozen=True)
class Comparison:
    """Hold a variant against the reference, at the points where that one did not fail: so many are `compared`.

    An episode that failed counts as infinitely far off, so that a percentile can be None. Where both have a loss:
    `spearman`, rank correlation of losses; where both have a gradient, `gradient`. `diverged` is the share that failed,
    `missing` that of the points with a loss and a reference's gradient that have none themselves, `batch` how many
    episodes were timed at once.
    """

    loss_error: LossError
    spearman: Bootstrap
    gradient: GradientError
    diverged: float | None
    compared: int
    seconds: Seconds
    batch: int
    missing: float | None = None

    def columns(self) -> dict[str, float | None]:
        """Return what tables have of it: errors are shares of the spread, with the ends of 95 % intervals."""
        p95 = self.loss_error.p95_relative
        return {
            "median": self.loss_error.median_relative.value,
            **{"p95": p95.value, "p95_low": p95.low, "p95_high": p95.high},
            **{"spearman": self.spearman.value, "cosine": self.gradient.cosine.value},
            **{"relative_error": self.gradient.relative_error.value, "diverged": self.diverged},
        }


def compare(variant: Sample, reference: Sample, *, seed: int) -> Comparison:
    """Hold a variant against the reference.

    The 95th percentile is the next larger error of the sample, not interpolated. Gradients are per width of the box;
    they are equal where both are exactly zero, and where one is, their cosine is 0 and they are infinitely far off.
    """
    known = has_loss(reference.status)
    both = known & has_loss(variant.status)
    wanted = both & reference.fine
    gradients = wanted & variant.fine
    error = np.where(has_loss(variant.status), np.abs(variant.loss - reference.loss), np.inf)[known]
    cosine, off = gradient_error(variant.grad[gradients], reference.grad[gradients])
    scale = spread(reference)
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
    """Return what errors are shares of: the 5th to 95th percentile of the reference's losses; None without one."""
    loss = reference.loss[has_loss(reference.status)]
    return loss_range(loss) or None


def loss_range(loss: Array) -> float:
    """Return the 5th to 95th percentile of losses, 0 without any."""
    return float(np.subtract(*np.percentile(loss, (95, 5)))) if loss.size else 0.0


def pareto_front(seconds: Sequence[float], error: Sequence[float]) -> list[int]:
    """Return the numbers of those that no other beats in both, by time; one that is not finite is beaten."""
    known = [k for k in range(len(seconds)) if np.isfinite(seconds[k]) and np.isfinite(error[k])]
    best, kept = np.inf, []
    for k in sorted(known, key=lambda k: (seconds[k], error[k])):
        if error[k] < best:
            best = error[k]
            kept.append(k)
    return kept
