"""`landscape optimize` and `landscape methods`: what they print, leave, refuse and survive."""

import json
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import xarray as xr
from torch import Tensor

from gradscape.envs.base import Environment
from gradscape.landscapes.objective import Evaluation
from gradscape.optim.runs.store import RunStore

from ..clock import Clock
from ..command import Said, modules
from ..processes import Instant, alone, landscape

QUICK = ["optimize", "branin", "--method", "cma-es", "--budget", "50"]


@pytest.mark.drawn
def test_optimize_leaves_run_picture_and_summary(run: Callable[..., Said], tmp_path: Path) -> None:
    done = run(*QUICK, "--option", "population=7", "--json", "--out", "run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary == {**json.loads((tmp_path / "run/summary.json").read_text()), "folder": "run"}
    assert (summary["env"], summary["method"], summary["seed"]) == ("branin", "cma-es", 0)
    assert summary["method_options"] == {"sigma": 0.5, "population": 7}
    assert summary["episodes"] == summary["status"]["ok"] == summary["kinds"]["population"] == 50
    table = RunStore.open(tmp_path / "run/run.zarr").dataset()
    row = summary["best"]["episode"] - 1
    assert summary["best"]["loss"] == float(table["loss"].min()) == float(table["loss"][row])
    assert summary["best"]["x"] == table["x"][row].values.tolist()
    assert (tmp_path / "run/progress.png").read_bytes().startswith(b"\x89PNG")
    assert "50 episodes to compute: one by one" in done.stderr
    assert f"best loss {summary['best']['loss']:.6g} at episode {row + 1}" in done.stderr


def test_a_method_with_gradients_says_what_they_cost(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, evaluate = Clock(), Environment.evaluate

    def slow(env: Environment, x: Tensor, *, grad: bool = True) -> Evaluation:
        clock.sleep(3.0 if grad else 1.0)
        return evaluate(env, x, grad=grad)

    for module in ("optim.lockstep", "landscapes.cost"):
        monkeypatch.setattr(f"gradscape.{module}.time", clock)
    monkeypatch.setattr(Environment, "evaluate", slow)
    command = ["optimize", "bounce", "--method", "descents", "--budget", "8", "--out", "run", "--json"]
    done = run(*command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["kinds"]["descent"] == 8
    assert (summary["gradient_cost"], summary["forwards"]) == (3.0, 24.0)
    assert "8 episodes to compute: one by one 8.0 s without gradients, 24 s with" in done.stderr


def test_same_command_computes_nothing_twice_a_larger_budget_goes_on_and_force_begins_anew(
    run: Callable[..., Said], tmp_path: Path
) -> None:
    first = json.loads(run(*QUICK, "--json", cwd=tmp_path).stdout)
    again = run(*QUICK, "--json", cwd=tmp_path)
    assert (json.loads(again.stdout)["episodes"], json.loads(again.stdout)["resumed"]) == (0, 50)
    assert "all 50 episodes are there already" in again.stderr
    more = json.loads(run(*QUICK, "--budget", "80", "--json", cwd=tmp_path).stdout)
    assert (more["folder"], more["budget"]) == (first["folder"], 80)
    assert more["episodes"] + more["resumed"] == 80
    anew = json.loads(run(*QUICK, "--force", "--json", cwd=tmp_path).stdout)
    assert (anew["episodes"], anew["resumed"], anew["best"]) == (50, 0, first["best"])


def test_another_run_is_not_overwritten(run: Callable[..., Said], tmp_path: Path) -> None:
    run(*QUICK, "--out", "run", cwd=tmp_path)
    before = (tmp_path / "run/summary.json").read_bytes()
    for change, said in (
        (["--seed", "1"], "seed: wanted 1, found 0"),
        (["--method", "random"], "method: wanted 'random', found 'cma-es'"),
        (["--option", "sigma=0.1"], "method_options.sigma: wanted 0.1, found 0.5"),
    ):
        other = run(*QUICK, *change, "--out", "run", cwd=tmp_path)
        assert other.returncode == 2
        assert said in other.stderr
    assert (tmp_path / "run/summary.json").read_bytes() == before


def test_every_different_run_has_a_folder_of_its_own(run: Callable[..., Said], tmp_path: Path) -> None:
    for change in ([], ["--seed", "1"], ["--method", "random"], ["--option", "sigma=0.1"]):
        assert run(*QUICK, *change, cwd=tmp_path).returncode == 0
    folders = sorted(path.name.rsplit("-", 1)[0] for path in (tmp_path / "out").iterdir())
    assert folders == ["branin-cma-es-exact-s0"] * 2 + ["branin-cma-es-exact-s1", "branin-random-exact-s0"]


def test_methods_lists_them_all_and_shows_one_in_full(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    listed = run("methods", cwd=tmp_path).stdout
    for name in ("random", "cma-es", "descents", "bo", "bo-descents", "bo-leap", "ppo", "sac", "extra rl"):
        assert f" {name} " in listed
    shown = run("methods", "cma-es", cwd=tmp_path).stdout
    for said in ("restarted when it has converged", "gradients: no", "sigma=a number (default 0.5)", "BoundTransform"):
        assert said in shown


@pytest.mark.parametrize("arguments", [["optimize", "--help"], ["methods"]])
def test_help_and_list_import_nothing_heavy(arguments: list[str]) -> None:
    heavy = {"torch", "warp", "numpy", "matplotlib", "xarray", "zarr", "botorch", "cma", "stable_baselines3"}
    assert not heavy & modules(arguments)


BUDGET = 70
LONG = ["optimize", "rastrigin", "--set", "dim=5", "--method", "cma-es", "--budget", str(BUDGET)]
LONG += ["--json", "--out", "run"]
search = partial(landscape, *LONG)


@pytest.mark.e2e
def test_sigkill_at_several_moments_changes_no_bit(run: Callable[..., Said], tmp_path: Path) -> None:
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    assert run(*LONG, cwd=tmp_path / "whole").returncode == 0
    for instant in (Instant(1), Instant(1, "loss/c"), Instant(4, ".state"), Instant(5, "loss/c")):
        assert alone(search, tmp_path / "killed", instant).returncode == -signal.SIGKILL
    kept = RunStore.open(tmp_path / "killed/run/run.zarr").count
    resumed = json.loads(run(*LONG, cwd=tmp_path / "killed").stdout)
    assert 0 < resumed["resumed"] == kept < BUDGET
    assert resumed["episodes"] + resumed["resumed"] == BUDGET
    one, two = (RunStore.open(tmp_path / name / "run/run.zarr").dataset() for name in ("whole", "killed"))
    xr.testing.assert_equal(one.drop_vars("seconds"), two.drop_vars("seconds"))


def test_interrupt_ends_cleanly_and_says_how_to_go_on(tmp_path: Path) -> None:
    done = alone(search, tmp_path, Instant(9, "status/c", signal.SIGINT))
    assert done.returncode == 130
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    kept = RunStore.open(tmp_path / "run/run.zarr").count
    assert f"stopped: {kept} of {BUDGET} episodes are kept in run" in done.stderr
    assert "the same command continues from there: landscape optimize rastrigin" in done.stderr
    assert 0 < kept < BUDGET
    assert (tmp_path / "run/progress.png").exists()
