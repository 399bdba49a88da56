"""What is imported for a scene: files that simulators are taken from, and the extras that engines are of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gradscape.envs import registry
from gradscape.envs.registry import entries, import_named, make, refuse_unknown

SPELLED = {  # files that hold a Bowl, or may
    "assigned": "Bowl = 1\n",
    "a class": "class Bowl:\n    pass\n",
    "imported": "from beside import Bowl\n",
    "imported with all else": "from beside import *\n",
    "bound by name": "globals()['Bo' + 'wl'] = 1\n",
    "in a branch": "if True:\n    Bowl = 1\n",
    "global": "def make():\n    global Bowl\n    Bowl = 1\nmake()\n",
    "no Python": "Bowls = (\n",
}


@pytest.mark.parametrize("how", SPELLED)
def test_a_file_that_may_hold_a_name_is_left_to_whoever_imports_it(tmp_path: Path, how: str) -> None:
    file = tmp_path / "own.py"
    file.write_text(SPELLED[how])
    refuse_unknown(f"{file}:Bowl")


def test_a_name_that_a_file_cannot_hold_is_refused_without_running_it(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "class Bowls:\n    Inner = 1\n\ndef drop():\n    pass\n\nlow, _high = steep = 1, 2\nraise SystemExit\n"
    )
    with pytest.raises(ValueError, match=r"own\.py holds no Bowl; it has Bowls, drop, low, steep$"):
        refuse_unknown(f"{file}:Bowl")


def test_a_name_is_looked_for_in_the_files_own_encoding(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_bytes("# coding: latin-1\nMühle = 1\n".encode("latin-1"))
    refuse_unknown(f"{file}:Mühle")


@pytest.mark.parametrize(
    ("call", "said"),
    [("sys.exit(3)", r"sys\.exit\(3\)"), ("sys.exit()", r"sys\.exit\(\)"), ("sys.exit('no')", r"sys\.exit\('no'\)")],
)
def test_a_file_that_leaves_while_it_is_imported_is_refused_with_a_sentence(
    tmp_path: Path, call: str, said: str
) -> None:
    file = tmp_path / "own.py"
    file.write_text(f"import sys\nBowl = {call}\n")
    with pytest.raises(ValueError, match=rf"own\.py called {said} while it was imported; .*__name__"):
        make(f"{file}:Bowl")


def test_a_file_that_is_stopped_while_it_is_imported_stops_the_program(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text("raise KeyboardInterrupt\n")
    with pytest.raises(KeyboardInterrupt):
        import_named(str(file))


@pytest.mark.parametrize(
    ("extra", "package", "module", "scene"),
    [("mjx", "mujoco-mjx", "mujoco", "mjx-push"), ("newton", "newton", "newton", "newton-ball")],
)
def test_without_an_extra_its_scenes_are_listed_and_naming_one_says_what_installs_it(
    run: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    extra: str,
    package: str,
    module: str,
    scene: str,
) -> None:
    monkeypatch.setattr(registry, "is_installed", lambda name: name != package)
    said = run("envs", cwd=tmp_path).stdout
    names = ", ".join(entry.name for entry in entries().values() if entry.extra == extra)
    assert f"not installed: {names}; pip install 'gradscape[{extra}]'\n" in said

    def missing(name: str, package: str) -> None:
        raise ImportError(f"No module named '{module}'")

    monkeypatch.setattr("gradscape.envs.base.import_module", missing)
    done = run("slice", scene, "--dims", "0", "1", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip().endswith(f"No module named '{module}'; pip install 'gradscape[{extra}]'")
    assert not list(tmp_path.iterdir())
