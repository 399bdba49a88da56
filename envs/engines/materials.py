"""What particles are made of: how a material's state gives stress, and how motion changes the state.

A material carries only the state its stress needs: a fluid its volume ratio J, an elastic solid its deformation
gradient F. Each has two kernels, both differentiated by Warp: `stress` fills the affine momentum A that p2g scatters,
`deform` advances the state with the new affine velocity C. tau is the Kirchhoff stress J sigma [Pa].
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, no_type_check

import numpy as np
import warp as wp

from .runtime import precision

TORN = 1.1  # volume ratio at which a fluid tears


@dataclass(frozen=True)
class Fluid:
    """A viscous, weakly compressible fluid: density [kg/m^3], bulk modulus [Pa], dynamic viscosity [Pa s].

    Its pressure grows with log J, so that however hard a droplet is hit it pushes back, and a lone particle oscillates
    at sqrt(12) c/dx whatever its J (stable for c dt/dx < 0.57). It bears tension up to a tenth more than its volume,
    then tears: J grows no further.
    """

    density: float
    bulk: float
    viscosity: float

    def volume_ratio(self, pressure: np.ndarray) -> np.ndarray:
        """Return J at which the fluid bears `pressure` [Pa], counted on its reference volume."""
        return np.asarray(np.exp(-pressure / self.bulk))  # K log J = -pressure

    def kernels(self, name: str) -> tuple[Any, Any]:
        """Return (stress, deform) for one precision."""
        stress, deform = _fluid_kernels(name)
        return stress, deform

    def constants(self) -> tuple[float, ...]:
        """Return what the stress kernel takes besides state and motion."""
        return self.bulk, self.viscosity

    def state(self, name: str) -> Any:
        """Return the Warp type of one particle's state."""
        return precision(name).real

    def initial(self, ratio: np.ndarray) -> np.ndarray:
        """Return the state of particles compressed to volume ratio J, shape (particle,)."""
        return ratio


@dataclass(frozen=True)
class Elastic:
    """A compressible neo-Hookean solid: density [kg/m^3], Young's modulus [Pa], Poisson's ratio."""

    density: float
    young: float
    poisson: float

    @classmethod
    def with_wave_speed(cls, density: float, speed: float, *, poisson: float) -> "Elastic":
        """Return the solid in which pressure waves travel at `speed` [m/s]."""
        modulus = density * speed**2  # lam + 2 mu
        return cls(density, modulus * (1.0 + poisson) * (1.0 - 2.0 * poisson) / (1.0 - poisson), poisson)

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

    def kernels(self, name: str) -> tuple[Any, Any]:
        """Return (stress, deform) for one precision."""
        stress, deform = _elastic_kernels(name)
        return stress, deform

    def constants(self) -> tuple[float, ...]:
        """Return what the stress kernel takes besides state and motion."""
        return self.mu, self.lam

    def state(self, name: str) -> Any:
        """Return the Warp type of one particle's state."""
        return precision(name).mat33

    def initial(self, ratio: np.ndarray) -> np.ndarray:
        """Return the state of particles compressed to volume ratio J, shape (particle, 3, 3)."""
        return np.asarray(np.cbrt(ratio)[:, None, None] * np.eye(3))


Material = Fluid | Elastic


@cache
@no_type_check
def _fluid_kernels(name: str) -> tuple[Any, Any]:
    types = precision(name)
    real, mat33 = types.real, types.mat33
    module = f"gradscape.materials.{name}"

    @wp.kernel(module=module, name=f"fluid_stress_{name}")
    def stress(
        first: int,
        scale: real,
        bulk: real,
        viscosity: real,
        mass: wp.array[real],
        volume: wp.array[real],
        J: wp.array2d[real],
        C: wp.array2d[mat33],
        A: wp.array2d[mat33],
    ):
        """Fill A = scale V tau + m C with tau = K log J I + J mu (C + C^T - 2/3 tr C I)."""
        e, p = wp.tid()
        c = C[e, first + p]
        j = J[e, p]
        identity = wp.identity(n=3, dtype=real)
        shear = c + wp.transpose(c) - (real(2.0) / real(3.0)) * wp.trace(c) * identity
        tau = bulk * wp.log(j) * identity + j * viscosity * shear
        A[e, first + p] = scale * volume[first + p] * tau + mass[first + p] * c

    @wp.kernel(module=module, name=f"fluid_deform_{name}")
    def deform(first: int, dt: real, J: wp.array2d[real], C_new: wp.array2d[mat33], J_new: wp.array2d[real]):
        """Advance J' = min(exp(dt tr C') J, TORN)."""
        e, p = wp.tid()
        J_new[e, p] = wp.min(wp.exp(dt * wp.trace(C_new[e, first + p])) * J[e, p], real(TORN))

    return stress, deform


@cache
@no_type_check
def _elastic_kernels(name: str) -> tuple[Any, Any]:
    types = precision(name)
    real, mat33 = types.real, types.mat33
    module = f"gradscape.materials.{name}"

    @wp.kernel(module=module, name=f"elastic_stress_{name}")
    def stress(
        first: int,
        scale: real,
        mu: real,
        lam: real,
        mass: wp.array[real],
        volume: wp.array[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        A: wp.array2d[mat33],
    ):
        """Fill A = scale V tau + m C with tau = mu (F F^T - I) + lam log(det F) I."""
        e, p = wp.tid()
        f = F[e, p]
        identity = wp.identity(n=3, dtype=real)
        tau = mu * (f * wp.transpose(f) - identity) + lam * wp.log(wp.determinant(f)) * identity
        A[e, first + p] = scale * volume[first + p] * tau + mass[first + p] * C[e, first + p]

    @wp.kernel(module=module, name=f"elastic_deform_{name}")
    def deform(first: int, dt: real, F: wp.array2d[mat33], C_new: wp.array2d[mat33], F_new: wp.array2d[mat33]):
        """Advance F' = (I + dt C') F."""
        e, p = wp.tid()
        F_new[e, p] = F[e, p] + dt * C_new[e, first + p] * F[e, p]

    return stress, deform
