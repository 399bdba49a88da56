"""What a verb says last: the command to go on with."""

import re
from types import SimpleNamespace

import pytest

from gradscape.commands.next import next_command

from ..command import Run


def test_the_next_command_of_a_slice_runs(run: Run, tmp_path: object) -> None:
    done = run.ok("slice branin --resolution 6 --out cut")
    found = re.search(r"next: landscape (.*)\n$", done.stderr)
    assert found
    assert found[1] == "report cut --html"
    run.ok(f"{found[1]} --points-per-axis 2 --out told")
    assert "next:" not in run.ok("slice branin --resolution 6 --out cut --json").stderr


@pytest.mark.parametrize(
    ("kind", "result", "given", "wanted"),
    [
        ("CheckReport", SimpleNamespace(passed=False), ("branin",), ""),
        ("CheckReport", SimpleNamespace(passed=True), ("my file.py:f",), "landscape slice 'my file.py:f'"),
        ("Report", SimpleNamespace(words=("gradients follow",)), ("fluid",), "landscape race fluid"),
        ("Report", SimpleNamespace(words=("gradients zero",)), ("fluid",), "landscape remedy fluid"),
        ("Report", SimpleNamespace(words=()), (".",), ""),
        ("Race", None, (lambda x: x,), ""),
        ("Plan", None, ("fluid",), ""),
    ],
)
def test_what_comes_next_depends_on_what_came_out(kind: str, result: object, given: tuple[object], wanted: str) -> None:
    assert next_command(kind, result, given, None) == wanted
