"""The singular value decomposition against its definition and numpy, also where values coincide or vanish."""

from functools import cache

import numpy as np
import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm.materials.plasticine import svd
from gradscape.envs.engines.runtime import precision

from ..bench import IDENTITY, NAMES, draw, rotations

COUNT = 200
ROUND_OFF = {"float32": 3e-6, "float64": 3e-15}  # of the largest singular value


def stretched(*values):
    """Return matrices with the singular values given, between random rotations."""
    s = torch.tensor(values, dtype=torch.float64)
    return rotations(COUNT, seed=1) @ torch.diag(s) @ rotations(COUNT, seed=2)


MATRICES = {
    "random": 4 * draw(COUNT, 3, 3, seed=0),
    "identity": IDENTITY[None],
    **{f"identity + {size:g}": IDENTITY + size * draw(COUNT, 3, 3, seed=3) for size in 10.0 ** np.arange(-9, 0)},
    "two equal, large": stretched(1.3, 1.3, 0.7),
    "two equal, small": stretched(1.3, 0.7, 0.7),
    "three equal": stretched(0.8, 0.8, 0.8),
    "nearly equal": stretched(1.0, 1.0 + 1e-8, 1.0 - 1e-8),
    "diagonal": torch.diag_embed(1.5 + draw(COUNT, 3, seed=4)),
    "flat": stretched(1.2, 0.9, 0.0),
    "nearly flat": stretched(1.2, 0.9, 1e-9),
    "thin": stretched(1.2, 1e-3, 1e-3),
    "needle": stretched(1.2, 1e-8, 1e-8),
    "a line": stretched(1.2, 0.0, 0.0),
    "inverted": stretched(1.2, 0.9, -0.4),
    "mirrored": -stretched(1.0, 1.0, 1.0),
    "far from 1": stretched(30.0, 1.0, 0.03),
}


@cache
def kernel(name):
    types = precision(name)
    decompose, vec3, mat33 = svd(name), types.vec3, types.mat33

    @wp.kernel(module="unique", enable_backward=False)
    def apply(F: wp.array[mat33], U: wp.array[mat33], s: wp.array[vec3], V: wp.array[mat33]):
        i = wp.tid()
        left, values, right = decompose(F[i])
        U[i] = left
        s[i] = values
        V[i] = right

    return apply


def decomposed(F, name):
    types = precision(name)
    results = [wp.zeros(len(F), dtype=kind) for kind in (types.mat33, types.vec3, types.mat33)]
    given = wp.array(F.to(types.torch).contiguous().numpy(), dtype=types.mat33)
    wp.launch(kernel(name), len(F), [given, *results], record_tape=False)
    return [torch.from_numpy(array.numpy()).double() for array in results]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("case", MATRICES)
def test_factors_are_rotations_that_give_the_matrix_back_and_values_are_numpys(case, name):
    """The last value bears the determinant's sign."""
    F = MATRICES[case].to(precision(name).torch).double()  # rounded as the function will see it
    U, s, V = decomposed(F, name)
    size = s[:, :2].amax(dim=1)[:, None, None]
    assert ((U * s[:, None] @ V.mT - F).abs() / size).max() < ROUND_OFF[name]
    for Q in (U, V):
        assert (Q.mT @ Q - IDENTITY).abs().max() < ROUND_OFF[name]
        assert (torch.linalg.det(Q) - 1).abs().max() < ROUND_OFF[name]
    wanted = torch.from_numpy(np.linalg.svd(F.numpy(), compute_uv=False))
    error = (s.abs().sort(dim=1, descending=True).values - wanted).abs() / wanted[:, :1]
    assert error.max() < ROUND_OFF[name]
    least = -ROUND_OFF[name] * wanted[:, 0]  # what vanishes has no sign, and no order
    assert (s[:, :2] >= least[:, None]).all()
    assert (s[:, :2].amin(dim=1) * (1 + ROUND_OFF[name]) - s[:, 2].abs() >= least).all()
    clear = wanted[:, 2] > 10 * ROUND_OFF[name] * wanted[:, 0]  # a flat matrix has no sign
    assert torch.equal(s[clear, 2].sign(), torch.linalg.det(F[clear]).sign())
