"""What a profile is as plain JSON: the keys of `report.json` that say what was measured, each declared once."""

from __future__ import annotations

from typing import Any, NotRequired, TypedDict

from ..statistics import EstimateRecord


class LossesRecord(TypedDict):
    """What `ruggedness.Ruggedness` holds; depths and ranges are in the loss's unit."""

    samples: int
    failed: int
    range: float | None
    floor: float | None
    minima: int
    minima_halved: list[int]
    notable: int
    curve: dict[str, int]
    largest_basin: float | None
    lowest_basin: float | None
    zero: EstimateRecord | None
    flat: EstimateRecord | None
    missing: NotRequired[EstimateRecord | None]  # nor this
    level: EstimateRecord
    correlation_length: list[EstimateRecord]
    holder: NotRequired[list[EstimateRecord]]  # reports of early versions do not have it
    total_variation: list[EstimateRecord]
    information: EstimateRecord
    settling: EstimateRecord
    turns: EstimateRecord
    dispersion: EstimateRecord
    fitness_distance: EstimateRecord


class NoiseRecord(TypedDict):
    """What `noise.Noise` holds [loss unit]."""

    again: float | None
    batch: float | None
    rounding: float | None
    points: float | None


class JumpRecord(TypedDict):
    """One jump: its place [plane units], its height [loss unit], and whether an event explains it, None if unknown."""

    place: list[float]
    height: float
    event: bool | None


class JumpsRecord(TypedDict):
    """What `discontinuities.Jumps` holds."""

    share: EstimateRecord
    explained_by_events: EstimateRecord | None
    least: float | None
    neighbours: int
    steep: int
    checked: int
    undecided: int
    found: list[JumpRecord]


class ScaleRecord(TypedDict):
    """How gradients compare with differences over one `scale`, a share of the box; `points` of so many show a slope."""

    scale: float
    points: int
    of: int
    cosine: EstimateRecord
    sign: EstimateRecord
    uphill: EstimateRecord
    error: float | None


class WidthRecord(TypedDict):
    """How first- and zeroth-order slopes compare under a Gaussian of one `width`, a share of the box."""

    width: float
    points: int
    of: int
    biased: EstimateRecord
    disagreement: EstimateRecord
    variance_ratio: float | None


class VerdictRecord(TypedDict):
    """The words for a landscape, and for each the measure that it comes from."""

    words: list[str]
    reasons: dict[str, str]


class WordRecord(TypedDict):
    """A word of somebody else's for a landscape, and whether it was measured too."""

    word: str
    measured: bool


class BeyondRecord(TypedDict):
    """How many evaluations were `asked` for, and how many of them were `cut` as they lay beyond the box."""

    asked: int
    cut: int


class UnresolvedRecord(TypedDict):
    """What `unresolved.Unresolved` holds; the least difference is in the loss's unit."""

    share: EstimateRecord
    least: float | None
    cells: int
    probed: int
    found: int
    undecided: int
    episodes: int


class TwiceRecord(TypedDict):
    """What `twice.Twice` holds: measures at twice the resolution, and the words that would appear and go."""

    blocks: int
    episodes: int
    measures: dict[str, EstimateRecord]
    appear: list[str]
    go: list[str]


class ProfileRecord(TypedDict):
    """All that is measured of a slice; reports of early versions do not have the last keys."""

    losses: LossesRecord
    noise: NoiseRecord
    jumps: JumpsRecord
    differences: list[ScaleRecord]
    differences_of_samples: list[ScaleRecord]
    smoothing: list[WidthRecord]
    verdict: VerdictRecord
    thresholds: dict[str, float | None]
    beyond_the_box: NotRequired[BeyondRecord]
    unresolved: NotRequired[UnresolvedRecord | None]
    at_twice: NotRequired[TwiceRecord | None]
    errors: NotRequired[str]
    growth: NotRequired[dict[str, Any] | None]  # what `lyapunov.GradientGrowth` holds
