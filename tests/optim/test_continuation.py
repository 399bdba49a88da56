"""Continuation: its path follows the smoothed gradient, leads past local minima, and keeps to its budget."""

import math
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

import gradscape as gs
from gradscape.envs.adapters import from_numpy, from_torch
from gradscape.jobs.race import RaceJob
from gradscape.jobs.watch import Watch
from gradscape.landscapes.objective import Objective
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind
from gradscape.optim.methods.continuation import Continuation, ContinuationOptions
from gradscape.optim.runs.store import RunStore
from gradscape.optim.search import search

SQUARE = ParameterSpace.box(("a", "b"), -1.0, 1.0)
LINE = ParameterSpace.box(("a",), -3.0, 3.0)
TARGET = torch.tensor([0.3, -0.2], dtype=torch.float64)
RIPPLES = from_torch(  # under a Gaussian of 20 % of a side its ripples have all but gone
    lambda x: (x - TARGET).square().sum(dim=1) + 0.1 * torch.sin(60 * x).sum(dim=1), SQUARE, name="ripples"
)
WELLS = from_torch(lambda x: ((x**2 - 1) ** 2 + 0.6 * x)[:, 0], LINE, name="wells")
CLIFF = from_torch(lambda x: torch.where(x[:, 0] < 0, math.nan, (x - TARGET).square().sum(dim=1)), SQUARE, name="cliff")


def told(optimizer: Continuation, objective: Objective) -> None:
    """Let an optimiser ask once, and tell it."""
    proposal = optimizer.ask()
    optimizer.tell(proposal.x, objective.evaluate(proposal.x, grad=proposal.grad))


@pytest.mark.parametrize("order", ["mixed", "zeroth"])
def test_a_strongly_smoothed_step_goes_down_the_bowl_and_not_down_the_ripples(order: str) -> None:
    """The smoothed loss is |x - t|^2 + a constant, whose gradient points at t; a step is 1.5 widths of 10 %."""
    astray = []
    for seed, place in enumerate(product((0.35, 0.45, 0.55), (0.48, 0.6, 0.65))):
        optimizer = Continuation(SQUARE, seed=seed, options=ContinuationOptions(order=order, pairs=500))
        optimizer.centre = np.array(place)
        told(optimizer, RIPPLES)
        moved, wanted = optimizer.centre - place, (TARGET.numpy() + 1) / 2 - place
        assert np.linalg.norm(moved) == pytest.approx(1.5 * 0.1 * math.sqrt(2))
        assert moved @ wanted > 0.9 * np.linalg.norm(moved) * np.linalg.norm(wanted)
        slope = RIPPLES.evaluate(2 * torch.tensor([place]) - 1).grad
        astray.append(float(slope[0].numpy() @ wanted) > 0)
    assert sum(astray) > 2  # where the gradient itself leads away


def test_it_finds_the_lower_of_two_wells_where_l_bfgs_b_from_the_same_start_does_not() -> None:
    """Under a Gaussian of 0.6 the wells x^4 - 2 x^2 + 0.6 x have one minimum, since 6 * 0.6^2 > 2."""
    lower = float(min(np.roots([4, 0, -4, 0.6]).real))
    for seed, start in enumerate((0.7, 1.0)):
        alone = minimize(lambda x: (x[0] ** 2 - 1) ** 2 + 0.6 * x[0], [start], method="L-BFGS-B", bounds=[(-3, 3)])
        assert alone.x[0] > 0.8
        optimizer = Continuation(LINE, seed=seed, options=ContinuationOptions(widths=8, pairs=50))
        optimizer.centre = np.array([(start + 3) / 6])
        run = search(WELLS, optimizer, budget=8 * 100 + 20, gradient_cost=1.0).read()  # no more than its first schedule
        assert run.best.x[0] == pytest.approx(lower, abs=1e-4)


@pytest.mark.parametrize("order", ["mixed", "zeroth"])
def test_a_budget_is_kept_to_and_a_run_goes_on_as_if_never_stopped(tmp_path: Path, order: str) -> None:
    options = ContinuationOptions(order=order)
    identity = {"objective": "ripples", "method": "continuation", "seed": 3}
    parted = RunStore.open_or_create(tmp_path / "parted", SQUARE, identity=identity, budget=7)
    for budget in (1, 8, 60):  # within the first pairs, after them, and within L-BFGS-B
        parted = RunStore.open_or_create(tmp_path / "parted", SQUARE, identity=identity, budget=budget)
        search(RIPPLES, Continuation(SQUARE, seed=3, options=options), parted, budget=budget, gradient_cost=2.0)
        assert parted.count == budget
    whole = search(RIPPLES, Continuation(SQUARE, seed=3, options=options), budget=60, gradient_cost=2.0)
    kept, wanted = parted.dataset(), whole.dataset()
    for column in ("x", "loss", "forwards", "kind"):
        np.testing.assert_array_equal(kept[column], wanted[column])
    assert set(wanted["kind"].to_numpy()) == {Kind.POPULATION} | ({Kind.DESCENT} if order == "mixed" else set())


def test_failed_episodes_push_away_and_end_nothing() -> None:
    """Half of the box fails; points beyond the bounds are mirrored into it."""
    run = search(CLIFF, Continuation(SQUARE, seed=1), budget=200, gradient_cost=1.0).read()
    losses, x = run.data["loss"].to_numpy(), run.data["x"].to_numpy()
    assert np.isnan(losses).any()
    assert np.abs(x).max() <= 1.0
    assert np.nanmin(losses) < 1e-12
    broken = from_torch(lambda x: x.sum(dim=1) * math.nan, SQUARE, name="broken")
    assert search(broken, Continuation(SQUARE, seed=1), budget=200, gradient_cost=1.0).count == 200


def test_losses_whose_gradients_are_nan_are_followed_by_their_differences() -> None:
    bare = from_torch(
        lambda x: (x - TARGET).square().sum(dim=1) + 0 * (x * 0).abs().sqrt().sum(dim=1), SQUARE, name="bare"
    )
    assert not bare.evaluate(TARGET[None]).has_gradient.any()
    run = search(bare, Continuation(SQUARE, seed=2), budget=150, gradient_cost=1.0).read()
    assert run.best.loss < 1e-3


def test_a_function_without_gradients_is_never_asked_for_them(tmp_path: Path) -> None:
    bowl = from_numpy(lambda x: ((x - TARGET.numpy()) ** 2).sum(axis=1), SQUARE, name="bowl")
    with pytest.raises(ValueError, match="without gradients"):
        gs.optimize(bowl, "continuation", budget=20)
    assert gs.optimize(bowl, "continuation", budget=200, method_options={"order": "zeroth"}).best.loss < 1e-3
    options = {"continuation": {"order": "zeroth"}}
    job = RaceJob.of(bowl, ["random", "continuation"], budget=30, seeds=2, command="", options=options, out=tmp_path)
    assert sum(one.gradients for one in job.work()) == 0
    assert job.compute(Watch()).statistics.ranks[0].forwards == 30


def test_schedules_begin_at_the_best_point_until_they_bring_less_than_the_floor() -> None:
    """With a floor above all losses nothing is progress: each random start has its first schedule and the halvings."""
    options = ContinuationOptions(floor=100.0, halvings=2, evaluations=2, widths=1)
    optimizer, widths = Continuation(SQUARE, seed=4, options=options), []
    for _ in range(60):
        if optimizer.level == 0:
            widths.append(optimizer.width)
        told(optimizer, RIPPLES)
    assert widths[:8] == pytest.approx([0.1, 0.1, 0.05, 0.025] * 2)  # from no loss at all any is progress
