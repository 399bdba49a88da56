"""benchmarks/bbob.py: the values of the package cma's functions, and gradients that are their slopes."""

import numpy as np
import pytest
import torch
from benchmarks.bbob import BBOB, FORMULAS, GROUPS
from cma import bbobbenchmarks

FRACTAL = (16, 23)  # Weierstrass and Katsuura: no difference over a step is their slope


@pytest.mark.parametrize("number", range(1, len(FORMULAS) + 1))
def test_values_are_those_of_cma(number: int) -> None:
    for dim, instance in ((2, 1), (5, 7)):
        ours, theirs = BBOB(number, dim, instance), bbobbenchmarks.dictbbob[number](instance)
        x = np.random.default_rng(number).uniform(-5, 5, (8, dim))
        wanted = [float(theirs(point.copy())) for point in x]
        np.testing.assert_allclose(ours.evaluate(torch.from_numpy(x), grad=False).loss, wanted, rtol=1e-9, atol=1e-9)
        assert ours.it.least == theirs.fopt
        best = torch.from_numpy(np.array(theirs.xopt))[None]
        if number not in (9, 19):  # whose minimum cma does not say
            assert float(ours.evaluate(best, grad=False).loss[0]) == pytest.approx(theirs.fopt, abs=1e-6)


@pytest.mark.parametrize("number", range(1, len(FORMULAS) + 1))
def test_gradients_are_slopes(number: int) -> None:
    ours, step = BBOB(number, 3), 1e-5
    x = torch.from_numpy(np.random.default_rng(number).uniform(-4.9, 4.9, (12, 3)))
    found = ours.evaluate(x)
    assert found.grad is not None
    assert bool(found.grad.isfinite().all())
    if number in FRACTAL:
        return
    moves = step * torch.eye(3, dtype=torch.float64)
    ends = [
        ours.evaluate((x[:, None] + side * moves).reshape(-1, 3), grad=False).loss.reshape(12, 3) for side in (1, -1)
    ]
    slopes = (ends[0] - ends[1]) / (2 * step)
    off = ((slopes - found.grad).norm(dim=1) / (slopes.norm(dim=1) + found.grad.norm(dim=1) + 1e-3)).sort().values
    assert float(off[:6].max()) < 1e-3  # of half of the points: steps cross edges, and waves of f19 are shorter


def test_groups_are_those_of_their_authors() -> None:
    names = [BBOB(number, 2).group for number in range(1, len(FORMULAS) + 1)]
    assert [names.count(one) for one in GROUPS.values()] == [5, 4, 5, 5, 5]
