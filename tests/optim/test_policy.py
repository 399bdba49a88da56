import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3", reason="the extra rl is not installed")

from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind
from gradscape.optim.methods.policy import PPO, SAC, PPOOptions, SACOptions
from gradscape.optim.registry import optimizer_class
from gradscape.optim.search import search

from .states import restored


class Bowl(Objective):
    """A bandit: one decision of two controls, best at (0.8, -1)."""

    space = ParameterSpace.box(("x", "y"), -2.0, 2.0)

    def evaluate(self, x, *, grad=True):
        return Evaluation.from_results((x - torch.tensor([0.8, -1.0])).square().sum(dim=1), None)


class Coin(Objective):
    """Four decisions: the first tosses a coin, whose side the others must match; only a look shows it."""

    space = ParameterSpace.box([f"u{k}" for k in range(4)], -3.0, 3.0)
    decisions = 4

    def __init__(self, *, blind=False):
        self.blind, self.looks = blind, []

    def observe(self, x, decision):
        self.looks.append((decision, x.clone()))
        seen = self.side(x) if decision and not self.blind else torch.zeros(len(x), dtype=x.dtype)
        return torch.stack([seen, torch.full_like(seen, decision / 4)], dim=1)

    def evaluate(self, x, *, grad=True):
        return Evaluation.from_results((x[:, 1:] - 2 * self.side(x)[:, None]).square().mean(dim=1), None)

    def side(self, x):
        return (25 * x[:, 0]).sin().sign()


class Fragile(Bowl):
    """A bowl where one half of the box fails."""

    def evaluate(self, x, *, grad=True):
        loss = (x - torch.tensor([0.8, -1.0])).square().sum(dim=1)
        return Evaluation.from_results(loss.masked_fill(x[:, 0] < 0, torch.nan), None)


SMALL = {
    "ppo": (PPO, PPOOptions(episodes=4, minibatches=2, epochs=2)),
    "sac": (SAC, SACOptions(warmup=4, batch=8, memory=64)),
}


@pytest.fixture(autouse=True)
def _one_thread():  # networks this small get nothing from more, and wait for them where cores are busy
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=SMALL)
def small(request):
    kind, options = SMALL[request.param]

    def make(objective, seed=0):
        optimizer = kind.on(objective, seed=seed, options=options)
        optimizer.attach(objective)
        return optimizer

    return make


def step(optimizer, objective):
    proposal = optimizer.ask()
    optimizer.tell(proposal.x, objective.evaluate(proposal.x))
    return proposal.x


def played(optimizer, objective, proposals):
    return torch.cat([step(optimizer, objective) for _ in range(proposals)])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ppo", "sac"])
def test_it_learns_a_bandit_within_the_budget(method):
    losses = search(Bowl(), optimizer_class(method).on(Bowl(), seed=1), budget=300).dataset()["loss"].values
    random = Bowl().evaluate(Bowl.space.uniform(2000, seed=0)).loss.mean()
    assert losses[-60:].mean() < 0.6 * random


@pytest.mark.slow
def test_it_learns_to_use_what_it_sees():
    sighted, blind = (
        search(objective, PPO.on(objective, seed=0), budget=400).dataset()["loss"].values[-100:].mean()
        for objective in (Coin(), Coin(blind=True))
    )
    assert sighted < 0.5 * blind


def test_every_look_shows_what_the_executed_controls_have_led_to(small):
    objective = Coin()
    optimizer = small(objective)
    objective.looks.clear()
    x = step(optimizer, objective)
    assert [decision for decision, _ in objective.looks] == [0, 1, 2, 3]
    for decision, shown in objective.looks:
        assert torch.equal(shown[:, :decision], x[:, :decision])


def test_executed_controls_stay_inside_the_box_and_fill_it(small):
    objective = Bowl()
    x = played(small(objective), objective, 20)
    assert bool((x >= objective.space.lower).all())
    assert bool((x <= objective.space.upper).all())
    assert x.abs().max() > 1.5


def test_no_rollout_repeats_the_draws_of_another(small):
    objective = Bowl()
    optimizer = small(objective)
    step(optimizer, objective)
    rollouts = torch.stack([step(optimizer, objective) for _ in range(6)])
    assert rollouts.std(dim=0).min() > 0.2


@pytest.mark.parametrize("objective", [Bowl(), Coin()], ids=["bandit", "staged"])
def test_stopping_after_every_proposal_changes_no_bit(small, objective):
    whole = played(small(objective), objective, 8)
    optimizer, parts = small(objective), []
    for _ in range(8):
        optimizer = restored(optimizer, objective)
        parts.append(step(optimizer, objective))
    assert torch.equal(torch.cat(parts), whole)


def test_before_it_is_attached_there_is_nothing_to_play_in():
    with pytest.raises(ValueError, match=r"call attach\(objective\) before the first ask"):
        SAC.on(Bowl()).ask()


def test_seeds_do_not_disturb_each_other_nor_the_process(small):
    objective = Coin()
    alone = [played(small(objective, seed), objective, 6) for seed in (0, 1)]
    assert not torch.equal(*alone)
    torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()
    pair = [small(objective, seed) for seed in (0, 1)]
    turns = [[step(optimizer, objective) for optimizer in pair] for _ in range(6)]
    for one, together in zip(alone, zip(*turns, strict=True), strict=True):
        assert torch.equal(torch.cat(together), one)
    assert torch.equal(torch.get_rng_state(), torch_before)
    assert (np.random.get_state()[1] == numpy_before).all()


def test_seeds_in_threads_give_the_bits_of_seeds_alone(small):
    objective = Coin()
    alone = [played(small(objective, seed), objective, 6) for seed in range(3)]
    with ThreadPoolExecutor(3) as threads:
        together = list(threads.map(lambda seed: played(small(objective, seed), objective, 6), range(3)))
    for one, other in zip(alone, together, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize(("method", "budget"), [("ppo", 30), ("sac", 30), ("ppo", 7), ("sac", 7)])
def test_a_budget_within_a_rollout_is_met_to_the_episode(method, budget):
    class Counted(Bowl):
        episodes = 0

        def evaluate(self, x, *, grad=True):
            self.episodes += len(x)
            return super().evaluate(x, grad=grad)

    objective = Counted()
    run = search(objective, optimizer_class(method).on(objective, seed=0), budget=budget)
    assert objective.episodes == run.count == budget


def test_only_sacs_warm_up_is_called_random(small):
    objective = Bowl()
    optimizer = small(objective)
    first = optimizer.ask()
    assert first.kind is (Kind.RANDOM if optimizer.name == "sac" else Kind.POLICY)
    optimizer.tell(first.x, objective.evaluate(first.x))
    assert optimizer.ask().kind is Kind.POLICY


@pytest.mark.slow
def test_failed_episodes_teach_it_to_stay_away():
    losses = search(Fragile(), PPO.on(Fragile(), seed=0), budget=400).dataset()["loss"].values
    assert np.isnan(losses[:60]).mean() > 0.3
    assert np.isnan(losses[-60:]).mean() < 0.2


def test_decisions_that_cannot_share_the_parameters_are_refused(small):
    class Odd(Coin):
        decisions = 3

    with pytest.raises(ValueError, match=r"equally many controls; got 4 parameters for 3 decisions"):
        small(Odd())


def test_minibatches_that_cannot_share_a_rollout_are_refused():
    with pytest.raises(ValueError, match="got episodes=5, minibatches=4"):
        PPO.on(Bowl(), options=PPOOptions(episodes=5)).attach(Bowl())


MISSING = """
import sys
sys.modules["stable_baselines3"] = None
from gradscape.optim.registry import optimizer_class
try:
    optimizer_class("sac")
except ValueError as error:
    print(error)
"""


def test_without_the_extra_it_says_what_to_install():
    done = subprocess.run([sys.executable, "-c", MISSING], capture_output=True, text=True, check=True)
    assert "sac needs the extra rl: pip install '.[rl]'" in done.stdout
