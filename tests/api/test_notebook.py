"""The notebook of the README, on a quick scene: every cell runs, top to bottom, and what it ends with is shown."""

from __future__ import annotations

from typing import Any

import pytest

from gradscape.landscapes import cost
from gradscape.studies import samples

CELLS = (
    "import gradscape as gs",
    's = gs.slice("bounce", (0, 1), resolution=8, out="throw")\ns',
    "s.plot()",
    "s.data.loss",
    "s.report(points=2).words",
    'run = gs.optimize("bounce", "bo-leap", budget=12, seed=0)\nrun',
    "s.plot(runs=[run])",
    "run.best.x",
    "run.table()",
    "run.plot()",
    'gs.race("bounce", ["random", "bo-leap"], budget=12, seeds=2).plot()',
    'env = gs.make("bounce")\nenv.episode(run.best.x).show()',
    'gs.check(env, power="20%")',
    'gs.study("fidelity", env, points=4, settings=["dt"])',
    "gs.list_envs()",
    "gs.open_slice(s.folder)",
    "gs.open_run(run.folder)",
)
PICTURES = {2, 6, 9, 10, 11}  # the cells that show one
TABLES = {8, 12, 13, 14}  # those that show a table


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """Run the cells in a folder of their own; return the value that each ends with."""
    folder = tmp_path_factory.mktemp("notebook")
    space: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_DATA_HOME", str(folder / "data"))
        for module, names in ((cost, ("MOMENT", "ENOUGH", "WARM_UP")), (samples, ("REPETITION", "LARGEST"))):
            for name in names:
                patch.setattr(module, name, 0.0)
        return [_run(cell, space) for cell in CELLS]


def _run(cell: str, space: dict[str, Any]) -> Any:
    """Run a cell and return the value of its last line, where that is an expression."""
    *lines, last = cell.splitlines()
    exec("\n".join(lines), space)
    if "=" in last.split("(")[0] or last.startswith("import"):
        exec(last, space)
        return None
    return eval(last, space)


@pytest.mark.drawn
def test_every_picture_is_shown_as_one(shown: list[Any]) -> None:
    for number in PICTURES:
        assert shown[number]._repr_png_().startswith(b"\x89PNG"), CELLS[number]


def test_every_table_is_shown_as_one(shown: list[Any]) -> None:
    for number in TABLES:
        assert "<table" in shown[number]._repr_html_(), CELLS[number]


def test_results_say_what_they_are(shown: list[Any]) -> None:
    assert repr(shown[1]).startswith("<Slice of bounce · draft over velocity x")
    assert shown[3].shape == (8, 8)
    assert all(isinstance(word, str) for word in shown[4])
    assert "bo-leap" in repr(shown[5])
    assert shown[7].shape == (3,)
    assert len(shown[8]) == 12
    assert repr(shown[15]) == repr(shown[1])
    assert repr(shown[16]).startswith(repr(shown[5]).rpartition(", in ")[0])
