"""What holds of every method: how it begins, what its seed decides, and which options it refuses."""

import math

import numpy as np
import pytest
import torch

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.registry import methods, optimizer_class

from .states import restored

SPACE = ParameterSpace.box(("a", "b", "c"), -1.0, 1.0)
BOWL = from_torch(lambda x: (x**2).sum(dim=1), SPACE, name="bowl")
AROUND = ("cma-es", "cma-es-gradient", "bo-leap", "continuation")  # draw a population around their first point
ELSEWHERE = ("ppo", "sac")  # begin with a policy; see test_policy.py
MEASURING = ("auto",)  # begins with points of its own; see test_auto.py
EGGS = from_torch(  # Rastrigin's function
    lambda x: (x**2 - 10.0 * torch.cos(2.0 * math.pi * x) + 10.0).sum(dim=1),
    ParameterSpace.box(("a", "b"), -4.0, 5.0),
    name="rastrigin",
)
QUICK = {
    "bo-leap": {"local_budget": 30},
    "bo": {"initial": 5},
    "bo-descents": {"initial": 5},
    "auto": {"evaluations": 20},
}


@pytest.mark.parametrize("name", [name for name in methods() if name not in (*ELSEWHERE, *MEASURING)])
def test_methods_with_the_same_seed_begin_at_the_same_point(name):
    first = optimizer_class("random").on(BOWL, seed=7).ask().x[0]
    optimizer = optimizer_class(name).on(BOWL, seed=7)
    if name not in AROUND:
        torch.testing.assert_close(optimizer.ask().x[0], first, rtol=0, atol=1e-12)
        return
    narrow = optimizer_class(name).Options(sigma=1e-6)
    around = optimizer_class(name).on(BOWL, seed=7, options=narrow).ask().x.mean(dim=0)
    torch.testing.assert_close(around, first, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["bo", "bo-gradient", "turbo"])
def test_surrogates_are_told_the_same_points_first(name):
    wanted = optimizer_class("random").on(BOWL, seed=3).ask().x[:6]
    optimizer, found = optimizer_class(name).on(BOWL, seed=3), []
    while len(found) < 6:
        proposal = optimizer.ask()
        optimizer.tell(proposal.x, BOWL.evaluate(proposal.x, grad=proposal.grad))
        found += list(proposal.x)
    torch.testing.assert_close(torch.stack(found[:6]), wanted, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in methods() if name not in ELSEWHERE])
def test_a_seed_decides_every_point_bit_for_bit_through_its_state_too(name):
    kind = optimizer_class(name)
    options, before = kind.Options(**QUICK.get(name, {})), np.random.get_state()[1].copy()
    plain, kept, other = (kind.on(EGGS, seed=seed, options=options) for seed in (7, 7, 8))
    same = []
    for _ in range(25 if name == "bo" else 50):
        asks = [one.ask() for one in (plain, kept, other)]
        assert torch.equal(asks[0].x, asks[1].x)
        assert (asks[0].kind, asks[0].grad) == (asks[1].kind, asks[1].grad)
        same.append(torch.equal(asks[0].x, asks[2].x))
        assert bool(((asks[0].x >= EGGS.space.lower) & (asks[0].x <= EGGS.space.upper)).all())
        for one, ask in zip((plain, kept, other), asks, strict=True):
            one.tell(ask.x, EGGS.evaluate(ask.x, grad=ask.grad))
        kept = restored(kept, EGGS)
    assert sum(same) < len(same) / 5  # searches may meet at a corner
    np.testing.assert_array_equal(before, np.random.get_state()[1])


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("cma-es", {"population": 2}, "population takes 0 or at least 3; got 2"),
        ("cma-es", {"sigma": 0.0}, "sigma takes numbers from 1e-09 to 1000"),
        ("bo-leap", {"best": 10}, "best takes 1 to 9 of a population of 10; got 10"),
        ("turbo", {"shortest": 0.9}, "shortest must be below the length 0.8; got 0.9"),
        ("bo", {"kernel": "cubic"}, "kernel takes rbf or matern; got cubic"),
    ],
)
def test_options_that_cannot_work_are_refused(name, options, said):
    with pytest.raises(ValueError, match=said):
        optimizer_class(name).Options(**options)


@pytest.mark.parametrize(
    ("name", "dim", "said"),
    [
        ("cma-es", 1, "two parameters or more; this space has 1"),
        ("bo-leap", 1, "two parameters or more; this space has 1"),
        ("bo-gradient", 50, "bo-gradient models gradients in at most 49 parameters; this space has 50"),
    ],
)
def test_a_space_that_a_method_cannot_search_is_refused(name, dim, said):
    with pytest.raises(ValueError, match=said):
        optimizer_class(name)(ParameterSpace.box([f"x{n}" for n in range(dim)], -1.0, 1.0))
