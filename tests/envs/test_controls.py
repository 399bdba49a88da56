"""Tool motion: segments held, waypoints met, speeds integrated, positions kept within reach, and how gradients pass."""

import numpy as np
import pytest
import torch

from gradscape.envs.controls import hold, integrate_velocity, ramp

START = torch.tensor([0.1, 0.2], dtype=torch.float64)
LOWER, UPPER = torch.tensor([-0.5, 0.0], dtype=torch.float64), torch.tensor([0.5, 1.0], dtype=torch.float64)
SPAN = 0.01


def drive(velocity):
    return integrate_velocity(START, velocity, SPAN, lower=LOWER, upper=UPPER)


def velocities(*shape, size=1.0):
    return size * (2 * torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1)


def test_segments_are_held_over_equal_shares_of_the_steps():
    segments = velocities(3, 5, 2)
    held = hold(segments, 20)
    assert held.shape == (3, 20, 2)
    for step in range(20):
        assert torch.equal(held[:, step], segments[:, step // 4])


def test_steps_that_segments_cannot_share_are_refused():
    with pytest.raises(ValueError, match="21 control steps cannot be divided equally into 5 segments"):
        hold(velocities(3, 5, 2), 21)


@pytest.mark.parametrize("steps", [20, 21, 4, 3, 100])
def test_a_ramp_is_linear_between_waypoints_whatever_the_number_of_steps(steps):
    waypoints = velocities(3, 5, 2)
    path = ramp(START, waypoints, steps)
    corners = torch.cat([START.expand(3, 1, 2), waypoints], dim=1)
    assert path.shape == (3, steps + 1, 2)
    for row in range(3):
        for axis in range(2):
            expected = np.interp(np.linspace(0, 5, steps + 1), np.arange(6), corners[row, :, axis])
            torch.testing.assert_close(path[row, :, axis], torch.from_numpy(expected), rtol=0, atol=1e-14)
    if steps % 5 == 0:
        assert torch.equal(path[:, :: steps // 5], corners)


def test_a_tool_stops_at_its_limits_and_turns_back_at_once():
    there, back = torch.full((1, 50, 2), 9.0, dtype=torch.float64), torch.full((1, 3, 2), -1.0, dtype=torch.float64)
    path = drive(torch.cat([there, back], dim=1))
    assert torch.equal(path[0, 50], UPPER)
    torch.testing.assert_close(path[0, 53], UPPER - 3 * SPAN)
    wild = drive(velocities(8, 40, 2, size=100))
    assert ((wild >= LOWER) & (wild <= UPPER)).all()


def test_gradients_pass_while_a_tool_moves_and_stop_where_it_is_stopped():
    velocity = velocities(1, 6, 2).requires_grad_()
    (grad,) = torch.autograd.grad(drive(velocity)[0, -1].sum(), velocity)
    torch.testing.assert_close(grad, torch.full_like(grad, SPAN))

    velocity = torch.ones(1, 6, 2, dtype=torch.float64)
    velocity[0, 2, 0] = 100.0  # beyond the limit: what came before has no say any more
    velocity[0, 3:, 0] = -1.0
    velocity.requires_grad_()
    (grad,) = torch.autograd.grad(drive(velocity)[0, -1].sum(), velocity)
    assert grad[0, :, 0].tolist() == [0, 0, 0, SPAN, SPAN, SPAN]
    assert grad[0, :, 1].tolist() == [SPAN] * 6


def test_the_map_from_segments_to_path_is_differentiated():
    segments = velocities(2, 3, 2, size=20).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: drive(hold(s, 6)), (segments,))
