"""Plasticine against its own definition: no stress from turning, Hooke's law, von Mises' bound, and true adjoints."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gradscape.envs.engines.mpm.materials import Plasticine, plasticine
from gradscape.envs.engines.mpm.materials.plasticine import ROUNDED, SMALLEST

from ..bench import IDENTITY, NAMES, MaterialBench, assert_rows_have_the_same_bits, draw, in_warp, rotations

CLAY = Plasticine(1000.0, 5e3, 0.2, yield_stress=50.0)
KAPPA = CLAY.yield_stress / (2 * CLAY.mu)  # largest deviatoric log strain
ROUND_OFF = {"float32": 2e-6, "float64": 1e-13}  # of the moduli
STILL = torch.zeros(1, 3, 3, dtype=torch.float64)


def after(F, name="float64"):
    """Return F after the return map, which no time passes by."""
    return MaterialBench(CLAY, name).deform(F, STILL.expand_as(F), 0.0)


def log_strain(F):
    """Return (log singular values, descending, their deviators)."""
    e = torch.linalg.svdvals(F).log()
    return e, e - e.mean(dim=1, keepdim=True)


def stretches(*logs, seed=0):
    """Return one F with these log strains, between random rotations."""
    e = torch.tensor(logs, dtype=torch.float64)
    return rotations(1, seed) @ torch.diag(e.exp()) @ rotations(1, seed + 1)


@pytest.mark.parametrize("size", [0.003, 0.8])  # before and after it yields
def test_stress_is_fixed_corotated(size):
    """tau = 2 mu (F' - R) F'^T + lam J (J - 1) I, with F' after the return and R its rotation."""
    F = rotations(20, seed=4) @ (IDENTITY + size * draw(20, 3, 3, seed=5))
    new = after(F)
    U, _, Vt = torch.linalg.svd(new)
    J = torch.linalg.det(new)[:, None, None]
    wanted = 2 * CLAY.mu * (new - U @ Vt) @ new.mT + CLAY.lam * J * (J - 1) * IDENTITY
    torch.testing.assert_close(MaterialBench(CLAY).tau(F), wanted, rtol=0, atol=1e-10 * CLAY.young)


def test_update_advances_by_the_motion_before_it_returns():
    F, C = IDENTITY + 0.3 * draw(20, 3, 3, seed=6), draw(20, 3, 3, seed=7)
    new = MaterialBench(CLAY).deform(F, C, 0.1)
    torch.testing.assert_close(new, after((IDENTITY + 0.1 * C) @ F), rtol=0, atol=1e-13)


@settings(max_examples=60)
@given(st.tuples(*[st.floats(-2.5, 2.5)] * 3), st.integers(0, 999))
def test_shape_flows_and_volume_returns(logs, seed):
    """However it is strained, it bears no more than kappa, and keeps its volume and its principal directions."""
    F = stretches(*logs, seed=seed)
    new = after(F)
    (e, d), (e_new, d_new) = log_strain(F), log_strain(new)
    assert d_new.norm() <= KAPPA * (1 + 1e-9)
    torch.testing.assert_close(e_new.sum(dim=1), e.sum(dim=1), rtol=0, atol=1e-12)
    for squares in ((F @ F.mT, new @ new.mT), (F.mT @ F, new.mT @ new)):  # the same axes, so they commute
        mixed = squares[0] @ squares[1] - squares[1] @ squares[0]
        assert mixed.abs().max() < 1e-13 * squares[0].abs().max() * squares[1].abs().max() + 1e-14
    norm = torch.sqrt((d * d).sum() + ROUNDED)
    wanted = d * (KAPPA / norm).clamp_max(1)  # radial
    torch.testing.assert_close(d_new, wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_below_the_yield_stress_nothing_changes(name):
    F = torch.cat([stretches(0.1 + 0.6 * KAPPA, 0.1, 0.1 - 0.6 * KAPPA, seed=seed) for seed in range(20)])
    assert (log_strain(F)[1].norm(dim=1) > 0.8 * KAPPA).all()
    torch.testing.assert_close(after(F, name), F, rtol=0, atol=3 * ROUND_OFF[name])


def test_what_yields_stands_at_the_yield_stress():
    """Pulled or sheared ever further, the von Mises norm of the stress, 2 mu |d|, stays what it was made of."""
    F = torch.cat([stretches(0.02, -0.01, -0.01), stretches(0.3, 0.0, -0.3), stretches(0.2, 0.2, -0.4)])
    bench, norms = MaterialBench(CLAY), []
    for _ in range(2):
        tau = bench.tau(F)
        deviator = tau - tau.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * IDENTITY
        norms.append(torch.linalg.matrix_norm(deviator))
        F = F @ F
    for norm in norms:
        torch.testing.assert_close(norm, torch.full_like(norm, CLAY.yield_stress), rtol=0.03, atol=0)


CASES = {
    "elastic": IDENTITY + 0.004 * draw(8, 3, 3, seed=8),
    "yielding": IDENTITY + 0.8 * draw(8, 3, 3, seed=9),
    "undeformed": IDENTITY[None],
    "nearly undeformed": IDENTITY + 1e-9 * draw(8, 3, 3, seed=10),
    "swollen": 1.1 * IDENTITY[None],
    "two equal, stretched": torch.diag(torch.tensor([1.2, 1.0, 1.0]).double())[None],
    "two equal, squeezed": torch.diag(torch.tensor([0.8, 0.8, 1.1]).double())[None],
    "two equal, turned": stretches(0.2, 0.2, -0.1, seed=11),
    "two nearly equal": stretches(0.2, 0.2 + 1e-9, -0.1, seed=13),
    "two a little apart": stretches(0.4, 0.18, 0.0, seed=14),  # where shrink leaves its series
    "flat": stretches(0.1, -0.1, np.log(0.3 * SMALLEST), seed=15),
    "flatter": rotations(1, seed=17) @ torch.diag(torch.tensor([1.3, 0.9, 1e-3]).double()) @ rotations(1, seed=18),
    "flat both ways": stretches(0.1, np.log(0.5 * SMALLEST), np.log(0.3 * SMALLEST), seed=19),
    "inverted": rotations(1, seed=21) @ torch.diag(torch.tensor([1.3, 0.9, -0.2]).double()) @ rotations(1, seed=22),
}


@pytest.mark.parametrize("through", ["state", "momentum"])
@pytest.mark.parametrize("case", CASES)
def test_adjoints_are_slopes(case, through):
    F, bench = CASES[case].expand(8, 3, 3), MaterialBench(CLAY)
    weights = [draw(len(F), 3, 3, seed=16), draw(len(F), 3, 3, seed=17)]
    weights[through == "state"].zero_()
    for C in (torch.zeros_like(F), draw(len(F), 3, 3, seed=18)):  # F itself, and F moved on
        dt = 1e-3 if C.any() else 0.1
        for got, wanted in bench.slopes(F, C, *weights, dt, step=3e-6):
            assert wanted.abs().max() > 0
            torch.testing.assert_close(got, wanted, rtol=0, atol=1e-6 * float(wanted.abs().max()))


def test_an_adjoint_where_three_singular_values_coincide_is_that_of_a_swelling_body():
    """Yielding with three equal values is yielding with kappa below the rounding: only volume passes on."""
    soft = Plasticine(1000.0, 5e3, 0.2, yield_stress=0.1)
    assert soft.yield_stress / (2 * soft.mu) < np.sqrt(ROUNDED)
    F = torch.cat([IDENTITY[None], 0.8 * IDENTITY[None], 1.1 * rotations(1, seed=23)])
    weights = [draw(3, 3, 3, seed=24), draw(3, 3, 3, seed=25)]
    for got, wanted in MaterialBench(soft).slopes(F, torch.zeros_like(F), *weights, 0.1, step=1e-7):
        torch.testing.assert_close(got, wanted, rtol=0, atol=1e-6 * float(wanted.abs().max()))


def test_rows_of_a_cpu_have_the_same_bits():
    """Eight particles at a time give what one gives: undeformed, yielding, flat, thin and turned inside out."""
    sizes = torch.tensor([0.0, 1e-3, 0.05, 0.3, 1.5]).repeat(25)[:, None, None]
    odd = [torch.diag(torch.tensor(one)) for one in ([0.0, 0, 0], [1.0, 1, 0], [2.0, 1, -1], [1.0, 0, 0])]
    F = torch.cat([torch.stack(odd).double(), IDENTITY + sizes * draw(125, 3, 3, seed=30)])
    C, adj_F, adj_A = (scale * draw(len(F), 3, 3, seed=31 + k) for k, scale in enumerate((30.0, 1.0, 1.0)))
    assert_rows_have_the_same_bits(CLAY, plasticine.response, F, C, adj_F, adj_A)


@pytest.mark.parametrize("yields_at", [50.0, 200.0, 5e6])
@pytest.mark.parametrize("size", [0.0, 1e-3, 0.02, 0.1, 0.2, 0.4])
@pytest.mark.parametrize(("name", "bound"), [("float32", 4e-6), ("float64", 3e-7)])
def test_series_do_what_decompositions_do(name, bound, size, yields_at):
    """Series end where float32 does; beyond them, and where a particle is flat, a decomposition takes over."""
    count, clay = 200, replace(CLAY, yield_stress=yields_at)
    swollen = (0.5 * draw(count, 1, 1, seed=40)).exp()
    F = swollen * (rotations(count, 41) @ (IDENTITY + size * draw(count, 3, 3, seed=42)) @ rotations(count, 43))
    odd = [CASES[case][:1] for case in ("flat", "flatter", "flat both ways", "inverted", "undeformed", "swollen")]
    F = torch.cat([F, *odd])
    C, adj_F, adj_A = (scale * draw(len(F), 3, 3, seed=44 + k) for k, scale in enumerate((3.0, 1.0, 1.0)))
    series, reference = in_warp(clay, plasticine.response_by_series, name), MaterialBench(clay)
    for got, wanted in (
        *zip(series.update(F, C), reference.update(F, C), strict=True),
        *zip(series.adjoint(F, C, adj_F, adj_A), reference.adjoint(F, C, adj_F, adj_A), strict=True),
    ):
        for part in (slice(count), slice(count, None)):
            largest = float(wanted[part].abs().max())
            torch.testing.assert_close(got[part], wanted[part], rtol=0, atol=bound * largest)


@pytest.mark.parametrize("case", ["elastic", "yielding", "undeformed", "swollen", "two equal, squeezed"])
def test_adjoints_of_series_are_slopes(case):
    F, bench = CASES[case].expand(8, 3, 3), in_warp(CLAY, plasticine.response_by_series, "float64")
    weights = [draw(8, 3, 3, seed=16), draw(8, 3, 3, seed=17)]
    for got, wanted in bench.slopes(F, draw(8, 3, 3, seed=18), *weights, 1e-3, step=3e-6):
        torch.testing.assert_close(got, wanted, rtol=0, atol=1e-6 * float(wanted.abs().max()))
