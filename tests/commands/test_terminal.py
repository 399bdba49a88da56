"""Tables on narrow terminals: what has a name is folded, and not cut."""

import re
from collections.abc import Callable
from io import StringIO
from pathlib import Path

import pytest

import gradscape
from gradscape.commands.terminal import Console, table
from gradscape.envs.registry import entries
from gradscape.gallery.figures import read_figures
from gradscape.optim.registry import methods

from ..command import Said

SOURCES = list(Path(gradscape.__path__[0]).glob("commands/*.py"))


def test_a_cell_that_is_too_wide_goes_on_in_the_next_line_with_every_letter() -> None:
    name, shown = "stable-baselines-of-the-third-kind", StringIO()
    found = table("method [of ours]", "what", title="some [of them]")
    found.add_row(name, "a " * 20)
    Console(file=shown, width=24).print(found)
    text = shown.getvalue()
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 24
    first = [line.split("│")[1].strip() for line in text.splitlines() if line.startswith("│")]
    assert "".join(first) == name
    assert "[of them]" in text  # brackets are what they are, and no markup
    assert "[of" in text


def test_every_table_is_made_that_way() -> None:
    assert len(SOURCES) > 10
    assert [
        file.name for file in SOURCES if file.name != "terminal.py" and re.search(r"\bTable\(", file.read_text())
    ] == []


@pytest.mark.parametrize(
    ("command", "names"),
    [
        ("envs", list(entries())),
        ("methods", list(methods())),
        ("gallery list", [figure.env for figure in read_figures()]),
    ],
)
def test_lists_fit_eighty_columns(run: Callable[..., Said], tmp_path: Path, command: str, names: list[str]) -> None:
    said = run(*command.split(), cwd=tmp_path, width=80).stdout
    assert "…" not in said
    assert max(map(len, said.splitlines())) <= 80 or command == "gallery list"  # whose title is a path
    assert [name for name in names if name not in said] == []
