"""An environment over the weights of a policy that decides by its observations: the landscape of policy learning.

The policy is a deterministic multilayer perceptron: tanh layers, with a tanh at the end that is mapped to the box of
each decision's parameters. The environment gives an observation just before each decision.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..landscapes.capacity import Need, require
from ..landscapes.identity import POLICY
from ..landscapes.objective import Evaluation, SimulatorError, Status
from ..landscapes.space import ParameterSpace
from .base import Environment
from .records import hidden_layers
from .remedies import RemediedEnvironment, Remedy

REACH = 3.0  # times as far as torch draws weights at first: where learning may take them
COPIES = 8  # of the weights of all rows, at most


@dataclass(frozen=True)
class Episodes:
    """Collect what policies `decided`, what they had `seen` before each decision, and which are `blind` (saw a NaN)."""

    decided: Float[Tensor, "batch decided"]
    seen: Sequence[Float[Tensor, "batch feature"]]
    blind: Bool[Tensor, " batch"]


@dataclass(frozen=True)
class Policy(Remedy):
    """Decide by a perceptron with these `layers`, inputs and outputs of each; as text it is `form`, mlp:32x32."""

    form: str
    layers: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, env: Environment, form: str) -> Policy:
        """Return the policy of an environment with decisions from its text: mlp:32x32 has two hidden layers.

        Raises ValueError for another form, and where the environment has a single decision or unequal decisions. Raises
        TooLargeError for more weights than fit in memory.
        """
        hidden = hidden_layers(form)
        if env.decisions == 1 or env.space.dim % env.decisions:
            raise ValueError(
                f"{env.name} decides {'once' if env.decisions == 1 else 'unequally'} in an episode, so a policy has "
                "nothing to observe; leave out --policy"
            )
        features = env.observe(env.space.center[None], 0).shape[1]
        found = cls(form, tuple(pairwise([features, *hidden, env.space.dim // env.decisions])))
        weights = sum((n + 1) * m for n, m in found.layers)
        require("policy", weights, lambda count: Need(8.0 * COPIES * count * env.preferred_batch))
        return found

    @property
    def text(self) -> str:
        """How the command line spells it."""
        return self.form

    def space_of(self, env: Environment) -> ParameterSpace:
        """Return the weights and biases, layer by layer.

        Those of a layer with n inputs lie within 3 / sqrt(n), three times torch's initial bound. At the centre they are
        zero, and every decision is the middle of its box.
        """
        shapes, reach = dict[str, tuple[int, ...]](), dict[str, float]()
        for layer, (n, m) in enumerate(self.layers, start=1):
            shapes |= {f"layer {layer} weight": (m, n), f"layer {layer} bias": (m,)}
            reach |= dict.fromkeys(list(shapes)[-2:], REACH / math.sqrt(n))
        return ParameterSpace.of_weights(shapes, reach)

    def to_inner(self, env: Environment, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch decided"]:
        """Return the parameters of the environment that policies with these weights decide on, one after another."""
        return self.play(env, x.reshape(-1, x.shape[-1])).decided.reshape(*x.shape[:-1], -1)

    def evaluate(self, env: Environment, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Return the losses of episodes played with these weights, and their gradients if requested.

        After an observation that is not finite, a policy decides on the middles of the boxes, and its row has failed.
        Raises SimulatorError where gradients are requested but the observation has no gradient.
        """
        if grad and not env.differentiates_observations:
            raise SimulatorError(
                f"{env.name} with policy {self.form} has no gradients, because its observations are not "
                "differentiated; sample losses only (--no-gradients), or estimate gradients from losses (--remedy "
                "smooth:1%:zeroth)"
            )
        played = self.play(env, x)
        found = env.evaluate(played.decided, grad=grad)
        lost = played.blind & found.has_loss
        status = found.status.masked_fill(lost, Status.NONFINITE)
        slope = None if found.grad is None else self._pull_back(env, x, played, found.grad.double())
        return Evaluation.from_results(found.loss.masked_fill(lost, torch.nan), slope, status, found.error)

    def play(self, env: Environment, x: Float[Tensor, "batch dim"]) -> Episodes:
        """Return the episodes played by policies with these weights."""
        decided: Tensor = env.space.center.repeat(len(x), 1)
        blind, shown = torch.zeros(len(x), dtype=torch.bool), list[Tensor]()
        for decision in range(env.decisions if len(x) else 0):
            seen = env.observe(decided, decision)
            blind |= ~seen.isfinite().all(dim=1)
            shown.append(torch.where(blind[:, None], 0.0, seen))
            lower, upper = _box(env, decision)
            share = torch.where(blind[:, None], 0.5, (1 + self._act(x, shown[-1])) / 2)
            decided[:, _own(env, decision)] = lower + share * (upper - lower)
        return Episodes(decided, shown, blind)

    def _pull_back(
        self, env: Environment, x: Float[Tensor, "batch dim"], played: Episodes, adjoint: Float[Tensor, "batch decided"]
    ) -> Float[Tensor, "batch dim"]:
        """Return gradients by the weights, from those by all decisions as if no decision depended on an earlier one.

        This runs from the last decision to the first: a decision changes later ones through later observations.
        """
        slope, adjoint = torch.zeros_like(x), adjoint.clone()
        for decision in reversed(range(env.decisions)):
            lower, upper = _box(env, decision)
            with torch.enable_grad():
                weights, seen = x.detach().clone().requires_grad_(), played.seen[decision].clone().requires_grad_()
                share = self._act(weights, seen) / 2
                pulled = (adjoint[:, _own(env, decision)] * (upper - lower)).detach()
                by_weights, by_seen = torch.autograd.grad(share, (weights, seen), pulled)
            slope += by_weights
            if decision:
                adjoint += env.pull_back_observation(played.decided, decision, by_seen)
        return slope

    def _act(self, x: Float[Tensor, "batch dim"], seen: Float[Tensor, "batch feature"]) -> Float[Tensor, "batch act"]:
        """Return the decision of each row's own perceptron for its observation."""
        first = 0
        for n, m in self.layers:
            weight = x[:, first : first + n * m].view(-1, m, n)
            bias = x[:, first + n * m : first + (n + 1) * m]
            seen = torch.tanh(torch.einsum("bmn,bn->bm", weight, seen) + bias)
            first += (n + 1) * m
        return seen


class PolicyEnvironment(RemediedEnvironment):
    """The loss of an episode in which a policy decides, over the policy's weights.

    Gradients are those of the whole loop of decisions and observations. They exist where the environment differentiates
    its observations.
    """

    remedy: Policy

    def __init__(self, inner: Environment, policy: Policy, /) -> None:
        super().__init__(inner, policy)
        self.name, self.beyond_box = f"{inner.name} with policy {policy.form}", True
        self.examples, self.decisions = {}, 1  # type: ignore[misc] # of this one, as `FunctionEnvironment` has them
        self.whole_batches = True  # of every decision most of the time is no row's

    @property
    def has_gradient(self) -> bool:  # type: ignore[override] # read only
        """Whether both the observation and the loss have gradients."""
        return self.inner.differentiates_observations and self.inner.has_gradient

    @property
    def horizon(self) -> float | None:
        """None: decisions cover whole episodes."""
        return None

    def with_horizon(self, horizon: float) -> Environment:
        """Raise ValueError: decisions cover whole episodes."""
        raise ValueError(f"{self.name} decides whole episodes, so their length is fixed")

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers: those of the environment, and the policy."""
        return {**self.inner.identity(), "objective": self.name, POLICY: self.remedy.form}

    def about(self) -> str:  # type: ignore[override] # what there is to say is the other environment's
        """Return the description of the inner environment, and the policy."""
        return f"{self.inner.about()}\n\nThe parameters are the weights of the policy {self.remedy.form}."

    def replicas(self) -> Mapping[str, Environment]:
        """Return the same policy in those replicas of the environment that have as many decisions."""
        alike = {name: one for name, one in self.inner.replicas().items() if one.decisions == self.inner.decisions}
        return {name: PolicyEnvironment(one, self.remedy) for name, one in alike.items()}

    def plain_point(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Return the points: a policy is no remedy, and nothing is evaluated without it."""
        return x


def with_policy(env: Environment, form: str | None) -> Environment:
    """Return an environment over the weights of a policy (mlp:32x32), itself where there is none.

    Raises ValueError for an invalid policy, and for an environment without decisions. Raises TooLargeError for more
    weights than fit in memory.
    """
    return PolicyEnvironment(env, Policy.of(env, form)) if form else env


def _own(env: Environment, decision: int) -> slice:
    """Return the positions of a decision's parameters."""
    count = env.space.dim // env.decisions
    return slice(decision * count, (decision + 1) * count)


def _box(env: Environment, decision: int) -> tuple[Float[Tensor, " act"], Float[Tensor, " act"]]:
    own = _own(env, decision)
    return env.space.lower[own], env.space.upper[own]
