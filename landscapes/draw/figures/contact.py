"""An episode's contact sheet: key frames with their times, a scale, and a caption (matplotlib)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from .. import style
from ..render import replay
from . import page

if TYPE_CHECKING:
    from ...episode import Episode

KEYS = 5  # frames
PITCH, MIN_FRAME = 2.5, 33.0  # room of a frame: on a screen [inch], and at least in print [mm]
CORNER = (0.05, 0.06)  # of the scale's bar, in shares of the frame


@dataclass(frozen=True)
class Caption:
    """The caption of an episode: what was simulated, the outcome, and its parameters with their source.

    `values` maps a parameter's name to its value with unit. `kept` is a file with all of them, for those that do not
    fit.
    """

    title: str = ""
    outcome: str = ""
    source: str = ""
    values: Mapping[str, str] = field(default_factory=dict)
    kept: str = ""
    provenance: str = ""

    def parameters(self, shown: int) -> str:
        """Write the first parameters, and the number of all."""
        said = ", ".join(f"{name} = {value}" for name, value in [*self.values.items()][:shown])
        rest = f", …; see {self.kept}" if shown < len(self.values) and self.kept else ", …" * (shown < len(self.values))
        count = f"{len(self.values)} parameter{'' if len(self.values) == 1 else 's'}"
        return f"{count}{f' of {self.source}' if self.source else ''}: {said}{rest}" if self.values else ""


def save_sheet(episode: Episode, path: str | Path, *, caption: Caption | None = None, keys: int = KEYS) -> None:
    """Write key frames side by side as PNG, PDF or SVG, by the ending of the file name.

    Raises ValueError if the episode has no `parts`, or for any other ending.
    """
    page.save(episode_figure(episode, caption=caption, keys=keys), path)


def episode_figure(
    episode: Episode, *, caption: Caption | None = None, keys: int = KEYS, width: float | None = None
) -> page.Picture:
    """Draw evenly spaced frames, including first and last, each over its time, and then a target of particles.

    The first frame has a scale. It is exact at the middle of the view; nearer objects look larger.

    Raises ValueError if the episode has no `parts`, or if the page is too narrow or too wide.
    """
    chosen, caption = replay.pick_frames(episode, keys), caption or Caption()
    shown = [*replay.frames(episode, chosen, marked=False)]
    said = [f"{style.number(float(episode.time[frame]), '.3g')} s" for frame in chosen]
    if goals := tuple(replace(part, material="goal") for part in replay.goal_parts(episode)):
        shown += replay.frames(replace(episode, parts=goals), [0], marked=False)
        said.append("target")
    sheet = style.Sheet.of(width, pitch=PITCH, columns=len(shown), least=MIN_FRAME)
    picture, axes = page.panels(sheet, len(shown))
    for ax, pixels, text in zip(axes, shown, said, strict=True):
        ax.imshow(pixels, interpolation="antialiased", aspect="auto")
        ax.set_box_aspect(pixels.shape[0] / pixels.shape[1])
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set(color=style.FAINT, linewidth=0.6 * sheet.weight)
        page.name_axes(ax, text)
    shot = replay.Shot.of(episode.viewpoint(), replay.HEIGHT)
    _draw_scale(picture.axes[0], shot)
    _write(picture, caption, f"Scale: {style.number(shot.bar)} m at the middle of the view; nearer parts look larger.")
    page.finish(picture)
    return picture


def _draw_scale(ax: Axes, shot: replay.Shot) -> None:
    """Draw a bar of a round length into a frame."""
    sheet, (width, height) = page.sheet_of(ax), shot.size
    left, low = CORNER[0] * width, (1 - CORNER[1]) * height
    right = left + shot.bar * shot.metre
    around = [withStroke(linewidth=3.0 * sheet.type, foreground="white")]
    look = sheet.look({"color": style.INK, "linewidth": 2.5, "solid_capstyle": "butt", "gid": "scale"})
    ax.plot([left, right], [low, low], path_effects=around, scalex=False, scaley=False, **look)
    text: dict[str, Any] = {"size": sheet.small, "color": style.INK, "ha": "left", "va": "bottom"}
    said = f"{style.number(shot.bar)} m"
    ax.annotate(said, (left, low), (0, 2), textcoords="offset points", path_effects=around, **text)


def _write(picture: page.Picture, caption: Caption, scale: str) -> None:
    """Write title and outcome over the frames, and under them up to two lines of parameters and the provenance."""
    sheet = picture.sheet
    room = sheet.width - 2 * page.MARGIN
    if over := " · ".join(filter(None, (caption.title, caption.outcome))):
        page.entitle(picture, over)
    lines = [_fit_parameters(caption, room, sheet.small), scale, caption.provenance]
    under = "\n".join(page.wrap_text(line, room, sheet.small) for line in lines if line)
    picture.supxlabel(under, size=sheet.small, color=style.QUIET, parse_math=False)


def _fit_parameters(caption: Caption, room: float, size: float) -> str:
    """Return the parameters, shortened to two lines."""
    counts: Sequence[int] = range(len(caption.values), 0, -1)
    said = (caption.parameters(shown) for shown in counts)
    whole = (text for text in said if not page.wrap_text(text, room, size).endswith(page.MORE))
    return next(whole, "")
