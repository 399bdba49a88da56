"""The study of replicas: how far each is from the scene itself, on a scene whose ripple is known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import gradscape as gs
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.storage.records import read_json
from gradscape.studies.symmetry import SymmetryRecord

from ..command import Run

FILE = """
import gradscape as gs

def tilt(x):
    return x[:, 0] + 0.1 * x[:, 1]

space = gs.ParameterSpace({"x": (0, 1), "y": (0, 1)})
others = {"half as steep": lambda x: 0.5 * tilt(x), "lifted": lambda x: tilt(x) + 1}
tilted = gs.from_torch(tilt, space, replicas=others)
"""


class Rippled(Objective):
    """A ramp along x of the same width whose grid adds a ripple of 0.01; beyond x = 0.9 one of its grids fails."""

    space = gs.ParameterSpace({"x": (0.0, 1.0), "y": (0.0, 1.0)})
    asked = 0

    def __init__(self, shift: float = 0.0) -> None:
        self.shift = shift

    def replicas(self) -> dict[str, Objective]:
        return {"grid moved by a third": Rippled(1 / 3), "grid moved by two thirds": Rippled(2 / 3)}

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        type(self).asked += len(x)
        phase = 2 * np.pi * (20 * x[:, 0] + self.shift)
        loss = x[:, 0] + 0.01 * phase.sin()
        if self.shift > 0.5:
            loss = torch.where(x[:, 0] > 0.9, torch.nan, loss)
        slope = torch.stack([1 + 0.4 * np.pi * phase.cos(), torch.zeros_like(phase)], dim=1)
        return Evaluation.from_results(loss, slope if grad else None)


def test_a_ripple_of_the_grid_is_the_floor_and_what_is_measured_stays(tmp_path: Path) -> None:
    """Sines a third apart have squares that sum to 3/2 a^2 wherever they are, and two degrees of freedom."""
    found = gs.study("symmetry", Rippled(), points=64, out=tmp_path / "study")
    assert isinstance(found, SymmetryRecord)
    assert found.floor.deviation == pytest.approx(0.01 * 3**0.5 / 2, rel=1e-6)
    assert found.floor.failed == 7
    assert [one.failed for one in found.replicas] == [0, 7]
    for one in found.replicas:  # two phases: (a - b) / sqrt 2, of which the mean square is a^2 (1 - cos 120°) / 2
        assert one.apart.value == pytest.approx(0.01 * 0.75**0.5 / found.floor.range, rel=0.1)
        assert one.spearman.value is not None
        assert 0.98 < one.spearman.value < 1
        assert one.cosine_low <= one.cosine.value
    first = "numerical floor 0.87 % of the range; gradients of replicas: cosine 1.000 (95 % intervals "
    assert found.sentences()[0].startswith(first)
    assert found.sentences()[-1] == "7 of 64 points left out, because the scene or a replica fails there"
    assert list(found.table().index) == [one.name for one in found.replicas]
    assert to_json(from_json(SymmetryRecord, read_json(tmp_path / "study/symmetry.json"))) == to_json(found)
    before = Rippled.asked
    again = gs.study("symmetry", Rippled(), points=64, out=tmp_path / "study")
    assert to_json(again.floor) == to_json(found.floor)  # type: ignore[attr-defined]
    assert Rippled.asked - before < 64  # no more than what a stored result is checked by


@pytest.mark.drawn
def test_the_command_prints_each_replica_and_draws_them(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(FILE)
    done = run.ok("study", "symmetry", "mine.py:tilted", "--points", "8", "--out", "found", "--json")
    assert done.json["replicas"][1]["cosine"]["value"] == pytest.approx(1)
    assert done.json["replicas"][1]["spearman"]["value"] == pytest.approx(1)
    assert (tmp_path / "found/symmetry.png").read_bytes().startswith(b"\x89PNG")
    for said in ("half as steep", "numerical floor", "largest difference from the scene itself: lifted"):
        assert said in done.stderr
    refused = run("study", "symmetry", "branin")
    assert "branin has no replicas, which compute the same physics differently" in " ".join(refused.stderr.split())
    assert "a function takes replicas={'other grid': fn}" in " ".join(refused.stderr.split())
