"""PPO and SAC of Stable-Baselines3: neural policies that observe the state of an episode and decide the next action.

A point of the box is an episode: its parameters are the controls of `decisions` equally long stretches, in order. The
objective's `observe` shows the policy the effect of the earlier ones. The whole is then evaluated once: an episode.
(Each observation restarts the simulator, which counts in a run's seconds, not in its episodes.) An objective without
`decisions` has a single action and nothing to observe: a bandit.

The reward is the paper's, minus the episode's loss after its last decision and 0 before. It is scaled to (m - loss) / s
with the mean m and the deviation s of the first episodes. Losses range from 1e-3 to 1e2, and SB3 scales advantages but
neither values nor SAC's entropy. A failed episode gets the reward of the worst so far. The paper has three layers of
64. Everything it leaves open is SB3's default, except rollouts and learning rates, which suit budgets of 1000 episodes.
"""

from __future__ import annotations

import abc
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, ClassVar

import gymnasium
import numpy as np
import stable_baselines3 as sb3
import torch
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import Tensor

from ...landscapes.objective import Objective
from ..base import LARGE, Kind, Optimizer, Points, Proposal
from ..lockstep import Asking, Observe, answer_alone
from ..memory import SearchSize
from ..options import LIBRARY, MethodOptions, number


def read_weights(model: Any) -> dict[str, Any]:
    """Return the weights of a model's networks and the state of its optimisers, as arrays."""
    return {name: _arrays(_inner(part)) for name, part in _parts(model).items()}


def put_weights(model: Any, weights: Mapping[str, Any]) -> None:
    """Restore a result of `read_weights` in a model made with the same options."""
    for name, part in _parts(model).items():
        if isinstance(part, Tensor):
            part.data.copy_(torch.from_numpy(weights[name]))
        elif isinstance(part, torch.optim.Optimizer):
            gathered = {int(number): _tensors(of) for number, of in weights[name].items()}
            part.load_state_dict({**part.state_dict(), "state": gathered})
        else:
            part.load_state_dict(_tensors(weights[name]))


def _parts(model: Any) -> dict[str, Any]:
    """Return the networks, optimisers and single tensors of a model by SB3's names of them."""
    names, tensors = model._get_torch_save_params()
    return {name: attrgetter(name)(model) for name in (*names, *tensors)}


def _inner(part: Any) -> Any:
    if isinstance(part, Tensor):
        return part
    return part.state_dict()["state"] if isinstance(part, torch.optim.Optimizer) else part.state_dict()


def _arrays(value: Any) -> Any:
    """Return tensors, and mappings of them, as arrays under names."""
    if isinstance(value, Mapping):
        return {str(name): _arrays(inner) for name, inner in value.items()}
    return value.detach().numpy()


def _tensors(arrays: Mapping[str, Any]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


SB3 = LIBRARY.format("Stable-Baselines3")
LAYERS = (64, 64, 64)  # CoRL 2022, appendix C
_GENERATORS = threading.Lock()  # held while the process's generators are an optimiser's own

ROLLOUT = 40e3  # bytes for each episode of a rollout: an environment of Stable-Baselines3 2.7
FEATURES = 64  # numbers that a policy sees, at most, in our scenes
ROW = 10e3  # bytes of a policy's networks for each transition of a batch
FAR = 1e18  # deviations: farther rewards are cut off, for their squares would be no float32
Numbers = NDArray[np.float32]


@dataclass(frozen=True)
class PPOOptions(MethodOptions):
    """`episodes` of a rollout, split into `minibatches`; `epochs` over them.

    `learning_rate` of policy and value, `discount` of later rewards. SB3's rollout of 2048 steps would take more than
    1000 episodes with one decision, and make three updates in 1000 episodes with five. With SB3's learning rate of
    3e-4, 600 episodes in a bowl (2-D) reach a mean loss of 2.4; with ours, 1.5.
    """

    method = "ppo"

    episodes: int = number(20, 2, 10_000)
    minibatches: int = number(4, 1, 5_000)
    epochs: int = number(10, 1, 10_000, SB3)
    learning_rate: float = number(1e-3, 1e-12, 1)
    discount: float = number(0.99, 0, 1, SB3)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.episodes % self.minibatches or self.episodes < 2 * self.minibatches:
            raise ValueError(
                "ppo splits a rollout's episodes equally into its minibatches, at least two episodes each; got "
                f"episodes={self.episodes}, minibatches={self.minibatches}"
            )


@dataclass(frozen=True)
class SACOptions(MethodOptions):
    """`warmup`: random episodes before the policy plays; then one gradient step on a `batch` for every transition.

    `learning_rate` of policy and critics, `discount` of later rewards. `memory`: number of stored transitions; the
    default fits 1000 episodes with 100 decisions. With SB3's learning rate of 3e-4, 600 episodes of five decisions
    reach a mean loss of 1.3; with ours, 0.3.
    """

    method = "sac"

    warmup: int = number(20, 1, 10_000)
    batch: int = number(256, 1, 100_000, SB3)
    learning_rate: float = number(1e-3, 1e-12, 1)
    discount: float = number(0.99, 0, 1, SB3)
    memory: int = number(100_000, 1, 1_000_000)


@dataclass(frozen=True, eq=False)
class Rollout:
    """Episodes as a policy played them: its observations, shape (decision, episode, feature), and its actions."""

    seen: Numbers
    actions: Numbers

    def to_points(self) -> Points:
        """Return the episodes as points of the scaled box, shape (episode, dim)."""
        by_episode = self.actions.astype(np.float64).clip(-1.0, 1.0).swapaxes(0, 1)
        return by_episode.reshape(len(by_episode), -1)


class PolicySearch(Optimizer):
    """Play episodes with a policy, and train it on their rewards.

    SB3 draws from the process's generators. Here it does so under a lock and with the optimiser's own states, which are
    stored afterwards. Searches in other threads neither see nor change them. Simulations do not need the lock.
    """

    _rollout: Rollout  # between `_ask` and `_tell`

    def _setup(self) -> None:
        self._model: Any = None
        self._scale: tuple[float, float] | None = None  # mean and deviation of the first episodes' losses
        self._generators = _seed_generators(int(self.random.integers(1 << 32)))

    def attach(self, objective: Objective) -> None:
        """Attach the objective in which the policy plays.

        Raises ValueError where its decisions differ in their number of controls.
        """
        super().attach(objective)
        self.decisions = objective.decisions
        if self.space.dim % self.decisions:
            raise ValueError(
                f"{self.name} needs decisions with equally many controls; "
                f"got {self.space.dim} parameters for {self.decisions} decisions"
            )
        if self._model is None:
            features = answer_alone(self._observe(self.space.center[None], 0), objective).shape[1]
            with self._own_randomness():
                self._model = self._make_model(_Spaces(features, self.space.dim // self.decisions))

    @abc.abstractmethod
    def _make_model(self, spaces: gymnasium.Env[Any, Any]) -> Any:
        """Return the new model of the algorithm."""

    @abc.abstractmethod
    def _act(self, seen: Tensor) -> Tensor:
        """Draw an action for every row of observations."""

    @abc.abstractmethod
    def _learn(self, rollout: Rollout, rewards: Numbers) -> None:
        """Train on episodes that ended with these rewards, shape (episode,)."""

    def _play(self, episodes: int) -> Asking[Rollout]:
        """Play episodes in parallel."""
        if self._model is None:
            raise ValueError(f"{self.name} plays in the objective itself; call attach(objective) before the first ask")
        self._refuse_diverged(self._model.policy.parameters())
        z = torch.zeros(episodes, self.decisions, self.space.dim // self.decisions, dtype=torch.float64)
        seen, actions = [], []
        for decision in range(self.decisions):
            x = self.space.from_unit((z.flatten(start_dim=1) + 1) / 2)
            seen.append((yield from self._observe(x, decision)))
            with self._own_randomness(), torch.no_grad():
                actions.append(self._act(torch.from_numpy(seen[-1])).numpy())
            self._refuse_diverged([torch.from_numpy(actions[-1])])
            z[:, decision] = torch.from_numpy(actions[-1]).double().clamp(-1, 1)
        return Rollout(np.stack(seen), np.stack(actions))

    def _refuse_diverged(self, numbers: Iterable[Tensor]) -> None:
        if not all(bool(part.isfinite().all()) for part in numbers):
            raise ValueError(
                f"the policy of {self.name} has diverged; use a learning_rate below {self.options.learning_rate:g}"
            )

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        losses = self.penalise(loss)
        if self._scale is None:
            self._scale = _mean_and_deviation(losses)
        mean, deviation = self._scale
        with np.errstate(over="ignore"):
            rewards = np.clip((mean - losses) / deviation, -FAR, FAR)
        with self._own_randomness():
            self._model.set_logger(Logger(folder=None, output_formats=[]))  # which only SB3's own loop gives it
            self._learn(self._rollout, rewards.astype(np.float32))
        del self._rollout

    def _observe(self, x: Tensor, decision: int) -> Asking[Numbers]:
        """Return the observation before a decision, shape (episode, feature); zero where there is only one decision."""
        if self.decisions == 1:
            return np.zeros((len(x), 1), dtype=np.float32)
        seen, _ = yield Observe(x, decision)
        return np.asarray(seen.numpy(), dtype=np.float32)

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        with _GENERATORS:
            others = _exchange(self._generators)
            try:
                yield
            finally:
                self._generators = _exchange(others)

    def _state(self) -> dict[str, Any]:
        torchs, numpys = self._generators
        return {
            "scale": self._scale,
            "torch": torchs.numpy(),
            "numpy": numpys,
            "weights": None if self._model is None else read_weights(self._model),
        }

    def _restore(self, own: Mapping[str, Any]) -> None:
        self._scale = own["scale"] and tuple(own["scale"])
        self._generators = torch.from_numpy(own["torch"]), dict(own["numpy"])
        if own["weights"] is not None:
            put_weights(self._model, own["weights"])


class PPO(PolicySearch):
    """Proximal policy optimisation (Schulman et al. 2017): a stochastic policy, improved by every rollout."""

    name: ClassVar[str] = "ppo"
    Options: ClassVar[type[Any]] = PPOOptions

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of a rollout and the networks [bytes]."""
        each = ROLLOUT + size.decisions * _transition_memory(size)
        return float(options["episodes"] * each + _network_memory(size))

    def _make_model(self, spaces: gymnasium.Env[Any, Any]) -> sb3.PPO:
        o = self.options
        return sb3.PPO(
            "MlpPolicy",
            DummyVecEnv([lambda: spaces, *(lambda: copy(spaces) for _ in range(o.episodes - 1))]),
            n_steps=self.decisions,
            batch_size=o.episodes * self.decisions // o.minibatches,
            n_epochs=o.epochs,
            learning_rate=o.learning_rate,
            gamma=o.discount,
            policy_kwargs={"net_arch": list(LAYERS)},
            device="cpu",
        )

    def _ask(self) -> Asking[Proposal]:
        self._rollout = yield from self._play(self.options.episodes)
        return Proposal(torch.from_numpy(self._rollout.to_points()), Kind.POLICY)

    def _act(self, seen: Tensor) -> Tensor:
        action: Tensor = self._model.policy(seen)[0]
        return action

    def _learn(self, rollout: Rollout, rewards: Numbers) -> None:
        buffer = self._model.rollout_buffer
        buffer.reset()
        for decision, (seen, actions) in enumerate(zip(rollout.seen, rollout.actions, strict=True)):
            with torch.no_grad():
                value, log_prob, _ = self._model.policy.evaluate_actions(*map(torch.from_numpy, (seen, actions)))
            reward = rewards if decision == self.decisions - 1 else np.zeros_like(rewards)
            buffer.add(seen, actions, reward, np.full(len(rewards), decision == 0), value, log_prob)
        buffer.compute_returns_and_advantage(last_values=torch.zeros(len(rewards)), dones=np.ones(len(rewards)))
        self._model.train()


class SAC(PolicySearch):
    """Soft actor-critic (Haarnoja et al. 2018): a stochastic policy, improved after every episode from all before."""

    name: ClassVar[str] = "sac"
    Options: ClassVar[type[Any]] = SACOptions

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of the replay buffer, a batch and the networks [bytes]."""
        transitions = options["memory"] + options["warmup"] * size.decisions
        return float(transitions * _transition_memory(size) + options["batch"] * ROW + _network_memory(size))

    def _setup(self) -> None:
        super()._setup()
        self._remembered: list[tuple[Rollout, Numbers]] = []

    def _make_model(self, spaces: gymnasium.Env[Any, Any]) -> sb3.SAC:
        o = self.options
        return sb3.SAC(
            "MlpPolicy",
            DummyVecEnv([lambda: spaces]),
            buffer_size=o.memory,
            batch_size=o.batch,
            learning_rate=o.learning_rate,
            gamma=o.discount,
            policy_kwargs={"net_arch": list(LAYERS)},
            device="cpu",
        )

    def _ask(self) -> Asking[Proposal]:
        self._rollout = yield from self._play(1 if self._remembered else self.options.warmup)
        kind = Kind.POLICY if self._remembered else Kind.RANDOM
        return Proposal(torch.from_numpy(self._rollout.to_points()), kind)

    def _act(self, seen: Tensor) -> Tensor:
        if not self._remembered:
            return torch.rand(len(seen), self._model.action_space.shape[0]) * 2 - 1
        action: Tensor = self._model.actor(seen)
        return action

    def _learn(self, rollout: Rollout, rewards: Numbers) -> None:
        trains = bool(self._remembered)
        self._remembered.append((rollout, rewards))
        self._remember(rollout, rewards)
        if trains:
            self._model.train(gradient_steps=self.decisions * len(rewards), batch_size=self.options.batch)

    def _remember(self, rollout: Rollout, rewards: Numbers) -> None:
        """Put episodes into the replay buffer, transition by transition."""
        last = self.decisions - 1
        for episode, reward in enumerate(rewards):
            seen, actions = rollout.seen[:, episode], rollout.actions[:, episode]
            for t in range(self.decisions):
                what = seen[t][None], seen[min(t + 1, last)][None], actions[t][None]
                end = np.array([t == last])
                self._model.replay_buffer.add(*what, reward * end, end, [{}])

    def _state(self) -> dict[str, Any]:
        played = [rollout for rollout, _ in self._remembered]
        return super()._state() | {
            "seen": np.concatenate([one.seen for one in played], axis=1) if played else None,
            "actions": np.concatenate([one.actions for one in played], axis=1) if played else None,
            "rewards": np.concatenate([rewards for _, rewards in self._remembered]) if played else None,
        }

    def _restore(self, own: Mapping[str, Any]) -> None:
        super()._restore(own)
        if own["seen"] is not None:
            self._remembered = [(Rollout(own["seen"], own["actions"]), own["rewards"])]
            self._remember(*self._remembered[0])


def _transition_memory(size: SearchSize) -> float:
    """Return the bytes of the observations before and after an action, and of the action, in float32."""
    return 4 * (2 * FEATURES + size.dim // size.decisions + 10)


def _network_memory(size: SearchSize) -> float:
    """Return the bytes of a policy, its critics and their optimisers' moments."""
    return 4 * 64 * 20 * (FEATURES + size.dim // size.decisions)


class _Spaces(gymnasium.Env[Any, Any]):
    """Describe observations and actions; the optimiser itself plays the episodes."""

    def __init__(self, features: int, controls: int) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (features,))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (controls,))


def _mean_and_deviation(losses: Points) -> tuple[float, float]:
    """Return the mean of losses and their deviation, 1 where they are all the same."""
    large = 2.0**600 if float(np.abs(losses).max()) > LARGE else 1.0  # their squares would be no numbers
    return float((losses / large).mean() * large), float((losses / large).std() * large) or 1.0


def _seed_generators(seed: int) -> tuple[Tensor, dict[str, Any]]:
    """Return the states of torch's and of numpy's global generator after seeding them."""
    numbers: dict[str, Any] = np.random.RandomState(seed).get_state(legacy=False)
    return torch.Generator().manual_seed(seed).get_state(), numbers


def _exchange(states: tuple[Tensor, dict[str, Any]]) -> tuple[Tensor, dict[str, Any]]:
    """Set the states of the global generators, and return the former ones."""
    before = torch.get_rng_state(), np.random.get_state(legacy=False)
    torch.set_rng_state(states[0])
    np.random.set_state(states[1])
    return before
