"""Runs over a slice as a rerun recording, which plays the evaluations back in three dimensions."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import xarray as xr
from matplotlib.colors import to_rgba
from numpy.typing import ArrayLike, NDArray

from ...objective import failed
from ...overlay import improvements
from ...storage.files import replacing
from .. import style
from ..figures import contour, page
from ..figures.overlay import by_kind, farthest_distance, half_widths, joint_scale
from ..figures.sweep import RATES, Scales, Sweep
from ..render import relief
from ..render.relief import HEIGHT, SIDE, Relief

Runs = Sequence[xr.Dataset]
Grid = NDArray[np.float64]

TIMELINE = "evaluation"
SURFACE, ARROWS = "landscape/surface", "landscape/descent_directions"
LIFT = 0.004  # of arrows above the surface
AWAY, UP = 2.75, 1.85  # of the eye: nearer than the picture's, whose angle is smaller
TICKS, NAMES, OVER = 0.06, 0.28, 1.12  # how far labels are from the frame; where along it the loss has its name
RADIUS, LINE, DOT = 0.015, 0.003, 0.002  # of points on the plane, of lines, of what only carries a label


def save_stream(dataset: xr.Dataset, runs: Runs, path: str | Path) -> None:
    """Write a slice with runs over it, as projected by `overlay`, as a rerun recording with its first view.

    The surface's height and colour are the loss, on one scale for the slice and the runs. A failed sample is a hole.
    Every point is at the height of its own loss, and a line joins it to the surface where the two differ. Points get
    smaller with the distance from the plane. The timeline `evaluation` shows what was known after each evaluation. The
    recording contains no clock time, so equal runs give equal recordings.
    """
    body = Relief.of(dataset, joint_scale(dataset, runs))
    arrays = [dataset["loss"], *(run[name] for run in runs for name in ("x", "loss"))]
    what = "best loss so far, log10" if body.scale.logarithmic else "best loss so far"
    curves = rrb.TimeSeriesView(name=what, origin="best", plot_legend=rrb.Corner2D.RightTop)
    panel = rrb.TimePanel(timeline=TIMELINE, play_state="following", state="collapsed")
    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    ranges = rrb.VisibleTimeRange(TIMELINE, start=start, end=end)
    blueprint = _blueprint(dataset, body, curves, panel, ranges)
    with recording(digest(arrays), Path(path), blueprint) as stream:
        _log(stream, SURFACE, _surface(body, dataset))
        if "grad" in dataset:
            _log(stream, ARROWS, _descent_arrows(body, dataset))
        _log_axes(stream, body, dataset)
        reach = farthest_distance(runs)
        for run in runs:
            _log_run(stream, body, run, reach)
            _log_best(stream, body, run)
        _log_key(stream, body, runs)
        _log(stream, "about", rr.TextDocument(_about(dataset, runs, body, reach), media_type=rr.MediaType.MARKDOWN))


def _places(body: Relief, dataset: xr.Dataset, loss: Grid | None = None) -> Grid:
    """Return the positions of a slice's or a run's points, shape (..., 3), those outside the window at its border."""
    u, v = dataset["u"].to_numpy(), dataset["v"].to_numpy()
    if loss is None:
        loss = dataset["loss"].to_numpy()
    if loss.ndim == 2:
        u, v = np.meshgrid(u, v)
    low, high = (side.numpy() for side in body.plane.cell_bounds())
    return body.at(np.clip(u, low[0], high[0]), np.clip(v, low[1], high[1]), loss)


def _log(stream: rr.RecordingStream, path: str, archetype: rr.AsComponents) -> None:
    stream.log(path, archetype, static=True, strict=True)


def _surface(body: Relief, dataset: xr.Dataset) -> rr.Mesh3D:
    """Return a slice as flat cells whose height and colour are the loss."""
    made = relief.cells(body, dataset)
    loss = dataset["loss"].transpose("v", "u").to_numpy().ravel()
    colours = style.LOSS_MAP(body.shade(loss[made.sample]), bytes=True)
    return rr.Mesh3D(
        vertex_positions=made.corners.reshape(-1, 3),
        triangle_indices=made.triangles,
        vertex_normals=np.repeat(made.normals, 4, axis=0),
        vertex_colors=np.repeat(colours, 4, axis=0),
    )


def _descent_arrows(body: Relief, dataset: xr.Dataset, scale: style.Scale | None = None) -> rr.Arrows3D:
    """Put the directions of steepest descent on the cells, coloured by the gradient's magnitude."""
    rows, columns = (contour.arrows_along(dataset, name) for name in ("v", "u"))
    at = np.ix_(rows, columns)
    logarithm = contour.log_magnitude(dataset)
    norm = (scale or style.Scale.of_magnitude(logarithm)).norm
    origins = _places(body, dataset)[at]
    flat = contour.descent(contour.slopes(dataset), body.plane)[at] * 0.8 * SIDE / max(len(rows), len(columns))
    vectors = np.concatenate([flat, np.zeros_like(flat[..., :1])], axis=-1)
    seen = np.isfinite(vectors).all(axis=-1) & np.isfinite(origins).all(axis=-1)
    return rr.Arrows3D(
        vectors=vectors[seen],
        origins=origins[seen] - vectors[seen] / 2 + [0.0, 0.0, LIFT],
        colors=style.SLOPE_MAP(norm(logarithm[at][seen]), bytes=True),
        radii=LINE,
    )


def _log_axes(stream: rr.RecordingStream, body: Relief, dataset: xr.Dataset) -> None:
    """Frame the scene, with the ticks of both parameters and of the loss."""
    frame = rr.LineStrips3D(body.frame(), colors=rgba(style.MID_GREY), radii=LINE / 2)
    _log(stream, "landscape/axes/frame", frame)
    for axis, name in enumerate((*body.plane.labels, page.loss_name(dataset))):
        ticks, share = body.ticks(axis)
        places = [body.beside(axis, part, TICKS) for part in share]
        places.append(body.beside(axis, 0.5, NAMES) if axis < 2 else body.beside(axis, OVER, TICKS))
        labels = [*(body.write(axis, tick) for tick in ticks.tolist()), name]
        points = rr.Points3D(places, labels=labels, show_labels=True, colors=rgba(style.MID_GREY), radii=DOT)
        _log(stream, f"landscape/axes/{'uvz'[axis]}", points)


def _log_key(stream: rr.RecordingStream, body: Relief, runs: Runs) -> None:
    """Label the colours of points behind the scene, in a text colour that is legible on every background."""
    shown = {name: style.POINT_MARKS[name]["color"] for run in runs for name, _ in by_kind(run)}
    if any(run["outside"].any() for run in runs):
        shown["outside"] = style.BEYOND
    if any(failed(run["status"]).any() for run in runs):
        shown["failed"] = style.LOST
    behind, left = (np.array(body.place(turn, 1.0, -relief.FOCUS)) for turn in (180.0, -90.0))
    high = np.array([0.0, 0.0, 1.25 * HEIGHT])
    places = [SIDE / 2 * behind + 0.45 * (number - 0.5) * left + high for number in range(len(shown))]
    colors = [rgba(color) for color in shown.values()]
    _log(stream, "landscape/key", rr.Points3D(places, colors=colors, radii=RADIUS))
    names = rr.Points3D(places, labels=list(shown), show_labels=True, colors=rgba(style.MID_GREY), radii=DOT)
    _log(stream, "landscape/key/names", names)


def _log_run(stream: rr.RecordingStream, body: Relief, run: xr.Dataset, reach: float) -> None:
    path, loss, outside = f"landscape/runs/{_path_of(run)}", run["loss"].to_numpy(), run["outside"].to_numpy()
    places = _places(body, run, np.nan_to_num(loss, nan=-np.inf))
    radii = RADIUS * np.sqrt(style.point_areas(run["distance"].to_numpy(), reach, 1) / style.MARK_AREAS[1])
    lost = failed(run["status"].to_numpy())
    groups = [(name, here & ~outside & ~lost, style.POINT_MARKS[name]["color"]) for name, here in by_kind(run)]
    groups += [("outside", outside & ~lost, style.BEYOND), ("failed", lost, style.LOST)]
    for name, here, color in groups:
        _log_points(stream, f"{path}/{name}", np.flatnonzero(here), places, radii, color)
    rows = np.flatnonzero(run["previous"].to_numpy() >= 0)
    steps = np.stack([places[run["previous"].to_numpy()[rows]], places[rows]], axis=1)
    _log_lines(stream, f"{path}/descents", rows, steps, style.method(run)["color"])
    _log_gaps(stream, body, run, f"{path}/gaps", places)


def _log_gaps(stream: rr.RecordingStream, body: Relief, run: xr.Dataset, path: str, places: Grid) -> None:
    """Join each point to the surface below or above it if the losses differ."""
    feet = places.copy()
    feet[:, 2] = body.height(run["beneath"].to_numpy())
    apart = np.isfinite(run["loss"].to_numpy()) & (np.abs(feet[:, 2] - places[:, 2]) > RADIUS)
    rows = np.flatnonzero(apart)
    _log_lines(stream, path, rows, np.stack([feet[rows], places[rows]], axis=1), style.MID_GREY)


def _log_best(stream: rr.RecordingStream, body: Relief, run: xr.Dataset) -> None:
    """Log the best loss so far as a curve, and the points that lowered it in the scene."""
    label, color, best = run.attrs["label"], style.method(run)["color"], run["best"].to_numpy()
    known = np.flatnonzero(np.isfinite(best))
    if not len(known):
        return
    with np.errstate(divide="ignore", invalid="ignore"):  # a run may go below the losses of a slice, and below zero
        curve = np.log10(best[known]) if body.scale.logarithmic else best[known]
    _log(stream, f"best/{_path_of(run)}", rr.SeriesLines(colors=rgba(color), names=label, widths=1.5))
    stream.send_columns(f"best/{_path_of(run)}", _times(known), rr.Scalars.columns(scalars=curve), strict=True)
    lowered, places = improvements(run), _places(body, run)
    radii = np.full(len(places), 1.6 * RADIUS)
    _log_points(stream, f"landscape/runs/{_path_of(run)}/best", lowered, places, radii, color)


def _path_of(run: xr.Dataset) -> str:
    """Return a run's label as a part of a path, which has no spaces or brackets."""
    return str(rr.escape_entity_path_part(run.attrs["label"]))


def _log_points(
    stream: rr.RecordingStream, path: str, rows: NDArray[np.intp], places: Grid, radii: Grid, color: str
) -> None:
    if len(rows):
        colors = np.tile(rgba(color), (len(rows), 1))
        columns = rr.Points3D.columns(positions=places[rows], radii=radii[rows], colors=colors)
        stream.send_columns(path, _times(rows), columns, strict=True)


def _log_lines(stream: rr.RecordingStream, path: str, rows: NDArray[np.intp], strips: Grid, color: str) -> None:
    if len(rows):
        colors, radii = np.tile(rgba(color), (len(rows), 1)), np.full(len(rows), LINE / 2)
        columns = rr.LineStrips3D.columns(strips=strips.astype(np.float32), colors=colors, radii=radii)
        stream.send_columns(path, _times(rows), columns, strict=True)


def _times(rows: NDArray[np.intp]) -> list[rr.TimeColumn]:
    """Return the evaluations after which rows are known."""
    return [rr.TimeColumn(TIMELINE, sequence=rows + 1)]


def rgba(color: str, opacity: float | None = None) -> NDArray[np.uint8]:
    """Return a colour as rerun takes it."""
    found: NDArray[np.uint8] = np.rint(255 * np.array(to_rgba(color, opacity))).astype(np.uint8)
    return found


def _blueprint(
    dataset: xr.Dataset,
    body: Relief,
    curves: rrb.TimeSeriesView,
    panel: rrb.TimePanel,
    ranges: rrb.VisibleTimeRange | None = None,
) -> rrb.Blueprint:
    """Return the layout: the scene on the left, curves and a description on the right."""
    place, focus = body.place(0.0, AWAY, UP), (0.0, 0.0, relief.FOCUS)
    eye = rrb.EyeControls3D(position=place, look_target=focus, eye_up=(0.0, 0.0, 1.0))
    space = rrb.Spatial3DView(
        name=page.title(dataset), origin="landscape", time_ranges=ranges, eye_controls=eye, line_grid=False
    )
    right = rrb.Vertical(curves, rrb.TextDocumentView(name="about", origin="about"))
    return rrb.Blueprint(rrb.Horizontal(space, right, column_shares=[2.2, 1.0]), panel, collapse_panels=True)


def _ends(scale: style.Scale) -> tuple[str, str, str]:
    """Write both ends of a scale, and what kind it is."""
    low, high = map(style.number, scale.ends)
    return low, high, "logarithmic" if scale.logarithmic else "linear"


def _about(dataset: xr.Dataset, runs: Runs, body: Relief, reach: float) -> str:
    """Describe in Markdown what the recording shows, and how it was made."""
    low, high, kind = _ends(body.scale)
    unit = dataset["loss"].attrs.get("units", "")
    distance = (
        f"Points on the plane are largest. A point {half_widths(reach)} off it has "
        f"{style.FARTHEST_SHARE**0.5:.0%} of that radius."
        if reach
        else "Every point lies on the plane."
    )
    lines = [
        f"# {page.title(dataset)}",
        f"Height and colour of the surface are the loss, from {low} to {high}{f' {unit}' if unit else ''} ({kind}). "
        f"The surface is {HEIGHT:g} high and the window {SIDE:g} wide. Losses beyond the scale are cut off. Holes are "
        "failed samples. Arrows point along steepest descent, and their colour is the gradient's magnitude.",
        "Each point is at the height of its own loss. A grey line joins it to the surface where the slice shows "
        "another loss. " + distance,
        "The colour of a point says what it was evaluated for; labels over the scene explain the colours. Failed "
        "episodes are on the floor, and points outside the window are at its border. The large points are each run's "
        "best so far.",
        "",
        "| run | episodes | failed | outside the window | best loss |",
        "|---|---|---|---|---|",
        *(_row(run) for run in runs),
        "",
        f"The plot of best losses is {'of their decimal logarithm' if body.scale.logarithmic else 'linear'}.",
        "",
        page.provenance(dataset),
    ]
    return "\n\n".join(lines[:4]) + "\n" + "\n".join(lines[4:]) + "\n"


def _row(run: xr.Dataset) -> str:
    lost = int(failed(run["status"]).sum())
    best = float(run["best"][-1]) if run.sizes["evaluation"] else float("nan")
    said = style.number(best) if np.isfinite(best) else "none"
    return f"| {run.attrs['label']} | {run.sizes['evaluation']} | {lost} | {int(run['outside'].sum())} | {said} |"


def digest(arrays: Iterable[ArrayLike], title: str = "") -> str:
    """Return a name that is equal for equal recordings."""
    content = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return hashlib.sha256(title.encode() + content).hexdigest()[:16]


@contextmanager
def recording(name: str, path: Path, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """Yield a stream to log to, and write the recording with its first view to `path` at the end.

    `name` is also that of the application, because a viewer keeps one blueprint for each. The recording contains no
    clock time, and none decides its chunks, so equal logs give equal recordings. It is collected in memory: on a full
    disk rerun's own files end in the middle without an error, and closing them waits for ever.
    """
    stream = rr.RecordingStream(
        f"gradscape-{name}", recording_id=name, send_properties=False, batcher_config=rr.ChunkBatcherConfig.NEVER()
    )
    stream.set_log_time_enabled(False)
    kept = stream.memory_recording()
    stream.send_blueprint(blueprint, make_active=False)
    yield stream
    with replacing(path) as partial:
        partial.write_bytes(kept.drain_as_bytes())


def save_sweep(sweep: Sweep, path: Path) -> None:
    """Write the slices as surfaces on a rerun timeline named after the swept value, with frames from 0."""
    scales, first = Scales.of(sweep), sweep.slices[0]
    body = Relief.of(first, scales.loss)
    arrays = [np.asarray(sweep.values), *(one["loss"].to_numpy() for one in sweep.slices)]
    hidden = rrb.PlotLegend(visible=False)
    curve = rrb.TimeSeriesView(name="lowest loss of each frame", origin="lowest", plot_legend=hidden)
    panel = rrb.TimePanel(timeline=sweep.name, state="expanded", fps=RATES[-1], loop_mode="all")
    with recording(digest(arrays), path, _blueprint(first, body, curve, panel)) as kept:
        _log_axes(kept, body, first)
        _log(kept, "about", rr.TextDocument(_about_sweep(sweep, scales.loss), media_type=rr.MediaType.MARKDOWN))
        for number, dataset in enumerate(sweep.slices):
            kept.set_time(sweep.name, sequence=number)
            kept.log(SURFACE, _surface(body, dataset), strict=True)
            if scales.slope:
                kept.log(ARROWS, _descent_arrows(body, dataset, scales.slope), strict=True)
            kept.log("landscape/value", _label(sweep, body, number), strict=True)
            if np.isfinite(dataset["loss"]).any():
                kept.log("lowest", rr.Scalars(float(dataset["loss"].min())), strict=True)


def _label(sweep: Sweep, body: Relief, number: int) -> rr.Points3D:
    place = body.place(180.0, SIDE / 2, HEIGHT)
    said = f"{sweep.name} = {sweep.write_value(sweep.values[number])}"
    return rr.Points3D([place], labels=[said], show_labels=True, colors=rgba(style.MID_GREY), radii=DOT)


def _about_sweep(sweep: Sweep, scale: style.Scale) -> str:
    low, high, kind = _ends(scale)
    lines = [
        f"# {page.title(sweep.slices[0])}\n",
        f"One surface for each value of {sweep.label}, numbered on the timeline. Height and colour are the loss, from "
        f"{low} to {high} ({kind}), on one scale for all frames. Losses beyond the scale are cut off. Holes are failed "
        "samples.\n",
        f"| frame | {sweep.name} | lowest loss | failed |",
        "|---|---|---|---|",
        *(_row_sweep(sweep, number) for number in range(len(sweep.slices))),
        "",
        page.provenance(sweep.slices[0]),
    ]
    return "\n".join(lines) + "\n"


def _row_sweep(sweep: Sweep, number: int) -> str:
    dataset = sweep.slices[number]
    least = dataset["loss"].min().item()
    said = style.number(least) if np.isfinite(least) else "none"
    lost = int(failed(dataset["status"]).sum())
    return f"| {number} | {sweep.write_value(sweep.values[number])} | {said} | {lost} |"
