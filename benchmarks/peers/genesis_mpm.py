"""Genesis's MPM through its own scenes, with `requires_grad` for the gradient."""

from __future__ import annotations

import argparse
import os
from functools import cache, partial
from importlib.metadata import version
from typing import Any

import numpy as np

from .protocol import Simulation, run
from .scenes import CUBE, Array, Cube

PADDING = 3  # cells between the edge of its grid and its walls, whose node the walls take
LONGEST = 16  # substeps of a step, all of which a differentiable scene holds with their grids
DIFFERS = (
    "All nodes of the grid are computed. A differentiable scene also decomposes every deformation gradient (SVD), "
    "which this material does not need.",
    "Walls take a particle's velocity too, and keep its place 3 cells from the edge of the grid.",
    "The gradient is its compiler's automatic one; steps of at most 16 substeps are kept, and the others run again.",
    "A step goes through the rest of its simulator (a rigid solver, couplings), which a cube does not need.",
)


def build(scene: Cube, asked: argparse.Namespace) -> Simulation:
    """Return Genesis's simulation of a scene: one of its scenes to go forward, and one that is differentiable."""
    os.environ.setdefault("PYGLET_HEADLESS", "true")  # it draws nothing, and asks for a display when it is imported
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    import genesis as gs
    import torch

    gs.init(backend=gs.cuda if asked.device == "cuda" else gs.cpu, precision="32", logging_level="error", seed=0)
    forward = make(gs, scene, grad=False)
    around = cache(partial(make, gs, scene, grad=True))  # made when it is wanted, so that going forward takes no more

    def simulate(which: tuple[Any, Any, int], velocity: Any) -> Any:
        world, cube, steps = which
        world.reset()
        cube.set_velocity(velocity)
        for _ in range(steps):
            world.step()
        return cube

    def loss(parameters: Array) -> float:
        velocity = torch.tensor(scene.velocities(parameters), dtype=torch.float32, device=gs.device)
        place = simulate(forward, velocity).get_particles_pos()
        return -float(place.reshape(-1, 3)[:, 0].double().mean())

    def gradient(parameters: Array) -> Array:
        velocity = torch.tensor(scene.velocities(parameters), dtype=torch.float32, device=gs.device, requires_grad=True)
        place = simulate(around(), velocity).get_state().pos
        (-place.reshape(-1, 3)[:, 0].mean()).backward()
        return scene.pull_back(velocity.grad.detach().cpu().numpy().reshape(-1, 3).astype(np.float64))

    return Simulation(
        version=f"genesis-world {version('genesis-world')}, quadrants {version('quadrants')}",
        material="neo-Hookean",
        grid=f"{forward[0].sim.mpm_solver.grid_res[0]}^3",
        loss=loss,
        gradient=gradient,
        differs=DIFFERS,
    )


def make(gs: Any, scene: Cube, *, grad: bool) -> tuple[Any, Any, int]:
    """Return a scene of Genesis, its cube, and how many of its steps make an episode."""
    substeps = max(n for n in range(1, LONGEST + 1) if scene.substeps % n == 0)
    world = gs.Scene(
        sim_options=gs.options.SimOptions(
            dt=substeps * scene.dt, substeps=substeps, gravity=(0.0, -scene.gravity, 0.0), requires_grad=grad
        ),
        mpm_options=gs.options.MPMOptions(
            grid_density=scene.nodes,
            particle_size=scene.spacing,
            lower_bound=((scene.floor - 1 - PADDING) * scene.dx,) * 3,
            upper_bound=((scene.wall + PADDING) * scene.dx,) * 3,
        ),
        show_viewer=False,
    )
    low, high = scene.x.min(axis=0) - scene.spacing / 2, scene.x.max(axis=0) + scene.spacing / 2
    material = gs.materials.MPM.Elastic(
        E=scene.young, nu=scene.poisson, rho=scene.density, model="neohooken", sampler="regular"
    )
    cube = world.add_entity(material=material, morph=gs.morphs.Box(lower=tuple(low), upper=tuple(high)))
    world.build()
    if cube.n_particles != scene.particles:
        raise ValueError(f"Genesis fills the cube with {cube.n_particles} particles; wanted {scene.particles}")
    return world, cube, scene.substeps // substeps


if __name__ == "__main__":
    run(CUBE, build)
