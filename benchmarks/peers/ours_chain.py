"""Our chain of three links, driven as the scene `cartpole` drives it, from a cart at rest."""

from __future__ import annotations

import argparse

import numpy as np
import torch

import gradscape
from gradscape.envs.engines.chain import Chain as Links
from gradscape.envs.engines.chain import Solver

from .protocol import Simulation, run
from .scenes import CHAIN, Array, Chain


def build(scene: Chain, asked: argparse.Namespace) -> Simulation:
    """Return our simulation of a scene."""
    links = Links(masses=scene.masses, lengths=(1.0, 1.0, 1.0), gravity=scene.gravity)
    settings = {"dt": scene.dt, "hold": scene.hold, "controls": scene.controls, "name": "float32"}
    solver = Solver(links, capacity=scene.particles, device=asked.device, **settings)
    rest = torch.zeros(3, dtype=torch.float64)

    def swing(parameters: Array) -> torch.Tensor:
        torques = torch.from_numpy(scene.torques(parameters))
        controls = torch.cat([torch.zeros_like(torques[..., :1]), torques], dim=2)
        return solver.run(rest, rest, controls).cpu().double().requires_grad_()

    def distance(phi: torch.Tensor) -> torch.Tensor:
        last = phi[-1]
        tip = torch.stack([last.sin().sum(dim=1), -last.cos().sum(dim=1) - scene.target], dim=1)
        return tip.norm(dim=1).mean()

    def gradient(parameters: Array) -> Array:
        phi = swing(parameters)
        (adjoint,) = torch.autograd.grad(distance(phi), phi)
        found = solver.gradient(adjoint)[..., 1:].double().cpu().numpy()
        return scene.pull_back(np.ascontiguousarray(found))

    return Simulation(
        version=f"gradscape {gradscape.__version__}",
        material="rods",
        grid="none",
        loss=lambda parameters: float(distance(swing(parameters).detach())),
        gradient=gradient,
        differs=("Equations of motion of this one chain, in angles and momenta, with a cart that can move.",),
    )


if __name__ == "__main__":
    run(CHAIN, build)
