"""The rivals of BO-Leap: each against its library or paper, on functions whose minima are known."""

import math

import numpy as np
import pytest
import torch
from botorch.optim.closures import get_loss_closure_with_grads
from gpytorch.mlls import ExactMarginalLogLikelihood
from scipy.optimize import Bounds, basinhopping, minimize

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind
from gradscape.optim.methods.bayes import BO, BOGradient, GradientProcess, TuRBO, TuRBOOptions, region, standardised
from gradscape.optim.methods.cmaes import CMAES, CMAESGradient
from gradscape.optim.methods.continuation import Continuation
from gradscape.optim.methods.descent import Adam, AdamOptions
from gradscape.optim.methods.process import GradientCovariance, Process, closure_of, covariance_of
from gradscape.optim.methods.quasi_newton import LBFGSB, BasinHopping
from gradscape.optim.methods.surrogate import LowerBound, Surrogate, SurrogateOptions
from gradscape.optim.search import search

FEW = {BOGradient: 30}  # episodes are enough for it, each of which it thinks long of
RIVALS = [LBFGSB, BasinHopping, Adam, CMAESGradient, TuRBO, BOGradient]


def rosenbrock(x):
    return (100.0 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1.0 - x[:, :-1]) ** 2).sum(dim=1)


def rastrigin(x):
    return (x**2 - 10.0 * torch.cos(2.0 * math.pi * x) + 10.0).sum(dim=1)


def branin(x):
    a, b = x[:, 0], x[:, 1]
    valley = b - 5.1 / (4 * math.pi**2) * a**2 + 5.0 / math.pi * a - 6.0
    return valley**2 + 10.0 * (1.0 - 1.0 / (8.0 * math.pi)) * torch.cos(a) + 10.0


VALLEY = from_torch(rosenbrock, ParameterSpace.box(("a", "b", "c"), -2.0, 2.0), name="rosenbrock")
EGGS = from_torch(rastrigin, ParameterSpace.box(("a", "b"), -4.0, 5.0), name="rastrigin")
SPACE = ParameterSpace(("a", "b"), torch.tensor([-5.0, 0.0]), torch.tensor([10.0, 15.0]), ("", ""))
BRANIN = from_torch(branin, SPACE, name="branin")


def scaled(objective):
    """Return a function of the box scaled to [-1, 1], as scipy takes it, and the list of points it is asked for."""
    space, asked = objective.space, []
    half = ((space.upper - space.lower) / 2).numpy()

    def at(z):
        asked.append(z.copy())
        x = torch.clamp(space.from_unit((torch.from_numpy(z)[None] + 1.0) / 2.0), space.lower, space.upper)
        found = objective.evaluate(x, grad=True)
        return float(found.loss[0]), found.grad[0].numpy() * half

    return at, asked


def evaluated(objective, optimizer, budget):
    """Return the points that a search evaluated, in the scaled box, and their losses."""
    table = search(objective, optimizer, budget=budget, gradient_cost=1.0).dataset()
    x = torch.from_numpy(table["x"].to_numpy())
    return (2.0 * objective.space.to_unit(x) - 1.0).numpy(), table["loss"].to_numpy()


@pytest.mark.parametrize("kind", [*RIVALS, Continuation])
def test_minima_are_found(kind):
    _, losses = evaluated(BRANIN, kind.on(BRANIN, seed=1), FEW.get(kind, 200))
    assert losses.min() == pytest.approx(0.397887, abs=0.05 if kind in (Adam, TuRBO) else 1e-3)


@pytest.mark.parametrize("kind", RIVALS)
def test_points_stay_in_the_box_and_failures_end_nothing(kind):
    cliff = from_torch(lambda x: torch.where(x[:, 0] < 0, math.nan, x.sum(dim=1)), EGGS.space, name="cliff")
    z, losses = evaluated(cliff, kind.on(cliff, seed=3), FEW.get(kind, 100))
    assert np.abs(z).max() <= 1.0
    assert np.isnan(losses).any()
    reached = -1.0 if kind in (LBFGSB, BasinHopping) else -3.0  # searches end at the cliff, of which they see no slope
    assert np.nanmin(losses) < reached  # at best -4: a = 0, b = -4


def test_l_bfgs_b_evaluates_scipys_points_and_begins_again():
    optimizer = LBFGSB.on(VALLEY, seed=4)
    at, asked = scaled(VALLEY)
    done = minimize(at, optimizer.local.start, jac=True, method="L-BFGS-B", bounds=Bounds([-1.0] * 3, [1.0] * 3))
    assert done.success
    assert done.fun < 1e-9
    z, losses = evaluated(VALLEY, optimizer, len(asked) + 5)
    np.testing.assert_allclose(z[: len(asked)], asked, atol=1e-12)
    assert losses[len(asked)] > 1.0  # elsewhere
    short = LBFGSB.on(VALLEY, seed=4, options=LBFGSB.Options(evaluations=5))
    z, _ = evaluated(VALLEY, short, 12)
    assert np.abs(np.diff(z, axis=0)).max(axis=1)[4:8].max() > 0.1


def test_basin_hopping_evaluates_scipys_points():
    optimizer = BasinHopping.on(EGGS, seed=5, options=BasinHopping.Options(temperature=3.0))
    at, asked = scaled(EGGS)
    twin = np.random.default_rng(0)
    twin.bit_generator.state = optimizer.random.bit_generator.state
    local = {"method": "L-BFGS-B", "jac": True, "bounds": Bounds([-1.0] * 2, [1.0] * 2), "options": {"maxfun": 200}}
    basinhopping(at, optimizer.local.start, niter=120, T=3.0, stepsize=0.5, minimizer_kwargs=local, rng=twin)
    z, _ = evaluated(EGGS, optimizer, 1000)
    assert len(asked) > 1000
    assert optimizer.hops > 60  # so that the length of hops has been adapted
    assert optimizer.length != 0.5
    np.testing.assert_allclose(z, np.clip(asked[:1000], -1.0, 1.0), atol=1e-9)


def test_adam_takes_torchs_steps():
    optimizer = Adam.on(VALLEY, seed=6, options=AdamOptions(batch_size=1, rate=0.02, patience=1000))
    at, _ = scaled(VALLEY)
    z = torch.from_numpy(optimizer.descents[0].at.copy())
    adam = torch.optim.Adam([z], lr=0.02)
    wanted = []
    for _ in range(100):
        wanted.append(z.numpy().copy())
        z.grad = torch.from_numpy(at(wanted[-1])[1])
        adam.step()
        z.clamp_(-1.0, 1.0)
    found, _ = evaluated(VALLEY, optimizer, 101)
    np.testing.assert_allclose(found[:100], wanted, atol=1e-12)
    assert np.abs(found[100] - wanted[-1]).max() > 0.05  # another start


def test_adam_ends_where_the_loss_stalls():
    flat = from_torch(lambda x: 0.0 * x.sum(dim=1) + 1.0, EGGS.space, name="flat")
    z, _ = evaluated(flat, Adam.on(flat, seed=7, options=AdamOptions(batch_size=1, patience=3)), 20)
    assert len(np.unique(z, axis=0)) == 4  # a start is evaluated once, and four times without improvement


def test_injected_gradients_speed_cma_es_up_on_a_bowl():
    space = ParameterSpace.box([f"x{n}" for n in range(10)], -1.0, 2.0)
    bowl = from_torch(lambda x: (x**2).sum(dim=1), space, name="bowl")
    plain, injected = (
        np.median([evaluated(bowl, kind.on(bowl, seed=seed), 300)[1].min() for seed in range(5)])
        for kind in (CMAES, CMAESGradient)
    )
    assert injected < 0.2 * plain  # 65 times less over eight seeds


def test_the_mean_is_evaluated_before_each_population_and_its_step_is_a_member():
    optimizer = CMAESGradient.on(EGGS, seed=9, options=CMAESGradient.Options(sigma=0.02))
    for _ in range(10):
        mean = optimizer.ask()
        assert (mean.kind, mean.grad, len(mean.x)) == (Kind.DESCENT, True, 1)
        optimizer.tell(mean.x, EGGS.evaluate(mean.x, grad=True))
        step, population = optimizer._injected[-1], optimizer.ask()
        assert population.grad is False
        z = (2.0 * EGGS.space.to_unit(population.x) - 1.0).numpy()
        down = z[0] - (2.0 * EGGS.space.to_unit(mean.x) - 1.0).numpy()[0]
        wanted = step - (2.0 * EGGS.space.to_unit(mean.x) - 1.0).numpy()[0]
        assert down @ wanted > 0.9 * np.linalg.norm(down) * np.linalg.norm(wanted)
        optimizer.tell(population.x, EGGS.evaluate(population.x, grad=False))


def test_the_trust_region_is_as_wide_as_it_says_and_longer_where_the_loss_changes_slowly():
    surrogate = Surrogate(3, SurrogateOptions(kernel="matern"))
    surrogate.add(np.zeros((4, 3)) + 0.1 * np.eye(4, 3), np.array([3.0, 1.0, 2.0, 4.0]))
    points = region(surrogate, np.array([0.5, 1.0, 2.0]), 0.2, 4000, np.random.default_rng(0))
    best, side = np.array([0.5, 0.55, 0.5]), np.array([0.05, 0.1, 0.2])
    np.testing.assert_allclose(points.min(axis=0), best - side, atol=1e-3)
    np.testing.assert_allclose(points.max(axis=0), best + side, atol=1e-3)


def test_the_trust_region_grows_with_successes_shrinks_with_failures_and_begins_anew():
    optimizer = TuRBO.on(EGGS, seed=10)
    told = iter([*[9.0] * 1, 8.0, 7.0, 6.0, *[6.0] * 9])
    lengths = []
    for loss in told:
        x = optimizer.ask().x
        optimizer.tell(x, EGGS.evaluate(x, grad=False).__class__(torch.full((len(x),), loss), None, torch.ones(len(x))))
        lengths.append(optimizer.length)
    assert lengths == [0.8, 0.8, 0.8, 1.6, 0.8, 0.4, 0.2, 0.1, 0.05, 0.025, 0.0125, 0.8, 0.8]
    assert len(optimizer.surrogate.loss) == 4  # the first points of the next search


def test_thompson_samples_follow_the_process():
    optimizer = TuRBO.on(BRANIN, seed=11, options=TuRBOOptions(batch_size=64, candidates=500))
    for _ in range(4):
        x = optimizer.ask().x
        optimizer.tell(x, BRANIN.evaluate(x, grad=False))
    late = BRANIN.evaluate(optimizer.ask().x, grad=False).loss
    assert float(late.median()) < 5.0  # random points have a median of 40


def test_the_process_of_losses_and_slopes_is_that_of_the_closed_form():
    random = np.random.default_rng(1)
    u, loss, grad = random.uniform(size=(7, 2)), random.normal(size=7), random.normal(size=(7, 2))
    model = GradientProcess(torch.from_numpy(u), torch.from_numpy(standardised(loss, grad)))
    scale, noise = model.covar_module.lengthscale.detach().numpy()[0], model.likelihood.noise.item()

    def k(a, b):
        """Return the covariance of values and slopes at a and b: Rasmussen & Williams 2006, eq. 9.1."""
        apart = (a[:, None] - b[None]) / scale**2
        value = np.exp(-0.5 * (apart**2 * scale**2).sum(axis=2))
        blocks = np.empty((len(a), 3, len(b), 3))
        blocks[:, 0, :, 0] = value
        for i in range(2):
            blocks[:, 0, :, 1 + i] = apart[:, :, i] * value
            blocks[:, 1 + i, :, 0] = -apart[:, :, i] * value
            for j in range(2):
                curved = (i == j) / scale[i] ** 2 - apart[:, :, i] * apart[:, :, j]
                blocks[:, 1 + i, :, 1 + j] = curved * value
        return blocks.reshape(3 * len(a), 3 * len(b))

    new = random.uniform(size=(5, 2))
    inverse, cross = np.linalg.inv(k(u, u) + noise * np.eye(21)), k(new, u)[::3]
    mean = cross @ inverse @ standardised(loss, grad).ravel()
    deviation = np.sqrt(1.0 - np.einsum("ij,jk,ik->i", cross, inverse, cross))
    covariance, values = covariance_of(model.covar_module), model.train_targets.reshape(-1)
    for first in (7, 4):  # at once, or going on from four points
        process = Process(covariance, noise, torch.from_numpy(u), values, first)
        bound, points = LowerBound(process, 2.0), torch.from_numpy(new)
        value, slope = bound.with_slope(points)
        np.testing.assert_allclose(value, mean - 2.0 * deviation, rtol=1e-8)
        np.testing.assert_allclose(bound(points), value)
        step = 1e-5 * torch.eye(2, dtype=torch.float64)
        differences = [(bound(points + one) - bound(points - one)) / 2e-5 for one in step]
        np.testing.assert_allclose(slope, torch.stack(differences, dim=1), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("first", [7, 4])
def test_a_process_given_some_slopes_is_that_of_its_known_rows_alone(first):
    random = np.random.default_rng(1)
    u, loss, grad = random.uniform(size=(7, 2)), random.normal(size=7), random.normal(size=(7, 2))
    grad[[1, 5]] = np.nan
    lacking = np.isnan(grad).any(axis=1)
    known = np.repeat(~lacking[:, None], 3, axis=1)
    known[:, 0] = True
    rows = standardised(loss, grad)
    assert np.isfinite(rows).all()
    covariance, noise, new = GradientCovariance(torch.tensor([0.4, 0.7]).double()), 1e-3, random.uniform(size=(5, 2))
    kept, points = known.ravel(), torch.from_numpy(u)
    within = covariance.dense(points, points).numpy()[kept][:, kept] + noise * np.eye(kept.sum())
    cross = covariance.across(torch.from_numpy(new), points)[0].numpy()[:, kept]
    mean = cross @ np.linalg.solve(within, rows.ravel()[kept])
    deviation = np.sqrt(1.0 - np.einsum("ij,ji->i", cross, np.linalg.solve(within, cross.T)))
    flagged = torch.from_numpy(np.column_stack([u, lacking]))
    bound = LowerBound(Process(covariance, noise, flagged, torch.from_numpy(rows.ravel()), first), 2.0)
    value, slope = bound.with_slope(torch.from_numpy(new))
    np.testing.assert_allclose(value, mean - 2.0 * deviation, rtol=1e-8)
    step = 1e-5 * torch.eye(2, dtype=torch.float64)
    differences = [(bound(torch.from_numpy(new) + one) - bound(torch.from_numpy(new) - one)) / 2e-5 for one in step]
    np.testing.assert_allclose(slope, torch.stack(differences, dim=1), rtol=1e-5, atol=1e-6)


def test_the_likelihood_of_losses_and_slopes_is_that_of_gpytorch():
    random = np.random.default_rng(2)
    u, loss, grad = random.uniform(size=(9, 3)), random.normal(size=9), random.normal(size=(9, 3))
    model = GradientProcess(torch.from_numpy(u), torch.from_numpy(standardised(loss, grad)))
    model.covar_module.lengthscale = torch.tensor([0.3, 0.7, 1.9])
    likelihood = ExactMarginalLogLikelihood(model.likelihood, model).train()
    parameters = {name: one for name, one in likelihood.named_parameters() if one.requires_grad}
    wanted, slopes = get_loss_closure_with_grads(likelihood, parameters)()
    value, found = closure_of(likelihood)()
    torch.testing.assert_close(value, wanted.detach(), rtol=1e-9, atol=1e-9)
    for one, two in zip(found, slopes, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_slopes_tell_the_process_more_than_losses_alone():
    def error(optimizer):
        _, losses = evaluated(BRANIN, optimizer, 25)
        return losses.min() - 0.397887

    with_slopes, without = (np.median([error(kind.on(BRANIN, seed=s)) for s in range(5)]) for kind in (BOGradient, BO))
    assert with_slopes < 0.2 * without
