"""An environment's loss over the weights of a policy that decides by what it sees: the landscape that learning walks.

The policy is a multilayer perceptron, deterministic: tanh layers, and tanh at its end, which is squashed to the box of
each decision's parameters. What it sees is what the environment shows just before each decision.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .capacity import Need, require
from .objective import Evaluation, Objective, ObjectiveWrapper, Status, check_points
from .space import ParameterSpace

FORM = re.compile(r"mlp:([1-9]\d{0,8}(?:x[1-9]\d{0,8})*)")
REACH = 3.0  # times as far as torch draws weights at first: where learning may take them
COPIES = 8  # of the weights of all rows, at most


class PolicyObjective(ObjectiveWrapper):
    """The loss of an episode in which a policy decides, over the policy's weights.

    Weights and biases of a layer with n inputs lie within 3 / sqrt(n), three times as far as torch draws them at first;
    at the centre they are zero, and every decision is the middle of its box. It has no gradients: what a policy sees is
    not differentiated, and without that they would be wrong.
    """

    def __init__(self, env: Objective, policy: str) -> None:
        """Give an environment with decisions a policy: mlp:32x32 has two hidden layers.

        Raises ValueError for another form, and where the environment decides but once or its decisions are not alike;
        TooLargeError for more weights than there is memory for.
        """
        hidden = _hidden_layers(policy)
        if env.decisions == 1 or env.space.dim % env.decisions:
            raise ValueError(
                f"{env.name} decides {'once' if env.decisions == 1 else 'unequally'} in an episode, so that there is "
                "nothing to see for a policy; slice its own parameters, without --policy"
            )
        super().__init__(env)
        self._env, self.policy = env, policy
        self.name, self.beyond_box = f"{env.name} with policy {policy}", False
        self.whole_batches = True  # of every decision most of the time is no row's
        features = env.observe(env.space.center[None], 0).shape[1]
        self._sizes = list(pairwise([features, *hidden, env.space.dim // env.decisions]))
        dim = sum((n + 1) * m for n, m in self._sizes)
        require("policy", dim, lambda weights: Need(8.0 * COPIES * weights * self.preferred_batch))
        bounds = torch.cat([torch.full(((n + 1) * m,), REACH / math.sqrt(n)).double() for n, m in self._sizes])
        self.space = ParameterSpace(tuple(self._names()), -bounds, bounds)

    def identity(self) -> dict[str, Any]:
        """Return what decides the numbers: all that does of the environment, and the policy."""
        return {**self._env.identity(), "objective": self.name, "policy": self.policy}

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return the losses of episodes that are played with these weights, a row for each policy.

        A policy that sees what is not finite decides on the middles of the boxes then, and its row has failed. Raises
        ValueError where gradients are asked for.
        """
        if grad:
            raise ValueError(
                f"{self.name} has no gradients, as what a policy sees is not differentiated; sample losses only, with "
                "--no-gradients, along random:SEED or parameters"
            )
        decided, blind = self._play(x)
        found: Evaluation = self._env.evaluate(decided, grad=False)
        lost = blind & found.has_loss
        status = found.status.masked_fill(lost, Status.NONFINITE)
        return Evaluation(found.loss.masked_fill(lost, torch.nan), None, status, found.error)

    def replicas(self) -> Mapping[str, Objective]:
        """Return the same policy in those replicas of the environment that decide as often."""
        alike = {name: one for name, one in self._env.replicas().items() if one.decisions == self._env.decisions}
        return {name: PolicyObjective(one, self.policy) for name, one in alike.items()}

    def decide(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch decided"]:
        """Return the environment's parameters that policies with these weights decide on, one after another."""
        return self._play(x)[0]

    def _play(self, x: Float[Tensor, "batch dim"]) -> tuple[Float[Tensor, "batch decided"], Bool[Tensor, " batch"]]:
        """Return what policies decide on, and which of them saw what is not finite."""
        x = check_points(x, self.space, self.name)
        space, count = self._env.space, self._env.space.dim // self._env.decisions
        decided: Tensor = space.center.repeat(len(x), 1)
        blind = torch.zeros(len(x), dtype=torch.bool)
        for decision in range(self._env.decisions if len(x) else 0):
            own = slice(decision * count, (decision + 1) * count)
            seen = self._env.observe(decided, decision)
            blind |= ~seen.isfinite().all(dim=1)
            share = (1 + self._act(x, seen)) / 2
            share[blind] = 0.5
            decided[:, own] = space.lower[own] + share * (space.upper - space.lower)[own]
        return decided, blind

    def _act(self, x: Float[Tensor, "batch dim"], seen: Float[Tensor, "batch feature"]) -> Float[Tensor, "batch act"]:
        """Return what each row's own perceptron answers to what it sees."""
        first = 0
        for n, m in self._sizes:
            weight = x[:, first : first + n * m].view(-1, m, n)
            bias = x[:, first + n * m : first + (n + 1) * m]
            seen = torch.tanh(torch.einsum("bmn,bn->bm", weight, seen) + bias)
            first += (n + 1) * m
        return seen

    def _names(self) -> Iterator[str]:
        for layer, (n, m) in enumerate(self._sizes, start=1):
            yield from (f"layer {layer} weight {row},{column}" for row in range(m) for column in range(n))
            yield from (f"layer {layer} bias {row}" for row in range(m))


def _hidden_layers(policy: str) -> list[int]:
    """Return the sizes of the hidden layers. Raises ValueError where a policy is not so written."""
    found = FORM.fullmatch(policy)
    if found is None:
        raise ValueError(f"--policy takes mlp and the sizes of its hidden layers, as mlp:32x32; got {policy!r}")
    return [int(size) for size in found[1].split("x")]
