"""The surfaces of an episode's parts, as pyvista meshes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

if TYPE_CHECKING:
    from ...episode import Part

Grid = NDArray[np.float64]

AROUND, ARC = 48, 24  # facets around an axis, along a half circle
SURFACE_DENSITY = 0.36  # of a lump's inner density, where its surface is
STRAY = 0.16  # below which a particle is a drop of its own
BLUR = 1.8  # of its density, in cells of half a pitch
SHEET, DEEP = 0.004, 0.006  # how thick a pan is drawn, and how far below where sheets touch it [m]
SWELL = 1.08  # what a target is drawn larger, to be seen around what is there
WIRE = 0.006  # radius of a tank's edges, per width


@contextmanager
def off_screen(size: tuple[int, int]) -> Iterator[pv.Plotter]:
    """Yield an empty, unlit plotter on white of a size [pixel]; it needs no display and closes at the end."""
    _import_triton()
    with pv.vtk_verbosity("error"):  # otherwise VTK warns that there is no X server, and renders without
        plotter = pv.Plotter(off_screen=True, window_size=list(size), lighting="none")
        try:
            plotter.set_background("white")
            yield plotter
        finally:
            plotter.close()


def _import_triton() -> None:
    """Import triton before Mesa renders, if a CUDA build of torch has installed it.

    Both contain LLVM. If Mesa's is loaded first, a later import of triton crashes, for example in `torch.func`.
    """
    if find_spec("triton"):
        import_module("triton")


def mesh(part: Part, frame: int) -> pv.PolyData:
    """Return a part's surface at a frame."""
    at = part.at[frame].numpy()
    match part.shape:
        case "lump":
            return lump(at, part.size[0])
        case "sheet":
            return _sheet(part, at)
        case "path":
            return tube(at, part.size[0])
        case "trail":
            path = part.at[: frame + 1, 0].numpy()
            return tube(path, part.size[0]) if frame else _revolve(_circle(part.size[0])).translate(path[0])
    body = _solid(part)
    if part.material == "target":
        body = body.scale(SWELL, inplace=False)
    if part.turn is not None:
        matrix = np.eye(4)
        matrix[:3, :3] = part.turn[frame].numpy()
        body = body.transform(matrix, inplace=False)
    return pv.merge([body.translate(place, inplace=False) for place in at])


def lump(x: Grid, pitch: float) -> pv.PolyData:
    """Return the surface around particles about `pitch` apart; stray ones become separate drops."""
    step = pitch / 2
    low = x.min(axis=0) - 4 * pitch
    shape = np.ceil((x.max(axis=0) + 4 * pitch - low) / step).astype(int)
    cell = np.floor((x - low) / step).astype(int)
    density = np.zeros(shape)
    np.add.at(density, tuple(cell.T), (pitch / step) ** 3)  # 1 where particles are a pitch apart
    density = gaussian_filter(density, BLUR)
    image = pv.ImageData(dimensions=tuple(shape), spacing=(step,) * 3, origin=tuple(low + step / 2))
    image["density"] = density.flatten(order="F")
    surface = image.contour([SURFACE_DENSITY], scalars="density", method="flying_edges")
    surface.clear_data()
    stray = x[density[tuple(cell.T)] < STRAY]
    drops = [_revolve(_circle(0.4 * pitch, 8), 12).translate(place, inplace=False) for place in stray]
    whole = pv.merge([surface, *drops]) if drops else surface
    return whole.compute_normals(cell_normals=False)


def tube(points: Grid, radius: float) -> pv.PolyData:
    """Return a tube through points, shape (point, 3), with round ends."""
    apart = np.linalg.norm(np.diff(points, axis=0, prepend=np.inf), axis=1) > 1e-9
    path = points[apart]
    ball = _revolve(_circle(radius))
    ends = [ball.translate(path[end], inplace=False) for end in (0, -1)]
    if len(path) < 2:
        return ends[0]
    return pv.merge([pv.lines_from_points(path).tube(radius=radius, n_sides=24), *ends])


def _sheet(part: Part, at: Grid) -> pv.PolyData:
    assert part.faces is not None  # as the record says of sheets
    surface = pv.PolyData.from_regular_faces(at, part.faces.numpy())
    if part.material == "sugar":
        return surface
    surface = surface.compute_normals(cell_normals=False, split_vertices=False, consistent_normals=False)
    return _thicken(surface, part.faces.numpy(), part.size[0]) if part.size else surface


def _thicken(sheet: pv.PolyData, faces: NDArray[np.int64], thickness: float) -> pv.PolyData:
    """Return a sheet with two sides and a rounded rim; the scalar `side` is 1 on the side of its normals, else 0."""
    lift, count = thickness / 2 * sheet.point_normals, sheet.n_points
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, shared = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    a, b = edges[first[shared == 1]].T
    rim = [np.stack([b, a, a + count], axis=1), np.stack([b, a + count, b + count], axis=1)]
    points = np.concatenate([sheet.points + lift, sheet.points - lift])
    body = pv.PolyData.from_regular_faces(points, np.concatenate([faces, faces[:, ::-1] + count, *rim]))
    body["side"] = np.repeat([1.0, 0.0], count)
    return body.subdivide(2, subfilter="loop").compute_normals(cell_normals=False, split_vertices=False)


def _solid(part: Part) -> pv.PolyData:
    """Return a solid at the origin, upright."""
    size = part.size
    match part.shape:
        case "sphere":
            return _revolve(_circle(size[0]))
        case "capsule":
            arc, half = _circle(size[1]), np.array([0.0, size[0]])
            return _revolve(np.concatenate([arc[: ARC // 2 + 1] - half, arc[ARC // 2 :] + half]))
        case "torus":
            return _revolve(_turn(2 * math.pi, size[1], (size[0], 0.0), 2 * ARC))
        case "cylinder":
            return _revolve(_corners([(0.0, -size[1]), (size[0], -size[1]), (size[0], size[1]), (0.0, size[1])]))
        case "ring":
            inner, outer, height = size
            return _revolve(_corners([(inner, 0), (outer, 0), (outer, height), (inner, height), (inner, 0)]))
        case "box":
            return pv.Cube(x_length=size[0], y_length=size[1], z_length=size[2])
        case "tank":
            return _tank(*size)
        case "pan":
            return _pan(*size)
        case "ladle":
            return _ladle(*size)
    raise ValueError(f"unknown solid {part.shape!r}")


def _ladle(radius: float, half: float, height: float) -> pv.PolyData:
    """Return half a spherical shell below the origin, with an upright handle at the left of its rim."""
    outer = _turn(math.pi / 2, radius + half, (0.0, 0.0), ARC)
    rim = _turn(math.pi, half, (radius, 0.0), 8, start=math.pi / 2)
    inner = _turn(math.pi / 2, radius - half, (0.0, 0.0), ARC)[::-1]
    rod = tube(np.array([[-radius, 0.0, 0.0], [-radius, height, 0.0]]), half)
    return pv.merge([_revolve(np.concatenate([outer, rim, inner])), rod])


def _pan(flat: float, bend: float, sweep: float) -> pv.PolyData:
    """Return a round bottom whose edge bends up along an arc, a little lower so that its contents are visible."""
    upper = np.concatenate([[[0.0, -DEEP]], _turn(sweep, bend + DEEP, (flat, bend), ARC)])
    lower = np.concatenate([_turn(sweep, bend + DEEP + SHEET, (flat, bend), ARC)[::-1], [[0.0, -DEEP - SHEET]]])
    return _revolve(np.concatenate([upper, lower])[::-1])


def _tank(x: float, y: float, z: float) -> pv.PolyData:
    """Return the edges of a box with its bottom at the origin."""
    a, b = x / 2, z / 2
    low = np.array([[-a, 0, -b], [a, 0, -b], [a, 0, b], [-a, 0, b]])
    high = low + np.array([0, y, 0])
    edges = [np.stack(pair) for side in (low, high) for pair in zip(side, np.roll(side, 1, axis=0), strict=True)]
    edges += [np.stack(pair) for pair in zip(low, high, strict=True)]
    return pv.merge([tube(edge, WIRE * x) for edge in edges])


def _circle(radius: float, facets: int = ARC) -> Grid:
    """Return the profile of a ball, from its lowest point to its highest."""
    return _turn(math.pi, radius, (0.0, 0.0), facets)


def _turn(sweep: float, radius: float, center: tuple[float, float], facets: int, start: float = 0.0) -> Grid:
    """Return points (out, up) along an arc that begins below its centre and turns outwards."""
    angle = start + np.linspace(0.0, sweep, facets + 1)
    return np.stack([center[0] + radius * np.sin(angle), center[1] - radius * np.cos(angle)], axis=1)


def _corners(profile: list[tuple[float, float]]) -> Grid:
    """Repeat the inner points of a profile, so that edges stay sharp."""
    return np.repeat(np.array(profile, dtype=np.float64), 2, axis=0)[1:-1]


def _revolve(profile: Grid, around: int = AROUND) -> pv.PolyData:
    """Turn a profile (out, up), shape (point, 2), about the y axis, with the solid on its left."""
    angle = np.linspace(0.0, 2 * math.pi, around + 1)
    out, up = profile.T[:, :, None]
    shell = np.stack([out * np.cos(angle), up + 0 * angle, -out * np.sin(angle)], axis=-1)
    count = len(profile)
    number = np.arange(count * (around + 1)).reshape(count, around + 1)
    a, b, c, d = (p.ravel() for p in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    body = pv.PolyData.from_regular_faces(shell.reshape(-1, 3), faces)
    along = np.gradient(profile, axis=0)
    body.point_data.active_normals = _normals(profile, along, angle)
    return body


def _normals(profile: Grid, along: Grid, angle: Grid) -> Grid:
    """Return unit normals of a turned profile, to the right of it."""
    sharp = np.linalg.norm(np.diff(profile, axis=0), axis=1) < 1e-12  # doubled corners look along their own edge
    forward, backward = np.diff(profile, axis=0, append=profile[-1:]), np.diff(profile, axis=0, prepend=profile[:1])
    along = along.copy()
    along[:-1][sharp], along[1:][sharp] = backward[:-1][sharp], forward[1:][sharp]
    side = np.stack([along[:, 1], -along[:, 0]], axis=1)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    out, up = side.T[:, :, None]
    return np.stack([out * np.cos(angle), up + 0 * angle, -out * np.sin(angle)], axis=-1).reshape(-1, 3)


BACKGROUND, GROUND, SHADOW = "#ffffff", "#f1efec", 0.34  # share of the light a full shadow takes
STAMP: dict[str, Any] = {"color": "#3c3c3c", "font_size": 11, "font": "arial"}
VEIL = 0.75  # how much the ground of what is written on a frame covers
INSET, THICK = (18, 14), 4  # of what is written on a frame, from its edges; of its scale's bar [pixel]
KEY = (-0.55, 1.0, 0.65)  # where the light that throws shadows comes from
LIGHTS = ((KEY, 0.70), ((0.7, 0.3, 1.0), 0.48), ((0.1, 0.3, -1.0), 0.18))  # direction, strength
ANGLE = 24.0  # the camera's, from side to side [degrees]

_MATT: dict[str, Any] = {"ambient": 0.28, "diffuse": 0.80, "specular": 0.06, "specular_power": 12}
_GLOSS: dict[str, Any] = {"ambient": 0.20, "diffuse": 0.78, "specular": 0.45, "specular_power": 40}
_CLEAR: dict[str, Any] = {"ambient": 0.35, "diffuse": 0.65, "specular": 0.30, "specular_power": 60}

CLAY = ("#e07a3f", "#e9b44c", "#c8553d", "#b0719a", "#d99a8b")  # warm, one for each body
LINKS = ("#4f7ba6", "#7fa5c8", "#b4cde2")  # of a chain, from its base
LOOKS: dict[str, dict[str, Any]] = {
    "syrup": _CLEAR | {"color": "#5b9bd5", "opacity": 0.42, "culling": "back"},
    "sugar": _MATT | {"color": "#f28e2b"},
    "plasticine": _MATT,
    "cloth": _MATT | {"color": "#4f86b8"},
    "dough": _MATT | {"color": "#e3b26a"},
    "rubber": _GLOSS | {"color": "#d1495b"},
    "steel": _GLOSS | {"color": "#a7b7c4"},
    "iron": _GLOSS | {"color": "#4a4f55"},
    "wood": _MATT | {"color": "#b98a5e"},
    "board": _MATT | {"color": "#f3efe6"},
    "glass": _GLOSS | {"color": "#aebfca"},
    "goal": _MATT | {"color": "#58ab65"},
    "target": _CLEAR | {"color": "#3fa34d", "opacity": 0.32},
}
BACK = {"cloth": "#b9cfe2", "dough": "#a86b2d"}  # the other side of sheets


def look(part: Part) -> dict[str, Any]:
    """Return the style of a part."""
    chosen = dict(LOOKS[part.material])
    if part.material == "plasticine":
        chosen["color"] = CLAY[part.tint % len(CLAY)]
    if part.material == "target" and part.shape != "sheet":
        chosen["culling"] = "front"  # so that what is in it keeps its colour
    if part.shape == "path" and part.material == "steel":
        chosen["color"] = LINKS[part.tint % len(LINKS)]
    return chosen


def solid(part: Part) -> bool:
    """Say whether a part throws a shadow."""
    return part.material not in ("syrup", "target", "glass") and part.shape != "trail"
