"""Print how fast a cube sinks or rises in the syrup of `fluid`, beside what is known of cubes between walls.

The ladle is away, the tank 0.2 m full, and the cube in the middle of it. The mean of the speeds of a heavy and a light
cube is free of what a neutral cube drifts, which is printed too. Known are Stokes' speed of the sphere of its volume,
that a cube is 0.92 times as fast (Pettyjohn and Christiansen, Chemical Engineering Progress 44, 157, 1948), and what
slippery walls and a surface change, by images (Happel and Brenner, Low Reynolds Number Hydrodynamics, 1965, chapter 7).

    python benchmarks/drag.py --resolution 24 --sampling 1.3333 --viscosity 30 60
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.mpm import fluid

DEPTH = 0.2  # of the syrup [m]
LAST = 10  # control steps over which a speed is taken
SHAPE = 0.92  # a cube's speed, as a share of that of the sphere of its volume
TERMS, BLUR = 40, 0.02  # of the sum over waves; how wide a force is spread [m], to the first order of no influence
RADIUS = fluid.CUBE_EDGE * (3 / (4 * np.pi)) ** (1 / 3)  # of the sphere of the cube's volume [m]
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
    fluid.RIM, fluid.FILL, fluid.CUBE_CENTER = (0.0, 10.0, 0.0), DEPTH, (0.025, DEPTH / 2, 0.0)
    substeps = max(7, round(0.46 * wanted.resolution))
    fidelity = Fidelity("drag", dt=fluid.SPAN / substeps, resolution=wanted.resolution, sampling=wanted.sampling)
    print(f"known: {SHAPE * wall_factor(fluid.TANK_WIDTH):.2f} of Stokes' speed")
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
    """Return how fast a cube sinks over the last of so many control steps [m/s]."""
    scene = fluid.Fluid(fidelity=fidelity, device=device, viscosity=viscosity, cube_density=density)
    _, before, after = heights(scene, steps)
    return (before - after) / (LAST * fluid.SPAN)


def heights(scene: fluid.Fluid, steps: int) -> list[float]:
    """Return how high the cube is, without a ladle, at first, LAST control steps before the end and at the end [m]."""
    away = torch.tensor([0.0, 10.0, 0.0], dtype=torch.float64).expand(1, steps + 1, 1, 3)
    with scene._solvers.lend() as stage:
        stage.solver.run(away.to(scene.device))
        found = (stage.solver.read_positions(step, 1).double().cpu() for step in (0, steps - LAST, steps))
        return [float(scene._center(place)[0, 1]) for place in found]


def stokes_speed(viscosity: float) -> float:
    """Return Stokes' speed of a sphere of the cube's volume and EXCESS [m/s]."""
    return float(2 / 9 * EXCESS * fluid.GRAVITY * RADIUS**2 / viscosity)


def wall_factor(width: float) -> float:
    """Return how fast a small body sinks in the middle of a square tank of a width [m], as a share of without walls.

    Slippery walls reflect: the body has images of the same force beside it, and of the opposite force below the floor
    and above the surface. That is a lattice of forces, whose velocity is a sum over waves.
    """
    count = int(TERMS * 2 * DEPTH / width) + 1
    across, up = (
        2 * np.pi / length * np.arange(-most, most + 1) for length, most in ((width, TERMS), (2 * DEPTH, count))
    )
    kx, ky, kz = np.meshgrid(across, up, across, indexing="ij")
    square = kx**2 + ky**2 + kz**2
    square[square == 0] = np.inf
    waves = (1 - np.cos(ky * DEPTH)) * (1 - ky**2 / square) / square * np.exp(-square * BLUR**2)
    alone = 1 / (6 * np.pi**1.5 * BLUR)
    return float(1 + 6 * np.pi * RADIUS * (waves.sum() / (2 * DEPTH * width**2) - alone))


if __name__ == "__main__":
    main()
