"""Reading a result runs nothing that the result names."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import gradscape as gs
from gradscape.landscapes.storage.store import open_slice

PLANTED = """
from pathlib import Path

Path(__file__).with_suffix(".ran").touch()
"""


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a slice whose attributes name a class in a file that lies beside it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.py").write_text(PLANTED)
    space = gs.ParameterSpace({"x": (-1, 1), "y": (-1, 1)})
    gs.slice(gs.from_torch(lambda x: (x**2).sum(1), space, name="evil.py:Evil"), resolution=6, out="slice")
    gs.optimize(gs.from_torch(lambda x: (x**2).sum(1), space, name="evil.py:Evil"), "random", budget=4, out="run")
    return tmp_path


@pytest.mark.parametrize(
    "read",
    [
        lambda: gs.report("slice"),
        lambda: gs.open_slice("slice").report(),
        lambda: gs.overlay("slice", "run", through="best"),
    ],
)
def test_no_file_that_a_result_names_is_run(read: Callable[[], object], planted: Path) -> None:
    assert json.loads(open_slice(Path("slice")).attrs["identity"])["objective"] == "evil.py:Evil"
    with pytest.raises(ValueError, match="is not registered here, and it is needed to evaluate more points"):
        read()
    assert not (planted / "evil.ran").exists()


def test_what_needs_no_new_evaluation_works(planted: Path) -> None:
    s = gs.open_slice("slice")
    assert s.plot() is not None
    assert len(gs.overlay("slice", "run").runs) == 1
    Path("points.csv").write_text("x,y,loss\n0.5,-0.5,0.5\n")
    assert len(gs.overlay("slice", "points.csv").runs) == 1
    assert torch.tensor(s.data.loss.to_numpy()).isfinite().all()


def test_a_simulator_that_is_given_is_the_one_that_is_asked(planted: Path) -> None:
    space = gs.ParameterSpace({"x": (-1, 1), "y": (-1, 1)})
    f = gs.from_torch(lambda x: (x**2).sum(1), space, name="another name")
    assert gs.report("slice", env=f, points_per_axis=2).words
    assert gs.open_slice("slice", env=f).report(points=2).verdict.words
    with pytest.raises(ValueError, match="whose losses have changed"):
        gs.open_slice("slice", env=gs.from_torch(lambda x: (x**4).sum(1), space)).report(points=2)
