"""An episode as pictures: its parts lit, on their ground, from its view (pyvista, off-screen)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyvista as pv
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from .. import style
from ..figures import page
from ..film import picture as picture_of
from ..film import save_film
from . import solids
from .solids import Grid, mesh, off_screen

if TYPE_CHECKING:
    from ...episode import Episode, Part, View

Picture = NDArray[np.uint8]

HEIGHT = 600  # of a frame [pixel]
STRIP, STRIP_DPI = 0.4, 100  # height of what is over a film [inch], and how fine it is
BAR = 0.25  # most of a frame's width that its scale takes
LIKELY = (0.8, 1.6)  # narrowest and widest frame, its width per height
AWAY_DISTANCE = 2.0  # from where on a target's surface is away from a body's particles, in their distances
LONGEST, RATE = 100, 25  # most frames of a film, and how many of them a second
EXTENT, CELLS = 3.0, 192  # of the ground in halves of the view's diagonal; of its shadow along each side
SAMPLES = 40_000  # of the surfaces that throw it


def save_replay(episode: Episode, mp4: str | Path, gif: str | Path, *, title: str = "", longest: int = LONGEST) -> int:
    """Write evenly spaced frames, including first and last, under a title as MP4 and GIF; return their number.

    Raises ValueError if the episode has no `parts`, OSError if ffmpeg cannot write.
    """
    count = min(longest, len(episode.time))
    pictures = add_title(frames(episode, pick_frames(episode, count)), title)
    save_film(pictures, Path(mp4), Path(gif), count=count, rate=RATE)
    return count


def add_title(pictures: Iterable[Picture], title: str) -> Iterator[Picture]:
    """Put a strip with a title over pictures, or leave them unchanged without a title."""
    strip = None
    for picture in pictures:
        if title and strip is None:
            strip = _strip(title, picture.shape[1])
        yield picture if strip is None else np.concatenate([strip, picture])


def _strip(title: str, width: int) -> Picture:
    """Return a strip with a title, as wide as the pictures [pixel]."""
    figure = Figure(figsize=(width / STRIP_DPI, STRIP), facecolor=solids.BACKGROUND)
    FigureCanvasAgg(figure)
    room = width / STRIP_DPI - 2 * page.MARGIN
    fits = page.text_width(title, style.Sheet.label) < room
    size = style.Sheet.label if fits else style.Sheet.small  # of which there is room for two lines
    said, left = page.wrap_text(title, room, size), page.MARGIN * STRIP_DPI / width
    figure.text(left, 0.5, said, size=size, color=style.INK, va="center", parse_math=False)
    return picture_of(figure, dpi=STRIP_DPI)


def pick_frames(episode: Episode, count: int) -> list[int]:
    """Return evenly spaced frames, including first and last, and fewer of them for a short episode."""
    found: list[int] = np.unique(np.linspace(0, len(episode.time) - 1, count).round().astype(int)).tolist()
    return found


def frames(episode: Episode, chosen: Sequence[int], *, height: int = HEIGHT, marked: bool = True) -> Iterator[Picture]:
    """Yield pictures of the chosen frames, shape (height, width, 3), with time and scale if they are `marked`.

    The scale is exact at the middle of the view; nearer objects look larger.

    Raises ValueError if the episode has no `parts`.
    """
    if not episode.parts:
        raise ValueError("the episode has no `parts` to draw; give Episode its `parts`")
    view = episode.viewpoint()
    shot = Shot.of(view, height)
    with _stage(view, shot) as plotter:
        parts = [part for part in episode.parts if part not in goal_parts(episode)]
        still = [part for part in parts if is_still(part)]
        moving = [part for part in parts if part not in still]
        bodies = [part for part in parts if part.shape == "lump"]
        goals = [mesh(part, 0) for part in goal_parts(episode)]
        tracked = tracked_parts(moving)
        _place(plotter, still, [mesh(part, 0) for part in still], "still")
        if marked:
            _write_scale(plotter, shot)
        for frame in chosen:
            _place(plotter, moving, [mesh(part, frame) for part in moving], "moving")
            _place(plotter, goal_parts(episode), [missed_surface(goal, bodies, frame) for goal in goals], "sought")
            if view.ground is not None:
                _lay_ground(plotter, view, [mesh(part, frame) for part in episode.parts if solids.solid(part)])
            if marked:
                said = f"{style.number(float(episode.time[frame]), '.3g')} s"
                _stamp(plotter, said, "time", solids.INSET)
                _name_lost(plotter, outside(tracked, shot, frame), shot)
            plotter.render()
            picture = np.array(plotter.screenshot(return_img=True))
            if marked:
                _draw_bar(picture, shot)
            yield picture


@dataclass(frozen=True)
class Shot:
    """The camera of a view: the point it looks at, its distance, and the `size` of the picture, width and height."""

    center: Grid  # [m]
    far: float  # [m]
    half: float  # of what is seen above and below the middle at the front of the view [m]
    size: tuple[int, int]  # [pixel]
    axes: tuple[Grid, Grid, Grid]  # right, up and towards the eye

    @classmethod
    def of(cls, view: View, height: int) -> Shot:
        """Return the camera that shows the whole box of a view in a picture of a height [pixel]."""
        low, high = np.array(view.lower), np.array(view.upper)
        right, up, eye = axes(view)
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        center = (low + high) / 2
        wide, tall = (np.ptp((corners - center) @ side) for side in (right, up))
        width = round(height * float(np.clip(wide / tall, *LIKELY))) // 2 * 2
        half = 1.06 * max(tall, wide * height / width) / 2
        far = half / np.tan(np.radians(solids.ANGLE) / 2) + np.ptp((corners - center) @ eye) / 2
        return cls(center, float(far), float(half), (width, height), (right, up, eye))

    def shows(self, points: Grid, margin: float = 0.0) -> bool:
        """Say whether the picture shows any of these points [m], shape (point, 3), with a `margin` [m] around them."""
        across, up, near = ((points - self.center) @ axis for axis in self.axes)
        reach = (self.far - near) * np.tan(np.radians(solids.ANGLE) / 2)
        inside = (abs(up) - margin < reach) & (abs(across) - margin < reach * self.size[0] / self.size[1])
        return bool(inside.any())

    @property
    def metre(self) -> float:
        """The length of a metre at the middle of the view [pixel]."""
        return float(self.size[1] / 2 / (self.far * np.tan(np.radians(solids.ANGLE) / 2)))

    @property
    def bar(self) -> float:
        """A round length for the scale bar [m]."""
        most = BAR * self.size[0] / self.metre
        power = 10.0 ** np.floor(np.log10(most))
        return float(next(step * power for step in (5, 2, 1) if step * power <= most))


@contextmanager
def _stage(view: View, shot: Shot) -> Iterator[pv.Plotter]:
    """Yield a plotter with lights and a camera that sees the view's box."""
    center, (_, _, eye) = shot.center, shot.axes
    diagonal = float(np.linalg.norm(np.array(view.upper) - np.array(view.lower)))
    with off_screen(shot.size) as plotter:
        for direction, strength in solids.LIGHTS:
            light = pv.Light(position=tuple(center + direction), focal_point=tuple(center), intensity=strength)
            light.positional = False
            plotter.add_light(light)
        plotter.camera.position, plotter.camera.focal_point = tuple(center + shot.far * eye), tuple(center)
        plotter.camera.up, plotter.camera.view_angle = (0.0, 1.0, 0.0), solids.ANGLE
        plotter.camera.clipping_range = (shot.far / 20, 20 * shot.far)
        plotter.enable_ssao(radius=diagonal / 14, bias=0.002 * shot.half / 1.06, kernel_size=64, blur=True)
        plotter.enable_anti_aliasing("ssaa")
        yield plotter


def _write_scale(plotter: pv.Plotter, shot: Shot) -> None:
    """Write the length of the scale bar over it at the lower right; the text may be wider than the bar."""
    right, lift = solids.INSET
    over = (shot.size[0] - right, lift + 2 * solids.THICK)
    _stamp(plotter, f"{style.number(shot.bar)} m", "scale", over).justification_horizontal = "right"


def _stamp(plotter: pv.Plotter, said: str, name: str, position: tuple[int, int]) -> pv.TextProperty:
    """Write a text on a nearly opaque background, and return its style."""
    actor = plotter.add_text(said, name=name, position=position, **solids.STAMP)
    actor.prop.background_color, actor.prop.background_opacity = solids.BACKGROUND, solids.VEIL
    return actor.prop


def _name_lost(plotter: pv.Plotter, lost: Sequence[str], shot: Shot) -> None:
    """Write at the upper left which bodies have left the picture, nothing where none has."""
    plotter.remove_actor("lost", reset_camera=False, render=False)
    if lost:
        right, down = solids.INSET
        over = (right, shot.size[1] - down)
        _stamp(plotter, f"outside the picture: {', '.join(lost)}", "lost", over).justification_vertical = "top"


def _draw_bar(picture: Picture, shot: Shot) -> None:
    """Draw the scale bar into a picture at the lower right."""
    right, bottom = (size - inset for size, inset in zip(shot.size, solids.INSET, strict=True))
    color = pv.Color(solids.STAMP["color"]).int_rgb
    picture[bottom - solids.THICK : bottom, right - round(shot.bar * shot.metre) : right] = color


def axes(view: View) -> tuple[Grid, Grid, Grid]:
    """Return the directions right, up and towards the eye of a view."""
    eye = np.array(view.eye) / np.linalg.norm(view.eye)
    right = np.cross([0.0, 1.0, 0.0], eye)
    right /= np.linalg.norm(right)
    return right, np.cross(eye, right), eye


def tracked_parts(moving: Sequence[Part]) -> list[Part]:
    """Return the bodies that a viewer looks for in a picture: sheets and lumps, or else balls, but no targets."""
    bodies = [part for part in moving if part.material not in ("target", "goal")]
    soft = [part for part in bodies if part.shape in ("sheet", "lump")]
    return soft or [part for part in bodies if part.shape == "sphere"]


def outside(tracked: Sequence[Part], shot: Shot, frame: int) -> list[str]:
    """Name the bodies that a picture of a frame does not show."""
    lost = [part for part in tracked if not shot.shows(part.at[frame].double().numpy(), (part.size or (0.0,))[0])]
    return list(dict.fromkeys("ball" if part.shape == "sphere" else part.material for part in lost))


def goal_parts(episode: Episode) -> list[Part]:
    """Return the targets that bodies should reach; the parts that they miss are drawn."""
    return [part for part in episode.parts if part.shape == "lump" and part.material == "target"]


def missed_surface(goal: pv.PolyData, bodies: Sequence[Part], frame: int) -> pv.PolyData:
    """Return the part of a target's surface that no particle of a body reaches."""
    pitch = max(part.size[0] for part in bodies)
    every = np.concatenate([part.at[frame].numpy() for part in bodies])
    away, _ = cKDTree(every).query(goal.points, distance_upper_bound=2 * AWAY_DISTANCE * pitch)
    return goal.extract_points(away > AWAY_DISTANCE * pitch, adjacent_cells=False).extract_surface(algorithm=None)


def _place(plotter: pv.Plotter, parts: Sequence[Part], surfaces: Sequence[pv.PolyData], label: str) -> None:
    for number, (part, surface) in enumerate(zip(parts, surfaces, strict=True)):
        look = solids.look(part)
        if "side" in surface.point_data:
            look["scalars"], look["cmap"] = "side", [solids.BACK[part.material], look.pop("color")]
            look["show_scalar_bar"] = False
        elif part.material in solids.BACK:
            look["backface_params"] = {**look, "color": solids.BACK[part.material]}
        smooth = part.shape != "box" and part.material != "sugar"
        name = f"{label} {number}"
        if not surface.n_cells:
            plotter.remove_actor(name, reset_camera=False, render=False)
            continue
        plotter.add_mesh(surface, name=name, smooth_shading=smooth, reset_camera=False, render=False, **look)


def is_still(part: Part) -> bool:
    """Say whether a part is the same in all frames."""
    return part.shape != "trail" and all(
        bool((rows == rows[:1]).all()) for rows in (part.at, part.turn) if rows is not None
    )


def _lay_ground(plotter: pv.Plotter, view: View, bodies: Sequence[pv.PolyData]) -> None:
    """Draw the ground under the view, with the shadows of solids, fading into the background."""
    assert view.ground is not None  # the caller asked
    low, high = np.array(view.lower), np.array(view.upper)
    center, half = (low + high) / 2, EXTENT * float(np.linalg.norm(high - low)) / 2
    x = center[0] + half * np.linspace(-1, 1, CELLS)
    z = center[2] + half * np.linspace(-1, 1, CELLS)
    dark = _shadow(bodies, view.ground, x, z)
    away = np.hypot((x[:, None] - center[0]) / half, (z[None, :] - center[2]) / half)
    fade = np.clip((away - 0.45) / 0.5, 0.0, 1.0)[..., None]
    ground, background = (np.array(pv.Color(name).float_rgb) for name in (solids.GROUND, solids.BACKGROUND))
    color = ground * (1 - solids.SHADOW * dark[..., None]) * (1 - fade) + background * fade
    grid = pv.StructuredGrid(*np.meshgrid(x, [view.ground], z, indexing="ij"))
    rgb = (255 * color).round().astype(np.uint8).transpose(1, 0, 2).reshape(-1, 3)
    plotter.add_mesh(
        grid, scalars=rgb, rgb=True, lighting=False, name="ground", reset_camera=False, render=False, pickable=False
    )


def _shadow(bodies: Sequence[pv.PolyData], ground: float, x: Grid, z: Grid) -> Grid:
    """Return the share of the key light that solids block on the ground, shape (x, z), 0 to 1."""
    spots = np.concatenate([_scatter_points(solid) for solid in bodies if solid.n_cells] or [np.zeros((0, 3))])
    lift = spots[:, 1:2] - ground
    shift = np.array(solids.KEY)
    feet = (spots - lift * shift / shift[1])[lift[:, 0] > 0]
    edges = [np.append(axis, 2 * axis[-1] - axis[-2]) - (axis[1] - axis[0]) / 2 for axis in (x, z)]
    hits, *_ = np.histogram2d(feet[:, 0], feet[:, 2], bins=edges)
    return np.clip(1.6 * gaussian_filter(np.minimum(hits / 3.0, 1.0), 1.6), 0.0, 1.0)


def _scatter_points(solid: pv.PolyData) -> Grid:
    """Return points spread evenly over a surface."""
    corners = solid.points[solid.triangulate().regular_faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not areas.sum() > 0:
        return np.zeros((0, 3))
    random = np.random.default_rng(0)
    chosen = corners[random.choice(len(corners), SAMPLES, p=areas / areas.sum())]
    share = np.sort(random.random((SAMPLES, 2)), axis=1)
    weights = np.stack([share[:, 0], share[:, 1] - share[:, 0], 1 - share[:, 1]], axis=1)
    return np.asarray(np.einsum("nk,nka->na", weights, chosen))
