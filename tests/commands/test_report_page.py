"""`landscape report --html`: one page that holds all it shows, for anyone's slice."""

import csv
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gradscape as gs
from gradscape.jobs import report_page
from gradscape.jobs.report import Report
from gradscape.landscapes.draw.pages import report as pages
from gradscape.landscapes.storage.store import open_slice

from ..command import Run, make

Visit = Callable[..., Any]


class Page(HTMLParser):
    """Collect what a page refers to and its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.references: list[str] = []
        self.ids: list[str] = []
        self.named: list[str] = []
        self.text = ""
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.references += [value for name in ("href", "src", "srcset", "poster") if (value := found.get(name))]
        self.ids += [value for value in [found.get("id")] if value]
        for name in ("aria-labelledby", "aria-describedby", "for", "data-copy"):
            self.named += (found.get(name) or "").split()

    def handle_data(self, data: str) -> None:
        self.text += data


def nodes_of(path: Path) -> dict[str, Any]:
    """Return what the map is drawn from."""
    found = re.search(r"let SLICE = (.*);</script>", path.read_text())
    assert found
    return dict(json.loads(found[1]))


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Report on a slice of Branin's function with a check and a race of it."""
    folder = make(
        tmp_path_factory.mktemp("told"),
        "slice branin --dims 0 1 --resolution 12 --out cut",
        "check branin --power 0.3 --out checked",
        "race branin --methods random,l-bfgs-b --budget 20 --seeds 2 --out raced",
        "report cut --points-per-axis 2 --out told --html --include checked --include raced",
    )
    return folder / "told"


def test_a_page_holds_all_that_it_shows(told: Path) -> None:
    page = Page(told / "report.html")
    assert all(one.startswith(("data:", "#")) for one in page.references)
    assert len(set(page.ids)) == len(page.ids)
    assert set(page.named) <= set(page.ids)
    report = Report.read(told)
    assert f"{report.words[0][1:]}, " in page.text
    for said in (*report.measures, "The check passes.", "l-bfgs-b, seed 1", "landscape slice branin"):
        assert said in page.text
    assert len(nodes_of(told / "report.html")["runs"]) == 4
    assert (told / "report.html").stat().st_size < 3e6


def test_a_page_is_written_of_a_report_that_is_there_and_other_folders_are_refused(run: Run, told: Path) -> None:
    words = f"report {told.parent / 'cut'} --points-per-axis 2 --out {told} --html"
    (told / "report.html").unlink()
    assert "report.html" in run.ok(words).stderr
    assert "The check" not in Page(told / "report.html").text
    run.refuse(f"{words} --include {told}", said="is not a run")


def test_no_text_of_a_user_ends_the_script_of_a_page(tmp_path: Path) -> None:
    name = "</script><b>x"
    space = gs.ParameterSpace({name: (-1, 1, "<i>"), "y": (-1, 1)})
    bowl = gs.from_torch(lambda x: (x**2).sum(-1), space, name="bowl & <b>")
    report = gs.report(gs.slice(bowl, resolution=8, out=tmp_path / "cut"), points_per_axis=2, out=tmp_path / "told")
    page = report.save(tmp_path / "x.html")
    assert nodes_of(page)["axes"][0]["label"].startswith(name)
    text = page.read_text()
    assert name not in text
    assert text.count("</script>") == text.count("<script")


def test_of_many_samples_the_map_has_every_so_many(told: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "MOST_NODES", 50)
    page = replace(Report.read(told), store=told.parent / "cut").save(tmp_path / "x.html")
    nodes, axis = nodes_of(page), open_slice(told.parent / "cut")["u"].to_numpy()
    np.testing.assert_allclose(nodes["axes"][0]["values"], axis[::2])
    assert len(nodes["axes"][1]["values"]) == 6
    assert "The map shows one of every 2 samples" in Page(page).text


def test_a_page_shows_episodes_at_the_ends_of_the_losses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_page, "FILM_FRAMES", 2)
    cut = gs.slice("bounce", dims=[0, 1], resolution=8, fidelity="draft", device="cpu", out=tmp_path / "cut")
    gs.report(cut, points_per_axis=2, out=tmp_path / "told", html=True)
    shown = nodes_of(tmp_path / "told/report.html")["episodes"]
    assert [one["why"] for one in shown] == ["lowest loss", "highest loss"]
    assert all(one["mp4"].startswith("data:video/mp4;base64,") for one in shown)
    loss = open_slice(tmp_path / "cut")["loss"].to_numpy()
    assert loss[shown[1]["row"], shown[1]["column"]] == np.nanmax(loss)


def test_nothing_compared_has_no_curve() -> None:
    assert pages.curve_of([]) is None


def test_a_page_works_in_a_browser_without_a_network(browser: Any, told: Path, tmp_path: Path) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 900}, offline=True, accept_downloads=True)
    page, wrong = context.new_page(), list[str]()
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto((told / "report.html").as_uri())
    page.hover("#map", position={"x": 200, "y": 200})
    assert "Loss: " in page.inner_text("#readout")
    with page.expect_download() as saved:
        page.click("[data-file='samples.csv']")
    rows = list(csv.reader(Path(saved.value.path()).read_text().splitlines()))
    loss = open_slice(told.parent / "cut")["loss"].to_numpy()
    assert len(rows) == 1 + loss.size
    np.testing.assert_allclose([float(row[2]) for row in rows[1:]], loss.ravel(), rtol=1e-6)
    with page.expect_download() as saved:
        page.click("[data-file='report.json']")
    assert json.loads(Path(saved.value.path()).read_text())["env"] == "branin"
    for width in (360, 2560):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.emulate_media(media="print")
    assert page.is_visible("img.printed")
    assert not page.is_visible("#map")
    assert len(re.findall(rb"/Type\s*/Page\b(?!s)", page.pdf(format="A4"))) <= 2
    assert not wrong
    context.close()
