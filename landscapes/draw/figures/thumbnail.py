"""A slice as a small picture without text."""

from __future__ import annotations

import numpy as np
import xarray as xr

from ...identity import plane_of
from ...lattice import own_cells, sampled_line
from .. import style
from ..figure import Picture

WIDTH, SHAPE = 2.4, 0.75  # of the page [inch]; its height, against its width


def thumbnail_figure(dataset: xr.Dataset, *, width: float | None = None) -> Picture:
    """Draw the losses of a slice over the whole of a small page; what is not OK is left grey."""
    sheet = style.Sheet.of(width, pitch=WIDTH)
    picture = Picture(sheet, SHAPE * sheet.width)
    ax = picture.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    picture.set_facecolor(style.UNSAMPLED)
    dataset = sampled_line(dataset) if plane_of(dataset).rank == 1 else own_cells(dataset)
    loss = dataset["loss"].to_numpy()
    if plane_of(dataset).rank == 1:
        ax.plot(dataset["u"], loss, color=style.LOSS_LINE, linewidth=1.2)
        return picture
    scale = style.Scale.of_loss(loss)
    ax.imshow(np.ma.masked_invalid(loss), origin="lower", aspect="auto", cmap=style.LOSS_MAP, norm=scale.norm)
    return picture
