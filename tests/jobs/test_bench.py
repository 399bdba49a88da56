"""What a benchmark says is what was measured: rates, ratios, kernels, the sampler's share."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import warp as wp

from gradscape.envs.base import Environment, Fidelity, Work
from gradscape.envs.bounce import Bounce
from gradscape.envs.engines.launches import KernelTime, Launches, time_kernels
from gradscape.envs.engines.runtime import cuda_available
from gradscape.envs.mpm.fluid import Fluid
from gradscape.jobs.bench import BenchJob, alternate
from gradscape.jobs.watch import Watch
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.store import SliceStore

from ..clock import Clock

GPU = pytest.mark.skipif(not cuda_available(), reason="no CUDA device")
NAP = {"warp": 0.002, "taichi": 0.008}  # [s] for each row, and as much again for its gradient
WRITING = 0.05  # [s] for each tile
CLOCK = Clock()


class Sleeper(Environment):
    """Takes its time on a clock of its own; its lowest rows fail."""

    name = "sleeper"
    engines = ("warp", "taichi")
    fidelities = {"draft": Fidelity("draft", dt=0.1)}  # noqa: RUF012 -- a class of this test's alone
    space = ParameterSpace.box(["a", "b"], -1.0, 1.0)

    def work(self):
        return Work(7, "nap")

    def _evaluate(self, x, *, grad):
        CLOCK.sleep(NAP[self.engine] * len(x) * (1 + grad))
        status = torch.where(x[:, 0] < -0.5, int(Status.ERROR), int(Status.OK))
        return Evaluation(x.sum(dim=1), torch.ones_like(x) if grad else None, status)


def sleeper(engine):
    return Sleeper(engine=engine)


@pytest.fixture(scope="module")
def report():
    write = SliceStore.write

    def slow(store, tile, evaluation):
        CLOCK.sleep(WRITING)
        write(store, tile, evaluation)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gradscape.jobs.bench.time", CLOCK)
        patch.setattr(SliceStore, "write", slow)
        return BenchJob(sleeper, "warp", against="taichi", batches=[1, 8], seconds=0.2).run().record()


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
            assert rate["seconds"] == pytest.approx(naps * NAP[row["engine"]] * row["batch"])
        assert row["gradient_costs"] == pytest.approx(2.0)


def test_ratios_are_those_of_the_rates(report):
    for ours, theirs in (report["rates"][:2], report["rates"][2:]):
        for way in ("forward", "with_gradient"):
            ratio = ours[way]["episodes_per_second"] / theirs[way]["episodes_per_second"]
            assert ours[f"ratio_{way}"] == pytest.approx(ratio) == pytest.approx(4.0)
            assert report[f"ratio_{way}"] == pytest.approx(4.0)
        assert "ratio_forward" not in theirs


def test_batches_are_repeated_for_the_seconds_given_and_twice_at_least(report):
    assert [row["repetitions"] for row in report["rates"]] == [6, 6, 2, 2]  # rounds of 0.03 s and of 0.24 s


def test_the_median_of_repetitions_counts(monkeypatch):
    monkeypatch.setattr(
        "gradscape.jobs.bench.alternate", lambda calls, seconds, draw: {key: [4.0, 1.0, 2.0] for key in calls}
    )
    (row,) = BenchJob(sleeper, "warp", batches=[1]).run().record()["rates"]
    assert (row["forward"]["seconds"], row["with_gradient"]["seconds"], row["repetitions"]) == (2.0, 2.0, 3)


@pytest.mark.parametrize("same", [False, True])
def test_every_repetition_has_points_of_its_own_and_both_engines_the_same(monkeypatch, same):
    seen = {"warp": [], "taichi": []}

    class Seen(Sleeper):
        def _evaluate(self, x, *, grad):
            if len(x) == 8:
                seen[self.engine].append((grad, x.clone()))
            return super()._evaluate(x, grad=grad)

    monkeypatch.setattr("gradscape.jobs.bench.time", CLOCK)
    job = BenchJob(lambda engine: Seen(engine=engine), "warp", against="taichi", batches=[8], seconds=1.0)
    assert replace(job, same_points=same).run().same_points == same
    for (_, ours), (_, theirs) in zip(*seen.values(), strict=False):
        assert torch.equal(ours, theirs)
    sloped = [x for grad, x in seen["warp"] if grad]
    assert len(sloped) > 3
    assert len({float(x.sum()) for x in sloped}) == (1 if same else len(sloped))


def test_failures_are_counted(report):
    env = sleeper("warp")
    sobol = torch.quasirandom.SobolEngine(2, scramble=True, seed=0).draw(8, dtype=torch.float64)
    failed = int((env.evaluate(env.space.from_unit(sobol)).status != Status.OK).sum())
    assert 0 < failed < 8
    assert [row["failed"] for row in report["rates"][2:]] == [failed, failed]


def test_simulating_is_not_the_samplers_own_time(report):
    sampler = report["sampler"]
    assert sampler["points"] == 25  # what is simulated in 0.1 s
    plane = Plane.through(Sleeper.space, Sleeper.space.center, ["a", "b"], resolution=5)
    tiles = len(SliceStore.in_memory(plane, Sleeper.space).tiles())
    assert sampler["seconds"] == pytest.approx(25 * 2 * NAP["warp"] + tiles * WRITING)
    assert sampler["share"] == pytest.approx(tiles * WRITING / sampler["seconds"])


class Adapted(Sleeper):
    """Sleeps four fifths of the time in an engine's own program."""

    def engine_call(self, x, *, grad):
        return lambda: CLOCK.sleep(0.8 * NAP[self.engine] * len(x) * (1 + grad))


def test_what_is_not_the_engines_own_program_is_the_adapters(report, monkeypatch):
    assert report["adapter"] is None
    monkeypatch.setattr("gradscape.jobs.bench.time", CLOCK)
    found = BenchJob(lambda engine: Adapted(engine=engine), "warp", batches=[1], seconds=0.2).run().adapter
    assert found.batch == 256
    assert (found.forward, found.with_gradient) == pytest.approx((0.2, 0.2))


def test_calls_take_turns_and_are_repeated_whatever_they_take():
    made = []
    calls = {name: lambda number, name=name: made.append((name, number)) for name in "ab"}
    times = alternate(calls, 0.0, lambda number: number)
    assert made == [("a", 0), ("b", 0), ("a", 1), ("b", 1)]
    assert {key: len(found) for key, found in times.items()} == {"a": 2, "b": 2}


def test_calls_end_before_a_round_would_end_too_late(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("gradscape.jobs.bench.time", clock)
    times = alternate({"a": lambda _: clock.sleep(1.0), "b": lambda _: clock.sleep(2.0)}, 10.0, lambda number: number)
    assert times == {"a": [1.0] * 3, "b": [2.0] * 3}


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=GPU)])
def timed(request, monkeypatch):
    """Return kernels' times by the way of a ball's flight; on a CPU every look at the clock takes a second."""
    if request.param == "cpu":
        clock = Clock(tick=1.0)
        for module in ("jobs.bench", "envs.engines.launches"):
            monkeypatch.setattr(f"gradscape.{module}.time", clock)
        monkeypatch.setattr(Bounce, "threads", 1)  # a solver takes fewer rows than are worth evaluating at once
    job = BenchJob(lambda engine: Bounce(device=request.param, engine=engine), "warp", batches=[1], seconds=0.0)
    return job.run().record()


def test_every_kernel_is_timed_within_the_time_that_passes(timed):
    advance = "flight_kernel.advance"  # one launch takes the ball of every row through all steps
    calls = {way: {row["name"]: row["calls"] for row in part["kernels"]} for way, part in timed["kernels"].items()}
    assert calls == {
        "forward": {advance: 1},
        "with_gradient": {advance: 1, f"{advance} backward": 1},
    }
    for part in timed["kernels"].values():
        spent, launches = (sum(row[what] for row in part["kernels"]) for what in ("seconds", "calls"))
        assert 0 < spent < part["seconds"]
        assert sum(row["share"] for row in part["kernels"]) == pytest.approx(spent / part["seconds"])
        if timed["device"] == "cpu":
            assert (spent, part["seconds"]) == (launches, 2 * launches + 1)  # two looks at every launch, and one after


def test_kernels_have_the_same_names_on_cuda(monkeypatch):
    runs = [
        SimpleNamespace(name="forward kernel step_kernel__locals__advance_0a1b2c3d", elapsed=2.0),
        SimpleNamespace(name="forward kernel step_kernel__locals__advance_0a1b2c3d", elapsed=3.0),
        SimpleNamespace(name="backward kernel step_kernel__locals__advance_0a1b2c3d", elapsed=7.0),
    ]
    monkeypatch.setattr(wp, "timing_begin", lambda cuda_filter: None)
    monkeypatch.setattr(wp, "timing_end", lambda: runs)
    with time_kernels("cuda") as times:
        assert not times
    assert times == {"step_kernel.advance": KernelTime(2, 0.005), "step_kernel.advance backward": KernelTime(1, 0.007)}


def test_kernels_are_launched_one_by_one_to_be_timed(monkeypatch):
    monkeypatch.setattr(wp, "timing_begin", lambda cuda_filter: None)
    monkeypatch.setattr(wp, "timing_end", list)
    monkeypatch.setattr(wp, "capture_launch", lambda graph: launched.append(graph))
    launches, launched = Launches("cuda"), []
    launches.run("key", 1, lambda: launches.call(lambda: launched.append("kernel")), small=True)
    launches.seen, launches.graphs = {("key", 1)}, {("key", 1): "graph"}
    with time_kernels("cuda"):
        launches.run("key", 1, launched.clear, small=True)
    launches.run("key", 1, launched.clear, small=True)
    assert launched == ["kernel", "kernel", "graph"]


@GPU
def test_a_gpu_holds_what_was_estimated_or_more_where_it_has_room():
    found = (
        BenchJob(lambda engine: Fluid(device="cuda", engine=engine), "warp", batches=[1], seconds=0.0).run().record()
    )
    assert found["memory"]["measured"] / found["memory"]["estimated"] > 0.3


def test_launches_are_timed_within_the_block_only():
    launch = wp.launch
    with pytest.raises(KeyError), time_kernels("cpu") as times:
        raise KeyError(times)
    assert wp.launch is launch


@pytest.mark.parametrize(
    ("engine", "against", "said"),
    [
        ("taichi", None, "bounce has engine warp; got engine 'taichi'"),
        ("warp", "taichi", "bounce has engine warp; got engine 'taichi'"),
        ("warp", "warp", "bench compares two different engines; got warp twice"),
    ],
)
def test_an_engine_that_is_not_there_is_refused_before_anything_runs(engine, against, said):
    heard, watch = [], Watch()
    watch.note = heard.append
    with pytest.raises(ValueError, match=said):
        BenchJob(lambda name: Bounce(device="cpu", engine=name), engine, against=against).run(watch)
    assert heard == []
