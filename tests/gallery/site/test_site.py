"""What a built site holds, without a browser."""

import csv
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urldefrag

import numpy as np
import pytest
from PIL import Image

from gradscape.gallery.league import read_standings
from gradscape.gallery.paper import read_paper
from gradscape.gallery.records import open_run
from gradscape.gallery.site.build import build_site
from gradscape.landscapes.draw.pages.rendering import STATIC
from gradscape.landscapes.identity import stored_identity
from gradscape.landscapes.storage.store import open_slice

from .conftest import FIGURES, SWEEP, kept_report


class Page(HTMLParser):
    """Collect what a page refers to, its anchors, its pictures and what labels its controls."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.references: list[str] = []
        self.ids: list[str] = []
        self.pictures: list[dict[str, str | None]] = []
        self.sources: list[dict[str, str | None]] = []
        self.named: list[str] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.references += [value for name in ("href", "src", "srcset", "poster") if (value := found.get(name))]
        self.sources += [found] if tag == "source" else []
        self.ids += [value for value in [found.get("id")] if value]
        self.pictures += [found] if tag == "img" else []
        for name in ("aria-labelledby", "aria-describedby", "for", "data-copy"):
            self.named += (found.get(name) or "").split()


def test_every_link_and_picture_is_in_the_site(site: Path) -> None:
    pages = {path: Page(path) for path in site.rglob("*.html")}
    assert len(pages) == 5 + len(FIGURES)  # the index, the report card, the league and its two races
    for path, page in pages.items():
        assert len(set(page.ids)) == len(page.ids)
        assert set(page.named) <= set(page.ids)
        assert all("alt" in picture for picture in page.pictures)
        for reference in page.references:
            file, anchor = urldefrag(reference)
            if not file.startswith("data:"):
                target = (path.parent / file).resolve() if file else path
                assert target.is_file(), f"{path}: {reference}"
                if anchor.startswith("node="):  # of the map
                    assert "map" in Page(target).ids
                else:
                    assert not anchor or anchor in Page(target).ids


def test_no_file_of_the_site_names_an_address(site: Path) -> None:
    texts = [path for path in site.rglob("*") if path.suffix in {".html", ".css", ".js", ".json"}]
    assert len(texts) >= 4 + 2 * len(FIGURES)
    assert not [path for path in texts if re.search(r"(https?:)?//[\w.]+\.\w|@import|url\(", path.read_text())]


def test_the_manifest_lists_everything_of_a_page(site: Path, data: Path) -> None:
    manifest = json.loads((site / "manifest.json").read_text())
    assert manifest["schema"] == 3
    assert manifest["missing"] == ["later"]
    assert [entry["id"] for entry in manifest["figures"]] == [figure.id for figure in FIGURES]
    for entry in manifest["figures"]:
        assert {path.name for path in (site / entry["id"]).iterdir()} == set(entry["files"])
        loss = open_slice(data / entry["id"] / "slice.zarr")["loss"]
        assert entry["numbers"]["lowest"] == float(loss.min())
        assert entry["numbers"]["status"]["ok"] == int(np.isfinite(loss).sum())
        assert entry["command"].startswith("landscape ")
    full = manifest["figures"][-1]
    assert full["numbers"]["status"]["nonfinite"] > 0
    assert (full["sweep"], full["measures"]) == (SWEEP, kept_report().profile.measures)
    assert [(one["row"], one["column"], one["why"]) for one in full["episodes"]] == [
        (6, 5, "lowest loss, through the slice's point"), (11, 11, "highest loss")
    ]  # fmt: skip
    assert full["episodes"][0]["at"] == {"speed [m/s]": pytest.approx(-1 / 11), "force [N]": pytest.approx(120 / 11)}
    for run in full["runs"]:
        table = open_run(data / f"runs/fluid/{run['method']}-0.zarr.zip")
        assert (run["budget"], run["episodes"], run["best"]) == (24, 24, float(table["loss"].min()))
    assert [run["method"] for run in full["runs"]] == ["descents", "random"]


def test_a_page_shows_what_each_part_of_the_model_is_for(site: Path) -> None:
    manifest = json.loads((site / "manifest.json").read_text())
    assert manifest["studies"]["bounce"] == []
    (study,) = (one for one in manifest["studies"]["fluid"] if one["kind"] == "model")
    found = study["found"]
    assert (study["device"], found["fidelity"], study["file"]) == ("cuda", "draft", "studies/fluid-cuda.model.json")
    assert [(row["name"], row["missing"]) for row in found["parts"]] == [("drag", False), ("wall", True)]
    drag = found["parts"][0]
    assert drag["comparison"]["loss_error"]["p95_relative"]["value"] == pytest.approx(1 / found["spread"])
    assert (drag["effect"], drag["price"]) == ("changes losses, not their order", "saves time")
    assert found["refused"] == [{"name": "tank", "why": "fluid needs its tank"}]
    full = manifest["figures"][-1]
    page = (site / full["page"]).read_text()
    assert all(said in page for said in ("What each part of the model contributes", "wall (missing)", "no drag"))


def test_a_page_shows_the_same_cut_elsewhere_where_that_was_sampled(site: Path) -> None:
    page = (site / "full/index.html").read_text()
    assert "The same parameters through other points" in page
    assert "through center from 0.25 to 3.5" in page
    assert "through example:scoop all episodes failed" in page
    assert 'href="companions.png"' in page
    assert "The same parameters through other points" not in (site / "bare/index.html").read_text()


def test_the_report_card_says_what_was_found_of_which_version(site: Path) -> None:
    page = " ".join((site / "card.html").read_text().split())
    assert (
        "The same check ran on 4 pairs of an engine and a scene, ours included (2030-01-01, cpu): 1 passes, 1 fails"
        in page
    )
    assert "engine 1.2.3" in page
    assert "33 % (22 to 46 %) of 64 points" in page
    assert "<strong>sign</strong>: the gradient has the wrong sign at 21 of 64 points" in page
    assert page.count('src="data:image/png;base64,') == 3  # a panel of each that has a slice
    assert 'href="card.html"' in (site / "index.html").read_text()
    rows = list(csv.DictReader((site / "card/card.csv").read_text().splitlines()))
    assert [one["verdict"] for one in rows] == ["passes", "not installed", "fails", "not decided"]
    assert [one["wrong"] for one in rows] == ["0", "0", "21", "0"]


def test_the_league_holds_claims_against_pairs_and_says_what_did_not_run(site: Path, data: Path) -> None:
    page = bare_cells((site / "league.html").read_text())
    assert "3 methods, 5 seeds each, 12 episodes a run" in page
    claims = read_paper().claims_about("fluid").claims
    found = read_standings(data / "league/fluid.json")
    pairs = {(one.first, one.second): one for one in found.pairs}
    for claim in claims:
        row = re.search(rf"{claim}</th>(.*?)</tr>", page)
        assert row is not None
        chance = pairs.get((claim.first, claim.second))
        assert ("not run" in row[1]) == (chance is None)
        if chance:  # of five seeds that are ten apart, each less than each
            assert ("confirmed" in row[1], chance.probability) == (chance.corrected < 0.05, 1.0)
            assert "100 %" in row[1]
    assert "2 confirmed, 2 not run" in page
    assert "bounce: The paper compares no optimisers here" in page
    assert 'href="league.html"' in (site / "index.html").read_text()
    assert {path.name for path in (site / "league").iterdir() if path.is_file()} == {
        f"{name}{kind}"
        for name in ("league", "fluid", "bounce") for kind in (".json", ".csv", ".png", "-dark.png", ".html")
        if (name, kind) != ("league", ".html")
    }  # fmt: skip
    races = [bare_cells((site / f"league/{name}.html").read_text()) for name in ("fluid", "bounce")]
    assert any("Without turbo: turbo is &lt;not&gt; here" in race for race in races)
    assert ["Where the searches went" in race for race in races] == [True, False]  # one of the two has a slice
    assert "landscape slice fluid --dims 0 1 --through best" in races[0]
    assert races[0].count("<strong class=") == len(claims)
    assert {path.name for path in (site / "league/fluid").iterdir()} == {
        "medians.png", "medians-dark.png", "slice.csv", "slice.zarr.zip"
    }  # fmt: skip


def test_ranks_are_legible_on_their_colours(site: Path) -> None:
    page = (site / "league.html").read_text()
    cells = re.findall(r"background: (#\w{6}); color: (\w+)", page)
    assert len(cells) == 2 * 3 * 3  # of two scenes, and of all, at equal episodes and at equal cost
    inks = {"white": 1.0, "black": 0.0}
    for ground, ink in cells:
        low, high = sorted((luminance(ground), inks[ink]))
        assert (high + 0.05) / (low + 0.05) >= 4.5


MINIMA = "12 minima and 7.5 turns along a side, deeper than 1 % of the range; exponent over short distances 0.90"
COSINE = "mean cosine of gradient and slope over 1 % of the box: 0.25 (0.10 to 0.40), not"


def test_words_are_beside_the_papers_and_a_trade_off_is_ranked(site: Path) -> None:
    manifest = json.loads((site / "manifest.json").read_text())
    bare, full = manifest["figures"][1:]
    assert (bare["report"], manifest["studies"]["bounce"]) == (None, [])
    agreed = {one["word"]: (one["measured"], one["paper"]) for one in full["report"]["words"]}
    assert agreed == {
        "rugged": (True, True), "gradients follow": (False, True), "gradients do not follow": (True, False)
    }  # fmt: skip
    assert full["report"]["picture"] == (
        "Gradient quality over the slice: mean cosine of gradient and slope, by parts of the box: "
        "1 %: 0.25 (0.10 to 0.40), not; "
        "smoothed over 1% of the box, first order is biased at 9 of 36"
    )
    trade, another = (one for one in manifest["studies"]["fluid"] if one["kind"] == "fidelity")
    assert (trade["device"], another["device"]) == ("cuda", "cpu")
    files = {path.name for path in (site / "studies").iterdir()}
    studies = ("fluid-cuda.fidelity", "fluid-cpu.fidelity", "fluid-cuda.model", "fluid-cuda.convergence")
    assert files == {f"{study}{kind}" for study in studies for kind in (".json", ".csv", ".png", "-dark.png")}
    said = "the reference is not converged: refining its dt moves it by 4 %, while standard is off by 10 %"
    (convergence,) = (one for one in manifest["studies"]["fluid"] if one["kind"] == "convergence")
    assert convergence["says"][0].startswith(said)
    assert convergence["device"] == "cuda"
    full_page = (site / "full/index.html").read_text()
    assert said in " ".join(full_page.split())
    assert trade["front"] == ["draft", "standard"]
    assert re.findall(r'<tr><th scope="row">(?:coarse|draft|standard|slow|reference)[^<]*', full_page)[:5] == [
        f'<tr><th scope="row">{name}' for name in ("coarse", "draft ★", "standard ★", "slow", "reference")
    ]
    assert trade["alt"] == (
        "Loss error of 5 variants of fluid against the time of an episode: draft takes 4 ms and is off by 9 %; "
        "standard takes 40 ms and is off by 3 %; the fastest within 5% is standard with 40 ms; "
        "the reference takes 400 ms"
    )


def test_a_search_lies_where_its_parameters_say(site: Path, data: Path) -> None:
    """On the slice through the middle of the box a point's place is its own two parameters, its distance the third."""
    text = (site / "full/nodes.js").read_text().removeprefix("let SLICE = ").rstrip(";\n")
    for run in json.loads(text)["runs"]:
        table = open_run(data / f"runs/fluid/{run['method']}-0.zarr.zip")
        x, loss = table["x"].to_numpy(), table["loss"].to_numpy()
        np.testing.assert_allclose([run["u"], run["v"]], x[:, :2].T, rtol=1e-5)
        np.testing.assert_allclose(run["distance"], [np.abs(x[:, 2]).min() / 10, np.abs(x[:, 2]).max() / 10], rtol=1e-9)
        order = np.argsort(np.abs(x[:, 2]))
        assert (np.diff(np.array(run["radius"])[order]) <= 0).all()
        assert run["path"] == [
            row for row in range(24) if np.isfinite(loss[row]) and not (loss[:row] <= loss[row]).any()
        ]


def test_a_search_of_other_options_is_not_laid_over_a_slice(data: Path) -> None:
    from gradscape.gallery.site.page_data import lay_own, read_runs

    tables, dataset = read_runs(data), open_slice(data / "full/slice.zarr")
    assert len(tables) == 4
    assert len(lay_own(dataset, tables)) == 2
    own = next(one for one in tables if lay_own(dataset, [one]))
    assert not lay_own(dataset, [own.assign_attrs(identity=json.dumps({**stored_identity(own), "model_version": 99}))])
    for one, goal in ((dataset, "high"), (tables[-1], "low")):
        one.attrs["identity"] = json.dumps({**stored_identity(one), "options": {"goal": goal}})
    assert [run.method for run in lay_own(dataset, tables)] == ["descents"]


def test_counts_are_multiplied_and_axes_are_not(site: Path) -> None:
    page = (site / "full/index.html").read_text()
    assert "5 × (ladle speed x, ladle speed y) [m/s]" in page


def test_words_of_a_figure_are_escaped(site: Path) -> None:
    assert "All of it &lt;b&gt;&amp;&lt;/b&gt; no network." in (site / "full/index.html").read_text()


def test_a_page_says_what_it_has_and_nothing_of_what_it_has_not(site: Path) -> None:
    full, bare = ((site / name / "index.html").read_text() for name in ("full", "bare"))
    sections = ("sweep-title", "episodes-title", "measures-title", "fidelity-title", 'id="surface"')
    assert [section in full for section in sections] == [True, True, True, True, True]
    assert [section in bare for section in sections] == [False, False, False, False, True]
    words = re.findall(r'<th scope="row">([\w ]+)</th>\s*<td>([^<]*)</td>\s*<td>([^<]*)</td></tr>', bare_cells(full))
    assert words[:3] == [
        ("rugged", f"yes: {MINIMA}", "agrees"), ("gradients follow", "no", "disagrees: claims this"),
        ("gradients do not follow", f"yes: {COSINE}", "not mentioned"),
    ]  # fmt: skip
    assert "<li>jumps not searched</li>" in full
    assert f'<th scope="row">Hölder exponent</th><td>{kept_report().profile.measures["Hölder exponent"]}</td>' in full
    assert bare_cells(full).count("<td>9 (4.5 to 18)</td> <td>0.987</td> <td>0.654</td> <td>25 % (15 to 37)</td>") == 2
    assert re.findall(r"<h3>(On .*?)</h3>", full) == ["On cuda", "On cpu"]
    assert "2 J from the 5th to the 95th percentile" in full.replace("\n", " ")
    assert "Mass from −10 to 10: 12 slices" in full.replace("\n", " ")
    assert SWEEP["command"] in full
    assert '<th scope="row">mass</th><td>0</td><td>none</td>' in bare_cells(full)
    line = bare_cells((site / "line/index.html").read_text())
    assert '<th scope="row">force</th><td>10</td><td>N</td>' in line


def bare_cells(page: str) -> str:
    """Return a page without line breaks and what its cells say of their columns."""
    return re.sub(r' data-label="[^"]*"', "", re.sub(r"\s+", " ", page))


def test_every_picture_has_a_dark_variant_for_screens_and_print_has_the_light_one(site: Path) -> None:
    for path in site.rglob("*.html"):
        page = Page(path)
        seen = [picture for picture in page.pictures if "printed" not in str(picture.get("class"))]
        light = [str(picture["src"]) for picture in seen if str(picture.get("src")).endswith(".png")]
        assert light or path.name == "card.html"  # whose panels are maps alone, without a ground
        assert [source["srcset"] for source in page.sources] == [src.replace(".png", "-dark.png") for src in light]
        assert {source["media"] for source in page.sources} <= {"screen and (prefers-color-scheme: dark)"}


def test_cells_say_which_column_they_are_of_where_there_is_a_heading(site: Path) -> None:
    """On a phone they stand one below the other."""
    full = (site / "full/index.html").read_text()
    for table in re.findall(r"<table.*?</table>", full, re.DOTALL):
        heading = re.search(r'<thead(?: class="(.*?)")?>(.*?)</thead>', table, re.DOTALL)
        if heading and heading[1] is None:
            names = [re.sub(r"\s+", " ", name) for name in re.findall(r'"col">(.*?)</th>', heading[2], re.DOTALL)][1:]
            labels = re.findall(r'data-label="([^"]*)"', table)
            assert labels
            assert all(any(name.startswith(label) for name in names) for label in labels)


def test_a_folder_of_other_files_is_left_alone(data: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("words")
    with pytest.raises(
        ValueError, match=r"is not replaced, because it has files that do not belong to a gallery.*: thesis\.txt; move"
    ):
        build_site(FIGURES, data, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    "said", ["{}", "[", '{"files": ["thesis.txt", "manifest.json"]}', '{"schema": 2, "figures": []}']
)
def test_a_manifest_of_something_else_gives_no_folder_away(data: Path, tmp_path: Path, said: str) -> None:
    (tmp_path / "manifest.json").write_text(said)
    (tmp_path / "thesis.txt").write_text("words")
    with pytest.raises(ValueError, match=r"is not replaced, .*: manifest\.json, thesis\.txt; move"):
        build_site(FIGURES, data, tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["manifest.json", "thesis.txt"]


def test_a_site_is_built_anew_where_its_manifest_lists_all_that_is_there(
    site: Path, data: Path, tmp_path: Path
) -> None:
    out, link = shutil.copytree(site, tmp_path / "out"), tmp_path / "link"
    link.symlink_to(out)
    for mine in ("thesis.txt", "full/notes.txt", ".git/HEAD"):
        (out / mine).parent.mkdir(exist_ok=True)
        (out / mine).write_text("words")
        for place in (out, link):
            with pytest.raises(ValueError, match=rf"{out} is not replaced, .*: {mine}; move"):
                build_site(FIGURES[:1], data, place)
        assert (out / mine).read_text() == "words"
        (out / mine).unlink()
    (out / "elsewhere").symlink_to(tmp_path)
    with pytest.raises(ValueError, match="elsewhere; move"):
        build_site(FIGURES[:1], data, out)
    (out / "elsewhere").unlink()
    files = build_site(FIGURES[:1], data, link).files
    assert sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()) == files
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "out"]


def colours(scheme: str) -> dict[str, str]:
    """Return the colours that the style sheet names for light, or for dark where it has its own."""
    light, dark = re.findall(r":root \{(.*?)\}", (STATIC / "style.css").read_text(), re.DOTALL)
    return dict(re.findall(r"--(\w+): (#\w{6})", light if scheme == "light" else light + dark))


def luminance(colour: str) -> float:
    parts = np.array([int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_contrast_of_text_is_that_of_wcag_aa(scheme: str) -> None:
    """WCAG 2.2, 1.4.3: 4.5 for text; 1.4.11: 3 for edges of controls, the focus and the curve."""
    named = colours(scheme)
    wanted = dict.fromkeys(("ink", "quiet", "link"), 4.5) | dict.fromkeys(("edge", "focus", "curve"), 3.0)
    for ground in ("ground", "panel"):
        for name, least in wanted.items():
            low, high = sorted((luminance(named[name]), luminance(named[ground])))
            assert (high + 0.05) / (low + 0.05) >= least, f"{name} on {ground}"


def test_pictures_keep_their_room_before_they_are_there(site: Path) -> None:
    for page in site.rglob("*.html"):
        for tag in re.findall(r"<img\b[^>]*>", page.read_text()):
            if 'src="' in tag and 'src="data:' not in tag:
                assert re.search(r'\swidth="\d+" height="\d+"', tag), (page, tag)
    text = (site / "full/index.html").read_text()
    found = re.search(r'src="landscape.png" width="(\d+)" height="(\d+)"', text)
    with Image.open(site / "full/landscape.png") as picture:
        assert found
        assert picture.size == (int(found[1]), int(found[2]))
