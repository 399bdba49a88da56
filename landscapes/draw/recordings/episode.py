"""An episode as a rerun recording, which plays it back in three dimensions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyvista as pv
import rerun as rr
import rerun.blueprint as rrb
import torch
from numpy.typing import NDArray

from ..render import solids
from ..render.replay import LONGEST, is_still, pick_frames
from ..render.solids import mesh
from .runs import digest, recording, rgba

if TYPE_CHECKING:
    from ...episode import Episode, Part, View

MAX_POINTS = 600_000  # points of a lump in all frames: of more, every so many are shown, larger
TIMELINE, SCENE = "time", "episode"
GRAIN = 0.62  # radius of a lump's particles in their distances: they touch
CLEAR = 0.35  # of that, where a lump is seen through
FAR = 1.0  # of the camera from the middle, in the view's diagonals
PLAYED = 4.0  # how long it plays [s]
EXTENT = 2.0  # of the ground, in the view's diagonals


def save_episode(episode: Episode, path: str | Path, *, title: str, longest: int = LONGEST) -> None:
    """Write evenly spaced frames on the timeline `time` [s] as a rerun recording, with its first view.

    Solids, sheets and targets are surfaces. Lumps are particles, which take a tenth of the space. Sheets have no
    thickness. The recording contains no clock time, so equal episodes give equal recordings.
    """
    view = episode.viewpoint()
    chosen = pick_frames(episode, longest)
    blueprint = _blueprint(view, title, float(episode.time[-1]))
    arrays = [episode.time, *(part.at for part in episode.parts)]
    with recording(digest(arrays, title), Path(path), blueprint) as stream:
        stream.log(SCENE, rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True, strict=True)
        if view.ground is not None:
            stream.log(f"{SCENE}/ground", _ground(view), static=True, strict=True)
        for number, part in enumerate(episode.parts, start=1):
            _log_part(stream, f"{SCENE}/{number:02d}_{part.material}_{part.shape}", part, episode, chosen)


def _log_part(stream: rr.RecordingStream, path: str, part: Part, episode: Episode, chosen: Sequence[int]) -> None:
    """Log the constant data of a part once, and the rest at each frame, or once if the part does not move."""
    for archetype in _static_parts(part):
        stream.log(path, archetype, static=True, strict=True)
    if is_still(part):
        stream.log(path, _at(part, 0), static=True, strict=True)
        return
    for frame in chosen:
        stream.set_time(TIMELINE, duration=float(episode.time[frame]))
        stream.log(path, _at(part, frame), strict=True)


def _static_parts(part: Part) -> list[rr.AsComponents]:
    """Return the data common to all frames: the surface of a solid at the origin, or the faces of a sheet."""
    color = _color(part)
    match part.shape:
        case "lump" | "path" | "trail":
            return []
        case "sheet":
            faces = mesh(replace(part, size=()), 0).regular_faces
            return [rr.Mesh3D.from_fields(triangle_indices=faces, albedo_factor=color)]
    return [_surface(mesh(replace(part, at=torch.zeros(1, 1, 3), turn=None), 0), color)]


def _at(part: Part, frame: int) -> rr.AsComponents:
    """Return the data of a part at a frame."""
    at, color = part.at[frame].numpy(), _color(part)
    match part.shape:
        case "lump" if part.material == "target":
            return _surface(mesh(part, frame), color)
        case "lump":
            every = max(1, math.ceil(part.at.shape[0] * len(at) / MAX_POINTS))
            clear = solids.look(part).get("opacity", 1.0) < 1.0
            radius = part.size[0] * GRAIN * every ** (1 / 3) * (CLEAR if clear else 1.0)
            return rr.Points3D(at[::every], radii=radius, colors=color[:3])
        case "path":
            return rr.LineStrips3D([at], radii=part.size[0], colors=color)
        case "trail":
            return rr.LineStrips3D([part.at[: frame + 1, 0].numpy()], radii=part.size[0], colors=color)
        case "sheet":
            surface = mesh(replace(part, size=()), frame)
            normals = surface.compute_normals(cell_normals=False, split_vertices=False).point_normals
            return rr.Mesh3D.from_fields(vertex_positions=surface.points, vertex_normals=normals)
    turn = np.eye(3) if part.turn is None else part.turn[frame].numpy()
    return rr.InstancePoses3D(translations=at, mat3x3=np.tile(turn, (len(at), 1, 1)))


def _surface(surface: pv.PolyData, color: NDArray[np.uint8]) -> rr.Mesh3D:
    surface = surface.triangulate()
    return rr.Mesh3D(
        vertex_positions=surface.points,
        triangle_indices=surface.regular_faces,
        vertex_normals=surface.point_normals,
        albedo_factor=color,
    )


def _color(part: Part) -> NDArray[np.uint8]:
    look = solids.look(part)
    return rgba(look["color"], look.get("opacity", 1.0))


def _ground(view: View) -> rr.Mesh3D:
    low, high = np.array(view.lower), np.array(view.upper)
    half = EXTENT * np.linalg.norm(high - low) / 2
    corners = (low + high) / 2 + half * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    corners[:, 1] = view.ground
    return rr.Mesh3D(
        vertex_positions=corners,
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_normals=[[0.0, 1.0, 0.0]] * 4,
        albedo_factor=rgba(solids.GROUND),
    )


def _blueprint(view: View, title: str, duration: float) -> rrb.Blueprint:
    low, high = np.array(view.lower), np.array(view.upper)
    center, eye = (low + high) / 2, np.array(view.eye) / np.linalg.norm(view.eye)
    place = center + FAR * np.linalg.norm(high - low) * eye
    controls = rrb.EyeControls3D(position=place, look_target=center, eye_up=(0.0, 1.0, 0.0))
    background = rrb.Background(color=rgba(solids.BACKGROUND))
    space = rrb.Spatial3DView(name=title, origin=SCENE, eye_controls=controls, background=background, line_grid=False)
    playing: dict[str, Any] = {"play_state": "playing", "loop_mode": "all", "playback_speed": duration / PLAYED or 1.0}
    panel = rrb.TimePanel(timeline=TIMELINE, state="collapsed", **playing)
    return rrb.Blueprint(space, panel, collapse_panels=True)
