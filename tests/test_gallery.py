"""`landscape gallery`: what is computed and when, what the site holds, and what a browser makes of it."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urldefrag

import numpy as np
import pytest

from gradscape import gallery_report
from gradscape.cli import main
from gradscape.envs.functions import Branin
from gradscape.gallery.figures import Figure
from gradscape.landscapes.store import open_slice

FIGURES = [
    Figure("bounce-y", "bounce", (1,), "It jumps.", number=8, through="example:aim", resolution=12, fidelity="draft"),
    Figure("bounce-x-y", "bounce", (0, 1), "A plane of it.", through="example:aim", resolution=12, fidelity="draft"),
    Figure("branin", "branin", (0, 1), "Three minima <b>&</b> no network.", resolution=12, fidelity="exact"),
]
PICTURE = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c4890000000d49444154789c6360606060000000050001a5f6"
    "45400000000049454e44ae426082"
)


def gallery(*arguments: str) -> int:
    with pytest.raises(SystemExit) as left:
        main(["gallery", *arguments])
    return int(left.value.code or 0)


@pytest.fixture(scope="module")
def listed() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gallery_report, "read_figures", lambda: list(FIGURES))
        yield


@pytest.fixture(scope="module")
def data(listed: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compute a small gallery, and add what other verbs make."""
    folder = tmp_path_factory.mktemp("data")
    assert gallery("compute", "--device", "cpu", "--data", str(folder)) == 0
    runs = [{"method": "bo-leap", "seed": 0, "u": [0.0, 2.5], "v": [7.5, 7.5], "loss": [20.0, 10.0]}]
    (folder / "branin/overlay.json").write_text(json.dumps(runs))
    (folder / "branin/episode-11-0.png").write_bytes(PICTURE)
    return folder


@pytest.fixture(scope="module")
def site(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "gallery"
    assert gallery("build", "--data", str(data), "--out", str(folder)) == 0
    return folder


def test_compute_goes_on_where_it_stopped_and_computes_nothing_twice(
    listed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points: list[int] = []
    evaluate = Branin._evaluate

    def stopping(env: Branin, x, *, grad):  # type: ignore[no-untyped-def]
        if sum(points) >= 64:
            raise KeyboardInterrupt
        points.append(len(x))
        return evaluate(env, x, grad=grad)

    monkeypatch.setattr(gallery_report, "_rate", lambda *_: 0.5)  # the first points are evaluated for the estimate too
    monkeypatch.setattr(Branin, "_evaluate", stopping)
    command = ("compute", "--only", "branin", "--device", "cpu", "--data", str(tmp_path), "--resolution", "40")
    assert gallery(*command) == 130
    said = capsys.readouterr().err
    assert "about 13 min in all" in said
    assert "stopped in branin" in said
    kept = int((open_slice(tmp_path / "branin/slice.zarr")["status"] > 0).sum())
    assert 0 < kept <= sum(points)
    points.clear()
    monkeypatch.setattr(
        Branin, "_evaluate", lambda env, x, *, grad: points.append(len(x)) or evaluate(env, x, grad=grad)
    )
    assert gallery(*command) == 0
    assert sum(points) == 1600 - kept
    points.clear()
    assert gallery(*command) == 0
    assert not points
    assert "1 of 1 figures are in" in capsys.readouterr().err


def test_a_figure_that_fails_does_not_stop_the_others(
    listed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = replace(FIGURES[1], id="broken", through="example:none")
    monkeypatch.setattr(gallery_report, "read_figures", lambda: [broken, FIGURES[2]])
    assert gallery("compute", "--device", "cpu", "--data", str(tmp_path)) == 1
    said = capsys.readouterr().err
    assert "broken failed: ValueError" in said
    assert "1 of 2 figures failed: broken" in said
    assert np.isfinite(open_slice(tmp_path / "branin/slice.zarr")["loss"]).all()


def test_list_says_what_is_there_missing_and_other(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert gallery("list", "--data", str(data), "--json") == 0
    assert {one["id"]: (one["done"], one["points"]) for one in json.loads(capsys.readouterr().out)} == {
        "bounce-y": (12, 12), "bounce-x-y": (144, 144), "branin": (144, 144)
    }  # fmt: skip
    gallery("list", "--data", str(data / "none"), "--json")
    assert {one["done"] for one in json.loads(capsys.readouterr().out)} == {0}
    assert gallery_report._state(replace(FIGURES[2], resolution=6), data).done is None


def test_build_refuses_an_empty_folder_of_data_and_foreign_files(listed: None, data: Path, tmp_path: Path) -> None:
    assert gallery("build", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "site")) == 2
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("words")
    assert gallery("build", "--data", str(data), "--out", str(tmp_path / "mine")) == 2
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_a_figure_of_which_nothing_is_sampled_begins_anew_by_other_code(
    listed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("compute", "--only", "branin", "--device", "cpu", "--data", str(tmp_path))
    monkeypatch.setattr(gallery_report, "_sample", stop)
    identity = gallery_report.identity_of
    monkeypatch.setattr(gallery_report, "identity_of", lambda env: identity(env) | {"code": "other"})
    assert gallery(*command) == 1
    monkeypatch.undo()
    monkeypatch.setattr(gallery_report, "read_figures", lambda: list(FIGURES))
    assert gallery(*command) == 0
    assert open_slice(tmp_path / "branin/slice.zarr").attrs["identity"]["code"] != "other"


def stop(*_: object) -> None:
    raise RuntimeError("stopped")


class Page(HTMLParser):
    """Collect what a page refers to, its anchors and its pictures."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.references: list[str] = []
        self.ids: list[str] = []
        self.pictures: list[dict[str, str | None]] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.references += [value for name in ("href", "src", "poster") if (value := found.get(name))]
        self.ids += [value for value in [found.get("id")] if value]
        self.pictures += [found] if tag == "img" else []


def test_every_link_and_picture_is_in_the_site(site: Path) -> None:
    pages = {path: Page(path) for path in site.rglob("*.html")}
    assert len(pages) == 1 + len(FIGURES)
    for path, page in pages.items():
        assert len(set(page.ids)) == len(page.ids)
        assert all("alt" in picture for picture in page.pictures)
        for reference in page.references:
            file, anchor = urldefrag(reference)
            if file != "data:,":
                target = (path.parent / file).resolve() if file else path
                assert target.is_file(), f"{path}: {reference}"
                assert not anchor or anchor in Page(target).ids


def test_no_file_of_the_site_names_an_address(site: Path) -> None:
    texts = [path for path in site.rglob("*") if path.suffix in {".html", ".css", ".js", ".json"}]
    assert len(texts) >= 4 + 2 * len(FIGURES)
    assert not [path for path in texts if re.search(r"(https?:)?//[\w.]+\.\w|@import", path.read_text())]


def test_the_manifest_lists_every_page_with_its_files_and_numbers(site: Path, data: Path) -> None:
    manifest = json.loads((site / "manifest.json").read_text())
    assert [entry["id"] for entry in manifest["figures"]] == [figure.id for figure in FIGURES]
    for entry in manifest["figures"]:
        assert {path.name for path in (site / entry["id"]).iterdir()} == set(entry["files"])
        loss = open_slice(data / entry["id"] / "slice.zarr")["loss"]
        assert entry["numbers"]["lowest"] == float(loss.min())
        assert entry["numbers"]["status"]["ok"] == loss.size
        assert entry["command"].startswith("landscape ")
    assert manifest["missing"] == []


def test_words_of_a_figure_are_escaped(site: Path) -> None:
    assert "Three minima &lt;b&gt;&amp;&lt;/b&gt; no network." in (site / "branin/index.html").read_text()


@pytest.fixture(scope="module")
def browser():  # type: ignore[no-untyped-def]
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if not program:
        pytest.skip("no Chromium here: `apt-get install -y chromium` (or your system's) lets this test run")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=program, args=["--disable-gpu"])
        yield opened
        opened.close()


@pytest.fixture
def served(site: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "gradscape", "gallery", "serve", "--out", str(site), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        found = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
        assert found
        yield found[0]
        process.terminate()


@pytest.fixture
def visit(browser) -> Iterator[Callable]:  # type: ignore[no-untyped-def, type-arg]
    """Open a page and, at the end, hold that it asked for nothing elsewhere and complained of nothing."""
    page = browser.new_page(viewport={"width": 1100, "height": 900})
    complaints: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("requestfailed", lambda request: complaints.append(f"{request.url} failed"))
    page.on("response", lambda response: complaints.append(response.url) if response.status >= 400 else None)
    page.on("request", lambda request: asked.append(request.url))
    roots: list[str] = []

    def go(root: str, path: str):  # type: ignore[no-untyped-def]
        roots.append(root)
        page.goto(root + path, wait_until="load")
        return page

    yield go
    assert complaints == []
    assert asked
    assert not [url for url in asked if not url.startswith((*roots, "data:"))]
    page.close()


PIXELS = """(id) => {
    const map = document.getElementById(id), copy = new OffscreenCanvas(map.width, map.height);
    const pen = copy.getContext("2d", { willReadFrequently: true });
    pen.drawImage(map, 0, 0);
    return Array.from(pen.getImageData(0, 0, map.width, map.height).data).join();
}"""


@pytest.mark.parametrize("way", ["file", "server"])
def test_the_site_opens_in_a_browser(
    way: str, site: Path, visit: Callable, request: pytest.FixtureRequest  # type: ignore[type-arg]
) -> None:  # fmt: skip
    root = f"file://{site}/" if way == "file" else request.getfixturevalue("served")
    page = visit(root, "index.html")
    assert page.locator(".card img").count() == len(FIGURES)
    page.click("text=velocity y [m/s] >> nth=0")
    page.wait_for_url("**/bounce-y/index.html")
    sizes = page.eval_on_selector_all("img", "all => all.map(one => one.naturalWidth)")
    assert all(size > 100 for size in sizes)
    assert "Figure 8" in page.inner_text("header")
    page.click("text=All landscapes")
    page.wait_for_url("**/index.html")


def test_the_map_says_what_is_under_the_pointer_and_the_keys(site: Path, data: Path, visit: Callable) -> None:  # type: ignore[type-arg]
    page = visit(f"file://{site}/", "branin/index.html")
    dataset = open_slice(data / "branin/slice.zarr")
    loss = dataset["loss"].to_numpy()
    box = page.locator("#map").bounding_box()
    scale = box["width"] / 640
    page.mouse.move(box["x"] + scale * (68 + 560 * 2.5 / 12), box["y"] + scale * (12 + 580 * (1 - 4.5 / 12)))
    assert told(page, "Loss") == pytest.approx(loss[4, 2], rel=1e-3)
    assert told(page, "x") == pytest.approx(float(dataset["u"][2]), rel=1e-3)
    slope = dataset["grad"].to_numpy()[4, 2]
    assert told(page, "Gradient’s length") == pytest.approx(np.linalg.norm(slope), rel=1e-3)
    page.focus("#map")
    for key in ("ArrowRight", "ArrowUp", "ArrowUp"):
        page.keyboard.press(key)
    assert told(page, "Loss") == pytest.approx(loss[6, 3], rel=1e-3)
    page.keyboard.press("Home")
    assert told(page, "Loss") == pytest.approx(loss.min(), rel=1e-3)
    page.mouse.click(box["x"] + scale * 70, box["y"] + scale * 14)  # the uppermost node on the left has an episode
    assert page.evaluate("document.activeElement.id") == "episode-11-0"


def told(page, what: str) -> float:  # type: ignore[no-untyped-def]
    line = next(line for line in page.inner_text("#readout").splitlines() if line.startswith(what))
    return float(line.split(": ")[1].split()[0].replace("\N{MINUS SIGN}", "-"))


def test_the_map_shows_the_landscape_and_its_switches_work(site: Path, visit: Callable) -> None:  # type: ignore[type-arg]
    page = visit(f"file://{site}/", "branin/index.html")
    first = page.evaluate(PIXELS, "map")
    pixels = np.array(first.split(","), dtype=int).reshape(640, 640, 4)
    seen = pixels[12:592:48, 68:628:46]
    assert len(np.unique(seen.reshape(-1, 4), axis=0)) > 20
    page.uncheck("input[name=bo-leap]")
    without = page.evaluate(PIXELS, "map")
    assert without != first
    page.check("input[name=bo-leap]")
    assert page.evaluate(PIXELS, "map") == first
    page.check("input[name=arrows]")
    assert page.evaluate(PIXELS, "map") != first


def test_the_surface_is_there_and_turns(site: Path, visit: Callable) -> None:  # type: ignore[type-arg]
    page = visit(f"file://{site}/", "branin/index.html")
    first = page.evaluate(PIXELS, "surface")
    colours = np.unique(np.array(first.split(","), dtype=int).reshape(-1, 4), axis=0)
    assert len(colours) > 100
    page.focus("#surface")
    page.keyboard.press("ArrowRight")
    assert page.evaluate(PIXELS, "surface") != first
    page.keyboard.press("ArrowLeft")
    turned = page.evaluate(PIXELS, "surface")
    page.uncheck("input[name=bo-leap]")
    assert page.evaluate(PIXELS, "surface") != turned


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_page_fits_a_phone_in_light_and_dark(site: Path, visit: Callable, scheme: str) -> None:  # type: ignore[type-arg]
    page = visit(f"file://{site}/", "branin/index.html")
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": 375, "height": 700})
    assert page.evaluate("document.documentElement.scrollWidth") <= 375
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    level = float(np.mean([int(part) for part in re.findall(r"\d+", ground)[:3]]))
    assert level > 200 if scheme == "light" else level < 60
