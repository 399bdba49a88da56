"""Newton's scenes: its solvers against closed forms, against our own ball, and what is wrong with them today."""

import pytest
import torch

import gradscape as gs
from gradscape.envs.newton.scenes import Flight


def closed_form(env: Flight, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss and gradient where semi-implicit Euler of free flight ends: x + v t - g (t + dt) t / 2."""
    time, fall = env.steps * env.fidelity.dt, torch.tensor([0.0, 9.8, 0.0])
    end = torch.tensor([0.0, 1.0, 0.0]) + x * time - fall * time * (time + env.fidelity.dt) / 2
    miss = end - torch.tensor([1.0, 1.0, 0.0])
    return miss.square().sum(dim=1), 2 * time * miss


@pytest.mark.parametrize("solver", ["semi-implicit", "xpbd"])
@pytest.mark.parametrize("fidelity", ["draft", "standard"])
def test_a_sphere_in_free_flight_ends_where_it_must_and_so_do_its_slopes(solver, fidelity):
    env = gs.make("newton-flight", fidelity=fidelity, solver=solver)
    x = env.space.uniform(6, seed=0)
    found, (loss, slope) = env.evaluate(x), closed_form(env, x)
    torch.testing.assert_close(found.loss, loss, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(found.grad, slope, rtol=1e-5, atol=1e-5)
