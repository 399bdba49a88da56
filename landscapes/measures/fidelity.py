"""Accuracy against cost: the same points in several variants of a scene, each held against a reference."""

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

from ..objective import Evaluation, Objective, Status, evaluate, has_loss
from ..plain import finite, number, optional
from ..statistics import CONFIDENCE, fit_line

REPETITION = 4.0  # least seconds that repetitions of a quick batch take, each way
LARGEST = 60.0  # most seconds that a batch larger than the study's points may take
RESAMPLES = 999  # of the bootstrap
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sample:
    """Hold what one variant says at the points of a study, and what that costs.

    `loss` [objective's unit], shape (point,); `grad` [loss unit / width of the box], shape (point, dim); `status`,
    shape (point,); `forward` and `with_gradient` [s per episode], at best, in batches of `batch`.
    """

    loss: Array
    grad: Array
    status: NDArray[np.int8]
    forward: float
    with_gradient: float
    batch: int

    def arrays(self) -> dict[str, Any]:
        """Return what `Sample(**arrays)` takes, for a file."""
        return {name: np.asarray(getattr(self, name)) for name in self.__dataclass_fields__}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Sample:
        """Rebuild a sample from its `arrays`."""
        plain: dict[str, Any] = {name: value if value.ndim else value.item() for name, value in arrays.items()}
        return cls(**plain)

    def first(self, points: int) -> Sample:
        """Return what it says at the first points."""
        return replace(self, loss=self.loss[:points], grad=self.grad[:points], status=self.status[:points])

    def join(self, more: Sample) -> Sample:
        """Return it with further points of the same variant; seconds are the best of both."""
        return Sample(
            np.concatenate([self.loss, more.loss]),
            np.concatenate([self.grad, more.grad]),
            np.concatenate([self.status, more.status]),
            min(self.forward, more.forward),
            min(self.with_gradient, more.with_gradient),
            max(self.batch, more.batch),
        )


@dataclass(frozen=True)
class Bootstrap:
    """Hold a number and its bootstrap interval (95 %); None where it is not finite or not defined."""

    value: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, statistic: Callable[..., Array], *samples: Array, seed: int) -> Bootstrap:
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

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Bootstrap:
        """Read it from plain JSON."""
        return cls(*(optional(number, record[end]) for end in ("value", "low", "high")))

    def share(self, whole: float | None) -> Bootstrap:
        """Return it as a share of a whole, None where there is none."""
        ends = (self.value, self.low, self.high)
        return Bootstrap(*(value / whole if value is not None and whole else None for value in ends))


def measure(
    objective: Objective,
    x: Float[Tensor, "point dim"],
    *,
    follow: Callable[[int], None] = lambda done: None,
    patience: float | None = None,
) -> Sample:
    """Evaluate an objective at the points of a study, then time it; `follow` hears how many points are done.

    Seconds are the best of repetitions, of batches as large as the objective prefers, or as patience allows: both take
    at most `patience` [s] beyond one evaluation, where that is given.
    """
    repetition, largest = (REPETITION, LARGEST) if patience is None else (patience, patience)
    at_once = objective.preferred_batch
    full = min(at_once, len(x))
    objective.prepare()
    began = time.perf_counter()
    evaluate(objective, x[:1], grad=True)  # what is made at first use is made now, a batch's threads too if quick
    if (time.perf_counter() - began) * full < repetition:
        evaluate(objective, x[:full], grad=True)
    parts, seconds, done = [], [], 0
    for part in torch.split(x, at_once):
        began = time.perf_counter()
        parts.append(evaluate(objective, part, grad=True))
        seconds.append(time.perf_counter() - began)
        follow(done := done + len(part))
    batch = _repeat_points(objective, x, full, at_once, seconds[0], largest)
    taken = min(seconds[: len(x) // full]) if len(batch) == full else np.inf
    forward = _best(objective, batch, grad=False, known=np.inf, repetition=repetition)
    with_gradient = _best(objective, batch, grad=True, known=taken, repetition=repetition)
    widths = objective.space.upper - objective.space.lower
    whole = Evaluation.join(parts, dim=objective.space.dim, grad=True)
    grad = cast("Tensor", whole.grad) * widths
    return Sample(whole.loss.numpy(), grad.numpy(), whole.status.numpy(), forward, with_gradient, len(batch))


def _repeat_points(
    objective: Objective, x: Tensor, rows: int, at_once: int, took: float, largest: float
) -> Float[Tensor, "batch dim"]:
    """Return the points repeated to as many as are worth evaluating at once, or to what takes `largest` seconds."""
    while rows < at_once and took * (more := min(4 * rows, at_once)) / rows < largest:
        began = time.perf_counter()
        objective.evaluate(x.repeat(-(-more // len(x)), 1)[:more], grad=True)
        rows, took = more, time.perf_counter() - began
    return x.repeat(-(-rows // len(x)), 1)[:rows]


def _best(
    objective: Objective, batch: Float[Tensor, "batch dim"], *, grad: bool, known: float, repetition: float
) -> float:
    """Return seconds per episode, the least of repetitions; `known` is what the batch took before."""
    best, start = known, time.perf_counter()
    while not np.isfinite(best) or time.perf_counter() - start + best < repetition:
        began = time.perf_counter()
        objective.evaluate(batch, grad=grad)
        best = min(best, time.perf_counter() - began)
    return best / len(batch)


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
    episodes were timed at once. Fields are called as files have them.
    """

    loss_error: LossError
    spearman: Bootstrap
    gradient: GradientError
    diverged: float | None
    compared: int
    seconds: Seconds
    batch: int
    missing: float | None = None

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Comparison:
        """Rebuild a comparison from its fields as plain JSON; raises TypeError and KeyError for what is none."""
        error, gradient = record["loss_error"], record["gradient"]
        return cls(
            LossError(**{name: Bootstrap.of_record(error[name]) for name in LossError.__dataclass_fields__}),
            Bootstrap.of_record(record["spearman"]),
            GradientError(**{name: Bootstrap.of_record(gradient[name]) for name in GradientError.__dataclass_fields__}),
            optional(number, record["diverged"]),
            record["compared"],
            Seconds(number(record["seconds"]["forward"]), number(record["seconds"]["with_gradient"])),
            record["batch"],
            optional(number, record.get("missing")),
        )

    def p95(self, *, relative: bool) -> float | None:
        """Return the 95th percentile of loss errors, as a share of the spread or in the loss's unit."""
        return (self.loss_error.p95_relative if relative else self.loss_error.p95).value


def compare(variant: Sample, reference: Sample, *, seed: int) -> Comparison:
    """Hold a variant against the reference.

    The 95th percentile is the next larger error of the sample, not interpolated. Gradients are per width of the box;
    they are equal where both are exactly zero, and where one is, their cosine is 0 and they are infinitely far off.
    """
    known = has_loss(reference.status)
    fine = known & has_loss(variant.status)
    wanted = fine & (reference.status == Status.OK)
    sloped = wanted & (variant.status == Status.OK)
    error = np.where(has_loss(variant.status), np.abs(variant.loss - reference.loss), np.inf)[known]
    cosine, off = gradient_error(variant.grad[sloped], reference.grad[sloped])
    scale = spread(reference)
    median, p95 = (Bootstrap.of(of, error, seed=seed) for of in (median_of, p95_of))
    return Comparison(
        LossError(median, p95, median.share(scale), p95.share(scale)),
        Bootstrap.of(spearman, variant.loss[fine], reference.loss[fine], seed=seed),
        GradientError(Bootstrap.of(median_of, cosine, seed=seed), Bootstrap.of(median_of, off, seed=seed)),
        float(1 - fine.sum() / known.sum()) if known.any() else None,
        int(known.sum()),
        Seconds(variant.forward, variant.with_gradient),
        variant.batch,
        float(1 - sloped.sum() / wanted.sum()) if wanted.any() else None,
    )


def spread(reference: Sample) -> float | None:
    """Return what errors are shares of: the 5th to 95th percentile of the reference's losses; None without one."""
    loss = reference.loss[has_loss(reference.status)]
    width = float(np.subtract(*np.percentile(loss, (95, 5)))) if loss.size else 0.0
    return width or None


def gradient_error(grad: Array, reference: Array) -> tuple[Array, Array]:
    """Return cosine and relative error of each gradient, shapes (point,); two that are exactly zero agree."""
    sizes = np.linalg.norm(grad, axis=-1), np.linalg.norm(reference, axis=-1)
    both = (sizes[0] == 0) & (sizes[1] == 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        units = [np.nan_to_num(g / size[:, None]) for g, size in zip((grad, reference), sizes, strict=True)]
        off = np.linalg.norm(grad - reference, axis=-1) / sizes[1]
    return np.where(both, 1.0, (units[0] * units[1]).sum(axis=-1)), np.where(both, 0.0, off)


def spearman(a: Array, b: Array) -> Array:
    """Return Spearman's rank correlation along the last axis, NaN where one side has a single value."""
    from scipy.stats import rankdata

    ranks = [rankdata(side, axis=-1) for side in (a, b)]
    ranks = [rank - rank.mean(axis=-1, keepdims=True) for rank in ranks]
    with np.errstate(invalid="ignore"):
        found: Array = (ranks[0] * ranks[1]).sum(-1) / np.sqrt((ranks[0] ** 2).sum(-1) * (ranks[1] ** 2).sum(-1))
    return found


def pareto_front(seconds: Sequence[float], error: Sequence[float]) -> list[int]:
    """Return the numbers of those that no other beats in both, by time; one that is not finite is beaten."""
    known = [k for k in range(len(seconds)) if np.isfinite(seconds[k]) and np.isfinite(error[k])]
    best, kept = np.inf, []
    for k in sorted(known, key=lambda k: (seconds[k], error[k])):
        if error[k] < best:
            best = error[k]
            kept.append(k)
    return kept


@dataclass(frozen=True)
class ConvergenceOrder:
    """Hold p of error ~ dt^p, fitted to some variants, with its standard error."""

    variants: tuple[str, ...]
    order: float
    standard_error: float


def convergence_order(
    dt: Sequence[float], error: Sequence[float], names: Sequence[str] = ()
) -> ConvergenceOrder | None:
    """Fit error ~ dt^p to variants of these names; return None below three errors that are positive and finite."""
    pairs = [(step, off) for step, off in zip(dt, error, strict=True) if np.isfinite(off) and off > 0]
    if len(pairs) < 3:
        return None
    fit = fit_line(*np.log(pairs).T)
    return ConvergenceOrder(tuple(names), fit.slope, fit.standard_error)


def cheapest(rows: Sequence[Mapping[str, Any]], tolerance: float, *, relative: bool) -> Mapping[str, Any] | None:
    """Return the variant that takes least time with gradient of those within a tolerance, as files have it.

    None where none is.
    """
    within = [row for row in rows if (off := p95(row, relative=relative)) is not None and off <= tolerance]
    return min(within, key=lambda row: float(row["seconds"]["with_gradient"]), default=None)


def p95(row: Mapping[str, Any], *, relative: bool) -> float | None:
    """Return the 95th percentile of a variant's loss errors, as files have it, as a share or in the loss's unit."""
    value: float | None = row["loss_error"]["p95_relative" if relative else "p95"]["value"]
    return value


def median_of(values: Array) -> Array:
    """Return the median along the last axis."""
    return np.asarray(np.median(values, axis=-1))


def p95_of(values: Array) -> Array:
    """Return the 95th percentile along the last axis: the next larger of the values, not interpolated."""
    return np.asarray(np.quantile(values, 0.95, axis=-1, method="higher"))
