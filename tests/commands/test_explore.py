"""`landscape explore`: its page in a browser, who may ask it, and how it ends."""

import json
import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import Any
from urllib.parse import urlsplit

import pytest
import torch

import gradscape as gs
from gradscape.jobs.explore_page import Explorer

COMPLETE = "48 × 48 samples"


@pytest.fixture
def explorer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Explorer]:
    monkeypatch.chdir(tmp_path)
    found = gs.explore("bounce", device="cpu", browser=False)
    yield found
    found.close()


@pytest.fixture
def page(browser: Any, explorer: Explorer) -> Iterator[Any]:
    opened = browser.new_page(viewport={"width": 1280, "height": 900})
    errors, asked = list[str](), list[str]()
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("request", lambda request: asked.append(request.url))
    opened.goto(explorer.address)
    yield opened
    opened.close()
    assert not errors
    here = urlsplit(explorer.address).netloc
    assert {urlsplit(url).netloc for url in asked if url.startswith("http")} == {here}


def has_text(locator: Any, text: str | re.Pattern[str]) -> None:
    from playwright.sync_api import expect

    expect(locator).to_have_text(text)


def click_map(page: Any, right: float, down: float) -> None:
    box = page.locator("#map").bounding_box()
    page.locator("#map").click(position={"x": right * box["width"], "y": down * box["height"]})


@pytest.mark.e2e
def test_a_click_plays_the_episode_and_draws_a_descent(page: Any) -> None:
    has_text(page.locator("#progress"), COMPLETE)
    click_map(page, 0.4, 0.4)
    has_text(page.locator("#descents li"), re.compile(r"^Descent 1 over the two shown: \d+ points, lowest loss .* m²"))
    page.locator("#player video").wait_for()
    has_text(page.locator("#player figcaption"), re.compile(r"^Episode at this node: .* m²$"))
    assert page.evaluate("SLICE.runs.length") == 1
    page.locator("#descents li").get_by_role("button").click()  # in the plane, which stays, with its descent
    has_text(page.locator("#progress"), COMPLETE)
    assert page.evaluate("SLICE.runs.length") == 1


@pytest.mark.e2e
def test_a_descent_over_all_parameters_leads_to_another_plane(browser: Any) -> None:
    bowl = gs.from_torch(lambda x: (x - 0.5).square().sum(dim=1), gs.ParameterSpace.box(["a", "b", "c"], -1, 1, "N"))
    explorer, page = gs.explore(bowl, browser=False), browser.new_page()
    page.goto(explorer.address)
    has_text(page.locator("#progress"), COMPLETE)
    page.get_by_label("varies all parameters").check()
    click_map(page, 0.4, 0.4)
    has_text(page.locator("#descents li"), re.compile("^Descent 1 over all parameters: "))
    page.locator("#descents li").get_by_role("button").click()
    has_text(page.locator("#sliders output").nth(2), "0.5 N")
    has_text(page.locator("#progress"), COMPLETE)
    assert page.evaluate("SLICE.runs.length") == 0
    assert page.evaluate("losses[lowest]") < 1e-3
    page.close()
    explorer.close()


@pytest.mark.e2e
def test_a_slider_moves_the_plane_and_another_parameter_turns_it(page: Any) -> None:
    from playwright.sync_api import expect

    readout = page.locator("#readout")
    has_text(page.locator("#progress"), COMPLETE)
    page.locator("#map").focus()
    page.keyboard.press("ArrowLeft")
    before = readout.text_content() or ""
    slider = page.get_by_role("slider", name="velocity z")
    slider.fill("0.9")
    has_text(page.locator("#sliders output").nth(2), "8 m/s")
    expect(readout).not_to_have_text(before)
    page.get_by_label("Across").select_option(label="velocity z")
    has_text(readout, re.compile(r"^velocity z \[m/s\]: .*velocity y \[m/s\]: ", re.DOTALL))
    assert page.get_by_role("slider", name="velocity z").is_disabled()
    page.get_by_label("Up").select_option(label="velocity z")  # which the other has: they swap
    has_text(readout, re.compile(r"^velocity y \[m/s\]: .*velocity z \[m/s\]: ", re.DOTALL))


@pytest.mark.e2e
def test_a_click_waits_for_the_map_of_the_chosen_plane(browser: Any) -> None:
    gate = Event()

    def bowl(x: torch.Tensor) -> torch.Tensor:
        assert (x[:, 2] == 0).all() or gate.wait(60)
        return x.square().sum(dim=1)

    made = gs.from_torch(bowl, gs.ParameterSpace.box(["a", "b", "c"], -1, 1))
    explorer, page = gs.explore(made, browser=False), browser.new_page()
    page.goto(explorer.address)
    has_text(page.locator("#progress"), COMPLETE)
    page.get_by_role("slider", name="c").fill("0.9")
    click_map(page, 0.4, 0.4)  # the map is still that of the plane before
    has_text(page.locator("#progress"), "The plane that you chose is not on the map yet.")
    gate.set()
    has_text(page.locator("#progress"), COMPLETE)
    assert page.locator("#descents li").count() == 0
    click_map(page, 0.4, 0.4)
    page.locator("#descents li").wait_for()
    page.close()
    explorer.close()


@pytest.mark.e2e
def test_what_is_seen_is_kept_as_a_slice(page: Any, tmp_path: Path) -> None:
    has_text(page.locator("#progress"), COMPLETE)
    page.get_by_role("button", name="Save this plane").click()
    page.locator("#kept-command").wait_for()
    folder = Path((page.locator("#kept").text_content() or "").partition(":")[0])
    assert folder.parent == Path("out")
    assert gs.open_slice(tmp_path / folder).data["loss"].shape == (48, 48)


@pytest.mark.e2e
@pytest.mark.parametrize("width", [360, 768, 2560])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_is_as_wide_as_the_screen(browser: Any, explorer: Explorer, width: int, scheme: str) -> None:
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page.goto(explorer.address)
    has_text(page.locator("#progress"), COMPLETE)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.close()


def send(address: str, headers: dict[str, str], data: bytes | None = None) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, data, headers)) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_who_does_not_know_the_token_or_asks_by_another_name_gets_nothing(explorer: Explorer) -> None:
    root = explorer.address.partition("?")[0]
    known = {"Authorization": f"Bearer {explorer.token}"}
    assert send(root, {})[0] == 403
    assert send(root + "?token=none", {})[0] == 403
    assert send(root + "keep", {}, b"{}")[0] == 403
    assert send(explorer.address, {"Host": "example.org"})[0] == 421
    assert send(root + f"other?token={explorer.token}", {})[0] == 404
    for question, body in (("what", b"{}"), ("look", b"{}"), ("look", b"no JSON"), ("film", b'{"at": ["x"]}')):
        status, said = send(root + question, known, body)
        assert status == 400
        assert json.loads(said)["error"]
    assert send(root + "look", known | {"Content-Length": "99999999"}, b"{}")[0] in (413, 400)
    assert send(root + "seen", known, b'{"number": -1}')[0] == 200


def test_a_port_in_use_is_refused(explorer: Explorer) -> None:
    port = urlsplit(explorer.address).port
    assert port is not None
    with pytest.raises(OSError, match="cannot be served"):
        gs.explore("branin", device="cpu", browser=False, port=port)


def test_a_notebook_shows_the_page(explorer: Explorer) -> None:
    assert f'src="{explorer.address}"' in explorer._repr_html_()
