"""The verb `plan`: what it predicts against what jobs then take."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

import pytest

import gradscape
from gradscape.landscapes.rehearsal import Alike
from gradscape.landscapes.store import SliceStore

from .command import Said

JOBS = {
    "bounce": ["bounce", "--dims", "0", "1", "--resolution", "64", "--fidelity", "standard"],
    "flip": ["flip", "--dims", "0", "1", "--resolution", "14", "--fidelity", "draft"],
    "sweep": ["bounce", "--dims", "0", "1", "--over", "2", "--frames", "6", "--resolution", "16"],
}
TRIES = 6


def plan(run: Callable[..., Said], cwd: Path, *arguments: str) -> dict[str, Any]:
    done = run("plan", *arguments, "--json", cwd=cwd)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def size(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


@pytest.mark.parametrize("name", JOBS)
def test_a_job_takes_what_was_planned_within_a_quarter(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Seconds are those of all cores that the process has used: what else the machine does falls on those of the clock.

    Medians of a few tries count, since caches are shared, too; all but `start`, which in this process is over.
    """
    verb = "sweep" if name == "sweep" else "slice"
    small = [*JOBS[name], "--resolution", "2"] + (["--frames", "2"] if verb == "sweep" else [])
    assert run(verb, *small, "--out", "loads", cwd=tmp_path).returncode == 0
    for clock in ("perf_counter", "monotonic"):
        monkeypatch.setattr(time, clock, time.process_time)
    expected, took = [], []
    for number in range(TRIES):
        planned = plan(run, tmp_path, *JOBS[name])
        done = json.loads(run(verb, *JOBS[name], "--out", str(number), "--json", cwd=tmp_path).stdout)
        assert planned["episodes"] == done["episodes"]
        expected.append(sum(planned["seconds"][part] for part in ("simulating", "writing", "drawing")))
        took.append(done["seconds"])
        if (off := abs(median(expected) / median(took) - 1)) < 0.25:
            break
    assert off < 0.25, (expected, took)
    there = tmp_path / str(number)
    assert planned["disk"]["bytes"] == pytest.approx(size(there), rel=0.25)
    assert planned["disk"]["files"] == pytest.approx(len(list(there.rglob("*"))), rel=0.02)


def test_a_job_needs_the_memory_that_was_planned_within_a_quarter(tmp_path: Path) -> None:
    # a third of what it holds is gradients of 400 components
    job = ["cartpole", "--dims", "0", "1", "--resolution", "128", "--json"]
    planned, _ = alone("plan", *job, cwd=tmp_path)
    _, peak = alone("slice", *job, cwd=tmp_path)
    assert planned["memory"]["host"] == pytest.approx(peak, rel=0.25)


def alone(*arguments: str, cwd: Path) -> tuple[dict[str, Any], int]:
    """Run the command in a process of its own; return what it printed and the most memory it held [bytes]."""
    said = cwd / "said.json"
    with (
        said.open("w") as out,
        subprocess.Popen([sys.executable, "-m", "gradscape", *arguments], stdout=out, cwd=cwd) as process,
    ):
        _, code, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(code)
    assert process.returncode == 0
    return json.loads(said.read_text()), used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def test_a_plan_leaves_nothing_behind_and_workers_share_what_can_be_shared(
    run: Callable[..., Said], tmp_path: Path
) -> None:
    one, four = (plan(run, tmp_path, *JOBS["bounce"], "--workers", count) for count in ("1", "4"))
    assert not list(tmp_path.iterdir())
    assert one["rate"] == "measured here, now"
    assert one["device_hours"] == one["seconds"]["simulating"] / 3600
    for planned, share in ((one, 1.0), (four, 2 / 8)):  # 4096 points in 8 batches
        seconds = planned["seconds"]
        shared = share * (seconds["simulating"] + seconds["writing"])
        assert planned["wall"] == pytest.approx(seconds["start"] + shared + seconds["drawing"])


def test_figures_are_planned_by_kind_and_added_up(run: Callable[..., Said], tmp_path: Path) -> None:
    figure = '[[figure]]\nid = "{}"\nenv = "bounce"\ndims = [{}]\nthrough = "example:aim"\nsays = ""\n'
    (tmp_path / "f.toml").write_text(figure.format("x", 0) + figure.format("y", 1) + figure.format("xy", "0, 1"))
    found = plan(run, tmp_path, "f.toml", "--resolution", "16", "--fidelity", "draft")
    assert [(one["figure"], one["episodes"]) for one in found["figures"]] == [("x", 16), ("y", 16), ("xy", 256)]
    x, y, _ = found["figures"]
    assert (x["seconds"]["simulating"], y["seconds"]["start"]) == (y["seconds"]["simulating"], 0.0)
    assert found["total"]["episodes"] == 288
    assert found["total"]["wall"] == pytest.approx(sum(one["wall"] for one in found["figures"]))
    assert {one.name for one in tmp_path.iterdir()} == {"f.toml"}


def test_a_device_that_is_not_here_has_the_rate_that_tradeoff_kept(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("gradscape.envs.engines.runtime.cuda_available", lambda: False)
    command = ["plan", "flip", "--resolution", "4", "--device", "cuda", "--fidelity", "draft", "--set", "horizon=0.5"]
    refused = run(*command, cwd=tmp_path)
    assert refused.returncode == 2
    assert "`landscape tradeoff flip --device cuda` measures it" in refused.stderr
    env = gradscape.make("flip", fidelity="draft", device="cpu", horizon=0.5)
    rung = {"name": "draft", "engine": "warp", "device": "cuda", "options": asdict(env.options), "batch": 8}
    rung |= {"fidelity": asdict(env.fidelity), "seconds": {"forward": 1.0, "with_gradient": 2.5}, "memory": 10}
    report = {"env": "flip", "identity": {"options": asdict(env.options), "device": "cuda"}, "rungs": [rung]}
    from gradscape.tolerance import keep

    path = keep(report)
    found = json.loads(run(*command, "--json", cwd=tmp_path).stdout)
    assert found["device"] == "cuda"
    assert (found["seconds"]["simulating"], found["batches"]) == (16 * 2.5, 2)
    assert str(path) in found["rate"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["bonce"], "did you mean bounce?"),
        (["none.toml"], "no list of figures at none.toml"),
        (["figures.toml", "--over", "2"], "leave out --over"),
        (["bounce", "--over", "horizon", "--set", "horizon=0.5"], "leave out --set horizon"),
        (["bounce", "--dims", "0", "9"], "numbered 0 to 2; got 9"),
        (["bounce", "--workers", "0"], "--workers"),
    ],
)
def test_bad_input_gets_one_line(run: Callable[..., Said], tmp_path: Path, arguments: list[str], said: str) -> None:
    done = run("plan", *arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_what_is_alike_keeps_failures_and_precision(tmp_path: Path) -> None:
    env = gradscape.make("flip", fidelity="draft", device="cpu")
    plane = gradscape.Plane.through(env.space, env.space.center, ("0", "1"), resolution=8)
    store = SliceStore.create(tmp_path / "s.zarr", plane, env.space, identity={})
    alike = Alike(env, store, rows=2)
    said = alike.evaluate(env.space.center.expand(5, -1))
    true_at = store.points(store.tiles()[0])[:2]
    true = env.evaluate(true_at)
    nearest = [int((plane.project(true_at) - plane.project(env.space.center[None])).norm(dim=1).argmin())] * 5
    assert said.loss.tolist() == pytest.approx(true.loss[nearest].tolist(), rel=2e-3)
    assert len(set(said.loss.tolist())) == 5
    exact = bool((true.loss.float().double() == true.loss).all())
    assert bool((said.loss.float().double() == said.loss).all()) == exact
    assert said.status.tolist() == true.status[nearest].tolist()
