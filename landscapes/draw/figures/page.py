"""The page of a matplotlib picture: its size, title, provenance, legend and files."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Patch

from ...identity import PACKAGE, VERSIONS, simulator_parts, stored_identity, stored_provenance
from ...lattice import with_gradients
from ...measures.undersampled import Undersampled
from ...objective import Status
from ...sampling.refine import Refined
from ...storage.files import print_width, replacing, visible_files
from .. import style
from ..figure import Picture as Picture
from .typesetting import MARGIN, settle, title_room, wrap_text

HANDLE = 4.5  # room of a legend's sign, in the height of its type
# Type in a PDF can be selected and searched, its font goes with it. SVG cannot carry one: there type is outlines, which
# look the same everywhere. Neither holds a clock or a random name, so that equal pictures are equal files.
EMBEDDED: Any = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "gradscape"}
DATED: dict[str, dict[str, Any]] = {"png": {}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
_settings = threading.Lock()  # matplotlib's, which are of the whole process


def head(picture: Picture, ax: Axes, dataset: xr.Dataset, name: str | None = None) -> None:
    """Write the title, a slice's unless named, over the figure and its provenance, small, over the uppermost panel."""
    entitle(picture, name or title(dataset))
    if line := provenance(dataset):
        remark(ax, line)


def entitle(picture: Picture, text: str) -> None:
    """Write a title over the figure."""
    sheet = picture.sheet
    said = wrap_text(text, sheet.width - 2 * MARGIN, sheet.title)
    picture.suptitle(said, size=sheet.title, color=style.INK, parse_math=False)


def remark(ax: Axes, text: str) -> None:
    """Write something small and quiet over a panel."""
    write_over(ax, text, size=sheet_of(ax).small, color=style.QUIET)


def write_over(ax: Axes, text: str, *, size: float, color: str) -> None:
    """Write over a panel, each line in two at most."""
    title = ax.set_title(text, size=size, color=color, parse_math=False)
    picture_of(ax).fitted[title] = text, lambda: title_room(ax)


def picture_of(ax: Axes) -> Picture:
    """Return the picture that a panel is in.

    Raises TypeError where it is in a figure that is no Picture.
    """
    picture = ax.get_figure(root=True)
    if not isinstance(picture, Picture):
        raise TypeError(f"panels are drawn in a Picture, which knows its sheet; got one in a {type(picture).__name__}")
    return picture


def sheet_of(ax: Axes) -> style.Sheet:
    """Return the sheet of the picture that a panel is in."""
    return picture_of(ax).sheet


def evaluated(dataset: xr.Dataset) -> int:
    """Return how many points of a slice are not interpolated."""
    return int((dataset["status"] != Status.INTERPOLATED).sum()) if "status" in dataset else dataset["loss"].size


def title(dataset: xr.Dataset) -> str:
    """Return objective, fidelity and resolution, and how much of it is sampled if not all."""
    identity = stored_identity(dataset)
    points = " \N{MULTIPLICATION SIGN} ".join(str(dataset.sizes[name]) for name in dataset["loss"].dims[::-1])
    said = simulator_parts(identity)
    whole = int(np.prod(identity["plane"]["resolution"]))
    done = int((dataset["status"] != Status.MISSING).sum())
    sampled = evaluated(dataset)
    refined = f", {sampled} sampled" if sampled < dataset["loss"].size else ""
    said.append(f"{points} points{refined}" if done == whole else f"{done} of {whole} points so far")
    return " · ".join(said)


def provenance(dataset: xr.Dataset) -> str:
    """Return version, device, date and command, as far as they are known."""
    known = {**stored_provenance(dataset), **stored_identity(dataset)}
    version = known.get(VERSIONS, {}).get(PACKAGE)
    said = [f"{PACKAGE} {version}"] if version else []
    said += [str(known[key]) for key in ("device", "created", "command") if known.get(key)]
    return " · ".join(said)


def loss_name(dataset: xr.Dataset) -> str:
    """Return what stands along an axis of losses: the word, and their unit if they have one."""
    unit = dataset["loss"].attrs.get("units", "")
    return f"loss [{unit}]" if unit else "loss"


def failure_key(dataset: xr.Dataset) -> list[Patch]:
    """Return one legend entry for each way of failing that occurs, with how often."""
    status = dataset["status"].to_numpy()
    names = style.FAILURES | {Status.MISSING: "not sampled yet"}
    return [
        Patch(**style.STATUS_LOOKS[kind], label=f"{name}: {count} of {evaluated(dataset)}")
        for kind, name in names.items()
        if (count := int((status == kind).sum()))
    ]


def gradient_key(dataset: xr.Dataset) -> list[Patch]:
    """Return the legend entry of the samples that have a loss and no gradient, with how many they are; none of none."""
    lacking = int((dataset["status"] == Status.NO_GRADIENT).sum()) if "status" in dataset else 0
    label = f"{style.NO_GRADIENT}: {lacking} of {evaluated(with_gradients(dataset))}"
    return [Patch(**style.NO_GRADIENT_LOOK, label=label)] if lacking else []


def sampling_key(dataset: xr.Dataset) -> list[Patch]:
    """Return legend entries of how exact a refined slice is, and which share of its cells is undersampled."""
    refined = Refined.of(dataset)
    exact = (
        f"interpolated points: 95 % within {100 * refined.error:.2g} % of the range"
        if refined and refined.error is not None
        else ""
    )
    between = Undersampled.of(dataset)
    lines = [exact, between.describe() if between else ""]
    return [Patch(facecolor="none", edgecolor="none", label=said) for said in lines if said]


def finish(picture: Picture, entries: Sequence[Artist], *, columns: int = 2, heading: str = "") -> None:
    """Put the legend, with a small quiet `heading` if it has one, under the panels, and fit the page's height."""
    if entries:
        _key(picture, entries, columns, heading)
    settle(picture)


def _key(picture: Picture, entries: Sequence[Artist], columns: int, heading: str) -> None:
    """Put a legend under the panels, in fewer columns where it would be wider than the page."""
    sheet, room = picture.sheet, picture.sheet.width - 2 * MARGIN
    legend = picture.legend(
        handles=list(entries),
        labels=[
            wrap_text(str(one.get_label()), room - HANDLE * sheet.tick / 72, sheet.tick, lines=3) for one in entries
        ],
        loc="outside lower center",
        ncols=columns,
        fontsize=sheet.tick,
        frameon=False,
        handlelength=1.8,
        columnspacing=1.6,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)
    if columns > 1 and legend.get_window_extent().width > room * picture.dpi:
        legend.remove()
        _key(picture, entries, columns - 1, heading)
    elif heading:
        legend.set_title(wrap_text(heading, room, sheet.small), prop=FontProperties(size=sheet.small))
        legend.get_title().set(color=style.QUIET, parse_math=False)


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, PDF or SVG, by the file's ending, whole or not at all.

    Raises ValueError where the ending is another.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in DATED:
        raise ValueError(f"a picture is saved as .png, .pdf or .svg; got {path.name!r}")
    with replacing(path) as partial, _settings, rc_context(EMBEDDED):
        dpi = style.DPI if kind == "png" else style.PRINT_DPI
        figure.savefig(partial, metadata=DATED[kind], format=kind, dpi=dpi)


def save_prints(draw: Callable[[float], Figure], path: Path, widths: Sequence[float]) -> list[str]:
    """Write what `draw` draws for a page of so many millimetres as PDF and SVG beside `path`; return their names.

    Those that are there from before are drawn anew, so that none is of something else.

    Raises ValueError where a width is no page's.
    """
    before = {width for file in visible_files(path.parent) if (width := print_width(file.name, path.name))}
    names = []
    for width in dict.fromkeys([*sorted(before), *widths]):
        figure = draw(width)
        for kind in ("pdf", "svg"):
            names.append(f"{path.stem}-{width:g}mm.{kind}")
            save(figure, path.with_name(names[-1]))
    return names
