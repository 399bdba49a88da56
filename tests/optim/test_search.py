from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.cost import LONG, MOMENT, episode_cost
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind, NoOptions, Optimizer, Points, Proposal
from gradscape.optim.methods.cmaes import CMAES
from gradscape.optim.methods.random import RandomSearch
from gradscape.optim.runs.store import RunStore
from gradscape.optim.search import SearchProgress, search

from ..clock import Clock

SPACE = ParameterSpace(("a", "b", "c"), torch.tensor([-2.0, 0, 5]), torch.tensor([2.0, 9, 6]), ("m", "s", ""))


class Pit(Objective):
    """A bowl with a strip at its bottom where episodes fail; it counts what it is asked."""

    space, name = SPACE, "pit"

    def __init__(self, *, stop_after: int | None = None):
        self.batches: list[int] = []
        self.with_gradient = 0
        self.stop_after = stop_after

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        if self.stop_after is not None and len(self.batches) >= self.stop_after:
            raise KeyboardInterrupt
        self.batches.append(len(x))
        self.with_gradient += grad * len(x)
        u = SPACE.to_unit(x)
        failed = torch.where(u[:, 1] < 0.2, Status.ESCAPED, Status.OK)
        width = SPACE.upper - SPACE.lower
        return Evaluation.from_results((u**2).sum(dim=1), 2 * u / width if grad else None, failed)


class Mixed(Optimizer):
    """Alternate seven random points and one with its gradient, which it steps along."""

    name, needs_grad = "mixed", True
    Options = NoOptions

    def _setup(self) -> None:
        self.at = np.zeros((1, self.space.dim))
        self.turn = 0

    def _ask(self) -> Proposal:
        if self.turn % 2:
            return Proposal(torch.from_numpy(self.at), Kind.DESCENT, grad=True)
        return Proposal(torch.from_numpy(self.random.uniform(-1, 1, (7, self.space.dim))), Kind.POPULATION)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        self.turn += 1
        self.at = z[[np.argmin(loss)]] if grad is None else z - 0.1 * grad


METHODS = [RandomSearch, CMAES, Mixed]


def run_at(path: Path, kind: type[Optimizer] = CMAES, *, budget: int = 60) -> RunStore:
    identity = {"objective": "pit", "method": kind.name, "seed": 3}
    return RunStore.open_or_create(path, SPACE, identity=identity, budget=budget)


def filled(path: Path, kind: type[Optimizer], *, budget: int, objective: Pit | None = None) -> xr.Dataset:
    run = run_at(path, kind, budget=budget)
    search(objective or Pit(), kind(SPACE, seed=3), run, budget=budget, gradient_cost=3.0)
    return run.dataset().drop_vars("seconds")


def test_the_table_holds_the_objective_at_the_points_that_were_asked_for() -> None:
    table = search(Pit(), Mixed(SPACE), budget=40).dataset()
    wanted = Pit().evaluate(torch.from_numpy(table["x"].values))
    np.testing.assert_array_equal(table["loss"], wanted.loss)
    np.testing.assert_array_equal(table["status"], wanted.status)
    descent = table["kind"].values == Kind.DESCENT
    np.testing.assert_array_equal(table["grad"][descent], wanted.grad[descent])
    assert np.isnan(table["grad"][~descent]).all()
    np.testing.assert_array_equal(table["slope"][descent], wanted.grad[descent].norm(dim=1))
    assert (table["status"] == Status.ESCAPED).any()


@pytest.mark.parametrize("kind", METHODS)
@pytest.mark.parametrize("budget", [1, 16, 29, 30])
def test_the_budget_is_met_and_not_exceeded_by_one_episode(kind: type[Optimizer], budget: int) -> None:
    objective = Pit()
    run = search(objective, kind(SPACE), budget=budget, gradient_cost=2.0)
    assert sum(objective.batches) == run.count == budget
    assert run.dataset()["episodes"].values.tolist() == list(range(1, budget + 1))


@pytest.mark.parametrize("kind", METHODS)
def test_a_run_stopped_at_every_instant_ends_as_an_undisturbed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type[Optimizer]
) -> None:
    monkeypatch.setattr("gradscape.optim.runs.store.PAUSE", 0.0)
    monkeypatch.setattr("gradscape.optim.runs.store.SHARE", 1.0e9)  # write every time
    whole, stops = filled(tmp_path / "whole.zarr", kind, budget=45), 0
    while run_at(tmp_path / "run.zarr", kind, budget=45).count < 45:
        before = run_at(tmp_path / "run.zarr", kind, budget=45).count
        try:
            filled(tmp_path / "run.zarr", kind, budget=45, objective=Pit(stop_after=1))
        except KeyboardInterrupt:
            stops += 1
            assert run_at(tmp_path / "run.zarr", kind, budget=45).count > before  # nothing was computed twice
    assert stops >= 2
    xr.testing.assert_equal(run_at(tmp_path / "run.zarr", kind, budget=45).dataset().drop_vars("seconds"), whole)


@pytest.mark.parametrize("kind", METHODS)
def test_a_run_stopped_before_anything_was_written_begins_again(tmp_path: Path, kind: type[Optimizer]) -> None:
    for stop in (0, 1, 2):
        with pytest.raises(KeyboardInterrupt):
            filled(tmp_path / "run.zarr", kind, budget=45, objective=Pit(stop_after=stop))
        assert run_at(tmp_path / "run.zarr", kind, budget=45).count == 0
    xr.testing.assert_equal(
        filled(tmp_path / "run.zarr", kind, budget=45), filled(tmp_path / "whole.zarr", kind, budget=45)
    )


@pytest.mark.parametrize("kind", METHODS)
def test_a_run_continued_to_a_larger_budget_is_the_one_that_had_it_from_the_beginning(
    tmp_path: Path, kind: type[Optimizer]
) -> None:
    for budget in (5, 18, 19, 40):
        continued = filled(tmp_path / "run.zarr", kind, budget=budget)
    whole = filled(tmp_path / "whole.zarr", kind, budget=40)
    xr.testing.assert_identical(continued, whole)
    objective = Pit()
    assert filled(tmp_path / "run.zarr", kind, budget=19, objective=objective).sizes["evaluation"] == 40
    assert not objective.batches


def test_forward_equivalents_count_a_gradient_for_what_it_costs(tmp_path: Path) -> None:
    run, objective = run_at(tmp_path / "run.zarr", Mixed), Pit()
    search(objective, Mixed(SPACE, seed=3), run, budget=24, gradient_cost=2.5)
    assert run.dataset()["forwards"].values[[6, 7, 8, 23]].tolist() == [7.0, 9.5, 10.5, 28.5]
    assert objective.with_gradient == 3
    search(Pit(), Mixed(SPACE, seed=3), run, budget=60, gradient_cost=99.0)  # what was measured first stays
    assert run.dataset()["forwards"].values[-1] == 60 + 7 * 1.5
    assert RunStore.open(tmp_path / "run.zarr").gradient_cost == 2.5


class Timed(Pit):
    """A pit whose episodes take a hundredth of a second, three with their gradient, the first ones `late` more."""

    def __init__(self, clock: Clock, late: tuple[float, ...] = ()):
        super().__init__()
        self.clock, self.late = clock, iter(late)

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        self.clock.sleep((0.03 if grad else 0.01) * len(x) + next(self.late, 0.0))
        return super().evaluate(x, grad=grad)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in ("optim.lockstep", "landscapes.cost"):
        monkeypatch.setattr(f"gradscape.{module}.time", clock)
    return clock


def test_what_a_gradient_costs_is_measured_at_its_best_within_a_moment(clock: Clock) -> None:
    objective = Timed(clock, late=(0.2, 0.1, 0.004, 0.0, 0.0, 0.006))
    cost = episode_cost(objective)
    assert (cost.forward, cost.gradient) == (pytest.approx(0.01), pytest.approx(0.03))
    assert cost.ratio == pytest.approx(3.0)
    assert MOMENT <= clock.now < MOMENT + 0.04
    assert search(Timed(clock), Mixed(SPACE), budget=3).gradient_cost == pytest.approx(3.0)


def test_a_slow_first_episode_must_do(clock: Clock) -> None:
    objective = Timed(clock, late=(LONG,))
    assert episode_cost(objective).gradient == pytest.approx(0.03)
    assert objective.batches == [1, 1]


def test_seconds_add_up_to_the_time_it_took(clock: Clock) -> None:
    table = search(Timed(clock), RandomSearch(SPACE), budget=40).dataset()
    np.testing.assert_allclose(table["seconds"], np.minimum(np.arange(16, 64) // 16 * 0.16, 0.4)[:40])


def test_progress_counts_up_and_knows_the_best(tmp_path: Path) -> None:
    seen: list[SearchProgress] = []
    run = run_at(tmp_path / "run.zarr")
    search(Pit(), CMAES(SPACE, seed=3), run, budget=20, progress=seen.append)
    assert [now.done for now in seen] == [0, 7, 14, 20]
    assert np.isnan(seen[0].best)
    table = run.dataset()
    assert seen[2].best == float(table["loss"][:14].min())
    assert seen[-1].failed == int((table["status"] != Status.OK).sum())
    seen.clear()
    search(Pit(), CMAES(SPACE, seed=3), run, budget=20, progress=seen.append)
    assert [(now.done, now.resumed, now.total) for now in seen] == [(20, 20, 20)]
    seen.clear()
    search(Pit(), CMAES(SPACE, seed=3), run, budget=30, progress=seen.append)
    assert [(now.done, now.resumed) for now in seen[::3]] == [(14, 14), (30, 14)]  # two were told, one was short


def test_a_method_is_known_by_its_name_and_not_exchanged(tmp_path: Path) -> None:
    named = run_at(tmp_path / "named.zarr", budget=20)
    search(Pit(), "cma-es", named, budget=20)
    made = filled(tmp_path / "made.zarr", CMAES, budget=20)
    xr.testing.assert_identical(named.dataset().drop_vars("seconds"), made)
    with pytest.raises(ValueError, match="contains a run of cma-es, not of random"):
        search(Pit(), "random", named, budget=30)
    with pytest.raises(ValueError, match="no method is called 'cmaes'; did you mean cma-es"):
        search(Pit(), "cmaes", budget=3)


class Idle(RandomSearch):
    def _ask(self) -> Proposal:
        return Proposal(torch.zeros(0, 3, dtype=torch.float64), Kind.RANDOM)


class Sly(RandomSearch):
    def _ask(self) -> Proposal:
        return Proposal(torch.zeros(1, 3, dtype=torch.float64), Kind.RANDOM, grad=True)


def test_an_optimiser_that_breaks_the_contract_is_named() -> None:
    objective = from_torch(lambda x: (x**2).sum(dim=1), SPACE)
    with pytest.raises(ValueError, match="random proposed no point"):
        search(objective, Idle(SPACE), budget=3)
    with pytest.raises(ValueError, match="must set needs_grad = True"):
        search(objective, Sly(SPACE), budget=3)
