"""Rewarped's MLS-MPM in Warp, its kernels launched in the order in which its own integrator launches them."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from .protocol import Simulation, run
from .scenes import CUBE, Array, Cube

DIFFERS = (
    "The gradient is Warp's automatic one: every substep keeps its particles and its whole grid.",
    "All nodes of the grid are computed.",
)


def build(scene: Cube, asked: argparse.Namespace) -> Simulation:
    """Return Rewarped's simulation of a scene."""
    import rewarped.warp_mpm_sga.sim.mpm as mpm
    import warp as wp

    episode = Episode(mpm, wp, scene, asked.device)
    return Simulation(
        version=f"rewarped 1.3.3, Warp {wp.config.version}",
        material="neo-Hookean",
        grid=f"{scene.nodes}^3",
        loss=episode.loss,
        gradient=episode.gradient,
        differs=DIFFERS,
    )


class Episode:
    """Hold a model with the states of its substeps: two of them to go forward, all of them once a gradient is asked."""

    def __init__(self, mpm: Any, wp: Any, scene: Cube, device: str) -> None:
        self.mpm, self.wp, self.scene, self.device = mpm, wp, scene, device
        with wp.ScopedDevice(device):
            builder = mpm.MPMModelBuilder().parse_cfg(settings(scene), 1, np.zeros((1, 3)))
            self.model = builder.finalize(device, requires_grad=False)
            material = mpm.materials.get_material("neohookean", E=scene.young, nu=scene.poisson)
            cube = mpm.MPMInitData(scene.density, scene.particles, scene.spacing**3, material, scene.x)
            statics = mpm.MPMStaticsInitializer(self.model)
            statics.add_group(cube)
            self.statics = statics.finalize()
        self.pair = [self._particles(grad=False) for _ in range(2)]
        self.grid = self.model.grid
        self.states: list[Any] = []
        self.grids: list[Any] = []

    def loss(self, parameters: Array) -> float:
        """Return minus the mean x [m] at the end."""
        first, other = self.pair
        self._begin(first, parameters)
        for _ in range(self.scene.substeps):
            self.grid.clear()
            self._step(first, other, self.grid)
            first, other = other, first
        return self._loss(first)

    def gradient(self, parameters: Array) -> Array:
        """Return the gradient by the parameters, by Warp's tape over all substeps."""
        self._keep()
        self._begin(self.states[0], parameters)
        for state in self.states:
            state.zero_grad()
        tape = self.wp.Tape()
        for grid in self.grids:
            grid.clear()
            grid.zero_grad()
        with tape:
            for before, after, grid in zip(self.states, self.states[1:], self.grids, strict=False):
                self._step(before, after, grid)
        self._loss(self.states[-1])
        seed = np.zeros((self.scene.particles, 3), dtype=np.float32)
        seed[:, 0] = -1 / self.scene.particles
        self.states[-1].x.grad.assign(seed)
        tape.backward()
        return self.scene.pull_back(self.states[0].v.grad.numpy().astype(np.float64))

    def _step(self, before: Any, after: Any, grid: Any) -> None:
        model, count, nodes = self.model, self.scene.particles, (1, *3 * (self.scene.nodes,))
        shared = [model.constant, self.statics, before]
        self.wp.launch(model.eval_stress, count, inputs=shared, device=self.device)
        self.wp.launch(model.p2g, count, inputs=[*shared, grid], device=self.device)
        self.wp.launch(model.grid_op, nodes, inputs=[model.constant, grid], device=self.device)
        self.wp.launch(model.g2p, count, inputs=[*shared, after, grid], device=self.device)

    def _begin(self, state: Any, parameters: Array) -> None:
        state.clear()
        state.x.assign(self.scene.x.astype(np.float32))
        state.v.assign(self.scene.velocities(parameters).astype(np.float32))

    def _loss(self, state: Any) -> float:
        return -float(state.x.numpy()[:, 0].astype(np.float64).mean())

    def _keep(self) -> None:
        if not self.states:
            self.states = [self._particles(grad=True) for _ in range(self.scene.substeps + 1)]
            for _ in range(self.scene.substeps):
                self.grids.append(self.mpm.MPMGridData())
                self.grids[-1].init((1, *3 * (self.scene.nodes,)), self.device, True)

    def _particles(self, *, grad: bool) -> Any:
        particles = self.mpm.MPMParticleData()
        particles.init(self.scene.particles, self.device, grad)
        return particles


def settings(scene: Cube) -> dict[str, Any]:
    """Return the scene in the names of Rewarped's configuration; its walls slip as ours do."""
    return {
        "num_grids": scene.nodes,
        "dt": scene.dt,
        "bound": scene.floor,
        "clip_bound": 0.5,
        "gravity": (0.0, -scene.gravity, 0.0),
        "bc": "freeslip",
        "eps": 1e-15,
        "lower_lim": (0.0, 0.0, 0.0),
        "upper_lim": (1.0, 1.0, 1.0),
        "body_friction": 0.0,
        "body_softness": 0.0,
        "ground_friction": 0.0,
    }


if __name__ == "__main__":
    run(CUBE, build)
