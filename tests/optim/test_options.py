"""Every option of every method: a value is refused by the names of method and option, or a search works with it."""

import dataclasses
import math
from collections.abc import Iterator
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


def options() -> Iterator[Any]:
    for method in methods():
        for option in dataclasses.fields(optimizer_class(method).Options):
            yield pytest.param(method, option, id=f"{method}.{option.name}")


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
@pytest.mark.parametrize(("method", "option"), [*options()])
def test_a_hostile_value_is_refused_by_name_or_works(method: str, option: Any) -> None:
    """The ends of an option's range are values, too, but for those that count what takes its time."""
    least, most = option.metadata.get("range", (0, 0))
    for value in (*HOSTILE, least, *([most] if option.type == "float" else [])):
        said, points = outcome(method, SHORT.get(method, {}) | {option.name: value})
        assert (len(points), said) == (8, "") or (method in said and option.name in said and "\n" not in said)
        assert np.isfinite(points).all()


@pytest.mark.parametrize(("method", "option"), [*options()])
def test_a_record_refuses_what_the_command_line_does(method: str, option: Any) -> None:
    """Records of options are made in Python, too, where values are not read from text."""
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
@pytest.mark.parametrize("losses", LOSSES)
@pytest.mark.parametrize("method", methods())
def test_a_method_searches_losses_of_any_size(method: str, losses: str) -> None:
    run = searched(from_torch(LOSSES[losses], SPACE, name=losses), method, SHORT.get(method, {}))
    table = run.dataset()
    assert run.count == 8
    assert np.isfinite(table["x"]).all()
    assert np.isfinite(table["loss"]).equals(table["status"] == Status.OK)
