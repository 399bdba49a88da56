"""A sweep as a rerun recording: the surfaces of its slices on a timeline."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from ...objective import failed
from .. import style
from ..figures import page
from ..figures.sweep import RATES, Scales, Sweep
from ..render.relief import HEIGHT, SIDE
from . import runs as stream
from .recording import recording


def save_stream(sweep: Sweep, path: Path) -> None:
    """Write the slices as surfaces on a rerun timeline named after what moves, numbered like the frames from 0."""
    scales, first = Scales.of(sweep), sweep.slices[0]
    scene = stream.Scene.of(first, [], scales.loss)
    with recording(_digest(sweep), path, _blueprint(sweep, scene)) as kept:
        stream.log_axes(kept, scene, first)
        about = rr.TextDocument(_about(sweep, scales), media_type=rr.MediaType.MARKDOWN)
        kept.log("about", about, static=True, strict=True)
        for number, dataset in enumerate(sweep.slices):
            kept.set_time(sweep.name, sequence=number)
            kept.log(stream.SURFACE, stream.surface(scene, dataset), strict=True)
            if scales.slope:
                kept.log(stream.ARROWS, stream.descent_arrows(scene, dataset, scales.slope), strict=True)
            kept.log("landscape/value", _label(sweep, scene, number), strict=True)
            if np.isfinite(dataset["loss"]).any():
                kept.log("lowest", rr.Scalars(float(dataset["loss"].min())), strict=True)


def _label(sweep: Sweep, scene: stream.Scene, number: int) -> rr.Points3D:
    place = scene.stand.place(180.0, SIDE / 2, HEIGHT)
    said = f"{sweep.name} = {sweep.write_value(sweep.values[number])}"
    return rr.Points3D([place], labels=[said], show_labels=True, colors=stream.rgba(style.MID_GREY), radii=stream.DOT)


def _blueprint(sweep: Sweep, scene: stream.Scene) -> rrb.Blueprint:
    space = rrb.Spatial3DView(
        name=page.title(sweep.slices[0]), origin="landscape", eye_controls=scene.eye, line_grid=False
    )
    curve = rrb.TimeSeriesView(
        name="lowest loss of each frame", origin="lowest", plot_legend=rrb.PlotLegend(visible=False)
    )
    about = rrb.TextDocumentView(name="about", origin="about")
    return rrb.Blueprint(
        rrb.Horizontal(space, rrb.Vertical(curve, about), column_shares=[2.2, 1.0]),
        rrb.TimePanel(timeline=sweep.name, state="expanded", fps=RATES[-1], loop_mode="all"),
        collapse_panels=True,
    )


def _about(sweep: Sweep, scales: Scales) -> str:
    """Say in Markdown what is to be seen, and where it comes from."""
    low, high = map(style.number, scales.loss.ends)
    kind = "logarithmic" if scales.loss.logarithmic else "linear"
    lines = [
        f"# {page.title(sweep.slices[0])}\n",
        f"One surface for each value of {sweep.label}, by number on the timeline. Height and colour: loss from {low} "
        f"to {high}, {kind}, the same in all frames; beyond it the surface is cut off. Holes failed.\n",
        f"| frame | {sweep.name} | lowest loss | failed |",
        "|---|---|---|---|",
        *(_row(sweep, number) for number in range(len(sweep.slices))),
        "",
        page.provenance(sweep.slices[0]),
    ]
    return "\n".join(lines) + "\n"


def _row(sweep: Sweep, number: int) -> str:
    dataset = sweep.slices[number]
    least = dataset["loss"].min().item()
    said = style.number(least) if np.isfinite(least) else "none"
    lost = int(failed(dataset["status"]).sum())
    return f"| {number} | {sweep.write_value(sweep.values[number])} | {said} | {lost} |"


def _digest(sweep: Sweep) -> str:
    """Return a name that equal recordings share."""
    arrays: list[NDArray[np.float64]] = [np.asarray(sweep.values), *(one["loss"].to_numpy() for one in sweep.slices)]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()[:16]
