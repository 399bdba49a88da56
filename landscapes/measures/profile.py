"""The profile of a slice: all that is measured of it, and what that comes to in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor

from ..capacity import Need
from ..identity import errors_of, plane_of
from ..objective import Evaluation, Objective, ObjectiveWrapper, evaluate, in_box
from ..statistics import EstimateRecord
from . import gradient_quality as gradients
from .classify import Verdict, classify, thresholds
from .discontinuities import Count, Jumps, find_jumps
from .lyapunov import GradientGrowth
from .noise import Noise, noise
from .records import ProfileRecord, UnresolvedRecord
from .ruggedness import Ruggedness, ruggedness
from .twice import Twice, at_twice, episodes_at_twice
from .unresolved import find_unresolved, probes, say_share, stored_unresolved

PRECISION = {"float32": 2.0**-23, "float64": 2.0**-52}  # relative, of an engine that computes in it
NOISE_POINTS, REPEATS, PAIRS = 16, 4, 12
SECONDS, BYTES = (1.0, 4e-5), (80_000_000, 300)  # that a slice takes, and each of its samples (2026-11, one core)
PAIRS_PER_POINT = 8  # steep pairs of samples that are looked into, for each point of a side of the subgrid


@dataclass(frozen=True, eq=False)
class Profile:
    """Hold the measures of a slice: of its losses, of its noise, of its jumps and of its gradients at several scales.

    `steps`, `samples` and `smooth` are what `gradients.ladder`, `of_samples` and `smoothed_slopes` return. `cut` of
    `asked` evaluations would have been beyond the box of an objective that does not invite that, and were left out.
    `unresolved` and `at_twice` say what its samples hide, None where that is not known; `errors` says how many of them
    raised and what the first of them said.
    """

    losses: Ruggedness
    noise: Noise
    jumps: Jumps
    steps: xr.Dataset
    samples: xr.Dataset
    smooth: xr.Dataset
    verdict: Verdict
    asked: int
    cut: int
    unresolved: UnresolvedRecord | None = None
    at_twice: Twice | None = None
    errors: str = ""

    @property
    def words(self) -> tuple[str, ...]:
        """The words for the landscape, in the order of `classify.WORDS`."""
        return self.verdict.words

    def record(self) -> ProfileRecord:
        """Return it as plain JSON."""
        return {
            "losses": self.losses.record(),
            "noise": self.noise.record(),
            "jumps": self.jumps.record(),
            "differences": gradients.scale_table(self.steps),
            "differences_of_samples": gradients.scale_table(self.samples),
            "smoothing": gradients.width_table(self.smooth),
            "verdict": {"words": list(self.verdict.words), "reasons": self.verdict.reasons},
            "thresholds": thresholds(),
            "beyond_the_box": {"asked": self.asked, "cut": self.cut},
            "unresolved": self.unresolved,
            "at_twice": self.at_twice.record() if self.at_twice else None,
            "errors": self.errors,
        }


def effort(rank: int, points: int, shape: Sequence[int] = ()) -> tuple[int, int]:
    """Return how many losses, at most, and how many gradients `measure_profile` evaluates.

    Without the `shape` of the slice those are left out that look between its samples.
    """
    places = points**2
    losses = NOISE_POINTS * (2 + 2 * REPEATS) + PAIRS_PER_POINT * points * 14
    losses += places * rank * 2 * len(gradients.SCALES)
    slopes = places * (1 + 2 * PAIRS * len(gradients.WIDTHS))
    if shape:
        anew = episodes_at_twice(shape)
        losses, slopes = losses + probes(math.prod(shape), grad=True) + anew[0], slopes + anew[1]
    return losses, slopes


def need_of(rank: int, dim: int, points: int) -> Need:
    """Return what the points and gradients of `measure_profile` take, some copies of them included."""
    return Need(8.0 * (4 * rank + 6 * dim) * 2 * PAIRS * float(points) ** 2)


def own_cost(samples: int) -> tuple[float, int]:
    """Return about how many seconds and bytes `measure_profile` takes itself for a slice of so many samples."""
    return SECONDS[0] + SECONDS[1] * samples, BYTES[0] + BYTES[1] * samples


def measure_profile(
    objective: Objective,
    dataset: xr.Dataset,
    *,
    rounding: float,
    points: int = 6,
    seed: int = 0,
    events: Count | None = None,
) -> Profile:
    """Measure a slice, with new evaluations of its objective at points x points places of it.

    `rounding` is the engine's relative precision: `PRECISION` has that of float32 and of float64. `events` counts what
    happens in episodes, which explains jumps. Jumps are looked for from half the step on, from sample to sample, of a
    ramp through the range of the losses.
    """
    plane, objective = plane_of(dataset), _Within(objective)
    generator = torch.Generator().manual_seed(seed)
    places = gradients.subgrid(plane, points if plane.rank == 2 else points**2)
    shares = torch.rand(NOISE_POINTS, plane.rank, generator=generator, dtype=torch.float64)
    drawn = plane.lower + (plane.upper - plane.lower) * shares
    fuzz = noise(objective, plane.lift(drawn), rounding=rounding, repeats=REPEATS, seed=seed)
    floor = float(np.nan_to_num(fuzz.floor(dataset["loss"].size)))
    found = ruggedness(dataset, floor=floor)
    least = max(floor, float(np.nan_to_num(found.range)) / (max(plane.resolution) - 1) / 2)
    jumps = find_jumps(objective, dataset, least=least, most=PAIRS_PER_POINT * points, seed=seed, events=events)
    deviation = float(np.nan_to_num(fuzz.deviation))
    steps = gradients.compare_differences(objective, plane, places, deviation=deviation)
    smooth = gradients.smoothed_slopes(objective, plane, places, pairs=PAIRS, seed=seed)
    samples = gradients.compare_samples(dataset, deviation=deviation)
    cosine = samples["cosine"].isel(scale=0).to_numpy()
    words = classify(found, jumps, cosine)
    between = stored_unresolved(dataset)
    if between is None and (looked := find_unresolved(objective, dataset, floor=floor, seed=seed)):
        between = looked.record()
    twice = at_twice(objective, dataset, found, jumps, cosine, deviation=deviation, seed=seed)
    asked = objective.asked, objective.cut
    return Profile(found, fuzz, jumps, steps, samples, smooth, words, *asked, between, twice, errors_of(dataset))


class _Within(ObjectiveWrapper):
    """Evaluate an objective where it may be asked, and count the points where it may not."""

    def __init__(self, objective: Objective) -> None:
        super().__init__(objective)
        self.beyond_box = True  # those are left out here
        self.asked = self.cut = 0

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        self.asked += len(x)
        if not self.objective.beyond_box:
            self.cut += int((~in_box(self.space, x)).sum())
        return evaluate(self.objective, x, grad=grad)


def named_measures(record: ProfileRecord) -> dict[str, str]:
    """Return the chief numbers of a profile's `record`, by short names, as a page shows them."""
    losses, jumps = record["losses"], record["jumps"]
    near, smooth = record["differences_of_samples"][0], record["smoothing"]
    fewest, most = losses["minima_halved"]
    lacking = losses.get("missing")
    named = {
        "Samples that failed": _percent(losses["failed"] / losses["samples"]) if losses["failed"] else "",
        "Points that raised": record.get("errors", ""),
        "Gradients missing beside a loss": _shares(lacking) if lacking and lacking["value"] else "",
        "Local minima above the noise": f"{losses['minima']} ({fewest} to {most} at half the resolution)",
        "Local minima deeper than 1 % of the range": str(losses["notable"]),
        "Basin of the lowest sample": _percent(losses["lowest_basin"]),
        "Noise floor": f"{losses['floor']:.2g}",
        "Gradient effectively zero": _shares(losses["flat"]),
        "Samples level with their neighbours": _shares(losses["level"]),
        "Neighbours with a jump between them": _shares(jumps["share"]),
        "Jumps explained by an event": _shares(jumps["explained_by_events"]),
        "Correlation length, of the box": ", ".join(map(_shares, losses["correlation_length"])),
        "Hölder exponent": _along_axes(losses.get("holder", [])),
        "Total variation, in ranges": _along_axes(losses["total_variation"]),
        "Information content": _number(losses["information"]),
        "Dispersion of the best 5 %": _number(losses["dispersion"]),
        "Fitness-distance correlation": _number(losses["fitness_distance"]),
        f"Cosine of gradient and difference over {near['scale']:.1%} of the box": _number(near["cosine"]),
        f"Gradients uphill over {near['scale']:.1%} of the box": _shares(near["uphill"]),
    }
    if between := say_share(record.get("unresolved")):
        named["Cells finer than the samples"] = between
    if cut := record.get("beyond_the_box", {}).get("cut"):
        named["Probes beyond the bounds, left out"] = f"{cut} of {record['beyond_the_box']['asked']}"
    if grown := record.get("growth"):
        named["Growth with the length of episodes"] = GradientGrowth.of_record(grown).say()
    for row in smooth:
        named[f"First order biased, smoothed over {row['width']:.0%} of the box"] = _shares(row["biased"])
    return {name: text for name, text in named.items() if text}


def _shares(estimate: EstimateRecord | None) -> str:
    return _with_interval(estimate, _percent)


def _along_axes(values: Sequence[EstimateRecord | None]) -> str:
    """Say a number for each axis, a dash where one is not known, nothing where none is."""
    said = list(map(_number, values))
    return ", ".join(one or "\N{EN DASH}" for one in said) if any(said) else ""


def _number(estimate: EstimateRecord | None) -> str:
    return _with_interval(estimate, lambda value: f"{value:z.2f}".replace("-", "\N{MINUS SIGN}"))


def _with_interval(estimate: EstimateRecord | None, write: Callable[[float], str]) -> str:
    if estimate is None or estimate["value"] is None:
        return ""
    said, low, high = write(estimate["value"]), estimate["low"], estimate["high"]
    return said if low is None or high is None or low == high else f"{said} ({write(low)} to {write(high)})"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"
