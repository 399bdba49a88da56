"""Tables on narrow terminals: what has a name is folded, and not cut; no name steers the terminal."""

import re
from io import StringIO
from pathlib import Path

import pytest
from rich.text import Text

import gradscape
from gradscape.commands.terminal import Bars, Console, table
from gradscape.envs.registry import entries
from gradscape.gallery.figures import read_figures
from gradscape.optim.registry import methods

from ..command import Run

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


EVIL = "a\x1b]0;title\x07\x1b[2J\rb\x9b1m\u202ec"
SHOWN = r"a\x1b]0;title\x07\x1b[2J\rb\x9b1m\u202ec"


def test_control_characters_in_names_are_shown_and_not_obeyed() -> None:
    shown = StringIO()
    console = Console(file=shown, width=60, force_terminal=True, color_system=None)
    found = table(EVIL, title=EVIL)
    found.add_row(EVIL)
    console.print(found)
    rows = shown.getvalue().splitlines()
    assert sum(SHOWN in row for row in rows) == 3
    assert len({len(row) for row in rows[1:]}) == 1  # what is escaped has its room
    console.print(EVIL)
    console.print(Text("laid out before: \x1b[2J"))
    with Bars(console).busy(EVIL) as say:
        say(f"more {EVIL}")
    with Bars(console).progress(2, EVIL) as advance:
        advance(1, EVIL)
    assert r"laid out before: \x1b[2J" in shown.getvalue()
    for control in ("\x1b]", "\x1b[2J", "\x07", "\x9b", "\u202e"):
        assert control not in shown.getvalue()


def test_a_class_of_others_does_not_steer_the_terminal(run: Run, tmp_path: Path) -> None:
    (tmp_path / "evil.py").write_text(
        "import gradscape as gs\nclass Evil(gs.Environment):\n    'It \\x1b[2J.'\n    name = 'evil\\x1b[2J'\n"
        "    space = gs.ParameterSpace({'\\x1b]0;k': (0, 1, 'm\\x07'), 'x': (0, 1)})\n"
        "    def _evaluate(self, x, *, grad): return gs.Evaluation.from_results(x[:, 0], None)\n"
    )
    for command in (
        ["envs", "evil.py:Evil"],
        ["slice", "evil.py:Evil", "--dims", "k", "0"],
        ["slice", "branin", "--dims", "0", "1", "--through", "\x1b[2J.npy"],
    ):
        said = run(*command)
        assert r"\x1b" in said.stdout + said.stderr
        assert not set("\x1b\x07") & set(said.stdout + said.stderr), command


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
def test_lists_fit_eighty_columns(run: Run, command: str, names: list[str]) -> None:
    said = run(command, width=80).stdout
    assert "…" not in said
    assert max(map(len, said.splitlines())) <= 80 or command == "gallery list"  # whose title is a path
    assert [name for name in names if name not in said] == []


def test_slices_without_pictures_are_listed_in_eighty_columns(run: Run, tmp_path: Path) -> None:
    made = run.ok("slice branin --resolution 4 --no-picture --out made/a-slice")
    assert "landscape.png" not in made.stderr
    assert sorted(file.name for file in (tmp_path / "made/a-slice").iterdir()) == ["slice.zarr.zip", "summary.json"]
    said = run("gallery list made", width=80).stdout
    assert "1 slice in made" in said
    assert all(word in said for word in ("a-slice", "branin", "x0, x1", "4 x 4"))
    assert max(map(len, said.splitlines())) <= 80
