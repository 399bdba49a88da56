"""The front page, what goes with every picture, and that all pages are legible at every width, in light and dark."""

import ast
import csv
import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from zarr.storage import ZipStore

import gradscape as gs
from gradscape.cli import main
from gradscape.envs.engines import runtime
from gradscape.gallery.figures import Figure
from gradscape.gallery.paper import PaperCaption
from gradscape.gallery.site import studio
from gradscape.gallery.site.build import build_site
from gradscape.gallery.site.wall import Tile, _is_most, answers
from gradscape.landscapes.statistics import Estimate, exactly
from gradscape.landscapes.storage.store import open_slice

from .conftest import FIGURES, keep

Visit = Callable[..., Any]
WIDTHS = (360, 768, 1280, 2560)


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def pages(site: Path) -> list[str]:
    return sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html"))


def test_the_front_page_asks_three_questions_and_answers_each_over_all_environments(site: Path) -> None:
    page = " ".join((site / "index.html").read_text().split())
    questions = [re.sub("<.*?>", "", one) for one in re.findall("<h2.*?</h2>", page)]
    assert questions[:3] == [
        "Is it smooth?", "Are its gradients worth following?", "Which optimiser gets anywhere?"
    ]  # fmt: skip
    tiles = re.findall(r'<li class="card tile".*?</li>', page)
    assert [re.search(r'class="name">(.*?)<', tile)[1] for tile in tiles] == ["bounce", "fluid"]  # type: ignore[index]
    fluid = re.sub("<.*?>", " ", tiles[1]).replace("&nbsp;", " ")
    assert "rugged 75 % (38 to 88) discontinuous 50 % (25 to 75) of 2 slices" in " ".join(fluid.split())
    assert "very smooth" not in fluid
    assert "not measured yet" in tiles[0]
    row = re.search(r'<th scope="row"><a href="full/index.html">fluid</a></th>(.*?)</tr>', page)
    assert row is not None
    assert re.findall(r">(\d+)</span>", row[1]) == ["10", "90"]
    assert 'href="card.html"' in page
    assert 'src="league/league.png"' in page
    wall = rows_of(site / "wall.csv")
    assert {(one["word"], float(one["share"]), float(one["low"])) for one in wall} >= {("rugged", 0.75, 0.375)}


def test_without_a_league_the_front_page_says_that_nothing_was_raced(data: Path, tmp_path: Path) -> None:
    few = tmp_path / "data"
    few.mkdir()
    (few / "bare").symlink_to(data / "bare")
    build_site(FIGURES, few, tmp_path / "site")
    page = (tmp_path / "site/index.html").read_text()
    assert "Not raced yet." in page
    assert "league.html" not in page
    assert not (tmp_path / "site/league.html").exists()
    assert "landscape card" in page
    assert "not measured yet" in page


def test_every_picture_is_to_be_had_with_its_data_and_every_page_has_its_command_and_lines(site: Path) -> None:
    found = 0
    for name in pages(site):
        text = (site / name).read_text()
        kept = re.findall(r'<a href="([^"]*)" download', text)
        assert all((site / name).parent.joinpath(one).resolve().is_file() for one in kept)
        for source in re.findall(r'<img class="wide" src="([^"]*)"', text):
            after = text.split(f'<img class="wide" src="{source}"')[1]
            taken = re.findall(r'href="([^"]*)" download', after[after.index('class="take') :].split("</p>")[0])
            assert taken[0] == source
            assert any(one.endswith(".csv") for one in taken), f"{name}: {source}"
            found += 1
        assert re.search(r'<pre id="(command|again-[\w-]*)"', text), name
        assert 'id="python"' in text, name
    assert found > 10
    for csv_file in site.rglob("*.csv"):
        rows = rows_of(csv_file)
        assert rows, csv_file
        assert len(rows[0]) > 1


@pytest.mark.parametrize("name", [figure.id for figure in FIGURES])
def test_a_slice_is_taken_along_whole(name: str, site: Path, data: Path) -> None:
    dataset = open_slice(data / name / "slice.zarr")
    with ZipStore(site / name / "slice.zarr.zip", mode="r") as store:
        taken = xr.open_zarr(store, consolidated=False, mask_and_scale=False).load()
    for array in ("loss", "grad", "status"):
        np.testing.assert_array_equal(taken[array].to_numpy(), dataset[array].to_numpy().astype(taken[array].dtype))
    assert json.loads(taken.attrs["identity"]) == json.loads(dataset.attrs["identity"])
    rows = rows_of(site / name / "slice.csv")
    losses = np.array([float(row["loss [J]"] or "nan") for row in rows])
    np.testing.assert_allclose(losses, dataset["loss"].to_numpy().ravel(), rtol=1e-6)
    slopes = np.array([float(row["slope along speed [m/s]"] or "nan") for row in rows])
    np.testing.assert_allclose(slopes, dataset["grad"].to_numpy().reshape(-1, 3)[:, 0], rtol=1e-6)
    assert float(rows[1]["speed [m/s]"]) == pytest.approx(float(dataset["u"][1]), rel=1e-6)


def test_lines_of_python_make_the_slice_that_the_command_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    figure = Figure("x", "rastrigin", (1, 0), PaperCaption(), resolution=4, fidelity="exact", options={"dim": 3})
    call = next(line for line in figure.python("cpu").splitlines() if line.startswith("s = "))
    made = eval(call.removeprefix("s = "), {"gs": gs})
    words = shlex.split(figure.command("cpu"))
    assert words[0] == "landscape"
    with pytest.raises(SystemExit):
        main([*words[1:], "--out", "command"])
    by_command = gs.open_slice("command")
    assert (made.data["loss"] == by_command.data["loss"]).all()
    assert json.loads(made.data.attrs["identity"]) == json.loads(by_command.data.attrs["identity"])
    ast.parse(figure.python("cpu"))


def test_the_front_page_is_filtered_by_word_number_and_engine_and_a_link_keeps_that(filed: str, visit: Visit) -> None:
    page = visit(filed, "index.html")
    sections = "document.querySelectorAll('.slice:not([hidden])').length"

    def left() -> tuple[list[str], int]:
        return page.locator(".wall .name:visible").all_inner_texts(), page.evaluate(sections)

    assert left() == (["bounce", "fluid"], 3)
    assert page.locator("#word option").all_inner_texts() == [
        "any", "rugged", "discontinuous", "gradients do not follow"
    ]  # fmt: skip
    page.select_option("#word", "discontinuous")  # of the census of fluid, and of no slice
    assert left() == (["fluid"], 0)
    assert page.locator(".shares .tile:visible").count() == 1
    page.select_option("#word", "rugged")
    assert left() == (["fluid"], 1)
    link = page.url
    page.click("#all")
    page.select_option("#dim", "1-3")
    assert left() == (["bounce"], 2)
    page.select_option("#dim", "")
    assert page.locator("#engine option").all_inner_texts() == ["any", "taichi", "warp"]
    page.select_option("#engine", "warp")
    assert left() == (["fluid"], 1)
    page.select_option("#engine", "")
    page.fill("#filter", "figure 10 DESC")
    assert left() == ([], 1)
    page.wait_for_function("document.getElementById('count').textContent === '1 of 3 slices'")
    page.fill("#filter", "nothing at all")
    assert left() == ([], 0)
    assert page.is_visible(".none")
    other = visit(filed, link.removeprefix(filed))
    assert other.input_value("#word") == "rugged"
    assert other.locator(".wall .name:visible").all_inner_texts() == ["fluid"]
    stray = visit(filed, "index.html#word=pink&dim=x")
    assert stray.locator(".wall .name:visible").count() == 2


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_every_page_fits_every_width(width: int, scheme: str, site: Path, filed: str, visit: Visit) -> None:
    page = visit(filed, "index.html", width=width, color_scheme=scheme)
    names = pages(site)
    assert len(names) == 5 + len(FIGURES)
    for name in names:
        page.goto(filed + name)
        page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        if name == "full/index.html":
            page.click("#profile-across")
            page.click("#link")
        assert page.evaluate("document.documentElement.scrollWidth") <= width, name
        for text, size, wide, seen in page.evaluate(TEXTS):
            assert size >= 12, f"{name}: {text}"
            assert wide <= seen + 1, f"{name}: {text} is cut"
        for ratio, text in page.evaluate(CONTRASTS):
            assert ratio >= 4.5, f"{name}: {text}"


TEXTS = """() => Array.from(document.querySelectorAll("h1, h2, h3, p, li, a, td, th, label, button, figcaption"))
    .filter((one) => one.checkVisibility() && one.textContent.trim() && !one.closest(".unseen, .skip, thead"))
    .map((one) => [one.textContent.trim().slice(0, 40), parseFloat(getComputedStyle(one).fontSize),
                   one.scrollWidth, one.clientWidth || one.scrollWidth])"""
CONTRASTS = """() => {
    const parts = (colour) => colour.match(/[\\d.]+/g).map(Number);
    const light = ([r, g, b]) => [r, g, b].map((one) => one / 255)
        .map((one) => (one <= 0.04045 ? one / 12.92 : ((one + 0.055) / 1.055) ** 2.4))
        .reduce((sum, one, k) => sum + one * [0.2126, 0.7152, 0.0722][k], 0);
    const ground = (one) => {
        for (; one; one = one.parentElement) {
            const found = parts(getComputedStyle(one).backgroundColor);
            if (found.length < 4 || found[3] > 0.99) return found;
        }
        return [255, 255, 255];
    };
    const seen = Array.from(document.querySelectorAll("p, a, td, th, label, button, h1, h2, h3, pre, span, option"));
    return seen.filter((one) => one.checkVisibility() && one.textContent.trim() && !one.closest(".unseen, .skip"))
        .map((one) => {
            const [dim, bright] = [light(parts(getComputedStyle(one).color)), light(ground(one))].sort((a, b) => a - b);
            return [(bright + 0.05) / (dim + 0.05), one.textContent.trim().slice(0, 40)];
        });
}"""


@pytest.mark.drawn
def test_many_slices_are_drawn_by_a_process_as_they_are_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two are many here, on two cores whatever this process has: on one there would be no other process."""
    figures = [Figure(f"slice-{k}", "fluid", (0, 1), PaperCaption(), resolution=4 + k) for k in range(2)]
    for figure in figures:
        keep(figure, tmp_path / "data")
    with monkeypatch.context() as patch:
        patch.setattr(studio, "MAX_DRAWN_HERE", 1)
        patch.setattr(runtime, "cores", lambda: 2)
        patch.setattr(studio, "draw_slice", lambda source, folder: pytest.fail("it is drawn here"))
        build_site(figures, tmp_path / "data", tmp_path / "many")
    build_site(figures[1:], tmp_path / "data", tmp_path / "one")
    for name in ("landscape.png", "landscape-dark.png", "thumbnail.png"):
        assert (tmp_path / "many/slice-1" / name).read_bytes() == (tmp_path / "one/slice-1" / name).read_bytes()


def test_most_is_said_where_the_interval_says_so() -> None:
    def tile(env: str, most: list[str], *, census: bool = True) -> Tile:
        return Tile(env, "", "", (), 3, "warp", 16, census, (), most=most)

    tiles = [
        tile("a", ["very smooth", "gradients follow"]),
        tile("b", []),
        tile("c", ["rugged"]),
        tile("d", ["rugged"]),
    ]
    smooth, follow = answers([*tiles, tile("e", ["rugged"], census=False)])
    assert "many slices of 4 environments" in smooth
    assert "very smooth in a, smooth with local minima in none, and rugged in c and d." in smooth
    assert "in most slices of a." in follow
    assert not _is_most(Estimate(0.9, 0.2, 1.0))
    assert _is_most(Estimate(0.9, 0.6, 1.0))
    assert _is_most(exactly(0.9))
