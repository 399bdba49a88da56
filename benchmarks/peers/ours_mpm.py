"""Our MLS-MPM, driven as the scenes drive it: a cube thrown against a wall."""

from __future__ import annotations

import argparse

import numpy as np
import torch

import gradscape
from gradscape.envs.engines.mpm.boundaries import Kind, Tool, ToolsInRoom
from gradscape.envs.engines.mpm.materials import Elastic
from gradscape.envs.engines.mpm.model import Body, Model
from gradscape.envs.engines.mpm.solver import Solver
from gradscape.envs.engines.runtime import to_torch

from .protocol import Simulation, run
from .scenes import CUBE, Array, Cube

LONGEST = 16  # substeps of a control step, between which particles are sorted
AWAY = 10.0  # where the tool is that the boundary wants [m]


def build(scene: Cube, asked: argparse.Namespace) -> Simulation:
    """Return our simulation of a scene."""
    model = make_model(scene)
    solver = Solver(model, capacity=1, device=asked.device)
    tools = torch.full((1, model.steps + 1, 1, 3), AWAY, dtype=torch.float64)
    adjoint = torch.zeros(1, scene.particles, 3, device=asked.device)
    adjoint[..., 0] = -1 / scene.particles

    def loss(parameters: Array) -> float:
        velocity = torch.from_numpy(scene.velocities(parameters))
        to_torch(solver.checkpoints[0].v)[0] = velocity.to(to_torch(solver.checkpoints[0].v))
        return -float(solver.run(tools)[0, :, 0].double().mean())

    def gradient(parameters: Array) -> Array:
        loss(parameters)
        solver.gradient({model.steps: adjoint})
        found = solver.orders[0].to_model(to_torch(solver.adjoint.new.v))[0]
        return scene.pull_back(found.cpu().double().numpy())

    return Simulation(
        version=f"gradscape {gradscape.__version__}",
        material="neo-Hookean",
        grid=f"{scene.nodes}^3",
        loss=loss,
        gradient=gradient,
        differs=("Only the nodes around the cube are computed.",),
    )


def make_model(scene: Cube) -> Model:
    """Return the cube in a room with slippery walls and floor."""
    substeps = max(n for n in range(1, LONGEST + 1) if scene.substeps % n == 0)
    inner, outer = (scene.floor - 0.5) * scene.dx, (scene.wall - 0.5) * scene.dx  # between nodes, so that none is on it
    room = ToolsInRoom(
        (Tool(Kind.SPHERE, (scene.dx,), 0.0),),
        lower=(inner,) * 3,
        upper=(outer,) * 3,
        floor=inner,
        friction=0.0,
        softness=666.0,
    )
    one = np.ones(scene.particles)
    body = Body(Elastic(scene.density, scene.young, scene.poisson), scene.x, scene.spacing**3 * one, one)
    return Model(
        precision="float32",
        bodies=(body,),
        boundary=room,
        origin=(0.0, 0.0, 0.0),
        dx=scene.dx,
        nodes=(scene.nodes,) * 3,
        dt=scene.dt,
        substeps=substeps,
        steps=scene.substeps // substeps,
        gravity=scene.gravity,
    )


if __name__ == "__main__":
    run(CUBE, build)
