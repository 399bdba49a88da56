"""The pages that are walked: every command, public name, scene, figure and claim has its place, and says what it is."""

from __future__ import annotations

import html
import inspect
import re
from dataclasses import replace
from pathlib import Path
from pydoc import locate
from typing import get_overloads

import pytest
from docs.pages import commands, extension, pictures, reproduction, scenes
from docs.pages.kept import NOT_MEASURED, Kept, KeptFigure
from docs.pages.text import prose
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

import gradscape
from gradscape.cli import verbs
from gradscape.envs.registry import BUILTIN, environment_class
from gradscape.envs.user_functions import Function, FunctionKeywords
from gradscape.gallery.figures import read_figures
from gradscape.gallery.files import DATA
from gradscape.gallery.paper import read_paper
from gradscape.jobs.report import Report
from gradscape.landscapes.measures.verdict import WORDS
from gradscape.optim.claims import ClaimVerdict
from gradscape.optim.league import League

from ..gallery.site.conftest import scene_standings

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[2]


VERBS = verbs()
FOREIGN = {"DataFrame", "Dataset", "None", "Any", "Kind", "Path"}  # and type variables
PUBLIC = {name: getattr(gradscape, name) for name in gradscape.__all__ if not name.startswith("__")}


@pytest.fixture(scope="module")
def kept() -> Kept:
    return Kept.read()


@pytest.fixture(scope="module")
def verb_pages() -> dict[str, str]:
    return commands.pages()


@pytest.fixture
def nothing(tmp_path: Path) -> Kept:
    """What there is to show where nothing was measured."""
    return Kept.read(tmp_path / "empty")


def shown(text: str) -> str:
    """Return what a reader sees of Markdown."""
    rendered = MarkdownIt().enable("table").render(text)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", "", rendered)).split())


def test_every_command_has_a_page_with_all_its_options(verb_pages: dict[str, str]) -> None:
    for name, verb in VERBS.items():
        text = verb_pages[f"commands/{name.replace(' ', '-')}.md"]
        assert [word for option in verb.options for word in option.names if word not in text] == [], name
        assert " ".join(verb.help().split("\n\n")[0].split()).replace("`", "") in shown(text)
        assert f"$ landscape {name}" in text


def test_the_page_of_commands_lists_them_and_nothing_else(verb_pages: dict[str, str]) -> None:
    files = set(verb_pages) - {"commands/index.md"}
    assert files == {f"commands/{name.replace(' ', '-')}.md" for name in VERBS}
    assert all(f"({Path(file).name})" in verb_pages["commands/index.md"] for file in files)


def test_the_interface_lists_every_public_name_and_what_functions_return() -> None:
    """Of what is not public it lists the records of this package that a public function is annotated to return."""
    text = (ROOT / "docs/interface.md").read_text()
    listed = re.findall(r"^   (gradscape\.\S+)$", text, flags=re.MULTILINE)
    assert {f"gradscape.{name}" for name in PUBLIC} == {name for name in listed if name.count(".") == 1}
    assert [name for name in listed if locate(name) is None] == []
    functions = [one for one in PUBLIC.values() if not inspect.isclass(one)]
    annotated = [str(inspect.signature(one).return_annotation) for public in functions
                 for one in (public, *get_overloads(public))]  # fmt: skip
    returned = {word for text in annotated for word in re.findall(r"(?<![\w.])[A-Z]\w+", text)} - FOREIGN
    assert returned <= {name.rpartition(".")[2] for name in listed}
    defaults = {name: repr(getattr(Function, name)) for name in FunctionKeywords.__annotations__}
    assert dict(re.findall(r"\| `(\w+)` \| `(.+)` \|", text)) == defaults


def test_every_scene_has_a_page_with_what_it_says_and_where_it_is_bounded(
    kept: Kept, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "FUNCTION_RESOLUTION", 3)
    pages = scenes.pages(kept, tmp_path)
    assert set(pages) == {"scenes/index.md", *(f"scenes/{one.name}.md" for one in BUILTIN)}
    for entry in BUILTIN:
        kind = environment_class(entry.name)
        text = shown(pages[f"scenes/{entry.name}.md"])
        told = " ".join(kind.about().split("\n\n")[0].split())
        assert told.replace("`", "") in text, entry.name
        assert all(name in text for name in kind.fidelities)
    figures = {one.env for one in read_figures()}
    assert all(f"pictures/{env}" in pages[f"scenes/{env}.md"] for env in figures)
    assert "measures it" in pages["scenes/mjx-drop.md"]


def test_pages_hold_every_figure_and_claim_and_say_what_is_not_measured(
    nothing: Kept, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes, "BUILTIN", [])
    text = reproduction.pages(nothing, tmp_path)["reproduction.md"]
    figures, paper = read_figures(), read_paper()
    assert [one.id for one in figures if f"### {one.id}\n" not in text] == []
    assert text.count(f"| **{NOT_MEASURED}** |") >= len(figures) + sum(map(len, paper.claims.values()))
    assert all(prose(why) in text for why in paper.silences.values())
    assert {f"## Figure {one.caption.number}" for one in figures if one.caption.number} <= set(text.splitlines())
    everything = extension.pages(nothing, tmp_path)
    assert f"| {NOT_MEASURED} |" in everything["figures.md"]
    assert "## " not in everything["wall.md"]


@pytest.mark.parametrize(
    ("hits", "misses", "verdict"),
    [(1, 0, "confirmed"), (0, 2, "not seen here"), (1, 1, "different"), (0, 0, "not described in the paper")],
)
def test_a_slice_is_judged_by_which_of_the_paper_s_words_were_measured(
    tmp_path: Path, hits: int, misses: int, verdict: str
) -> None:
    """What was not measured with other settings than the paper's is not seen here, and refuted only with its own."""
    figure = next(one for one in read_figures() if one.id == "swing-stiffness-single")
    report = Report.read(DATA / figure.id)
    unseen = [word for word in WORDS if word not in report.words][:misses]
    own = replace(figure.caption, words=(*report.words[:hits], *unseen))
    one = KeptFigure(replace(figure, caption=own, env=figure.env if own.words else "branin"))
    assert reproduction.verdict_of(one) == verdict
    page = reproduction.pages(replace(Kept.read(tmp_path / "none"), figures=[one]), tmp_path)["reproduction.md"]
    assert f"| **verdict** | **{verdict}** |" in page
    assert (f"| **words of the paper that we did not find** | {', '.join(unseen)} |" in page) == bool(misses)
    options = report.options | environment_class(figure.env).preset_options("paper")
    one.report, one.figure = replace(report, options=options), replace(one.figure, id="of-no-finding")
    assert reproduction.verdict_of(one) == ("refuted" if verdict == "not seen here" else verdict)


def test_claims_are_what_the_league_makes_of_them(nothing: Kept) -> None:
    """In the made-up race bo-leap is ahead of cma-es, and that of random; other methods were not run."""
    raced = replace(nothing, league=League([scene_standings("fluid", {})], {}, "landscape league"))
    found = [one for one in reproduction.judge_claims(raced) if one.env == "fluid"]
    by = {(one.claim.first, one.claim.second): one.verdict for one in found}
    assert by["bo-leap", "random"] == by["bo-leap", "cma-es"] == "confirmed"
    assert by["bo-leap", "descents"] == "not run"
    assert {one.verdict for one in reproduction.judge_claims(raced) if one.env != "fluid"} == {NOT_MEASURED}
    assert len(set(ClaimVerdict)) + 3 == len(reproduction.MEANING)  # each that there is has a meaning


def test_pictures_lead_to_the_gallery_where_it_is_built_and_to_scenes_where_not(
    kept: Kept, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = next(one for one in kept.figures if one.slice is not None)
    monkeypatch.setattr(scenes, "BUILTIN", [entry for entry in BUILTIN if entry.name == one.figure.env])
    (tmp_path / "site" / one.figure.id).mkdir(parents=True)
    (tmp_path / "site" / one.figure.id / "index.html").write_text("")
    few = replace(kept, figures=[one])
    assert f":target: scenes/{one.figure.env}.html" in extension.pages(few, tmp_path)["wall.md"]
    pages = extension.pages(replace(few, gallery=tmp_path / "site"), tmp_path)
    assert f":target: ../gallery/{one.figure.id}/index.html" in pages["wall.md"]
    assert f'<a href="../../gallery/{one.figure.id}/index.html">' in pages[f"scenes/{one.figure.env}.md"]


def test_every_picture_of_the_pages_says_what_made_it() -> None:
    found = extension.pictures_of_pages()
    assert {one.name for kind in ("png", "webp") for one in (ROOT / "docs").glob(f"*.{kind}")} == set(found)
    for name, (pages, command) in found.items():
        assert pages, f"no page shows {name}"
        verb = re.match(r"landscape (gallery \w+|\w+)", command)
        assert verb
        assert verb[1] in VERBS


def test_samples_of_another_model_are_called_so(kept: Kept, monkeypatch: pytest.MonkeyPatch) -> None:
    one = next(one for one in kept.figures if one.current)
    monkeypatch.setattr(environment_class(one.figure.env), "model_version", 99)
    assert not KeptFigure(one.figure, one.root).current


def test_the_example_package_is_shown_whole() -> None:
    shown_files = re.findall(r"\{literalinclude\} (\S+)", (ROOT / "docs/example.md").read_text())
    files = [file for file in (ROOT / "docs/example_package").rglob("*.*") if file.suffix != ".pyc"]
    assert {f"example_package/{file.name}" for file in files} == set(shown_files)


def test_pages_of_what_is_gone_go(tmp_path: Path) -> None:
    pages = {"commands/slice.md": "# landscape slice\n"}
    extension.write({"commands/gone.md": "# gone\n"}, tmp_path)
    extension.write(pages, tmp_path)
    assert [file.name for file in tmp_path.rglob("*.md")] == ["slice.md"]
    written = (tmp_path / "commands/slice.md").stat().st_mtime_ns
    extension.write(pages, tmp_path)
    assert (tmp_path / "commands/slice.md").stat().st_mtime_ns == written  # what is equal stays


@given(st.lists(st.text("ab*_[]<>$#|{}~\\! .,=:", min_size=1, max_size=12).filter(str.strip), min_size=1, max_size=3))
def test_a_text_is_read_as_it_was_written(words: list[str]) -> None:
    text = "x" + " ".join(words)
    assert shown(prose(text)) == " ".join(text.split())
