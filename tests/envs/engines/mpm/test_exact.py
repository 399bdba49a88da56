"""Exact sums of floating-point numbers: what a GPU's integers come to, against sums without rounding."""

import math

import numpy as np
import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm.boundaries import BITS, LANES, LOWEST, SUMS, settle_kernel
from gradscape.envs.engines.runtime import precision, to_torch

SLOTS, STEPS = 2, 3
KINDS = {"float32": np.float32, "float64": np.float64}


def add(sums, value, name):
    """Add a number to the sums of its range, as a GPU does: its whole multiple of the least number."""
    if not math.isfinite(value):
        sums[SUMS[name] - 1] += 1
        return
    whole = int(math.ldexp(abs(float(value)), LOWEST[name]) if name == "float32" else exact_multiple(value))
    low = 0
    while whole:
        part, width = whole & ((1 << BITS) - 1), low // BITS
        sums[width] += part if value > 0 else -part
        whole, low = whole >> BITS, low + BITS


def exact_multiple(value):
    top, bottom = abs(float(value)).as_integer_ratio()
    return top * (1 << LOWEST["float64"]) // bottom


def settled(name, numbers):
    """Return the adjoint of tools, shape (step + 1, slot, 3), to which numbers were added in one place, by lane."""
    sums = np.zeros((LANES, 6 * SLOTS, SUMS[name]), dtype=np.int64)
    for i, value in enumerate(numbers):
        add(sums[i % LANES, 3 * SLOTS + 4], value, name)  # of the step's end: slot 1, axis y
    held = wp.array(sums.reshape(LANES, -1), dtype=wp.int64)
    adjoint = wp.zeros((1, STEPS, SLOTS, 3), dtype=precision(name).real)
    wp.launch(settle_kernel(name), (1, 6 * SLOTS), [1, held, adjoint], record_tape=False)
    assert not to_torch(held).any()
    return to_torch(adjoint)[0].double()


@pytest.mark.parametrize("name", SUMS)
def test_sums_are_rounded_once_whatever_their_order(name):
    kind, rng = KINDS[name], np.random.default_rng(0)
    numbers = (rng.standard_normal(200) * 2.0 ** rng.integers(-60, 60, 200)).astype(kind)
    wanted = kind(math.fsum(numbers))
    for order in (numbers, numbers[::-1], rng.permutation(numbers)):
        found = settled(name, order)
        assert float(found[2, 1, 1]) == pytest.approx(float(wanted), rel=2 * float(np.finfo(kind).eps))
        assert torch.equal(found, settled(name, numbers))
        assert int((found != 0).sum()) == 1


@pytest.mark.parametrize("name", SUMS)
def test_what_cancels_leaves_the_rest(name):
    kind = KINDS[name]
    tiny = np.finfo(kind).tiny / 4  # below the normal numbers
    numbers = np.array([1e30, tiny, -1e30, 3.0, -3.0], dtype=kind)
    assert float(settled(name, numbers)[2, 1, 1]) == float(numbers[1]) > 0


@pytest.mark.parametrize("name", SUMS)
def test_what_is_no_number_is_said(name):
    assert settled(name, np.array([1.0, np.inf], dtype=KINDS[name]))[2, 1, 1].isnan()
