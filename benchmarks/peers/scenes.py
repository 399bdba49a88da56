"""The two scenes that peers simulate: a cube thrown against a wall, and chains that swing. Only NumPy is needed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CUBE, CHAIN = "cube", "chain"


@dataclass(frozen=True)
class Cube:
    """A neo-Hookean cube of n^3 `particles` that flies at 1 m/s against a wall, for so many `substeps`.

    The figures are those of DiffTaichi's `diffmpm3d` (64 nodes along each metre, density 1 kg/m^3, mu = lam = 10 Pa, 10
    m/s^2 downwards), but for `dt` [s], which is half of its, and for 8 particles in a cell. Nodes from `wall` on belong
    to the wall, nodes below `floor` to the floor. Parameters are the 12 numbers of the first velocity, which is affine
    in the place: of the middle [m/s], and of each axis at the cube's face [m/s]. The loss is minus the mean x [m] at
    the end.
    """

    particles: int
    substeps: int
    nodes: int = 64
    wall: int = 62
    floor: int = 3
    dt: float = 1e-3
    density: float = 1.0
    mu: float = 10.0
    lam: float = 10.0
    gravity: float = 10.0

    def __post_init__(self) -> None:
        side = round(self.particles ** (1 / 3))
        if side**3 != self.particles or not 2 <= side <= 100:
            near = f"{max(2, side) ** 3} or {(max(2, side) + 1) ** 3}"
            raise ValueError(f"a cube has n^3 particles, n from 2 to 100; got {self.particles}, take {near}")
        if self.substeps < 1:
            raise ValueError(f"a cube is simulated for one substep or more; got {self.substeps}")

    @property
    def dx(self) -> float:
        """Distance of nodes [m]."""
        return 1.0 / self.nodes

    @property
    def spacing(self) -> float:
        """Distance of particles [m]."""
        return self.dx / 2

    @property
    def young(self) -> float:
        """Young's modulus [Pa]."""
        return self.mu * (3 * self.lam + 2 * self.mu) / (self.lam + self.mu)

    @property
    def poisson(self) -> float:
        """Poisson's ratio."""
        return self.lam / (2 * (self.lam + self.mu))

    @property
    def work(self) -> int:
        """Number of particles times that of substeps."""
        return self.particles * self.substeps

    @cached_property
    def x(self) -> Array:
        """Places at first [m], shape (particle, 3): the cube's face is two cells before the wall."""
        side = round(self.particles ** (1 / 3))
        axis = (np.arange(side) + 0.5 - side / 2) * self.spacing
        middle = np.array([(self.wall - 2) * self.dx - side * self.spacing / 2, 0.5, 0.5])
        return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) + middle

    @property
    def start(self) -> Array:
        """Parameters at which it is measured, shape (12,): 1 m/s towards the wall, turning and shearing."""
        return np.array([1.0, 0.1, -0.05, 0.0, 0.2, -0.1, -0.15, 0.05, 0.1, 0.1, -0.05, 0.0])

    def velocities(self, parameters: Array) -> Array:
        """Return the velocities that parameters, shape (12,), ask for [m/s], shape (particle, 3)."""
        return self._basis @ np.concatenate([parameters[None, :3], parameters[3:].reshape(3, 3)])

    def pull_back(self, adjoint: Array) -> Array:
        """Return the adjoint of the parameters, shape (12,), from that of the velocities, shape (particle, 3)."""
        return (self._basis.T @ adjoint).reshape(-1)

    @cached_property
    def _basis(self) -> Array:
        place = self.x - self.x.mean(axis=0)
        return np.concatenate([np.ones((len(place), 1)), place / np.abs(place).max()], axis=1)


@dataclass(frozen=True)
class Chain:
    """Chains (`particles` of them) of three rods that hang from a cart at rest and are swung by torques for `substeps`.

    Masses [kg], lengths [m], gravity [m/s^2] and `dt` [s] are those of the scene `cartpole` at standard. Parameters are
    the torques [N m] of each chain, three for every two steps. The loss is the mean distance of the tips to a point 3 m
    above the cart [m].
    """

    particles: int
    substeps: int
    dt: float = 0.01
    hold: int = 2
    masses: tuple[float, float, float] = (1.0, 0.5, 0.25)
    gravity: float = 9.81
    bounds: tuple[float, float, float] = (10.0, 4.0, 1.0)
    target: float = 3.0

    def __post_init__(self) -> None:
        if self.particles < 1 or self.substeps < 1 or self.substeps % self.hold:
            raise ValueError(
                f"chains are simulated for a multiple of {self.hold} steps, one chain or more; got {self.particles} "
                f"chains and {self.substeps} steps"
            )

    @property
    def work(self) -> int:
        """Number of links times that of steps."""
        return 3 * self.particles * self.substeps

    @property
    def controls(self) -> int:
        """Number of controls, each of which is held for `hold` steps."""
        return self.substeps // self.hold

    @property
    def start(self) -> Array:
        """Torques at which it is measured, as parts of their bounds, flat from shape (chain, control, 3)."""
        return np.random.default_rng(1).uniform(-1, 1, self.particles * self.controls * 3)

    def torques(self, parameters: Array) -> Array:
        """Return torques [N m], shape (chain, control, 3)."""
        return parameters.reshape(self.particles, self.controls, 3) * np.array(self.bounds)

    def pull_back(self, adjoint: Array) -> Array:
        """Return the adjoint of the parameters from that of the torques, shape (chain, control, 3)."""
        return (adjoint * np.array(self.bounds)).reshape(-1)
