"""Records of studies, made of samples whose differences are known."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from gradscape.envs.records import Fidelity
from gradscape.landscapes.objective import Status
from gradscape.studies.fidelity import FidelityRecord, MeasuredVariant
from gradscape.studies.model import (
    MeasuredPart,
    ModelRecord,
    Noise,
    judge_effect,
    judge_price,
    share_moved,
)
from gradscape.studies.samples import (
    Bootstrap,
    Comparison,
    GradientError,
    LossError,
    Sample,
    Seconds,
    compare,
    spread,
)
from gradscape.studies.variants import Refused

POINTS = 40


def sample(losses: ArrayLike, *, failed: int = 0, slope: float = 1.0) -> Sample:
    """Return a sample whose last points `failed` and whose gradients have a slope."""
    loss = np.array(losses, float)
    status = np.full(len(loss), Status.OK, dtype=np.int8)
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


def study(changes: Mapping[str, float], *, failing: bool = False) -> ModelRecord:
    """Return a study of parts that move every loss by so much, the last of which is missing from the model."""
    parts = [
        part(
            name, sample(full().loss + size), (1 - at / 20, 0.98 - at / 20, 1.02 - at / 20), missing=at == len(changes)
        )
        for at, (name, size) in enumerate(changes.items(), start=1)
    ]
    if failing:
        parts.append(part("glass", sample(full().loss, failed=10), (1.0, 0.9, 1.1)))
    return ModelRecord(
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
        refused=(Refused("tank", "fluid needs its tank"),),
        identity={"device": "cuda", "options": {}},
        provenance={"created": "2026-01-01"},
        command="landscape study model fluid",
    )


NONE = Bootstrap(None, None, None)


def variant(name: str, seconds: float, error: float | None, changed: str = "dt") -> MeasuredVariant:
    """Return a variant that takes so long, with an error that is the same as a share and in the loss's unit."""
    p95 = Bootstrap(error, error and error / 2, error and 2 * error)
    found = Comparison(
        LossError(NONE, p95, NONE, p95), NONE, GradientError(NONE, NONE), 0.0, 64, Seconds(seconds / 2, seconds), 8
    )
    return MeasuredVariant(name, changed, Fidelity(name, dt=0.1), "warp", "cpu", {}, 1, found)


VARIANTS = (
    variant("reference", 10.0, 0.0, "named"),
    variant("draft", 0.1, 0.3, "named"),
    variant("standard", 1.0, 0.02, "named"),
    variant("draft-dt-x0.5", 0.2, 0.1),
    variant("slow", 2.0, 0.1),
    variant("above the name of draft", 0.1, 0.45, "precision"),
    variant("beside it", 0.12, 0.4, "precision"),
    variant("broken", 0.05, None),
    variant("slower than the reference", 20.0, 0.001),
)


def fidelities(variants: Sequence[MeasuredVariant] = VARIANTS, env: str = "scene") -> FidelityRecord:
    """Return a study of fidelities, the first of which is the reference."""
    return FidelityRecord(
        env=env, points=64, seed=0, loss_unit="m", refused=(), identity={"device": "cpu", "options": {}},
        provenance={}, command="", reference="reference", spread=2.0, reference_failed=0, variants=tuple(variants),
        orders=(),
    )  # fmt: skip
