"""Gradients of MLS-MPM: they are the slope, add up, and have the same bits every time."""

import pytest
import torch

from ..bench import slope_errors
from .bodies import kneaded, kneading, weights
from .bodies import stirred as stirring


@pytest.fixture(scope="module")
def stirred():
    return stirring()


def test_the_gradient_by_tools_on_plasticine_is_the_slope():
    model, paths = kneading()
    adj_x = {model.steps: weights(model, 3, 1)}
    solver, _, gradient = kneaded(model, paths, adj_x)
    steps = (1e-4, 1e-5, 1e-6, 1e-7)
    assert min(slope_errors(solver.run, paths, adj_x[model.steps], gradient, steps, seed=2)) < 1e-6


def test_adjoints_at_several_control_steps_add_up():
    model, paths = kneading()
    at = {step: weights(model, 3, step) for step in (1, 2, model.steps)}
    solver, _, together = kneaded(model, paths, at)
    separate = [solver.gradient({step: adj_x}) for step, adj_x in at.items()]
    torch.testing.assert_close(together, sum(separate), rtol=0, atol=1e-12 * float(together.abs().max()))
    assert not separate[0][:, 2:].any()  # what comes later has no say
    assert separate[0].abs().max() > 0


def test_the_gradient_by_the_tools_is_the_slope_on_a_ladder_of_steps(stirred):
    solver, path = stirred
    adj_x = weights(solver.model, 2, 1)
    solver.run(path)
    gradient = solver.gradient({solver.model.steps: adj_x})
    errors = slope_errors(solver.run, path, adj_x, gradient, (1e-3, 1e-5, 1e-7, 1e-8), seed=2)
    assert min(errors) < 1e-7
    assert errors[0] > 100 * min(errors)  # the slope over a millimetre is another one


def test_gradients_have_the_same_bits_every_time_and_so_has_a_second_one_of_a_run(stirred):
    solver, path = stirred
    adj_x, gradients = {solver.model.steps: torch.ones((2, solver.model.particles, 3), dtype=torch.float64)}, []
    for _ in range(2):
        solver.run(path)
        gradients += [solver.gradient(adj_x), solver.gradient(adj_x)]
    assert all(torch.equal(one, gradients[0]) for one in gradients)
    assert gradients[0].abs().max() > 0
