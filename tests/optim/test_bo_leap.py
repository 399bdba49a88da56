import math

import numpy as np
import pytest

from gradscape.envs.adapters import from_torch
from gradscape.envs.registry import make
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind
from gradscape.optim.methods.bo_leap import BOLeap, BOLeapOptions, SemiLocal
from gradscape.optim.search import search

SPACE = ParameterSpace.box(("x", "y", "z"), -2.0, 4.0, "m")
BRANIN = 10 / (8 * math.pi)  # its least loss: where the square and the cosine are as low as they get
RIPPLES = from_torch(lambda x: ((x - 0.5) ** 2).sum(dim=1) + (4 * x).cos().sum(dim=1), SPACE)


@pytest.mark.slow
def test_branins_minimum_is_reached_to_a_thousandth_within_300_evaluations():
    branin = make("branin")
    runs = [search(branin, BOLeap(branin.space, seed=seed), budget=300, gradient_cost=2.0) for seed in range(5)]
    reached = [run.best_loss - BRANIN < 1e-3 for run in runs]
    assert sum(reached) >= 4
    assert all(run.count == 300 for run in runs)


def test_sigma_and_c_follow_hansen_and_ostermeier_2001_equations_14_to_17():
    n, count, best = 3, 10, 4
    options = BOLeapOptions(population=count, best=best, sigma=0.7)
    mu = np.array([0.3, -0.2, 0.1])
    local = SemiLocal(mu, options, np.random.default_rng(0))
    c_c = c_sigma = 4 / (n + 4)  # table 1
    c_cov, d_sigma = 2 / (n + math.sqrt(2)) ** 2, (n + 4) / 4 + 1
    chi = math.sqrt(2) * math.gamma((n + 1) / 2) / math.gamma(n / 2)
    sigma, C, p_c, p_sigma = 0.7, local.es.sm.C.copy(), np.zeros(n), np.zeros(n)
    np.testing.assert_allclose(C, np.eye(n), atol=1e-4)  # pycma tells the axes of its identity apart
    for step in range(4):
        x = local.draw().clip(-1.0, 1.0)
        loss = (x - 0.6) @ np.array([1.0, -2.0, 0.5])
        mean = x[np.argsort(loss)[:best]].mean(axis=0)
        np.testing.assert_allclose(local.tell(x, loss), mean, rtol=1e-12)
        y = math.sqrt(best) / sigma * (mean - mu)
        p_c = (1 - c_c) * p_c + math.sqrt(c_c * (2 - c_c)) * y  # eq. 14
        values, B = np.linalg.eigh(C)
        whitened = B @ np.diag(values**-0.5) @ B.T @ y
        p_sigma = (1 - c_sigma) * p_sigma + math.sqrt(c_sigma * (2 - c_sigma)) * whitened  # eq. 16
        C = (1 - c_cov) * C + c_cov * np.outer(p_c, p_c)  # eq. 15
        sigma *= math.exp((np.linalg.norm(p_sigma) / chi - 1) / d_sigma)  # eq. 17
        np.testing.assert_allclose(local.es.sm.C, C, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(local.es.sigma, sigma, rtol=1e-4)  # pycma approximates chi, to 5e-5
        sigma = local.es.sigma
        mu = mean + 0.1 * (step + 1)  # a leap, of which the paths are to know nothing
        local.leap(mu)


def test_a_population_is_drawn_around_the_leapt_point():
    options = BOLeapOptions(population=400, best=5, sigma=0.5)
    local = SemiLocal(np.zeros(2), options, np.random.default_rng(0))
    x = local.draw()
    local.tell(x, x.sum(axis=1))
    local.leap(np.array([0.4, -0.9]))
    drawn = local.draw()
    expected = local.es.sigma**2 * local.es.sm.C
    np.testing.assert_allclose(drawn.mean(axis=0), [0.4, -0.9], atol=4 * local.es.sigma / math.sqrt(400))
    np.testing.assert_allclose(np.cov(drawn.T), expected, atol=0.25 * expected.max())


def test_no_point_of_a_small_population_mirrors_one_of_the_last():
    local = SemiLocal(np.zeros(3), BOLeapOptions(population=5, best=2), np.random.default_rng(0))
    drawn = []
    for _ in range(4):
        x = local.draw()
        apart = x - local.es.mean
        drawn.append(apart / np.linalg.norm(apart, axis=1, keepdims=True))
        local.tell(x, (x**2).sum(axis=1))
    directions = np.concatenate(drawn)
    assert (directions @ directions.T).min() > -0.9999


def test_a_local_step_is_a_population_the_mean_of_its_best_five_and_a_descent_from_there():
    table = search(RIPPLES, BOLeap(SPACE, seed=1), budget=120, gradient_cost=2.0).dataset()
    x, loss, kind = (table[name].to_numpy() for name in ("x", "loss", "kind"))
    starts = np.flatnonzero((kind[1:] == Kind.DESCENT) & (kind[:-1] == Kind.POPULATION)) + 1
    assert len(starts) >= 3
    for start in starts:
        population = slice(start - 10, start)
        assert (kind[population] == Kind.POPULATION).all()
        best = np.argsort(loss[population])[:5]
        np.testing.assert_allclose(x[start], x[population][best].mean(axis=0), atol=1e-12)


def test_gradients_are_asked_for_in_descents_and_nowhere_else():
    table = search(RIPPLES, BOLeap(SPACE, seed=1), budget=60, gradient_cost=2.0).dataset()
    np.testing.assert_array_equal(table["slope"].notnull(), table["kind"] == Kind.DESCENT)


def test_a_new_proposal_is_made_once_the_local_budget_is_spent(monkeypatch):
    optimizer = BOLeap(SPACE, seed=0, options=BOLeapOptions(local_budget=25, steps=4))
    spent: list[int] = []
    lowest = optimizer.surrogate.minimise

    def counting(random):
        spent.append(len(optimizer.surrogate.loss))
        return lowest(random)

    monkeypatch.setattr(optimizer.surrogate, "minimise", counting)
    for _ in range(40):
        ask = optimizer.ask()
        optimizer.tell(ask.x, RIPPLES.evaluate(ask.x, grad=ask.grad))
    between = np.diff(spent)
    assert len(between) >= 3
    assert (between >= 25).all()
    assert (between < 25 + 14).all()
