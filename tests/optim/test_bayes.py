import numpy as np
import pytest
import torch
from botorch.acquisition.analytic import UpperConfidenceBound

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind
from gradscape.optim.methods.bayes import BO, BODescents, BODescentsOptions
from gradscape.optim.methods.bo_leap import BOLeap
from gradscape.optim.search import search

from .states import model_of

SPACE = ParameterSpace.box(("x", "y"), -2.0, 4.0, "m")
BOWL = from_torch(lambda x: ((x - 1.5) ** 2).sum(dim=1) + (3 * x).cos().prod(dim=1), SPACE)


class Hole(Objective):
    """A bowl that fails over a third of the box."""

    space = SPACE

    def evaluate(self, x, *, grad=True):
        loss = torch.where(x[:, 0] < 0.0, torch.nan, ((x - 0.5) ** 2).sum(dim=1))
        return Evaluation.from_results(loss, 2 * (x - 0.5) if grad else None)


@pytest.mark.slow
@pytest.mark.parametrize("method", [BO, BODescents, BOLeap])
def test_the_process_sees_the_loss_of_every_point(method):
    optimizer = method(SPACE, seed=2)
    table = search(Hole(), optimizer, budget=40, gradient_cost=2.0).dataset()
    assert (table["status"] != Status.OK).any()
    known = len(optimizer.surrogate.z)  # a population that the budget cuts short is not told
    assert known > 30
    np.testing.assert_allclose(1.0 + 3.0 * optimizer.surrogate.z, table["x"][:known], atol=1e-12)
    np.testing.assert_array_equal(optimizer.surrogate.loss, table["loss"].fillna(np.inf)[:known])


def test_bo_evaluates_where_the_bound_of_all_it_knows_is_least_and_the_first_ten_at_random():
    optimizer = BO(SPACE, seed=1)
    table = search(BOWL, optimizer, budget=18).dataset()
    assert table["kind"].to_numpy().tolist() == 10 * [Kind.RANDOM] + 8 * [Kind.ACQUISITION]
    assert table["slope"].isnull().all()
    found = SPACE.to_unit(optimizer.ask().x)
    grid = torch.cartesian_prod(*2 * [torch.linspace(0.0, 1.0, 101, dtype=torch.float64)])
    bound = UpperConfidenceBound(model_of(optimizer.surrogate), beta=1.0, maximize=False)
    with torch.no_grad():
        assert bound(found[:, None]) >= bound(grid[:, None]).max() - 1e-6


def test_bo_descents_descends_from_each_proposal_and_proposes_anew_when_a_descent_ends():
    options = BODescentsOptions(steps=5, step=0.01, patience=5, initial=5)
    table = search(BOWL, BODescents(SPACE, seed=3, options=options), budget=15, gradient_cost=2.0).dataset()
    first = [Kind.RANDOM] + 4 * [Kind.DESCENT]
    later = [Kind.ACQUISITION] + 4 * [Kind.DESCENT]
    assert table["kind"].to_numpy().tolist() == first + later + later
    x, grad = table["x"].to_numpy(), table["grad"].to_numpy()
    move = np.clip(x - 9.0 * 0.01 * grad, -2.0, 4.0)  # 9: each parameter's half range, squared
    within = [i for i in range(14) if i % 5 != 4 and np.abs(9.0 * 0.01 * grad[i]).max() <= 0.6]
    assert len(within) > 5
    rising = np.diff(table["loss"].to_numpy()) > 0
    assert not rising[[i for i in range(14) if i % 5 != 4]].any()
    np.testing.assert_allclose(x[1:][within], move[within], atol=1e-12)
