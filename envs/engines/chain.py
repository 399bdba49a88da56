"""A planar chain of three links that hangs from a cart of prescribed velocity, with torques at its joints."""

from dataclasses import dataclass
from functools import cache
from typing import Any, no_type_check

import torch
import warp as wp

from .runtime import load, precision, to_torch


@dataclass(frozen=True)
class Chain:
    """Three uniform rods of `masses` [kg] and `lengths` [m], the first hinged to the cart, under `gravity` [m/s^2].

    `damping` [N m s/rad] of each joint brakes how fast the joint bends.

    Coordinates are the angles phi of the rods, each from where it hangs down, counter-clockwise. While the cart moves
    at u, T = w.M w / 2 + u b.w + m u^2 / 2 with w = phi', M_ij = C_ij cos(phi_i - phi_j), b_i = beta_i cos(phi_i) and m
    the mass of all rods; V = -g sum beta_i cos(phi_i).
    """

    masses: tuple[float, float, float]
    lengths: tuple[float, float, float]
    gravity: float
    damping: float = 0.0

    @property
    def beta(self) -> tuple[float, ...]:
        """Static moment [kg m] of each rod about its joint, all that hangs from its end being put there."""
        return tuple(self.lengths[i] * (self.masses[i] / 2 + self._mass_below(i)) for i in range(3))

    @property
    def inertia(self) -> tuple[float, ...]:
        """C, the mass matrix [kg m^2] of the stretched chain, row by row."""
        return tuple(self._inertia(i, j) for i in range(3) for j in range(3))

    def _inertia(self, i: int, j: int) -> float:
        if i != j:
            return self.beta[max(i, j)] * self.lengths[min(i, j)]
        return self.lengths[i] ** 2 * (self.masses[i] / 3 + self._mass_below(i))

    def _mass_below(self, i: int) -> float:
        return sum(self.masses[i + 1 :])


class Solver:
    """Integrate up to `capacity` motions by the classical Runge-Kutta method, and differentiate their ends.

    The state is phi and its momentum p = M phi' + u b, which a jump of the cart's velocity u leaves as it is: the kick
    such a jump gives to the links needs no case of its own. Each of `controls` controls is held for `hold` steps of
    `dt` [s]. The whole motion is kept: six numbers a step need no checkpoints.
    """

    def __init__(
        self, chain: Chain, *, dt: float, hold: int, controls: int, name: str, capacity: int, device: str
    ) -> None:
        self.chain, self.dt, self.hold, self.steps, self.device = chain, dt, hold, controls * hold, device
        self.types = precision(name)
        self.kernel = motion_kernel(name)
        load([self.kernel], device)
        self.constants = [self.types.mat33(*chain.inertia), self.types.vec3(*chain.beta), chain.gravity, chain.damping]
        shape, vec3, vec4 = (self.steps + 1, capacity), self.types.vec3, self.types.vec4
        self.phi, self.p, self.adj_phi, self.adj_p = (wp.zeros(shape, dtype=vec3, device=device) for _ in range(4))
        self.control, self.adj_control = (wp.zeros((controls, capacity), dtype=vec4, device=device) for _ in range(2))

    def run(self, phi: torch.Tensor, p: torch.Tensor, controls: torch.Tensor) -> torch.Tensor:
        """Move from angles `phi` [rad] and momenta `p` [N m s], shapes (3,) or (batch, 3); return phi of all steps.

        `controls` are the cart's velocity [m/s] and the torques [N m] at the joints cart-1, 1-2 and 2-3, shape
        (batch, control, 4). The result has the shape (step + 1, batch, 3).
        """
        batch = len(controls)
        to_torch(self.phi)[0, :batch] = phi.to(self.types.torch)
        to_torch(self.p)[0, :batch] = p.to(self.types.torch)
        to_torch(self.control)[:, :batch] = controls.transpose(0, 1).to(self.types.torch)
        wp.launch(self.kernel, batch, self._inputs, device=self.device, record_tape=False)
        return to_torch(self.phi)[:, :batch]

    def energy(self, batch: int, phi: torch.Tensor) -> torch.Tensor:
        """Return the energy [J] of the last run under a cart at rest, from hanging, shape (step + 1, batch)."""
        p = to_torch(self.p)[:, :batch].cpu().double()
        apart = (phi[..., :, None] - phi[..., None, :]).cos()
        mass = phi.new_tensor(self.chain.inertia).view(3, 3) * apart
        kinetic = (p * torch.linalg.solve(mass, p)).sum(dim=-1) / 2
        height = ((1 - phi.cos()) * phi.new_tensor(self.chain.beta)).sum(dim=-1)
        found: torch.Tensor = kinetic + self.chain.gravity * height
        return found

    def gradient(self, adj_phi: torch.Tensor) -> torch.Tensor:
        """Return the adjoint of the controls, shape (batch, control, 4), from that of phi, (step + 1, batch, 3)."""
        batch = adj_phi.shape[1]
        for adjoint in (self.adj_phi, self.adj_p, self.adj_control):
            adjoint.zero_()
        to_torch(self.adj_phi)[:, :batch] = adj_phi.to(self.types.torch)
        settings: dict[str, Any] = {"device": self.device, "adjoint": True, "record_tape": False}
        settings["adj_inputs"] = [None] * (len(self._inputs) - 3) + [self.adj_control, self.adj_phi, self.adj_p]
        wp.launch(self.kernel, batch, self._inputs, **settings)
        return to_torch(self.adj_control)[:, :batch].transpose(0, 1).clone()

    @property
    def _inputs(self) -> list[Any]:
        return [self.steps, self.hold, self.dt, *self.constants, self.control, self.phi, self.p]


@cache
@no_type_check
def motion_kernel(name: str) -> Any:
    """Return the kernel of a motion by the classical Runge-Kutta method.

    One thread takes a motion through all its steps, since a launch costs more than a step. Nothing is carried from step
    to step but by the arrays: variables that a loop carries would be lost to its derivatives.
    """
    types, module = precision(name), f"gradscape.chain.{name}"
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33

    @wp.func(module=module)
    def cosines(phi: vec3) -> vec3:
        return vec3(wp.cos(phi[0]), wp.cos(phi[1]), wp.cos(phi[2]))

    @wp.func(module=module)
    def sines(phi: vec3) -> vec3:
        return vec3(wp.sin(phi[0]), wp.sin(phi[1]), wp.sin(phi[2]))

    @wp.func(module=module)
    def velocity(C: mat33, beta: vec3, u: real, phi: vec3, p: vec3) -> vec3:
        """Return phi' = dH/dp = M^-1 (p - u b)."""
        c, s = cosines(phi), sines(phi)
        M = wp.cw_mul(C, wp.outer(c, c) + wp.outer(s, s))
        return wp.inverse(M) * (p - u * wp.cw_mul(beta, c))

    @wp.func(module=module)
    def force(C: mat33, beta: vec3, gravity: real, damping: real, control: vec4, phi: vec3, w: vec3) -> vec3:
        """Return p' = -dH/dphi + torques, where w = phi'."""
        c, s = cosines(phi), sines(phi)
        inertial = wp.cw_mul(w, wp.cw_mul(C, wp.outer(s, c) - wp.outer(c, s)) * w)
        outside = wp.cw_mul(wp.cw_mul(beta, s), control[0] * w + vec3(gravity, gravity, gravity))
        bend = vec3(w[0], w[1] - w[0], w[2] - w[1])
        motor = vec3(control[1], control[2], control[3]) - damping * bend
        return vec3(motor[0] - motor[1], motor[1] - motor[2], motor[2]) - inertial - outside

    @wp.kernel(module=module)
    def advance(
        steps: int,
        hold: int,
        dt: real,
        C: mat33,
        beta: vec3,
        gravity: real,
        damping: real,
        controls: wp.array2d[vec4],
        phi: wp.array2d[vec3],
        p: wp.array2d[vec3],
    ):
        e = wp.tid()
        for step in range(steps):
            control, phi0, p0 = controls[step // hold, e], phi[step, e], p[step, e]
            u, half = control[0], real(0.5) * dt
            v1 = velocity(C, beta, u, phi0, p0)
            f1 = force(C, beta, gravity, damping, control, phi0, v1)
            phi2 = phi0 + half * v1
            v2 = velocity(C, beta, u, phi2, p0 + half * f1)
            f2 = force(C, beta, gravity, damping, control, phi2, v2)
            phi3 = phi0 + half * v2
            v3 = velocity(C, beta, u, phi3, p0 + half * f2)
            f3 = force(C, beta, gravity, damping, control, phi3, v3)
            phi4 = phi0 + dt * v3
            v4 = velocity(C, beta, u, phi4, p0 + dt * f3)
            f4 = force(C, beta, gravity, damping, control, phi4, v4)
            sixth = dt / real(6.0)
            phi[step + 1, e] = phi0 + sixth * (v1 + real(2.0) * (v2 + v3) + v4)
            p[step + 1, e] = p0 + sixth * (f1 + real(2.0) * (f2 + f3) + f4)

    return advance
