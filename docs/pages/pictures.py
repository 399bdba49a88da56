"""Pictures of the figures' slices and of the test functions, drawn for light pages and for dark ones."""

from __future__ import annotations

from pathlib import Path

from gradscape.envs.registry import make
from gradscape.gallery.files import dark_name
from gradscape.gallery.league import save_both
from gradscape.landscapes import draw
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.draw.figures.multiples import thumbnail_figure
from gradscape.landscapes.draw.figures.profile import profile_figure
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.storage.paths import slice_path

from .kept import KeptFigure

FUNCTION_RESOLUTION = 48


def draw_slice(kept: KeptFigure, folder: Path, *, small: bool = False) -> dict[str, str]:
    """Draw a figure's slice unless its pictures are up to date, and return their names."""
    assert kept.slice is not None
    name, data = f"{kept.figure.id}{'-small' if small else ''}.png", kept.slice.data
    if _is_old(folder / name, slice_path(kept.folder)):
        full = landscape_figure if len(data["loss"].dims) == 2 else profile_figure
        save_both((thumbnail_figure if small else full)(data), folder / name)
    return _both(name)


def draw_function(env: str, folder: Path) -> dict[str, str]:
    """Sample a test function over its first two parameters, draw it, and return the names of the pictures."""
    if _is_old(folder / f"{env}.png"):
        objective = make(env, device="cpu")
        plane = Plane.through(objective.space, objective.space.center, (0, 1), resolution=FUNCTION_RESOLUTION)
        save_both(landscape_figure(sample(objective, plane)), folder / f"{env}.png")
    return _both(f"{env}.png")


def _both(name: str) -> dict[str, str]:
    return {"light": name, "dark": dark_name(name)}


def _is_old(picture: Path, *data: Path) -> bool:
    """Say whether a picture is missing, or older than its data or the code that draws it."""
    picture.parent.mkdir(parents=True, exist_ok=True)
    sources = [*data, *(file for folder in (*data, *map(Path, draw.__path__)) for file in folder.rglob("[!_]*"))]
    newest = max(file.stat().st_mtime for file in sources)
    pair = (picture, picture.with_name(dark_name(picture.name)))
    return not all(one.exists() and one.stat().st_mtime > newest for one in pair)
