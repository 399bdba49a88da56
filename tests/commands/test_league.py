"""`landscape league` and `gs.league`: what they leave, say and refuse."""

import json
from pathlib import Path

import pytest
import torch

import gradscape as gs

from ..command import Run

LEAGUE = ["league", "branin", "bounce@draft", "--methods", "random,cma-es", "--budget", "6", "--seeds", "2"]


def test_it_prints_ranks_and_the_papers_claims(run: Run) -> None:
    done = run.ok("league branin --methods random --budget 6 --seeds 1 --claims")
    for shown in ("mean ranks", "branin (exact)", "all scenes", "branin: lowest loss", "compares no optimisers"):
        assert shown in done.stdout


def test_the_best_point_of_a_league_is_known_to_slices(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gradscape.jobs.scene.best_of_league", lambda env: None)  # the gallery keeps a better one
    short = ["--methods", "random", "--budget", "6", "--seeds", "1", "--device", "cpu", "--json"]
    league = run("league", "bounce@draft", *short)
    best = league.json["scenes"][0]["best"]
    cut = ["--resolution", "2", "--through", "best", "--fidelity", "draft", "--device", "cpu", "--out", "s"]
    run.ok("slice", "bounce", "--dims", "0", "1", *cut)
    plane = json.loads(gs.open_slice(tmp_path / "s").data.attrs["identity"])["plane"]
    assert plane["origin"][2] == best["x"][2]
    found = gs.make("bounce", fidelity="draft", device="cpu").evaluate(
        torch.tensor([best["x"]], dtype=torch.float64), grad=False
    )
    assert float(found.loss) == best["loss"]


def test_a_scene_that_cannot_be_raced_ends_with_exit_code_1(run: Run, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "from gradscape.envs.functions import Branin\n\n\n"
        "class Own(Branin):\n    name = 'own'\n\n"
        "    def _evaluate(self, x, *, grad):\n        raise RuntimeError('fire')\n"
    )
    done = run("league", "own.py:Own", *LEAGUE[1:2], *LEAGUE[3:])
    assert done.returncode == 1
    assert "RuntimeError: fire; the first was" in done.stderr
    assert "1 of 2 scenes were left out: own@exact" in done.stderr
    assert "all scenes" in done.stdout
