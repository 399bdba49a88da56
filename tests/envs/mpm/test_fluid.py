"""The Fluid scene: the ladle's path, the loss, what floats and what is lifted, precision and failures."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gradscape.envs.base import Fidelity
from gradscape.envs.engines.mpm.boundaries import LadleInTank
from gradscape.envs.mpm import fluid
from gradscape.envs.mpm.fluid import (
    BOWL,
    CUBE_CENTER,
    RIM,
    SEGMENTS,
    SHELL,
    SPAN,
    STEPS,
    TANK_HEIGHT,
    TANK_WIDTH,
    Fluid,
)
from gradscape.landscapes.objective import Status

TINY = Fidelity("tiny", dt=SPAN / 2, precision="float64", resolution=6, sampling=1.5)
STILL = torch.zeros(1, 2 * SEGMENTS, dtype=torch.float64)


@pytest.fixture(scope="module")
def tiny():
    return Fluid(fidelity=TINY, device="cpu")


@pytest.fixture(scope="module")
def draft():
    return Fluid(fidelity="draft", device="cpu")


def test_ladle_lifts_the_cube(draft):
    x = draft.example("scoop")[None]
    cube, ladle = draft.cube(x)[0], draft.tools(x)[0, -1, 0]
    assert cube[1] > TANK_HEIGHT
    assert (cube - ladle).norm() < BOWL - SHELL
    still, scooped = (draft.evaluate(points, grad=False).loss for points in (STILL, x))
    assert float(scooped) < 0.5 * float(still)


def test_the_cube_floats_or_sinks_as_its_density_says():
    height = {}
    for density in (800.0, 1330.0, 2500.0):  # the syrup's is 1330
        height[density] = float(Fluid(device="cpu", cube_density=density).cube(STILL)[0, 1])
    start = CUBE_CENTER[1]
    assert height[800.0] > start + 0.005
    assert height[2500.0] < start - 0.005
    assert height[800.0] - height[1330.0] > 0.003
    assert height[1330.0] - height[2500.0] > 0.003
    assert abs(height[1330.0] - start) < 0.01  # a coarse grid moves it by millimetres


def test_a_still_scene_stays_symmetric_in_depth(draft):
    assert abs(float(draft.cube(STILL)[0, 2])) < 1e-5


def test_the_printed_goal_turns_the_sign_of_the_height(draft):
    printed = Fluid(fidelity="draft", device="cpu", goal="printed")
    x = torch.cat([draft.space.uniform(3, seed=0), draft.example("scoop")[None]])
    ours, theirs = draft.evaluate(x, grad=False), printed.evaluate(x, grad=False)
    height = draft.cube(x)[:, 1]
    assert height.min() < TANK_HEIGHT < height.max()
    torch.testing.assert_close(ours.loss - theirs.loss, TANK_HEIGHT - height, rtol=0, atol=1e-12)


def test_the_loss_is_height_missing_plus_distances_to_ladle_and_axis(tiny):
    x = tiny.space.uniform(4, seed=1)
    cube, ladle = tiny.cube(x), tiny.tools(x)[:, -1, 0]
    aside, from_axis = (cube - ladle)[:, [0, 2]].norm(dim=1), cube[:, [0, 2]].norm(dim=1)
    wanted = (TANK_HEIGHT - cube[:, 1]).clamp_min(0) + 3 * aside + from_axis
    torch.testing.assert_close(tiny.evaluate(x, grad=False).loss, wanted, rtol=0, atol=1e-14)


@settings(max_examples=50)
@given(st.lists(st.floats(-1e3, 1e3), min_size=2 * SEGMENTS, max_size=2 * SEGMENTS))
def test_the_ladle_stays_in_the_tank(tiny, speeds):
    path = tiny.tools(torch.tensor([speeds], dtype=torch.float64))
    assert path.shape == (1, STEPS + 1, 1, 3)
    x, y, z = path[0, :, 0].unbind(-1)
    assert (x.abs() + BOWL + SHELL <= TANK_WIDTH / 2 + 1e-12).all()
    assert (y - BOWL - SHELL >= 0).all()
    assert (z == RIM[2]).all()


def test_away_from_its_limits_the_ladle_goes_speed_times_time(tiny):
    # From the rim's start: right 0.02 m a segment, up 0.01 m a segment.
    speeds = torch.tensor([[0.2, 0.1] * SEGMENTS], dtype=torch.float64)
    time = SPAN * torch.arange(STEPS + 1, dtype=torch.float64)
    wanted = torch.tensor(RIM, dtype=torch.float64) + time[:, None] * torch.tensor([0.2, 0.1, 0.0])
    torch.testing.assert_close(tiny.tools(speeds)[0, :, 0], wanted)


def test_single_precision_gives_the_same_landscape(draft):
    double = Fluid(fidelity=replace(draft.fidelity, precision="float64"), device="cpu")
    x = torch.cat([draft.space.uniform(3, seed=2), draft.example("scoop")[None]])
    single, exact = draft.evaluate(x), double.evaluate(x)
    torch.testing.assert_close(single.loss, exact.loss, rtol=0, atol=1e-5)
    torch.testing.assert_close(single.grad, exact.grad, rtol=0, atol=1e-3 * float(exact.grad.abs().max()))


def test_syrup_thrown_out_of_the_grid_is_an_escape_and_spoils_no_other_row(monkeypatch):
    monkeypatch.setattr(fluid, "HEADROOM", 0.1)
    monkeypatch.setattr(fluid, "LadleInTank", lambda *args, **kw: replace(LadleInTank(*args, **kw), lid=9.0))
    low = Fluid(fidelity=TINY, device="cpu")
    x = STILL.repeat(3, 1)
    x[1, 1::2] = 2.0  # lift what is in the ladle over the top of a low grid
    result = low.evaluate(x)
    assert result.status.tolist() == [Status.OK, Status.ESCAPED, Status.OK]
    assert result.loss.isnan().tolist() == [False, True, False]
    assert result.grad.isnan().all(dim=1).tolist() == [False, True, False]
    alone = low.evaluate(STILL)
    for row in (0, 2):
        assert torch.equal(result.loss[row], alone.loss[0])
        assert torch.equal(result.grad[row], alone.grad[0])


def test_an_episode_shows_what_the_loss_measures(tiny):
    x = tiny.space.uniform(1, seed=4)
    episode = tiny.episode(x[0])
    assert episode.time[-1] == pytest.approx(STEPS * SPAN)
    syrup, cube, ladle = episode.points["syrup"], episode.points["cube"], episode.tools["ladle"]
    assert syrup.shape[0] == cube.shape[0] == len(ladle) == len(episode.time) == STEPS + 1
    torch.testing.assert_close(cube[0].mean(dim=0), torch.tensor(CUBE_CENTER, dtype=torch.float64))
    torch.testing.assert_close(cube[-1].mean(dim=0), tiny.cube(x)[0])
    torch.testing.assert_close(ladle, tiny.tools(x)[0, :, 0])
    for points in (syrup, cube):
        assert points[:, :, [0, 2]].abs().max() < TANK_WIDTH / 2
        assert points[:, :, 1].min() > 0
