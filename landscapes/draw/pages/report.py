"""A report about a landscape in one file, which anyone can open and send; it needs no network."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import xarray as xr

from ...convert import to_json
from ...identity import plane_of, stored_identity, stored_provenance
from ...measures.profile import Profile
from ...measures.verdict import QuotedWord
from ...storage.arrays import count_statuses, parameters_of
from .nodes import EpisodeShown, Trajectory, lay_runs, read_off_nodes
from .rendering import STATIC, STYLE, scripts, templates
from .words import words_of

if TYPE_CHECKING:
    from ...checks.diagnosis import Diagnosis
    from ...checks.finding import Finding
    from ...measures.gradient_quality import ScaleRow

MOST_NODES = 90_000  # of the map: with losses and gradients they take 2 MB
WIDTH, HEIGHT = 400, 220  # of the curve of usefulness [pixels]
LEFT, RIGHT, TOP, BOTTOM = 34, 26, 10, 38
WORD_FOR_NONE = "no verdict is resolved"
DOWNLOAD = "download.js"


@dataclass(frozen=True)
class CheckShown:
    """The results of a check: whether all passed, the diagnoses, and each finding."""

    passed: bool
    diagnoses: Sequence[Diagnosis]
    findings: Sequence[Finding]


@dataclass(frozen=True)
class Mark:
    """A point of the curve of usefulness [pixels], and its text."""

    x: float
    y: float
    low: float
    high: float
    width: str
    said: str


@dataclass(frozen=True)
class Curve:
    """How gradients follow differences, by the width of the difference: marks and ticks of the axes [pixels]."""

    marks: Sequence[Mark]
    across: Sequence[tuple[float, str]]
    up: Sequence[tuple[float, str]]


def report_page(
    dataset: xr.Dataset,
    profile: Profile,
    *,
    title: str,
    record: Mapping[str, Any],
    picture: bytes,
    quoted: Sequence[QuotedWord] = (),
    where: str = "",
    runs: Sequence[xr.Dataset] = (),
    episodes: Sequence[EpisodeShown] = (),
    check: CheckShown | None = None,
    floor: xr.Dataset | None = None,
) -> str:
    """Return a self-contained page about a slice and its measures.

    `record` is the JSON that the page offers, and `picture` a PNG of the slice for print. `quoted` is the verdict of
    somebody else, and `where` its source. `runs` are drawn over the map. Films and pictures of `episodes` are data
    links. A slice with more than `MOST_NODES` samples is thinned for the map, and the page says so.
    """
    stride = _stride(dataset)
    shown = _every(dataset, stride)
    laid = lay_runs(shown, runs)
    nodes = read_off_nodes(shown, [] if stride > 1 else episodes, laid, None if stride > 1 else floor)
    page = templates().get_template("report.html")
    return page.render(
        **shown_of(dataset, profile, nodes, quoted=quoted, where=where),
        entry=_entry(dataset, title, laid, episodes),
        stride=stride,
        check=check,
        still=data_link(picture, "image/png"),
        nodes=inert(nodes),
        record=inert(record),
        style=(STATIC / STYLE).read_text(encoding="utf-8"),
        scripts=[(STATIC / name).read_text(encoding="utf-8") for name in (*scripts(len(shown.loss.dims)), DOWNLOAD)],
    )


def shown_of(
    dataset: xr.Dataset,
    profile: Profile | None,
    nodes: Mapping[str, Any],
    *,
    quoted: Sequence[QuotedWord] = (),
    where: str = "",
) -> dict[str, Any]:
    """Return the texts of a page: about the slice, how it was made, and its measures if there are any."""
    provenance = stored_provenance(dataset)
    return {
        "plane": plane_of(dataset).rank == 2,
        "status": count_statuses(dataset),
        "held": list(held_parameters(dataset)),
        "provenance": provenance,
        "command": provenance.get("command", ""),
        "finer": nodes["finer"] is not None,
        "deviates": nodes["floor"] is not None,
        "sentence": sentence(profile) if profile else "",
        "words": words_of(profile.verdict, quoted) if profile else (),
        "notes": (*profile.verdict.open, *profile.verdict.lines) if profile else (),
        "where": where,
        "measures": profile.measures if profile else {},
        "curve": curve_of(profile.differences) if profile else None,
    }


def _entry(
    dataset: xr.Dataset, title: str, laid: Sequence[Trajectory], episodes: Sequence[EpisodeShown]
) -> dict[str, Any]:
    """Return the entry that the map of a slice's page shows."""
    identity = stored_identity(dataset)
    return {
        "id": title,
        "env": identity["objective"],
        "labels": identity["plane"]["labels"],
        "resolution": identity["plane"]["resolution"],
        "identity": identity,
        "loss_unit": stored_provenance(dataset).get("loss_unit", ""),
        "episodes": episodes,
        "runs": [run.search() for run in laid],
    }


def sentence(profile: Profile) -> str:
    """Return the verdict as a sentence: the measured words, or that none is resolved."""
    said = ", ".join(profile.words) or WORD_FOR_NONE
    return f"{said[0].upper()}{said[1:]}."


def data_link(data: bytes, kind: str) -> str:
    """Return a data link with a file of a media type."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def held_parameters(dataset: xr.Dataset) -> Iterator[tuple[str, float, str]]:
    """Yield the parameters that a slice does not vary: name, value and unit."""
    plane = plane_of(dataset)
    varied = plane.basis.any(dim=0).tolist()
    for (name, unit), value, varies in zip(parameters_of(dataset), plane.origin.tolist(), varied, strict=True):
        if not varies:
            yield name, value, unit


def curve_of(rows: Sequence[ScaleRow]) -> Curve | None:
    """Return the curve of usefulness, or None if nothing was compared."""
    known = [row for row in rows if math.isfinite(row.cosine.value)]
    if not known:
        return None
    first, last = (math.log10(end) for end in (known[0].scale, known[-1].scale))

    def across(scale: float) -> float:
        part = (math.log10(scale) - first) / (last - first) if last > first else 0.5
        return round(LEFT + part * (WIDTH - LEFT - RIGHT), 1)

    def up(cosine: float) -> float:
        return round(TOP + (1 - cosine) / 2 * (HEIGHT - TOP - BOTTOM), 1)

    marks = [
        Mark(across(row.scale), up(row.cosine.value), up(_or(row.cosine.low, row.cosine.value)),
             up(_or(row.cosine.high, row.cosine.value)), f"{100 * row.scale:g} %", _said(row))
        for row in known
    ]  # fmt: skip
    ticks = [(mark.x, mark.width) for mark in marks]
    return Curve(
        marks, ticks, [(up(value), f"{value:g}".replace("-", "\N{MINUS SIGN}")) for value in (-1, -0.5, 0, 0.5, 1)]
    )


def _said(row: ScaleRow) -> str:
    value, low, high = (f"{one:z.2f}".replace("-", "\N{MINUS SIGN}") for one in
                        (row.cosine.value, row.cosine.low, row.cosine.high))  # fmt: skip
    interval = f" ({low} to {high})" if math.isfinite(row.cosine.low) else ""
    return f"{value}{interval} at {row.points} points"


def _or(value: float, other: float) -> float:
    return value if math.isfinite(value) else other


def _stride(dataset: xr.Dataset) -> int:
    """Return the step in samples between neighbours on the map, along each axis."""
    rank, size = dataset["loss"].ndim, dataset["loss"].size
    return math.ceil((size / MOST_NODES) ** (1 / rank)) if size > MOST_NODES else 1


def _every(dataset: xr.Dataset, stride: int) -> xr.Dataset:
    """Return every `stride`-th sample of a slice along each axis, as a slice of that resolution."""
    if stride == 1:
        return dataset
    plane, identity = plane_of(dataset), stored_identity(dataset)
    dims = ("u", "v")[: plane.rank]
    thin = dataset.isel({dim: slice(None, None, stride) for dim in dims})
    ends = [axis[stride * (thin.sizes[dim] - 1)] for axis, dim in zip(plane.axes(), dims, strict=True)]
    upper = plane.upper.new_tensor([float(end) for end in ends])
    coarse = replace(plane, upper=upper, resolution=tuple(thin.sizes[dim] for dim in dims))
    return thin.assign_attrs(identity=json.dumps({**identity, "plane": coarse.record()}))


def inert(value: Any) -> str:
    """Return a value as JSON in which no text can end the surrounding script."""
    text = json.dumps(to_json(value), separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
