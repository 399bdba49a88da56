"""`landscape plan ENV --methods`: what a race takes is added up from what its methods and simulator were seen to."""

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pytest
import torch

import gradscape
from gradscape.jobs.plan_race import RacePlan, Rate, Workload, own_time
from gradscape.jobs.search import make_optimizer
from gradscape.landscapes.objective import Evaluation
from gradscape.optim import dry_run as timing
from gradscape.optim.base import Optimizer
from gradscape.optim.dry_run import BLOCK, MIN_KNOWN, WARM_UP, DryRun, StepTime, SyntheticObjective, dry_run, places
from gradscape.optim.methods import surrogate
from gradscape.optim.registry import methods

from ..clock import Clock
from ..command import Said

SHORT = ["plan", "branin", "--methods", "random,descents", "--seeds", "2", "--budget", "8"]
STEADY = DryRun((StepTime(100.0, 0.25, 0.5),), proposal_size=1.0, gradient_share=0.0)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Let a rehearsal and what processes would compute pass on a clock of its own."""
    clock = Clock()
    for module in ("optim.dry_run", "optim.lockstep"):
        monkeypatch.setattr(f"gradscape.{module}.time", clock)
    return clock


def plan(run: Callable[..., Said], cwd: Path, *arguments: str) -> dict[str, Any]:
    done = run(*arguments, "--json", cwd=cwd)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_runs_take_what_their_episodes_took_and_processes_share_what_is_apart() -> None:
    rising = DryRun((StepTime(0.0, 1.0, 0.0), StepTime(10.0, 2.0, 20.0)), proposal_size=1.0, gradient_share=0.0)
    serial, parallel = rising.seconds(0, 21)
    assert serial == pytest.approx(sum(1.0 + n / 10.0 for n in range(10)) + 11 * 2.0)
    assert parallel == pytest.approx(sum(2.0 * n for n in range(10)) + 11 * 20.0)
    assert rising.seconds(5, 5) == (0.0, 0.0)
    first, rest = rising.seconds(0, 7), rising.seconds(7, 21)
    assert (first[0] + rest[0], first[1] + rest[1]) == pytest.approx((serial, parallel))
    for workers, beside in ((1, 1), (2, 2), (8, 3)):  # no more than there are runs
        own = own_time(STEADY, [40, 100, 60], 100, workers)
        assert (own.serial, own.parallel, own.processes) == pytest.approx((0.25 * 200, 0.5 * 200, beside))
        assert own.wall == pytest.approx(50.0 + 100.0 / beside)


def test_a_race_takes_its_rounds_its_episodes_and_its_methods() -> None:
    many = DryRun((StepTime(100.0, 0.01, 0.0),), proposal_size=5.0, gradient_share=0.5)
    rehearsed, left = {"one": STEADY, "many": many}, {"one": [100, 100], "many": [100, 40]}
    load = Workload.of(rehearsed, left)
    assert load == Workload(forward=200 + 70, gradient=70, batches=100)  # `one` proposes a point at a time
    assert load.rows == (3, 1)
    own = {method: own_time(rehearsed[method], left[method], 100, 2) for method in left}
    found = RacePlan(load, Rate(2.0, 3.0, "given"), own, start=7.0)
    assert found.simulating == pytest.approx(270 * 2.0 + 70 * 3.0)
    assert found.searching == pytest.approx(0.25 * 200 + 0.5 * 200 / 2 + 0.01 * 140)
    assert found.wall == pytest.approx(7.0 + found.simulating + found.searching)
    assert found.share == pytest.approx(found.searching / (found.simulating + found.searching))
    said = found.record()
    assert said["seconds"]["methods"] == pytest.approx(sum(one["wall"] for one in said["methods"].values()))
    assert "the methods' own, 2 min of them one" in found.outcome()


def test_runs_beyond_those_that_go_abreast_wait_for_them() -> None:
    left = {"one": [10] * 401}
    assert Workload.of({"one": STEADY}, left).batches == 3 * 10


@pytest.mark.parametrize("budget", [1, 32, 200, 1000, 30_000])
def test_a_method_that_remembers_is_rehearsed_from_the_beginning_to_nearly_the_end(budget: int) -> None:
    found = places(budget)
    assert found == sorted(set(found))
    assert found[0] == 0
    assert all(MIN_KNOWN <= known <= budget for known in found[1:])
    assert found[-1] >= budget - BLOCK or found[-1] == budget * 7 // 8
    assert len(found) <= 2 + math.log(max(budget, MIN_KNOWN) / MIN_KNOWN, 3)


def slowed(monkeypatch: pytest.MonkeyPatch, clock: Clock, method: str) -> Callable[[], Optimizer]:
    """Make a method that takes a millisecond for each point it knows when it asks, and make it."""
    env = gradscape.make("branin")
    kind = type(make_optimizer(method, env))
    ask, take_in = kind._ask, kind._take_in
    known = WeakKeyDictionary[Optimizer, int]()

    def slow_ask(self: Optimizer) -> Any:
        clock.sleep(1e-3 * known.get(self, 0))
        return ask(self)

    def count(self: Optimizer, x: torch.Tensor, evaluation: Evaluation) -> Any:
        known[self] = known.get(self, 0) + len(x)
        return take_in(self, x, evaluation)

    monkeypatch.setattr(kind, "_ask", slow_ask)
    monkeypatch.setattr(kind, "_take_in", count)
    return lambda: make_optimizer(method, env)


def test_what_late_proposals_take_is_known_without_going_there(
    monkeypatch: pytest.MonkeyPatch, clock: Clock, tmp_path: Path
) -> None:
    """Of a method whose proposals take a millisecond for each point known, a whole search is known from a few."""
    found = dry_run(gradscape.make("branin"), slowed(monkeypatch, clock, "bo"), 600, tmp_path)
    serial, parallel = found.seconds(0, 600)
    assert (found.proposal_size, found.gradient_share, parallel) == (1.0, 0.0, 0.0)
    assert serial == pytest.approx(sum(1e-3 * known for known in range(600)), rel=0.03)
    assert sum(1 for slept in clock.slept if slept) < 300


def test_what_processes_would_compute_is_told_apart(
    monkeypatch: pytest.MonkeyPatch, clock: Clock, tmp_path: Path
) -> None:
    """A process that knows enough points is minimised by whoever computes."""
    minimise = surrogate._minimise

    def slow(*given: Any) -> Any:
        clock.sleep(0.25)
        return minimise(*given)

    monkeypatch.setattr(surrogate, "_minimise", slow)
    env = gradscape.make("branin")
    found = dry_run(env, lambda: make_optimizer("bo", env), 200, tmp_path)
    assert len(found.steps) > 2
    for step in found.steps[1:]:
        assert (step.serial, step.parallel) == pytest.approx((0.0, 0.25))


def test_a_method_that_forgets_is_rehearsed_once_and_no_longer_than_a_moment(
    monkeypatch: pytest.MonkeyPatch, clock: Clock, tmp_path: Path
) -> None:
    make = slowed(monkeypatch, clock, "random")
    found = dry_run(gradscape.make("branin"), make, 100_000, tmp_path)
    assert len(found.steps) == 1
    assert clock.now < 2 * timing.MAX_SECONDS + WARM_UP


def remembering() -> Iterator[str]:
    for name in methods():
        if not methods()[name].extra and make_optimizer(name, gradscape.make("branin")).remembers:
            yield name


def test_a_method_that_is_informed_goes_on_as_if_it_had_asked() -> None:
    """Those that remember propose by what they were told, wherever the points came from."""
    env, names = gradscape.make("branin"), list(remembering())
    assert {"bo", "bo-descents", "bo-leap", "bo-gradient"} <= set(names)
    x = env.space.uniform(30, seed=1)
    evaluation = SyntheticObjective(env).evaluate(x)
    for name in names:
        one, other, blank = (make_optimizer(name, env) for _ in range(3))
        one.inform(x, evaluation)
        other.inform(x, evaluation)
        proposals = [each.ask().x for each in (one, other, blank)]
        np.testing.assert_array_equal(proposals[0], proposals[1])
        assert not torch.equal(proposals[0], proposals[2])


def test_synthetic_slopes_are_those_of_the_losses() -> None:
    synthetic = SyntheticObjective(gradscape.make("branin"))
    x = synthetic.space.uniform(5, seed=0).requires_grad_()
    evaluation = synthetic.evaluate(x.detach())
    u = synthetic.space.to_unit(x) - 0.3
    (wanted,) = torch.autograd.grad((3.0 * u.square() + 0.3 * torch.sin(9.0 * u)).sum(), x)
    torch.testing.assert_close(evaluation.grad, wanted)
    assert synthetic.evaluate(x.detach(), grad=False).grad is None
    assert synthetic.asked == {True: 5, False: 5}


def test_a_race_is_planned_as_json_and_leaves_nothing_behind(run: Callable[..., Said], tmp_path: Path) -> None:
    found = plan(run, tmp_path, *SHORT, "--workers", "2", "--option", "descents.batch_size=2")
    assert not list(tmp_path.iterdir())
    assert (found["env"], found["seeds"], found["budget"], found["workers"]) == ("branin", 2, 8, 2)
    assert (found["episodes"], found["with_gradient"]) == (2 * 2 * 8, 2 * 8)
    assert set(found["methods"]) == {"random", "descents"}
    assert found["batches"] == 4  # two points of each descent at a time
    assert found["wall"] == pytest.approx(sum(found["seconds"].values()))
    assert 0.0 < found["methods_share"] < 1.0
    assert min(found["memory"]["host"], found["disk"]["bytes"], found["rate"]["gradient"]) > 0


def test_a_plan_of_a_race_is_printed(run: Callable[..., Said], tmp_path: Path) -> None:
    done = run(*SHORT, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "branin · exact · cpu · 8 episodes · 2 seeds of random, descents" in done.stdout
    assert "s an episode" in done.stdout


def test_a_race_announces_what_its_plan_would_say(run: Callable[..., Said], tmp_path: Path) -> None:
    budget = str(4 * BLOCK)
    done = run("race", "branin", "--methods", "random", "--budget", budget, "--seeds", "1", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"{budget} episodes to compute: about " in done.stderr
    assert "the methods' own" in done.stderr
    again = run("race", "branin", "--methods", "random", "--budget", "600", "--seeds", "1", "--json", cwd=tmp_path)
    assert "and what the methods take" in again.stderr  # 88 are left, of which a rehearsal would be much


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["branin", "--methods", "random,magic"], "no method is called 'magic'"),
        (["branin", "--seeds", "3"], "name its methods with --methods"),
        (["branin", "--budget", "3"], "name its methods with --methods"),
        (["branin", "--methods", "random", "--resolution", "8"], "a race has no plane; leave out"),
        (["branin", "--methods", "random", "--dims", "0", "1"], "a race has no plane; leave out"),
        (["figures.toml", "--methods", "random"], "a race is of one environment"),
        (["branin", "--methods", "random", "--option", "bo.initial=3"], "METHOD.NAME=VALUE for one of random"),
        (["branin", "--methods", "descents", "--option", "descents.speed=3"], "descents has no option 'speed'"),
        (["bonce", "--methods", "random"], "did you mean bounce?"),
    ],
)
def test_bad_input_gets_one_line(run: Callable[..., Said], tmp_path: Path, arguments: list[str], said: str) -> None:
    done = run("plan", *arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_device_that_is_not_here_has_no_rate_until_one_is_kept(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("gradscape.envs.engines.runtime.cuda_available", lambda: False)
    command = ["plan", "flip", "--methods", "random", "--device", "cuda", "--fidelity", "draft", "--set", "horizon=0.5"]
    refused = run(*command, "--budget", "4", cwd=tmp_path)
    assert refused.returncode == 2
    assert "`landscape tradeoff flip --device cuda` measures it" in refused.stderr
