"""A slice as a small picture without words, to recognise it by."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..store import plane_of
from . import style
from .page import blank_page


def thumbnail_figure(dataset: xr.Dataset) -> Figure:
    """Draw the losses of a slice over the whole of a small page; what is not OK is left grey."""
    figure = blank_page(2.4, 1.8)
    figure.set_layout_engine("none")
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    figure.set_facecolor(style.UNSAMPLED)
    loss = dataset["loss"].to_numpy()
    if plane_of(dataset).rank == 1:
        ax.plot(dataset["u"], loss, color=style.LINE, linewidth=1.2)
        return figure
    scale = style.Scale.of_loss(loss)
    ax.imshow(np.ma.masked_invalid(loss), origin="lower", aspect="auto", cmap=style.LOSS_MAP, norm=scale.norm)
    return figure
