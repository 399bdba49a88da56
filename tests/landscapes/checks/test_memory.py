"""Memory that grows with every evaluation is found; caches, garbage and allocators of healthy functions are not."""

import jax.numpy as jnp
import numpy as np
import pytest
import torch
import warp as wp

import gradscape as gs
from gradscape.landscapes.checks.memory import FLOOR, memory_growth

SPACE = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})
X = SPACE.uniform(16, seed=0)


@wp.kernel
def _square(x: wp.array2d(dtype=wp.float32), loss: wp.array(dtype=wp.float32)):
    i = wp.tid()
    loss[i] = x[i, 0] * x[i, 0] + x[i, 1]


def squares(x):
    loss = wp.zeros(len(x), dtype=wp.float32, requires_grad=True)
    wp.launch(_square, dim=len(x), inputs=[x], outputs=[loss])
    return loss


def keeping(make, loss=lambda x: (x**2).sum(1)):
    """Return a function that appends something to a list at each evaluation."""
    kept = []
    return lambda x: (kept.append(make()), loss(x))[1]


def graphs(numbers):
    """Return a function that appends the graph of each evaluation to a list, of so many numbers for each point."""
    kept = []

    def keep(x):
        wide = x[:, :1] * torch.ones(numbers, dtype=x.dtype)
        loss = wide.sin().mean(1) + x[:, 1] ** 2
        kept.append((wide, loss))  # torch drops what a graph has saved once it is differentiated
        return loss

    return gs.from_torch(keep, SPACE, name="graphs")


class Cache:
    """A function that fills a cache of 40 MB, once after some calls."""

    def __init__(self):
        self.calls, self.cache = 0, None

    def __call__(self, x):
        self.calls += 1
        if self.calls == 60:
            self.cache = np.ones(5_000_000)
        return (x**2).sum(1)


def garbage(x):
    """Leave 100 kB which refer to themselves."""
    cycle = [np.ones(12_500)]
    cycle.append(cycle)
    return (x**2).sum(1)


HEALTHY = {
    "torch": lambda: gs.from_torch(lambda x: (x**2).sum(1), SPACE),
    "torch, large": lambda: gs.from_torch(lambda x: (x[:, :1] * torch.ones(100_000).to(x)).sin().mean(1), SPACE),
    "jax": lambda: gs.from_jax(lambda p: jnp.sin(p[0]) * p[1], SPACE),
    "warp": lambda: gs.from_warp(squares, SPACE, device="cpu"),
    "numpy": lambda: gs.from_numpy(lambda x: (x**2).sum(1), SPACE, differences=1e-4),
    "a scene": lambda: gs.make("bounce", fidelity="draft", device="cpu"),
    "a cache": lambda: gs.from_numpy(Cache(), SPACE, differences=1e-4, name="cache"),
    "garbage": lambda: gs.from_torch(garbage, SPACE),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_nothing_grows_in_what_keeps_nothing(name):
    objective = HEALTHY[name]()
    found = memory_growth(objective, objective.space.uniform(16, seed=0))
    assert not found.grows
    assert found.where == "process"


@pytest.mark.parametrize("numbers", [1, 100, 10_000])
def test_graphs_that_are_kept_are_found_with_their_size(numbers):
    found = memory_growth(graphs(numbers), X)
    assert found.grows
    assert found.total > FLOOR
    least = 8 * 16 * numbers
    assert least / 2 < found.per_evaluation < 4 * least + 20_000


def test_numbers_and_arrays_of_warp_that_are_kept_are_found():
    numbers = keeping(lambda: [float(number) for number in range(1000)])
    assert memory_growth(gs.from_numpy(numbers, SPACE, differences=1e-4, name="numbers"), X).grows
    tapes = keeping(lambda: wp.ones(1 << 14, dtype=wp.float32, requires_grad=True), squares)  # of 64 kB
    found = memory_growth(gs.from_warp(tapes, SPACE, device="cpu", name="tapes"), X)
    assert found.grows
    assert 3e4 < found.per_evaluation < 3e5


def test_what_a_few_evaluations_cannot_show_is_none():
    assert not memory_growth(graphs(100), X, seconds=1e-3).grows
