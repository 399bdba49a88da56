"""`landscape envs` and `landscape info`: what they print."""

from pathlib import Path

import pytest

import gradscape

from ..command import Run

SHOWN = {
    "envs": ("bounce", "initial velocity x, y, z [m/s]", "fluid", "draft, standard, reference", "branin"),
    "envs fluid": ("ladle x speed, segment 1", "goal=high|printed", "scoop", "reference", "m/s", "y - 0.2"),
    "info": (f"gradscape {gradscape.__version__}", "torch", "warp-lang", "cores for this process", "cuda"),
}


@pytest.mark.parametrize("words", SHOWN)
def test_what_there_is_is_shown_and_nothing_is_written(run: Run, tmp_path: Path, words: str) -> None:
    said = run.ok(*words.split(), width=200).stdout
    assert [shown for shown in SHOWN[words] if shown not in said] == []
    assert not list(tmp_path.iterdir())
