"""A CPU's kernels, which take eight vertices at a time, against those that take one in each thread, to the bit."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gradscape.envs.engines.sheets import springs
from gradscape.envs.engines.sheets.contact import AnchoredFloor, Floor, PanOverFloor
from gradscape.envs.engines.sheets.springs import Solver
from gradscape.envs.sheets import lattice

from .cloths import DT, PAN, crumpled, drive

STEPS = 30


def tangled(surface):
    """Return a sheet of 25 vertices of unlike springs: a plate, coincident ends, twice a spring, some held."""
    shift = (0.05, 0.012, 0.02) if surface is not CASES["floor"][0] else (0.0, 0.008, 0.0)
    count = len(lattice.springs(lattice.square(4), reach=2, bend=0.4)[0])
    plate = 2.0 * np.random.default_rng(1).uniform(-0.3, 1, count)
    sheet = crumpled(4, 0.04, shift, held=(20, 24), plate=plate)
    sheet.x[7] = sheet.x[8]
    again = {name: np.concatenate([value, value[5:7]]) for name, value in vars(sheet).items() if name in PER_SPRING}
    return replace(sheet, **again)


PER_SPRING = ("pairs", "rest", "weight", "plate")
CASES = {
    "floor": (AnchoredFloor(friction=0.3), "start", "float32"),
    "pan": (PAN, "start", "float64"),
    "both": (PanOverFloor(replace(PAN, friction=0.2), Floor(0.0)), "end", "float32"),
}


def simulate(sheet, surface, rule, name):
    """Return all positions, the gradient of a random loss, and the solver."""
    solver = Solver(sheet, surface, dt=DT, steps=STEPS, name=name, capacity=4, device="cpu", rule=rule)
    inputs, adj_end = drive(sheet, STEPS)
    x = solver.run(*inputs).clone()
    return [x, *(part.clone() for part in solver.gradient(adj_end))], solver


@pytest.mark.parametrize("case", CASES)
def test_eight_vertices_at_a_time_have_the_bits_of_each_alone(case, monkeypatch):
    surface, rule, name = CASES[case]
    sheet = tangled(surface)
    ours, solver = simulate(sheet, surface, rule, name)
    assert 0 < int(solver.touched[0].numpy()[:3, 0].min()) < len(sheet.x) - 2  # some are, and some are not
    monkeypatch.setattr(springs, "_in_rows", lambda device: False)
    theirs, _ = simulate(sheet, surface, rule, name)
    for eight, alone in zip(ours, theirs, strict=True):
        assert eight.isfinite().all()
        assert eight.abs().max() > 0
        assert torch.equal(eight, alone)
