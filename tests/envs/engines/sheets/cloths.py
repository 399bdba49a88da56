"""A crumpled sheet, and random numbers that drive it, for the tests of both engines of sheets."""

import math

import numpy as np
import torch

from gradscape.envs.engines.sheets.contact import Pan
from gradscape.envs.engines.sheets.springs import Sheet
from gradscape.envs.sheets import lattice

PAN = Pan(flat=0.14, bend=0.07, sweep=math.asin(6 / 7), thickness=0.03)
DT, ROWS = 2e-3, 3


def crumpled(cells, pitch, shift, **more):
    """Return a sheet of square cells of a `pitch` [m], its first corner moved by `shift` [m]; vertices weigh unlike."""
    points = lattice.square(cells)
    pairs, rest, weight = lattice.springs(points, reach=2, bend=0.4)
    x = np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1) * pitch
    x += 0.01 * np.random.default_rng(0).uniform(-1, 1, x.shape) + shift
    mass = 0.0025 * (1 + np.arange(len(x)) % 4)
    return Sheet(x, pairs, pitch * rest, weight, mass=mass, damping=0.05, drag=0.5, **more)


def drive(sheet, steps, *, turn=1.0):
    """Return random velocities, stiffness of every vertex and poses, and a random adjoint of the last positions.

    A pose's tilt is `turn` times its displacement.
    """
    rng = torch.Generator().manual_seed(1)

    def within(low, high, *shape):
        return low + (high - low) * torch.rand(shape, generator=rng, dtype=torch.float64)

    moved = within(-0.05, 0.05, ROWS, 1, 3) * torch.tensor([1.0, 1.0, turn])
    poses = torch.linspace(0, 1, steps + 1, dtype=torch.float64)[:, None] * moved
    poses = poses + within(-1e-3, 1e-3, ROWS, steps + 1, 3)
    count = len(sheet.x)
    return (within(-1.0, 0.0, ROWS, 3), within(5.0, 40.0, ROWS, count), poses), within(-1.0, 1.0, ROWS, count, 3)
