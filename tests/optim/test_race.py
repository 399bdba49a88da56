import dataclasses
import math
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.race import Competitor, race
from gradscape.optim.registry import optimizer_class
from gradscape.optim.runs.store import RunStore
from gradscape.optim.search import search


class Bowl(Objective):
    """A bowl that fails in a corner, counts its episodes, and can be interrupted after some."""

    space = ParameterSpace.box(("x", "y"), -2.0, 2.0, "m")
    name = "bowl"

    def __init__(self, stop_after: float = math.inf):
        self.asked, self.stop_after = 0, stop_after
        self.batches: list[int] = []

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        if self.asked >= self.stop_after:
            raise KeyboardInterrupt
        self.asked += len(x)
        self.batches.append(len(x))
        failed = torch.where((x > 1).all(dim=1), Status.ESCAPED, Status.OK)
        return Evaluation.from_results((x**2).sum(dim=1), 2 * x if grad else None, failed)


BUDGET = 37


def field(folder=None, seeds=2) -> list[Competitor]:
    found = []
    for seed in range(seeds):
        for method in ("random", "cma-es", "descents"):
            identity = {"objective": "bowl", "method": method, "seed": seed}
            made = partial(optimizer_class(method).on, Bowl(), seed=seed)
            if folder is None:
                run = RunStore.in_memory(Bowl.space, identity=identity, budget=BUDGET)
            else:
                path = folder / f"{method}-{seed}/run.zarr"
                run = RunStore.open_or_create(path, Bowl.space, identity=identity, budget=BUDGET)
            found.append(Competitor(method, seed, run, made))
    return found


def bits(entries: list[Competitor]) -> dict[tuple[str, int], tuple[bytes, ...]]:
    columns = ("x", "loss", "grad", "status", "kind", "episodes", "forwards")
    return {
        (entry.method, entry.seed): tuple(entry.run.dataset()[name].to_numpy().tobytes() for name in columns)
        for entry in entries
    }


def alone() -> list[Competitor]:
    entries = field()
    for entry in entries:
        search(Bowl(), entry.make(), entry.run, budget=BUDGET, gradient_cost=2.0)
    return entries


def test_every_run_has_the_budget_to_the_episode_and_seeds_differ():
    objective, entries = Bowl(), field()
    race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert objective.asked == BUDGET * len(entries)
    assert [entry.run.count for entry in entries] == [BUDGET] * 6
    assert len(set(bits(entries).values())) == len(entries)


def test_runs_in_lockstep_are_those_of_each_alone():
    objective, entries = Bowl(), field()
    race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert bits(entries) == bits(alone())
    assert objective.batches[:2] == [2 * (16 + 6), 2 * 4]  # of both seeds: populations, then descents with gradient
    assert len(objective.batches) < BUDGET * 2  # a run that has ended is not waited for


def test_on_a_gpu_that_is_not_full_losses_are_evaluated_with_the_gradients_of_others():
    """A row whose loss alone was wanted does not fail for a gradient that it lacks."""

    class Edged(Bowl):
        device, preferred_batch = "cuda", 1000

        def evaluate(self, x, *, grad=True):
            found = super().evaluate(x, grad=grad)
            return Evaluation.from_results(
                found.loss, found.grad.masked_fill(x[:, :1] < 0, torch.nan) if grad else None, found.status
            )

    apart, objective, entries = field(), Edged(), field()
    for entry in apart:
        search(Edged(), entry.make(), entry.run, budget=BUDGET, gradient_cost=2.0)
    race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert bits(entries) == bits(apart)
    assert objective.batches[0] == 2 * (16 + 6 + 4)
    status = {entry.method: set(entry.run.dataset()["status"].to_numpy().tolist()) for entry in entries}
    assert Status.NO_GRADIENT in status["descents"]
    assert Status.NO_GRADIENT not in status["random"] | status["cma-es"]


@pytest.mark.parametrize("abreast", [1, 4])
def test_more_runs_than_go_on_abreast_take_turns(monkeypatch, abreast):
    monkeypatch.setattr("gradscape.optim.race.MAX_ABREAST", abreast)
    entries = field()
    race(Bowl(), entries, budget=BUDGET, gradient_cost=2.0)
    assert bits(entries) == bits(alone())


def test_a_race_that_was_stopped_goes_on_to_the_same_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("gradscape.optim.runs.store.PAUSE", 0.0)
    monkeypatch.setattr("gradscape.optim.runs.store.SHARE", math.inf)
    for stop in (20, 150):
        with pytest.raises(KeyboardInterrupt):
            race(Bowl(stop), field(tmp_path), budget=BUDGET, gradient_cost=2.0)
    kept = sum(entry.run.count for entry in field(tmp_path))
    assert 0 < kept < BUDGET * 6
    objective, entries = Bowl(), field(tmp_path)
    race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert objective.asked == BUDGET * 6 - kept
    assert bits(entries) == bits(alone())


def test_a_finished_race_computes_nothing_and_touches_no_file(tmp_path):
    race(Bowl(), field(tmp_path), budget=BUDGET, gradient_cost=2.0)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")}
    objective, made = Bowl(), []
    again = [dataclasses.replace(entry, make=partial(made.append, entry)) for entry in field(tmp_path)]
    race(objective, again, budget=BUDGET, gradient_cost=2.0)
    assert (objective.asked, made) == (0, [])
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")} == before


def test_what_the_objective_raises_ends_all_runs():
    class Broken(Bowl):
        def evaluate(self, x, *, grad=True):
            if grad:
                raise ValueError("no gradients here")
            return super().evaluate(x, grad=grad)

    objective = Broken()
    with pytest.raises(ValueError, match="no gradients here"):
        race(objective, field(seeds=8), budget=BUDGET, gradient_cost=2.0)
    assert len(objective.batches) <= 1


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_a_method_that_breaks_or_is_interrupted_ends_all_runs(monkeypatch, error):
    def broken(self):
        raise error

    objective = Bowl()
    with monkeypatch.context() as patch:
        patch.setattr("gradscape.optim.methods.cmaes.CMAES._ask", broken)
        with pytest.raises(error):
            race(objective, field(), budget=BUDGET, gradient_cost=2.0)
    assert len(objective.batches) <= 2
    race(Bowl(), field(), budget=BUDGET, gradient_cost=2.0)  # and nothing of it is left


def test_seconds_are_a_runs_own_and_its_share_of_each_batch():
    class Slow(Bowl):
        def evaluate(self, x, *, grad=True):
            now[0] += 0.01 * len(x)
            return super().evaluate(x, grad=grad)

    now = [0.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gradscape.optim.lockstep.time", clock)
        entries = field()
        race(Slow(), entries, budget=BUDGET, gradient_cost=2.0)
    for entry in entries:
        assert entry.run.dataset()["seconds"].to_numpy()[-1] == pytest.approx(0.01 * BUDGET)


def test_what_a_gradient_costs_is_measured_once_before_the_race():
    objective, entries = Bowl(), field()
    race(objective, entries, budget=BUDGET)
    costs = {entry.run.gradient_cost for entry in entries if entry.method == "descents"}
    assert len(costs) == 1
    assert costs.pop() > 0


def test_progress_tells_which_run_it_is_of():
    entries, seen = field(), {}
    race(Bowl(), entries, budget=BUDGET, gradient_cost=2.0, progress=lambda e, now: seen.update({e: now}))
    assert {(e.method, e.seed): now.done for e, now in seen.items()} == {(e.method, e.seed): BUDGET for e in entries}
    assert all(now.best == e.run.best_loss for e, now in seen.items())
