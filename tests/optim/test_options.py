"""Every option of every method: a value is refused by the names of method and option, or a search works with it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

from gradscape import ParameterSpace, from_torch
from gradscape.landscapes.objective import Status
from gradscape.landscapes.options import read_options
from gradscape.optim.registry import methods, optimizer_class
from gradscape.optim.search import search

SPACE = ParameterSpace(["a", "b"], [0, -1], [1, 1])
BOWL = from_torch(lambda x: (x - 0.3).square().sum(dim=1), SPACE, name="bowl")
HOSTILE = (0, -1, 1e300, 1e-300, math.nan, math.inf, 1 << 63, 10**30, "", None, [])
SHORT = {  # what makes a method show all it does within a few episodes
    "bo": {"initial": 7},
    "bo-descents": {"initial": 7, "steps": 2},
    "bo-leap": {"initial": 5, "population": 4, "best": 2, "local_budget": 4, "steps": 2},
    "ppo": {"episodes": 4, "minibatches": 2, "epochs": 2},
    "sac": {"warmup": 4},
}


def options(method: str) -> Sequence[Any]:
    return dataclasses.fields(optimizer_class(method).Options)


def searched(objective: Any, method: str, options: dict[str, Any], budget: int = 8) -> Any:
    kind = optimizer_class(method)
    record = read_options(method, kind.Options, options)
    return search(objective, kind.on(objective, seed=0, options=record), budget=budget, gradient_cost=1.0)


def outcome(method: str, options: dict[str, Any]) -> tuple[str, Any]:
    """Return how a search was refused, or the points it went to."""
    try:
        return "", searched(BOWL, method, options).dataset()["x"].to_numpy()
    except ValueError as refusal:
        return str(refusal), np.empty(0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", methods())
def test_a_hostile_value_is_refused_by_name_or_works(method: str) -> None:
    """The ends of an option's range are values, too, but for those that count what takes its time."""
    for option in options(method):
        least, most = option.metadata.get("range", (0, 0))
        for value in (*HOSTILE, least, *([most] if option.type == "float" else [])):
            said, points = outcome(method, SHORT.get(method, {}) | {option.name: value})
            refused = method in said and option.name in said and "\n" not in said
            assert (len(points), said) == (8, "") or refused, (option.name, value)
            assert np.isfinite(points).all(), (option.name, value)


def test_a_record_refuses_what_the_command_line_does() -> None:
    """Records of options are made in Python, too, where values are not read from text."""
    for method in methods():
        for option in options(method):
            for value in ("x", math.nan, None, True, -math.inf, 1j):
                with pytest.raises(ValueError, match=f"option {option.name} takes .*; got {value}"):
                    optimizer_class(method).Options(**{option.name: value})


LOSSES = {
    "large": lambda x: x.square().sum(dim=1) * 1e300,
    "of both signs": lambda x: (x[:, 0] - 0.5) * 3e308,
    "small": lambda x: x.square().sum(dim=1) * 1e-300,
    "all the same": lambda x: 0 * x[:, 0] + 1,
    "failing": lambda x: x[:, 0] * torch.nan,
    "sometimes large": lambda x: x.square().sum(dim=1) * 10 ** (300 * (x[:, 0] > 0.2)),
    "failing but for a few": lambda x: torch.where(x[:, 0] > 0.8, x[:, 1], torch.nan),
    "steep": lambda x: torch.sin(x.sum(dim=1) * 1e300),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", methods())
def test_a_method_searches_losses_of_any_size(method: str) -> None:
    for name, losses in LOSSES.items():
        run = searched(from_torch(losses, SPACE, name=name), method, SHORT.get(method, {}))
        table = run.dataset()
        assert run.count == 8, name
        assert np.isfinite(table["x"]).all(), name
        assert np.isfinite(table["loss"]).equals(table["status"] == Status.OK), name
