"""The Fluid scene: the ladle's path, the loss, what floats and what is lifted, precision and failures."""

from dataclasses import replace

import pytest
import torch
from benchmarks.drag import known_speed
from hypothesis import given, settings
from hypothesis import strategies as st

from gradscape.envs.base import Fidelity
from gradscape.envs.controls import ease, hold
from gradscape.envs.engines.mpm.boundaries import LadleInTank
from gradscape.envs.engines.runtime import to_torch
from gradscape.envs.mpm import fluid
from gradscape.envs.mpm.fluid import (
    BOWL,
    CUBE_CENTER,
    CUBE_EDGE,
    EASING,
    FILL,
    GRAVITY,
    RIM,
    SEGMENTS,
    SHELL,
    SPAN,
    SPEED,
    STEPS,
    SYRUP_DENSITY,
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


def test_the_pressure_of_syrup_at_rest_is_hydrostatic(monkeypatch):
    monkeypatch.setattr(fluid, "CUBE_CENTER", (0.025, 0.1, 0.0))  # where the syrup bears all of it
    scene = Fluid(fidelity="draft", device="cpu", cube_density=SYRUP_DENSITY)
    scene.evaluate(STILL, grad=False)
    with scene._solvers.lend() as stage:
        solver = stage.solver
        J = to_torch(solver.checkpoints[STEPS].S[0])[0].double()
        height = to_torch(solver.checkpoints[STEPS].x)[0, : len(J), 1].double()
    pressure = -SYRUP_DENSITY * scene.options.sound_speed**2 * J.log()
    floor = SYRUP_DENSITY * GRAVITY * FILL
    for low in torch.arange(0, FILL - 0.01, 0.025):
        layer = (height >= low) & (height < low + 0.025)
        wanted = SYRUP_DENSITY * GRAVITY * (FILL - height[layer].mean())
        assert abs(float(pressure[layer].mean() - wanted)) < 0.04 * floor
        assert pressure[layer].std() < 0.03 * floor  # of it a layer's own slope is 0.04


@pytest.fixture(scope="module")
def narrow():
    """Return what makes a narrow tank of syrup, its cube's centre at a height [m], and lets it go without a ladle.

    It returns the scene, and where particles are before some control steps.
    """

    def run(height, steps, fidelity, *, fill=FILL, **options):
        away = torch.tensor([0.0, 10.0, 0.0], dtype=torch.float64).expand(1, max(steps) + 1, 1, 3)
        changes = {"RIM": (0.0, 10.0, 0.0), "FILL": fill, "TANK_WIDTH": 0.2, "CUBE_CENTER": (0.0, height, 0.0)}
        with pytest.MonkeyPatch.context() as patch:
            for name, value in changes.items():
                patch.setattr(fluid, name, value)
            scene = Fluid(fidelity=fidelity, device="cpu", horizon=max(1.0, max(steps) / STEPS), **options)
        with scene._solvers.lend() as stage:
            stage.solver.run(away)
            return scene, [stage.solver.read_positions(step, 1).double() for step in steps]

    return run


@pytest.fixture(scope="module")
def speeds(narrow):
    """Speeds upwards of cubes in syrup over the last half of 20 control steps, by viscosity and density."""
    fidelity, found = Fidelity("narrow", dt=SPAN / 22, resolution=24, sampling=4 / 3), {}
    for case in [(30.0, 1800.0), (30.0, 860.0), (60.0, 1800.0), (60.0, 860.0), (30.0, SYRUP_DENSITY)]:
        scene, places = narrow(0.1, (10, 20), fidelity, fill=0.2, viscosity=case[0], cube_density=case[1])
        before, end = (float(scene._center(place)[0, 1]) for place in places)
        found[case] = (end - before) / (SPAN * 10)
    return found


def test_a_cube_half_as_heavy_as_syrup_floats_half_in_and_leaves_the_surface_still(narrow):
    fidelity = Fidelity("narrow", dt=SPAN / 16, resolution=12, sampling=4 / 3)
    scene, places = narrow(FILL, (0, STEPS), fidelity, cube_density=SYRUP_DENSITY / 2)
    start, end = (place[0] for place in places)
    syrup = len(scene.model.bodies[0].x)
    assert abs(float((end - start)[syrup:, 1].mean())) < 2e-3  # of 50 mm
    top = start[:syrup, 1] > start[:syrup, 1].max() - 1e-9
    assert float((end - start)[:syrup][top, 1].abs().max()) < 1e-3


@pytest.mark.parametrize("viscosity", [30.0, 60.0])
def test_a_cube_sinks_and_rises_as_fast_as_is_known_of_cubes_between_walls(speeds, viscosity):
    assert speeds[viscosity, 1800.0] < -0.001 < 0.001 < speeds[viscosity, 860.0]
    # Half the difference of the two is free of what a neutral cube drifts.
    half = (speeds[viscosity, 860.0] - speeds[viscosity, 1800.0]) / 2
    assert half == pytest.approx(known_speed(viscosity, 0.2, 0.2, 470.0), rel=0.1)


def test_a_neutral_cube_stays(speeds):
    """What drives it is less than a twentieth of the weight of syrup that it displaces."""
    assert abs(speeds[30.0, SYRUP_DENSITY]) < 0.05 * SYRUP_DENSITY / 470.0 * known_speed(30.0, 0.2, 0.2, 470.0)


def test_a_heavy_cube_that_is_half_in_goes_under(narrow):
    """It neither sticks where its top is at the surface, nor does the syrup lose volume on the way."""
    steps, fidelity = 150, Fidelity("narrow", dt=SPAN / 14, resolution=16, sampling=1.5)
    scene, places = narrow(FILL, (0, steps - 20, steps), fidelity, cube_density=2000.0)
    before, end = (float(scene._center(place)[0, 1]) for place in places[1:])
    assert end + CUBE_EDGE / 2 < FILL - 0.01
    assert (before - end) / (20 * SPAN) > 0.008
    syrup = [float(place[0, : len(scene.model.bodies[0].x), 1].mean()) for place in places]
    assert syrup[2] == pytest.approx(syrup[0], rel=0.02)


def test_walls_that_stick_slow_the_syrup_along_them():
    fidelity = replace(Fluid.fidelities["draft"], precision="float64")
    x = STILL.clone()
    x[0, 1::2] = SPEED  # the ladle goes up and takes syrup along
    moved = {}
    for walls in ("slip", "stick"):
        scene = Fluid(fidelity=fidelity, device="cpu", walls=walls, horizon=0.2)
        syrup = scene.episode(x[0]).points["syrup"]
        near = syrup[0, :, 0].abs() > TANK_WIDTH / 2 - scene.model.dx
        moved[walls] = float((syrup[-1, near] - syrup[0, near])[:, 1:].norm(dim=1).mean())
    assert moved["slip"] > 1e-4
    assert moved["stick"] < 0.5 * moved["slip"]


def test_the_ladles_speed_eases(tiny):
    x = STILL.clone()
    x[0, 0], x[0, 2] = 0.1, -0.1
    speed = tiny.tools(x)[0, :, 0, 0].diff() / SPAN
    ramp = torch.arange(1, EASING + 1, dtype=torch.float64) / EASING
    steps = STEPS // SEGMENTS
    torch.testing.assert_close(tiny.tools(x)[0, 0, 0], torch.tensor(RIM, dtype=torch.float64))
    torch.testing.assert_close(speed[:EASING], 0.1 * ramp)
    torch.testing.assert_close(speed[steps : steps + EASING], 0.1 - 0.2 * ramp)
    jumping = Fluid(fidelity=TINY, device="cpu", easing=False).tools(x)[0, :, 0, 0].diff() / SPAN
    torch.testing.assert_close(jumping[:steps], torch.full((steps,), 0.1, dtype=torch.float64))


def test_a_wall_seldom_stops_the_ladle(tiny):
    x = tiny.space.uniform(512, seed=0)
    wanted = SPAN * ease(hold(x.view(512, SEGMENTS, 2), STEPS), EASING)
    stopped = ((tiny.tools(x)[:, :, 0, :2].diff(dim=1) - wanted).abs() > 1e-9).any(dim=2)
    assert 0 < stopped.double().mean() < 0.15


def test_the_gradient_of_the_whole_scene_is_the_slope():
    scene = Fluid(fidelity=TINY, device="cpu", walls="stick", horizon=0.2)
    assert scene.options.smoothing == 1.0
    x = 0.3 * scene.space.uniform(1, seed=5)
    way = torch.rand(x.shape, generator=torch.Generator().manual_seed(6), dtype=torch.float64) - 0.5
    slope, errors = float((scene.evaluate(x).grad * way).sum()), []
    for step in (1e-4, 1e-5, 1e-6):
        ends = [float(scene.evaluate(x + s * step * way, grad=False).loss) for s in (1, -1)]
        errors.append(abs((ends[0] - ends[1]) / (2 * step) - slope) / abs(slope))
    assert min(errors) < 1e-6


def test_the_gradient_is_the_slope_over_a_thousandth_of_the_box(draft):
    """Losses jumped wherever the middle of the ladle's shell passed a node, which no gradient sees."""
    scene = Fluid(fidelity=replace(draft.fidelity, precision="float64"), device="cpu")
    x = 0.5 * scene.space.uniform(6, seed=5)
    way = 4.0 * torch.nn.functional.normalize(scene.space.uniform(6, seed=6), dim=1)
    slope = (scene.evaluate(x).grad * way).sum(dim=1)
    ends = scene.evaluate(torch.cat([x + 5e-4 * way, x - 5e-4 * way]), grad=False).loss
    assert ((ends[:6] - ends[6:]) / 1e-3 / slope - 1).abs().median() < 0.02


@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_an_episode_is_its_own_mirror_image_in_depth(shift):
    """The ladle moves in the plane z = 0, so each particle's image at the start is its image at the end."""
    scene = Fluid(fidelity=replace(TINY, settings={"shift_x": shift, "shift_z": shift}), device="cpu", horizon=0.4)
    mirror = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    start = torch.cat([torch.as_tensor(body.x) for body in scene.model.bodies])
    image = torch.cdist(start, start * mirror).argmin(dim=1)
    assert torch.allclose(start[image], start * mirror)
    end = scene.end(scene.space.uniform(1, seed=3)[0])
    torch.testing.assert_close(end[image], end * mirror, rtol=0, atol=1e-12)
    assert (end - start).norm(dim=1).max() > 0.01


@pytest.mark.parametrize("goal", ["high", "printed"])
def test_the_loss_is_height_missing_plus_distances_to_ladle_and_axis(draft, goal):
    """The goal as it is printed turns the sign of the height."""
    scene, x = Fluid(fidelity="draft", device="cpu", goal=goal), torch.stack([STILL[0], draft.example("scoop")])
    cube, ladle = scene.cube(x), scene.tools(x)[:, -1, 0]
    above = cube[:, 1] - TANK_HEIGHT
    assert above.min() < 0 < above.max()
    aside, from_axis = (cube - ladle)[:, [0, 2]].norm(dim=1), cube[:, [0, 2]].norm(dim=1)
    wanted = (above if goal == "printed" else -above).clamp_min(0) + 3 * aside + from_axis
    torch.testing.assert_close(scene.evaluate(x, grad=False).loss, wanted, rtol=0, atol=1e-14)


@settings(max_examples=50)
@given(st.lists(st.floats(-1e3, 1e3), min_size=2 * SEGMENTS, max_size=2 * SEGMENTS))
def test_the_ladle_stays_in_the_tank(tiny, speeds):
    path = tiny.tools(torch.tensor([speeds], dtype=torch.float64))
    assert path.shape == (1, STEPS + 1, 1, 3)
    x, y, z = path[0, :, 0].unbind(-1)
    assert (x.abs() + BOWL + SHELL <= TANK_WIDTH / 2 + 1e-12).all()
    assert (y - BOWL - SHELL >= 0).all()
    assert (z == RIM[2]).all()


def test_single_precision_gives_the_same_landscape(draft):
    double = Fluid(fidelity=replace(draft.fidelity, precision="float64"), device="cpu")
    x = torch.cat([draft.space.uniform(1, seed=2), draft.example("scoop")[None]])
    single, exact = draft.evaluate(x), double.evaluate(x)
    torch.testing.assert_close(single.loss, exact.loss, rtol=0, atol=1e-5)
    torch.testing.assert_close(single.grad, exact.grad, rtol=0, atol=2e-3 * float(exact.grad.abs().max()))


def test_syrup_thrown_out_of_the_grid_is_an_escape_and_spoils_no_other_row(monkeypatch):
    monkeypatch.setattr(fluid, "HEADROOM", 0.1)
    monkeypatch.setattr(fluid, "FILL", 0.2)
    monkeypatch.setattr(fluid, "HIGHEST", 9.0)
    monkeypatch.setattr(fluid, "LadleInTank", lambda *args, **kw: replace(LadleInTank(*args, **kw), lid=9.0))
    low = Fluid(fidelity=TINY, device="cpu")
    x = STILL.repeat(3, 1)
    x[1, 1::2] = 6.0  # throw what is in the ladle over the top of a low grid
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
