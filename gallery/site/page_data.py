"""The data on a slice's page: its numbers, the nodes of its map, its films, and its searches."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from ...envs.registry import entries
from ...jobs.report import Report
from ...jobs.slice import flat_points
from ...landscapes.convert import from_json, to_json
from ...landscapes.draw.pages.nodes import EpisodeShown, Search, Trajectory, lay_runs
from ...landscapes.draw.pages.words import Word, words_of
from ...landscapes.identity import plane_of, stored_identity, stored_provenance
from ...landscapes.measures.profile import Profile
from ...landscapes.measures.slice_floor import floor_of
from ...landscapes.measures.undersampled import Undersampled
from ...landscapes.objective import NOT_EVALUATED
from ...landscapes.plane import Plane
from ...landscapes.storage.arrays import count_statuses
from ...landscapes.storage.records import read_json, reading
from ..figures import Figure
from ..files import EPISODES, REMAKE, REPORT, RUN_SUFFIX, RUNS
from ..parts import changes_since
from ..records import Companion, Node, SweepRecord, open_run, read_nodes, read_sweep, searched


@dataclass(frozen=True)
class Numbers:
    """Counts of how a slice's points ended, the range of their losses, and the share with a zero gradient.

    `undersampled` is the share of undersampled cells with its interval, where it is known. `floor` describes the
    numerical floor.
    """

    points: int
    status: Mapping[str, int]
    lowest: float | None
    highest: float | None
    flat: float | None
    undersampled: Mapping[str, float | None] | None = None
    floor: str = ""

    @property
    def spread(self) -> float:
        """The range of the losses, 0 if none is finite."""
        return 0.0 if self.lowest is None or self.highest is None else self.highest - self.lowest


@dataclass(frozen=True)
class ReportEntry:
    """The results of `landscape report` on a slice; `picture` describes the picture of gradient quality.

    `notes` list what is not resolved, and what limits every verdict.
    """

    words: Sequence[Word]
    notes: Sequence[str]
    where: str
    device: str
    fidelity: str
    picture: str
    file: str


@dataclass(frozen=True)
class FigureEntry:
    """A slice of the gallery with the contents of its page.

    `changed` maps the settings of its fidelity that changed since it was sampled to the old and the new value.
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
    sweep: SweepRecord | None
    changed: Mapping[str, Sequence[Any]]
    measures: Mapping[str, str] = field(default_factory=dict)
    files: Sequence[str] = ()
    episodes: Sequence[EpisodeShown] = ()
    companions: Sequence[Companion] = ()
    runs: Sequence[Search] = ()
    report: ReportEntry | None = None

    @classmethod
    def of(cls, figure: Figure, dataset: xr.Dataset, source: Path) -> FigureEntry:
        """Return the entry of a slice, to which other files are added later."""
        identity, provenance = stored_identity(dataset), stored_provenance(dataset)
        device = identity.get("device", "auto")
        return cls(
            id=figure.id,
            env=figure.env,
            paper_figure=figure.caption.number,
            page=f"{figure.id}/index.html",
            dims=figure.dims,
            labels=identity["plane"]["labels"],
            through=figure.through,
            says=figure.caption.says,
            searched=figure.searched,
            resolution=identity["plane"]["resolution"],
            loss_unit=provenance.get("loss_unit", ""),
            numbers=count_numbers(dataset),
            command=provenance.get("command") or figure.command(device),
            python=figure.python(device),
            identity={name: value for name, value in identity.items() if name != "plane"},
            provenance=provenance,
            sweep=read_sweep(source),
            changed=changes_since(identity),
        )

    @property
    def dim(self) -> int:
        """The number of parameters of its environment."""
        named = entries().get(self.env)
        return int(named.dim) if named and named.dim.isdigit() else len(self.identity.get("parameters", self.dims))

    @property
    def words(self) -> list[str]:
        """The measured verdict, as a list of words."""
        return [one.word for one in self.report.words if one.measured] if self.report is not None else []


def count_numbers(dataset: xr.Dataset) -> Numbers:
    """Count how the points of a slice ended, and return the range of their losses."""
    loss, status, flat = dataset["loss"].to_numpy(), dataset["status"].to_numpy(), flat_points(dataset)
    between, floor = Undersampled.of(dataset), floor_of(dataset)
    finite, evaluated = loss[np.isfinite(loss)], int(np.isin(status, NOT_EVALUATED, invert=True).sum())
    return Numbers(
        points=int(status.size),
        status=count_statuses(dataset),
        lowest=float(finite.min()) if finite.size else None,
        highest=float(finite.max()) if finite.size else None,
        flat=None if flat is None or not evaluated else flat / evaluated,
        undersampled=to_json(between.share) if between else None,
        floor=floor.sentence().removeprefix("numerical floor ") if floor else "",
    )


def read_episodes(folder: Path, dataset: xr.Dataset) -> list[EpisodeShown]:
    """Return the episodes in `episodes.json` that have a film or a picture, one for each node."""
    listed = folder / EPISODES
    if not listed.exists():
        return []
    nodes = read_nodes(listed)
    with reading(listed, REMAKE.format("episodes")):  # a node may lie beyond the slice
        shown: dict[tuple[int, int], EpisodeShown] = {}
        for node in nodes:
            place = (node.row, node.column)
            if place in shown:
                shown[place] = replace(shown[place], why=f"{shown[place].why}, {node.why}")
            else:
                shown[place] = _episode(node, folder, plane_of(dataset))
    return [episode for episode in shown.values() if episode.files]


def _episode(node: Node, folder: Path, plane: Plane) -> EpisodeShown:
    place = torch.stack([axis[at] for axis, at in zip(plane.axes(), (node.column, node.row), strict=False)])
    at = dict(zip(plane.labels, plane.to_values(place).tolist(), strict=True))
    files = [f"{node.name}.{kind}" for kind in ("mp4", "webp")]
    mp4, webp = (name if (folder / name).exists() else None for name in files)
    return EpisodeShown(**vars(node), at=at, mp4=mp4, webp=webp)


def read_report(folder: Path) -> Report | None:
    """Return the report of a slice, or None if there is none."""
    if not (folder / REPORT).exists():
        return None
    with reading(folder / REPORT, REMAKE.format("reports")):
        return from_json(Report, read_json(folder / REPORT))


def enter_report(report: Report) -> ReportEntry:
    """Return the part of a report that a page shows."""
    where = report.paper.where if report.paper else ""
    verdict, picture = report.profile.verdict, _describe_quality(report.profile)
    notes = (*verdict.open, *verdict.lines)
    return ReportEntry(
        words_of(verdict, report.paper.words if report.paper else ()),
        notes,
        where,
        report.device,
        report.fidelity,
        picture,
        REPORT,
    )


def _describe_quality(profile: Profile) -> str:
    """Describe the picture of gradient quality."""
    following = profile.verdict.following
    parts = [following.sentence] if following is not None and following.scales else []
    for row in profile.smoothing:
        if math.isfinite(row.biased.value):
            biased = round(row.biased.value * row.points)
            parts.append(f"smoothed over {row.width:.0%} of the box, first order is biased at {biased} of {row.points}")
    return "Gradient quality over the slice: " + ("; ".join(parts) or "no slope above the noise")


def quality_rows(profile: Profile) -> list[dict[str, Any]]:
    """Return the data by scale behind the picture of gradient quality, a row for each scale of its three parts."""
    parts = ("differences", "differences_of_samples", "smoothing")
    return [{"part": part.replace("_", " "), **to_json(row)} for part in parts for row in getattr(profile, part)]


def read_runs(data: Path) -> list[xr.Dataset]:
    """Return every run in the gallery's data that has at least one episode."""
    tables = [open_run(file) for file in sorted((data / RUNS).glob(f"*/*{RUN_SUFFIX}"))]
    return [table for table in tables if table.sizes["evaluation"]]


def lay_own(dataset: xr.Dataset, tables: Sequence[xr.Dataset]) -> list[Trajectory]:
    """Project the runs of a slice's environment and options onto it, the lowest loss first."""
    return lay_runs(dataset, [one for one in tables if searched(stored_identity(one), stored_identity(dataset))])
