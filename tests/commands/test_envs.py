"""`landscape envs` and `landscape info`: what they print."""

from collections.abc import Callable
from pathlib import Path

import pytest

import gradscape

from ..command import Said


def test_envs_lists_every_environment_with_units(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    said = run("envs", cwd=tmp_path).stdout
    for shown in ("bounce", "initial velocity x, y, z [m/s]", "fluid", "draft, standard, reference", "branin"):
        assert shown in said


def test_envs_shows_one_in_full(run: Callable[..., Said], tmp_path: Path) -> None:
    said = run("envs", "fluid", cwd=tmp_path).stdout
    for shown in ("ladle x speed, segment 1", "goal=high|printed", "scoop", "reference", "m/s", "y - 0.2"):
        assert shown in said


def test_info_names_the_version_the_libraries_and_the_devices(run: Callable[..., Said], tmp_path: Path) -> None:
    said = run("info", cwd=tmp_path).stdout
    for shown in (f"gradscape {gradscape.__version__}", "torch", "warp-lang", "cores for this process", "cuda"):
        assert shown in said
    assert not list(tmp_path.iterdir())
