"""The effect of remedies: the loss that descents reach with each, and the landscape without and with one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .. import style
from . import page

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ....studies.remedies import RemedyStudy

PITCH = 7.2  # width on a screen [inch]
ROW = 0.034  # height of a remedy's row, by the width
MAPS = 0.3  # height of the maps, by the width


def plot_remedies(found: RemedyStudy, *, width: float | None = None) -> page.Picture:
    """Draw the median loss of descents with every remedy, and maps without and with the best one.

    Filled marks are remedies with a significant difference from none, and none itself. Hollow marks are not
    distinguishable from none. Raises ValueError if the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH)
    picture = page.Picture(sheet, sheet.width)
    rows = ROW * len(found.rows) + 0.06
    flat = next(iter(found.maps.values())).ndim == 2
    parts = picture.add_gridspec(2, 2, height_ratios=(rows, MAPS))
    ax = picture.add_subplot(parts[0, :])
    page.dress(ax)
    ax.set_box_aspect(rows)
    _draw_rows(ax, found, sheet)
    shown = _shown(found)
    maps = [found.maps[name] for name in shown]
    low, high = (float(find(np.concatenate([one.ravel() for one in maps]))) for find in (np.nanmin, np.nanmax))
    for column, (name, losses) in enumerate(zip(shown, maps, strict=True)):
        panel = picture.add_subplot(parts[1, column])
        page.dress(panel)
        panel.set_box_aspect(1.0)
        if flat:
            panel.imshow(
                losses, origin="lower", extent=(0, 1, 0, 1), aspect="auto", cmap=style.LOSS_MAP, vmin=low, vmax=high
            )
        else:
            panel.plot(np.linspace(0, 1, len(losses)), losses, color=style.INK, linewidth=1)
            panel.set_ylim(low, high)
        panel.set_xlim(0, 1)
        page.name_axes(panel, f"{found.dims[0]}, share of box", f"{found.dims[1]}, share of box" if flat else "loss")
        panel.set_title("without a remedy" if not column else name, size=sheet.small, parse_math=False)
    page.entitle(picture, f"{found.env} · {found.fidelity} · remedies, {found.starts} descents each")
    page.finish(picture, [], columns=2, heading=" · ".join(page.made_by(found)))
    return picture


def _shown(found: RemedyStudy) -> list[str]:
    """Return the names for the maps: no remedy, and the best one among those that change the losses."""
    plain = found.plain.remedy
    changed = [row for row in found.rows if not np.array_equal(found.maps[row.remedy], found.maps[plain])]
    return [plain, *(row.remedy for row in sorted(changed, key=lambda row: row.reached.value)[:1])]


def _draw_rows(ax: Axes, found: RemedyStudy, sheet: style.Sheet) -> None:
    told = {row.remedy for row in (*found.helpful, *found.harmful)}
    for place, row in enumerate(found.rows):
        one = row.reached
        ax.plot([one.low, one.high], [place, place], color=style.INK, linewidth=1)
        fill = style.INK if row.remedy in told or not place else "white"
        ax.plot([one.value], [place], "o", color=style.INK, markerfacecolor=fill, markersize=4)
    ax.axvline(found.plain.reached.value, color=style.INK, linewidth=0.6, linestyle=":")
    ax.set_yticks(range(len(found.rows)), [row.remedy for row in found.rows], size=sheet.small)
    ax.invert_yaxis()
    unit = f" [{found.loss_unit}]" if found.loss_unit else ""
    page.name_axes(ax, f"median loss that descents reach{unit}, with its 95 % interval")
