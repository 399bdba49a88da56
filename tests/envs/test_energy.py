"""Energy of motions that nothing drives: it stays or falls, and how far it strays falls with the step."""

from dataclasses import replace

import pytest
import torch

from gradscape.envs.registry import make
from gradscape.envs.sheets.swing import Swing, SwingStiffness, SwingVelocity


def rise(energy: torch.Tensor) -> float:
    return float(((energy - energy.cummin(dim=1).values) / energy[:, :1]).max())


def energy(name: str, fidelity: str) -> torch.Tensor:
    env = make(name, fidelity=fidelity, device="cpu")
    found = env.energy(env.space.uniform(3, seed=0))
    assert found is not None
    assert found.shape[0] == 3
    return found


def test_a_chain_that_swings_freely_keeps_its_energy_to_the_order_of_the_method() -> None:
    """Runge-Kutta of fourth order loses dt^4 to dt^5 over a given time."""
    draft, standard = (energy("cartpole", fidelity) for fidelity in ("draft", "standard"))
    assert (draft[:, 0] > 1).all()
    strayed = [float((found / found[:, :1] - 1).abs().max()) for found in (draft, standard)]
    assert strayed[0] < 2e-3
    assert strayed[0] / strayed[1] > 10


def test_a_ball_loses_energy_to_the_ground_and_gains_none_in_the_air() -> None:
    draft, standard = (energy("bounce", fidelity) for fidelity in ("draft", "standard"))
    assert rise(standard) < rise(draft) < 0.1  # within a contact, where a step is long
    assert (standard[:, -1] < 0.7 * standard[:, 0]).all()


def test_a_thrown_ball_has_the_energy_of_its_throw() -> None:
    env = make("bounce", device="cpu")
    found = env.energy(torch.tensor([[3.0, 4.0, 0.0]], dtype=torch.float64))
    assert found is not None
    assert float(found[0, 0]) == pytest.approx(25 / 2 + 9.8 * 0.9, rel=0.01)


@pytest.mark.parametrize("kind", [SwingVelocity, SwingStiffness])
def test_a_cloth_gains_energy_in_a_step_only_as_far_as_the_step_is_long(kind: type[Swing]) -> None:
    """What semi-implicit steps give back for a moment falls by at least the first order, here by the second."""
    rises = []
    for dt in (1 / 1500, 1 / 3000):
        fidelity = replace(kind.fidelities["draft"], dt=dt, precision="float64")
        env = kind(fidelity=fidelity, device="cpu")
        found = env.energy(env.space.uniform(3, seed=0))
        assert found is not None
        assert (found[:, -1] < 0.7 * found[:, 0]).all()
        rises.append(rise(found))
    assert rises[0] < 2e-3
    assert rises[1] < rises[0] / 3 + 1e-6


def test_scenes_that_are_driven_offer_none() -> None:
    env = make("flip", device="cpu")
    assert env.energy(env.space.center[None]) is None
