"""The study `updates`: the distribution of losses after many single updates along the gradient.

Rahn et al. 2023, "Policy optimization in a noisy neighborhood", examine returns after one update by random batches.
Here an update follows the gradient at a randomly moved point, which needs nothing but gradients, and each is compared
with a random step of the same length. Both are our choice. So is the zero of returns: the loss at the centre of the
box, where a policy has zero weights and does nothing, or 0 for a function that is maximised.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..landscapes.objective import Evaluation, evaluate
from ..landscapes.statistics import UNKNOWN, Estimate, mean, share
from .samples import Follow, evaluate_parts, interval_columns
from .variants import Expected, Study, StudyRecord, read_positive

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from .variants import StudyOptions

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
BINS, DROP = 100, 0.5  # of the histogram whose fullest bin is the mode, and the share of it that ends the left tail
NOISE, LENGTH = 0.01, 0.01  # of the box: how far points are moved, and how long updates are at the median, by default
ALONG, RANDOM = "along the gradient", "random steps as long"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outcomes:
    """The losses after steps of one kind, NaN where a simulation failed.

    `quantiles` are at 5, 25, 50, 75 and 95 %, where a failure counts as the largest loss; `mean` is without failures.
    `worse` is the share of steps after which the loss is larger than before. `tail` is the left-tail probability that a
    return is below half the mode of returns, that is, a loss above `tail_from`. Failures count as both. Where the mode
    is no gain, both are NaN.
    """

    name: str
    losses: tuple[float, ...]
    failed: int
    quantiles: tuple[float, ...]
    mean: Estimate
    worse: Estimate
    tail: Estimate
    tail_from: float

    @classmethod
    def of(cls, name: str, losses: Array, *, before: float, zero: float) -> Outcomes:
        """Return the outcomes of steps, from the loss `before` them, and the loss with return `zero`."""
        known, all_of = losses[np.isfinite(losses)], np.where(np.isfinite(losses), losses, np.inf)
        mode = mode_of(zero - known) if len(known) else math.nan
        tail_from = zero - DROP * mode if mode > 0 else math.nan
        return cls(
            name=name,
            losses=tuple(losses.tolist()),
            failed=len(losses) - len(known),
            quantiles=tuple(np.quantile(all_of, QUANTILES, method="inverted_cdf").tolist()),
            mean=mean(known),
            worse=share(int((all_of > before).sum()), len(losses)),
            tail=share(int((all_of > tail_from).sum()), len(losses)) if mode > 0 else UNKNOWN,
            tail_from=tail_from,
        )


def mode_of(values: Array) -> float:
    """Return the middle of the fullest of a hundred bins, as in the source's code."""
    if values.min() == values.max():
        return float(values[0])
    counts, edges = np.histogram(values, BINS)
    at = int(counts.argmax())
    return float(edges[at] + edges[at + 1]) / 2


@dataclass(frozen=True, kw_only=True)
class UpdatesRecord(StudyRecord):
    """The losses after single updates from a point, and after random steps of the same length.

    The point, `through`, has the loss `before`. An update is `rate` times the gradient at a point moved by `noise` of
    each width of the box, with the median `length` [widths of the box]. Returns are `zero`, the loss at the centre of
    the box, minus the loss. `lower` is the share of pairs in which the update ends lower than the random step. For
    `unknown` updates the gradient failed, and `clamped` were cut off at the bounds.
    """

    kind: ClassVar[str] = "updates"
    read_elsewhere: ClassVar[bool] = False

    fidelity: str
    through: str
    before: float
    noise: float
    rate: float
    length: float
    zero: float
    along: Outcomes
    random: Outcomes
    lower: Estimate
    unknown: int
    clamped: int

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row for updates along the gradient and one for random steps.

        Columns: `mean`, `worse` and `tail` with the ends of their 95 % intervals; `q5` to `q95`; `failed`.
        """
        for one in (self.along, self.random):
            quantiles = {f"q{100 * q:.0f}": value for q, value in zip(QUANTILES, one.quantiles, strict=True)}
            intervals = [interval_columns(name, getattr(one, name)) for name in ("mean", "worse", "tail")]
            yield {"name": one.name, **intervals[0], **quantiles, **intervals[1], **intervals[2], "failed": one.failed}

    def sentences(self) -> list[str]:
        """Return the results of an update and of a random step, and which ends lower."""
        said = [
            f"before an update the loss is {self.before:.4g}; after it, {self.along.quantiles[2]:.4g} at the median "
            f"({self.along.quantiles[0]:.4g} to {self.along.quantiles[-1]:.4g} in nine of ten)",
            f"worse than before: {_percent(self.along.worse)} of updates, {_percent(self.random.worse)} of random "
            "steps of the same length",
            f"left-tail probability: {_percent(self.along.tail)}, of random steps {_percent(self.random.tail)}"
            if self.along.tail.value >= 0
            else "left-tail probability: unknown, because most updates do not end below the centre of the box",
            f"an update ends lower than a random step in {_percent(self.lower)} of pairs",
        ]
        if self.unknown:
            said.append(f"{self.unknown} of {self.points} updates are unknown, because they have no gradient")
        if self.clamped:
            said.append(f"{self.clamped} updates were cut off at the bounds")
        return said


class UpdatesStudy(Study):
    """Updates from a point: gradients at randomly moved points, then the losses after the updates."""

    kind = "updates"
    takes = ("through", "noise", "rate")
    what = "parts"
    default_points = 256
    about_last = False
    advice = "fewer --points take less"

    def __init__(self, env: Environment, options: StudyOptions) -> None:
        if not env.has_gradient:
            raise ValueError(
                f"{env.name} has no gradients to follow; estimate them from losses with --remedy smooth:1%:zeroth"
            )
        self.noise = read_positive("noise", options.noise, NOISE)
        self.rate = None if options.rate is None else read_positive("rate", options.rate, 1.0)
        self.through = options.through.name if options.through else "center"
        self.start = options.through.x if options.through else env.space.center
        super().__init__(env, options)

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers, as plain JSON."""
        own = {"point": self.start.tolist(), "noise": self.noise, "rate": self.rate}
        return {**super().identity(), **own}

    def run(self, watch: Watch, provenance: Mapping[str, Any], command: str) -> UpdatesRecord:
        """Measure the missing parts and return the record.

        Raises ValueError where the point itself fails, or no gradient near it is known.
        """
        count = len(self.x)
        with watch.progress(3 * count + 2) as advance:
            found = self.checkpoint.load_or_compute("gradients", lambda: self._gradients(advance))
            before = float(found["loss"][0])
            slope = torch.from_numpy(found["grad"][1:])
            known = slope.isfinite().all(dim=1)
            if not math.isfinite(before) or not bool(known.any()):
                raise ValueError(f"{self.env.name} has no loss or no gradient at {self.through}; choose another point")
            rate = self.rate or self._rate(slope[known])
            ends, clamped = self._clamp(self.start - rate * slope[known])
            steps = [ends, self._random_steps(ends), self.env.space.center[None]]
            after = self.checkpoint.load_or_compute(
                "losses", lambda: {"loss": self._losses(torch.cat(steps), lambda done: advance(count + 1 + done))}
            )["loss"]
        along, random, (center,) = np.split(after, [len(ends), 2 * len(ends)])
        zero = 0.0 if self.env.identity().get("maximize") else float(center)
        pairs = np.isfinite(along) | np.isfinite(random)
        return UpdatesRecord(
            **self.about(provenance, command),
            fidelity=self.env.fidelity.name,
            through=self.through,
            before=before,
            noise=self.noise,
            rate=rate,
            length=float(self._lengths(ends).median()),
            zero=zero,
            along=Outcomes.of(ALONG, along, before=before, zero=zero),
            random=Outcomes.of(RANDOM, random, before=before, zero=zero),
            lower=share(int((np.nan_to_num(along, nan=np.inf) < np.nan_to_num(random, nan=np.inf))[pairs].sum()),
                        int(pairs.sum())),
            unknown=count - len(ends),
            clamped=clamped,
        )  # fmt: skip

    def expected(self) -> Iterator[Expected]:
        """Yield the missing gradients, and losses after updates."""
        left = {"gradients": len(self.x) + 1, "losses": 2 * len(self.x) + 1}
        for name, episodes in left.items():
            if self.checkpoint.load(name) is None:
                yield Expected(name, self.env, episodes)

    def describe_left(self) -> str:
        """Describe the remaining measurements."""
        return f"{len(self.x)} updates, {len(list(self.expected()))} of 2 parts of them to measure"

    def _points(self, points: int) -> Tensor:
        """Move the point at random."""
        noise = torch.randn(points, self.env.space.dim, generator=self._generator(0), dtype=torch.float64)
        return self._clamp(self.start + self.noise * self._widths * noise)[0]

    @property
    def _widths(self) -> Float[Tensor, " dim"]:
        return self.env.space.upper - self.env.space.lower

    def _generator(self, number: int) -> torch.Generator:
        return torch.Generator().manual_seed(2 * self.seed + number)

    def _clamp(self, x: Float[Tensor, "step dim"]) -> tuple[Float[Tensor, "step dim"], int]:
        """Return points within the bounds, unless the environment is defined outside, and how many were outside."""
        if self.env.beyond_box:
            return x, 0
        inside = torch.clamp(x, self.env.space.lower, self.env.space.upper)
        return inside, int((inside != x).any(dim=1).sum())

    def _rate(self, slope: Float[Tensor, "step dim"]) -> float:
        """Return the rate at which updates have their default length; 1 where gradients are zero."""
        size = float((slope / self._widths).norm(dim=1).median())
        return LENGTH / size if size else 1.0

    def _lengths(self, ends: Float[Tensor, "step dim"]) -> Float[Tensor, " step"]:
        lengths: Tensor = ((ends - self.start) / self._widths).norm(dim=1)
        return lengths

    def _random_steps(self, ends: Float[Tensor, "step dim"]) -> Float[Tensor, "step dim"]:
        """Return the ends of steps in random directions with the length of the updates."""
        drawn = torch.randn(ends.shape, generator=self._generator(1), dtype=torch.float64)
        unit = drawn / drawn.norm(dim=1, keepdim=True)
        return self._clamp(self.start + self._lengths(ends)[:, None] * self._widths * unit)[0]

    def _gradients(self, follow: Follow) -> dict[str, Array]:
        """Return the loss at the point, the first, and losses and gradients at the moved points."""
        found, _ = evaluate_parts(self.env, torch.cat([self.start[None], self.x]), follow)
        assert found.grad is not None  # as it was asked for
        return {"loss": found.loss.numpy(), "grad": found.grad.numpy()}

    def _losses(self, x: Float[Tensor, "point dim"], follow: Follow) -> Array:
        parts = list[Evaluation]()
        for part in torch.split(x, self.env.preferred_batch):
            parts.append(evaluate(self.env, part, grad=False))
            follow(sum(len(one.loss) for one in parts))
        losses: Array = torch.cat([one.loss for one in parts]).numpy()
        return losses


def _percent(found: Estimate) -> str:
    """Return a share in per cent, with its interval."""
    value, low, high = (f"{100 * end:.3g}" for end in (found.value, found.low, found.high))
    return f"{value} % ({low} to {high} %)"
