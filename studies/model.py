"""The study `model`: the effect of each part of a scene's model.

Every part is changed, left out or added, at the same points as the full model and timed in turn with it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from ..envs.records import ModelPart
from ..landscapes.objective import failed, has_loss
from . import samples
from .samples import Bootstrap, Comparison, Sample, Seconds, Turns, compare, evaluate_points, interval_columns, spread
from .variants import Expected, StudyRecord, Variant, VariantStudy, part_name, samples_of

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from .samples import Follow
    from .variants import StudyOptions

NOISE_FACTOR = 2.0  # times the noise, above which a difference is the part's
SAME_ORDER = 0.99  # rank correlation from which on the order of losses counts as kept: that of a standard fidelity
FAILING_SHARE = 0.05  # of points, above which a model without the part fails where the full one does not
REPEATS = 3  # of the full model, which say how noisy it is
FULL, AGAIN, PART = "full", "full-again", "part"


class Effect(StrEnum):
    """The effect of a part on the landscape, in the words of its verdict."""

    NOTHING = "moves nothing beyond the noise"
    GRADIENTS = "changes gradients, not losses"
    LOSSES = "changes losses, not their order"
    ORDER = "changes the order"
    FAILURE = "fails where the full model does not"


class Price(StrEnum):
    """The effect of a changed part on the time of an episode."""

    SAVES = "saves time"
    NOTHING = "costs nothing measurable"
    COSTS = "takes longer"


@dataclass(frozen=True)
class Noise:
    """The full model compared with itself, with parameters moved by their last digit.

    `comparison` is over all repeats; `largest` is the largest difference of losses and `digit` the last digit of the
    largest loss [loss unit], `rounding` the relative precision of the engine. A model that is not deterministic, or
    chaotic, has much noise.
    """

    comparison: Comparison
    largest: float
    digit: float
    rounding: float

    @classmethod
    def of(cls, repeats: Sample, full: Sample, *, rounding: float, seed: int) -> Noise:
        """Compare repeats of the full model with it, point by point; failed ones are left out."""
        fine = has_loss(repeats.status) & has_loss(full.status)
        largest = np.abs(repeats.loss - full.loss)[fine].max(initial=0.0)
        digit = rounding * np.abs(full.loss)[fine].max(initial=0.0)
        return cls(compare(repeats, full, seed=seed), float(largest), float(digit), rounding)


@dataclass(frozen=True)
class MeasuredPart:
    """The effect of changing a part of the model; `change` describes the change, by which `options`.

    A `missing` part is one that the full model leaves out, and its options add. `moved` is the share of points whose
    loss changes beyond the noise. `cost` and `cost_forward` are the time of an episode with and without gradient,
    relative to the full model's, measured in turn with it.
    """

    name: str
    change: str
    options: dict[str, Any]
    missing: bool
    comparison: Comparison
    moved: float | None
    cost: Bootstrap
    cost_forward: Bootstrap
    effect: Effect
    price: Price

    @property
    def verdict(self) -> str:
        """The verdict on the part, in words."""
        return f"{self.effect}; {self.price}"


@dataclass(frozen=True, kw_only=True)
class ModelRecord(StudyRecord):
    """The parts of a scene's model at the same points, all compared with the full model at one fidelity.

    `spread` is the 5th to 95th percentile of the full model's losses [`loss_unit`], None where they are all equal.
    `failed` points are left out, because the full model fails there; `seconds` is the time of its episode.
    """

    kind: ClassVar[str] = "model"
    read_elsewhere: ClassVar[bool] = False

    fidelity: str
    spread: float | None
    failed: int
    seconds: Seconds
    noise: Noise
    parts: tuple[MeasuredPart, ...]

    @property
    def present(self) -> tuple[MeasuredPart, ...]:
        """The parts of the full model."""
        return tuple(part for part in self.parts if not part.missing)

    @property
    def missing(self) -> tuple[MeasuredPart, ...]:
        """The parts that it leaves out."""
        return tuple(part for part in self.parts if part.missing)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each part, those of the model first.

        Columns: `change`, `missing`; `median` and `p95` of the loss changes as shares of the spread, with the ends of
        the latter's 95 % interval; `moved`, the share of points beyond the noise; `spearman`, `cosine`,
        `relative_error`, `diverged`; `cost`, the time of an episode with gradient relative to the full model's, with
        the ends of its interval; `effect` and `price`, the verdict.
        """
        for part in (*self.present, *self.missing):
            yield {
                **{"name": part.name, "change": part.change, "missing": part.missing, "moved": part.moved},
                **part.comparison.columns(),
                **interval_columns("cost", part.cost),
                **{"effect": part.effect.value, "price": part.price.value},
            }

    def sentences(self) -> list[str]:
        """Return the verdict on each part."""
        return [f"{part.name}, {part.change}: {part.verdict}" for part in (*self.present, *self.missing)]


class ModelStudy(VariantStudy):
    """The full model, its repeats, and the model with each part changed."""

    kind = "model"
    what = "models"
    about_last = False
    advice = "plus compiling kernels; fewer --points or a cheaper --fidelity take less"

    def __init__(self, env: Environment, options: StudyOptions) -> None:
        if not env.model_parts:
            raise ValueError(f"{env.name} names no parts of its model; list them in its class as `model_parts`")
        super().__init__(env, options)
        self._parts = {part.name: part for part in env.model_parts}
        self._rounding = float(torch.finfo(getattr(torch, env.fidelity.precision)).eps)

    @cached_property
    def variants(self) -> list[Variant]:
        """The full model, the full model again, and the model with each part changed."""
        own = Variant.of(self.env)
        parts = [
            replace(own, name=part.name, changed=PART, options={**own.options, **part.options})
            for part in self.env.model_parts
        ]
        return [replace(own, name=FULL), replace(own, name=AGAIN), *parts]

    def part(self, variant: Variant) -> str:
        """Return the name of a variant's part of the checkpoint; another change of the same part has another name."""
        if variant.changed != PART:
            return variant.name
        return part_name("part", variant.name, dict(self._parts[variant.name].options))

    def _make(self, variant: Variant) -> Environment:
        """Make the model; raises ValueError where a changed part equals the full model, or the scene refuses it."""
        if variant.changed != PART:
            return self.env
        part = self._parts[variant.name]
        env = self.env.remake(**part.options)
        if env.options == self.env.options:
            raise ValueError(f"the full model already has the options of {part.change!r}")
        return env

    def measure(self, variant: Variant, follow: Follow) -> Mapping[str, Any]:
        """Return the arrays of a model's sample, and for a changed part the times in turn with the full model."""
        if variant.changed != PART:
            x = self._moved() if variant.name == AGAIN else self.x
            return evaluate_points(self.env, x, follow, by=self.evaluates(variant)).arrays()
        env = self._make(variant)
        sample = evaluate_points(env, self.x, follow)
        for one in (self.env, env):
            self._make_room(one)
            one.prepare()
        turns = samples.take_turns(self.env, env, self.x)
        return {**sample.arrays(), "batch": turns.batch, "full_seconds": turns.first, "part_seconds": turns.second}

    def _moved(self) -> torch.Tensor:
        """Return the points repeatedly, each moved within its last digit, so that rounding differs."""
        generator, box = torch.Generator().manual_seed(self.seed), self.env.space
        x = self.x.repeat(REPEATS, 1)
        moves = 2 * torch.rand(x.shape, generator=generator, dtype=torch.float64) - 1
        return torch.clamp(x + moves * self._rounding * (box.upper - box.lower), box.lower, box.upper)

    def _make_room(self, env: Environment) -> None:
        """Limit an environment's rows to the timed ones: two share a GPU, and a solver takes all its memory."""
        if env.device == "cuda" and env.preferred_batch > self._timed_rows:
            env.shrink(self._timed_rows)

    @cached_property
    def _timed_rows(self) -> int:
        return max(1, min(len(self.x), self.env.preferred_batch // 2))

    def _expect(self, variant: Variant, env: Environment) -> Expected:
        if variant.changed != PART:
            return Expected(variant.name, env, len(self.x) * (REPEATS if variant.name == AGAIN else 1))
        timed = 4 * (samples.MIN_ROUNDS + 2) * max(1, self.env.threads)  # both models, both ways
        return Expected(variant.name, env, len(self.x) + timed, lambda each: samples.MIN_SECONDS)

    def run(self, watch: Watch, provenance: Mapping[str, Any], command: str) -> ModelRecord:
        """Measure the missing parts and return the record. Raises ValueError where the full model cannot be run."""
        arrays = self.measure_all(watch)
        if AGAIN not in arrays:
            raise ValueError(f"{self.env.name} cannot be repeated: {self.refused[AGAIN]}")
        found = samples_of(arrays)
        full = replace(found[FULL], forward=0.0, with_gradient=0.0)
        turns = {
            name: Turns(one["full_seconds"], one["part_seconds"], int(one["batch"]))
            for name, one in arrays.items()
            if name in self._parts
        }
        times = [one.first.min(axis=1) for one in turns.values()]
        whole = reduce(Sample.join, [full] * REPEATS)
        again = replace(found[AGAIN], forward=0.0, with_gradient=0.0)
        noise = Noise.of(again, whole, rounding=self._rounding, seed=self.seed)
        return ModelRecord(
            **self.about(provenance, command),
            fidelity=self.env.fidelity.name,
            spread=spread(full),
            failed=int(failed(full.status).sum()),
            seconds=Seconds(*(min((float(one[way]) for one in times), default=0.0) for way in (0, 1))),
            noise=noise,
            parts=tuple(self._judge(self._parts[name], found[name], one, full, noise) for name, one in turns.items()),
        )

    def _judge(self, part: ModelPart, sample: Sample, turns: Turns, full: Sample, noise: Noise) -> MeasuredPart:
        forward, with_gradient = map(float, turns.second.min(axis=1))
        sample = replace(sample, forward=forward, with_gradient=with_gradient, batch=turns.batch)
        found, moved = compare(sample, full, seed=self.seed), share_moved(sample, full, noise)
        cost = turns.ratio(grad=True, seed=self.seed)
        return MeasuredPart(
            name=part.name,
            change=part.change,
            options=dict(part.options),
            missing=part.missing,
            comparison=found,
            moved=moved,
            cost=cost,
            cost_forward=turns.ratio(grad=False, seed=self.seed),
            effect=judge_effect(found, noise, moved),
            price=judge_price(cost),
        )


def share_moved(part: Sample, full: Sample, noise: Noise) -> float | None:
    """Return the share of points whose loss changes by more than twice the largest noise; None without points."""
    fine = has_loss(part.status) & has_loss(full.status)
    limit = NOISE_FACTOR * max(noise.largest, noise.digit)
    return float((np.abs(part.loss - full.loss)[fine] > limit).mean()) if fine.any() else None


def judge_effect(found: Comparison, noise: Noise, moved: float | None) -> Effect:
    """Return the effect of a part, by fixed rules.

    It fails where more than one point in twenty fails. It changes losses where one of them changes by more than twice
    the largest noise, or their median or 95th percentile by more than twice that of the noise. It changes their order
    where the rank correlation is below 0.99 and below the interval of the noise's own. It changes gradients where their
    median relative error is more than twice the noise's, or where more than one point in twenty has lost its own.
    """
    if found.diverged is None or round(found.diverged, 9) > FAILING_SHARE:
        return Effect.FAILURE
    own = noise.comparison
    errors = [(found.loss_error.median, own.loss_error.median), (found.loss_error.p95, own.loss_error.p95)]
    if not moved and not any(_exceeds(one, other, noise.digit) for one, other in errors):
        changes = found.gradient.relative_error, own.gradient.relative_error
        if round(found.missing or 0.0, 9) > FAILING_SHARE:
            return Effect.GRADIENTS
        return Effect.GRADIENTS if _exceeds(*changes, noise.rounding) else Effect.NOTHING
    rank, low = found.spearman.value, own.spearman.low
    kept = SAME_ORDER if low is None else min(SAME_ORDER, low)
    return Effect.ORDER if rank is not None and rank < kept else Effect.LOSSES


def _exceeds(found: Bootstrap, noise: Bootstrap, least: float) -> bool:
    return _size(found) > NOISE_FACTOR * max(_size(noise), least)


def _size(found: Bootstrap) -> float:
    return np.inf if found.value is None else found.value


def judge_price(cost: Bootstrap) -> Price:
    """Return whether the interval of a ratio of times excludes 1."""
    if cost.high is not None and cost.high < 1:
        return Price.SAVES
    return Price.COSTS if cost.low is not None and cost.low > 1 else Price.NOTHING
