"""What docs/races.md says of a fair race: methods with the same seed begin at the same point."""

import pytest
import torch

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.registry import methods, optimizer_class

SPACE = ParameterSpace.box(("a", "b", "c"), -1.0, 1.0)
BOWL = from_torch(lambda x: (x**2).sum(dim=1), SPACE, name="bowl")
AROUND = ("cma-es", "cma-es-gradient", "bo-leap")  # draw a population around their first point
ELSEWHERE = ("ppo", "sac")  # begin with a policy


@pytest.mark.parametrize("name", [name for name in methods() if name not in ELSEWHERE])
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
