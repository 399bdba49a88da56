"""The chain against mechanics written down independently: energies of rods, Euler and Lagrange, modes, kicks, work."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch
from torch.func import grad, hessian, jvp, vmap

from gradscape.envs.engines.chain import Chain, Solver
from gradscape.envs.engines.runtime import to_torch

CHAIN = Chain(masses=(1.3, 0.7, 0.4), lengths=(0.8, 1.1, 0.6), gravity=9.81)
FREE = torch.zeros(1, 4, dtype=torch.float64)
REST = torch.zeros(1, 3, dtype=torch.float64)
BENT = torch.tensor([[1.0, 0.4, -0.8]], dtype=torch.float64)
ROWS = 16


def joints(phi):
    """Return where the chain's joints and its tip are [m], the cart being at 0."""
    lengths = torch.tensor(CHAIN.lengths, dtype=torch.float64)
    links = torch.stack([lengths * phi.sin(), -lengths * phi.cos()], dim=1)
    return torch.cat([torch.zeros(1, 2, dtype=torch.float64), links.cumsum(dim=0)])


def kinetic(phi, w, u):
    """Return the kinetic energy of three rods [J]: m (a.a + a.b + b.b) / 6, where a and b are the ends' velocities."""
    v = jvp(joints, (phi,), (w,))[1] + torch.stack([u, torch.zeros_like(u)])
    a, b = v[:-1], v[1:]
    return (torch.tensor(CHAIN.masses, dtype=torch.float64)[:, None] * (a * a + a * b + b * b)).sum() / 6


def potential(phi):
    y = joints(phi)[:, 1]
    return CHAIN.gravity * (torch.tensor(CHAIN.masses, dtype=torch.float64) * (y[1:] + y[:-1]) / 2).sum()


def lagrangian(phi, w, u):
    return kinetic(phi, w, u) - potential(phi)


def work(phi, torque):
    """Return what the motors' torques have done between all angles 0 and `phi` [J]."""
    bends = phi - torch.cat([torch.zeros_like(phi[..., :1]), phi[..., :-1]], dim=-1)
    return (torque * bends).sum(dim=-1)


momentum = vmap(grad(lagrangian, argnums=1))


def mass_matrix(phi):
    return vmap(hessian(kinetic, argnums=1))(phi, torch.zeros_like(phi), torch.zeros_like(phi[:, 0]))


def kick(phi):
    """Return M^-1 b, by which a kick of the cart at 1 m/s turns the links back [rad/s]."""
    b = momentum(phi, torch.zeros_like(phi), torch.ones_like(phi[:, 0]))
    return torch.linalg.solve(mass_matrix(phi), b)


def energy(phi, p):
    """Return the energy [J] of a chain on a standing cart."""
    w = torch.linalg.solve(mass_matrix(phi), p)
    return vmap(kinetic)(phi, w, torch.zeros_like(phi[:, 0])) + vmap(potential)(phi)


def move(phi, p, controls, *, dt, hold):
    """Return angles and momenta of all steps, shape (step + 1, batch, 3), in float64."""
    batch, count, _ = controls.shape
    solver = Solver(CHAIN, dt=dt, hold=hold, controls=count, name="float64", capacity=batch, device="cpu")
    return solver.run(phi, p, controls).clone(), to_torch(solver.p).clone()


def rates(phi, p, control):
    """Return phi' and p' by fourth-order differences of single steps forward and back."""
    ends = {n: [end[1] for end in move(phi, p, control[:, None], dt=n * 1e-3, hold=1)] for n in (-2, -1, 1, 2)}
    return tuple((8 * (ends[1][i] - ends[-1][i]) - (ends[2][i] - ends[-2][i])) / 12e-3 for i in range(2))


def random(*shape, scale=1.0, seed=0):
    return scale * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_the_equations_of_motion_are_euler_and_lagranges():
    phi, w, u = random(ROWS, 3, scale=2.0), random(ROWS, 3, scale=3.0, seed=1), random(ROWS, seed=2)
    torque = random(ROWS, 3, scale=5.0, seed=3)
    p = momentum(phi, w, u)
    velocity, force = rates(phi, p, torch.cat([u[:, None], torque], dim=1))
    torch.testing.assert_close(velocity, w, rtol=1e-7, atol=1e-7)
    wanted = vmap(grad(lagrangian))(phi, w, u) + vmap(grad(work))(phi, torque)
    torch.testing.assert_close(force, wanted, rtol=1e-7, atol=1e-6)


def test_motions_converge_at_fourth_order():
    control = torch.tensor([[[0.5, 3.0, -2.0, 0.4], [-1.0, -4.0, 1.0, -0.3]]], dtype=torch.float64)
    ends = [move(BENT, REST, control, dt=0.4 / hold, hold=hold)[0][-1] for hold in (20, 40, 80, 640)]
    errors = [float((end - ends[-1]).norm()) for end in ends[:-1]]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 4, atol=0.4)


@pytest.mark.parametrize("mode", range(3))
def test_small_oscillations_have_the_frequencies_of_the_linearised_chain(mode):
    stiffness = hessian(potential)(REST[0])
    squares, modes = scipy.linalg.eigh(stiffness.numpy(), mass_matrix(REST)[0].numpy())
    turns, per_turn, amplitude = 2.25, 80, 1e-5
    dt = 2 * math.pi / math.sqrt(squares[mode]) / per_turn
    shape = torch.from_numpy(modes[:, mode])
    phi, _ = move(amplitude * shape, REST, FREE[:, None], dt=dt, hold=round(turns * per_turn))
    lag = torch.dot(shape, mass_matrix(REST)[0] @ phi[-1, 0]) / amplitude  # of the phase: a cosine that falls through 0
    wanted = (2 * math.pi / per_turn) ** 4 / 120 * 2 * math.pi * turns  # what the method's expansion says
    assert float(lag) == pytest.approx(wanted, rel=0.02)


def test_a_jump_of_the_carts_velocity_kicks_the_links_against_it():
    """No joint passes on a moment: M phi' + u b, the angular momenta of what hangs from each, stay."""
    before, after = 0.7, -1.1
    controls = torch.zeros(1, 2, 4, dtype=torch.float64)
    controls[0, :, 0] = torch.tensor([before, after])
    h, at = 1e-3, 300
    phi = move(BENT, REST, controls, dt=h, hold=at)[0][:, 0]
    stencil = torch.tensor([-25.0, 48.0, -36.0, 16.0, -3.0], dtype=torch.float64) / (12 * h)
    left, right = -stencil @ phi[at - 4 : at + 1].flip(0), stencil @ phi[at : at + 5]
    jump = -kick(phi[at : at + 1])[0] * (after - before)
    assert jump.abs().max() > 1
    torch.testing.assert_close(right - left, jump, rtol=0, atol=1e-6)


def test_the_work_of_the_torques_is_the_energy_gained():
    hold, count = 100, 4
    controls = torch.zeros(1, count, 4, dtype=torch.float64)
    controls[..., 1:] = random(count, 3)
    phi, p = (a[::hold, 0] for a in move(REST, REST, controls, dt=1e-3, hold=hold))
    done = (work(phi[1:], controls[0, :, 1:]) - work(phi[:-1], controls[0, :, 1:])).cumsum(dim=0)
    assert done.abs().max() > 1
    torch.testing.assert_close(energy(phi, p)[1:] - energy(phi, p)[0], done, rtol=0, atol=1e-7)


def test_damped_joints_brake_how_fast_they_bend_and_nothing_else():
    """The same step with torques of -c times the bending rate: p' differs by those torques' generalized forces."""
    phi, p = random(ROWS, 3, scale=2.0), random(ROWS, 3, scale=3.0, seed=1)
    c, dt = 0.3, 1e-6
    w = torch.linalg.solve(mass_matrix(phi), p)
    bend = w - torch.cat([torch.zeros_like(w[:, :1]), w[:, :-1]], dim=1)
    wanted = vmap(grad(work))(phi, -c * bend)
    ends = []
    for damping, step in ((c, dt), (c, -dt), (0.0, dt), (0.0, -dt)):
        chain = replace(CHAIN, damping=damping)
        solver = Solver(chain, dt=step, hold=1, controls=1, name="float64", capacity=ROWS, device="cpu")
        solver.run(phi, p, torch.zeros(ROWS, 1, 4, dtype=torch.float64))
        ends.append(to_torch(solver.p)[1].clone())
    change = (ends[0] - ends[1]) - (ends[2] - ends[3])
    torch.testing.assert_close(change / (2 * dt), wanted, rtol=1e-6, atol=1e-6)
