"""`landscape envs` and `landscape info`: what they print."""

from pathlib import Path

import pytest

import gradscape

from ..command import Run


def test_envs_lists_every_environment_with_units(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    said = run("envs").stdout
    for shown in ("bounce", "initial velocity x, y, z [m/s]", "fluid", "draft, standard, reference", "branin"):
        assert shown in said


def test_envs_shows_one_in_full(run: Run) -> None:
    said = run("envs fluid").stdout
    for shown in ("ladle x speed, segment 1", "goal=high|printed", "scoop", "reference", "m/s", "y - 0.2"):
        assert shown in said


def test_info_names_the_version_the_libraries_and_the_devices(run: Run, tmp_path: Path) -> None:
    said = run("info").stdout
    for shown in (f"gradscape {gradscape.__version__}", "torch", "warp-lang", "cores for this process", "cuda"):
        assert shown in said
    assert not list(tmp_path.iterdir())
