"""What happens near the points of a study: neighbours that part, and the losses of neighbourhoods."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import torch

from ..landscapes.objective import evaluate
from .watch import Watch

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.measures.distributions import Distributions
    from ..landscapes.measures.divergence import Divergence, Growth, Response
    from ..landscapes.measures.self_convergence import Values
    from ..landscapes.storage.checkpoint import Checkpoint
    from .variants import Variant

MOTIONS = 8  # points whose motion is followed
PARTNERS = 2  # neighbours of each
SMALL = 1e-8  # how far a neighbour begins, as a share of the box
SIZES = (1e-9, 1e-7, 1e-5, 1e-3)  # of perturbations whose losses are compared
PLACES, AROUND, RADIUS = 8, 64, 0.02  # neighbourhoods, points of each, how far they reach as a share of the box


@dataclass(frozen=True)
class Neighbours:
    """The neighbours of the points `x` of a scene at its reference `env`, shape (point, dim); pieces on disk.

    `spread` is what losses are told in; `compared` says which variants distributions are compared of.
    """

    env: Environment
    x: Tensor
    seed: int
    pieces: Checkpoint
    spread: float
    compared: Callable[[], Sequence[Variant]]

    def measure_divergence(self, watch: Watch) -> Divergence | None:
        """Follow neighbours at some points, and say how they part; None where a scene shows no motion."""
        from ..landscapes.measures.divergence import Divergence

        growths: list[Growth] = []
        some = self.x[:MOTIONS]
        try:
            with watch.progress(len(some), "points whose neighbours are followed") as advance:
                for number in range(len(some)):
                    advance(number)
                    growths.append(self._follow(number))
                advance(len(some))
        except ValueError:  # no episode to draw: no motion
            return None
        return Divergence.of(growths, self._responses(watch), size=SMALL)

    def measure_distributions(self, watch: Watch) -> Distributions:
        """Compare the losses of fidelities over neighbourhoods with those of the reference."""
        from ..landscapes.measures.distributions import compare_distributions

        first, second = (self._around(seed) for seed in (1, 2))
        variants = self.compared()
        losses: dict[str, NDArray[np.float64]] = {}
        with watch.progress(2 + len(variants), "fidelities over neighbourhoods") as advance:
            pair = tuple(
                self._losses(f"around-{name}", self.env, x) for name, x in (("first", first), ("second", second))
            )
            for number, variant in enumerate(variants):
                advance(2 + number, variant.name)
                env = variant.make(self.env)
                losses[variant.name] = self._losses(f"around-{variant.name}", env, second)
            advance(2 + len(variants))
        shape = (-1, AROUND)
        return compare_distributions(
            (pair[0].reshape(shape), pair[1].reshape(shape)),
            {name: one.reshape(shape) for name, one in losses.items()},
            scale=self.spread,
            radius=RADIUS,
            seed=self.seed,
        )

    def _follow(self, number: int) -> Growth:
        """Return how neighbours of a point part: the growth of the distance between their points, a root mean square.

        Only the first decision is perturbed, so that what grows later is the motion's. The distances of several
        neighbours are put together as their geometric mean.
        """
        from ..landscapes.measures.divergence import measure_growth

        name = f"divergence-{number}"
        arrays = self.pieces.load(name)
        if arrays is None:
            arrays = self._part(self.x[number], number)
            self.pieces.save(name, **arrays)
        with np.errstate(divide="ignore"):
            distance = np.exp(np.log(arrays["distance"]).mean(axis=0))
        return measure_growth(arrays["time"], distance, extent=float(arrays["extent"]))

    def _part(self, x: Float[Tensor, " dim"], number: int) -> dict[str, NDArray[np.float64]]:
        count = self.env.space.dim // self.env.decisions
        times, base = _motion(self.env, x)
        distances = []
        for turn in _directions(PARTNERS, count, seed=self.seed + number):
            near = x.clone()
            near[:count] += SMALL * turn * (self.env.space.upper - self.env.space.lower)[:count]
            distances.append(_rms(_motion(self.env, near)[1] - base))
        extent = _rms(base - base[:1]).max()
        return {"time": times, "distance": np.array(distances), "extent": np.array(extent)}

    def _responses(self, watch: Watch) -> list[Response]:
        """Return how far losses move for perturbations of each size, in one batch of all points."""
        from ..landscapes.measures.divergence import Response

        space = self.env.space
        turns = _directions(len(self.x), space.dim, seed=self.seed)
        found = []
        with watch.busy(f"{self.env.name}: losses of neighbours"):
            every = torch.cat([self.x, *(self.x + size * turns * (space.upper - space.lower) for size in SIZES)])
            losses = self._losses("responses", self.env, torch.clamp(every, space.lower, space.upper))
        base, *others = losses.reshape(1 + len(SIZES), -1)
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

    def _losses(self, name: str, env: Environment, x: Float[Tensor, "point dim"]) -> NDArray[np.float64]:
        arrays = self.pieces.load(name)
        if arrays is None:
            parts = [evaluate(env, part, grad=False).loss for part in torch.split(x, env.preferred_batch)]
            arrays = {"loss": torch.cat(parts).numpy()}
            self.pieces.save(name, **arrays)
        return arrays["loss"]


def evaluate_points(env: Environment, x: Float[Tensor, "point dim"], follow: Callable[[int], None]) -> Values:
    """Evaluate losses and gradients at points in the batches that a scene prefers; `follow` hears how many are done."""
    from ..landscapes.measures.self_convergence import Values

    env.prepare()
    losses, slopes, seconds, done = [], [], [], 0
    for part in torch.split(x, env.preferred_batch):
        began = time.perf_counter()
        found = evaluate(env, part, grad=True)
        seconds.append((time.perf_counter() - began) / len(part))
        losses.append(found.loss)
        slopes.append(cast("Tensor", found.grad))
        follow(done := done + len(part))
    widths = env.space.upper - env.space.lower
    return Values(torch.cat(losses).numpy(), (torch.cat(slopes) * widths).numpy(), min(seconds))


def _motion(env: Environment, x: Float[Tensor, " dim"]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the times of an episode [s] and the places of all its bodies' points [m], shape (frame, point, axis)."""
    episode = env.episode(x)
    places = torch.cat([episode.points[name].double() for name in sorted(episode.points)], dim=1)
    return episode.time.double().numpy(), places.numpy()


def _rms(shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the root mean square over points of their distances, shape (frame,)."""
    return np.asarray(np.sqrt((shift**2).sum(axis=-1).mean(axis=-1)))


def _directions(count: int, dim: int, *, seed: int) -> Float[Tensor, "count dim"]:
    turns = torch.randn(count, dim, dtype=torch.float64, generator=_generator(seed))
    unit: Tensor = turns / turns.norm(dim=1, keepdim=True)
    return unit


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
