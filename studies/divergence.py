"""Divergence of neighbours: how fast similar motions separate, whether that is chaos, and how to compare then.

A chaotic motion has no reference to which others converge point by point: every error, of a step or of a digit, grows
until it is as large as the motion itself. Its fidelities are compared by the distributions of their losses over
neighbourhoods. Two samples of the same distribution differ, too. That is the noise, and a smaller difference does not
distinguish a fidelity from the reference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..landscapes.objective import evaluate
from ..landscapes.plain import finite
from ..landscapes.statistics import CONFIDENCE, fit_line, mean
from .samples import Bootstrap

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from ..landscapes.storage.checkpoint import Checkpoint
    from .variants import Variant

Array = NDArray[np.float64]
# A point is chaotic where neighbours part so fast that a small difference would grow a thousandfold over an episode:
# that undoes ten halvings of the step of a first-order scheme (2^10 = 1024).
CHAOTIC_FACTOR = 1000.0
SATURATION = 0.1  # of a motion's extent: from there on a distance cannot grow as it did
MIN_INSTANTS = 5  # that a rate is fitted to
LARGE_RESPONSE = 0.1  # of the losses' spread: a difference of losses as large as that is no longer small
SHUFFLES = 199  # ways to divide two samples of the reference again
FOLLOWED_POINTS, NEIGHBOURS = 8, 2  # points whose motion is followed, and neighbours of each
DISTANCE = 1e-8  # at which a neighbour begins, as a share of the box
SIZES = (1e-9, 1e-7, 1e-5, 1e-3)  # of perturbations whose losses are compared
PLACES, AROUND, RADIUS = 8, 64, 0.02  # neighbourhoods, points of each, how far they reach as a share of the box


@dataclass(frozen=True)
class DivergenceRate:
    """The growth of a distance: `rate` [1/s], over `duration` [s]."""

    rate: float
    duration: float

    @property
    def chaotic(self) -> bool:
        """Whether a small difference would grow a thousandfold over the whole duration at that rate."""
        return bool(self.rate * self.duration >= math.log(CHAOTIC_FACTOR))


def fit_rate(time: Array, distance: Array, *, extent: float) -> DivergenceRate:
    """Fit log distance ~ rate x time, over the second half of the time in which a distance can grow.

    The first half is left out because powers of time grow quickly at first, which is not chaos: a distance like t^n
    grows by a factor of 2^n in the second half. Growth ends where the distance is a tenth of the `extent` of the
    motion. A rate is NaN where fewer than five instants remain.
    """
    known = np.flatnonzero(distance > 0)
    whole = float(time[-1] - time[0])
    if not known.size:
        return DivergenceRate(0.0, whole)
    large = np.flatnonzero(distance >= SATURATION * extent)
    end = int(large[0]) if large.size else len(time) - 1
    middle = (time[known[0]] + time[end]) / 2
    chosen = [k for k in known if middle <= time[k] <= time[end]]
    if len(chosen) < MIN_INSTANTS:
        return DivergenceRate(math.nan, whole)
    return DivergenceRate(fit_line(time[chosen], np.log(distance[chosen])).slope, whole)


@dataclass(frozen=True)
class Response:
    """The median change of losses by a perturbation of a `size`, as a share of the box, in spreads."""

    size: float
    loss: float | None


@dataclass(frozen=True)
class Divergence:
    """The divergence of neighbours in a scene.

    `rate` [1/s] is the mean over `points` with Student's interval, `chaotic` the number of chaotic points; `size` is
    the perturbation, as a share of the box. `responses` are those of losses. `saturates_at` is the smallest size that
    moves them by a tenth of their spread, None where none does.
    """

    points: int
    chaotic: int
    size: float
    rate: Bootstrap
    rates: tuple[float | None, ...]
    responses: tuple[Response, ...]
    saturates_at: float | None

    @classmethod
    def of(cls, found: Sequence[DivergenceRate], responses: Sequence[Response], *, size: float) -> Divergence:
        """Summarise the points."""
        rates = np.array([one.rate for one in found])
        whole = mean(rates)
        large = [one.size for one in responses if one.loss is None or one.loss >= LARGE_RESPONSE]
        return cls(
            len(found),
            sum(one.chaotic for one in found),
            size,
            Bootstrap(finite(whole.value), finite(whole.low), finite(whole.high)),
            tuple(finite(float(rate)) for rate in rates),
            tuple(responses),
            min(large, default=None),
        )

    def sentence(self) -> str:
        """Describe the divergence of neighbours."""
        moved = "no perturbation up to a thousandth of the box moves"
        if self.saturates_at is not None:
            moved = f"a perturbation of {self.saturates_at:g} of the box moves"
        return (
            f"neighbours diverge at {self.rate} 1/s; {self.chaotic} of {self.points} points are chaotic; {moved} "
            "losses by a tenth of their spread"
        )

    @property
    def is_chaos(self) -> bool:
        """Whether at least half of the points are chaotic: then a scene is judged by distributions."""
        return self.points > 0 and 2 * self.chaotic >= self.points


@dataclass(frozen=True)
class Distance:
    """The distance of two distributions: `kolmogorov` in 0 to 1, `wasserstein` in spreads of the losses."""

    kolmogorov: Bootstrap
    wasserstein: Bootstrap


@dataclass(frozen=True)
class ComparedDistribution:
    """The distance of a fidelity's losses from those of the reference, means over the neighbourhoods.

    `told` names the distances that distinguish it from the reference, those above the 95th percentile of the noise.
    """

    name: str
    distance: Distance
    told: tuple[str, ...]


@dataclass(frozen=True)
class Distributions:
    """The losses of fidelities over neighbourhoods of `points`, each of `radius` (a share of the box).

    `noise` is the distance of two samples of the reference; `noise_limit` is its 95th percentile.
    """

    neighbourhoods: int
    points: int
    radius: float
    noise: Distance
    noise_limit: dict[str, float | None]
    compared: tuple[ComparedDistribution, ...]

    def sentence(self) -> str:
        """Name the fidelities that are distinguishable from the reference."""
        told = [f"{one.name} (by {' and '.join(one.told)})" for one in self.compared if one.told]
        others = [one.name for one in self.compared if not one.told]
        said = [f"over {self.neighbourhoods} neighbourhoods of {self.points} points the losses of"]
        said += [", ".join(told), "have another distribution than the reference's"] if told else []
        said += (
            [*(["and those of"] if told else []), ", ".join(others), "are not distinguishable from the reference's"]
            if others
            else []
        )
        return " ".join(said)


def compare_distributions(
    reference: tuple[Array, Array], others: Mapping[str, Array], *, scale: float, radius: float, seed: int
) -> Distributions:
    """Compare losses over neighbourhoods, shape (neighbourhood, point), NaN where an episode failed.

    `reference` is two independent samples of the reference, `others` are losses at the points of the second. So a
    variant equal to the reference is exactly as far from the first as the second is. Noise comes from dividing both
    samples of the reference again.
    """
    first, second = reference
    generator = np.random.default_rng(seed)
    shuffled = [_shuffle(first, second, generator) for _ in range(SHUFFLES)]
    noises = np.array([_distances(*pair, scale).mean(axis=0) for pair in shuffled])
    limit = np.quantile(noises, CONFIDENCE, axis=0)
    compared = []
    for name, losses in others.items():
        apart = _distances(first, losses, scale)
        beyond = apart.mean(axis=0) > limit
        told = tuple(what for what, far in zip(("kolmogorov", "wasserstein"), beyond, strict=True) if far)
        compared.append(ComparedDistribution(name, _sum_up(apart, seed), told))
    return Distributions(
        len(first),
        first.shape[1],
        radius,
        _sum_up(_distances(first, second, scale), seed),
        {"kolmogorov": finite(float(limit[0])), "wasserstein": finite(float(limit[1]))},
        tuple(compared),
    )


def distances(a: Array, b: Array, scale: float) -> Float[NDArray[np.float64], " distance"]:
    """Return Kolmogorov's distance of two samples and Wasserstein's, the latter in units of `scale`.

    Failed episodes are left out; both distances are NaN where all failed.
    """
    a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    if not (a.size and b.size):
        return np.full(2, np.nan)
    values = np.sort(np.concatenate([a, b]))
    shares = [np.searchsorted(np.sort(one), values, side="right") / len(one) for one in (a, b)]
    apart = np.abs(shares[0] - shares[1])
    return np.array([apart.max(), (apart[:-1] * np.diff(values)).sum() / scale])


def _distances(a: Array, b: Array, scale: float) -> Array:
    return np.array([distances(one, other, scale) for one, other in zip(a, b, strict=True)])


def _shuffle(a: Array, b: Array, generator: np.random.Generator) -> tuple[Array, Array]:
    both = generator.permuted(np.concatenate([a, b], axis=1), axis=1)
    first, second = np.split(both, [a.shape[1]], axis=1)
    return first, second


def _sum_up(apart: Array, seed: int) -> Distance:
    return Distance(*(Bootstrap.of(lambda values: values.mean(axis=-1), column, seed=seed) for column in apart.T))


RESPONSES = "responses"  # the part with the losses of neighbours


@dataclass(frozen=True)
class Neighbours:
    """The neighbours of the points `x` of a scene at its reference `env`, shape (point, dim); parts of a checkpoint.

    Losses are in units of their `spread`.
    """

    env: Environment
    x: Tensor
    seed: int
    checkpoint: Checkpoint
    spread: float

    def count_left(self) -> float:
        """Return the remaining cost of simulating neighbours, in episodes with gradients; 0 where that is done."""
        if self.checkpoint.load(RESPONSES) is not None:
            return 0.0
        alone = self.env.threads * (1 + NEIGHBOURS) * len(self.x[:FOLLOWED_POINTS])
        return alone + (1 + len(SIZES)) * len(self.x) / 2  # a loss takes about half of a gradient

    def measure_divergence(self, watch: Watch) -> Divergence | None:
        """Simulate neighbours at some points, and return how they diverge; None where a scene shows no motion."""
        some, rates = self.x[:FOLLOWED_POINTS], list[DivergenceRate]()
        try:
            with watch.progress(len(some), "points with neighbours") as advance:
                for number in range(len(some)):
                    advance(number)
                    rates.append(self._follow(number))
                advance(len(some))
        except ValueError:  # no episode to draw: no motion
            return None
        with watch.busy(f"{self.env.name}: losses of neighbours"):
            return Divergence.of(rates, self._responses(), size=DISTANCE)

    def measure_distributions(self, variants: Sequence[Variant], watch: Watch) -> Distributions:
        """Compare the losses of variants over neighbourhoods with those of the reference."""
        first, second = (self._around(seed) for seed in (1, 2))
        losses: dict[str, Array] = {}
        with watch.progress(2 + len(variants), "fidelities over neighbourhoods") as advance:
            pair = [self._losses(f"around-{name}", self.env, x) for name, x in (("first", first), ("second", second))]
            for number, variant in enumerate(variants):
                advance(2 + number, variant.name)
                losses[variant.name] = self._losses(f"around-{variant.name}", variant.make(self.env), second)
            advance(2 + len(variants))
        shape = (-1, AROUND)
        return compare_distributions(
            (pair[0].reshape(shape), pair[1].reshape(shape)),
            {name: one.reshape(shape) for name, one in losses.items()},
            scale=self.spread,
            radius=RADIUS,
            seed=self.seed,
        )

    def _follow(self, number: int) -> DivergenceRate:
        """Return the divergence of a point's neighbours: the growth of the root mean square distance of all points.

        Only the first decision is perturbed, so that later growth is the motion's. The distances of several neighbours
        are combined by their geometric mean.
        """
        arrays = self.checkpoint.load_or_compute(f"divergence-{number}", lambda: self._part(self.x[number], number))
        with np.errstate(divide="ignore"):
            distance = np.exp(np.log(arrays["distance"]).mean(axis=0))
        return fit_rate(arrays["time"], distance, extent=float(arrays["extent"]))

    def _part(self, x: Float[Tensor, " dim"], number: int) -> dict[str, Array]:
        count = self.env.space.dim // self.env.decisions
        times, base = _motion(self.env, x)
        distances = []
        for turn in _directions(NEIGHBOURS, count, seed=self.seed + number):
            near = x.clone()
            near[:count] += DISTANCE * turn * (self.env.space.upper - self.env.space.lower)[:count]
            distances.append(_rms(_motion(self.env, near)[1] - base))
        extent = _rms(base - base[:1]).max()
        return {"time": times, "distance": np.array(distances), "extent": np.array(extent)}

    def _responses(self) -> list[Response]:
        """Return the changes of losses for perturbations of each size, in one batch of all points."""
        space = self.env.space
        turns = _directions(len(self.x), space.dim, seed=self.seed)
        every = torch.cat([self.x, *(self.x + size * turns * (space.upper - space.lower) for size in SIZES)])
        losses = self._losses(RESPONSES, self.env, torch.clamp(every, space.lower, space.upper))
        base, *others = losses.reshape(1 + len(SIZES), -1)
        found = []
        for size, loss in zip(SIZES, others, strict=True):
            moved = np.abs(loss - base)[np.isfinite(base)]
            median = float(np.median(np.nan_to_num(moved, nan=np.inf))) if moved.size else np.inf
            found.append(Response(size, median / self.spread if np.isfinite(median) else None))
        return found

    def _around(self, seed: int) -> Float[Tensor, "point dim"]:
        """Return the points of all neighbourhoods, one after the other."""
        space, places = self.env.space, self.x[:PLACES]
        shift = 2 * torch.rand(len(places) * AROUND, space.dim, dtype=torch.float64, generator=_generator(seed)) - 1
        x = places.repeat_interleave(AROUND, dim=0) + RADIUS * shift * (space.upper - space.lower)
        return torch.clamp(x, space.lower, space.upper)

    def _losses(self, name: str, env: Environment, x: Float[Tensor, "point dim"]) -> Array:
        def compute() -> dict[str, Array]:
            parts = [evaluate(env, part, grad=False).loss for part in torch.split(x, env.preferred_batch)]
            return {"loss": torch.cat(parts).numpy()}

        return self.checkpoint.load_or_compute(name, compute)["loss"]


def _motion(env: Environment, x: Float[Tensor, " dim"]) -> tuple[Array, Array]:
    """Return the times of an episode [s] and the positions of all bodies' points [m], shape (frame, point, axis)."""
    episode = env.episode(x)
    places = torch.cat([episode.points[name].double() for name in sorted(episode.points)], dim=1)
    return episode.time.double().numpy(), places.numpy()


def _rms(shift: Array) -> Array:
    """Return the root mean square over points of their distances, shape (frame,)."""
    return np.asarray(np.sqrt((shift**2).sum(axis=-1).mean(axis=-1)))


def _directions(count: int, dim: int, *, seed: int) -> Float[Tensor, "count dim"]:
    turns = torch.randn(count, dim, dtype=torch.float64, generator=_generator(seed))
    unit: Tensor = turns / turns.norm(dim=1, keepdim=True)
    return unit


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
