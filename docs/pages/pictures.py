"""Pictures of the figures' slices and of the test functions, drawn for light pages and for dark ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import xarray as xr

from gradscape.envs.registry import make
from gradscape.gallery.files import STORE, dark_name
from gradscape.gallery.league import save_both
from gradscape.landscapes import draw
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.draw.figures.multiples import thumbnail_figure
from gradscape.landscapes.draw.figures.profile import profile_figure
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample

from .kept import KeptFigure

if TYPE_CHECKING:
    from gradscape.landscapes.draw.figures.page import Picture

FUNCTION_RESOLUTION = 48
CODE = [Path(place) for place in draw.__path__]


def draw_slice(kept: KeptFigure, folder: Path, *, small: bool = False) -> str:
    """Draw a figure's slice, if a picture of it is not there already, and return the picture's name."""
    assert kept.slice is not None
    name = f"{kept.figure.id}{'-small' if small else ''}.png"
    _refresh(folder / name, _newest(kept.folder / STORE), lambda: _picture(kept.slice.data, small=small))
    return name


def draw_function(env: str, folder: Path) -> str:
    """Sample a test function over its first two parameters, draw it, and return the picture's name."""
    name = f"{env}.png"

    def sampled() -> Picture:
        objective = make(env, device="cpu")
        plane = Plane.through(objective.space, objective.space.center, (0, 1), resolution=FUNCTION_RESOLUTION)
        return landscape_figure(sample(objective, plane))

    _refresh(folder / name, 0.0, sampled)
    return name


def shown(name: str, alt: str, up: str, *, look: str = "", leads: str = "") -> str:
    """Return the Markdown that shows a picture on pages of either kind; `up` leads to where pages are walked.

    `look` is a class of the style sheet, and `leads` where a click on it leads.
    """
    target = f":target: {leads}\n" if leads else ""
    lines = [
        f"```{{image}} {up}pictures/{file}\n:alt: {alt}\n:class: {f'{look} only-{kind}'.strip()}\n{target}```"
        for kind, file in (("light", name), ("dark", dark_name(name)))
    ]
    return "\n\n".join(lines)


def _picture(data: xr.Dataset, *, small: bool) -> Picture:
    if small:
        return thumbnail_figure(data)
    return (landscape_figure if len(data["loss"].dims) == 2 else profile_figure)(data)


def _refresh(file: Path, since: float, drawn: Callable[[], Picture]) -> None:
    """Draw a picture where there is none that is younger than its data and the code that draws."""
    newest = max(since, *map(_newest, CODE))
    pair = (file, file.with_name(dark_name(file.name)))
    if not all(one.exists() and one.stat().st_mtime > newest for one in pair):
        file.parent.mkdir(parents=True, exist_ok=True)
        save_both(drawn(), file)


def _newest(folder: Path) -> float:
    return max(one.stat().st_mtime for one in folder.rglob("*") if "__pycache__" not in one.parts)
