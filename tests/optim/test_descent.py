import numpy as np
import pytest
import torch

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind
from gradscape.optim.methods.descent import Descent, DescentOptions, Descents, DescentsOptions
from gradscape.optim.methods.quasi_newton import LocalSearch
from gradscape.optim.search import search

SPACE = ParameterSpace.box(("x", "y"), -2.0, 4.0, "m")
BOWL = from_torch(lambda x: ((x - 1.0) ** 2 * torch.tensor([1.0, 3.0])).sum(dim=1), SPACE)


def path(descent: Descent, losses, grads) -> np.ndarray:
    """Tell a descent what it asks for until it ends, and return the iterates that it evaluated."""
    points = []
    while not descent.done:
        points.append(descent.at)
        descent.tell(losses(descent.at), grads(descent.at))
    return np.stack(points)


def test_a_descent_contracts_a_quadratic_at_the_exact_rate():
    curvature, step = np.array([1.0, 3.0, 7.0]), 0.1
    start = np.array([0.9, -0.5, 0.2])
    options = DescentOptions(step=step, max_step=1.0, steps=12)
    z = path(Descent(start, options), lambda z: 0.5 * (curvature * z**2).sum(), lambda z: curvature * z)
    rate = (1.0 - step * curvature) ** np.arange(12)[:, None]
    np.testing.assert_allclose(z, rate * start, rtol=1e-12)


def test_a_move_is_shortened_to_the_longest_allowed_and_keeps_its_direction():
    descent = Descent(np.zeros(2), DescentOptions(step=1.0, max_step=0.25))
    descent.tell(1.0, np.array([3e6, -6e6]))
    np.testing.assert_allclose(descent.at, [-0.125, 0.25])


def test_a_descent_stays_in_the_box_and_ends_where_the_border_stops_it():
    z = path(Descent(np.array([0.7, 0.0]), DescentOptions()), lambda z: -z[0], lambda z: np.array([-1.0, 0.0]))
    np.testing.assert_allclose(z[:, 0], [0.7, 0.9, 1.0])


def test_a_descent_ends_after_more_than_three_steps_without_improvement_and_only_then():
    losses = iter([5.0, 6.0, 7.0, 5.0, 4.0, 4.0, 4.0 - 1e-6, 4.0, 9.0, 1.0])
    z = path(Descent(np.zeros(1), DescentOptions(step=1e-3)), lambda z: next(losses), np.ones_like)
    assert len(z) == 9


def test_steps_shrink_where_the_loss_rises_and_nowhere_else():
    losses = iter([5.0, 6.0, 4.0, 7.0])
    descent = Descent(np.zeros(1), DescentOptions(step=1e-2, shrink=0.5, steps=5))
    moves = []
    for loss in losses:
        before = descent.at
        descent.tell(loss, np.ones(1))
        moves.append((before - descent.at)[0])
    np.testing.assert_allclose(moves, [1e-2, 0.5e-2, 0.5e-2, 0.25e-2])


def test_a_failed_episode_ends_a_descent_at_the_last_point_that_has_a_loss():
    descent = Descent(np.zeros(2), DescentOptions())
    descent.tell(3.0, np.array([0.1, 0.0]))
    descent.tell(np.inf, np.zeros(2))
    assert descent.done
    np.testing.assert_array_equal(descent.at, np.zeros(2))


def iterates(batch_size: int, budget: int) -> np.ndarray:
    """Return what descents evaluate, as descent, step, dim of the scaled box; all take their six steps."""
    options = DescentsOptions(batch_size=batch_size, step=0.01, max_step=2.0, steps=6)
    table = search(BOWL, Descents(SPACE, seed=3, options=options), budget=budget, gradient_cost=2.0).dataset()
    assert (table["kind"] == Kind.DESCENT).all()
    z = (table["x"].to_numpy() - 1.0) / 3.0
    rows = z.reshape(-1, batch_size, 2).swapaxes(0, 1)  # step of the search, descent -> descent, step of the search
    return rows.reshape(-1, 6, 2)


def test_descents_evaluated_together_are_those_evaluated_one_after_the_other():
    alone = iterates(batch_size=1, budget=24)
    np.testing.assert_allclose(alone[:, 1:], alone[:, :-1] * (1 - 0.01 * 18 * np.array([1, 3])), atol=1e-12)
    np.testing.assert_allclose(iterates(batch_size=4, budget=24), alone, atol=1e-12)


def test_a_zero_gradient_ends_a_descent_and_begins_another():
    flat = from_torch(lambda x: 0.0 * x.sum(dim=1), SPACE)
    table = search(flat, Descents(SPACE, seed=1), budget=40, gradient_cost=2.0).dataset()
    assert len(np.unique(table["x"], axis=0)) == 40


class HalfBlind(Objective):
    """A bowl that has no gradient in half of the box, nor at its minimum."""

    name = "half blind"
    space = ParameterSpace.box(("a", "b"), -1.0, 1.0)

    def evaluate(self, x, *, grad=True):
        missing = (x[:, :1] < 0) | (x == 0).all(dim=1, keepdim=True)
        return Evaluation.from_results(x.square().sum(dim=1) / 2, x.masked_fill(missing, torch.nan) if grad else None)


@pytest.mark.parametrize(
    "method",
    ["adam", "descents", "l-bfgs-b", "basin-hopping", "cma-es-gradient", "bo-descents", "bo-gradient", "bo-leap"],
)
def test_every_method_takes_losses_without_gradients_and_asks_for_no_nan(method):
    store = search(HalfBlind(), method, budget=60, gradient_cost=2.0)
    table = store.dataset()
    lacking = (table["status"] == Status.NO_GRADIENT).to_numpy()
    assert lacking.any()
    assert (table["status"] == Status.OK).any()
    assert np.isfinite(table["x"]).all()
    assert np.isfinite(table["loss"]).all()
    assert store.failed == 0
    assert store.best_loss == float(table["loss"].min())


def test_a_descent_ends_at_a_minimum_that_has_no_gradient_and_keeps_its_loss():
    options = DescentsOptions(step=1.0, max_step=10.0)
    run = search(HalfBlind(), Descents(HalfBlind.space, seed=0, options=options), budget=40, gradient_cost=2.0).read()
    assert run.best.loss == 0.0
    assert int(run.data["status"][run.best.episode - 1]) == Status.NO_GRADIENT
    started = Descent(np.array([0.5, 0.5]), options)
    started.tell(0.25, np.array([np.nan, np.nan]))
    assert (started.done, started.best) == (True, 0.25)
    np.testing.assert_array_equal(started.at, [0.5, 0.5])


def test_a_local_search_ends_where_there_is_no_gradient_at_its_best_point():
    local = LocalSearch(np.array([0.5, 0.5]), 100)
    local.tell(0.25, np.array([0.5, 0.5]))
    local.tell(7.0, np.array([np.nan, np.nan]))
    assert (local.done, local.failed, local.best_loss) == (True, True, 0.25)
    np.testing.assert_array_equal(local.best, [0.5, 0.5])


def test_descents_go_on_past_failures():
    class Cliff(Objective):
        space = SPACE

        def evaluate(self, x, *, grad=True):
            loss = torch.where(x[:, 0] < 1.0, torch.nan, x[:, 0])
            return Evaluation.from_results(loss, torch.tensor([[1.0, 0.0]]).expand(len(x), 2).double())

    table = search(Cliff(), Descents(SPACE, seed=0), budget=80, gradient_cost=2.0).dataset()
    assert int((table["status"] == Status.NONFINITE).sum()) > 5
    assert float(table["loss"].min()) < 1.5
