"""The parts of plasticine scenes, each left out by its option; the targets that demonstrations make; steps and time."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.engines.mpm.boundaries import Kind, Tool, ToolsInRoom
from gradscape.envs.engines.mpm.materials import Plasticine as Clay
from gradscape.envs.engines.mpm.materials.plasticine import NEAR
from gradscape.envs.engines.mpm.model import Body, Model
from gradscape.envs.engines.mpm.raster import Raster
from gradscape.envs.engines.mpm.solver import Solver
from gradscape.envs.mpm.plasticine import DEMONSTRATION, SPAN, YOUNG, Plasticine
from gradscape.envs.mpm.plasticine_scenes import Assembly, Pinch, Table, Torus, TripleMove, Writer
from gradscape.envs.mpm.scene import SEGMENTS
from gradscape.envs.mpm.targets import Ball, fill

from ..engines.bench import BoundaryBench, MaterialBench, vectors
from ..scenes import cheap

TINY = cheap(Plasticine)


def made(kind, **options):
    return kind(fidelity=TINY, device="cpu", **options)


def rest(env):
    return torch.from_numpy(np.concatenate([body.x for body in env.model.bodies]))


def shifts(env, x):
    """Return how far bodies move on the floor in an episode [m], shape (body, 2)."""
    way = torch.split(env.end(x) - rest(env), [len(body.x) for body in env.model.bodies])
    return torch.stack([moved.mean(dim=0)[[0, 2]] for moved in way])


def share_moved(kind):
    """Return half the absolute difference between the draft target's grid and the start's, by their mass."""
    env = kind(fidelity="draft", device="cpu")
    start = Raster(env.model, env.model.mass, capacity=1, device="cpu")(rest(env)[None])[0]
    return float((env._target.mass - start).abs().sum() / 2 / env.model.mass.sum())


def test_an_elastic_body_keeps_any_strain_and_plasticine_none_beyond_its_yield():
    strain = torch.diag(torch.tensor([1.2, 0.9, 0.95], dtype=torch.float64))[None]
    kept = {}
    for factor in (1.0, 1e6):
        clay = made(Torus, yield_stress=factor).model.bodies[0].material
        kept[factor] = MaterialBench(clay).deform(strain, torch.zeros_like(strain))
    torch.testing.assert_close(kept[1e6], strain, rtol=0, atol=1e-12)
    log_strain = torch.linalg.svdvals(kept[1.0]).log()
    deviator = (log_strain - log_strain.mean()).norm()
    assert float(deviator) == pytest.approx(Torus.scene.yield_stress / 2 / clay.mu, rel=1e-3)
    assert float(log_strain.sum()) == pytest.approx(float(torch.linalg.det(strain).log()), abs=1e-12)


def test_without_friction_two_spheres_lift_no_ball():
    heights = []
    for friction in (1.0, 0.0):
        env = Assembly(device="cpu", tool_friction=friction)
        ball = env.end(env.example(DEMONSTRATION))[-len(env.model.bodies[1].x) :]
        heights.append(float(ball[:, 1].mean()))
    assert heights[0] > 0.2, heights
    assert heights[1] < 0.06 + 0.5 * (heights[0] - 0.06)  # of what it is lifted by


def test_on_a_slippery_floor_what_is_pushed_slides_farther():
    """A box that two spheres push for a while, then leave."""
    push = torch.zeros(SEGMENTS, 2, 3, dtype=torch.float64)
    push[:2, 0, 0] = 1.0
    far, near = (shifts(made(Assembly, floor_friction=mu), push.flatten())[0].norm() for mu in (0.0, 1.0))
    assert far > 1.5 * near
    assert far > 1e-3


def test_without_gravity_what_hangs_in_the_air_stays():
    still = torch.zeros(15, dtype=torch.float64)
    weightless, heavy = made(Table, gravity=0.0), made(Table)
    torch.testing.assert_close(weightless.end(still), rest(weightless), rtol=0, atol=1e-12)
    assert float((heavy.end(still) - rest(heavy))[:, 1].mean()) < -1e-3


def test_without_poissons_ratio_what_is_pressed_does_not_push_aside():
    squeezed = torch.diag(torch.tensor([1.0, 0.995, 1.0], dtype=torch.float64))[None]
    still = torch.zeros_like(squeezed)
    for factor in (0.0, 1.0):
        clay = made(Torus, poisson=factor).model.bodies[0].material
        assert isinstance(clay, Clay)
        aside = float(MaterialBench(clay).tau(squeezed, still)[0, 0, 0])
        assert aside == pytest.approx(clay.lam * 0.995 * -0.005, abs=1e-9)  # lam J (J - 1)
        assert (aside == pytest.approx(0, abs=1e-9)) == (factor == 0.0)


def test_a_hard_tool_is_felt_at_its_surface_alone():
    for softness, felt in ((666.0, True), (1e5, False)):
        env = made(Assembly, softness=softness)
        bench = BoundaryBench(env.model.boundary, rate=1.0)
        tool = env.scene.anchors[0]
        place = torch.tensor([a.start for a in env.scene.anchors], dtype=torch.float64).expand(2, -1, -1)
        outside = vectors(tool.start) + vectors((0, tool.tool.size[0] + 1e-3, 0))
        assert (float(bench(outside, vectors((0, -1, 0)), place)[0, 1]) > -0.9) == felt


def test_without_walls_nothing_but_the_floor_holds():
    for walls in (True, False):
        env = made(TripleMove, walls=walls)
        bench = BoundaryBench(env.model.boundary, rate=1.0)
        away = torch.full((2, env.model.boundary.slots, 3), 50.0, dtype=torch.float64)
        lower, upper = map(torch.from_numpy, env.scene.room())
        for corner, v in ((lower, -1.0), (upper, 1.0)):
            met = bench(corner[None] + vectors((0, 0.06, 0)), vectors((v, 1, v)), away)
            held = vectors((0.0, 1.0 if v < 0 else 0.0, 0.0)) if walls else vectors((v, 1, v))
            torch.testing.assert_close(met, held)
        assert float(bench(vectors((0.5, 0.0, 0.5)), vectors((0, -1, 0)), away)[0, 1]) == 0


@pytest.mark.parametrize("part", Plasticine.model_parts, ids=lambda part: part.name)
def test_gradients_are_slopes_without_each_part(part):
    env = made(Assembly, horizon=0.4, **part.options)
    x = env.space.uniform(1, seed=1).requires_grad_()
    with torch.no_grad():
        moved = (env.end(x[0]) - rest(env)).norm(dim=1).max()
    assert moved > 1e-4  # a sphere has touched the ball
    assert torch.autograd.gradcheck(env, (x,), fast_mode=True, rtol=1e-6, atol=1e-6)


def test_a_pen_without_friction_has_none_to_leave_out():
    assert "tool_friction" not in {option for part in Writer.model_parts for option in part.options}
    assert Writer.scene.anchors[0].tool.friction == 0


def test_parts_below_nothing_are_refused():
    with pytest.raises(ValueError, match="gravity takes a number of at least 0; got -1"):
        made(Torus, gravity=-1.0)
    with pytest.raises(ValueError, match="softness takes a number above 0; got 0"):
        made(Torus, softness=0.0)


@pytest.mark.parametrize("options", [{"gravity": 0.0, "yield_stress": 2.0}, {"contact": 1.0, "loss": "sum"}])
def test_targets_are_those_of_the_whole_model_whatever_the_losss_weights(options):
    assert torch.equal(made(Torus, **options)._target.mass, made(Torus)._target.mass)


@pytest.mark.parametrize(("kind", "released"), [(Torus, (0.071, 0.078)), (Pinch, (0.059, 0.070))])
def test_a_press_moves_about_as_much_as_a_released_target(kind, released):
    """A draft smears a tool by a cell: from half the least to half as much again as the most."""
    assert 0.5 * released[0] < share_moved(kind) < 1.5 * released[1]


def test_one_leg_is_bent_and_the_table_stays():
    """PlasticineLab's targets, on as fine a grid: 8 to 65 mm of the bent leg, at most 2 mm of the others.

    The draft's coarser grid smears the sphere over the other legs, which it moves by as much.
    """
    env = Table(fidelity=Fidelity("PlasticineLab's", dt=1e-4, resolution=64, particles=5000), device="cpu")
    bent = shifts(env, torch.tensor(Table.examples[DEMONSTRATION]).double()).norm(dim=1)
    assert 0.01 < bent[2] < 0.05
    assert bent[[0, 1, 3]].max() < 2e-3
    assert bent[4] < 4e-3  # the top leans


def pushed(substeps, room):
    """Return where a ball that does not yield is after a softer sphere has pushed it for 20 ms [m]."""
    count, radius, dt = 100, 0.06, SPAN / substeps
    x = fill(Ball((0.5, 0.5, 0.5), radius), count)
    body = Body(Clay(1.0, 5000.0, 0.2, 1e9), x, np.full(count, 4 / 3 * np.pi * radius**3 / count), np.ones(count))
    nodes = (25, 25, 25)
    model = Model("float64", (body,), room, (0.0, 0.0, 0.0), 1 / 24, nodes, dt, substeps, steps=10, gravity=0.0)
    start = vectors((0.5 - radius - 0.046, 0.5013, 0.5007))
    path = start + torch.arange(11, dtype=torch.float64)[:, None] * SPAN * vectors((1.0, 0.0, 0.0))
    return Solver(model, capacity=1, device="cpu").run(path[None, :, None])[0].clone()


def test_shorter_steps_do_not_harden_a_tools_shell():
    """What a ball's end changes by as steps are halved, against a law that takes a share per step, however short."""
    law = ToolsInRoom((Tool(Kind.SPHERE, (0.04,), 0.9),), (0.1, 0.0, 0.1), (0.9, 0.9, 0.9), 0.0, 1.0, softness=60.0)
    counts = (5, 10, 20, 40)
    rate = [pushed(count, replace(law, dt=SPAN / count)) for count in counts]
    share = [pushed(count, law) for count in counts]
    converging, drifting = ([float((a - b).norm(dim=1).mean()) for a, b in pairwise(ends)] for ends in (rate, share))
    assert sum(converging) < 0.5 * sum(drifting), (converging, drifting)
    assert converging[-1] < 0.5 * converging[0]


def test_what_yields_in_a_scene_is_strained_by_so_little_that_series_are_exact():
    """On a GPU a decomposition is for what a substep strains by half as much again, or does not yield."""
    scenes = [kind.scene for kind in Plasticine.__subclasses__()]
    assert len(scenes) >= 8
    for scene in scenes:
        kappa = Clay(1.0, YOUNG, scene.poisson, scene.yield_stress).constants()["kappa"]
        assert 1.5 * np.expm1(2 * kappa) < NEAR
