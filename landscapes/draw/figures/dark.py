"""Pictures for dark pages: greys are inverted and colours stay, so that a map matches its colour bar."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_dilation

from ...storage.files import replacing
from .. import style
from ..figure import Picture

Colours = NDArray[np.float64]

COLOURS = ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor")  # that an artist may have
# Up to which difference of its channels a colour is grey, and from which on it is none, where it is pale and where
# not: bands are tinted and pale; cividis has colours that are nearly grey and not pale.
PALE_GREY, GREY = (0.07, 0.12), (0.015, 0.04)
MIDDLE = (0.40, 0.53)  # lightness of greys that stay: turned over they would hardly change, and cividis has them
PAPER, PALE = 0.975, 0.6  # lightness of the page, and of colours that it shines through
NEIGHBOURHOOD = 3  # pixels within which such colours are near the page


def darken(picture: Picture) -> None:
    """Recolour a drawn picture for a dark page; arrows get a colour map that is visible there."""
    for artist in picture.findobj(lambda one: not isinstance(one, Figure | Axes)):  # these have their patches' colours
        if isinstance(artist, ScalarMappable) and artist.get_array() is not None:
            if artist.get_cmap() == style.SLOPE_MAP:
                artist.set_cmap(style.SLOPE_MAP_DARK)
        else:
            _darken(artist)


def _darken(artist: Artist) -> None:
    for name in COLOURS:
        read, write = (getattr(artist, f"{verb}_{name}", None) for verb in ("get", "set"))
        if read is None or write is None or (isinstance(value := read(), str) and value in ("none", "auto")):
            continue
        found = to_rgba_array(value)
        if len(found):
            write(invert_greys(found) if np.ndim(value) == 2 else tuple(invert_greys(found)[0]))
    strokes: list[dict[str, Any]] = [
        vars(effect)["_gc"] for effect in artist.get_path_effects() or [] if isinstance(effect, withStroke)
    ]
    if strokes:
        grounds = [tuple(invert_greys(to_rgba_array(stroke["foreground"]))[0]) for stroke in strokes]
        effects = [stroke | {"foreground": ground} for stroke, ground in zip(strokes, grounds, strict=True)]
        artist.set_path_effects([withStroke(**effect) for effect in effects])


def invert_greys(colours: Colours) -> Colours:
    """Return colours, shape (..., 3 or 4), with greys as light on the dark page as they were dark on white.

    A pale grey keeps its tint.
    """
    rgb, rest = colours[..., :3], colours[..., 3:]
    level, chroma = rgb.mean(axis=-1, keepdims=True), np.ptp(rgb, axis=-1, keepdims=True)
    ground, ink = (to_rgba_array(name)[0, :3] for name in (style.NIGHT, style.NIGHT_INK))
    least, most = (np.where(level > PALE, *ends) for ends in zip(PALE_GREY, GREY, strict=True))
    grey = np.clip((most - chroma) / (most - least), 0.0, 1.0)
    grey = np.where((level > MIDDLE[0]) & (level < MIDDLE[1]), 0.0, grey)
    turned = ground + (1 - level) * (ink - ground) + np.where(level > PALE, rgb - level, 0.0)
    found: Colours = np.concatenate([grey * turned + (1 - grey) * rgb, rest], axis=-1)
    return found


def save_dark(source: Path, target: Path) -> None:
    """Write a PNG picture again for a dark page; where a colour blends with the paper, the paper is removed."""
    light, place = _colours_of(source)
    level, chroma = light.mean(axis=-1), np.ptp(light, axis=-1)
    paper, pale = (level > PAPER) & (chroma < PALE_GREY[0]), (level > PALE) & (chroma > PALE_GREY[0])
    edge = binary_dilation(paper[place], iterations=NEIGHBOURHOOD) & pale[place]
    ground = to_rgba_array(style.NIGHT)[0, :3]
    dark = _as_bytes(invert_greys(light))[place]
    dark[edge] = _as_bytes(light - light.min(axis=-1, keepdims=True) * (1 - ground))[place[edge]]
    few = Image.fromarray(dark).quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    _keep_ground(few, paper[place], _as_bytes(ground))
    with replacing(target) as partial:
        few.save(partial, "PNG")


def _colours_of(source: Path) -> tuple[Colours, NDArray[np.integer[Any]]]:
    """Return a picture's distinct colours, shape (colour, 3), and the index of the colour of each pixel."""
    with Image.open(source) as picture:
        if picture.mode == "P":
            return np.array(picture.getpalette()).reshape(-1, 3) / 255, np.asarray(picture)
        pixels = np.asarray(picture.convert("RGB"), dtype=np.uint32)
    packed, place = np.unique((pixels << (16, 8, 0)).sum(axis=-1, dtype=np.uint32), return_inverse=True)
    return (packed[:, None] >> (16, 8, 0) & 255) / 255, place.reshape(pixels.shape[:2])


def _keep_ground(few: Image.Image, paper: NDArray[np.bool_], ground: NDArray[np.uint8]) -> None:
    """Give the paper of a picture with few colours the exact colour of the page."""
    palette, places = few.getpalette() or [], np.asarray(few)[paper]
    if places.size:
        most = int(np.bincount(places).argmax())
        palette[3 * most : 3 * most + 3] = ground.tolist()
        few.putpalette(palette)


def _as_bytes(colours: Colours) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)
