"""A slice as a lit surface, with runs draped on it (pyvista, off-screen; labels by matplotlib)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray

from ..files import replacing
from ..objective import Status
from ..plane import Plane
from ..store import plane_of
from . import page, style
from .overlay import by_kind, joint_scale
from .solids import off_screen

Runs = Sequence[xr.Dataset]
Grid = NDArray[np.float64]

SIDE, HEIGHT = 2.0, 0.9  # of the surface: the slice's window, and the scale of the losses
EYE, FOCUS, ANGLE = (-2.7, -4.0, 3.0), (0.0, 0.0, 0.26), 28.0  # of the camera; its angle [degrees]
PIXELS = (1500, 1100)
LIGHTS = (((-2.0, -1.0, 2.5), 0.75), ((2.5, -2.0, 1.5), 0.35), ((0.0, 3.0, 1.0), 0.2))  # position, strength
MATTER: dict[str, Any] = {"ambient": 0.25, "diffuse": 0.8, "specular": 0.12, "specular_power": 20}
POINT, TRAIL, BEST, LIFT = 0.016, 0.006, 0.03, 0.004  # radii of points, descents and bests; how far they lie above
FRAME, AWAY = 0.003, 0.09  # radius of the frame's lines; of labels from it


@dataclass(frozen=True, eq=False)
class Relief:
    """Say where plane coordinates and losses are: the slice's window is centred, its longer side SIDE."""

    plane: Plane
    scale: style.Scale

    def at(self, u: Grid, v: Grid, loss: Grid) -> Grid:
        """Return positions, shape (..., 3)."""
        low, high = (side.numpy() for side in self.plane.window())
        flat = SIDE * ((np.stack([u, v], axis=-1) - low) / (high - low) - 0.5)
        return np.concatenate([flat, self.height(loss)[..., None]], axis=-1)

    def height(self, loss: Grid) -> Grid:
        """Return the height of a loss, cut at both ends of the scale; NaN for none."""
        return HEIGHT * self.shade(loss)

    def shade(self, loss: Grid) -> Grid:
        """Return where a loss is on the scale, 0 to 1; NaN for none."""
        least = float(self.scale.norm.vmin or 0.0) if self.scale.logarithmic else -np.inf
        return np.clip(np.asarray(self.scale.norm(np.maximum(loss, least)), dtype=np.float64), 0.0, 1.0)


def save_surface(dataset: xr.Dataset, runs: Runs, png: str | Path, gltf: str | Path) -> None:
    """Write a slice, and runs laid over it as `overlay` does, as a picture and as a model to turn around."""
    page.save(surface_figure(dataset, runs), png)
    with _scene(dataset, runs) as (plotter, _), replacing(Path(gltf)) as partial:
        plotter.export_gltf(str(partial), inline_data=True, rotate_scene=True, save_normals=True)


def surface_figure(dataset: xr.Dataset, runs: Runs = ()) -> Figure:
    """Draw a slice as a surface whose height and colour are the loss; samples that failed are holes."""
    with _scene(dataset, runs) as (plotter, relief):
        pixels = np.asarray(plotter.screenshot(return_img=True))
        seen = _projection(plotter)
    figure = page.blank_page(8.6, 6.6)
    ax = figure.add_subplot()
    ax.imshow(pixels, interpolation="antialiased")
    ax.set_axis_off()
    page.head(figure, ax, dataset)
    _label(ax, dataset, relief, seen)
    bar = figure.colorbar(
        ScalarMappable(relief.scale.norm, style.LOSS_MAP), ax=ax, extend=relief.scale.extend, fraction=0.03, pad=0.0,
        shrink=0.7,
    )  # fmt: skip
    style.dress_bar(bar, _loss_name(dataset))
    page.key(figure, [*_entries(runs), *_holes(dataset)], columns=3)
    return figure


@contextmanager
def _scene(dataset: xr.Dataset, runs: Runs) -> Iterator[tuple[pv.Plotter, Relief]]:
    plane = plane_of(dataset)
    if plane.rank != 2:
        raise ValueError(f"a surface shows a plane; got a slice of rank {plane.rank}, so vary two parameters")
    relief = Relief(plane, joint_scale(dataset, runs))
    with off_screen(PIXELS) as plotter:
        for position, strength in LIGHTS:
            plotter.add_light(pv.Light(position=position, focal_point=FOCUS, intensity=strength))
        plotter.camera.position, plotter.camera.focal_point, plotter.camera.up = EYE, FOCUS, (0.0, 0.0, 1.0)
        plotter.camera.view_angle = ANGLE
        _add_surface(plotter, relief, dataset)
        _add_frame(plotter)
        for run in runs:
            _add_run(plotter, relief, run)
        plotter.camera.clipping_range = (0.5, 30.0)
        plotter.enable_anti_aliasing("ssaa")
        yield plotter, relief


def _add_surface(plotter: pv.Plotter, relief: Relief, dataset: xr.Dataset) -> None:
    loss = dataset["loss"].transpose("v", "u").to_numpy()
    u, v = np.meshgrid(dataset["u"].to_numpy(), dataset["v"].to_numpy())
    number = np.arange(loss.size).reshape(loss.shape)
    a, b, c, d = (p.ravel() for p in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    faces = faces[np.isfinite(loss).ravel()[faces].all(axis=1)]
    if not len(faces):
        return
    surface = pv.PolyData.from_regular_faces(np.nan_to_num(relief.at(u, v, loss)).reshape(-1, 3), faces)
    surface["color"] = style.LOSS_MAP(relief.shade(loss).ravel(), bytes=True)[:, :3]
    surface = surface.clean(point_merging=False).compute_normals(cell_normals=False, split_vertices=False)
    look = {"color": "white", "scalars": "color", "rgb": True, "smooth_shading": True, **MATTER}
    plotter.add_mesh(surface, name="surface", reset_camera=False, **look)


def _add_frame(plotter: pv.Plotter) -> None:
    a, top = SIDE / 2, HEIGHT
    floor = [(-a, -a, 0), (a, -a, 0), (a, a, 0), (-a, a, 0), (-a, -a, 0)]
    walls = [(-a, a, 0), (-a, a, top), (a, a, top), (a, a, 0)], [(a, a, top), (a, -a, top), (a, -a, 0)]
    for number, line in enumerate((floor, *walls)):
        lines = pv.lines_from_points(np.array(line, dtype=np.float64)).tube(radius=FRAME)
        plotter.add_mesh(lines, color=style.FAINT, lighting=False, name=f"frame {number}", reset_camera=False)


def _add_run(plotter: pv.Plotter, relief: Relief, run: xr.Dataset) -> None:
    """Drape a run's points on the surface, where its loss differs above or below it, and join its descents."""
    places = relief.at(*(run[name].to_numpy() for name in ("u", "v", "loss"))) + np.array([0.0, 0.0, LIFT])
    shown = ~run["outside"].to_numpy() & np.isfinite(run["loss"].to_numpy())
    label, color = run.attrs["label"], style.method(run)["color"]
    for name, here in by_kind(run):
        if (here & shown).any():
            ball = pv.Sphere(radius=POINT, theta_resolution=16, phi_resolution=16)
            points = pv.PolyData(places[here & shown]).glyph(geom=ball, scale=False, orient=False)
            look = {"color": style.KINDS[name]["color"], "smooth_shading": True, **MATTER}
            plotter.add_mesh(points, name=f"{label} {name}", reset_camera=False, **look)
    previous = run["previous"].to_numpy()
    rows = np.flatnonzero((previous >= 0) & shown & shown[previous])
    if len(rows):
        segments = np.stack([places[previous[rows]], places[rows]], axis=1).reshape(-1, 3)
        tubes = pv.line_segments_from_points(segments).tube(radius=TRAIL)
        plotter.add_mesh(tubes, color=color, name=f"{label} descents", reset_camera=False, **MATTER)
    if shown.any():
        best = places[shown][np.argmin(run["loss"].to_numpy()[shown])]
        plotter.add_mesh(pv.Sphere(radius=BEST, center=best), color=color, name=f"{label} best", reset_camera=False)


def _projection(plotter: pv.Plotter) -> Grid:
    """Return the matrix that takes positions to the picture."""
    matrix = plotter.camera.GetCompositeProjectionTransformMatrix(PIXELS[0] / PIXELS[1], -1.0, 1.0)
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])


def on_picture(seen: Grid, places: Grid) -> Grid:
    """Return where positions, shape (point, 3), are in the picture [pixel], from its upper left corner."""
    clip = np.concatenate([places, np.ones((len(places), 1))], axis=1) @ seen.T
    flat = clip[:, :2] / clip[:, 3:]
    return np.stack([(flat[:, 0] + 1) / 2 * PIXELS[0], (1 - flat[:, 1]) / 2 * PIXELS[1]], axis=1)


def _label(ax: Axes, dataset: xr.Dataset, relief: Relief, seen: Grid) -> None:
    """Write ticks and names beside the frame's two lower edges in front and the one at the right."""
    window = [side.numpy() for side in relief.plane.window()]
    norm = relief.scale.norm
    ends = [*zip(*window, strict=True), (float(norm.vmin or 0.0), float(norm.vmax or 0.0))]
    for axis, name in enumerate((*relief.plane.labels, _loss_name(dataset))):
        low, high = ends[axis]
        logarithmic = axis == 2 and relief.scale.logarithmic
        ticks = np.asarray((LogLocator(numticks=6) if logarithmic else MaxNLocator(5)).tick_values(low, high))
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        share = (ticks - low) / (high - low) if axis < 2 else relief.shade(ticks)
        spots = on_picture(seen, np.array([_beside(axis, part, AWAY) for part in share]))
        for tick, (x, y) in zip(ticks.tolist(), spots, strict=True):
            ax.text(
                x,
                y,
                style.number(tick),
                size=style.TICK,
                color=style.INK,
                ha="left" if axis == 2 else "center",
                va="center",
            )
        away = (3.2, 3.2, 8.0)[axis] * AWAY
        start, end, (x, y) = on_picture(seen, np.array([_beside(axis, part, away) for part in (0.0, 1.0, 0.5)]))
        slope = np.degrees(np.arctan2(start[1] - end[1], end[0] - start[0]))
        slope -= 180.0 * round(slope / 180.0) if abs(slope) > 90.0 + 1e-6 else 0.0
        look: dict[str, Any] = {"size": style.LABEL, "color": style.INK, "parse_math": False}
        ax.text(x, y, name, rotation=slope, rotation_mode="anchor", ha="center", va="center", **look)


def _beside(axis: int, share: float, away: float) -> tuple[float, float, float]:
    low, along = -SIDE / 2, SIDE * (share - 0.5)
    return ((along, low - away, 0.0), (low - away, along, 0.0), (-low + 0.5 * away, low, HEIGHT * share))[axis]


def _entries(runs: Runs) -> list[Artist]:
    """Return legend entries of methods and of kinds of points."""
    dot: dict[str, Any] = {"linestyle": "none", "marker": "o"}
    kinds = dict.fromkeys(name for run in runs for name, _ in by_kind(run))
    found: list[Artist] = [Line2D([], [], color=style.KINDS[name]["color"], **dot, label=name) for name in kinds]
    methods = {str(run.attrs["method"]): style.method(run)["color"] for run in runs}
    bests = [Line2D([], [], color=color, **dot, markersize=10, label=f"{m}: best") for m, color in methods.items()]
    outside = sum(int(run["outside"].sum()) for run in runs)
    beyond = [Line2D([], [], linestyle="none", label=f"beyond the slice: {outside} points")] if outside else []
    return [*found, *bests, *beyond]


def _holes(dataset: xr.Dataset) -> list[Artist]:
    status = dataset["status"].to_numpy()
    failed = int((status != Status.OK).sum())
    return [Line2D([], [], linestyle="none", label=f"holes: {failed} of {status.size} samples")] if failed else []


def _loss_name(dataset: xr.Dataset) -> str:
    unit = dataset["loss"].attrs.get("units", "")
    return f"loss [{unit}]" if unit else "loss"
