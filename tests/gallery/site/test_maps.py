"""The pictures of a slice's page that are drawn in the browser: what every control does, and what a frame costs."""

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import LogNorm, Normalize
from PIL import Image
from scipy.stats import rankdata

from gradscape.landscapes.draw.style import LOSS_MAP, Scale
from gradscape.landscapes.lattice import own_cells
from gradscape.landscapes.measures.undersampled import contradicted_cells
from gradscape.landscapes.objective import Status
from gradscape.landscapes.storage.store import open_slice

from .browsing import DRAWN, pixels, point_at, told

Visit = Callable[..., Any]


@pytest.fixture
def losses(ledge_data: Path) -> np.ndarray[Any, Any]:
    return open_slice(ledge_data / "coarse/slice.zarr")["loss"].to_numpy()


def colours_of(shares: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return 255 * np.asarray(LOSS_MAP(np.clip(shares, 0, 1)))[..., :3]


def seen(page: Any, *, border: float = 2) -> dict[tuple[int, int], np.ndarray[Any, Any]]:
    """Return the colour at every node that lies well within the window of the map."""
    picture, found = pixels(page, "map"), {}
    places = page.evaluate("Array.from(losses, (_, index) => spot(index))")
    left, top, wide, tall = page.evaluate("[PAD.left, PAD.top, box.width, box.height]")
    count = page.evaluate("columns")
    for index, (right, down) in enumerate(places):
        if left + border < right < left + wide - border and top + border < down < top + tall - border:
            found[divmod(index, count)] = picture[int(down), int(right), :3]
    return found


@pytest.mark.parametrize("name", ["linear", "logarithmic", "rank"])
def test_colours_are_those_of_the_scale_that_is_chosen(
    name: str, ledges: str, losses: np.ndarray[Any, Any], visit: Visit
) -> None:
    page = visit(ledges, "coarse/index.html")
    page.select_option("#scale", name)
    finite = np.isfinite(losses)
    low, high = np.nanmin(losses), np.nanmax(losses)
    shares = {"linear": Normalize(low, high), "logarithmic": LogNorm(low, high)}.get(name, lambda values: values)(
        losses
    )
    if name == "rank":
        shares = np.full(losses.shape, np.nan)
        shares[finite] = (rankdata(losses[finite].astype(np.float32)) - 1) / (finite.sum() - 1)
    nodes, without = seen(page), page.evaluate("node")
    assert len(nodes) == losses.size
    for (row, column), colour in nodes.items():
        if finite[row, column] and row * 16 + column != without:
            np.testing.assert_allclose(colour, colours_of(shares[row, column]), atol=4, err_msg=f"{row}, {column}")


def test_a_window_shows_the_nodes_that_it_says(ledges: str, losses: np.ndarray[Any, Any], visit: Visit) -> None:
    page = visit(ledges, "coarse/index.html")
    page.evaluate("setView(2.5, 0.31, 0.13)")
    nodes, node = seen(page, border=6), page.evaluate("node")
    assert 30 < len(nodes) < 49  # about a sixth of 256
    norm = Normalize(np.nanmin(losses), np.nanmax(losses))
    for (row, column), colour in nodes.items():
        if np.isfinite(losses[row, column]) and row * 16 + column != node:
            np.testing.assert_allclose(colour, colours_of(norm(losses[row, column])), atol=4)
    for row, column in nodes:
        page.mouse.move(*point_at(page, row, column))
        assert page.evaluate("node") == row * 16 + column


def test_keys_zoom_at_the_node_and_the_window_goes_along(ledges: str, visit: Visit) -> None:
    page = visit(ledges, "coarse/index.html")
    page.mouse.move(*point_at(page, 4, 11))
    page.focus("#map")
    before = page.evaluate("spot(node)")
    page.keyboard.press("+")
    page.keyboard.press("+")
    assert page.evaluate("view.zoom") == pytest.approx(2.25)
    assert page.evaluate("spot(node)") == pytest.approx(before)
    for _ in range(12):
        page.keyboard.press("ArrowUp")
        assert page.evaluate("inside(spot(node))")
    assert page.evaluate("at(node)") == [11, 15]
    page.keyboard.press("-")
    assert page.evaluate("view.zoom") == pytest.approx(1.5)
    page.keyboard.press("0")
    assert page.evaluate("[view.zoom, view.right, view.up]") == [1, 0, 0]
    for _ in range(20):
        page.click("#closer")
    assert page.evaluate("view.zoom") == 4  # of 16 nodes, four are seen
    page.click("#farther")
    assert page.evaluate("view.zoom") == pytest.approx(4 / 1.5)
    page.click("#whole")
    assert page.evaluate("view.zoom") == 1


def test_the_wheel_zooms_only_a_map_that_has_the_focus(ledges: str, visit: Visit) -> None:
    page = visit(ledges, "coarse/index.html")
    place = point_at(page, 4, 11)
    page.mouse.move(*place)
    page.mouse.wheel(0, 60)
    page.wait_for_function("scrollY > 0")
    assert page.evaluate("view.zoom") == 1
    page.focus("#map")
    page.mouse.move(*point_at(page, 4, 11))
    before, scrolled = page.evaluate("spot(4 * columns + 11)"), page.evaluate("scrollY")
    page.mouse.wheel(0, -150)
    page.wait_for_function("view.zoom > 1.2")
    assert page.evaluate("spot(4 * columns + 11)") == pytest.approx(before, abs=1)  # a pixel
    assert page.evaluate("scrollY") == scrolled


def test_a_drag_moves_the_window_and_shows_no_episode(ledges: str, visit: Visit) -> None:
    page = visit(ledges, "coarse/index.html")
    page.evaluate("setView(2, 0.2, 0.3)")
    first, then = point_at(page, 8, 7), point_at(page, 10, 9)
    page.mouse.move(*first)
    page.mouse.down()
    page.mouse.move(*then, steps=4)
    page.mouse.up()
    assert point_at(page, 8, 7) == pytest.approx(then, abs=1)
    page.mouse.move(*then)
    assert page.evaluate("at(node)") == [7, 8]


def test_two_fingers_zoom_between_them(ledges: str, visit: Visit) -> None:
    page = visit(ledges, "coarse/index.html")
    page.evaluate("""() => {
        canvas.setPointerCapture = () => {};
        const frame = canvas.getBoundingClientRect();
        const touch = (kind, pointerId, right) => canvas.dispatchEvent(new PointerEvent(kind, {
            pointerId, pointerType: "touch", clientX: frame.left + PAD.left + right * box.width,
            clientY: frame.top + PAD.top + box.height / 2, buttons: 1, bubbles: true,
        }));
        touch("pointerdown", 1, 0.4);
        touch("pointerdown", 2, 0.6);
        touch("pointermove", 1, 0.3);
        touch("pointermove", 2, 0.7);
        touch("pointerup", 1, 0.3);
        touch("pointerup", 2, 0.7);
    }""")
    assert page.evaluate("view.zoom") == pytest.approx(2)
    assert page.evaluate("[view.right, view.up]") == pytest.approx([0.25, 0.25], abs=0.02)


def test_isolines_cross_every_edge_between_losses_on_both_sides_and_none_at_a_failure(
    ledges: str, losses: np.ndarray[Any, Any], visit: Visit
) -> None:
    page = visit(ledges, "coarse/index.html")
    shares = (losses - np.nanmin(losses)) / np.ptp(losses[np.isfinite(losses)])
    for share in (0.1, 0.5, 0.9):
        parts = np.array(page.evaluate(f"Array.from(isoline({share}))")).reshape(-1, 2)
        whole = np.isfinite(shares[1:, 1:] + shares[1:, :-1] + shares[:-1, 1:] + shares[:-1, :-1])
        expected = []
        for axis in (0, 1):
            low, high = np.moveaxis(shares, axis, 0)[:-1], np.moveaxis(shares, axis, 0)[1:]
            beside = np.pad(whole, 1)
            cells = beside[1:-1, 1:] | beside[1:-1, :-1] if axis == 0 else beside[1:, 1:-1] | beside[:-1, 1:-1]
            for at, line in np.argwhere(((low > share) != (high > share)) & np.moveaxis(cells, axis, 0)):
                place = at + (share - low[at, line]) / (high[at, line] - low[at, line])
                expected.append((line, place) if axis == 0 else (place, line))
        apart = np.abs(parts[:, None] - np.array(expected)).max(axis=-1)
        assert apart.min(axis=0).max() < 1e-4  # each is crossed
        assert apart.min(axis=1).max() < 1e-4  # and nothing else is
    plain = pixels(page, "map")
    page.check("input[name=isolines]")
    assert (pixels(page, "map") != plain).any()
    page.uncheck("input[name=isolines]")
    assert (pixels(page, "map") == plain).all()


def test_arrows_are_thinned_by_the_zoom(ledges: str, visit: Visit) -> None:
    page = visit(ledges, "fine/index.html")
    page.evaluate("""() => {
        window.drawn = [];
        const plain = arrow;
        arrow = (from, direction, length) => { drawn.push([...from, length]); plain(from, direction, length); };
    }""")
    page.check("input[name=arrows]")
    steps = []
    for zoom in (1, 3, 12, 60):
        page.evaluate(f"drawn.length = 0; setView({zoom}, 0.1, 0.1)")
        page.evaluate(DRAWN)
        arrows, window = np.array(page.evaluate("drawn")), page.evaluate("[box.width, box.height]")
        across, up = (np.unique(np.round(arrows[:, axis], 3)) for axis in (0, 1))
        assert min(np.diff(across).min(), np.diff(up).min()) > min(window) / 25  # room for each
        assert len(across) <= 26
        assert (arrows[:, 2] < np.diff(across).min()).all()
        steps.append(page.evaluate("thinned()"))
    assert steps == sorted(steps, reverse=True)
    assert (steps[0], steps[-1]) == (16, 1)
    thinned = """step => {
        const off = (k) => (k % columns) % step || Math.floor(k / columns) % step;
        gradients.forEach((_, k) => { if (off(k)) gradients[k] = NaN; });
        return spacing();
    }"""
    assert [page.evaluate(thinned, step) for step in (1, 4)] == [1, 4]


def test_cells_whose_gradients_contradict_their_losses_are_dotted(ledges: str, ledge_data: Path, visit: Visit) -> None:
    where = contradicted_cells(open_slice(ledge_data / "coarse/slice.zarr"))
    assert set(np.argwhere(where)[:, 1]) == {10}  # of 16 columns, the ledge lies between two
    page = visit(ledges, "coarse/index.html")
    plain = pixels(page, "map").astype(int)
    page.check("input[name=finer]")
    changed = np.argwhere((pixels(page, "map") != plain).any(axis=-1))
    left, right = (page.evaluate(f"spot({column})[0]") for column in (10, 11))
    assert len(changed) > 50
    assert left - 1 <= changed[:, 1].min() < changed[:, 1].max() <= right + 1


def line_of(page: Any) -> list[dict[str, str]]:
    with page.expect_download() as waiting:
        page.click("#profile-table")
    return list(csv.DictReader(io.StringIO(Path(waiting.value.path()).read_text())))


def test_a_line_is_drawn_with_the_pointer_or_with_keys_and_has_the_nodes_losses(
    ledges: str, losses: np.ndarray[Any, Any], visit: Visit
) -> None:
    page = visit(ledges, "coarse/index.html", accept_downloads=True)
    page.click("#draw-profile")
    page.mouse.move(*point_at(page, 2, 1))
    page.mouse.down()
    page.mouse.move(*point_at(page, 8, 9), steps=3)
    page.mouse.move(*point_at(page, 14, 15), steps=3)
    page.mouse.up()
    rows = line_of(page)
    expected = [losses[2 + round(k * 12 / 14), 1 + k] for k in range(15)]
    np.testing.assert_allclose(
        [float(row["loss"] or "nan") for row in rows], np.array(expected, dtype=np.float32), rtol=1e-6
    )
    assert [row["status"] for row in rows[-1:]] == ["NONFINITE"]
    assert float(rows[0]["speed [m/s]"]) == pytest.approx(-1 + 2 / 15)
    said = page.inner_text("#profile-said")
    assert "15 nodes" in said
    assert f", {int(np.isnan(expected).sum())} without" in said
    assert said in page.get_attribute("#profile", "aria-label")
    picture = pixels(page, "profile")
    page.focus("#map")
    page.keyboard.press("Escape")
    assert not page.is_visible("#profile-panel")
    page.evaluate("go(2 * columns + 1)")
    page.keyboard.press("p")
    page.evaluate("go(14 * columns + 15)")
    page.keyboard.press("p")
    assert line_of(page) == rows
    assert (pixels(page, "profile") == picture).all()


def test_a_chart_of_a_line_is_hatched_where_a_node_failed(
    ledges: str, losses: np.ndarray[Any, Any], visit: Visit
) -> None:
    page = visit(ledges, "coarse/index.html")
    page.evaluate("go(15 * columns)")
    page.click("#profile-across")
    page.locator("#profile").scroll_into_view_if_needed()
    picture = pixels(page, "profile")
    failed = np.isnan(losses[15])
    assert 0 < failed.sum() < 16
    left, right, top, bottom = page.evaluate(
        "[EDGE.left, chart.clientWidth - EDGE.right, EDGE.top, chart.clientHeight - EDGE.bottom]"
    )
    for column in range(1, 15):
        middle = round(left + column / 15 * (right - left))
        dark = (picture[top + 4 : bottom - 4, middle - 4 : middle + 5, :3].max(axis=-1) < 140).mean()
        assert (dark > 0.08) == failed[column]


def test_a_link_opens_the_view_that_it_was_taken_of(ledges: str, visit: Visit) -> None:
    page = visit(ledges, "coarse/index.html")
    page.evaluate("go(3 * columns + 12)")
    page.check("input[name=isolines]")
    page.check("input[name=arrows]")
    page.select_option("#scale", "rank")
    page.evaluate("setView(1.7, 0.3, 0.1); setProfile(18, 205); setCamera(2.1, 0.9, 1.3)")
    page.click("#link")
    link = page.input_value("#permalink")
    page.wait_for_function("!sharp.stale && sharp.zoom === view.zoom")
    other = visit(ledges, link.removeprefix(ledges))
    other.wait_for_function("!sharp.stale && sharp.zoom === view.zoom")
    assert other.evaluate("[node, scaleName, ...profile]") == [60, "rank", 18, 205]
    assert other.input_value("#scale") == "rank"
    assert other.is_checked("input[name=arrows]")
    for canvas in ("map", "surface", "profile"):
        ours, theirs = (pixels(one, canvas).astype(int) for one in (page, other))
        assert (np.abs(ours - theirs).max(axis=-1) > 8).mean() < 0.005  # of numbers that the link rounds
    other.evaluate("location.hash = 'node=5,6'")
    other.wait_for_function("node === 5 * columns + 6 && document.activeElement === canvas")
    place = visit(ledges, "coarse/index.html#node=15,2")
    assert place.evaluate("at(node)") == [2, 15]
    assert told(place, "angle") == 2


@pytest.mark.parametrize(
    "junk", ["node=x,y", "node=99,-4", "window=1,2", "camera=Infinity,1,1", "line=1", "scale=pink", "layers="]
)
def test_a_link_of_something_else_opens_the_page(junk: str, ledges: str, visit: Visit) -> None:
    page = visit(ledges, f"coarse/index.html#{junk}")
    assert len(np.unique(pixels(page, "map").reshape(-1, 4), axis=0)) > 40
    assert page.evaluate("0 <= node && node < losses.length && Number.isFinite(camera.turn)")


@pytest.mark.parametrize("canvas", ["map", "surface", "profile"])
def test_a_view_is_saved_as_it_is_seen(canvas: str, ledges: str, visit: Visit) -> None:
    page = visit(ledges, "coarse/index.html", accept_downloads=True)
    page.click("#profile-up")
    drawn = pixels(page, canvas)
    with page.expect_download() as waiting:
        page.click(f"[data-png={canvas}]")
    assert waiting.value.suggested_filename == f"coarse-{canvas}.png"
    assert (np.asarray(Image.open(waiting.value.path())) == drawn).all()


def test_from_above_the_surface_is_the_map(ledges: str, losses: np.ndarray[Any, Any], visit: Visit) -> None:
    page = visit(ledges, "coarse/index.html")
    norm = Normalize(np.nanmin(losses), np.nanmax(losses))
    for angle in (0.0, 0.7, 2.0, 4.0):
        page.evaluate(f"setCamera({angle}, 1.5, 1)")
        picture = pixels(page, "surface")
        for row, column in np.ndindex(losses.shape):
            right, down = page.evaluate(
                "([row, column]) => flat([(column + 0.5) / columns, (row + 0.5) / rows, rise(column, row)])",
                [row, column],
            )  # fmt: skip
            if np.isfinite(losses[row, column]):
                colour = picture[int(down), int(right), :3]
                np.testing.assert_allclose(colour, colours_of(norm(losses[row, column])), atol=4)
        middle = page.evaluate("flat([15 / 16, 15 / 16, 0])")
        assert picture[int(middle[1]), int(middle[0]), :3].min() > 250  # open where losses are missing


def test_a_refined_slice_is_drawn_as_its_nearest_samples_and_says_where_it_was_not_sampled(
    ledges: str, ledge_data: Path, visit: Visit
) -> None:
    dataset = open_slice(ledge_data / "refined/slice.zarr")
    skipped = dataset["status"].to_numpy() == Status.INTERPOLATED
    assert 100 < skipped.sum() < 33 * 33 - 100
    drawn = own_cells(dataset)["loss"].to_numpy()
    norm = Scale.of_loss(dataset["loss"].to_numpy()).norm
    page = visit(ledges, "refined/index.html")
    nodes, node = seen(page), page.evaluate("node")
    for (row, column), colour in nodes.items():
        if np.isfinite(drawn[row, column]) and np.hypot(*np.subtract((row, column), divmod(node, 33))) > 2:
            np.testing.assert_allclose(colour, colours_of(norm(drawn[row, column])), atol=4)
    row, column = np.argwhere(skipped)[0]
    page.mouse.move(*point_at(page, int(row), int(column)))
    assert "Loss: interpolated" in page.inner_text("#readout")
