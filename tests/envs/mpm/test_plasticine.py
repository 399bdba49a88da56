"""The plasticine scenes: tools, loss terms, targets, demonstrations, memory, gradients of what is undeformed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gradscape.envs.engines.mpm import solver
from gradscape.envs.engines.mpm.boundaries import Kind
from gradscape.envs.mpm.plasticine import DEMONSTRATION, PARTICLE, SEGMENTS, TERMS, Plasticine
from gradscape.envs.mpm.plasticine_scenes import Assembly, RollingPin, Rope, Torus, TripleMove, Writer
from gradscape.envs.mpm.scene import STEPS
from gradscape.envs.registry import environment_class

from ..scenes import SOFT, cheap

SCENES = [environment_class(name) for name in SOFT]
TINY = cheap(Plasticine)
FREE = 60_000_000_000  # bytes that a GPU of 80 GB has for sure


def made(kind, **options):
    return kind(fidelity=TINY, device="cpu", **options)


scenes = pytest.mark.parametrize("kind", SCENES, ids=lambda kind: kind.name)


@scenes
def test_the_demonstration_is_far_better_than_doing_nothing(kind):
    env = kind(device="cpu")
    still = torch.zeros(env.space.dim, dtype=torch.float64)
    shown, idle = env.evaluate(torch.stack([env.example(DEMONSTRATION), still]), grad=False).loss.tolist()
    assert shown < 0.25 * idle


@scenes
def test_a_scene_takes_the_memory_of_its_particles_keeps_a_gpu_busy_and_weighs_what_upstream_says(kind, monkeypatch):
    """A frame of each step (x, v, C, F), a tape of one with adjoints; grids and rasters are half as much at most."""
    env, frame = kind(fidelity="standard", device="cpu"), 24
    model = env.model
    tape = (model.substeps + 1) * (frame + 9)
    own = 4 * ((model.steps + 3) * frame + tape) * model.particles
    assert own <= env.memory() <= 1.5 * own
    monkeypatch.setattr(solver, "free_memory", lambda: FREE)
    batch = solver.capacity(model, "cuda")
    assert solver.BUSY <= batch * model.particles <= solver.FULL_CARD
    assert batch * env.memory() < FREE
    for one in (model, kind(fidelity="draft", device="cpu").model):
        weights = [body.mass.sum() / PARTICLE for body in one.bodies]
        assert np.allclose(weights, [piece.particles for piece in kind.scene.pieces])


@scenes
def test_tools_start_in_place_and_go_as_far_as_their_steps_say(kind):
    env = made(kind)
    still = env.tools(torch.zeros(1, env.space.dim, dtype=torch.float64))[0]
    moved = env.tools(0.1 * torch.ones(1, env.space.dim, dtype=torch.float64))[0]
    slot = 0
    for anchor in kind.scene.anchors:
        start = torch.tensor(anchor.start, dtype=torch.float64)
        assert torch.equal(still[:, slot], start.expand(STEPS + 1, 3))
        way = moved[-1, slot] - start
        if anchor.tool.kind is Kind.ROLLER:
            assert float(way[1]) == pytest.approx(0.1 * STEPS * anchor.step[2])
            length = (moved[1:, slot, ::2] - moved[:-1, slot, ::2]).norm(dim=1).sum()  # rolled without slip
            assert float(length) == pytest.approx(0.1 * STEPS * anchor.step[0] * anchor.tool.size[1])
            spin_and_turn = torch.tensor([anchor.step[0], -anchor.step[1]], dtype=torch.float64)
            torch.testing.assert_close(moved[-1, slot + 1, :2], 0.1 * STEPS * spin_and_turn)
        else:
            wanted = (start + 0.1 * STEPS * start.new_tensor(anchor.step)).clamp(
                start.new_tensor(anchor.lower), start.new_tensor(anchor.upper)
            )
            torch.testing.assert_close(moved[-1, slot], wanted)
        slot += anchor.tool.slots


def test_a_pin_first_rolls_to_the_left_and_turns_clockwise_seen_from_above():
    env = made(RollingPin)
    x = torch.zeros(2, SEGMENTS, 3, dtype=torch.float64)
    x[0, 0, 0] = x[1, 0, 1] = 0.5
    rolled, turned = env.tools(x.flatten(1))
    assert rolled[-1, 0, 0] < rolled[0, 0, 0]
    assert turned[-1, 1, 1] < 0


def test_losses_are_their_weighted_terms_each_reported_alone():
    x = made(Rope).space.uniform(3, seed=0)
    terms = made(Rope).terms(x)
    assert tuple(terms) == TERMS
    for term in TERMS:
        weights = {other: float(other == term) for other in TERMS}
        torch.testing.assert_close(made(Rope, **weights).evaluate(x, grad=False).loss, terms[term])
    total = 10 * terms["density"] + 10 * terms["sdf"] + 500 * terms["contact"]
    torch.testing.assert_close(made(Rope).evaluate(x, grad=False).loss, total)


def test_the_sum_over_control_steps_ends_with_the_final_frame():
    env, summed = made(Torus), made(Torus, loss="sum")
    x = env.space.uniform(1, seed=4)
    frames, tools = env.episode(x[0]), env.tools(x)
    with env._solvers.lend() as stage:
        stage.solver.run(tools)
        ends = [stage.solver.read_positions(step, 1) for step in range(STEPS + 1)]
        each = torch.cat([env._terms(stage, ends[step], tools[:, step]) for step in range(1, STEPS + 1)])
    assert len(frames.time) == STEPS + 1
    torch.testing.assert_close(torch.stack(list(summed.terms(x).values()), dim=1), each.sum(dim=0, keepdim=True))
    torch.testing.assert_close(torch.stack(list(env.terms(x).values()), dim=1), each[-1:])


@pytest.mark.parametrize("kind", [Torus, RollingPin], ids=lambda kind: kind.name)
def test_the_sums_gradient_is_its_slope(kind):
    env = made(kind, loss="sum")
    x = env.space.uniform(1, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(env, (x,), fast_mode=True)


def test_a_body_that_is_its_own_target_costs_nothing():
    """Density and distance at t = 0: for geometric targets made of the very shapes the bodies start as."""
    for kind in (TripleMove, Assembly):
        own = replace(kind.scene, target=tuple(piece.shape for piece in kind.scene.pieces))
        still = type("Own", (kind,), {"scene": own})(fidelity=TINY, device="cpu")
        paths = still.tools(torch.zeros(1, still.space.dim, dtype=torch.float64))
        with still._solvers.lend() as stage:
            stage.solver.run(paths)
            terms = dict(
                zip(TERMS, still._terms(stage, stage.solver.read_positions(0, 1), paths[:, 0])[0].tolist(), strict=True)
            )
        assert terms["density"] == pytest.approx(0, abs=1e-12)  # its particles are in another order
        assert terms["sdf"] == 0


def test_triple_moves_targets_are_at_the_listed_centres():
    env = TripleMove(fidelity="standard", device="cpu")
    ends = np.cumsum([len(body.x) for body in env.model.bodies])
    x = np.split(env._target_particles(), ends[:-1])
    centers = [(0.2, 0.2, 0.5029), (0.8, 0.2, 0.2), (0.6254, 0.3436, 0.2002)]
    for block, center in zip(x, centers, strict=True):
        assert np.allclose(block.mean(axis=0), center, atol=2e-3)
        assert np.allclose(np.ptp(block, axis=0), 0.1, atol=2e-3)


@scenes
def test_gradients_are_slopes_where_bodies_start_undeformed_and_where_they_yield(kind):
    """To 1e-4, central differences in float64 at 1e-7, along the gradient itself and along a random direction."""
    env = kind(fidelity=replace(TINY, particles=200), device="cpu")
    x = torch.cat([0.02 * env.space.uniform(1, seed=5), env.space.uniform(2, seed=6)])  # hardly touched; kneaded
    slope = env.evaluate(x).grad
    random = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u = torch.stack([direction / direction.norm(dim=1, keepdim=True).clamp_min(1e-12) for direction in (slope, random)])
    ends = torch.stack([x + 1e-7 * u, x - 1e-7 * u])  # side, direction, row, dim
    ahead, behind = env.evaluate(ends.flatten(0, 2), grad=False).loss.view(ends.shape[:3])
    error = ((ahead - behind) / 2e-7 - (slope * u).sum(dim=2)).abs() / slope.norm(dim=1).clamp_min(1e-3)
    assert float(error.max()) < 1e-4


@pytest.mark.slow
def test_gradients_hold_over_a_thousandth_of_the_box():
    """No jumps in contact or floor: what AD says at a point is what a searcher meets a step of 1e-3 away."""
    for kind in (Writer, Assembly):
        env = kind(fidelity=replace(TINY, resolution=20, particles=400), device="cpu")
        x = env.space.uniform(6, seed=11)
        slope = env.evaluate(x).grad
        u = torch.randn(x.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
        u = u / u.norm(dim=1, keepdim=True)
        ahead, behind = (env.evaluate(x + h * u, grad=False).loss for h in (1e-3, -1e-3))
        error = ((ahead - behind) / 2e-3 - (slope * u).sum(dim=1)).abs() / slope.norm(dim=1)
        assert float(error.median()) < 2e-3


def test_plasticine_at_rest_on_a_sticky_floor_stays():
    x = torch.zeros(15, dtype=torch.float64)
    x[1::3] = 0.2  # the ring rises out of the way
    frames = Torus(fidelity=replace(Torus.fidelities["draft"], precision="float64"), device="cpu").episode(x)
    moved = (frames.points["plasticine 1"][-1] - frames.points["plasticine 1"][0]).norm(dim=1)
    assert float(moved.max()) < 2e-3  # it settles under gravity by less than a fifteenth of a cell
    assert float(moved.median()) < 5e-4
