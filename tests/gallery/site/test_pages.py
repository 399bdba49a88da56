"""What a browser makes of the site: from files and from a server, with the pointer, with keys, on a phone."""

import json
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gradscape.gallery.site.server import SiteHandler
from gradscape.landscapes.draw.loopback import LoopbackServer
from gradscape.landscapes.draw.render.relief import Relief, azimuth
from gradscape.landscapes.draw.style import LOSS_MAP, Scale
from gradscape.landscapes.identity import plane_of
from gradscape.landscapes.storage.store import open_slice

from .browsing import DRAWN, pixels, point_at, told
from .conftest import FIGURES

Visit = Callable[..., Any]


@pytest.fixture
def served(site: Path) -> Iterator[str]:
    """Serve the folder above the site's: the site is in a subfolder of a server."""
    with LoopbackServer(0, partial(SiteHandler, directory=str(site.parent))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"{server.address}/{site.name}/"
        server.shutdown()
        thread.join()


def load_pictures(page: Any, selector: str) -> None:
    """Have the browser load pictures that it would leave until they are scrolled to, and wait for them.

    How far below the window it loads them by itself depends on how quick it finds the server to be.
    """
    page.evaluate("(all) => document.querySelectorAll(all).forEach((one) => { one.loading = 'eager'; })", selector)
    page.wait_for_function(
        "(all) => Array.from(document.querySelectorAll(all)).every((one) => one.naturalWidth > 100)", arg=selector
    )


@pytest.mark.parametrize("way", ["filed", "served"])
def test_every_page_opens(way: str, visit: Visit, request: pytest.FixtureRequest) -> None:
    page = visit(request.getfixturevalue(way), "index.html")
    load_pictures(page, "img")
    assert page.locator(".slice").count() == len(FIGURES)
    for figure in FIGURES:
        page.evaluate("document.getElementById('every').open = true")
        page.click(f".slice a[href='{figure.id}/index.html']")
        page.wait_for_url(f"**/{figure.id}/index.html")
        shown = "img:not([hidden]):not(#player img)"
        page.locator(shown).first.wait_for(state="attached")
        load_pictures(page, shown)
        for film in page.locator("video[src]").all():
            film.evaluate(
                "(one) => new Promise((done) => { one.onloadeddata = done; one.load(); one.preload = 'auto'; })"
            )
        page.click("text=All landscapes")
        page.wait_for_url("**/index.html")


def test_the_map_says_what_is_under_the_pointer_and_the_keys(filed: str, data: Path, visit: Visit) -> None:
    page = visit(filed, "full/index.html")
    dataset = open_slice(data / "full/slice.zarr")
    loss, slope = dataset["loss"].to_numpy(), dataset["grad"].to_numpy()
    page.mouse.move(*point_at(page, 4, 2))
    assert told(page, "Loss") == pytest.approx(loss[4, 2], rel=1e-3)
    assert told(page, "speed") == pytest.approx(float(dataset["u"][2]), rel=1e-3)
    assert told(page, "force") == pytest.approx(float(dataset["v"][4]), rel=1e-3)
    assert told(page, "Gradient along the slice") == pytest.approx(slope[4, 2, 0], rel=1e-3)
    assert told(page, "Gradient norm") == pytest.approx(np.linalg.norm(slope[4, 2]), rel=1e-3)
    page.clock.install()
    page.mouse.move(*point_at(page, 11, 11))
    assert "Loss: not finite" in page.inner_text("#readout")
    page.clock.run_for(10_000)
    assert page.inner_text("#spoken") == ""
    page.mouse.move(*point_at(page, 4, 2))
    page.focus("#map")
    for key in ("ArrowRight", "ArrowUp", "ArrowUp"):
        page.keyboard.press(key)
    assert told(page, "Loss") == pytest.approx(loss[6, 3], rel=1e-3)
    page.clock.run_for(10_000)
    assert "Loss: " in page.inner_text("#spoken")
    page.keyboard.press("Shift+ArrowLeft")
    assert told(page, "speed") == -1
    page.keyboard.press("Home")
    assert told(page, "Loss") == pytest.approx(np.nanmin(loss), rel=1e-3)


def test_the_map_has_the_colours_of_its_scale_and_hatches_failures(filed: str, data: Path, visit: Visit) -> None:
    page = visit(filed, "full/index.html")
    page.uncheck("input[name='descents, seed 0']")
    seen, loss = pixels(page, "map"), open_slice(data / "full/slice.zarr")["loss"].to_numpy()
    norm = Scale.of_loss(loss).norm
    for row, column in ((0, 0), (3, 9), (9, 3), (11, 0)):
        left, top = page.evaluate(f"spot({row * 12 + column})")
        colour = 255 * np.array(LOSS_MAP(norm(loss[row, column]))[:3])
        np.testing.assert_allclose(seen[round(top), round(left), :3], colour, atol=3)
    left, top = (round(part) for part in page.evaluate("spot(10 * 12 + 11)"))
    failed = seen[top - 8 : top + 8, left - 8 : left + 8, :3].reshape(-1, 3)
    assert failed.std(axis=1).max() < 8  # grey
    assert np.ptp(failed) > 100  # and striped
    bar = page.evaluate("[PAD.left + box.width + BAR.gap + 6, PAD.top, PAD.top + box.height]")
    for end, value in ((bar[1] + 3, 0.995), (bar[2] - 3, 0.005)):
        np.testing.assert_allclose(seen[round(end), round(bar[0]), :3], 255 * np.array(LOSS_MAP(value)[:3]), atol=8)


def test_a_click_on_a_ringed_node_plays_its_episode(filed: str, visit: Visit) -> None:
    page = visit(filed, "full/index.html")
    assert not page.is_visible("#player")
    left, top = point_at(page, 6, 5)
    page.mouse.click(left + 9, top)  # near enough to its ring
    page.wait_for_function("document.querySelector('#player video').currentTime > 0.05")
    assert page.get_attribute("#player video", "src") == "episode-6-5.mp4"
    assert "Lowest loss, through the slice's point: 1.25 J" in page.inner_text("#player figcaption")
    page.focus("#map")
    page.keyboard.press("PageDown")
    page.keyboard.press("Enter")
    assert page.inner_text("#player figcaption") == "Highest loss: not finite"
    page.wait_for_function("document.querySelector('#player img').naturalWidth === 160")  # it has no size before
    assert page.is_visible("#player img")
    assert page.eval_on_selector("#player video", "(one) => one.paused")


@pytest.mark.parametrize(("motion", "played"), [("reduce", 0), ("no-preference", 1)])
def test_nothing_moves_by_itself_where_motion_is_not_wanted(motion: str, played: int, filed: str, visit: Visit) -> None:
    page = visit(filed, "full/index.html", reduced_motion=motion)
    page.evaluate("""() => {
        window.played = 0;
        HTMLMediaElement.prototype.play = async () => { played += 1; };
    }""")
    page.mouse.click(*point_at(page, 6, 5))
    assert page.is_visible("#player video")
    assert page.evaluate("played") == played
    assert page.evaluate("Array.from(document.querySelectorAll('video')).every((one) => one.paused && !one.autoplay)")


@pytest.mark.parametrize("name", ["full", "line"])
def test_switches_show_and_hide_searches(name: str, filed: str, visit: Visit) -> None:
    page = visit(filed, f"{name}/index.html")
    boxes = page.locator("#switches input:checked")
    assert [box.get_attribute("name") for box in boxes.all()] == ["descents, seed 0"]
    assert "descents, seed 0 24 episodes, best 1 J" in page.inner_text("#switches")
    canvases = ["map", "surface"] if name == "full" else ["map"]
    first = {canvas: pixels(page, canvas) for canvas in canvases}
    page.uncheck("input[name='descents, seed 0']")
    without = {canvas: pixels(page, canvas) for canvas in canvases}
    page.check("input[name='random, seed 0']")
    for canvas in canvases:
        assert (without[canvas] != first[canvas]).any()
        assert (pixels(page, canvas) != without[canvas]).any()
    page.uncheck("input[name='random, seed 0']")
    assert all((pixels(page, canvas) == without[canvas]).all() for canvas in canvases)
    if name == "full":
        page.check("input[name=arrows]")
        assert (pixels(page, "map") != without["map"]).any()


@pytest.mark.parametrize("name", ["full", "line"])
def test_a_search_s_line_leads_out_of_a_window_to_points_that_are_not_in_it(
    name: str, filed: str, visit: Visit
) -> None:
    page = visit(filed, f"{name}/index.html")
    page.evaluate("setView(2, 0.5, 0.5)")
    drawn = page.evaluate("""() => {
        let joined = 0;
        const plain = pen.lineTo;
        pen.lineTo = (...at) => { joined += 1; plain.apply(pen, at); };
        const run = SLICE.runs.find((one) => one.method === "random");
        drawRun(pen, { ...run, u: run.u, loss: run.loss, far: [] }, where);
        delete pen.lineTo;
        const bends = run.path.filter((row) => !run.hidden.includes(row)).length;
        return [joined - (bends ? 10 : 0), bends]; // the star has ten
    }""")
    assert drawn[0] == drawn[1] - 1 > 1


def test_arrows_point_downhill(filed: str, visit: Visit) -> None:
    page = visit(filed, "full/index.html")
    page.evaluate("""() => {
        window.drawn = [];
        const plain = arrow;
        arrow = (from, direction, length) => { drawn.push([...from, ...direction]); plain(from, direction, length); };
    }""")
    page.check("input[name=arrows]")
    page.evaluate(DRAWN)
    drawn = np.array(page.evaluate("drawn"))
    lowest = page.evaluate("[x(-0.1), y(9)]")  # of the bowl
    assert len(drawn) > 30
    assert (((lowest - drawn[:, :2]) * drawn[:, 2:]).sum(axis=1) > 0).mean() > 0.95


def test_the_surface_is_there_and_turns(filed: str, visit: Visit) -> None:
    page = visit(filed, "bare/index.html")
    first = pixels(page, "surface")
    assert len(np.unique(first.reshape(-1, 4), axis=0)) > 40
    page.focus("#surface")
    page.keyboard.press("ArrowRight")
    turned = pixels(page, "surface")
    assert (turned != first).any()
    page.locator("#surface").scroll_into_view_if_needed()
    box = page.locator("#surface").bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 260, box["y"] + 200)
    page.mouse.up()
    assert (pixels(page, "surface") != turned).any()
    before = pixels(page, "surface")
    page.keyboard.press("+")
    assert (pixels(page, "surface") != before).any()


def test_the_surface_is_flat_where_a_node_is_and_opens_where_its_valley_is_seen(
    filed: str, data: Path, visit: Visit
) -> None:
    page = visit(filed, "bare/index.html")
    loss = open_slice(data / "bare/slice.zarr")["loss"].to_numpy()
    row, column = np.unravel_index(int(np.nanargmax(loss)), loss.shape)  # nothing is before it
    places = page.evaluate(
        """([row, column]) => [[0.5, 0.5], [0.2, 0.3], [0.8, 0.7], [0.7, 0.2]].map(([right, back]) =>
            flat([(column + right) / columns, (row + back) / rows, rise(column, row)]))""",
        [int(row), int(column)],
    )  # fmt: skip
    seen = pixels(page, "surface")
    found = np.array([seen[round(down), round(right), :3] for right, down in places], dtype=int)
    assert np.ptp(found, axis=0).max() == 0  # one colour over all of it, and the map's own
    np.testing.assert_allclose(
        found[0], 255 * np.array(LOSS_MAP(Scale.of_loss(loss).norm(np.nanmax(loss)))[:3]), atol=2
    )
    dataset = open_slice(data / "bare/slice.zarr")
    eye = np.radians(azimuth(Relief(plane_of(dataset), Scale.of_loss(loss)), dataset))
    nearest = page.evaluate("FLOOR.map(project).map((corner) => corner[2])")
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    assert np.argmax(nearest) == np.argmax(corners @ [np.cos(eye), np.sin(eye)])


@pytest.mark.parametrize("path", ["full/index.html", "league.html", "league/fluid.html"])
def test_every_table_shows_all_of_its_columns_on_a_phone(filed: str, visit: Visit, path: str) -> None:
    page = visit(filed, path, width=360)
    page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    boxes = page.evaluate(
        """() => Array.from(document.querySelectorAll('tbody th, tbody td')).filter((one) => one.textContent.trim())
            .map((one) => { const box = one.getBoundingClientRect();
                            return [box.left, box.right, box.width, one.scrollWidth - one.clientWidth]; })"""
    )  # fmt: skip
    assert len(boxes) > 20
    for left, right, width, hidden in boxes:
        assert 0 <= left < right <= 360
        assert width > 20
        assert hidden <= 0
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    for table in page.locator(".across").all():
        assert table.evaluate("(one) => one.scrollWidth <= one.clientWidth")


def test_every_control_has_a_name_and_can_be_reached_by_keys(filed: str, visit: Visit) -> None:
    for path in ("index.html", "full/index.html", "line/index.html"):
        page = visit(filed, path)
        names = page.eval_on_selector_all(
            "button, canvas, video, input, select",
            """all => all.filter((one) => one.checkVisibility()).map((one) => one.getAttribute('aria-label')
                || one.labels?.[0]?.textContent.trim() || one.textContent.trim())""",
        )
        assert names
        assert all(names)
        controls = page.evaluate("""() => {
            const all = document.querySelectorAll("a, button, canvas[tabindex], input, select, summary, pre[tabindex]");
            const seen = Array.from(all).filter((one) => one.checkVisibility());
            seen.forEach((one, k) => { one.dataset.k = k; });
            return seen.length;
        }""")
        reached = set()
        for _ in range(2 * controls + 20):
            page.keyboard.press("Tab")
            reached.add(page.evaluate("document.activeElement.dataset.k"))
        assert {str(k) for k in range(controls)} <= reached


def test_print_is_dark_on_white_and_has_the_picture(filed: str, visit: Visit) -> None:
    page = visit(filed, "full/index.html", color_scheme="dark")
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.is_visible("img[src='landscape.png']")
    assert not page.is_visible("#map")


def test_a_browser_that_never_lets_it_copy_has_the_command_selected(filed: str, visit: Visit) -> None:
    from playwright.sync_api import expect

    page = visit(filed, "full/index.html")
    page.evaluate("() => { if (window.Clipboard) Clipboard.prototype.writeText = () => new Promise(() => {}) }")
    page.clock.install()
    button = page.locator("[data-copy=command]")
    button.click()
    page.clock.run_for(10_000)
    expect(button).to_have_text("Selected")
    assert "landscape slice" in page.evaluate("getSelection().toString()")


def test_the_command_is_copied(filed: str, visit: Visit) -> None:
    page = visit(filed, "full/index.html")
    button = page.locator("[data-copy=command]")
    button.click()
    page.wait_for_function("/Copied|Selected/.test(document.querySelector('[data-copy=command]').textContent)")
    command = json.loads((Path(filed.removeprefix("file://")) / "manifest.json").read_text())["figures"][-1]["command"]
    if button.inner_text() == "Selected":
        assert page.evaluate("getSelection().toString()") == command
    else:
        page.evaluate("document.body.insertAdjacentHTML('beforeend', '<textarea id=here></textarea>')")
        page.focus("#here")
        page.keyboard.press("Control+v")
        assert page.input_value("#here") == command
