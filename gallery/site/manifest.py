"""What the site says to programs and to its pages: the records of its JSON, each with the keys that are read there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from ..companions import Companion
from ..records import SweepRecord

SCHEMA = 2  # counts up whenever the meaning of a name in the manifest changes
Column = Sequence[float | None]  # of numbers, None for what is not finite
LEFT_OUT = {"left out": True}  # metadata of a key that is not there where its value is None


def as_json(value: Any) -> Any:
    """Return records as plain JSON."""
    if is_dataclass(value):
        return {
            one.name: as_json(held)
            for one in fields(value)
            if (held := getattr(value, one.name)) is not None or not one.metadata
        }
    if isinstance(value, Mapping):
        return {name: as_json(held) for name, held in value.items()}
    return list(map(as_json, value)) if isinstance(value, list | tuple) else value


@dataclass(frozen=True)
class Numbers:
    """Say how a slice's points ended, the ends of their losses, and at what share of them the gradient is zero.

    `undersampled` is the share of its cells whose loss its samples do not show, with its interval, where it is known.
    """

    points: int
    status: Mapping[str, int]
    lowest: float | None
    highest: float | None
    flat: float | None
    undersampled: Mapping[str, float | None] | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True)
class EpisodeEntry:
    """A node whose episode is shown: where it lies, in numbers of nodes and `at` which parameters, and its files."""

    row: int
    column: int
    why: str
    loss: float | None
    status: str
    at: Mapping[str, float]
    mp4: str | None = field(default=None, metadata=LEFT_OUT)
    webp: str | None = field(default=None, metadata=LEFT_OUT)

    @property
    def files(self) -> list[str]:
        """The files that there are of it."""
        return [name for name in (self.mp4, self.webp) if name]


@dataclass(frozen=True)
class Search:
    """A run that is laid over a slice: how it was made, and what became of it.

    `outside` counts the episodes beyond the map, `distance` is from the slice, the least and the most.
    """

    method: str
    seed: int
    label: str
    fidelity: str
    colour: str
    budget: int
    episodes: int
    best: float | None
    outside: int
    failed: int
    distance: tuple[float, float]
    command: str


@dataclass(frozen=True)
class Trajectory(Search):
    """A run with its points, in the order of evaluation, for the map alone.

    Of every point: where it falls, its own loss, and how large its mark is [pixels] (the smaller, the farther off the
    slice). `path` holds the points that were the best so far, `hidden` those beyond the map.
    """

    u: Column
    v: Column | None = field(metadata=LEFT_OUT)
    loss: Column
    radius: Sequence[float]
    path: Sequence[int]
    hidden: Sequence[int]

    def search(self) -> Search:
        """Return it without its points."""
        return Search(**{one.name: getattr(self, one.name) for one in fields(Search)})


@dataclass(frozen=True)
class Axis:
    """An axis of a map: its label, the coordinates of its nodes, and where it is labelled.

    Coordinates along a `logarithmic` one are decimal logarithms of values.
    """

    label: str
    values: Sequence[float]
    ticks: Sequence[float]
    logarithmic: bool = False


@dataclass(frozen=True)
class ColourScale:
    """The scale of a map's colours, or of a line's height."""

    low: float
    high: float
    logarithmic: bool
    extend: str
    ticks: Sequence[float]


@dataclass(frozen=True)
class Nodes:
    """A slice as the map draws it, row by row from the lowest v; `page_data.pack` packs its arrays.

    `loss` [unit] is packed float32, NaN where there is none, and `status` packed uint8, by the numbers of `statuses`.
    `cells` and `looks` are the same as they are drawn, where a refined slice was not sampled everywhere. `slope` is the
    gradient along the axes, `gradient` its length in all dimensions, packed float32 both. `finer` are packed flags of
    the cells between four samples whose gradients contradict their losses. `scales` are those that the map can have,
    by name, `scale` that which it begins with. `azimuth` is where the surface is seen from at first [degrees].
    """

    axes: Sequence[Axis]
    unit: str
    loss: str
    status: str
    statuses: Mapping[int, str]
    scale: str
    scales: Mapping[str, ColourScale]
    palette: Sequence[str]
    episodes: Sequence[EpisodeEntry]
    runs: Sequence[Trajectory]
    azimuth: float | None = field(default=None, metadata=LEFT_OUT)
    slope: Sequence[str] | None = field(default=None, metadata=LEFT_OUT)
    gradient: str | None = field(default=None, metadata=LEFT_OUT)
    cells: str | None = field(default=None, metadata=LEFT_OUT)
    looks: str | None = field(default=None, metadata=LEFT_OUT)
    finer: str | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True)
class Word:
    """A word that was measured, or that the paper says: `agree` is None where the paper is silent."""

    word: str
    measured: bool
    reason: str
    agree: bool | None


@dataclass(frozen=True)
class ReportEntry:
    """What `landscape report` found of a slice; `picture` says what the picture of gradient quality shows."""

    words: Sequence[Word]
    where: str
    device: str
    fidelity: str
    picture: str
    file: str


@dataclass(frozen=True)
class Interval:
    """An estimate and the ends of its interval, None where there is none."""

    value: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class SecondsEntry:
    """What an episode takes [s]."""

    forward: float
    with_gradient: float


@dataclass(frozen=True)
class VariantRow:
    """A way to simulate: how near it is to the reference, and what it takes; `front` where nothing beats it in both."""

    name: str
    front: bool
    error: Interval
    spearman: float | None
    cosine: float | None
    diverged: float | None
    seconds: SecondsEntry
    memory: float


@dataclass(frozen=True)
class ConvergenceEntry:
    """What `landscape study convergence` found, in sentences; `alt` says what its picture shows."""

    says: Sequence[str]
    converged: bool | None
    command: str
    picture: str
    file: str
    alt: str


@dataclass(frozen=True)
class FidelityEntry:
    """What `landscape study fidelity` found of an environment on a device; `alt` says what its picture shows."""

    env: str
    reference: str
    loss_unit: str
    command: str
    points: float
    spread: float | None
    refused: Sequence[Mapping[str, str]]
    options: Mapping[str, Any]
    device: str
    picture: str
    file: str
    alt: str
    variants: Sequence[VariantRow]
    convergence: ConvergenceEntry | None


@dataclass(frozen=True)
class PartRow:
    """A part of a model: how far changing it moves losses, what that costs as a ratio of times, and the verdict."""

    name: str
    change: str
    missing: bool
    error: Interval
    spearman: float | None
    cosine: float | None
    diverged: float | None
    cost: Interval
    verdict: str


@dataclass(frozen=True)
class ModelEntry:
    """What each part of an environment's model is for, on a device; `noise` is the full model's against itself."""

    env: str
    fidelity: str
    loss_unit: str
    command: str
    points: float
    spread: float | None
    device: str
    noise: float | None
    refused: Sequence[Mapping[str, str]]
    picture: str
    file: str
    alt: str
    parts: Sequence[PartRow]


@dataclass(frozen=True)
class FigureEntry:
    """A slice of the gallery, and all that its page shows.

    `changed` holds the settings of its fidelity that changed since it was sampled: what they were, and what they are.
    """

    id: str
    env: str
    paper_figure: int | None
    page: str
    dims: Sequence[int]
    labels: Sequence[str]
    through: str
    says: str
    searched: Mapping[str, Any]
    resolution: Sequence[int]
    loss_unit: str
    numbers: Numbers
    command: str
    python: str
    identity: Mapping[str, Any]
    provenance: Mapping[str, Any]
    files: Sequence[str]
    episodes: Sequence[EpisodeEntry]
    sweep: SweepRecord | None
    companions: Sequence[Companion]
    changed: Mapping[str, Sequence[Any]]
    runs: Sequence[Search]
    measures: Mapping[str, str | float]
    report: ReportEntry | None
    fidelities: Sequence[FidelityEntry]
    models: Sequence[ModelEntry]


@dataclass(frozen=True)
class WordShare:
    """A word, the share of an environment's slices that it fits, and its interval, None where there is none."""

    word: str
    share: float
    low: float | None = None
    high: float | None = None

    def said(self) -> str:
        """Say it with its share."""
        return f"{self.word} {self.share:.0%}".replace("%", "\N{NO-BREAK SPACE}%")


@dataclass(frozen=True)
class Tile:
    """An environment on the wall: the slice that is shown, and which words fit which share of how many slices.

    They are those of its `census`, with the command, the picture and the table of that, or of the gallery's own slices.
    """

    env: str
    figure: str
    page: str
    labels: Sequence[str]
    dim: int
    engine: str
    slices: int
    census: bool
    words: Sequence[WordShare]
    picture: str = ""
    table: str = ""
    command: str = ""

    def fitting(self, least: float) -> list[str]:
        """Return the words that fit such a share of the slices, or more."""
        return [one.word for one in self.words if one.share >= least]

    def best(self, among: Sequence[str], most: int = 3) -> list[WordShare]:
        """Return the words of these that fit most slices, the most frequent first, none that fits none."""
        found = [one for one in self.words if one.word in among and one.share > 0]
        return sorted(found, key=lambda one: -one.share)[:most]

    def sentence(self, among: Sequence[str]) -> str:
        """Say which words of these fit which shares of how many slices."""
        if not self.slices:
            return "not measured yet"
        said = ", ".join(one.said() for one in self.best(among)) or "none of the words"
        return f"{said} of {self.slices} slice{'s' if self.slices > 1 else ''}{'' if self.census else ' here'}"

    def share(self, word: str) -> WordShare | None:
        """Return the share of a word, None where nothing is known of it."""
        return next((one for one in self.words if one.word == word), None)


@dataclass(frozen=True)
class Manifest:
    """All of a site: its environments, its slices, those that are not sampled yet, and its files."""

    schema: int
    gradscape: str
    wall: Sequence[Tile]
    figures: Sequence[FigureEntry]
    missing: Sequence[str]
    files: Sequence[str]
