"""Materials against continuum mechanics: what costs stress, Hooke's and Newton's laws, and the kernels' adjoints."""

import math

import numpy as np
import pytest
import torch
import warp as wp

from gradscape.envs.engines.materials import TORN, Elastic, Fluid
from gradscape.envs.engines.runtime import precision, to_torch

SYRUP = Fluid(density=1300.0, bulk=4e4, viscosity=4.0)
RUBBER = Elastic.with_wave_speed(1400.0, 6.0, poisson=0.3)
IDENTITY = torch.eye(3, dtype=torch.float64)
SCALE, MASS, VOLUME, DT = -0.7, 0.2, 0.3, 1e-3
NAMES = ["float32", "float64"]
ROUND_OFF = {"float32": 2e-6, "float64": 1e-13}  # of the moduli


def draw(*shape, seed):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5


class Bench:
    """Launch one material's kernels on tensors of particles, shape (particle, ...)."""

    def __init__(self, material, name="float64"):
        self.material, self.types = material, precision(name)
        self.stress_kernel, self.deform_kernel = material.kernels(name)
        self.kinds = {(): self.types.real, (3, 3): self.types.mat33}

    def array(self, values):
        kind = self.kinds[tuple(values.shape[1:])]
        return wp.array(values.to(self.types.torch)[None].contiguous().numpy(), dtype=kind, copy=True)

    def each(self, value, count):
        return wp.array(np.full(count, value), dtype=self.types.real)

    def inputs(self, state, C):
        count = len(C)
        constants = [0, SCALE, *self.material.constants(), self.each(MASS, count), self.each(VOLUME, count)]
        return [*constants, self.array(state), self.array(C), self.array(torch.zeros_like(C))]

    def affine(self, state, C):
        """Return the affine momentum A."""
        inputs = self.inputs(state, C)
        wp.launch(self.stress_kernel, (1, len(C)), inputs, record_tape=False)
        return double(inputs[-1])

    def tau(self, state, C=None):
        """Return the Kirchhoff stress [Pa]."""
        C = torch.zeros(len(state), 3, 3, dtype=torch.float64) if C is None else C
        return (self.affine(state, C) - MASS * C) / (SCALE * VOLUME)

    def deform(self, state, C, dt=DT):
        new = self.array(torch.zeros_like(state))
        wp.launch(self.deform_kernel, (1, len(C)), [0, dt, self.array(state), self.array(C), new], record_tape=False)
        return double(new)

    def adjoint(self, kernel, inputs, wanted, given):
        """Return the adjoints of two inputs, numbers `wanted`, from that of the last."""
        adjoints = [None] * len(inputs)
        for i in wanted:
            adjoints[i] = wp.zeros_like(inputs[i])
        adjoints[-1] = self.array(given)
        shape = (1, len(given))
        wp.launch(kernel, shape, inputs, adj_inputs=adjoints, adj_outputs=[], adjoint=True, record_tape=False)
        return [double(adjoints[i]) for i in wanted]


def double(array):
    return to_torch(array)[0].double().clone()


def rotations(count, seed):
    q = torch.linalg.qr(draw(count, 3, 3, seed=seed)).Q
    return q * torch.linalg.det(q)[:, None, None]


@pytest.mark.parametrize("name", NAMES)
def test_turning_an_elastic_solid_costs_no_stress(name):
    tau = Bench(RUBBER, name).tau(rotations(20, seed=0))
    assert tau.abs().max() < ROUND_OFF[name] * RUBBER.young


def test_elastic_stress_turns_with_the_solid():
    bench, R = Bench(RUBBER), rotations(20, seed=1)
    F = IDENTITY + 0.3 * draw(20, 3, 3, seed=2)
    tau = bench.tau(F)
    torch.testing.assert_close(bench.tau(R @ F), R @ tau @ R.mT, rtol=0, atol=1e-10 * RUBBER.young)
    torch.testing.assert_close(bench.tau(F @ R), tau, rtol=0, atol=1e-10 * RUBBER.young)  # isotropic
    torch.testing.assert_close(tau, tau.mT)


def test_small_strains_obey_hooke():
    strain = draw(20, 3, 3, seed=3)
    strain = strain + strain.mT
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    hooke = RUBBER.lam * trace * IDENTITY + 2 * RUBBER.mu * strain
    errors = [
        float((Bench(RUBBER).tau(IDENTITY + size * strain) / size - hooke).abs().max()) for size in (1e-3, 5e-4, 2.5e-4)
    ]
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 2, atol=0.02)  # first order in the strain
    assert errors[-1] < 1e-3 * RUBBER.young


def test_stretching_one_axis_meets_the_modulus_of_pressure_waves():
    stretch = 1e-6
    F = IDENTITY.clone()
    F[1, 1] += stretch
    tau = Bench(RUBBER).tau(F[None])[0] / stretch
    modulus = RUBBER.lam + 2 * RUBBER.mu
    assert modulus == pytest.approx(1400.0 * 6.0**2)
    assert tau[1, 1] == pytest.approx(modulus, rel=1e-5)
    assert tau[0, 0] == pytest.approx(RUBBER.lam, rel=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_a_fluid_bears_the_pressure_its_volume_ratio_was_made_for(name):
    pressure = np.linspace(0, 2e3, 9)
    ratio = torch.from_numpy(SYRUP.initial(SYRUP.volume_ratio(pressure)))
    tau = Bench(SYRUP, name).tau(ratio)
    wanted = -torch.from_numpy(pressure)[:, None, None] * IDENTITY
    torch.testing.assert_close(tau, wanted, rtol=0, atol=ROUND_OFF[name] * SYRUP.bulk)
    assert (np.diff(ratio.numpy()) < 0).all()


def test_an_elastic_solid_bears_it_to_first_order():
    misses = []
    for pressure in (200.0, 100.0, 50.0):
        F = torch.from_numpy(RUBBER.initial(RUBBER.volume_ratio(np.array([pressure]))))
        misses.append(float((Bench(RUBBER).tau(F)[0] + pressure * IDENTITY).abs().max()) / pressure)
    np.testing.assert_allclose(np.array(misses[:-1]) / misses[1:], 2, atol=0.05)
    assert misses[-1] < 0.01


def test_shearing_a_fluid_meets_newtons_viscosity():
    J = torch.tensor([1.0, 0.97, 1.02], dtype=torch.float64)
    rate = 3.0
    C = torch.zeros(3, 3, 3, dtype=torch.float64)
    C[:, 0, 1] = rate
    viscous = Bench(SYRUP).tau(J, C) - Bench(SYRUP).tau(J)
    wanted = torch.zeros_like(C)
    wanted[:, 0, 1] = wanted[:, 1, 0] = J * SYRUP.viscosity * rate
    torch.testing.assert_close(viscous, wanted, rtol=0, atol=1e-10)


def test_turning_and_swelling_a_fluid_meet_no_viscosity():
    bench = Bench(SYRUP)
    spin = draw(5, 3, 3, seed=4)
    for C in (spin - spin.mT, 2.0 * IDENTITY.expand(5, 3, 3)):
        torch.testing.assert_close(
            bench.tau(torch.ones(5).double(), C), torch.zeros(5, 3, 3).double(), rtol=0, atol=1e-10
        )


def test_particles_carry_their_affine_momentum():
    C = draw(5, 3, 3, seed=5)
    at_rest = IDENTITY.expand(5, 3, 3)
    torch.testing.assert_close(Bench(RUBBER).affine(at_rest, C), MASS * C, rtol=0, atol=1e-12)


def test_a_fluid_tears_instead_of_stretching_on():
    J = torch.ones(1, dtype=torch.float64)
    expanding, contracting = (rate * IDENTITY[None] for rate in (10.0, -10.0))
    for _ in range(100):
        J = Bench(SYRUP).deform(J, expanding, 0.01)
    assert float(J) == TORN
    assert float(Bench(SYRUP).deform(J, contracting, 0.01)) < TORN


def test_states_follow_a_constant_motion_at_first_order():
    """F' = C F is solved by exp(t C), J' = tr(C) J by exp(t tr C)."""
    C = 2 * draw(6, 3, 3, seed=6)
    trace = C.diagonal(dim1=-2, dim2=-1).sum(-1)
    errors = []
    for steps in (100, 200, 400):
        F, J = IDENTITY.expand(6, 3, 3), torch.full((6,), 0.5, dtype=torch.float64)
        for _ in range(steps):
            F, J = Bench(RUBBER).deform(F, C, 0.1 / steps), Bench(SYRUP).deform(J, C, 0.1 / steps)
        far_F, far_J = F - torch.linalg.matrix_exp(0.1 * C), J - 0.5 * torch.exp(0.1 * trace)
        errors.append(float(far_F.abs().max() + far_J.abs().max()))
    assert all(math.isclose(ratio, 2, abs_tol=0.1) for ratio in np.array(errors[:-1]) / errors[1:])


@pytest.mark.parametrize("material", [SYRUP, RUBBER])
def test_adjoints_are_slopes(material):
    bench, count = Bench(material), 6
    C, G = draw(count, 3, 3, seed=7), draw(count, 3, 3, seed=8)
    solid = isinstance(material, Elastic)
    state = IDENTITY + 0.3 * draw(count, 3, 3, seed=9) if solid else 1 + 0.1 * draw(count, seed=9)
    H = draw(*state.shape, seed=10)

    stress_inputs = bench.inputs(state, C)
    deform_inputs = [0, DT, bench.array(state), bench.array(C), bench.array(torch.zeros_like(state))]
    last = len(stress_inputs) - 1
    stress = bench.adjoint(bench.stress_kernel, stress_inputs, (last - 2, last - 1), G)
    deform = bench.adjoint(bench.deform_kernel, deform_inputs, (2, 3), H)

    def paired_stress(s, c):
        return (bench.affine(s, c) * G).sum()

    def paired_deform(s, c):
        return (bench.deform(s, c) * H).sum()

    for function, (adj_state, adj_C) in ((paired_stress, stress), (paired_deform, deform)):
        ds, dC, step = draw(*state.shape, seed=11), draw(count, 3, 3, seed=12), 1e-5
        by_state = (function(state + step * ds, C) - function(state - step * ds, C)) / (2 * step)
        by_C = (function(state, C + step * dC) - function(state, C - step * dC)) / (2 * step)
        torch.testing.assert_close((adj_state * ds).sum(), by_state, rtol=1e-7, atol=1e-7)
        torch.testing.assert_close((adj_C * dC).sum(), by_C, rtol=1e-7, atol=1e-7)
