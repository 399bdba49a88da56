"""`landscape optimize` and `landscape methods`: what they print, leave, refuse and survive."""

import json
import re
from pathlib import Path

import pytest
from torch import Tensor

from gradscape.envs.base import Environment
from gradscape.landscapes.objective import Evaluation
from gradscape.optim.runs.store import RunStore

from ..clock import Clock
from ..command import Run

QUICK = ["optimize", "branin", "--method", "cma-es", "--budget", "50"]


@pytest.mark.drawn
def test_optimize_leaves_run_picture_and_summary(run: Run, tmp_path: Path) -> None:
    done = run.ok(*QUICK, "--option", "population=7", "--json", "--out", "run")
    summary = done.json
    assert summary == {**json.loads((tmp_path / "run/summary.json").read_text()), "folder": "run"}
    assert (summary["env"], summary["method"], summary["seed"]) == ("branin", "cma-es", 0)
    assert summary["method_options"] == {"sigma": 0.5, "population": 7}
    assert summary["episodes"] == summary["status"]["ok"] == summary["kinds"]["population"] == 50
    table = RunStore.open(tmp_path / "run/run.zarr").dataset()
    row = summary["best"]["episode"] - 1
    assert summary["best"]["loss"] == float(table["loss"].min()) == float(table["loss"][row])
    assert summary["best"]["x"] == table["x"][row].values.tolist()
    assert (tmp_path / "run/progress.png").read_bytes().startswith(b"\x89PNG")
    assert re.search(r"50 episodes to compute: [\d.]+ s, one by one, plus the time of the method", done.stderr)
    assert f"best loss {summary['best']['loss']:.6g} at episode {row + 1}" in done.stderr


def test_a_method_with_gradients_says_what_they_cost(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, evaluate = Clock(), Environment.evaluate

    def slow(env: Environment, x: Tensor, *, grad: bool = True) -> Evaluation:
        clock.sleep(3.0 if grad else 1.0)
        return evaluate(env, x, grad=grad)

    for module in ("optim.lockstep", "landscapes.cost"):
        monkeypatch.setattr(f"gradscape.{module}.time", clock)
    monkeypatch.setattr(Environment, "evaluate", slow)
    command = ["optimize", "bounce", "--method", "descents", "--budget", "8", "--out", "run", "--json"]
    done = run.ok(*command)
    summary = done.json
    assert summary["kinds"]["descent"] == 8
    assert (summary["gradient_cost"], summary["forwards"]) == (3.0, 24.0)
    assert "8 episodes to compute: 8.0 s without gradients, 24 s with, one by one" in done.stderr


def test_methods_lists_them_all_and_shows_one_in_full(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    listed = run("methods").stdout
    for name in ("random", "cma-es", "descents", "bo", "bo-descents", "bo-leap", "ppo", "sac", "extra rl"):
        assert f" {name} " in listed
    shown = run("methods cma-es").stdout
    for said in ("restarted after convergence", "gradients: no", "sigma=a number (default 0.5)", "BoundTransform"):
        assert said in shown
