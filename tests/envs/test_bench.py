"""What a benchmark says is what was measured: rates, ratios, kernels, the sampler's share."""

import time
from types import SimpleNamespace

import pytest
import torch
import warp as wp

from gradscape.envs.base import Environment, Fidelity, Work
from gradscape.envs.bench import alternated, bench
from gradscape.envs.bounce import Bounce
from gradscape.envs.engines.model import Box
from gradscape.envs.engines.replay import Replay
from gradscape.envs.engines.runtime import KernelTime, cuda_available, kernel_times
from gradscape.envs.fluid import Fluid
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.space import ParameterSpace

GPU = pytest.mark.skipif(not cuda_available(), reason="no CUDA device")
NAP = {"warp": 0.002, "taichi": 0.008}  # [s] for each row, and as much again for its gradient


class Sleeper(Environment):
    """Costs what it sleeps; its lowest rows fail."""

    name = "sleeper"
    engines = ("warp", "taichi")
    fidelities = {"draft": Fidelity("draft", dt=0.1)}  # noqa: RUF012 -- a class of this test's alone
    space = ParameterSpace.box(["a", "b"], -1.0, 1.0)

    def work(self):
        return Work(7, "nap")

    def _evaluate(self, x, *, grad):
        time.sleep(NAP[self.engine] * len(x) * (1 + grad))
        status = torch.where(x[:, 0] < -0.5, int(Status.ERROR), int(Status.OK))
        return Evaluation(x.sum(dim=1), torch.ones_like(x) if grad else None, status)


def sleeper(engine):
    return Sleeper(engine=engine)


@pytest.fixture(scope="module")
def report():
    return bench(sleeper, "warp", against="taichi", batches=[1, 8], seconds=0.2)


def test_rates_are_what_one_batch_took(report):
    assert [(row["batch"], row["engine"]) for row in report["rates"]] == [
        *((1, "warp"), (1, "taichi")),
        *((8, "warp"), (8, "taichi")),
    ]
    for row in report["rates"]:
        for way, naps in (("forward", 1), ("with_gradient", 2)):
            rate = row[way]
            assert rate["episodes_per_second"] == pytest.approx(row["batch"] / rate["seconds"])
            assert rate["work_per_second"] == pytest.approx(7 * rate["episodes_per_second"])
            assert rate["seconds"] >= naps * NAP[row["engine"]] * row["batch"]
        assert row["gradient_costs"] == row["with_gradient"]["seconds"] / row["forward"]["seconds"]


def test_ratios_are_those_of_the_rates(report):
    for ours, theirs in (report["rates"][:2], report["rates"][2:]):
        for way in ("forward", "with_gradient"):
            ratio = ours[way]["episodes_per_second"] / theirs[way]["episodes_per_second"]
            assert ours[f"ratio_{way}"] == pytest.approx(ratio)
            assert ratio > 1.5  # four, if the machine has nothing else to do
        assert ours["repetitions"] == theirs["repetitions"] >= 2
        assert "ratio_forward" not in theirs


def test_the_best_repetition_counts(monkeypatch):
    monkeypatch.setattr(
        "gradscape.envs.bench.alternated", lambda calls, seconds: {key: [3.0, 1.0, 2.0] for key in calls}
    )
    (row,) = bench(sleeper, "warp", batches=[1])["rates"]
    assert (row["forward"]["seconds"], row["with_gradient"]["seconds"], row["repetitions"]) == (1.0, 1.0, 3)


def test_failures_are_counted(report):
    env = sleeper("warp")
    sobol = torch.quasirandom.SobolEngine(2, scramble=True, seed=0).draw(8, dtype=torch.float64)
    failed = int((env.evaluate(env.space.from_unit(sobol)).status != Status.OK).sum())
    assert 0 < failed < 8
    assert [row["failed"] for row in report["rates"][2:]] == [failed, failed]


def test_simulating_is_not_the_samplers_own_time(report, monkeypatch):
    assert report["sampler"]["points"] >= 4
    monkeypatch.setitem(NAP, "warp", 0.0)
    idle = bench(sleeper, "warp", batches=[1], seconds=0.0)["sampler"]
    assert idle["share"] > 0.5 > report["sampler"]["share"] > 0


def test_calls_take_turns_and_are_repeated_whatever_they_take():
    made = []
    times = alternated({"a": lambda: made.append("a"), "b": lambda: made.append("b")}, seconds=0.0)
    assert made == ["a", "b", "a", "b"]
    assert {key: len(found) for key, found in times.items()} == {"a": 2, "b": 2}


def test_calls_end_before_a_round_would_end_too_late(monkeypatch):
    clock = [0.0]

    def call(seconds):
        clock[0] += seconds

    monkeypatch.setattr("gradscape.envs.bench.time", SimpleNamespace(perf_counter=lambda: clock[0]))
    times = alternated({"a": lambda: call(1.0), "b": lambda: call(2.0)}, seconds=10.0)
    assert times == {"a": [1.0] * 3, "b": [2.0] * 3}


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=GPU)])
def test_every_kernel_is_timed_within_the_time_that_passes(device):
    found = bench(lambda engine: Bounce(device=device, engine=engine), "warp", batches=[1], seconds=0.0)
    steps, advance = found["work"]["count"], "step_kernel.advance"  # one launch moves the ball of every row
    calls = {way: {row["name"]: row["calls"] for row in part["kernels"]} for way, part in found["kernels"].items()}
    assert calls == {
        "forward": {advance: steps},
        "with_gradient": {advance: steps, f"{advance} backward": steps},
    }
    for part in found["kernels"].values():
        spent = sum(row["seconds"] for row in part["kernels"])
        assert 0 < spent < part["seconds"]
        assert sum(row["share"] for row in part["kernels"]) == pytest.approx(spent / part["seconds"])


def test_kernels_have_the_same_names_on_cuda(monkeypatch):
    runs = [
        SimpleNamespace(name="forward kernel step_kernel__locals__advance_0a1b2c3d", elapsed=2.0),
        SimpleNamespace(name="forward kernel step_kernel__locals__advance_0a1b2c3d", elapsed=3.0),
        SimpleNamespace(name="backward kernel step_kernel__locals__advance_0a1b2c3d", elapsed=7.0),
    ]
    monkeypatch.setattr(wp, "timing_begin", lambda cuda_filter: None)
    monkeypatch.setattr(wp, "timing_end", lambda: runs)
    with kernel_times("cuda") as times:
        assert not times
    assert times == {"step_kernel.advance": KernelTime(2, 0.005), "step_kernel.advance backward": KernelTime(1, 0.007)}


def test_kernels_are_launched_one_by_one_to_be_timed(monkeypatch):
    monkeypatch.setattr(wp, "timing_begin", lambda cuda_filter: None)
    monkeypatch.setattr(wp, "timing_end", list)
    monkeypatch.setattr(wp, "capture_launch", lambda graph: launched.append(graph))
    replay, launched = Replay("cuda"), []
    box = Box((0, 0, 0), (1, 1, 1))
    replay("key", box, None, lambda: replay.call(lambda: launched.append("kernel")), small=True)
    replay.seen, replay.graphs = {("key", box)}, {("key", box): "graph"}
    with kernel_times("cuda"):
        replay("key", box, None, launched.clear, small=True)
    replay("key", box, None, launched.clear, small=True)
    assert launched == ["kernel", "kernel", "graph"]


@GPU
def test_a_gpu_holds_what_was_estimated_or_more_where_it_has_room():
    found = bench(lambda engine: Fluid(device="cuda", engine=engine), "warp", batches=[1], seconds=0.0)
    assert found["memory"]["measured"] / found["memory"]["estimated"] > 0.3


def test_launches_are_timed_within_the_block_only():
    launch = wp.launch
    with pytest.raises(KeyError), kernel_times("cpu") as times:
        raise KeyError(times)
    assert wp.launch is launch


@pytest.mark.parametrize(
    ("engine", "against", "said"),
    [
        ("taichi", None, "bounce has engine warp; got engine 'taichi'"),
        ("warp", "taichi", "bounce has engine warp; got engine 'taichi'"),
        ("warp", "warp", "two engines are compared; got warp against warp"),
    ],
)
def test_an_engine_that_is_not_there_is_refused_before_anything_runs(engine, against, said):
    heard = []
    with pytest.raises(ValueError, match=said):
        bench(lambda name: Bounce(device="cpu", engine=name), engine, against=against, follow=heard.append)
    assert heard == []
