"""The map of a league: a number in each cell that is legible there, and a hatch where a method did not run."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb
from matplotlib.patches import Rectangle

from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures.search import league_figure

METHODS = ["bo-leap", "cma-es-gradient", "descents", "random"]
RANK = np.array([[1.0, 2.25, 3.0, 3.75], [1.5, np.nan, 1.5, 3.0], [1.25, 2.25, 2.25, 3.4]])


def dataset() -> xr.Dataset:
    parts = {"rank": RANK, "rank_low": RANK - 0.2, "rank_high": RANK + 0.3}
    return xr.Dataset(
        {name: (("scene", "method"), values) for name, values in parts.items()},
        {"scene": ["fluid", "swing-stiffness", "all scenes"], "method": METHODS},
        {"title": "League of 4 methods", "seeds": "10", "command": "landscape league"},
    )


def luminance(colour: tuple[float, ...]) -> float:
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in colour[:3]]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))


@pytest.mark.parametrize("width", [None, 85.0, 170.0])
def test_each_cell_has_its_rank_and_a_method_that_did_not_run_a_hatch(width: float | None) -> None:
    picture = league_figure(dataset(), width=width)
    ax = picture.axes[0]
    said = {(round(one.get_position()[0]), round(one.get_position()[1])): one for one in ax.texts}
    hatched = [one.get_xy() for one in ax.patches if isinstance(one, Rectangle) and one.get_hatch()]
    assert hatched == [(0.5, 0.5)]
    assert len(said) == np.isfinite(RANK).sum()
    first = [one.get_text() for one in ax.texts if round(one.get_position()[1]) == 0]
    assert {"1.00", "2.25", "3.75"} <= set(first) or {"1", "2.2", "3.8"} <= set(first)
    assert [one.get_text() for one in ax.get_yticklabels()] == ["fluid", "swing-stiffness", "all scenes"]


def test_intervals_are_left_out_where_there_is_no_room_and_the_legend_says_so() -> None:
    many = xr.concat(
        [dataset().assign_coords(method=[f"{name}{part}" for name in METHODS]) for part in range(3)], "method"
    )
    many.attrs = dataset().attrs
    for width, told in ((None, True), (85.0, False)):
        picture = league_figure(many, width=width)
        assert any(" to " in one.get_text() for one in picture.axes[0].texts) == told
        assert any("intervals are in league.json" in one.get_text() for one in picture.legends[0].get_texts()) != told


def test_texts_do_not_leave_their_cells() -> None:
    picture = league_figure(dataset())
    picture.canvas.draw()
    ax = picture.axes[0]
    cell = ax.get_window_extent().width / len(METHODS)
    assert all(one.get_window_extent().width < cell for one in ax.texts)


def test_ink_is_legible_on_every_rank_and_no_grey() -> None:
    for share in np.linspace(0, 1, 101):
        colour = style.RANK_MAP(share)
        assert style.text_on(colour) in ("black", "white")
        light, dark = sorted((luminance(colour), luminance(to_rgb(style.text_on(colour)))), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 4.5
    assert all(np.ptp(to_rgb(ink)) > 0.04 for ink in style.TINTED)  # a dark page turns greys over
