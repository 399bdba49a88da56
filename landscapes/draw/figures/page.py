"""The page of a matplotlib picture: title, panels, legend and labels in the sizes of its sheet, layout and files."""

from __future__ import annotations

import math
import textwrap
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.textpath import text_to_path
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter
from matplotlib.transforms import Bbox
from numpy.typing import ArrayLike, NDArray

from ...identity import PACKAGE, VERSIONS, simulator_parts, stored_identity, stored_provenance
from ...measures.slice_floor import floor_of
from ...measures.undersampled import Undersampled
from ...objective import Status
from ...plane import Plane
from ...sampling.refine import Refined
from ...space import LOG10, labelled
from ...storage.files import print_width, replacing, visible_files
from .. import style
from ..figure import Picture as Picture
from ..style import mark_decades

if TYPE_CHECKING:
    from ....studies.samples import Bootstrap
    from ...statistics import Estimate

Grid = NDArray[np.float64]

ENDINGS = {kind.name for kind in style.ENDED}  # what samples that failed are called, which are last in a legend
HANDLE = 4.5  # room of a legend's sign, in the height of its type
# Type in a PDF can be selected and searched, its font goes with it. SVG cannot carry one: there type is outlines, which
# look the same everywhere. Neither holds a clock or a random name, so that equal pictures are equal files.
EMBEDDED: Any = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "gradscape"}
DATED: dict[str, dict[str, Any]] = {"png": {}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
_settings = threading.Lock()  # matplotlib's, which are of the whole process


def head(picture: Picture, ax: Axes, dataset: xr.Dataset, name: str | None = None) -> None:
    """Write the title, by default the slice's, over the figure, and its provenance over the uppermost panel."""
    entitle(picture, name or title(dataset))
    if line := provenance(dataset):
        remark(ax, line)


def entitle(picture: Picture, text: str) -> None:
    """Write a title over the figure."""
    sheet = picture.sheet
    said = wrap_text(text, sheet.width - 2 * MARGIN, sheet.title)
    picture.suptitle(said, size=sheet.title, color=style.INK, parse_math=False)


def remark(ax: Axes, text: str) -> None:
    """Write a small grey remark over a panel."""
    write_over(ax, text, size=sheet_of(ax).small, color=style.QUIET)


def write_over(ax: Axes, text: str, *, size: float, color: str) -> None:
    """Write a text over a panel, and break each of its lines once at most."""
    title = ax.set_title(text, size=size, color=color, parse_math=False)
    picture_of(ax).fitted[title] = text, lambda: title_room(ax)


def picture_of(ax: Axes) -> Picture:
    """Return the picture of a panel."""
    return cast("Picture", ax.get_figure(root=True))


def sheet_of(ax: Axes) -> style.Sheet:
    """Return the sheet of a panel's picture."""
    return picture_of(ax).sheet


def evaluated(dataset: xr.Dataset) -> int:
    """Return the number of points of a slice that are not interpolated."""
    return int((dataset["status"] != Status.INTERPOLATED).sum()) if "status" in dataset else dataset["loss"].size


def title(dataset: xr.Dataset) -> str:
    """Return objective, fidelity and resolution, and the progress of an unfinished slice."""
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
    """Return the known ones of version, device, date and command."""
    known = {**stored_provenance(dataset), **stored_identity(dataset)}
    version = known.get(VERSIONS, {}).get(PACKAGE)
    said = [f"{PACKAGE} {version}"] if version else []
    said += [str(known[key]) for key in ("device", "created", "command") if known.get(key)]
    return " · ".join(said)


def made_by(record: Any, *keys: str) -> list[str]:
    """Return the known ones of device, date and command of a study, or of other `keys`."""
    known = {**record.provenance, **record.identity}
    return [str(known[key]) for key in keys or ("device", "created", "command") if known.get(key)]


def loss_name(dataset: xr.Dataset) -> str:
    """Return the label of an axis of losses, with their unit if they have one."""
    return labelled("loss", loss_unit(dataset))


def loss_unit(dataset: xr.Dataset) -> str:
    """Return the unit of losses, empty if they have none."""
    return str(dataset["loss"].attrs.get("units", ""))


def lost_samples(dataset: xr.Dataset, kind: Status, within: str = "") -> str:
    """Return the legend's text for the samples with a status, and their number."""
    count = int((dataset["status"] == kind).sum())
    return f"{style.ENDED[kind]}{within}: {count} of {evaluated(dataset)}"


def sampling_key(dataset: xr.Dataset) -> list[str]:
    """Return the legend's texts on the error of a refined slice, undersampled cells, and the numerical floor."""
    refined, between, floor = Refined.of(dataset), Undersampled.of(dataset), floor_of(dataset)
    said = []
    if refined and refined.error is not None:
        said.append(f"interpolated points: 95 % within {100 * refined.error:.2g} % of the range")
    said.append(between.describe() if between else "")
    return [one for one in (*said, floor.sentence() if floor else "") if one]


def sign(sheet: style.Sheet, label: str, look: Mapping[str, Any]) -> Line2D:
    """Return a legend entry for lines or marks with a look."""
    return Line2D([], [], **sheet.look(look), label=label)


def interval(ax: Axes, x: ArrayLike, y: ArrayLike, label: str | None = "95 % interval") -> None:
    """Draw an interval from one end to the other, with a legend entry if it has a `label`."""
    ax.plot(x, y, **sheet_of(ax).look(style.INTERVAL_LINE), gid="interval", label=label)


def ends_of(estimates: Iterable[Estimate | Bootstrap]) -> Grid:
    """Return values and both ends of their intervals, shape (estimate, 3), NaN where unknown."""
    return np.array([(one.value, one.low, one.high) for one in estimates], dtype=float).reshape(-1, 3)


def draw_rows(
    ax: Axes, ends: Grid, look: Mapping[str, Any], label: str, *, gid: str, within: str = "95 % interval"
) -> None:
    """Draw each known estimate in its row with its interval, from `ends_of`."""
    for row in np.flatnonzero(np.isfinite(ends[:, 0])):
        ax.plot(ends[row, :1], [row], **sheet_of(ax).look(look), gid=gid, label=label)
        interval(ax, ends[row, 1:], [row, row], within)


def finish(
    picture: Picture,
    more: Sequence[Artist | str] = (),
    *,
    columns: int = 2,
    heading: str = "",
    like: Picture | None = None,
) -> None:
    """Put the legend under the panels, with a small grey `heading` if given, and fit the page's height.

    The legend has an entry for each label in the panels and each of `more`; a text in `more` has no sign. A picture
    `like` another one, for a film, has the same height and layout.
    """
    drawn = [pair for ax in picture.axes for pair in zip(*ax.get_legend_handles_labels()[::-1], strict=True)]
    signs = [Patch(visible=False, label=one) if isinstance(one, str) else one for one in more]
    entries: dict[str, Artist] = {}
    for label, one in [*drawn, *((str(sign.get_label()), sign) for sign in signs)]:
        entries.setdefault(label, one[0] if isinstance(one, ErrorbarContainer) else one)
    if entries:
        _key(picture, dict(sorted(entries.items(), key=lambda entry: entry[1].get_gid() in ENDINGS)), columns, heading)
    if like is None:
        settle(picture)
        return
    picture.set_size_inches(*like.get_size_inches())
    for ax, other in zip(picture.axes, like.axes, strict=True):
        ax.set_position(other.get_position())
    for text, written in zip(picture.texts, like.texts, strict=True):
        text.set_position(written.get_position())
    _wrap(picture)


def _key(picture: Picture, entries: Mapping[str, Artist], columns: int, heading: str) -> None:
    """Put a legend under the panels, in fewer columns if it would be wider than the page."""
    sheet, room = picture.sheet, picture.sheet.width - 2 * MARGIN
    wide = room - HANDLE * sheet.tick / 72
    labels = [wrap_text(label, wide, sheet.tick, lines=3) for label in entries]
    legend = picture.legend(
        list(entries.values()), labels, loc="outside lower center", ncols=columns, fontsize=sheet.tick, frameon=False,
        handlelength=1.8, columnspacing=1.6,
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)
    if columns > 1 and legend.get_window_extent().width > room * picture.dpi:
        legend.remove()
        _key(picture, entries, columns - 1, heading)
    elif heading:
        legend.set_title(wrap_text(heading, room, sheet.small), prop=FontProperties(size=sheet.small))
        legend.get_title().set(color=style.QUIET, parse_math=False)


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, PDF or SVG, by the ending of the file name, whole or not at all.

    Raises ValueError for any other ending.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in DATED:
        raise ValueError(f"a picture is saved as .png, .pdf or .svg; got {path.name!r}")
    with replacing(path) as partial, _settings, rc_context(EMBEDDED):
        dpi = style.DPI if kind == "png" else style.PRINT_DPI
        figure.savefig(partial, metadata=DATED[kind], format=kind, dpi=dpi)


def save_prints(draw: Callable[[float], Figure], path: Path, widths: Sequence[float]) -> list[str]:
    """Draw for pages of some `widths` [mm], write PDF and SVG next to `path`, and return their names.

    Existing ones for other widths are drawn again, so that none is out of date.

    Raises ValueError if a width is not that of a page.
    """
    before = {width for file in visible_files(path.parent) if (width := print_width(file.name, path.name))}
    names = []
    for width in dict.fromkeys([*sorted(before), *widths]):
        figure = draw(width)
        for kind in ("pdf", "svg"):
            names.append(f"{path.stem}-{width:g}mm.{kind}")
            save(figure, path.with_name(names[-1]))
    return names


NARROW = 1.8  # room of a panel that has fewer ticks [inch]
DECADES = 3, 6  # ticks of a logarithmic axis, about, in a narrow panel and in another


def panels(sheet: style.Sheet, count: int, *, share: bool = False) -> tuple[Picture, list[Axes]]:
    """Return a picture with `count` panels in the columns of the sheet; the panels may share their axes."""
    columns = min(count, sheet.columns)
    rows = -(-count // columns)
    picture = Picture(sheet, rows * sheet.pitch)
    every = list(picture.subplots(rows, columns, sharex=share, sharey=share, squeeze=False).flat)
    for empty in every[count:]:
        empty.remove()
    return picture, every[:count]


def panel(sheet: style.Sheet, shape: float) -> tuple[Picture, Axes]:
    """Return a picture of one panel with ticks and frame, `shape` times as high as wide."""
    picture, (ax,) = panels(sheet, 1)
    dress(ax)
    ax.set_box_aspect(shape)
    return picture, ax


LINE_PITCH, LINE_ROOM = 8.0, 1.2  # width of a page of panels over a line on a screen, room next to them [inch]
FLATTEST = 0.55  # of these panels, against those on a screen: narrow ones are drawn higher than they would be


def stack(sheet: style.Sheet, heights: Sequence[float]) -> tuple[Picture, list[Axes]]:
    """Return panels of some heights [inch] one below the other, which share the horizontal axis."""
    picture = Picture(sheet, sum(heights) + 1.6)
    axes = list(picture.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0])
    for ax, height in zip(axes, heights, strict=True):
        ax.set_box_aspect(height / (sheet.width - LINE_ROOM * sheet.type))
    return picture, axes


def dress(ax: Axes, plane: Plane | None = None) -> None:
    """Give a panel its ticks and frame.

    With a `plane`, whose limits the panel must already have, logarithmic parameters have ticks at decades.
    """
    sheet = sheet_of(ax)
    ax.tick_params(which="both", **_ticks(sheet))
    ax.tick_params(which="minor", length=2 * sheet.type)
    ax.spines[:].set(color=style.QUIET, linewidth=max(0.4, 0.6 * sheet.weight))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(5 if sheet.pitch > NARROW else 3))
    for number, scale in enumerate(plane.scales if plane else ()):
        if scale == LOG10:
            mark_decades((ax.xaxis, ax.yaxis)[number], DECADES[sheet.pitch > NARROW])


def log_axis(*axes: Axis) -> None:
    """Make axes logarithmic, with round values for the data drawn so far, and fewer of them in a small panel."""
    for axis in axes:
        (axis.axes.set_xscale if axis is axis.axes.xaxis else axis.axes.set_yscale)("log")
        low, high = np.log10(sorted(axis.get_view_interval()))
        ticks = style.decades(low, high, DECADES[sheet_of(axis.axes).pitch > NARROW])
        axis.set_major_locator(FixedLocator([10.0**tick for tick in ticks]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: style.write_power(math.log10(value))))
        axis.set_minor_formatter(NullFormatter())


def name_axes(ax: Axes, x: str | None = None, y: str | None = None) -> None:
    """Label the axes."""
    for axis, said in ((ax.xaxis, x), (ax.yaxis, y)):
        if said is not None:
            _name(ax, axis, said, (lambda: title_room(ax)) if axis is ax.xaxis else (lambda: side_room(ax)))


def name_outer(ax: Axes, x: str, y: str) -> None:
    """Label the axes of one of several panels over the same plane, once for each row and column."""
    spec = ax.get_subplotspec()
    assert spec is not None  # as `grid` made it
    others = [other for panel in picture_of(ax).axes if (other := panel.get_subplotspec()) is not None]
    lowest = not any(one.rowspan.start > spec.rowspan.start and one.colspan == spec.colspan for one in others)
    ax.label_outer()
    ax.tick_params(labelbottom=lowest)
    name_axes(ax, x if lowest else "", y if spec.is_first_col() else "")


def _name(ax: Axes, axis: Axis, said: str, room: Callable[[], float]) -> None:
    axis.set_label_text(said, size=sheet_of(ax).label, color=style.INK, parse_math=False)
    picture_of(ax).fitted[axis.label] = said, room


def caption(ax: Axes, text: str) -> None:
    """Write the caption of a panel over it."""
    write_over(ax, text, size=sheet_of(ax).label, color=style.INK)


def colour_bar(
    ax: Axes,
    drawn: ScalarMappable,
    label: str,
    scale: style.Scale | None = None,
    *,
    beside: Sequence[Axes] = (),
    **how: Any,
) -> Colorbar:
    """Put a colour bar next to one or several panels, with plain numbers on a logarithmic scale."""
    sheet = sheet_of(ax)
    place: dict[str, Any] = {
        "fraction": 0.05, "pad": 0.02, "extend": scale.extend if scale else "neither",
        "use_gridspec": False,  # the panel keeps its place in the grid, from which the page is laid out
    }  # fmt: skip
    bar = ax.figure.colorbar(drawn, ax=[*beside] or ax, **place | how)
    lying = bar.orientation == "horizontal"
    _name(ax, bar.long_axis, label, (lambda: title_room(ax)) if lying else (lambda: side_room(ax)))
    bar.ax.tick_params(which="both", **_ticks(sheet))
    bar.ax.tick_params(which="minor", length=2 * sheet.type)
    bar.outline.set(edgecolor=style.QUIET, linewidth=max(0.4, 0.6 * sheet.weight))
    if scale and scale.logarithmic:
        bar.long_axis.set_major_locator(FixedLocator(scale.ticks()))
        bar.long_axis.set_major_formatter(FuncFormatter(lambda value, _: style.power(value)))
        bar.long_axis.set_minor_formatter(NullFormatter())
    return bar


def _ticks(sheet: style.Sheet) -> dict[str, Any]:
    return {
        "labelsize": sheet.tick, "color": style.QUIET, "labelcolor": style.INK, "length": 3 * sheet.type,
        "width": max(0.4, 0.8 * sheet.weight), "pad": 3.5 * sheet.type,
    }  # fmt: skip


MARGIN = 0.1  # between type and the edge of the page [inch]
HINTED = 1.06  # small type whose letters are moved to whole pixels is up to so much wider
MORE, MIN_LINE = " …", 3  # what stands for the rest of a text; characters of a line
BESIDE = 1.2  # length of what is written up a panel's side, against it, at most
AMPLE = 3.0  # height to begin with that no legend or title uses up [inch]
NEARLY, TURNS = 0.02, 8  # as high as it has to be [inch]; most attempts at it


def settle(picture: Picture) -> None:
    """Fit the page's height to its contents, with panels as wide as possible in their proportions, and fix the layout.

    Meanwhile panels fill their whole space, because the layout takes any space that a panel leaves for margins.
    """
    shapes = {ax: shape for ax in picture.axes if (shape := ax.get_box_aspect()) and ax.get_subplotspec()}
    for ax in shapes:  # a colour bar has no place in the grid: it goes with its panel
        ax.set_box_aspect(None)
    _set_height(picture, picture.get_figheight() + AMPLE)
    for turn in range(TURNS):
        if turn < TURNS / 2:  # or lines might break now here, now there
            _wrap(picture)
        _lay_out(picture)
        if abs(lack := _missing_height(picture, shapes)) < NEARLY:
            break
        _set_height(picture, picture.get_figheight() + lack)
    for ax, shape in shapes.items():
        ax.set_box_aspect(shape)
        ax.apply_aspect()


def _set_height(picture: Picture, height: float) -> None:
    """Set the height of the page [inch], rounded to whole pixels of a screen."""
    picture.set_figheight(round(height * style.DPI) / style.DPI)


def _lay_out(picture: Picture) -> None:
    """Place the panels by matplotlib's constrained layout.

    The layout spends most of its time on measuring panels, several times at one position, and a shared colour bar once
    for each of its panels. Each time it computes the ticks and their boxes of both axes up to eight times.
    """
    with ExitStack() as kept:
        for ax in picture.axes:
            _ask_once(ax, "get_tightbbox", ax, kept)
            for axis, name in product((ax.xaxis, ax.yaxis), ("_update_ticks", "_get_ticklabel_bboxes")):
                _ask_once(axis, name, ax, kept)
        ConstrainedLayoutEngine().execute(picture)


def _ask_once(artist: Artist, name: str, ax: Axes, kept: ExitStack) -> None:
    """Cache a method of a panel or its axis until the panel moves or `kept` is closed."""
    ask: Callable[..., Any] | None = getattr(artist, name, None)
    if ask is None:  # a matplotlib that has no such method is only slower
        return
    known: dict[str, Any] = {}

    def answer(*about: Any, **how: Any) -> Any:
        if known.get("place") != ax.bbox.bounds:
            known["answer"] = ask(*about, **how)
            known["place"] = ax.bbox.bounds  # afterwards: measuring a panel gives it its proportions
        return known["answer"]

    setattr(artist, name, answer)
    kept.callback(delattr, artist, name)


def _missing_height(picture: Picture, shapes: Mapping[Axes, float]) -> float:
    """Return the height [inch] that the page lacks for its panels to have their shapes, height over width."""
    width, height = picture.get_size_inches()
    rows: dict[int, float] = {}
    for ax, shape in shapes.items():
        room, spec = ax.get_position(), ax.get_subplotspec()
        assert spec is not None  # as the panels were chosen
        row, need = spec.rowspan.start, shape * room.width * width - room.height * height
        rows[row] = max(need, rows.get(row, need))
    return float(sum(rows.values()))


def _wrap(picture: Picture) -> None:
    for text, (said, room) in picture.fitted.items():
        size = float(text.get_fontsize())
        text.set_text("\n".join(wrap_text(line, room(), size) for line in said.split("\n")))


def title_room(ax: Axes) -> float:
    """Return the space [inch] for a text centred over a panel, from its columns of the page."""
    spec, box, (width, _) = ax.get_subplotspec(), ax.get_position(), _page_size(ax)
    if spec is None:
        return width
    columns = spec.get_gridspec().ncols
    middle = (box.x0 + box.x1) / 2
    aside = min(middle - spec.colspan.start / columns, spec.colspan.stop / columns - middle)
    return float(2 * width * aside - MARGIN)


def side_room(ax: Axes) -> float:
    """Return the space [inch] for a text along a panel's side."""
    return float(BESIDE * ax.get_position().height * _page_size(ax)[1])


def _page_size(ax: Axes) -> tuple[float, float]:
    page = ax.get_figure(root=True)
    assert page is not None  # panels are on one
    width, height = page.get_size_inches()
    return float(width), float(height)


@lru_cache(1024)  # a page is laid out several times, with the same texts
def wrap_text(text: str, width: float, size: float, *, lines: int = 2) -> str:
    """Break a text in a type size [pt] into at most `lines` about equal lines of a width [inch]."""
    broken, fits = [text], len(text)
    while fits > MIN_LINE and (most := max(text_width(line, size) for line in broken)) > width:
        fits = min(fits - 1, int(1.1 * fits * width / most))
        broken = _break_lines(text, max(fits, MIN_LINE), lines)
    shorter = broken
    while fits > MIN_LINE and len(shorter) == len(broken) > 1 and not shorter[-1].endswith(MORE):
        broken, fits = shorter, fits - 1
        shorter = _break_lines(text, fits, lines)
    return "\n".join(broken)


def _break_lines(text: str, fits: int, lines: int) -> list[str]:
    return textwrap.wrap(text, fits, max_lines=lines, placeholder=MORE, break_on_hyphens=False) or [text]


@lru_cache(4096)
def text_width(text: str, size: float) -> float:
    """Return an upper bound on the width [inch] of a text in a type size [pt], on screen and paper."""
    width, _, _ = text_to_path.get_text_width_height_descent(text, FontProperties(size=size), ismath=False)
    return HINTED * float(width) / 72


SIDES = (  # right, up: where a name may stand, in the order tried; from the second gap on all of them
    *((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)),
    *((0.5, 1), (1, 0.5), (1, -0.5), (0.5, -1), (-0.5, -1), (-1, -0.5), (-1, 0.5), (-0.5, 1)),
)
NEAR_SIDES = 8  # of the sides
NOTHING: Grid = np.zeros((0, 2))
ROOM = 1.15  # of a line, in the size of its type


@dataclass(frozen=True)
class Label:
    """A text, and the position in a panel that it names [data]."""

    text: str
    at: tuple[float, float]


def place_labels(
    ax: Axes,
    names: Sequence[Label],
    clear: Grid,
    *,
    rather: Grid = NOTHING,
    size: float,
    gaps: Sequence[float],
    gid: str = "name",
) -> list[int]:
    """Write names next to their positions, in order, and return the indices of those that do not fit.

    A name is inside the panel, at the first of `gaps` [pt] that works. It covers no other name and none of the points
    `clear`, shape (point, 2) [data], and if possible none of the points `rather`. It is nearer to its own position than
    to any other; from the second gap on, a line leads to the position instead. The panel must have its final position
    on the page.
    """
    dot = ax.figure.dpi / 72
    origins = ax.transData.transform(np.array([name.at for name in names]).reshape(-1, 2))
    points = [ax.transData.transform(some.reshape(-1, 2)) for some in (np.concatenate([clear, rather]), clear)]
    crowd = _Crowd(ax.get_window_extent().padded(-dot), origins)
    left = []
    for number, name in enumerate(names):
        half = np.array([text_width(name.text, size) * 72, ROOM * size]) * dot / 2
        for avoided, (far, gap), side in product(points, enumerate(gaps), SIDES):
            shift = np.array(side) * (half + gap * dot)
            if not far and side not in SIDES[:NEAR_SIDES]:
                continue
            if crowd.takes(number, shift, half, avoided, led=far > 0):
                x, y = (shift / dot).tolist()
                text = ax.annotate(
                    name.text, name.at, (x, y), textcoords="offset points", ha="center", va="center", size=size,
                    arrowprops=style.LEADER if far else None, parse_math=False, gid=gid, **style.NAME_TEXT,
                )  # fmt: skip
                text.set_in_layout(False)  # it has found its room
                break
        else:
            left.append(number)
    return left


class _Crowd:
    """The occupied parts of a panel [pixel]: named positions, boxes of names, and points along lines to them."""

    def __init__(self, frame: Bbox, origins: Grid) -> None:
        self.frame, self.origins = frame, origins
        self.boxes: list[Bbox] = []
        self.lines = NOTHING

    def takes(self, number: int, shift: Grid, half: Grid, points: Grid, *, led: bool) -> bool:
        """Occupy a box for a position, and the line that leads there, if nothing is in the way."""
        own, others = self.origins[number], np.delete(self.origins, number, axis=0)
        box = Bbox([own + shift - half, own + shift + half])
        inside = np.all(box.min >= self.frame.min) and np.all(box.max <= self.frame.max)
        if not inside or box.count_overlaps(self.boxes):
            return False
        if box.count_contains(np.concatenate([points, self.origins, self.lines])):
            return False
        path = NOTHING
        if led:
            path = own + np.linspace(0.05, 1.0, 48)[:, None] * shift
            path = path[(np.abs(path - own - shift) >= half).any(axis=1)]  # up to the box
            far = others[np.linalg.norm(others - own, axis=1) >= 2 * half[1]]  # a nearer one cannot be passed
            passed = np.linalg.norm(path[:, None] - far, axis=-1) < half[1]
            if passed.any() or any(one.count_contains(path) for one in self.boxes):
                return False
        elif len(others):
            away = [np.linalg.norm(np.maximum(np.abs(at - own - shift) - half, 0), axis=-1) for at in (own, others)]
            if (away[1] <= away[0]).any():
                return False
        self.boxes.append(box)
        self.lines = np.concatenate([self.lines, path])
        return True
