"""The Taichi engine against the Warp engine: the same scenes to the last digits, by other code and other gradients."""

import threading
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.engines.mpm import solver as mpm
from gradscape.envs.engines.mpm.boundaries import STICKY, Kind, Open, Tool, ToolsInRoom
from gradscape.envs.engines.mpm.materials import Elastic, Fluid, Plasticine
from gradscape.envs.engines.mpm.model import Body, Model
from gradscape.envs.engines.taichi import mpm as taichi_mpm
from gradscape.envs.engines.taichi.mpm import boundary_contact, kernels
from gradscape.envs.engines.taichi.runtime import real, start
from gradscape.envs.mpm import fluid

from ..bench import DT, IDENTITY, MASS, SCALE, VOLUME, MaterialBench, draw, rotations, vectors

pytestmark = pytest.mark.slow

SYRUP = Fluid(1000.0, 4e4, viscosity=4.0)
SPONGE = Elastic(1000.0, 2e4, 0.3)
CLAY = Plasticine(1000.0, 2e4, 0.3, yield_stress=100.0)


def scene(**options):
    """Return the coarsest fluid scene with these options, and two paths of its ladle."""
    tiny = Fidelity("tiny", dt=fluid.SPAN / 2, precision="float64", resolution=6, sampling=1.5)
    environment = fluid.Fluid(fidelity=tiny, device="cpu", **options)
    x = torch.stack([environment.example("scoop"), 2 * draw(10, seed=1)])
    return replace(environment.model, steps=20), environment.tools(x)[:, :21].contiguous()


def block(material, x):
    """Return 27 particles around x."""
    offsets = np.stack(np.meshgrid(*[np.linspace(-0.04, 0.04, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return Body(material, offsets + np.array([x, 0.14, 0.0]), np.full(27, 0.04**3), np.full(27, 0.98))


def crowded(friction=0.5, **changes):
    """Return a block of each material on a floor that every kind of tool presses and rubs, and two sets of paths.

    No node lies on a tool's axis, where its normal turns within a micrometre.
    """
    tools = (
        Tool(Kind.SPHERE, (0.06,), 0.3),
        Tool(Kind.CAPSULE, (0.03, 0.04), 0.9),
        Tool(Kind.TORUS, (0.06, 0.03), 0.5),
        Tool(Kind.CYLINDER, (0.05, 0.05), 0.2),
        Tool(Kind.ROLLER, (0.05, 0.04), 0.9),
    )
    room = ToolsInRoom(tools, (-0.4, 0.0, -0.15), (0.4, 0.6, 0.15), 0.1, friction, 60.0)
    bodies = tuple(block(material, x) for material, x in ((SYRUP, -0.2), (CLAY, 0.0), (SPONGE, 0.2)))
    model = Model("float64", bodies, room, (-0.5, 0.0, -0.25), 0.05, (21, 15, 11), 2e-3, 5, 4)
    places = vectors((-0.2, 0.22, 0), (0.2, 0.22, 0), (0, 0.2, 0), (0, 0.12, 0.1), (0.1, 0.2, 0), (0, 0, 0)) + 0.013
    time = torch.arange(5, dtype=torch.float64)[:, None, None]
    return replace(model, **changes), places + time * 0.02 * draw(2, 1, 6, 3, seed=3) - time * 0.004


MODELS = {
    "bowl between sticky walls": lambda: scene(handle=False, walls="stick"),
    "crowded": crowded,
    "sticky": lambda: crowded(STICKY),
}


@dataclass
class Result:
    """What an engine makes of a model."""

    ends: torch.Tensor
    way: torch.Tensor
    gradient: torch.Tensor
    left: torch.Tensor


def solved(engine, model, tools):
    """Run a model by one engine; two control steps have a say in the gradient."""
    solver = engine.Solver(model, capacity=len(tools) + 1, device="cpu")
    ends = solver.run(tools).clone()
    adj_x = {step: draw(*ends.shape, seed=step) for step in (2, model.steps)}
    way = solver.read_positions(2, len(tools)).clone()
    return Result(ends, way, solver.gradient(adj_x), solver.read_escaped(len(tools)))


def relative(a, b):
    return float((a - b).abs().max() / b.abs().max())


@pytest.mark.parametrize("name", MODELS)
def test_both_engines_agree_to_round_off(name):
    model, tools = MODELS[name]()
    ours, theirs = solved(taichi_mpm, model, tools), solved(mpm, model, tools)
    moved = (theirs.ends - theirs.ends.new_tensor(np.concatenate([body.x for body in model.bodies]))).norm(dim=2)
    assert moved.max() > 0.01
    assert relative(ours.way, theirs.way) < 1e-12
    assert relative(ours.ends, theirs.ends) < 1e-12
    assert relative(ours.gradient, theirs.gradient) < 1e-10
    assert (theirs.gradient != 0).any(dim=3).any(dim=0).sum() > tools[0].numel() / 6  # most tools matter


def test_a_solver_forgets_the_run_before():
    model, tools = crowded()
    solver = taichi_mpm.Solver(model, capacity=2, device="cpu")
    adj_x = {model.steps: draw(1, model.particles, 3, seed=7)}
    found = []
    for paths in (tools[:1], tools[1:], tools[:1]):
        end = solver.run(paths).clone()
        found.append((end, solver.gradient(adj_x), solver.gradient(adj_x)))
    for first, again in zip(found[0], found[2], strict=True):
        assert relative(first, again) < 1e-12
    assert relative(found[0][1], found[0][2]) < 1e-12
    assert relative(found[0][0], found[1][0]) > 1e-6


def test_both_engines_report_the_same_particles_out_of_the_grid():
    model, tools = crowded(boundary=Open(), substeps=20)
    for gravity in (0.0, 1e2, -1e2):
        falling = replace(model, bodies=model.bodies[:1], gravity=gravity)
        ours, theirs = (solved(engine, falling, tools[:, :, :1]) for engine in (taichi_mpm, mpm))
        assert ours.ends.isfinite().all()
        assert ours.left.tolist() == theirs.left.tolist() == [gravity != 0] * 2


def test_a_stopped_solver_says_so():
    model, tools = crowded()
    stop = threading.Event()
    solver = taichi_mpm.Solver(model, capacity=2, device="cpu", stop=stop)
    stop.set()
    threads = torch.get_num_threads()
    with pytest.raises(InterruptedError, match="stopped"):
        solver.run(tools)
    assert torch.get_num_threads() == threads


def states(material):
    """Return states that are still, strained, equally strained, and near or past what a material bears."""
    if isinstance(material, Fluid):
        return 1.0 + 0.4 * draw(40, seed=8)
    random = IDENTITY + 0.4 * draw(20, 3, 3, seed=9)
    if isinstance(material, Elastic):
        return torch.cat([IDENTITY.expand(5, 3, 3), random])
    s = vectors((1.2, 1.2, 0.9), (0.7, 1.1, 1.1), (1.3, 0.8, 0.03), (1.2, 0.04, 0.02), (1.1, 0.9, -0.3))
    turned = rotations(5, seed=10) @ torch.diag_embed(s) @ rotations(5, seed=11)
    return torch.cat([IDENTITY.expand(5, 3, 3), IDENTITY + 1e-7 * random[:5], random, turned])


@pytest.mark.parametrize("material", [SYRUP, SPONGE, CLAY, replace(CLAY, yield_stress=1e9)])
def test_materials_and_their_adjoints_agree_with_warps(material):
    S = states(material)
    C, adj_new, adj_A = (20 * draw(len(S), 3, 3, seed=12), draw(*S.shape, seed=13), draw(len(S), 3, 3, seed=14))
    start("cpu")
    update, adjoint = kernels(material, "float64")
    C_, A_, S_ = torch.zeros(1, 1, len(S), 3, 3), torch.zeros(1, 1, len(S), 3, 3), torch.zeros(2, 1, *S.shape)
    C_, A_, S_ = (array.double().requires_grad_() for array in (C_, A_, S_))
    C_.detach()[0, 0], S_.detach()[0, 0] = C, S
    for array in (C_, A_, S_):
        array.grad = torch.zeros_like(array)
    S_.grad[1, 0], A_.grad[0, 0] = adj_new, adj_A
    each = [torch.full((len(S),), value, dtype=torch.float64) for value in (MASS, VOLUME)]
    inputs = (0, 1, 0, DT, SCALE, *material.constants().values(), *each, C_, S_, A_)
    update(*inputs)
    adjoint(*inputs)
    bench = MaterialBench(material)
    for ours, theirs in zip((S_.detach()[1, 0], A_.detach()[0, 0]), bench.update(S, C), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12 * float(theirs.abs().max()))
    for ours, theirs in zip((S_.grad[0, 0], C_.grad[0, 0]), bench.adjoint(S, C, adj_new, adj_A), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9 * float(theirs.abs().max()))


def test_taichi_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="cpu and cuda; got device 'tpu'"):
        start("tpu")
    start("cpu")
    with pytest.raises(ValueError, match="runs only on cpu in this process"):
        start("cuda")
    with pytest.raises(ValueError, match="float32 or float64; got 'float16'"):
        real("float16")
    with pytest.raises(ValueError, match="knows Open, LadleInTank and ToolsInRoom; got boundary 'sea'"):
        boundary_contact("sea", "float64")
