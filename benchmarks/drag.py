"""Print how fast a cube sinks or rises in the syrup of `fluid`, beside Stokes' speed for the sphere of its volume.

The ladle is away, the tank 0.2 m full, and the cube in the middle of it. The mean of the speeds of a heavy and a light
cube is free of what a neutral cube drifts, which is printed too.

    python benchmarks/drag.py --resolution 24 --sampling 1.3333 --viscosity 30 60
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.mpm import fluid

EXCESS = 470.0  # density of the heavy cube above the syrup's, and of the light one below [kg/m^3]


def main() -> None:
    """Measure, and print a line for each viscosity."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--resolution", type=int, default=24)
    parser.add_argument("--sampling", type=float, default=4 / 3)
    parser.add_argument("--viscosity", type=float, nargs="+", default=[30.0, 60.0])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--device", default="cpu")
    wanted = parser.parse_args()
    fluid.RIM, fluid.FILL, fluid.CUBE_CENTER = (0.0, 10.0, 0.0), 0.2, (0.025, 0.1, 0.0)
    substeps = max(7, round(0.46 * wanted.resolution))
    fidelity = Fidelity("drag", dt=fluid.SPAN / substeps, resolution=wanted.resolution, sampling=wanted.sampling)
    for viscosity in wanted.viscosity:
        heavy, light, neutral = (
            fall(fidelity, viscosity, fluid.SYRUP_DENSITY + excess, wanted.steps, wanted.device)
            for excess in (EXCESS, -EXCESS, 0.0)
        )
        stokes = stokes_speed(viscosity)
        print(
            f"{viscosity:g} Pa s: heavy {heavy / stokes:.2f}, light {light / stokes:.2f}, neutral"
            f" {neutral / stokes:.2f}, half of heavy less light {(heavy - light) / 2 / stokes:.2f} of {stokes:.4f} m/s",
            flush=True,
        )


def fall(fidelity: Fidelity, viscosity: float, density: float, steps: int, device: str) -> float:
    """Return how fast a cube sinks over the last ten of so many control steps [m/s]."""
    scene = fluid.Fluid(fidelity=fidelity, device=device, viscosity=viscosity, cube_density=density)
    away = torch.tensor([0.0, 10.0, 0.0], dtype=torch.float64).expand(1, steps + 1, 1, 3)
    with scene._solvers.lend() as stage:
        stage.solver.run(away.to(device))
        before, after = (
            float(scene._center(stage.solver.read_positions(k, 1).double().cpu())[0, 1]) for k in (steps - 10, steps)
        )
    return (before - after) / (10 * fluid.SPAN)


def stokes_speed(viscosity: float) -> float:
    """Return Stokes' speed of a sphere of the cube's volume and EXCESS [m/s]."""
    radius = fluid.CUBE_EDGE * (3 / (4 * np.pi)) ** (1 / 3)
    return float(2 / 9 * EXCESS * fluid.GRAVITY * radius**2 / viscosity)


if __name__ == "__main__":
    main()
