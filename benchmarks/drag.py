"""Print how fast cubes sink, rise and float in the syrup of `fluid`, relative to known values between walls.

There is no ladle. Each line is a start: the cube in the middle of the syrup, with its top at the surface, half in, or
standing on it. In the middle, a cube heavier than syrup is paired with one lighter by the same amount. Half the
difference of their speeds is compared with the drag law, and half their sum with the weight of the displaced syrup: an
error of the buoyancy. From the surface, the heavy cube's speed is printed when its top is as deep as WETTED, when it
has slowed down, and at the end.

Known are Stokes' speed of a sphere with the cube's volume, the factor 0.92 for a cube (Pettyjohn and Christiansen,
Chemical Engineering Progress 44, 157, 1948), and the effect of slippery walls and a surface, by images (Happel and
Brenner, Low Reynolds Number Hydrodynamics, 1965, chapter 7), to first order in size over distance. Close below the
surface a cube is slower, because syrup has to flow over it in a thin film (a film of h lets it sink at about h^3 p /
(600 mm^2 x 3 viscosity)).

    python -m benchmarks.drag --resolution 16 --width 0.2
    python -m benchmarks.drag --resolution 32 --width 0.4 --device cuda
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.mpm import fluid

EXCESS = 670.0  # density of the heavy cube above the syrup's, and of the light one below [kg/m^3]
SHAPE = 0.92  # a cube's speed, as a share of that of the sphere of its volume
TERMS, BLUR = 40, 0.02  # of the sum over waves; how wide a force is spread [m], to the first order of no influence
RADIUS = fluid.CUBE_EDGE * (3 / (4 * np.pi)) ** (1 / 3)  # of the sphere of the cube's volume [m]
SETTLED = slice(15, 30)  # control steps over which speeds in the middle are taken
STARTS = {"top at the surface": -0.5, "half in": 0.0, "on the surface": 0.5}  # centre above the surface, in edges
DURATION = 0.5  # of an episode of horizon 1 [s]
WETTED = 0.01  # how deep a cube's top is that has gone under [m]


def main() -> None:
    """Measure, and print a line for each start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--resolution", type=int, default=16)
    parser.add_argument("--width", type=float, default=0.2, help="of the tank [m]")
    parser.add_argument("--sampling", type=float, default=1.5)
    parser.add_argument("--viscosity", type=float, default=20.0)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--device", default="cpu")
    wanted = parser.parse_args()
    fluid.RIM, fluid.TANK_WIDTH = (0.0, 10.0, 0.0), wanted.width
    substeps = max(6, round(14 * 0.0125 / wanted.width * wanted.resolution))
    fidelity = Fidelity("drag", dt=fluid.SPAN / substeps, resolution=wanted.resolution, sampling=wanted.sampling)
    known = known_speed(wanted.viscosity, wanted.width, fluid.FILL)
    print(f"known: {known * 1e3:.1f} mm/s between walls, for {EXCESS:g} kg/m^3 more than syrup", flush=True)

    def fall(excess: float, start: float, seconds: float) -> np.ndarray:
        return heights(fidelity, wanted.viscosity, fluid.SYRUP_DENSITY + excess, start, seconds, wanted.device)

    print_middle([speed(fall(excess, fluid.FILL / 2, 0.3)) for excess in (EXCESS, -EXCESS)], known)
    for name, edges in STARTS.items():
        print_start(name, fall(EXCESS, fluid.FILL + edges * fluid.CUBE_EDGE, wanted.seconds), known)


def print_middle(speeds: list[float], known: float) -> None:
    """Print drag and buoyancy from the speeds of a heavy and a light cube."""
    half, drift = (speeds[0] - speeds[1]) / 2, (speeds[0] + speeds[1]) / 2
    error = drift / half * EXCESS / fluid.SYRUP_DENSITY
    print(
        f"middle: {half / known:.2f} of the known speed; buoyancy {100 * error:+.1f} % of the displaced weight",
        flush=True,
    )


def print_start(name: str, height: np.ndarray, known: float) -> None:
    """Print how a cube submerges, by its centre's height after each control step [m]."""
    depth = fluid.FILL - height - fluid.CUBE_EDGE / 2
    falls = -np.gradient(height, fluid.SPAN)
    under = np.flatnonzero(depth > WETTED)
    first = (
        f"its top {WETTED * 1e3:g} mm deep after {under[0] * fluid.SPAN:.2f} s" if len(under) else "does not submerge"
    )
    shares = falls[10:].min() / known, falls[-10:].mean() / known
    print(f"{name}: {first}; slowest {shares[0]:.2f}, at the end {shares[1]:.2f} of the known speed", flush=True)


def speed(height: np.ndarray) -> float:
    """Return how fast a cube sinks once it has settled [m/s]."""
    return float(height[SETTLED.start] - height[SETTLED.stop]) / (fluid.SPAN * (SETTLED.stop - SETTLED.start))


def heights(
    fidelity: Fidelity, viscosity: float, density: float, start: float, seconds: float, device: str
) -> np.ndarray:
    """Return the height of a cube's centre at the ends of control steps, without a ladle [m]."""
    fluid.CUBE_CENTER = (0.0, start, 0.0)
    steps = round(seconds / fluid.SPAN)
    horizon = steps * fluid.SPAN / DURATION
    scene = fluid.Fluid(fidelity=fidelity, device=device, viscosity=viscosity, cube_density=density, horizon=horizon)
    away = torch.tensor([0.0, 10.0, 0.0], dtype=torch.float64).expand(1, steps + 1, 1, 3)
    with scene._solvers.lend() as stage:
        stage.solver.run(away.to(scene.device))
        places = (stage.solver.read_positions(step, 1).double().cpu() for step in range(steps + 1))
        return np.array([float(scene._center(place)[0, 1]) for place in places])


def known_speed(viscosity: float, width: float, depth: float, excess: float = EXCESS) -> float:
    """Return the sinking speed of a cube with this excess density [kg/m^3] in the middle of a square tank [m/s]."""
    return float(SHAPE * wall_factor(width, depth) * 2 / 9 * excess * fluid.GRAVITY * RADIUS**2 / viscosity)


def wall_factor(width: float, depth: float) -> float:
    """Return the sinking speed of a small body in the middle of a square tank, relative to that without walls.

    Slippery walls reflect: the body has images of the same force beyond them, and of the opposite force below the floor
    and above the surface. That is a lattice of forces, whose velocity is a sum over waves.
    """
    count = int(TERMS * 2 * depth / width) + 1
    across, up = (
        2 * np.pi / length * np.arange(-most, most + 1) for length, most in ((width, TERMS), (2 * depth, count))
    )
    kx, ky, kz = np.meshgrid(across, up, across, indexing="ij")
    square = kx**2 + ky**2 + kz**2
    square[square == 0] = np.inf
    waves = (1 - np.cos(ky * depth)) * (1 - ky**2 / square) / square * np.exp(-square * BLUR**2)
    alone = 1 / (6 * np.pi**1.5 * BLUR)
    return float(1 + 6 * np.pi * RADIUS * (waves.sum() / (2 * depth * width**2) - alone))


if __name__ == "__main__":
    main()
