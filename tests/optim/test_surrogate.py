import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from botorch.acquisition.analytic import UpperConfidenceBound
from botorch.optim.closures import get_loss_closure_with_grads
from gpytorch.kernels import MaternKernel
from gpytorch.mlls import ExactMarginalLogLikelihood

from gradscape.optim.methods import process
from gradscape.optim.methods.process import GROWTH, Process, closure_of, covariance_of
from gradscape.optim.methods.surrogate import LowerBound, Surrogate, SurrogateOptions
from gradscape.optim.runs.store import decode, encode

from .states import model_of, proposal_of


def waves(z: np.ndarray) -> np.ndarray:
    return 30.0 + 5.0 * np.sin(4.0 * z).sum(axis=1) + 8.0 * (z**2).sum(axis=1)


def informed(count: int = 40, dim: int = 2, **options) -> Surrogate:
    surrogate = Surrogate(dim, SurrogateOptions(initial=1, **options))
    z = np.random.default_rng(1).uniform(-1.0, 1.0, (count, dim))
    surrogate.add(z, waves(z))
    return surrogate


@pytest.mark.parametrize("count", [5, 40])
@pytest.mark.parametrize("kernel", ["rbf", "matern"])
def test_the_bounds_argmin_agrees_with_a_dense_grid(count, kernel):
    surrogate = informed(count, kernel=kernel)
    axis = torch.linspace(0.0, 1.0, 201, dtype=torch.float64)
    grid = torch.cartesian_prod(axis, axis)
    found = torch.from_numpy(proposal_of(surrogate) + 1.0)[None] / 2.0
    bound = UpperConfidenceBound(model_of(surrogate), beta=1.0, maximize=False)
    with torch.no_grad():
        values, value = -bound(grid[:, None]), -bound(found[:, None])
    assert value <= values.min() + 1e-6 * (values.max() - values.min())
    assert (found - grid[values.argmin()]).abs().max() < 0.006


def going_on(surrogate: Surrogate, first: int) -> Process:
    """Return the process of a surrogate as one that continues from the factor of its first points."""
    return replace(surrogate.process(), first=first)


@pytest.mark.parametrize("first", [30, 40])
@pytest.mark.parametrize("kernel", ["rbf", "matern"])
def test_the_bound_its_slopes_and_the_posterior_are_those_of_botorch(kernel, first):
    surrogate = informed(kernel=kernel)
    model = model_of(surrogate)
    points = torch.rand(7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    wanted = -UpperConfidenceBound(model, beta=2.5**2, maximize=False)(points[:, None])
    (slopes,) = torch.autograd.grad(wanted.sum(), points)
    bound, scale = LowerBound(going_on(surrogate, first), 2.5), model.outcome_transform
    value, slope = bound.with_slope(points.detach())
    torch.testing.assert_close(scale.untransform(value[:, None])[0][:, 0], wanted.detach(), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(scale.stdvs[0] * slope, slopes, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(bound(points.detach()), value)
    mean, covariance = going_on(surrogate, first).posterior(points.detach())
    whole = model.posterior(points.detach())
    torch.testing.assert_close(scale.untransform(mean[:, None])[0], whole.mean.detach(), rtol=1e-9, atol=1e-9)
    theirs = whole.distribution.covariance_matrix.detach()
    torch.testing.assert_close(covariance * scale.stdvs[0] ** 2, theirs, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("kernel", ["rbf", "matern"])
def test_fits_climb_the_likelihood_that_botorch_has(kernel):
    model = model_of(informed(kernel=kernel))
    likelihood = ExactMarginalLogLikelihood(model.likelihood, model).train()
    parameters = dict(likelihood.named_parameters())
    for factor in (1.0, 1.7):  # where the last fit ended, and elsewhere
        with torch.no_grad():
            for parameter in parameters.values():
                parameter.mul_(factor)
        wanted, slopes = get_loss_closure_with_grads(likelihood, parameters)()
        value, found = closure_of(likelihood)()
        torch.testing.assert_close(value, wanted.detach(), rtol=1e-9, atol=1e-9)
        for one, other in zip(found, slopes, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-7)


def test_a_covariance_that_is_not_radial_is_refused():
    with pytest.raises(ValueError, match="or a MaternKernel of 5/2; got"):
        covariance_of(MaternKernel(nu=0.5))


def test_losses_of_another_scale_are_searched_alike():
    """The bound is searched in deviations of the losses, so that small losses are no reason to stop early."""

    def least(scale: float) -> np.ndarray:
        surrogate = informed()
        surrogate.loss = scale * surrogate.loss
        return proposal_of(surrogate)

    np.testing.assert_array_equal(least(2.0**-20), least(1.0))


def test_more_exploration_goes_further_from_what_is_known():
    def distance(coefficient: float) -> float:
        surrogate = informed(15, coefficient=coefficient)
        return np.linalg.norm(surrogate.z - proposal_of(surrogate), axis=1).min()

    assert distance(20.0) > 2.0 * distance(0.0)


def test_a_failure_counts_as_the_worst_loss():
    surrogate, plain = informed(20), informed(20)
    worst, failed = plain.loss.argmax(), plain.loss.argmin()
    surrogate.loss[failed], plain.loss[failed] = np.inf, plain.loss[worst]
    z = [proposal_of(one) for one in (surrogate, plain)]
    np.testing.assert_array_equal(*z)


@pytest.mark.parametrize("loss", [[3.0], [2.0, 2.0, 2.0], [1e6, 0.0, 1e-9], [np.inf, 5.0]])
def test_few_equal_and_wildly_different_losses_are_no_obstacle(loss):
    surrogate = Surrogate(3, SurrogateOptions(initial=1))
    surrogate.add(np.random.default_rng(0).uniform(-1, 1, (len(loss), 3)), np.array(loss))
    z = proposal_of(surrogate)
    assert np.isfinite(z).all()
    assert (np.abs(z) <= 1.0).all()


def test_points_are_drawn_at_random_until_there_are_enough_and_one_has_a_loss():
    def drawn(count: int, loss: float) -> list[np.ndarray]:
        surrogate = Surrogate(2, SurrogateOptions(initial=4))
        z = np.random.default_rng(1).uniform(-1.0, 1.0, (count, 2))
        surrogate.add(z, loss + waves(z))
        assert surrogate.informed == (count == 4 and loss < np.inf)
        return [proposal_of(surrogate, seed) for seed in (0, 1)]

    np.testing.assert_array_equal(drawn(0, 0.0), drawn(3, 0.0))
    np.testing.assert_array_equal(drawn(0, 0.0), drawn(4, np.inf))
    assert not np.array_equal(drawn(3, 0.0), drawn(4, 0.0))


def test_every_point_is_modelled_up_to_the_most_and_the_best_half_and_a_spread_past_it():
    assert len(model_of(informed(50, max_points=50)).train_targets) == 50
    surrogate = informed(100, max_points=20)
    kept = set(map(tuple, 2.0 * model_of(surrogate).train_inputs[0].numpy() - 1.0))
    order = np.argsort(surrogate.loss)
    assert len(kept) == int(20 / GROWTH)  # with room for those to come

    def held(rows: np.ndarray) -> np.ndarray:
        return np.array([any(np.allclose(surrogate.z[row], one) for one in kept) for row in rows])

    assert held(order[:9]).all()
    others = np.sort(order[9:])
    assert np.diff(np.flatnonzero(held(others))).max() <= 12


def test_hyper_parameters_are_kept_until_the_data_have_grown_by_a_tenth():
    surrogate = informed(40)
    before = model_of(surrogate).covar_module.lengthscale.tolist()
    z = np.random.default_rng(9).uniform(-1.0, 1.0, (4, 2))
    surrogate.add(z[:3], 100.0 * waves(z[:3]))
    assert model_of(surrogate).covar_module.lengthscale.tolist() == before
    surrogate.add(z[3:], 100.0 * waves(z[3:]))
    assert len(surrogate.loss) >= GROWTH * 40
    assert model_of(surrogate).covar_module.lengthscale.tolist() != before


def test_its_state_is_whole_and_it_leaves_no_trace_in_global_generators_or_warning_filters():
    surrogate = informed(43)
    model_of(surrogate)
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), list(warnings.filters)
    copy = Surrogate(2, surrogate.options)
    copy.restore(decode(encode(surrogate.state())))
    z = [proposal_of(one, 4) for one in (surrogate, copy)]
    np.testing.assert_array_equal(*z)
    assert torch.equal(before[0], torch.get_rng_state())
    np.testing.assert_array_equal(before[1], np.random.get_state()[1])
    assert before[2] == warnings.filters


def test_threads_find_what_one_alone_finds():
    def lowest(seed: int) -> list[np.ndarray]:
        surrogate = informed(30 + seed)
        return [proposal_of(surrogate, seed) for _ in range(3)]

    alone = [lowest(seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as executor:
        np.testing.assert_array_equal(list(executor.map(lowest, range(4))), alone)


@pytest.mark.parametrize("first", [1, 30, 39, 40])
def test_a_bound_goes_on_from_the_factor_of_the_first_points(first):
    surrogate = Surrogate(3, SurrogateOptions())
    z = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 3))
    surrogate.add(z, (z**2).sum(axis=1))
    points = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    whole = going_on(surrogate, first)
    found = [LowerBound(whole, 1.5)(points) for _ in range(2)]
    torch.testing.assert_close(found[0], LowerBound(surrogate.process(), 1.5)(points), rtol=1e-9, atol=1e-9)
    assert torch.equal(*found)  # the factor was kept
    process._factors.clear()
    assert torch.equal(LowerBound(whole, 1.5)(points), found[0])  # and is the same when it was not
    for count in (first, 20, 40, 35, 40):  # with fewer points known since, more, and others
        known = max(count, first)
        part = replace(whole, u=whole.u[:known], values=whole.values[:known])
        LowerBound(part, 1.5)
    assert torch.equal(LowerBound(whole, 1.5)(points), found[0])
    others = torch.cat([whole.u[:first], whole.u[first:].flip(0)])
    flipped = LowerBound(
        replace(whole, u=others, values=torch.cat([whole.values[:first], whole.values[first:].flip(0)])), 1.5
    )
    torch.testing.assert_close(flipped(points), found[0], rtol=1e-9, atol=1e-9)


def test_factors_of_other_processes_are_told_apart():
    points = torch.rand(20, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    z = np.random.default_rng(1).uniform(-1.0, 1.0, (30, 2))
    bounds = []
    for kernel in ("rbf", "matern"):
        surrogate = Surrogate(2, SurrogateOptions(kernel=kernel))
        surrogate.add(z, np.sin(5 * z).sum(axis=1))
        bounds.append([LowerBound(going_on(surrogate, first), 1.0)(points) for first in (20, 30)])
    for kept, whole in bounds:
        torch.testing.assert_close(kept, whole, rtol=1e-8, atol=1e-8)


def test_a_full_process_makes_room_and_keeps_every_point_that_comes_until_it_is_full_again():
    surrogate = informed(40, max_points=44)
    model_of(surrogate)
    random, fits = np.random.default_rng(3), []
    for _ in range(30):
        z = random.uniform(-1.0, 1.0, (1, 2))
        surrogate.add(z, waves(z))
        known = surrogate.process().u
        assert len(known) <= 44
        assert torch.equal(known[-1], torch.from_numpy(z[0] + 1.0) / 2.0)
        fits.append(len(surrogate._chosen))
    assert len(set(fits)) > 1  # it was chosen again
    assert len(set(fits)) < 8  # and not for every point
