"""The picture of gradient quality, and how numbers are written."""

import itertools

import numpy as np
import pytest
from matplotlib.text import Text

from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures.page import Label, Picture, place_labels
from gradscape.landscapes.draw.figures.quality import quality_figure
from gradscape.landscapes.sampling.fill import sample

from .test_contour import Bowl, plane
from .test_page import PLANE, dated, quality


@pytest.mark.parametrize(
    ("value", "form", "said"),
    [
        (-0.0, ".4g", "0"),
        (-1e-3, ".2f", "0.00"),
        (-0.5, ".2f", "−0.50"),
        (1234.5, ".4g", "1234"),
        (-2.0, ".1f", "−2.0"),
    ],
)
def test_numbers_have_a_minus_sign_and_zero_has_none(value: float, form: str, said: str) -> None:
    assert style.number(value, form) == said


@pytest.mark.parametrize(("value", "said"), [(1e-4, "0.0001"), (2e-5, "2×10⁻⁵"), (500.0, "500"), (1e7, "10⁷")])
def test_ticks_of_many_digits_are_powers_of_ten(value: float, said: str) -> None:
    assert style.power(value) == said


def test_a_mean_that_rounds_to_zero_is_written_without_a_sign_and_titles_keep_apart() -> None:
    dataset, found = quality(PLANE)
    samples = found.samples
    samples["cosine"][:] = np.where(np.isfinite(samples["cosine"]), -1e-3, np.nan)
    figure = quality_figure(dataset, found)
    titles = [ax.title for ax in figure.axes if ax.get_title()]
    assert any("mean cosine 0.00" in title.get_text() for title in titles)
    assert not any("−0.00" in title.get_text() for title in titles)
    rows: dict[float, list] = {}
    for title in titles:
        rows.setdefault(round(title.axes.get_position().y1, 2), []).append(title.get_window_extent())
    for row in rows.values():
        row.sort(key=lambda box: box.x0)
        for left, right in itertools.pairwise(row):
            assert right.x0 - left.x1 > 0.02 * figure.bbox.width  # room enough to tell them apart


def test_cosines_are_as_wide_as_gradients_are_apart() -> None:
    """Grey says that there is no slope above the noise, and not that there is no gradient."""
    every = 4
    figure = quality_figure(*quality(dated(sample(Bowl(), plane(33, 33), gradients=every))))
    maps = [ax for ax in figure.axes if "differences over" in ax.get_title()]
    assert len(maps) == 3
    mesh = maps[0].collections[0]
    shown = np.ma.getmaskarray(mesh.get_array())
    assert shown.shape == (9, 9)
    assert not shown[1:5, 1:-1].any()  # above, episodes fail
    low, high = maps[0].get_xlim()
    edges = np.asarray(mesh.get_coordinates())[0, :, 0]
    assert (edges[0], edges[-1]) == pytest.approx((low, high))
    assert np.diff(edges)[1:-1] == pytest.approx(every * (high - low) / 33)


def panel(*, side: float = 4.0):
    picture = Picture(style.Sheet.of(None, pitch=side), side)
    ax = picture.add_axes((0.1, 0.1, 0.8, 0.8))
    ax.set(xlim=(0, 1), ylim=(0, 1))
    return ax


def test_names_stand_beside_their_places_and_cover_nothing() -> None:
    ax, random = panel(), np.random.default_rng(0)
    places = random.uniform(0.1, 0.9, (20, 2))
    clear = np.concatenate([places, random.uniform(0, 1, (200, 2))])
    names = [Label(f"name {number}", tuple(at)) for number, at in enumerate(places)]
    left = place_labels(ax, names, clear, size=7.0, gaps=(6.0, 12.0, 20.0, 30.0))
    assert len(ax.texts) + len(left) == len(names)
    assert len(ax.texts) >= 10
    ax.figure.canvas.draw()
    boxes = [Text.get_window_extent(text) for text in ax.texts]  # without the line that leads to it
    frame = ax.get_window_extent()
    for number, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:number])
        assert frame.x0 <= box.x0 <= box.x1 <= frame.x1
        assert not any(box.contains(*point) for point in ax.transData.transform(clear))


def test_a_name_without_a_line_is_nearest_to_what_it_names() -> None:
    ax = panel()
    places = np.array([[0.5, 0.5], [0.53, 0.5], [0.5, 0.54], [0.53, 0.54]])
    names = [Label(f"name {number}", tuple(at)) for number, at in enumerate(places)]
    assert place_labels(ax, names, places, size=7.0, gaps=(6.0, 12.0, 20.0, 30.0)) == []
    for number, text in enumerate(ax.texts):
        if text.arrow_patch is None:
            box = text.get_window_extent()
            corners = np.array([[box.x0, box.y0], [box.x1, box.y1]])
            away = ax.transData.transform(places) - np.clip(ax.transData.transform(places), *corners)
            assert np.argmin(np.linalg.norm(away, axis=1)) == number


def test_where_there_is_no_room_there_is_no_name() -> None:
    ax = panel(side=1.0)
    names = [Label("a long name", (0.5, 0.5))] * 5
    left = place_labels(ax, names, np.array([[0.5, 0.5]]), size=7.0, gaps=(6.0,))
    assert len(left) >= 4
