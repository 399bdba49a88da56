"""Materials against continuum mechanics: what costs stress, Hooke's and Newton's laws, and the kernels' adjoints."""

import math

import numpy as np
import pytest
import torch

from gradscape.envs.engines.mpm.materials import Elastic, Fluid, Plasticine, fluid
from gradscape.envs.engines.mpm.materials.fluid import TORN

from ..bench import (
    IDENTITY,
    MASS,
    NAMES,
    SCALE,
    VOLUME,
    MaterialBench,
    assert_rows_have_the_same_bits,
    draw,
    rotations,
)

SYRUP = Fluid(density=1300.0, bulk=4e4, viscosity=4.0)
RUBBER = Elastic.with_wave_speed(1400.0, 6.0, poisson=0.3)
FIRM = Plasticine(1000.0, 5e3, 0.2, yield_stress=5e3)  # far from where it yields
ROUND_OFF = {"float32": 2e-6, "float64": 1e-13}  # of the moduli


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("solid", [RUBBER, FIRM])
def test_turning_a_solid_costs_no_stress(solid, name):
    R = rotations(20, seed=0)
    state, A = MaterialBench(solid, name).update(R, torch.zeros_like(R), 0.0)
    assert (A / (SCALE * VOLUME)).abs().max() < ROUND_OFF[name] * solid.young
    torch.testing.assert_close(state, R, rtol=0, atol=ROUND_OFF[name])


@pytest.mark.parametrize("solid", [RUBBER, FIRM])
def test_a_solids_stress_turns_with_it_and_it_is_isotropic(solid):
    bench, R = MaterialBench(solid), rotations(20, seed=1)
    F = IDENTITY + 0.3 * draw(20, 3, 3, seed=2)
    tau = bench.tau(F)
    for turned, wanted in ((R @ F, R @ tau @ R.mT), (F @ R, tau)):
        torch.testing.assert_close(bench.tau(turned), wanted, rtol=0, atol=1e-10 * solid.young)
    torch.testing.assert_close(tau, tau.mT)


@pytest.mark.parametrize("solid", [RUBBER, FIRM])
def test_small_strains_obey_hooke(solid):
    strain = draw(20, 3, 3, seed=3)
    strain = strain + strain.mT
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    hooke = solid.lam * trace * IDENTITY + 2 * solid.mu * strain
    errors = [
        float((MaterialBench(solid).tau(IDENTITY + size * strain) / size - hooke).abs().max())
        for size in (1e-3, 5e-4, 2.5e-4)
    ]
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 2, atol=0.02)  # first order in the strain
    assert errors[-1] < 1e-3 * solid.young


def test_stretching_one_axis_meets_the_modulus_of_pressure_waves():
    stretch = 1e-6
    F = IDENTITY.clone()
    F[1, 1] += stretch
    tau = MaterialBench(RUBBER).tau(F[None])[0] / stretch
    modulus = RUBBER.lam + 2 * RUBBER.mu
    assert modulus == pytest.approx(1400.0 * 6.0**2)
    assert tau[1, 1] == pytest.approx(modulus, rel=1e-5)
    assert tau[0, 0] == pytest.approx(RUBBER.lam, rel=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_a_fluid_bears_the_pressure_its_volume_ratio_was_made_for(name):
    pressure = np.linspace(0, 2e3, 9)
    ratio = torch.from_numpy(SYRUP.initial(SYRUP.volume_ratio(pressure)))
    tau = MaterialBench(SYRUP, name).tau(ratio)
    wanted = -torch.from_numpy(pressure)[:, None, None] * IDENTITY
    torch.testing.assert_close(tau, wanted, rtol=0, atol=ROUND_OFF[name] * SYRUP.bulk)
    assert (np.diff(ratio.numpy()) < 0).all()


def test_an_elastic_solid_bears_it_to_first_order():
    misses = []
    for pressure in (200.0, 100.0, 50.0):
        F = torch.from_numpy(RUBBER.initial(RUBBER.volume_ratio(np.array([pressure]))))
        misses.append(float((MaterialBench(RUBBER).tau(F)[0] + pressure * IDENTITY).abs().max()) / pressure)
    np.testing.assert_allclose(np.array(misses[:-1]) / misses[1:], 2, atol=0.05)
    assert misses[-1] < 0.01


def test_shearing_a_fluid_meets_newtons_viscosity_and_turning_and_swelling_it_none():
    J, bench, spin = torch.tensor([1.0, 0.97, 1.02], dtype=torch.float64), MaterialBench(SYRUP), draw(3, 3, 3, seed=4)
    sheared = torch.zeros(3, 3, 3, dtype=torch.float64)
    sheared[:, 0, 1] = 3.0
    stress = J[:, None, None] * SYRUP.viscosity * (sheared + sheared.mT)
    for C, wanted in ((sheared, stress), (spin - spin.mT, 0 * stress), (2.0 * IDENTITY.expand(3, 3, 3), 0 * stress)):
        torch.testing.assert_close(bench.tau(J, C) - bench.tau(J), wanted, rtol=0, atol=1e-10)


def test_particles_carry_their_affine_momentum():
    C = draw(5, 3, 3, seed=5)
    at_rest = IDENTITY.expand(5, 3, 3)
    torch.testing.assert_close(MaterialBench(RUBBER).update(at_rest, C, 0.0)[1], MASS * C, rtol=0, atol=1e-12)


def test_a_fluid_tears_instead_of_stretching_on():
    J = torch.ones(1, dtype=torch.float64)
    expanding, contracting = (rate * IDENTITY[None] for rate in (10.0, -10.0))
    for _ in range(100):
        J = MaterialBench(SYRUP).deform(J, expanding, 0.01)
    assert float(J) == TORN
    assert float(MaterialBench(SYRUP).deform(J, contracting, 0.01)) < TORN


def test_states_follow_a_constant_motion_at_first_order():
    """F' = C F is solved by exp(t C), J' = tr(C) J by exp(t tr C)."""
    C = 2 * draw(6, 3, 3, seed=6)
    trace = C.diagonal(dim1=-2, dim2=-1).sum(-1)
    errors = []
    for steps in (100, 200, 400):
        F, J = IDENTITY.expand(6, 3, 3), torch.full((6,), 0.5, dtype=torch.float64)
        for _ in range(steps):
            F, J = MaterialBench(RUBBER).deform(F, C, 0.1 / steps), MaterialBench(SYRUP).deform(J, C, 0.1 / steps)
        far_F, far_J = F - torch.linalg.matrix_exp(0.1 * C), J - 0.5 * torch.exp(0.1 * trace)
        errors.append(float(far_F.abs().max() + far_J.abs().max()))
    assert all(math.isclose(ratio, 2, abs_tol=0.1) for ratio in np.array(errors[:-1]) / errors[1:])


@pytest.mark.parametrize("through", ["state", "momentum"])
@pytest.mark.parametrize("material", [SYRUP, RUBBER])
def test_adjoints_are_slopes(material, through):
    count, dt = 12, 0.1
    C = draw(count, 3, 3, seed=7)
    state = (
        IDENTITY + 0.3 * draw(count, 3, 3, seed=9) if isinstance(material, Elastic) else 1 + 0.1 * draw(count, seed=9)
    )
    weights = [draw(*state.shape, seed=10), draw(count, 3, 3, seed=8)]
    weights[through == "state"].zero_()
    for got, wanted in MaterialBench(material).slopes(state, C, *weights, dt, step=1e-5):
        assert wanted.abs().max() > 0
        torch.testing.assert_close(got, wanted, rtol=0, atol=1e-8 * float(wanted.abs().max()))


def test_a_torn_fluid_has_forgotten_its_volume():
    """Its pressure no longer depends on J nor on how fast it swells; its viscous stress still does on shear."""
    J, C = torch.full((4,), TORN, dtype=torch.float64), 3 * IDENTITY + draw(4, 3, 3, seed=13)
    bench = MaterialBench(SYRUP)
    adj_J, adj_C = bench.adjoint(J, C, torch.ones(4, dtype=torch.float64), IDENTITY.expand(4, 3, 3))
    assert not adj_J.any()
    torch.testing.assert_close(adj_C, MASS * IDENTITY.expand(4, 3, 3))  # a pressure meets no shear


def test_rows_of_a_cpu_have_the_same_bits():
    """Eight particles of a fluid at a time, and six that are left, give what one gives: squeezed, at rest and torn."""
    J = torch.cat([torch.tensor([1.0, TORN, 1e-3]), 1 + 0.1 * draw(99, seed=40)]).double()
    C, adj_J, adj_A = 60 * draw(102, 3, 3, seed=41), draw(102, seed=42), draw(102, 3, 3, seed=43)
    C[1::9] = 0.0
    assert_rows_have_the_same_bits(SYRUP, fluid.response, J, C, adj_J, adj_A)
    assert (MaterialBench(SYRUP, "float32").update(J, C)[0] > TORN - 1e-6).float().mean() > 0.05
