"""Distributions of losses over a neighbourhood: how fidelities of a chaotic scene are compared.

Two samples of the same distribution differ, too: that is the noise, and no fidelity can be told from the reference by
less.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from ..plain import finite, number, optional, text
from ..statistics import CONFIDENCE
from .fidelity import Bootstrap

Array = NDArray[np.float64]
SHUFFLES = 199  # ways to divide two samples of the reference anew


@dataclass(frozen=True)
class Distance:
    """Hold how far two distributions are apart: `kolmogorov` in 0 to 1, `wasserstein` in spreads of the losses."""

    kolmogorov: Bootstrap
    wasserstein: Bootstrap

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Distance:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(Bootstrap.of_record(record["kolmogorov"]), Bootstrap.of_record(record["wasserstein"]))


@dataclass(frozen=True)
class ComparedDistribution:
    """Say how far the losses of a fidelity are from those of the reference, means over the neighbourhoods.

    `told` says by which of the two distances it can be told from the reference: they are beyond the 95th percentile of
    the noise.
    """

    name: str
    distance: Distance
    told: tuple[str, ...]

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> ComparedDistribution:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(text(record["name"]), Distance.of_record(record["distance"]), tuple(map(text, record["told"])))


@dataclass(frozen=True)
class Distributions:
    """Hold what fidelities say over neighbourhoods of so many `points`, of `radius` (a share of the box) each.

    `noise` is the distance of two samples of the reference; `noise_limit` what it stays below in 95 % of cases.
    """

    neighbourhoods: int
    points: int
    radius: float
    noise: Distance
    noise_limit: dict[str, float | None]
    compared: tuple[ComparedDistribution, ...]

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Distributions:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(
            record["neighbourhoods"],
            record["points"],
            number(record["radius"]),
            Distance.of_record(record["noise"]),
            {text(name): optional(number, value) for name, value in record["noise_limit"].items()},
            tuple(map(ComparedDistribution.of_record, record["compared"])),
        )

    def say(self) -> str:
        """Say which fidelities can be told from the reference."""
        told = [f"{one.name} (by {' and '.join(one.told)})" for one in self.compared if one.told]
        others = [one.name for one in self.compared if not one.told]
        said = [f"over {self.neighbourhoods} neighbourhoods of {self.points} points the losses of"]
        said += [", ".join(told), "are distributed otherwise than the reference's"] if told else []
        said += [*(["and those of"] if told else []), ", ".join(others), "are not told from it"] if others else []
        return " ".join(said)


def compare_distributions(
    reference: tuple[Array, Array], others: Mapping[str, Array], *, scale: float, radius: float, seed: int
) -> Distributions:
    """Compare losses over neighbourhoods, shape (neighbourhood, point), NaN where an episode failed.

    `reference` is two independent samples of the reference, `others` are losses at the points of the second: so what is
    the same as the reference is exactly as far from the first as the second is. Noise is what dividing both samples of
    the reference anew gives.
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

    Episodes that failed are left out; both distances are NaN where all did.
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
    return Distance(*(Bootstrap.of(_mean, column, seed=seed) for column in apart.T))


def _mean(values: Array) -> Array:
    return np.asarray(values.mean(axis=-1))
