"""Bodies of fluid, clay and sponge that MLS-MPM is tested with: in empty space, in a tank, under tools."""

from dataclasses import replace

import numpy as np
import torch

from gradscape.envs.engines.mpm.boundaries import Kind, LadleInTank, Open, Tool, ToolsInRoom
from gradscape.envs.engines.mpm.materials import Elastic, Fluid, Plasticine
from gradscape.envs.engines.mpm.model import Body, Model
from gradscape.envs.engines.mpm.solver import Solver
from gradscape.envs.engines.runtime import to_torch

from ..bench import draw

DENSITY, SPEED, GRAVITY = 1330.0, 6.0, 9.81  # [kg/m^3], of sound [m/s], [m/s^2]
SYRUP = Fluid(DENSITY, DENSITY * SPEED**2, viscosity=4.0)
SPONGE = Elastic.with_wave_speed(DENSITY, SPEED, poisson=0.3)
CLAY = Plasticine(DENSITY, SPONGE.young, SPONGE.poisson, yield_stress=150.0)
FIRM = replace(CLAY, yield_stress=1e5)  # never yields
MATERIALS = {"fluid": SYRUP, "elastic": SPONGE, "plasticine": FIRM}
WIDTH, DEPTH = 0.2, 0.15  # of the tank and of what fills it [m]
SPAN = 0.01  # length of a control step [s]


def lattice(counts, sides):
    """Return the centres of equal cells of a box that stands on the middle of the plane y = 0."""
    axes = [(np.arange(n) + 0.5) / n * side for n, side in zip(counts, sides, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return x - np.array([sides[0] / 2, 0, sides[2] / 2])


def block(material, corner, side=0.1, count=4):
    x = lattice((count,) * 3, (side,) * 3) + np.array(corner)
    return Body(material, x, np.full(count**3, (side / count) ** 3), np.ones(count**3))


def free_model(**changes):
    """Return a block of fluid, of clay and of sponge in empty space."""
    model = Model(
        precision="float64",
        bodies=(block(SYRUP, (-0.1, 0.4, 0.0)), block(CLAY, (0, 0.27, 0.0)), block(SPONGE, (0.07, 0.45, 0.0))),
        boundary=Open(),
        origin=(-0.3, 0.0, -0.3),
        dx=0.05,
        nodes=(13, 16, 13),
        dt=SPAN / 5,
        substeps=5,
        steps=12,
        gravity=0.0,
    )
    return replace(model, **changes)


def tank(material, dx, *, at_rest, steps):
    """Return a tank full of one material, compressed as its own weight does, or not at all."""
    counts = [round(2 * side / dx) for side in (WIDTH, DEPTH, WIDTH)]
    x = lattice(counts, (WIDTH, DEPTH, WIDTH))
    pressure = DENSITY * GRAVITY * (DEPTH - x[:, 1]) * at_rest
    margin = 2
    across = round(WIDTH / dx) + 1 + 2 * margin
    ladle = {"radius": 0.07, "half_thickness": 0.01, "height": 0.25, "friction": 0.1}
    return Model(
        precision="float64",
        bodies=(Body(material, x, np.full(len(x), WIDTH * DEPTH * WIDTH / len(x)), material.volume_ratio(pressure)),),
        boundary=LadleInTank(half_width=WIDTH / 2, lid=0.25, band=0.75 * dx, **ladle),
        origin=(-WIDTH / 2 - margin * dx, -margin * dx, -WIDTH / 2 - margin * dx),
        dx=dx,
        nodes=(across, round(0.25 / dx) + 1 + 2 * margin, across),
        dt=SPAN / 10,
        substeps=10,
        steps=steps,
        gravity=GRAVITY,
    )


def parked(model, batch=1):
    """Return tools that stay 10 m above everything."""
    return torch.tensor([0.0, 10.0, 0.0], dtype=torch.float64).expand(batch, model.steps + 1, 1, 3)


def solved(model, batch=1, velocity=None):
    """Run a model; `velocity` [m/s], shape (batch, particle, 3), is that of the first frame."""
    solver = Solver(model, capacity=batch, device="cpu")
    if velocity is not None:
        to_torch(solver.checkpoints[0].v)[:] = velocity
    solver.run(parked(model, batch))
    return solver


def over_time(solver, name):
    """Return x or v at the ends of control steps, shape (step + 1, batch, particle, 3)."""
    pairs = zip(solver.orders, solver.checkpoints, strict=True)
    return torch.stack([order.to_model(to_torch(getattr(frame, name))) for order, frame in pairs])


def masses(model):
    return torch.cat([torch.from_numpy(body.mass) for body in model.bodies])


def lumps(*materials):
    """Return two lumps on a floor."""
    return tuple(block(each, (x, 0.1, 0.0), count=3) for each, x in zip(materials, (-0.12, 0.09), strict=True))


def kneading(**changes):
    """Return a model of two lumps of clay on a floor, with a ball and a roller, and paths that press and drag them."""
    room = ToolsInRoom(
        (Tool(Kind.SPHERE, (0.06,), 0.3), Tool(Kind.ROLLER, (0.05, 0.04), 0.9)),
        lower=(-0.6, 0.0, -0.3),
        upper=(0.6, 0.7, 0.3),
        floor=0.1,
        friction=0.5,
        softness=60.0,
    )
    clay = replace(CLAY, yield_stress=50.0)
    model = free_model(
        bodies=lumps(clay, clay), boundary=room, origin=(-0.7, 0.0, -0.4), nodes=(29, 16, 17), gravity=GRAVITY, steps=4
    )
    model = replace(model, **changes)
    generator = torch.Generator().manual_seed(5)
    start = torch.tensor([[-0.117, 0.251, 0.003], [0.083, 0.232, 0.007], [0.0, 0.3, 0.0]], dtype=torch.float64)
    travel = torch.tensor([[0.004, -0.01, 0.003], [-0.006, -0.008, 0.002], [0.1, 0.05, 0.0]], dtype=torch.float64)
    time = torch.arange(model.steps + 1, dtype=torch.float64)[:, None, None]
    paces = 0.5 + torch.rand((3, 1, 3, 3), generator=generator, dtype=torch.float64)
    return model, start + time * travel * paces


def weights(model, batch, seed):
    return draw(batch, model.particles, 3, seed=seed)


def kneaded(model, paths, adj_x, *, columns=False, pieces=1):
    """Return (solver, last x, gradient)."""
    solver = Solver(model, capacity=len(paths), device="cpu", columns=columns, pieces=pieces)
    return solver, solver.run(paths).clone(), solver.gradient(adj_x)


def stirred(*, smoothing=0.0, columns=False, pieces=1):
    """Return a solver of a coarse tank, and the path of a ladle that stirs it.

    Nodes lie nowhere on the bowl's mid-surface nor in the plane of its rim: there the normal jumps, or bends.
    """
    model = tank(replace(SYRUP, smoothing=smoothing), 0.05, at_rest=True, steps=6)
    time = torch.linspace(0, 1, model.steps + 1, dtype=torch.float64)
    path = torch.stack([0.003 + 0.02 * time, 0.1141 - 0.05 * time, 0.007 + 0.01 * time], dim=-1)[None, :, None]
    solver = Solver(model, capacity=2, device="cpu", columns=columns, pieces=pieces)
    return solver, path.expand(2, -1, -1, -1).contiguous()
