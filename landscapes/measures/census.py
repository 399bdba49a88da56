"""The census of an environment: slices through random points along random cuts, each measured by itself."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..directions import orthonormal
from ..identity import plane_of
from ..lattice import count_gradients
from ..objective import Objective, evaluate, in_box
from ..plane import Plane
from ..space import ParameterSpace
from ..statistics import Estimate
from .classify import Verdict, classify
from .discontinuities import EVALUATIONS_PER_PAIR, Jumps, find_jumps_abreast
from .gradient_quality import compare_samples
from .ruggedness import Ruggedness, ruggedness

Array = NDArray[np.float64]
PAIRS, RANDOM = "pairs", "random"
ALONG = (PAIRS, RANDOM)  # what cuts are: pairs of parameters, or pairs of random directions
STEEP = 16  # pairs of neighbouring samples of a slice that are bisected for jumps
MEASURES = (
    "turns",
    "notable minima",
    "level",
    "gradient zero",
    "jumps",
    "correlation length",
    "Hölder exponent",
    "total variation",
    "information content",
    "dispersion",
    "fitness-distance correlation",
    "cosine",
    "uphill",
    "range",
)  # as a report has them: means over the axes, shares, and the range of the losses in their unit


@dataclass(frozen=True)
class Cut:
    """Hold the two directions of a slice, and what they are called.

    `dims` are the numbers of two parameters; else `directions`, shape (2, dim), are orthonormal in widths of the box.
    """

    dims: tuple[int, int] | None
    directions: tuple[tuple[float, ...], ...] | None = None

    def through(self, space: ParameterSpace, base: Float[Tensor, " dim"], resolution: int) -> Plane:
        """Return the slice through a point: over the whole box, or half a width of it to every side."""
        if self.dims is not None:
            return Plane.through(space, base, self.dims, resolution=resolution)
        width = space.upper - space.lower
        along = torch.tensor(self.directions, dtype=torch.float64) * width
        labels = [f"random direction {axis + 1}" for axis in range(len(along))]
        return Plane.span(base, along, resolution=resolution, extent=(-0.5, 0.5), labels=labels)


@dataclass(frozen=True, eq=False)
class CensusDesign:
    """Hold what is sliced: every cut through every base point, so that what either does can be told apart.

    `bases` [parameters' units] has shape (base, dim). A slice has gradients at every so many samples along each axis,
    `gradients`.
    """

    space: ParameterSpace
    bases: Float[Tensor, "base dim"]
    cuts: tuple[Cut, ...]
    resolution: int
    gradients: int = 1

    @classmethod
    def draw(
        cls, space: ParameterSpace, slices: int, *, along: str, resolution: int, seed: int, gradients: int = 1
    ) -> CensusDesign:
        """Draw about as many base points as cuts, so many slices in all at most.

        Of pairs of parameters there may be fewer than that takes, and then there are more base points; of two
        parameters there is one slice, whatever it goes through. Raises ValueError for other ways to cut, and where
        the space has one parameter.
        """
        if along not in ALONG:
            raise ValueError(f"a census cuts along {' or '.join(ALONG)}; got {along!r}")
        if space.dim < 2:
            raise ValueError("a census takes two parameters and more; got one")
        generator = np.random.default_rng(seed)
        count = math.isqrt(slices)
        if along == RANDOM:
            cuts = [Cut(None, tuple(map(tuple, orthonormal(generator, space.dim).tolist()))) for _ in range(count)]
        else:
            every = list(combinations(range(space.dim), 2))
            cuts = [Cut(every[at]) for at in sorted(generator.permutation(len(every))[:count])]
        many = 1 if along == PAIRS and space.dim == 2 else slices // len(cuts)
        bases = space.from_unit(torch.from_numpy(generator.random((many, space.dim))))
        return cls(space, bases, tuple(cuts), resolution, gradients)

    @property
    def samples(self) -> tuple[int, int]:
        """How many samples of a slice are without a gradient, and how many have one."""
        having = count_gradients((self.resolution, self.resolution), self.gradients)
        return self.resolution**2 - having, having

    @property
    def places(self) -> list[tuple[int, int]]:
        """The numbers of base point and cut of every slice, in order."""
        return [(base, cut) for base in range(len(self.bases)) for cut in range(len(self.cuts))]

    def plane(self, base: int, cut: int) -> Plane:
        """Return a slice."""
        return self.cuts[cut].through(self.space, self.bases[base], self.resolution)


@dataclass(frozen=True, eq=False)
class SurveyedSlice:
    """Hold what a slice of a census is like: its losses, measures by the order of `MEASURES`, and words.

    `loss` [loss unit] has shape (v, u), NaN where an episode failed or the point is outside the box. `halved` are the
    measures of every second sample along each axis.
    """

    loss: Array
    measures: Array
    halved: Array
    words: tuple[str, ...]
    episodes: int

    def arrays(self) -> dict[str, Any]:
        """Return what `of_arrays` takes, for a file."""
        return {**vars(self), "words": np.array(self.words, dtype=str), "episodes": np.array(self.episodes)}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> SurveyedSlice:
        """Rebuild it from its `arrays`."""
        words = tuple(map(str, arrays["words"]))
        return cls(arrays["loss"], arrays["measures"], arrays["halved"], words, int(arrays["episodes"]))


def survey(
    objective: Objective, planes: Sequence[Plane], *, deviation: float, seed: int, gradients: int = 1
) -> list[SurveyedSlice]:
    """Sample and measure slices, their points in one batch; `deviation` [loss unit] is that of the losses' noise.

    Measures are those of a report, without their intervals within the slice: what counts here is how they differ from
    slice to slice. Those of gradients are of every so many samples along each axis, `gradients`, and hold them against
    the losses of all. Jumps are looked for in at most `STEEP` pairs of samples of a slice.
    """
    wholes = sample_cuts(objective, planes, gradients=gradients)
    rugged = [_ruggedness(whole, deviation) for whole in wholes]
    least = [
        max(_floor(whole, deviation), float(np.nan_to_num(found.range)) / (max(plane.resolution) - 1) / 2)
        for plane, whole, found in zip(planes, wholes, rugged, strict=True)
    ]
    jumps = find_jumps_abreast(objective, wholes, least=least, most=STEEP, seed=seed)
    surveyed = []
    for plane, whole, found, steep in zip(planes, wholes, rugged, jumps, strict=True):
        measures, verdict = _measure(whole, found, steep, deviation)
        thin = thin_out(whole)
        halved, _ = _measure(thin, _ruggedness(thin, deviation), None, deviation)
        samples = plane.grid().reshape(-1, plane.dim)
        asked = len(samples) if objective.beyond_box else int(in_box(objective.space, samples).sum())
        loss, episodes = whole["loss"].to_numpy(), asked + EVALUATIONS_PER_PAIR * steep.checked
        surveyed.append(SurveyedSlice(loss, measures, halved, verdict.words, episodes))
    return surveyed


def sample_cuts(objective: Objective, planes: Sequence[Plane], *, gradients: int = 1) -> list[xr.Dataset]:
    """Return losses and gradients of slices, NaN where a sample has none; of each nothing else is said than its plane.

    Gradients are at every so many samples along each axis, `gradients`.
    """
    grids = [plane.grid() for plane in planes]
    having = torch.zeros(grids[0].shape[:2], dtype=torch.bool)
    having[::gradients, ::gradients] = True
    loss = torch.empty(len(planes), *having.shape, dtype=torch.float64)
    status = torch.empty(loss.shape, dtype=torch.int8)
    grad = torch.full((*loss.shape, grids[0].shape[2]), torch.nan, dtype=torch.float64)
    for some in (having, ~having):
        if bool(some.any()):
            x = torch.cat([grid[some] for grid in grids])
            found = evaluate(objective, x, grad=some is having)
            loss[:, some] = found.loss.reshape(len(planes), -1)
            status[:, some] = found.status.reshape(len(planes), -1)
            if found.grad is not None:
                grad[:, some] = found.grad.reshape(len(planes), -1, grad.shape[-1])
    arrays = (loss.numpy(), grad.numpy(), status.numpy())
    return [_dataset(plane, *(values[row] for values in arrays)) for row, plane in enumerate(planes)]


def thin_out(whole: xr.Dataset) -> xr.Dataset:
    """Return every second sample along each axis, as a slice of half the resolution would have them."""
    plane, thin = plane_of(whole), whole.isel(u=slice(None, None, 2), v=slice(None, None, 2))
    shape = thin.sizes["u"], thin.sizes["v"]
    steps = [
        (high - low) / (count - 1) for low, high, count in zip(plane.lower, plane.upper, plane.resolution, strict=True)
    ]
    ends = [low + 2 * step * (count - 1) for low, step, count in zip(plane.lower, steps, shape, strict=True)]
    return _dataset(
        Plane(plane.origin, plane.basis, plane.lower, torch.stack(ends), shape, plane.labels, plane.scales),
        *(thin[name].to_numpy() for name in ("loss", "grad", "status")),
    )


def _dataset(plane: Plane, loss: Array, grad: Array, status: Array) -> xr.Dataset:
    about = {"identity": json.dumps({"plane": plane.record()})}
    columns = {"loss": (("v", "u"), loss), "grad": (("v", "u", "dim"), grad), "status": (("v", "u"), status)}
    return xr.Dataset(columns, attrs=about)


def _ruggedness(dataset: xr.Dataset, deviation: float) -> Ruggedness:
    return ruggedness(dataset, floor=_floor(dataset, deviation), estimate=_alone)


def _floor(dataset: xr.Dataset, deviation: float) -> float:
    return 2 * deviation * math.sqrt(2 * math.log(dataset["loss"].size))


def _measure(dataset: xr.Dataset, found: Ruggedness, steep: Jumps | None, deviation: float) -> tuple[Array, Verdict]:
    cosine = compare_samples(dataset, deviation=deviation)["cosine"].isel(scale=0).to_numpy()
    share = steep.share.value if steep is not None else math.nan
    return _values(found, share, cosine), classify(found, steep, cosine)


def _alone(statistic: Any, samples: Array, **bounds: float) -> Estimate:
    """Return a measure without an interval, which the other slices give."""
    return Estimate(statistic(samples), math.nan, math.nan)


def _values(found: Ruggedness, jumps: float, cosine: Array) -> Array:
    known = cosine[np.isfinite(cosine) & (cosine != 0)]
    flat = found.flat.value if found.flat is not None else math.nan
    return np.array(
        [
            found.turns.value,
            found.notable,
            found.level.value,
            flat,
            jumps,
            np.mean([one.value for one in found.correlation_length]),
            np.mean([one.value for one in found.holder]),
            np.mean([one.value for one in found.total_variation]),
            found.information.value,
            found.dispersion.value,
            found.fitness_distance.value,
            known.mean() if len(known) else math.nan,
            (known < 0).mean() if len(known) else math.nan,
            found.range,
        ]
    )


def ordered(measures: Sequence[Array]) -> list[int]:
    """Return the numbers of slices by their measures, the least rugged first: how often they turn back, then minima."""
    keyed = [MEASURES.index(name) for name in ("turns", "notable minima")]
    keys = [tuple(np.nan_to_num(one[keyed], nan=-1.0)) for one in measures]
    return sorted(range(len(keys)), key=lambda number: keys[number])
