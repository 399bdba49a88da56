"""What particles are made of: how motion changes a material's state, and what stress that state gives.

A material carries only the state its stress needs: a fluid its volume ratio J, a solid its deformation gradient F. It
has two kernels: `update` advances the state by the affine velocity C and fills the affine momentum A that p2g scatters,

    S' = deform(S, C),    A = -dt V 4/dx^2 tau(S', C) + m C,

and `adjoint` turns the adjoints of S' and A into those of S and C. Both are written by hand; the tests hold the second
against differences of the first. On a GPU the adjoint gathers that of A first (`gathers`), and computes A again, so
that no substep has to keep it. tau is the Kirchhoff stress J sigma [Pa].
"""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp

from ...runtime import fill_struct, precision
from . import elastic, fluid, plasticine
from .kernels import Response, after_p2g, alone, kernels_in_rows, law_struct, update_kernel


class _Material(abc.ABC):
    """What a solver asks of a material; `blocks` of its adjoint are to find registers on a GPU at once."""

    blocks: ClassVar[int] = 4

    @abc.abstractmethod
    def constants(self) -> dict[str, float]:
        """Return what the kernels take besides state and motion, by name."""

    @abc.abstractmethod
    def response(self, name: str) -> Response:
        """Return what the material does in one precision, as Warp functions."""

    def law(self, name: str) -> Any:
        """Return the struct of one precision that the kernels take, with the constants in it."""
        return fill_struct(law_struct(name, *self.constants()), self.constants())

    def kernels(self, name: str, *, columns: bool = False) -> tuple[Any, Any]:
        """Return (update, adjoint) of one precision for a CPU, or for `columns`."""
        if not columns and (rows := self.rows(name)):
            array2d: Any = wp.array2d  # of a type that is known at run time alone
            return kernels_in_rows(name, law_struct(name, *self.constants()), array2d[self.state(name)], *rows)
        response = self.response(name)
        adjoint = after_p2g(name, response, self.blocks) if columns else alone(name, response)
        return update_kernel(name, response), adjoint

    def rows(self, name: str) -> tuple[Any, ...]:
        """Return what kernels in C++ are called after, which take eight particles at a time, and their constants."""
        return ()

    @abc.abstractmethod
    def state(self, name: str) -> Any:
        """Return the Warp type of one particle's state."""


@dataclass(frozen=True)
class Fluid(_Material):
    """A viscous, weakly compressible fluid: density [kg/m^3], bulk modulus [Pa], dynamic viscosity [Pa s].

    Its pressure grows with log J, so that however hard a droplet is hit it pushes back, and a lone particle oscillates
    at sqrt(12) c/dx whatever its J (stable for c dt/dx < 0.57). It bears tension up to a volume larger by 4 %, then
    tears: J grows no further. Smoothed, it comes nowhere near that, and tension holds no surface (`fluid`). Before each
    control step a share `smoothing`, from 0 to 1, of what the J of a particle differs from that of its neighbours is
    taken from it.
    """

    density: float
    bulk: float
    viscosity: float
    smoothing: float = 0.0
    blocks: ClassVar[int] = 5

    def volume_ratio(self, pressure: np.ndarray) -> np.ndarray:
        """Return J at which the fluid bears `pressure` [Pa], counted on its reference volume."""
        return np.asarray(np.exp(-pressure / self.bulk))  # K log J = -pressure

    def constants(self) -> dict[str, float]:
        """Return what the kernels take besides state and motion."""
        return {"bulk": self.bulk, "viscosity": self.viscosity}

    def response(self, name: str) -> Response:
        """Return what the material does in one precision, as Warp functions."""
        found: Response = fluid.response(name)
        return found

    def rows(self, name: str) -> tuple[Any, ...]:
        """Return what kernels in C++ are called after, and their constants."""
        return "fluid", fluid.TORN

    def state(self, name: str) -> Any:
        """Return the Warp type of one particle's state."""
        return precision(name).real

    def initial(self, ratio: np.ndarray) -> np.ndarray:
        """Return the state of particles compressed to volume ratio J, shape (particle,)."""
        return ratio


@dataclass(frozen=True)
class _Solid(_Material):
    """What solids share: density [kg/m^3], Young's modulus [Pa], Poisson's ratio; their state is F."""

    density: float
    young: float
    poisson: float
    smoothing: ClassVar[float] = 0.0

    @property
    def mu(self) -> float:
        """Shear modulus [Pa]."""
        return self.young / (2.0 * (1.0 + self.poisson))

    @property
    def lam(self) -> float:
        """First Lame parameter [Pa]."""
        return self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))

    def volume_ratio(self, pressure: np.ndarray) -> np.ndarray:
        """Return J at which the solid bears `pressure` [Pa], to first order."""
        return 1.0 - pressure / (self.lam + 2.0 * self.mu / 3.0)

    def state(self, name: str) -> Any:
        """Return the Warp type of one particle's state."""
        return precision(name).mat33

    def initial(self, ratio: np.ndarray) -> np.ndarray:
        """Return the state of particles compressed to volume ratio J, shape (particle, 3, 3)."""
        return np.asarray(np.cbrt(ratio)[:, None, None] * np.eye(3))


@dataclass(frozen=True)
class Elastic(_Solid):
    """A compressible neo-Hookean solid."""

    @classmethod
    def with_wave_speed(cls, density: float, speed: float, *, poisson: float) -> "Elastic":
        """Return the solid in which pressure waves travel at `speed` [m/s]."""
        modulus = density * speed**2  # lam + 2 mu
        return cls(density, modulus * (1.0 + poisson) * (1.0 - 2.0 * poisson) / (1.0 - poisson), poisson)

    def constants(self) -> dict[str, float]:
        """Return what the kernels take besides state and motion."""
        return {"mu": self.mu, "lam": self.lam}

    def response(self, name: str) -> Response:
        """Return what the material does in one precision, as Warp functions."""
        found: Response = elastic.response(name)
        return found


@dataclass(frozen=True)
class Plasticine(_Solid):
    """A fixed-corotated solid that yields by von Mises at `yield_stress` [Pa]: its shape flows, its volume returns."""

    yield_stress: float

    def constants(self) -> dict[str, float]:
        """Return what the kernels take besides state and motion; `kappa` is the largest deviatoric log strain."""
        return {"mu": self.mu, "lam": self.lam, "kappa": self.yield_stress / (2.0 * self.mu)}

    def response(self, name: str) -> Response:
        """Return what the material does in one precision, as Warp functions: float32 is as exact as series are."""
        return (plasticine.response_by_series if name == "float32" else plasticine.response)(name)

    def rows(self, name: str) -> tuple[Any, ...]:
        """Return what kernels in C++ are called after, and their constants."""
        return "plasticine", *plasticine.constants_of_rows(name)


Material = Fluid | Elastic | Plasticine
