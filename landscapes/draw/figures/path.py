"""The path of a training over the slice along it: its checkpoints in order (matplotlib)."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from ...identity import plane_of
from ...training import TrainingPath
from .. import style
from . import page


def path_scale(dataset: xr.Dataset) -> style.Scale:
    """Return the scale of a slice's losses, open at an end if checkpoints of its training are beyond it."""
    scale, path = style.Scale.of_loss(dataset["loss"].to_numpy()), TrainingPath.of(dataset)
    return scale.over(np.array([one.loss for one in path.checkpoints])) if path else scale


def draw_path(ax: Axes, dataset: xr.Dataset, scale: style.Scale) -> list[Artist | str]:
    """Draw the checkpoints of a slice's training over its loss map, and return their legend.

    A white line joins them in order. The colour of a marker is the loss of the checkpoint itself, and its size falls
    with the distance from the plane. The last one is a square. Checkpoints without a loss are crosses.
    """
    path, sheet = TrainingPath.of(dataset), page.sheet_of(ax)
    if path is None:
        return []
    low, high = (side.numpy() for side in plane_of(dataset).cell_bounds())
    place = np.clip([(one.u, one.v) for one in path.checkpoints], low, high)
    off, loss = (np.array([getattr(one, name) for one in path.checkpoints]) for name in ("distance", "loss"))
    areas = sheet.weight**2 * style.point_areas(off, path.farthest, len(off))
    for look in style.IMPROVEMENTS:
        ax.plot(place[:, 0], place[:, 1], gid="path", **sheet.look(look))
    last, known = np.arange(len(off)) == len(off) - 1, np.isfinite(loss)
    fill: dict[str, Any] = {"cmap": style.LOSS_MAP, "norm": scale.norm}
    for gid, some, look in (("checkpoint", known & ~last, style.CHECKPOINT), ("last", known & last, style.LAST)):
        u, v = place[some].T
        ax.scatter(u, v, s=areas[some], **sheet.look(style.HALO))
        ax.scatter(u, v, s=areas[some], c=loss[some], gid=gid, **fill, **sheet.look(look))
    u, v = place[~known].T
    ax.scatter(u, v, gid="failed", **sheet.look(style.FAILED_MARK))
    return _signs(sheet, path, loss)


def _signs(sheet: style.Sheet, path: TrainingPath, loss: Any) -> list[Artist | str]:
    """Return the legend: markers, the share of the training in the plane, and the number of failed checkpoints."""
    said = {path.sentence(): {"marker": "o", "markersize": 5.5}}
    if np.isfinite(loss[-1]):
        said[f"the last of them: {style.number(loss[-1])}"] = {"marker": "s", "markersize": 6.5}
    if lost := int((~np.isfinite(loss)).sum()):
        said[f"checkpoints without a loss: {lost}"] = {"marker": "x", "markersize": 5.5}
    plain = {"linestyle": "none", "markerfacecolor": "white", "markeredgecolor": style.INK, "markeredgewidth": 1.0}
    return [page.sign(sheet, text, plain | look) for text, look in said.items()]
