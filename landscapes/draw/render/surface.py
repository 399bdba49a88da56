"""A slice as a lit surface of flat cells, with runs on it (pyvista, off-screen; labels by matplotlib)."""

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
from numpy.typing import NDArray

from ...identity import plane_of
from ...lattice import own_cells
from ...objective import has_loss
from ...storage.files import replacing
from .. import style
from ..figures import page
from ..figures.overlay import by_kind, joint_scale
from . import relief
from .relief import FOCUS, HEIGHT, SIDE, Relief
from .solids import off_screen

Runs = Sequence[xr.Dataset]
Grid = NDArray[np.float64]

PITCH = 8.6  # of the page on a screen [inch]
PIXELS, FINE = (1500, 1100), 300  # of the picture; in print, so many per inch where that is more
ANGLE = 28.0  # of the camera [degrees]
LIGHTS = (((-100.0, 2.0, 4.0), 0.85), ((60.0, 3.2, 1.2), 0.35))  # from the eye's azimuth, away and up; strength
MATTER: dict[str, Any] = {"ambient": 0.3, "diffuse": 0.78, "specular": 0.0}
POINT, TRAIL, BEST, LIFT = 0.016, 0.006, 0.03, 0.004  # radii of points, descents and bests; how far they lie above
FRAME = 0.003  # radius of its lines
AWAY, OUT = (0.09, 0.09, 0.04), (0.31, 0.31, 0.28)  # of ticks and of names from the frame, for each axis
ROOM = 0.02  # about the frame, in the picture


@dataclass(frozen=True, eq=False)
class Shown:
    """A scene that is ready to be drawn at a size in pixels."""

    plotter: pv.Plotter
    relief: Relief
    pixels: tuple[int, int]
    projection: Grid  # the matrix that takes positions to the picture

    def on_picture(self, places: Grid) -> Grid:
        """Return the picture coordinates [pixel] of positions, shape (point, 3), from the upper left corner."""
        clip = np.concatenate([places, np.ones((len(places), 1))], axis=1) @ self.projection.T
        flat = clip[:, :2] / clip[:, 3:]
        return np.stack([flat[:, 0] + 1, 1 - flat[:, 1]], axis=1) / 2 * self.pixels


def save_surface(dataset: xr.Dataset, runs: Runs, png: str | Path, gltf: str | Path) -> None:
    """Write a slice with runs over it, as projected by `overlay`, as a picture and as a glTF model to turn.

    The first view of the model is that of the picture: in glTF y points up and z points to the viewer.

    Raises ValueError if the slice is a line.
    """
    page.save(surface_figure(dataset, runs), png)
    with scene(dataset, runs) as shown, replacing(Path(gltf)) as partial:
        for actor in shown.plotter.actors.values():
            actor.rotate_x(-90.0)  # after what follows
            actor.rotate_z(-90.0 - shown.relief.azimuth)
        camera = shown.plotter.camera
        camera.position, camera.focal_point = (0.0, FOCUS + relief.UP, relief.AWAY), (0.0, FOCUS, 0.0)
        camera.up = (0.0, 1.0, 0.0)
        shown.plotter.export_gltf(str(partial), inline_data=True, rotate_scene=False, save_normals=True)


def surface_figure(dataset: xr.Dataset, runs: Runs = (), *, width: float | None = None) -> page.Picture:
    """Draw a slice as a body whose height and colour are the loss: samples are flat, failed ones are holes.

    It is seen from the one of eight sides that shows most of the valley, the lowest tenth of the losses.

    Raises ValueError if the slice is a line, or if the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH)
    fine = max(1.0, FINE * sheet.width / PIXELS[0]) if width else 1.0
    picture, (ax,) = page.panels(sheet, 1)
    with scene(dataset, runs, pixels=(round(fine * PIXELS[0]), round(fine * PIXELS[1]))) as shown:
        ax.imshow(np.asarray(shown.plotter.screenshot(return_img=True)), interpolation="antialiased", aspect="auto")
        _crop(ax, shown)
        _label(ax, dataset, shown)
    page.head(picture, ax, dataset)
    scale = shown.relief.scale
    shown_scale = ScalarMappable(scale.norm, style.LOSS_MAP)
    page.colour_bar(ax, shown_scale, page.loss_name(dataset), scale, fraction=0.03, shrink=0.8)
    page.finish(picture, [*_signs(sheet, runs), *_holes(dataset)], columns=3)
    return picture


@contextmanager
def scene(dataset: xr.Dataset, runs: Runs, *, pixels: tuple[int, int] = PIXELS) -> Iterator[Shown]:
    """Yield the scene of a slice with runs over it.

    Raises ValueError if the slice is a line.
    """
    plane = plane_of(dataset)
    if plane.rank != 2:
        raise ValueError(f"a surface shows a plane; got a slice of rank {plane.rank}, so vary two parameters")
    body = Relief.of(dataset, joint_scale(dataset, runs))
    with off_screen(pixels) as plotter:
        focus = (0.0, 0.0, FOCUS)
        for (turn, away, up), strength in LIGHTS:
            plotter.add_light(pv.Light(position=body.place(turn, away, up), focal_point=focus, intensity=strength))
        plotter.camera.position, plotter.camera.focal_point = body.place(0.0, relief.AWAY, relief.UP), focus
        plotter.camera.up, plotter.camera.view_angle = (0.0, 0.0, 1.0), ANGLE
        _add_surface(plotter, body, dataset)
        _add_frame(plotter, body)
        for run in runs:
            _add_run(plotter, body, run)
        plotter.camera.clipping_range = (0.5, 30.0)
        plotter.enable_anti_aliasing("ssaa")
        yield Shown(plotter, body, pixels, _projection(plotter, pixels))


def _projection(plotter: pv.Plotter, pixels: tuple[int, int]) -> Grid:
    matrix = plotter.camera.GetCompositeProjectionTransformMatrix(pixels[0] / pixels[1], -1.0, 1.0)
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])


def _add_surface(plotter: pv.Plotter, body: Relief, dataset: xr.Dataset) -> None:
    made = relief.cells(body, dataset)
    if not len(made.corners):
        return
    surface = pv.PolyData.from_regular_faces(made.corners.reshape(-1, 3), made.triangles)
    loss = own_cells(dataset)["loss"].transpose("v", "u").to_numpy()
    colours = style.LOSS_MAP(body.shade(loss).ravel(), bytes=True)[:, :3]
    surface["color"] = np.repeat(colours[made.sample], 4, axis=0)
    surface.point_data.active_normals = np.repeat(made.normals, 4, axis=0)
    look = {"color": "white", "scalars": "color", "rgb": True, "smooth_shading": True, **MATTER}
    plotter.add_mesh(surface, name="surface", reset_camera=False, **look)


def _add_frame(plotter: pv.Plotter, body: Relief) -> None:
    for number, line in enumerate(body.frame()):
        lines = pv.lines_from_points(line).tube(radius=FRAME)
        plotter.add_mesh(lines, color=style.FAINT, lighting=False, name=f"frame {number}", reset_camera=False)


def _add_run(plotter: pv.Plotter, body: Relief, run: xr.Dataset) -> None:
    """Draw a run's points at the height of their own losses, and join its descents."""
    places = body.at(*(run[name].to_numpy() for name in ("u", "v", "loss"))) + np.array([0.0, 0.0, LIFT])
    shown = ~run["outside"].to_numpy() & np.isfinite(run["loss"].to_numpy())
    label, color = run.attrs["label"], style.method(run)["color"]
    for name, here in by_kind(run):
        if (here & shown).any():
            ball = pv.Sphere(radius=POINT, theta_resolution=16, phi_resolution=16)
            points = pv.PolyData(places[here & shown]).glyph(geom=ball, scale=False, orient=False)
            look = {"color": style.POINT_MARKS[name]["color"], "smooth_shading": True, **MATTER}
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


def _crop(ax: Axes, shown: Shown) -> None:
    """Crop the picture to the frame with a small margin."""
    a = SIDE / 2
    box = np.array([(x, y, z) for x in (-a, a) for y in (-a, a) for z in (0.0, HEIGHT)])
    spots = shown.on_picture(box)
    low, high = spots.min(axis=0), spots.max(axis=0)
    room = ROOM * (high - low)[0]
    (left, upper), (right, lower) = low - room, high + room
    ax.set(xlim=(left, right), ylim=(lower, upper))
    ax.set_box_aspect((lower - upper) / (right - left))
    ax.set_axis_off()


def _label(ax: Axes, dataset: xr.Dataset, shown: Shown) -> None:
    """Write ticks and names next to the two lower front edges of the frame and the right one."""
    sheet, body = page.sheet_of(ax), shown.relief
    room = sheet.type / sheet.zoom  # that type takes up of the scene
    for axis, name in enumerate((*body.plane.labels, page.loss_name(dataset))):
        ticks, share = body.ticks(axis)
        spots = shown.on_picture(np.array([shown.relief.beside(axis, part, room * AWAY[axis]) for part in share]))
        look: dict[str, Any] = {"size": sheet.tick, "color": style.INK, "va": "center"}
        look["ha"] = "left" if axis == 2 else "center"
        for tick, (x, y) in zip(ticks.tolist(), spots, strict=True):
            ax.text(x, y, body.write(axis, tick), **look)
        _name(ax, shown, axis, name, room * OUT[axis])


def _name(ax: Axes, shown: Shown, axis: int, name: str, away: float) -> None:
    """Write an axis' name along it, farther out than its ticks."""
    spots = shown.on_picture(np.array([shown.relief.beside(axis, part, away) for part in (0.0, 1.0, 0.5)]))
    start, end, (x, y) = spots
    slope = np.degrees(np.arctan2(start[1] - end[1], end[0] - start[0]))
    slope -= 180.0 * round(slope / 180.0) if abs(slope) > 90.0 + 1e-6 else 0.0
    look: dict[str, Any] = {"size": page.sheet_of(ax).label, "color": style.INK, "parse_math": False}
    ax.text(x, y, name, rotation=slope, rotation_mode="anchor", ha="center", va="center", **look)


def _signs(sheet: style.Sheet, runs: Runs) -> list[Artist | str]:
    """Return the legend of kinds of points and of methods."""
    dot = {"linestyle": "none", "marker": "o", "markersize": 6.0}
    kinds = dict.fromkeys(name for run in runs for name, _ in by_kind(run))
    found: list[Artist | str] = [page.sign(sheet, k, dot | {"color": style.POINT_MARKS[k]["color"]}) for k in kinds]
    methods = {str(run.attrs["method"]): style.method(run)["color"] for run in runs}
    found += [page.sign(sheet, f"{m}: best", dot | {"markersize": 10.0, "color": c}) for m, c in methods.items()]
    outside = sum(int(run["outside"].sum()) for run in runs)
    return [*found, f"outside the slice: {outside} points"] if outside else found


def _holes(dataset: xr.Dataset) -> list[str]:
    status = dataset["status"].to_numpy()
    holes = int((~has_loss(status)).sum())
    return [f"holes: {holes} of {status.size} samples"] if holes else []
