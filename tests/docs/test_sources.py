"""Beside the pages: the bibliography has what is cited, the citation is ours, workflows run what is there."""

from __future__ import annotations

import re
import tomllib
import unicodedata
from pathlib import Path
from typing import Any

import pytest
import yaml
from pybtex.database import parse_file

import gradscape

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FOLDERS = ("api", "benchmarks", "commands", "docs", "envs", "gallery", "jobs", "landscapes", "optim")
FILES = [ROOT / "README.md", ROOT / "BENCHMARKS.md"] + [
    file for name in FOLDERS for kind in ("py", "md", "toml") for file in sorted((ROOT / name).rglob(f"*.{kind}"))
]
NAMES = r"([A-Z]\w+(?:(?:, | & | and )(?:Van )?[A-Z]\w+)*)(?: et al\.)?,? \(?((?:19|20)\d\d)\b"
PAGES = [file for file in sorted((ROOT / "docs").rglob("*.md")) if "generated" not in file.parts]
MONTHS = {"January", "February", "March", "April", "May", "June", "July", "August"}
MONTHS |= {"September", "October", "November", "December"}
VENUES = {"CoRL", "ICLR", "ICML", "NeurIPS", "GECCO"}


def plain(name: str) -> str:
    return "".join(one for one in unicodedata.normalize("NFD", name) if not unicodedata.combining(one)).lower()


def cited() -> list[tuple[str, str]]:
    """Return who is named with which year, in code and pages."""
    found = {hit for file in FILES for hit in re.findall(NAMES, " ".join(file.read_text().split()))}
    return sorted((names, year) for names, year in found if names not in MONTHS | VENUES)


def bibliography() -> list[tuple[set[str], str]]:
    entries = parse_file(ROOT / "docs/references.bib").entries.values()
    return [
        ({plain(str(part)) for one in entry.persons["author"] for part in one.rich_last_names}, entry.fields["year"])
        for entry in entries
    ]


def test_papers_are_cited_in_the_code() -> None:
    assert len(cited()) > 25


def test_every_paper_that_is_cited_is_in_the_bibliography() -> None:
    entries, missing = parse_file(ROOT / "docs/references.bib").entries.values(), []
    for names, year in cited():
        last = plain(re.split(r", | & | and ", names)[-1].removeprefix("Van "))
        matches = [people for people, when in bibliography() if when == year and any(last in one for one in people)]
        first = plain(names.split(", ")[0])  # of a title, where a sentence has that before the year
        titles = [one for one in entries if one.fields["year"] == year and first in plain(one.fields["title"])]
        missing += [] if matches or titles else [(names, year)]
    assert missing == []


def test_the_citation_is_of_this_project() -> None:
    found: dict[str, Any] = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert found["version"] == gradscape.__version__
    assert (found["title"], found["license"]) == (PROJECT["name"], PROJECT["license"])
    assert found["abstract"] == PROJECT["description"] + "."
    assert [one["name"] for one in found["authors"]] == [one["name"] for one in PROJECT["authors"]]
    assert found["keywords"] == PROJECT["keywords"]
    (paper,) = found["references"]
    entry = parse_file(ROOT / "docs/references.bib").entries["antonova2022"]
    assert [one["family-names"] for one in paper["authors"]] == [
        str(one.last_names[0]) for one in entry.persons["author"]
    ]
    assert (paper["title"], str(paper["year"])) == (entry.fields["title"], entry.fields["year"])
    assert paper["conference"]["name"] == entry.fields["booktitle"]
    assert (paper["collection-title"], str(paper["volume"])) == (entry.fields["series"], entry.fields["volume"])
    assert paper["url"].removeprefix("https://arxiv.org/abs/") == entry.fields["note"].removeprefix("arXiv:")


def test_the_changelog_begins_with_this_version() -> None:
    first = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert first
    assert first[1] == gradscape.__version__


@pytest.mark.parametrize("file", sorted((ROOT / ".github/workflows").glob("*.yml")), ids=lambda file: file.name)
def test_workflows_run_what_there_is(file: Path) -> None:
    found = yaml.safe_load(file.read_text())
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    lines = [step["run"] for job in found["jobs"].values() for step in job["steps"] if "run" in step]
    ours = [line.split() for line in lines if line.split()[0] in ("make", ".ci/run", ".venv/bin/landscape")]
    assert ours
    for words in ours:
        assert words[0] != "make" or words[1] in targets
        assert words[0] != ".ci/run" or (ROOT / ".ci/run").stat().st_mode & 0o100


def test_both_workflows_are_there_and_call_what_the_makefile_has() -> None:
    said = {file.name: file.read_text() for file in (ROOT / ".github/workflows").glob("*.yml")}
    assert "- run: .ci/run" in said["ci.yml"]
    assert "make docs" in said["pages.yml"]
    assert "make docs\n" in (ROOT / ".ci/run").read_text()


def test_no_block_of_python_is_left_out() -> None:
    """A block of Python is a cell, which the build runs, or stands where test_docs.py finds it, and runs it."""
    conf = (ROOT / "docs/conf.py").read_text()
    assert 'nb_execution_mode = "force"' in conf
    assert "nb_execution_raise_on_error = True" in conf
    for page in PAGES:
        text = page.read_text()
        kinds = set(re.findall(r"^```(\S.*)$", text, flags=re.MULTILINE))
        assert not any(kind.startswith("{code-cell}") for kind in kinds) or "file_format: mystnb" in text
        written = {kind for kind in kinds if "py" in kind and not kind.startswith("{literalinclude}")}
        assert written <= {"python", "{code-cell} python"}, page


def test_every_tutorial_is_listed_and_runs() -> None:
    listed = re.search(r"```{toctree}\n.*?\n\n(.*?)```", (ROOT / "docs/tutorials/index.md").read_text(), re.DOTALL)
    assert listed
    names = listed[1].split()
    assert len(names) == 8
    assert {file.stem for file in (ROOT / "docs/tutorials").glob("*.md")} == {*names, "index"}
    assert all("{code-cell}" in (ROOT / f"docs/tutorials/{name}.md").read_text() for name in names)
