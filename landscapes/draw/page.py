"""The page a matplotlib picture stands on: size, title, provenance, legend and file."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ..files import replacing
from ..identity import stored_identity, stored_provenance
from ..objective import Status
from . import style


def blank_page(width: float, height: float) -> Figure:
    """Return an empty figure of a size [inch] that draws without a window or any global state."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def head(figure: Figure, ax: Axes, dataset: xr.Dataset, name: str | None = None, *, width: int = 92) -> None:
    """Write the title, a slice's unless named, over the figure and its provenance, small, over the uppermost panel.

    `width` is how many characters of it fit over the panel.
    """
    figure.suptitle(wrapped(name or title(dataset), 56), size=style.TITLE, color=style.INK, parse_math=False)
    if line := provenance(dataset):
        ax.set_title(wrapped(line, width), size=style.SMALL, color=style.QUIET, parse_math=False)


def title(dataset: xr.Dataset) -> str:
    """Return objective, fidelity and resolution, and how much of it is sampled if not all."""
    identity = stored_identity(dataset)
    points = " \N{MULTIPLICATION SIGN} ".join(str(dataset.sizes[name]) for name in dataset["loss"].dims[::-1])
    said = [str(identity[key]) for key in ("objective", "fidelity") if identity.get(key)]
    whole = int(np.prod(identity["plane"]["resolution"]))
    done = int((dataset["status"] != Status.MISSING).sum())
    said.append(f"{points} points" if done == whole else f"{done} of {whole} points so far")
    return " · ".join(said)


def provenance(dataset: xr.Dataset) -> str:
    """Return version, device, date and command, as far as they are known."""
    known = {**stored_provenance(dataset), **stored_identity(dataset)}
    said = [f"gradscape {known['gradscape']}"]
    said += [str(known[key]) for key in ("device", "created", "command") if known.get(key)]
    return " · ".join(said)


def failure_key(dataset: xr.Dataset) -> list[Patch]:
    """Return one legend entry for each way of failing that occurs, with how often."""
    status = dataset["status"].to_numpy()
    names = style.FAILURES | {Status.MISSING: "not sampled yet"}
    return [
        Patch(**style.LOOKS[kind], label=f"{name}: {count} of {status.size}")
        for kind, name in names.items()
        if (count := int((status == kind).sum()))
    ]


def key(figure: Figure, entries: Sequence[Artist], *, columns: int = 2) -> None:
    """Put a legend under the panels, in fewer columns where it would be wider than the page."""
    if entries:
        legend = figure.legend(
            handles=list(entries),
            loc="outside lower center",
            ncols=columns,
            fontsize=style.TICK,
            frameon=False,
            handlelength=1.8,
            columnspacing=1.6,
        )
        for text in legend.get_texts():
            text.set_parse_math(False)
        if columns > 1 and legend.get_window_extent().width > figure.bbox.width:
            legend.remove()
            key(figure, entries, columns=columns - 1)


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    with replacing(Path(path)) as partial:
        figure.savefig(partial, format="png", dpi=style.DPI)


def wrapped(text: str, width: int) -> str:
    """Break a text into at most two lines of so many characters."""
    return "\n".join(textwrap.wrap(text, width, max_lines=2, placeholder=" …"))
