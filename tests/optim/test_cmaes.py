import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scipy.stats import special_ortho_group

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind, Points
from gradscape.optim.methods.cmaes import CMAES, CMAESOptions, Normal
from gradscape.optim.search import search

from .states import restored

BOX = ParameterSpace.box(("a", "b", "c"), -1.0, 1.0)
SCALES = torch.tensor([1.0, 5.0, 25.0], dtype=torch.float64)


def ellipsoid(x: torch.Tensor) -> torch.Tensor:
    return ((SCALES * x) ** 2).sum(dim=1)


def objective(loss: Callable[[torch.Tensor], torch.Tensor], space: ParameterSpace = BOX) -> Objective:
    return from_torch(loss, space, name="test")


def points(loss: Callable[[torch.Tensor], torch.Tensor], *, seed: int = 0, budget: int = 300) -> Points:
    table = search(objective(loss), CMAES(BOX, seed=seed), budget=budget).dataset()
    assert (table["kind"] == Kind.POPULATION).all()
    return table["x"].to_numpy()


def test_it_finds_the_minimum_of_an_ellipsoid_to_many_digits() -> None:
    run = search(objective(ellipsoid), CMAES(BOX), budget=700)
    assert run.best_loss < 1e-9


def test_losses_matter_by_their_order_only() -> None:
    same = points(lambda x: torch.log(ellipsoid(x)) ** 3 - 7)
    np.testing.assert_array_equal(points(ellipsoid), same)
    assert not np.array_equal(points(lambda x: -ellipsoid(x)), same)


class Turned:
    """Draw, for a search in a space turned by R, the very samples of the search in the space as it was.

    A sample is B D z with C = B D^2 B^T. The eigenvectors B are known but for their signs, so z is turned along.
    """

    def __init__(self, twin: CMAES, own: CMAES, R: Points) -> None:
        self.twin, self.own, self.R = twin, own, R
        self.normal = Normal(np.random.default_rng(5))

    def __call__(self, *shape: int) -> Points:
        z = self.normal(*shape)
        return z @ (self.own.strategy.sm.B.T @ self.R @ self.twin.strategy.sm.B).T


def started(at: Points, seed: int = 5) -> CMAES:
    """A search that starts at a point in the middle of the box, small enough to stay where the fold is straight."""
    optimizer = CMAES(BOX, options=CMAESOptions(sigma=0.05, population=8))
    optimizer.strategy.mean[:] = at
    optimizer.strategy.opts["randn"] = optimizer.strategy.sm.randn = Normal(np.random.default_rng(seed))
    return optimizer


def test_turning_the_space_turns_the_search() -> None:
    R = special_ortho_group(3, seed=2).rvs()
    center = torch.tensor([0.2, -0.1, 0.15], dtype=torch.float64)
    turned = torch.from_numpy(R)
    plain, twin = started(np.zeros(3)), started(np.zeros(3))
    C, B = twin.strategy.sm.C, twin.strategy.sm.B  # not quite the identity: the library keeps eigenvalues apart
    twin.strategy.sm.C, twin.strategy.sm.B = R @ C @ R.T, R @ B
    twin.strategy.sm.randn = twin.strategy.opts["randn"] = Turned(plain, twin, R)
    largest = 0.0
    for generation in range(60):
        y, x = plain.ask().x, twin.ask().x  # in this order: B is brought up to date by asking
        np.testing.assert_allclose(x, y @ turned.T, atol=1e-9, err_msg=f"generation {generation}")
        loss = ellipsoid(y - center)
        ok = torch.full((len(y),), Status.OK)
        plain.tell(y, Evaluation(loss, None, ok))
        twin.tell(x, Evaluation(ellipsoid(x @ turned - center), None, ok))
        largest = max(largest, float(y.abs().max()))
    assert largest < 0.9  # where the box's fold begins
    assert plain.strategy.sm.condition_number > 10  # so it is not the round distribution that is turned
    assert float(loss.min()) < 1e-4


def test_every_sample_is_inside_the_box_even_where_the_loss_falls_beyond_it() -> None:
    x = points(lambda x: -x.sum(dim=1), budget=400)
    assert np.abs(x).max() <= 1.0
    assert x[-50:].min() > 0.99  # at the corner
    assert (np.abs(x) == 1.0).mean() < 0.05  # folded, not clamped to the border


@pytest.mark.slow
def test_it_begins_again_elsewhere_when_it_has_converged() -> None:
    two = torch.tensor([[0.5, 0.5, 0.5], [-0.5, -0.5, -0.5]], dtype=torch.float64)
    x = points(lambda x: torch.cdist(x, two).min(dim=1).values ** 2, budget=3000)
    near = [int((np.abs(x - at).max(axis=1) < 1e-6).sum()) for at in two.numpy()]
    assert min(near) > 50
    assert len({tuple(row) for row in x}) == len(x)


@pytest.mark.slow
def test_a_flat_landscape_is_searched_all_over() -> None:
    x = points(lambda x: 0 * x.sum(dim=1), budget=1000)
    assert np.histogramdd(x, bins=3, range=[(-1, 1)] * 3)[0].min() > 0


def test_failed_episodes_push_the_search_away() -> None:
    class Cliff(Objective):
        space, name = BOX, "cliff"

        def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
            return Evaluation.from_results(x.sum(dim=1), None, torch.where(x[:, 0] < 0, Status.ESCAPED, Status.OK))

    table = search(Cliff(), CMAES(BOX, seed=4), budget=600).dataset()
    assert (table["status"] != Status.OK).any()
    assert float(table["loss"].min()) == pytest.approx(-2.0, abs=1e-3)  # a = 0, b = c = -1


def test_a_seed_decides_every_point_even_beside_other_searches() -> None:
    alone = [points(ellipsoid, seed=seed) for seed in range(4)]
    before = np.random.get_state()[1].copy()
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(lambda seed: points(ellipsoid, seed=seed), range(4)))
    np.testing.assert_array_equal(alone, together)
    np.testing.assert_array_equal(np.random.get_state()[1], before)
    assert not np.array_equal(alone[0], alone[1])


@pytest.mark.slow
def test_a_restored_search_goes_on_bit_for_bit_past_restarts() -> None:
    one = CMAES(BOX, seed=2)
    for _ in range(150):
        again = restored(one, objective(ellipsoid))
        proposal = one.ask()
        assert torch.equal(again.ask().x, proposal.x)
        one.tell(proposal.x, Evaluation.from_results(ellipsoid(proposal.x), None))


def test_where_the_library_draws_other_points_it_goes_on_with_those_of_the_run() -> None:
    one = CMAES(BOX, seed=2)
    for _ in range(5):
        proposal = one.ask()
        one.tell(proposal.x, Evaluation.from_results(ellipsoid(proposal.x), None))
    state = one.state()
    state["own"]["points"] += 1e-9
    with pytest.warns(RuntimeWarning, match="continues with the points and losses of the run"):
        again = CMAES.from_state(objective(ellipsoid), state)
    assert again.strategy.best.f == one.strategy.best.f
    near = 3 * one.strategy.sigma  # not the same mean: points that were folded into the box are unfolded differently
    assert bool(((again.ask().x - one.ask().x).mean(dim=0).abs() < near).all())


def test_nothing_is_printed_written_or_warned_of(tmp_path, monkeypatch, capfd) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cma_signals.in").write_text("{'timeout': 0}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        points(lambda x: 1e300 * ellipsoid(x), budget=400)
    assert capfd.readouterr() == ("", "")
    assert [path.name for path in tmp_path.iterdir()] == ["cma_signals.in"]


def test_options_reach_the_library() -> None:
    optimizer = CMAES(BOX, options=CMAESOptions(sigma=0.1, population=12))
    assert optimizer.strategy.sigma == 0.1
    assert len(optimizer.ask().x) == 12
    assert len(CMAES(BOX).ask().x) == 4 + int(3 * np.log(3))
