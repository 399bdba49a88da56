"""A study of a model's parts, made of samples whose differences are known."""

from collections.abc import Mapping

import numpy as np

from gradscape.landscapes.measures.fidelity import Bootstrap, Sample, Seconds, compare, spread
from gradscape.landscapes.measures.model import (
    MeasuredPart,
    ModelStudy,
    Noise,
    judge_effect,
    judge_price,
    share_moved,
)
from gradscape.landscapes.measures.tradeoff import RefusedVariant
from gradscape.landscapes.objective import Status

POINTS = 40


def sample(loss: np.ndarray, *, failed: int = 0, slope: float = 1.0) -> Sample:
    """Return a sample whose last points `failed` and whose gradients have a slope."""
    status, loss = np.full(len(loss), Status.OK, dtype=np.int8), loss.astype(float).copy()
    if failed:
        status[-failed:], loss[-failed:] = Status.NONFINITE, np.nan
    return Sample(loss, np.full((len(loss), 2), slope), status, 0.1, 0.3, 4)


def full() -> Sample:
    """Return losses of 0 to 39 in some order."""
    return sample(np.random.default_rng(0).permutation(POINTS).astype(float))


def noise(size: float) -> Noise:
    """Return noise that moves every loss by so much, every other one down."""
    moved = full().loss + size * (-1.0) ** np.arange(POINTS)
    return Noise.of(sample(moved), full(), rounding=1e-7, seed=0)


def part(
    name: str, changed: Sample, cost: tuple[float, float, float], *, missing: bool = False, noisy: float = 1e-3
) -> MeasuredPart:
    """Return a part that changes the full model to a sample, at a ratio of times with its interval."""
    found, own = compare(changed, full(), seed=0), noise(noisy)
    moved, ratio = share_moved(changed, full(), own), Bootstrap(*cost)
    effect = judge_effect(found, own, moved)
    options, change = {name: False}, f"no {name}"
    return MeasuredPart(name, change, options, missing, found, moved, ratio, ratio, effect, judge_price(ratio))


def study(changes: Mapping[str, float], *, failing: bool = False) -> ModelStudy:
    """Return a study of parts that move every loss by so much, the last of which is missing from the model."""
    parts = [
        part(
            name, sample(full().loss + size), (1 - at / 20, 0.98 - at / 20, 1.02 - at / 20), missing=at == len(changes)
        )
        for at, (name, size) in enumerate(changes.items(), start=1)
    ]
    if failing:
        parts.append(part("glass", sample(full().loss, failed=10), (1.0, 0.9, 1.1)))
    return ModelStudy(
        env="fluid",
        fidelity="draft",
        points=POINTS,
        seed=0,
        loss_unit="J",
        spread=spread(full()),
        failed=0,
        seconds=Seconds(0.1, 0.3),
        noise=noise(1e-3),
        parts=tuple(parts),
        refused=(RefusedVariant("tank", "fluid needs its tank"),),
        identity={"device": "cuda", "options": {}},
        provenance={"created": "2026-01-01"},
        command="landscape tradeoff fluid --ladder model",
    )
