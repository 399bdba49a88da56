"""Newton's implicit MPM, which has no gradient: a cube of its elastic material against a wall of its own."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from .protocol import Simulation, run
from .scenes import CUBE, Array, Cube

WHY = "its kernels are compiled without adjoints (`enable_backward` is False in all of its implicit MPM)."
DIFFERS = (
    "It is implicit: a substep solves for stress by Gauss-Seidel to a tolerance of 1e-4. It may be much longer than "
    "ours; here it is as long.",
    "Linear velocities and constant strains in a cell of a sparse grid, where ours has quadratic B-splines.",
    "Its own elastic law with the same Young's modulus and Poisson's ratio; residual strain is carried as it advises "
    "for soft bodies.",
    "The wall is a plane without friction, at the face of the node that ours begins at.",
)


def build(scene: Cube, asked: argparse.Namespace) -> Simulation:
    """Return Newton's simulation of a scene."""
    import newton
    import warp as wp

    device = "cuda:0" if asked.device == "cuda" else "cpu"
    with wp.ScopedDevice(device):
        model = make(newton, wp, scene)
        config = newton.solvers.SolverImplicitMPM.Config()
        config.voxel_size = scene.dx
        config.carry_residual_strain = "unconverged"
        config.air_drag = 0.0

    def loss(parameters: Array) -> float:
        with wp.ScopedDevice(device):
            state = model.state()
            state.particle_qd.assign(scene.velocities(parameters).astype(np.float32))
            solver = newton.solvers.SolverImplicitMPM(model, config=config)
            for _ in range(scene.substeps):
                solver.step(state, state, None, None, scene.dt)
            return -float(state.particle_q.numpy()[:, 0].astype(np.float64).mean())

    return Simulation(
        version=f"newton {newton.__version__}, Warp {wp.config.version}",
        material="its elastic one",
        grid="sparse, 64 cells a metre",
        loss=loss,
        gradient=None,
        why=WHY,
        differs=DIFFERS,
    )


def make(newton: Any, wp: Any, scene: Cube) -> Any:
    """Return a model of the cube and the wall."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -scene.gravity, 0.0))
    newton.solvers.SolverImplicitMPM.register_custom_attributes(builder)
    mass, radius = scene.density * scene.spacing**3, scene.spacing / 2
    for place in scene.x:
        builder.add_particle(pos=wp.vec3(*place), vel=wp.vec3(0.0), mass=mass, radius=radius)
    smooth = newton.ModelBuilder.ShapeConfig(mu=0.0)
    builder.add_shape_plane(plane=(-1.0, 0.0, 0.0, scene.wall * scene.dx), width=0.0, length=0.0, cfg=smooth)
    model = builder.finalize()
    model.mpm.young_modulus.fill_(scene.young)
    model.mpm.poisson_ratio.fill_(scene.poisson)
    model.mpm.tensile_yield_ratio.fill_(1.0)
    return model


if __name__ == "__main__":
    run(CUBE, build)
