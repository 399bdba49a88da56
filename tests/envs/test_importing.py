"""What is imported for a scene: files that simulators are taken from, and the extras that engines are of."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gradscape.envs import registry
from gradscape.envs.registry import entries, import_named, make


@pytest.mark.parametrize("call", ["sys.exit(3)", "sys.exit()", "sys.exit('no')"])
def test_a_file_that_leaves_while_it_is_imported_is_refused_with_a_sentence(tmp_path: Path, call: str) -> None:
    file = tmp_path / "own.py"
    file.write_text(f"import sys\nBowl = {call}\n")
    with pytest.raises(ValueError, match=rf"own\.py called {re.escape(call)} while it was imported; .*__name__"):
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
