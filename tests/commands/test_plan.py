"""The verb `plan`: its parts add up to what a job takes, on a clock by which everything has its price."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
import xarray as xr

import gradscape
from gradscape.envs.base import Environment
from gradscape.jobs.rehearsal import Replica, count_pictures, room_of, time_drawing
from gradscape.jobs.slice import SOON, pause_after
from gradscape.jobs.tolerance import keep
from gradscape.landscapes.draw.figures import page, sweep
from gradscape.landscapes.measures.fidelity import Bootstrap, Comparison, GradientError, LossError, Seconds
from gradscape.landscapes.measures.tradeoff import MeasuredVariant, Tradeoff
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.storage.arrays import need_of
from gradscape.landscapes.storage.store import SliceStore

from ..clock import Clock
from ..command import Said

JOBS = {
    "bounce": ["bounce", "--dims", "0", "1", "--resolution", "32", "--fidelity", "draft"],
    "flip": ["flip", "--dims", "0", "1", "--resolution", "14", "--fidelity", "draft"],
    "along": ["bounce", "--along", "random:1", "--extent", "0.2", "--resolution", "32", "--fidelity", "draft"],
    "sweep": ["bounce", "--dims", "0", "1", "--over", "2", "--frames", "4", "--resolution", "16"],
    "sweep of few gradients": [
        *("bounce", "--dims", "0", "1", "--over", "2", "--frames", "3", "--resolution", "16", "--gradients", "3"),
    ],
}
EPISODE, TILE, PICTURE = 0.05, 0.035, 0.5  # seconds that it takes to simulate, write and draw one


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Let what jobs are made of take its time on a clock of its own."""
    clock = Clock()
    for module in ("jobs.slice", "jobs.rehearsal", "jobs.plan", "jobs.sweep", "commands.plan", "landscapes.cost"):
        monkeypatch.setattr(f"gradscape.{module}.time", clock)

    def slow(owner: Any, name: str, price: Callable[..., float]) -> None:
        plain = getattr(owner, name)

        def slowed(*given: Any, **named: Any) -> Any:
            clock.sleep(price(*given))
            return plain(*given, **named)

        monkeypatch.setattr(owner, name, slowed)

    monkeypatch.setattr(page, "save", lambda figure, path: path.write_bytes(bytes(60_000)))
    slow(Environment, "evaluate", lambda env, x: EPISODE * len(x))
    slow(SliceStore, "write", lambda *_: TILE)
    slow(page, "save", lambda *_: PICTURE)
    slow(sweep, "frame_figure", lambda *_: PICTURE)
    return clock


def plan(run: Callable[..., Said], cwd: Path, *arguments: str) -> dict[str, Any]:
    done = run("plan", *arguments, "--json", cwd=cwd)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("name", JOBS)
def test_the_parts_of_a_plan_add_up_to_what_the_job_takes(
    run: Callable[..., Said], tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    planned, verb = plan(run, tmp_path, *JOBS[name]), "sweep" if name.startswith("sweep") else "slice"
    finish, tiles, before = SliceStore.finish, [], clock.slept.count(TILE)

    def finished(store: SliceStore, dataset: xr.Dataset) -> None:
        assert store.place is not None
        tiles.append(room_of(store.place))
        finish(store, dataset)

    monkeypatch.setattr(SliceStore, "finish", finished)
    done = json.loads(run(verb, *JOBS[name], "--out", "made", "--json", cwd=tmp_path).stdout)
    room = room_of(tmp_path / "made")
    seconds, guess = planned["seconds"], 1e-3 if verb == "sweep" else PICTURE  # when a picture is due
    assert planned["episodes"] == done["episodes"]
    assert seconds["simulating"] == pytest.approx(EPISODE * done["episodes"])
    assert seconds["writing"] == pytest.approx(TILE * (clock.slept.count(TILE) - before))
    between = EPISODE * done["unresolved"]["episodes"] if verb == "slice" else 0.0
    parts = seconds["simulating"] + seconds["writing"] + seconds["drawing"]
    assert parts + between == pytest.approx(done["seconds"], abs=guess)
    assert between <= seconds["between"] <= seconds["simulating"] / 5
    assert planned["disk"]["bytes"] == pytest.approx(room.bytes, rel=0.25)
    assert planned["disk"]["files"] == room.files - 1  # all that is in the folder
    filling = planned["disk"]["filling"]
    assert filling["bytes"] == pytest.approx(max(one.bytes for one in tiles), rel=0.25)
    assert filling["files"] == pytest.approx(max(one.files for one in tiles), rel=0.02)


def test_few_gradients_are_planned_at_their_own_rate(
    run: Callable[..., Said], tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate = Environment.evaluate

    def slower(env: Environment, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        clock.sleep(2 * EPISODE * len(x) * grad)
        return evaluate(env, x, grad=grad)

    monkeypatch.setattr(Environment, "evaluate", slower)
    job = ["cartpole", "--dims", "0", "1", "--resolution", "32", "--gradients", "5", "--fidelity", "draft"]
    planned = plan(run, tmp_path, *job)
    done = json.loads(run("slice", *job, "--out", "made", "--json", cwd=tmp_path).stdout)
    seconds, between = planned["seconds"], EPISODE * done["unresolved"]["episodes"]
    assert (planned["episodes"], planned["gradients"]) == (32 * 32, 7 * 7)
    assert seconds["simulating"] == pytest.approx(EPISODE * (32 * 32 + 2 * 7 * 7))
    parts = seconds["simulating"] + seconds["writing"] + seconds["drawing"]
    late = 2 * PICTURE  # batches of gradients go on from level to level, so that two pictures are not due any more
    assert parts + between == pytest.approx(done["seconds"], abs=late)
    assert between <= seconds["between"]
    room, dense = room_of(tmp_path / "made"), plan(run, tmp_path, *job[:6], *job[8:])
    assert planned["disk"]["bytes"] == pytest.approx(room.bytes, rel=0.5)
    assert planned["disk"]["bytes"] < dense["disk"]["bytes"] / 5
    assert dense["gradients"] == dense["episodes"]
    assert plan(run, tmp_path, *job[:6], "--no-gradients")["gradients"] == 0


def test_a_plan_needs_the_memory_that_is_held_and_that_of_the_slice_to_come(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gradscape.jobs.slice.peak_memory", lambda: 10**9)
    planned = plan(run, tmp_path, "cartpole", "--dims", "0", "1", "--resolution", "16")
    assert planned["memory"] == {"host": 10**9 + need_of((16, 16), 400, grad=True).memory, "device": 0}


def test_what_a_first_drawing_loads_is_paid_once(clock: Clock) -> None:
    took = iter((5.0, 2.0))
    assert time_drawing(lambda: clock.sleep(next(took))) == (3.0, 2.0)


def test_pictures_come_with_finer_levels_batches_and_a_pause_between_them() -> None:
    space = gradscape.ParameterSpace.box(["a", "b"], -1.0, 1.0)
    store = SliceStore.in_memory(gradscape.Plane.through(space, space.center, ("a", "b"), resolution=64), space)
    most = 1 + store.tiles()[-1].level
    soon = SOON + 44.0
    cases = ((99, 1e6, 1.0), (99, SOON, 1.0), (99, SOON + 1.0, 1.0), (99, soon, 1.0), (3, soon, 1.0))
    assert [count_pictures(most - 1, *now) for now in cases] == [most, 1, 2, 6, 4]


@pytest.mark.parametrize(("resolution", "coarse"), [(4, False), (32, True)])
def test_a_slice_that_is_over_at_once_is_drawn_when_it_is_finished_alone(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resolution: int, coarse: bool
) -> None:
    drawn, save = list[Path](), page.save
    monkeypatch.setattr(page, "save", lambda figure, path: (drawn.append(path), save(figure, path)))
    words = ["bounce", "--dims", "0", "1", "--fidelity", "draft", "--resolution", str(resolution)]
    assert run("slice", *words, "--out", "made", cwd=tmp_path).returncode == 0
    assert EPISODE * 4**2 < SOON < EPISODE * 32**2
    assert (len(drawn) > 1) == coarse


def test_no_more_than_a_tenth_of_the_time_goes_into_pictures_of_what_is_unfinished() -> None:
    assert [pause_after(seconds) for seconds in (0.1, 1.0, 60.0)] == [10.0, 10.0, 600.0]


def test_a_larger_job_is_planned_by_a_smaller_one(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four times the resolution, sixteen times the points: of each part as much as a rehearsal of all would say."""
    said = ["branin", "--dims", "0", "1", "--resolution", "64"]
    whole = plan(run, tmp_path, *said)
    monkeypatch.setattr("gradscape.jobs.plan.MOST_POINTS", 32)
    scaled = plan(run, tmp_path, *said)
    assert scaled["rate"] == "measured here, now, on 32 x 32 points"
    for name in ("episodes", "gradients", "batches", "too_large"):
        assert scaled[name] == whole[name]
    assert scaled["seconds"]["simulating"] == pytest.approx(whole["seconds"]["simulating"])
    assert scaled["disk"]["files"] == whole["disk"]["files"]
    for filled in ("bytes", "files"):
        assert scaled["disk"]["filling"][filled] == pytest.approx(whole["disk"]["filling"][filled], rel=0.6)
    few = plan(run, tmp_path, *said, "--gradients", "5")
    assert (few["gradients"], few["batches"]) == (13 * 13, 11 + 246)  # of 16, not as many times those of 32 x 32
    assert few["seconds"]["simulating"] == pytest.approx(whole["seconds"]["simulating"])


def test_a_plan_leaves_nothing_behind_and_workers_share_what_can_be_shared(
    run: Callable[..., Said], tmp_path: Path
) -> None:
    job = [*JOBS["bounce"], "--resolution", "48"]
    one, four = (plan(run, tmp_path, *job, "--workers", count) for count in ("1", "4"))
    assert not list(tmp_path.iterdir())
    assert one["rate"] == "measured here, now"
    assert one["device_hours"] == one["seconds"]["simulating"] / 3600
    for planned, share in ((one, 1.0), (four, 2 / 5)):  # 2304 points in 5 batches
        seconds = planned["seconds"]
        shared = share * (seconds["simulating"] + seconds["writing"] + seconds["between"])
        assert planned["wall"] == pytest.approx(seconds["start"] + shared + seconds["drawing"])


def test_figures_are_planned_by_kind_and_added_up(run: Callable[..., Said], tmp_path: Path) -> None:
    figure = '[[figure]]\nid = "{}"\nenv = "bounce"\ndims = [{}]\nthrough = "example:aim"\n'
    (tmp_path / "f.toml").write_text(figure.format("x", 0) + figure.format("y", 1) + figure.format("xy", "0, 1"))
    found = plan(run, tmp_path, "f.toml", "--resolution", "16", "--fidelity", "draft")
    assert [(one["figure"], one["episodes"]) for one in found["figures"]] == [("x", 16), ("y", 16), ("xy", 256)]
    x, y, _ = found["figures"]
    assert (x["seconds"]["simulating"], y["seconds"]["start"]) == (y["seconds"]["simulating"], 0.0)
    assert found["total"]["episodes"] == 288
    assert found["total"]["wall"] == pytest.approx(sum(one["wall"] for one in found["figures"]))
    assert {one.name for one in tmp_path.iterdir()} == {"f.toml"}


def test_a_figure_with_few_gradients_is_planned_with_as_many(run: Callable[..., Said], tmp_path: Path) -> None:
    figure = '[[figure]]\nid = "{}"\nenv = "bounce"\ndims = [0, 1]\nthrough = "example:aim"\ngradients = {}\n'
    (tmp_path / "f.toml").write_text(figure.format("all", 1) + figure.format("few", 4))
    how = ["f.toml", "--resolution", "16", "--fidelity", "draft"]
    assert [one["gradients"] for one in plan(run, tmp_path, *how)["figures"]] == [256, 16]
    assert [one["gradients"] for one in plan(run, tmp_path, *how, "--no-gradients")["figures"]] == [0, 0]


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
    none = Bootstrap(None, None, None)
    errors = LossError(none, none, none, none)
    measured = Comparison(errors, none, GradientError(none, none), None, 4, Seconds(1.0, 2.5), 8)
    options, identity = asdict(env.options), {**env.identity(), "device": "cuda"}
    draft = MeasuredVariant("draft", "named", env.fidelity.record(), "warp", "cuda", options, 10, measured)
    path = keep(Tradeoff("flip", "draft", 4, 0, env.loss_unit, None, 0, (draft,), (), (), identity, {}, ""))
    done = run(*command, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["device"] == "cuda"
    assert (found["seconds"]["simulating"], found["batches"]) == (16 * 2.5, 2)
    assert str(path) in found["rate"]
    few = json.loads(run(*command, "--gradients", "3", "--json", cwd=tmp_path).stdout)
    assert (few["seconds"]["simulating"], few["batches"]) == (4 * 2.5 + 12 * 1.0, 1 + 2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["bonce"], "did you mean bounce?"),
        (["none.toml"], "no list of figures at none.toml"),
        (["figures.toml", "--over", "2"], "leave out --over"),
        (["figures.toml", "--gradients", "2"], "--gradients and --set"),
        (["bounce", "--over", "2", "--resolution", "8", "--gradients", "8"], "gradients at every 8"),
        (["bounce", "--resolution", "8", "--gradients", "8"], "got 8 x 8 samples and gradients at every 8"),
        (["bounce", "--gradients", "2", "--methods", "random"], "a race has no plane; leave out --dims"),
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


def test_a_replica_keeps_failures_and_precision(tmp_path: Path) -> None:
    env = gradscape.make("flip", fidelity="draft", device="cpu")
    plane = gradscape.Plane.through(env.space, env.space.center, ("0", "1"), resolution=8)
    store = SliceStore.create(tmp_path / "s.zarr", plane, env.space, identity={})
    replica = Replica(env, store, rows=2)
    said = replica.evaluate(env.space.center.expand(5, -1))
    true_at = store.points(store.tiles()[0])[:2]
    true = env.evaluate(true_at)
    nearest = [int((plane.project(true_at) - plane.project(env.space.center[None])).norm(dim=1).argmin())] * 5
    assert said.loss.tolist() == pytest.approx(true.loss[nearest].tolist(), rel=2e-3)
    assert len(set(said.loss.tolist())) == 5
    exact = bool((true.loss.float().double() == true.loss).all())
    assert bool((said.loss.float().double() == said.loss).all()) == exact
    assert said.status.tolist() == true.status[nearest].tolist()
