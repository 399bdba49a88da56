"""The census of an environment: slices through random points along random cuts, each measured separately."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..convert import NOT_JSON
from ..directions import orthonormal
from ..identity import plane_of
from ..lattice import count_gradients
from ..objective import Objective, evaluate
from ..plane import Plane
from ..space import ParameterSpace
from ..statistics import UNKNOWN, Estimate, clustered_share, exactly, middle_95
from .discontinuities import EVALUATIONS_PER_PAIR
from .floor import Floor
from .following import CHIEF, SCALES
from .ruggedness import ruggedness
from .surface import EVALUATIONS_PER_PLACE, WAY_POINTS, WAYS, Surface, measure_surface
from .verdict import FLAT, WORDS, CountedObjective, Verdict, judge, least_difference

if TYPE_CHECKING:
    import pandas as pd

    from ..draw.figure import Picture

Array = NDArray[np.float64]
PAIRS, RANDOM = "pairs", "random"
ALONG = (PAIRS, RANDOM)  # what cuts are: pairs of parameters, or pairs of random directions
STEEP = 48  # pairs of neighbouring samples of a slice that are bisected for jumps
CUTS = 2  # through each base point
PLACES, POINTS = 48, 48  # between the samples of a slice, and where gradients are held against slopes
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
)  # as a report has them: the most of the axes' turns, means over axes, shares, and the range of the losses


RESAMPLES = 999
ROUNDING = 1e-9  # of a measure, below which it does not vary
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True)
class PlaneSpec:
    """The two directions of a slice, and their labels.

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
        return Plane.span(base, along, resolution=resolution, window=(-0.5, 0.5), labels=labels)


@dataclass(frozen=True, eq=False)
class CensusDesign:
    """The slices to measure: two cuts through every base point, and every cut through two or more points.

    That separates the effects of point and cut, with as many of both as the number of slices allows, because slices
    that share one are alike. `bases` [parameters' units] has shape (base, dim). `gradients` is the stride of the
    samples with gradients along each axis.
    """

    space: ParameterSpace
    bases: Float[Tensor, "base dim"]
    cuts: tuple[PlaneSpec, ...]
    resolution: int
    gradients: int = 1

    @classmethod
    def draw(
        cls, space: ParameterSpace, slices: int, *, along: str, resolution: int, seed: int, gradients: int = 1
    ) -> CensusDesign:
        """Draw half as many base points as slices, and as many cuts, or all there are.

        A space of two parameters has a single slice, whatever point it goes through. Raises ValueError for another way
        to cut, and for a space with one parameter.
        """
        if along not in ALONG:
            raise ValueError(f"a census takes along {' or '.join(ALONG)}; got {along!r}")
        if space.dim < 2:
            raise ValueError("a census needs at least two parameters; got one")
        generator = np.random.default_rng(seed)
        many = max(1, slices // CUTS)
        count = max(many, min(CUTS, slices))
        if along == RANDOM:
            frames = [orthonormal(generator, space.dim).tolist() for _ in range(count)]
            cuts = [PlaneSpec(None, tuple(map(tuple, frame))) for frame in frames]
        else:
            every = list(combinations(range(space.dim), 2))
            cuts = [PlaneSpec(every[at]) for at in sorted(generator.permutation(len(every))[:count])]
        only = along == PAIRS and space.dim == 2
        bases = space.from_unit(torch.from_numpy(generator.random((1 if only else many, space.dim))))
        return cls(space, bases, tuple(cuts), resolution, gradients)

    @property
    def exhausted(self) -> tuple[bool, bool]:
        """Whether base points and cuts are a complete enumeration, so that others cannot differ."""
        dim, pairs = self.space.dim, self.cuts[0].dims is not None
        return pairs and dim == 2, pairs and len(self.cuts) == dim * (dim - 1) // 2

    @property
    def samples(self) -> tuple[int, int]:
        """The numbers of samples of a slice without and with a gradient."""
        having = count_gradients((self.resolution, self.resolution), self.gradients)
        return self.resolution**2 - having, having

    @property
    def places(self) -> list[tuple[int, int]]:
        """The numbers of base point and cut of every slice, in order."""
        through = min(CUTS, len(self.cuts))
        return [(base, (base + k) % len(self.cuts)) for base in range(len(self.bases)) for k in range(through)]

    def plane(self, base: int, cut: int) -> Plane:
        """Return a slice."""
        return self.cuts[cut].through(self.space, self.bases[base], self.resolution)


@dataclass(frozen=True, eq=False)
class SurveyedSlice:
    """The results of a slice of a census: its losses, measures in the order of `MEASURES`, and words.

    `loss` [loss unit] has shape (v, u), NaN where an episode failed or the point is outside the box. `halved` are the
    measures of every second sample along each axis.
    """

    loss: Array
    measures: Array
    halved: Array
    words: tuple[str, ...]
    episodes: int

    def arrays(self) -> dict[str, Any]:
        """Return the input of `of_arrays`, for a file."""
        return {**vars(self), "words": np.array(self.words, dtype=str), "episodes": np.array(self.episodes)}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> SurveyedSlice:
        """Rebuild it from its `arrays`."""
        words = tuple(map(str, arrays["words"]))
        return cls(arrays["loss"], arrays["measures"], arrays["halved"], words, int(arrays["episodes"]))


def survey(
    objective: Objective,
    planes: Sequence[Plane],
    *,
    deviation: float,
    seed: int,
    gradients: int = 1,
    floor: Floor | None = None,
    own_range: float | None = None,
) -> list[SurveyedSlice]:
    """Sample and measure slices, their points in one batch.

    `deviation` [loss unit] is the standard deviation of the losses' noise, `floor` the numerical floor and `own_range`
    the range of the environment's losses, see `judge`. `gradients` is the stride of the samples with gradients along
    each axis. Measures are those of a report, without their intervals within the slice, because only the differences
    between slices count here. Jumps are searched in at most `STEEP` pairs of samples of a slice.
    """
    counted = CountedObjective(objective)
    wholes = sample_cuts(counted, planes, gradients=gradients)
    verdicts = judge(
        counted, wholes, deviation=deviation, floor=floor, own_range=own_range,
        places=PLACES, pairs=STEEP, points=POINTS, smoothed=0, seed=seed,
    )  # fmt: skip
    surveyed = []
    for number, (whole, verdict) in enumerate(zip(wholes, verdicts, strict=True)):
        thin = thin_out(whole)
        coarse = measure_surface(thin, floor=least_difference(thin, deviation, floor), own_range=own_range)
        measures, halved = _measure(whole, verdict, verdict.surface), _measure(thin, verdict, coarse)
        halved[MEASURES.index("jumps")] = math.nan
        episodes = (counted.asked - counted.cut + number) // len(planes)  # an even share, which add up to all
        surveyed.append(SurveyedSlice(whole["loss"].to_numpy(), measures, halved, verdict.words, episodes))
    return surveyed


def judging_effort() -> tuple[int, int]:
    """Return the largest number of losses, and the number of gradients, needed to judge a sampled slice."""
    losses = PLACES * EVALUATIONS_PER_PLACE + WAYS * WAY_POINTS + STEEP * EVALUATIONS_PER_PAIR
    return losses + 4 * POINTS * len(SCALES), POINTS


def sample_cuts(objective: Objective, planes: Sequence[Plane], *, gradients: int = 1) -> list[xr.Dataset]:
    """Return losses and gradients of slices, NaN where a sample has none; their only attribute is their plane.

    `gradients` is the stride of the samples with gradients along each axis.
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
    """Return every second sample along each axis, like a slice of half the resolution."""
    plane, thin = plane_of(whole), whole.isel(u=slice(None, None, 2), v=slice(None, None, 2))
    shape = thin.sizes["u"], thin.sizes["v"]
    upper = torch.stack([axis[2 * (count - 1)] for axis, count in zip(plane.axes(), shape, strict=True)])
    arrays = (thin[name].to_numpy() for name in ("loss", "grad", "status"))
    return _dataset(replace(plane, upper=upper, resolution=shape), *arrays)


def _dataset(plane: Plane, loss: Array, grad: Array, status: Array) -> xr.Dataset:
    about = {"identity": json.dumps({"plane": plane.record()})}
    columns = {"loss": (("v", "u"), loss), "grad": (("v", "u", "dim"), grad), "status": (("v", "u"), status)}
    return xr.Dataset(columns, attrs=about)


def _alone(statistic: Any, samples: Array, **bounds: float) -> Estimate:
    """Return a measure without an interval, which comes from the other slices."""
    return exactly(statistic(samples))


def _measure(dataset: xr.Dataset, verdict: Verdict, surface: Surface) -> Array:
    """Return the measures of a slice with the given surface."""
    found = ruggedness(dataset, floor=surface.floor, estimate=_alone)
    near = None if verdict.following is None else verdict.following.at(CHIEF)
    return np.array(
        [
            max(one.value for one in surface.turns),
            surface.minima.value,
            surface.level.value,
            math.nan if verdict.following is None else verdict.following.zero.value,
            math.nan if verdict.jumps is None else verdict.jumps.share.value,
            np.mean([one.value for one in found.correlation_length]),
            np.mean([one.value for one in found.holder]),
            np.mean([one.value for one in found.total_variation]),
            found.information.value,
            found.dispersion.value,
            found.fitness_distance.value,
            math.nan if near is None else near.cosine.value,
            math.nan if near is None else near.uphill.value,
            found.range,
        ]
    )


def ordered(measures: Sequence[Array]) -> list[int]:
    """Return the numbers of slices by their measures, the least rugged first: by turns, then minima."""
    keyed = [MEASURES.index(name) for name in ("turns", "notable minima")]
    keys = [tuple(np.nan_to_num(one[keyed], nan=-1.0)) for one in measures]
    return sorted(range(len(keys)), key=lambda number: keys[number])


@dataclass(frozen=True)
class Spread:
    """The distribution of a measure over the slices: its quantiles, and its median with a 95 % interval."""

    quantiles: tuple[float, ...]
    median: Estimate


@dataclass(frozen=True)
class VarianceComponents:
    """Shares of a measure's variance over slices by cause; NaN where it does not vary or is unknown.

    `base` and `cut` are the effects of the point and of the cut alone, `both` the rest: their joint effect.
    `resolution` and `fidelity` are the variances from another way to measure, as shares of the same variance.
    """

    base: float
    cut: float
    both: float
    resolution: float
    fidelity: float


@dataclass(frozen=True)
class CensusedSlice:
    """One slice of a census: the numbers of its base point and cut, its axes, range and words.

    `range` [loss unit] is from its lowest to its highest loss, None where all failed. `measures` are in the order of
    `census.MEASURES`; `failed` is the share of its samples without a loss.
    """

    base: int
    cut: int
    axes: tuple[str, ...]
    range: tuple[float, float] | None
    failed: float
    measures: tuple[float | None, ...]
    words: tuple[str, ...]


@dataclass(frozen=True)
class Census:
    """The results of many slices of an environment.

    `words` has the share of slices for every word, among those that are not flat. `spreads` and `parts` have the
    distribution and the variance components of every measure. `exhausted`: base points and cuts are a complete
    enumeration. `other` is the second fidelity of some slices, empty where there is none. `gradients` is the stride of
    the samples with gradients along each axis. `losses` [loss unit] are those of the slices, shape (slice, v, u), in a
    separate file. `floor` is the difference between replicas of the environment at random points, relative to the
    median range of the slices; None where it has no replicas.
    """

    env: str
    fidelity: str
    other: str
    loss_unit: str
    along: str
    resolution: int
    gradients: int
    seed: int
    episodes: int
    slices: tuple[CensusedSlice, ...]
    words: dict[str, Estimate]
    spreads: dict[str, Spread]
    parts: dict[str, VarianceComponents]
    exhausted: tuple[bool, bool]
    identity: dict[str, Any]
    provenance: dict[str, Any]
    command: str
    floor: Floor | None = None
    losses: NDArray[np.float32] = field(
        default_factory=lambda: np.zeros(0, np.float32), metadata=NOT_JSON, repr=False, compare=False
    )

    @property
    def solid(self) -> int:
        """The number of slices that are not flat, the base of the shares of other words."""
        return sum(FLAT not in one.words for one in self.slices)

    def share(self, words: Sequence[str]) -> Estimate:
        """Return the share of slices with any of some words, among those that are not flat."""
        places = [(one.base, one.cut) for one in self.slices]
        return share_of_any([one.words for one in self.slices], words, places, self.exhausted)

    @property
    def order(self) -> list[int]:
        """The numbers of the slices, the least rugged first."""
        return ordered([np.array([np.nan if m is None else m for m in one.measures]) for one in self.slices])

    def table(self) -> pd.DataFrame:
        """Return a row for each measure, indexed by `measure`.

        Columns: the quantiles over the slices, `median` with `low` and `high`, and the shares of the variance due to
        `base`, `cut`, `both`, `resolution` and `fidelity`.
        """
        import pandas as pd

        rows = []
        for name, one in self.spreads.items():
            quantiles = dict(zip([f"{q:.0%}" for q in QUANTILES], one.quantiles, strict=True))
            middle = {"median": one.median.value, "low": one.median.low, "high": one.median.high}
            rows.append({"measure": name, **quantiles, **middle, **asdict(self.parts[name])})
        return pd.DataFrame(rows).set_index("measure")

    def plot(self, width: float | None = None) -> Picture:
        """Draw every slice small, the least rugged first, for a screen, or for a page of this width [mm]."""
        from ..draw.figure import figure_of

        return figure_of(self, width)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def scale(losses: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
    """Return the losses of slices, shape (slice, v, u), in the form of a small file.

    `loss` goes from 0 at a slice's lowest loss, `low`, to 1 at its highest, `high` [loss unit], in half precision, with
    an error of at most 0.025 % of the range. It is NaN where a sample has no loss, and so are the ends of a slice
    without any.
    """
    known = np.isfinite(losses)
    low, high = (
        np.where(known.any(axis=(1, 2)), end(np.where(known, losses, out), axis=(1, 2)), np.nan)
        for end, out in ((np.min, np.inf), (np.max, -np.inf))
    )
    whole = np.where(high > low, high - low, 1.0)[:, None, None]
    return {"loss": ((losses - low[:, None, None]) / whole).astype(np.float16), "low": low, "high": high}


def conclude(
    design: CensusDesign,
    found: Sequence[SurveyedSlice],
    others: Mapping[int, SurveyedSlice],
    *,
    env: str,
    fidelity: str,
    other: str,
    loss_unit: str,
    seed: int,
    identity: Mapping[str, Any],
    provenance: Mapping[str, Any],
    command: str,
    floor: Floor | None = None,
) -> Census:
    """Summarise the slices of a design, and those that were also measured at another fidelity, by their numbers."""
    drawn = bootstrap(design.places, seed=seed, exhausted=design.exhausted)
    whole, halved = (np.array([getattr(one, name) for one in found]) for name in ("measures", "halved"))
    spreads, parts = {}, {}
    for k, name in enumerate(MEASURES):
        spreads[name] = spread(whole[:, k], drawn)
        elsewhere = {at: float(one.measures[k]) for at, one in others.items()}
        parts[name] = divide(whole[:, k], halved[:, k], elsewhere, design.places)
    places = zip(design.places, found, strict=True)
    return Census(
        along="random" if design.cuts[0].dims is None else "pairs",
        resolution=design.resolution,
        gradients=design.gradients,
        seed=seed,
        episodes=sum(one.episodes for one in (*found, *others.values())),
        slices=tuple(_sum_up(one, *place, design.plane(*place).labels) for place, one in places),
        words=word_shares([one.words for one in found], design.places, design.exhausted),
        exhausted=design.exhausted,
        spreads=spreads,
        parts=parts,
        losses=np.array([one.loss for one in found], dtype=np.float32),
        env=env,
        fidelity=fidelity,
        other=other,
        loss_unit=loss_unit,
        identity=dict(identity),
        provenance=dict(provenance),
        command=command,
        floor=floor,
    )


def _sum_up(found: SurveyedSlice, base: int, cut: int, axes: tuple[str, ...]) -> CensusedSlice:
    known = found.loss[np.isfinite(found.loss)]
    ends = (float(known.min()), float(known.max())) if known.size else None
    measures = tuple(None if not np.isfinite(one) else float(one) for one in found.measures)
    return CensusedSlice(base, cut, axes, ends, 1 - known.size / found.loss.size, measures, found.words)


def bootstrap(
    places: Sequence[tuple[int, int]], *, seed: int, exhausted: tuple[bool, bool] = (False, False)
) -> NDArray[np.int64]:
    """Draw the weight of each slice, shape (resample, slice): base points and cuts are drawn independently.

    Slices that share a point or a cut depend on each other (pigeonhole bootstrap: Owen 2007, Ann. Appl. Stat. 1(2)). A
    single point or cut is kept, and so are all of a complete enumeration.
    """
    generator, at = np.random.default_rng(seed), np.array(places)
    counts = [
        np.ones((RESAMPLES, many), int)
        if many == 1 or all_of_them
        else generator.multinomial(many, np.full(many, 1 / many), size=RESAMPLES)
        for many, all_of_them in zip(at.max(axis=0) + 1, exhausted, strict=True)
    ]
    return np.asarray(counts[0][:, at[:, 0]] * counts[1][:, at[:, 1]], dtype=np.int64)


def word_shares(
    words: Sequence[Sequence[str]], places: Sequence[tuple[int, int]], exhausted: tuple[bool, bool]
) -> dict[str, Estimate]:
    """Return the share of slices for each word, among those that are not flat; that of flat is of all slices."""
    return {word: share_of_any(words, [word], places, exhausted) for word in WORDS}


def share_of_any(
    said: Sequence[Sequence[str]],
    words: Sequence[str],
    places: Sequence[tuple[int, int]],
    exhausted: tuple[bool, bool],
) -> Estimate:
    """Return the share of slices with any of some words, with its interval; see `word_shares`.

    Slices of one base point are a cluster, and so are those of one cut where there are others.
    """
    counted = np.array([FLAT in words or FLAT not in one for one in said])
    hits = np.array([any(word in one for word in words) for one in said], dtype=float)[counted]
    clusters = [np.array(places)[counted, axis] for axis in (0, 1) if not exhausted[axis]]
    return clustered_share(hits, clusters)


def spread(values: Array, drawn: NDArray[np.int64]) -> Spread:
    """Return the distribution of the values of a measure, without NaN."""
    known = np.isfinite(values)
    if not known.any():
        return Spread((np.nan,) * len(QUANTILES), UNKNOWN)
    middle = middle_95(float(np.median(values[known])), _medians(values[known], drawn[:, known]))
    return Spread(tuple(float(one) for one in np.quantile(values[known], QUANTILES)), middle)


def _medians(values: Array, drawn: NDArray[np.int64]) -> Array:
    """Return the median of each resample with values: the mean of the one or two in its middle."""
    order = np.argsort(values, kind="stable")
    upto = np.cumsum(drawn[:, order], axis=1)  # how many of a resample there are up to each value
    upto = upto[upto[:, -1] > 0]
    last = upto[:, -1:] - 1
    below, above = (values[order][(upto <= at).sum(axis=1)] for at in (last // 2, (last + 1) // 2))
    return np.asarray((below + above) / 2)


def divide(
    values: Array, halved: Array, others: Mapping[int, float], places: Sequence[tuple[int, int]]
) -> VarianceComponents:
    """Divide the variance of a measure over slices, shape (slice,), among its causes.

    Two-way random effects: half the mean square of the difference of two slices is the sum of the effects of point, cut
    and both where they share neither, and lacks the shared ones (Searle, Casella & McCulloch 1992, section 4.3: in a
    complete table these are the mean squares). Shares below zero are set to zero. `places` are base point and cut of
    the slices. `halved` is the measure at half the resolution, `others` that of some slices, by their numbers, at
    another fidelity. Half the mean square of a difference is the variance that either adds.
    """
    total = float(np.nanvar(values, ddof=1)) if np.isfinite(values).sum() > 1 else 0.0
    if not total > (ROUNDING * np.nanmax(np.abs(values), initial=0.0)) ** 2:
        return VarianceComponents(*(np.nan,) * 5)
    other = np.array([others.get(number, np.nan) for number in range(len(values))])
    added = [_added(values, one) / total for one in (halved, other)]
    base, cut, both = _components(values, np.array(places))
    whole = base + cut + both
    shares = [one / whole if whole > 0 else np.nan for one in (base, cut, both)]
    return VarianceComponents(*shares, *added)


def _added(values: Array, others: Array) -> float:
    squares = np.square(values - others)
    return float(np.nanmean(squares) / 2) if np.isfinite(squares).any() else np.nan


def _components(values: Array, places: NDArray[np.int64]) -> tuple[float, float, float]:
    """Return the variances due to base points, cuts and the rest; NaN where no two slices share either."""
    first, second = np.triu_indices(len(values), 1)
    squares = np.square(values[first] - values[second]) / 2
    shared = places[first] == places[second]
    known = np.isfinite(squares)
    ways = [known & (shared == way).all(axis=1) for way in ([False, False], [True, False], [False, True])]
    if not all(one.any() for one in ways):
        return np.nan, np.nan, np.nan
    apart, of_base, of_cut = (float(squares[one].mean()) for one in ways)
    return max(apart - of_base, 0.0), max(apart - of_cut, 0.0), max(of_base + of_cut - apart, 0.0)
