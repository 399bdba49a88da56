"""What a page needs of a slice: its numbers, its nodes for the map to hover over, its films, and its searches."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from ...envs.registry import entries
from ...jobs.report import Report
from ...jobs.slice import count_statuses, flat_points
from ...landscapes.convert import from_json, to_json
from ...landscapes.identity import plane_of, stored_identity, stored_provenance
from ...landscapes.lattice import own_cells
from ...landscapes.measures.profile import Profile
from ...landscapes.measures.slice_floor import floor_of
from ...landscapes.measures.undersampled import Undersampled, contradicted_cells
from ...landscapes.measures.verdict import WORDS
from ...landscapes.objective import NOT_EVALUATED, Status, failed
from ...landscapes.overlay import improvements, lay
from ...landscapes.plain import number
from ...landscapes.plane import Plane
from ...landscapes.space import LOG10
from ...landscapes.storage.records import read_json, reading
from ..figures import Figure
from ..files import EPISODE_KINDS, EPISODES, MEASURES, REMAKE, REPORT, RUN_SUFFIX, RUNS
from ..parts import changes_since
from ..records import Companion, Node, SweepRecord, open_run, read_nodes, read_sweep, searched

LINEAR, LOGARITHMIC = "linear", "logarithmic"
Column = Sequence[float | None]  # of numbers, None for what is not finite


@dataclass(frozen=True)
class Numbers:
    """Say how a slice's points ended, the ends of their losses, and at what share of them the gradient is zero.

    `undersampled` is the share of its cells whose loss its samples do not show, with its interval, where it is known;
    `floor` is its numerical floor in words.
    """

    points: int
    status: Mapping[str, int]
    lowest: float | None
    highest: float | None
    flat: float | None
    undersampled: Mapping[str, float | None] | None = None
    floor: str = ""


@dataclass(frozen=True)
class EpisodeEntry(Node):
    """A node whose episode is shown, `at` which parameters it lies, and the files that there are of it."""

    at: Mapping[str, float]
    mp4: str | None = None
    webp: str | None = None

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
    v: Column | None
    loss: Column
    radius: Sequence[float]
    path: Sequence[int]
    hidden: Sequence[int]

    def search(self) -> Search:
        """Return it without its points."""
        return Search(**{one.name: getattr(self, one.name) for one in fields(Search)})


@dataclass(frozen=True)
class Word:
    """A word that was measured, or that the `paper` says; `measured` is None where that is not resolved."""

    word: str
    measured: bool | None
    reason: str
    paper: bool

    @property
    def comparison(self) -> str:
        """How the paper's word compares."""
        if not self.paper:
            return "says nothing of it"
        return {True: "agrees", False: "disagrees: it says so", None: "says so"}[self.measured]


@dataclass(frozen=True)
class ReportEntry:
    """What `landscape report` found of a slice; `picture` says what the picture of gradient quality shows.

    `notes` say what is not resolved, and what limits every word.
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
    sweep: SweepRecord | None
    changed: Mapping[str, Sequence[Any]]
    measures: Mapping[str, str | float]
    files: Sequence[str] = ()
    episodes: Sequence[EpisodeEntry] = ()
    companions: Sequence[Companion] = ()
    runs: Sequence[Search] = ()
    report: ReportEntry | None = None

    @classmethod
    def of(cls, figure: Figure, dataset: xr.Dataset, source: Path) -> FigureEntry:
        """Return the entry of a slice; its other files are added later."""
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
            measures=read_measures(source),
        )

    @property
    def dim(self) -> int:
        """How many parameters its environment has."""
        named = entries().get(self.env)
        return int(named.dim) if named and named.dim.isdigit() else len(self.identity.get("parameters", self.dims))

    @property
    def words(self) -> list[str]:
        """The words that were measured of it."""
        return [one.word for one in self.report.words if one.measured] if self.report is not None else []


def count_numbers(dataset: xr.Dataset) -> Numbers:
    """Count how the points of a slice ended, and find the range of their losses."""
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


def read_off_nodes(dataset: xr.Dataset, episodes: Sequence[EpisodeEntry], runs: Sequence[Trajectory]) -> dict[str, Any]:
    """Read off a slice what the map draws and says of its nodes, as JSON for its script.

    Nodes go row by row from the lowest v; arrays are packed, see `pack`. `loss` [unit] is float32, NaN where there is
    none, and `status` uint8, by the numbers of `statuses`. `cells` and `looks` are the same as they are drawn, where a
    refined slice was not sampled everywhere. `slope` is the gradient along the axes, `gradient` its length in all
    dimensions, float32 both. `finer` are flags of the cells between four samples whose gradients contradict their
    losses. `scales` are those that the map can have, by name, `scale` that which it begins with. `azimuth` is where the
    surface is seen from at first [degrees].
    """
    from ...landscapes.draw.render.relief import Relief, azimuth
    from ...landscapes.draw.style import LOSS_MAP, Scale

    plane, loss = plane_of(dataset), dataset["loss"].to_numpy()
    own, flat = Scale.of_loss(loss), plane.rank == 2
    skipped = flat and bool((dataset["status"] == Status.INTERPOLATED).any())
    drawn = own_cells(dataset) if skipped else None
    grad = torch.from_numpy(dataset["grad"].to_numpy().reshape(loss.size, -1)) if "grad" in dataset else None
    finer = contradicted_cells(dataset) if flat and grad is not None else np.zeros(0)
    found = {
        "axes": _axes(plane),
        "unit": str(dataset["loss"].attrs.get("units", "")),
        "loss": pack(loss),
        "status": pack(dataset["status"].to_numpy(), "u1"),
        "statuses": {int(code): code.name for code in Status},
        "scale": LOGARITHMIC if own.logarithmic and flat else LINEAR,
        "scales": _scales(loss, [run.best for run in runs if run.best is not None]),
        "palette": [bytes(round(255 * part) for part in LOSS_MAP(level)[:3]).hex() for level in range(256)],
        "episodes": episodes,
        "runs": runs,
        "azimuth": azimuth(Relief(plane, own), dataset) if flat else None,
        "slope": None if grad is None else [pack(column) for column in plane.slope(grad).numpy().T],
        "gradient": None if grad is None else pack(np.linalg.norm(grad.numpy(), axis=1)),
        "cells": None if drawn is None else pack(drawn["loss"].to_numpy()),
        "looks": None if drawn is None else pack(drawn["status"].to_numpy(), "u1"),
        "finer": pack(finer, "u1") if finer.any() else None,
    }
    return dict(to_json(found))


def pack(values: np.ndarray[Any, Any], kind: str = "f4") -> str:
    """Return an array, in its own order, as little-endian numbers in base64: a browser decodes it once."""
    return base64.b64encode(values.astype(f"<{kind}").tobytes()).decode()


def _axes(plane: Plane) -> list[dict[str, Any]]:
    """Return the axes of a map: coordinates of nodes, where they are labelled, both logarithms on a logarithmic one."""
    from ...landscapes.draw.style import decades, round_values

    found = []
    for label, places, scale in zip(plane.labels, (axis.tolist() for axis in plane.axes()), plane.scales, strict=True):
        ticks = (decades if scale == LOG10 else round_values)(places[0], places[-1])
        found.append({"label": label, "values": places, "ticks": ticks, "logarithmic": scale == LOG10})
    return found


def _scales(loss: np.ndarray[Any, Any], below: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Return the scales that a map's colours can have, or a line's height, which goes down to what lies below.

    A logarithmic one is there where all losses are positive.
    """
    from ...landscapes.draw.style import Scale

    scale, finite = Scale.of_loss(loss), loss[np.isfinite(loss)]
    low, high = scale.ends
    found = {LINEAR: Scale.between(low, high, extend=scale.extend)}
    if loss.ndim == 1 and finite.size:
        low, high = min([float(finite.min()), *below]), float(finite.max())
        room = 0.04 * (high - low) or 0.5
        found = {LINEAR: Scale.between(low - room, high + room)}
    if finite.size and 0 < low < high and finite.min() > 0:
        found[LOGARITHMIC] = Scale.between(low, high, logarithmic=True, extend=scale.extend)
    names = ("low", "high", "logarithmic", "extend", "ticks")
    return {
        name: dict(zip(names, (*one.ends, one.logarithmic, one.extend, one.ticks()), strict=True))
        for name, one in found.items()
    }


def read_episodes(folder: Path, dataset: xr.Dataset) -> list[EpisodeEntry]:
    """Return the episodes that `episodes.json` lists and that have a film or a picture, one a node."""
    listed = folder / EPISODES
    if not listed.exists():
        return []
    nodes = read_nodes(listed)
    with reading(listed, REMAKE.format("episodes")):  # a node may lie beyond the slice
        shown: dict[tuple[int, int], EpisodeEntry] = {}
        for node in nodes:
            place = (node.row, node.column)
            if place in shown:
                shown[place] = replace(shown[place], why=f"{shown[place].why}, {node.why}")
            else:
                shown[place] = _episode(node, folder, plane_of(dataset))
    return [episode for episode in shown.values() if episode.files]


def _episode(node: Node, folder: Path, plane: Plane) -> EpisodeEntry:
    place = torch.stack([axis[at] for axis, at in zip(plane.axes(), (node.column, node.row), strict=False)])
    at = dict(zip(plane.labels, plane.to_values(place).tolist(), strict=True))
    files = {kind: f"{node.name}.{kind}" for kind in EPISODE_KINDS}
    there = {kind: name for kind, name in files.items() if (folder / name).exists()}
    return EpisodeEntry(node.row, node.column, node.why, node.loss, node.status, at, **there)


def read_report(folder: Path) -> Report | None:
    """Return what `landscape report` found of a slice, None where there is no report."""
    if not (folder / REPORT).exists():
        return None
    with reading(folder / REPORT, REMAKE.format("reports")):
        return from_json(Report, read_json(folder / REPORT))


def enter_report(report: Report) -> ReportEntry:
    """Return what a page shows of a report."""
    where = report.paper.where if report.paper else ""
    verdict, picture = report.profile.verdict, _describe_quality(report.profile)
    notes = (*verdict.open, *verdict.lines)
    return ReportEntry(_words(report), notes, where, report.device, report.fidelity, picture, REPORT)


def _words(report: Report) -> list[Word]:
    """Return every word that was measured or that the paper says."""
    reasons = report.profile.verdict.reasons
    paper = {one.word: one.measured for one in report.paper.words} if report.paper else {}
    return [
        Word(word, word in reasons or paper.get(word, False), reasons.get(word, ""), word in paper)
        for word in WORDS
        if word in reasons or word in paper
    ]


def _describe_quality(profile: Profile) -> str:
    """Say what the picture of gradient quality shows."""
    following = profile.verdict.following
    parts = [following.sentence] if following is not None and following.scales else []
    for row in profile.smoothing:
        if math.isfinite(row.biased.value):
            biased = round(row.biased.value * row.points)
            parts.append(f"smoothed over {row.width:.0%} of it, first order is biased at {biased} of {row.points}")
    return "Gradient quality over the slice: " + ("; ".join(parts) or "no slope above the noise")


def quality_rows(profile: Profile) -> list[dict[str, Any]]:
    """Return what the picture of gradient quality shows by scale, a row for each scale of each of its three parts."""
    parts = ("differences", "differences_of_samples", "smoothing")
    return [{"part": part.replace("_", " "), **to_json(row)} for part in parts for row in getattr(profile, part)]


def read_measures(folder: Path) -> dict[str, str | float]:
    """Return the numbers of a slice's report by their names, none where there is no report."""
    path = folder / MEASURES
    if not path.exists():
        return {}
    with reading(path, REMAKE.format("reports")):
        return {name: value if isinstance(value, str) else number(value) for name, value in read_json(path).items()}


def round_off(values: np.ndarray[Any, Any]) -> list[float | None]:
    """Return numbers to six digits, None for what is not finite."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]


def read_runs(data: Path) -> list[xr.Dataset]:
    """Return every run that `save_run` left in the gallery's data and that has an episode."""
    tables = [open_run(file) for file in sorted((data / RUNS).glob(f"*/*{RUN_SUFFIX}"))]
    return [table for table in tables if table.sizes["evaluation"]]


def lay_runs(dataset: xr.Dataset, tables: Sequence[xr.Dataset]) -> list[Trajectory]:
    """Lay the runs of a slice's environment and options over it, the least loss first."""
    from ...landscapes.draw.figures.overlay import farthest_distance

    own = [table for table in tables if searched(stored_identity(table), stored_identity(dataset))]
    runs = [lay(dataset, table, f"{table.attrs['method']}, seed {table.attrs['seed']}") for table in own]
    reach = farthest_distance(runs)
    points = sum(run.sizes["evaluation"] for run in runs)
    top = math.inf if "v" in dataset.dims else float(dataset["loss"].max())  # of what a line's map shows
    laid = [_trajectory(run, reach, points, top) for run in runs]
    return sorted(laid, key=lambda run: math.inf if run.best is None else run.best)


def _trajectory(run: xr.Dataset, reach: float, points: int, top: float) -> Trajectory:
    from ...landscapes.draw.style import method, point_areas

    loss, distance = run["loss"].to_numpy(), run["distance"].to_numpy()
    outside = run["outside"].to_numpy() | (loss > top)
    lost = failed(run["status"].to_numpy())
    radius = np.sqrt(point_areas(distance, reach, points) / np.pi) * 4 / 3  # a point is 4/3 of a pixel
    return Trajectory(
        **{name: run.attrs[name] for name in ("method", "seed", "label", "fidelity", "budget")},
        colour=method(run)["color"],
        episodes=run.sizes["evaluation"],
        best=float(np.nanmin(loss)) if np.isfinite(loss).any() else None,
        outside=int(outside.sum()),
        failed=int(lost.sum()),
        distance=(float(distance.min()), float(distance.max())),
        command=stored_provenance(run).get("command", ""),
        u=round_off(run["u"].to_numpy()),
        v=round_off(run["v"].to_numpy()) if "v" in run else None,
        loss=round_off(loss),
        radius=[round(float(size), 1) for size in radius],
        path=improvements(run).tolist(),
        hidden=np.flatnonzero(outside).tolist(),
    )
