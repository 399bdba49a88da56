"""Every option of every method: a value is refused by the names of method and option, or a search works with it."""

import dataclasses
import inspect
import math
from collections.abc import Sequence
from typing import Any

import cma
import numpy as np
import pytest
import scipy.optimize
import torch

from gradscape import ParameterSpace, from_torch
from gradscape.landscapes.objective import Status
from gradscape.landscapes.options import read_options
from gradscape.optim.options import OURS, PAPER, defaults
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


@pytest.mark.parametrize("method", methods())
def test_every_default_says_whose_choice_it_is(method: str) -> None:
    kind = optimizer_class(method)
    found = defaults(kind.Options)
    assert [one.option for one in found] == [one.name for one in options(method)]
    assert all(one.source in (OURS, PAPER) or "(" in one.source for one in found)


def test_a_default_that_is_called_a_librarys_is_that_of_the_library() -> None:
    """But for the first step size of CMA-ES, which its author advises and the library has no default of."""
    hop = inspect.signature(scipy.optimize.basinhopping).parameters
    (beta1, beta2), theirs = inspect.signature(torch.optim.Adam).parameters["betas"].default, {}
    theirs["basin-hopping"] = {"step": hop["stepsize"].default, "temperature": hop["T"].default}
    theirs["adam"] = {"beta1": beta1, "beta2": beta2}
    for name, named in (("ppo", {"epochs": "n_epochs"}), ("sac", {"batch": "batch_size"})):
        if name in methods():
            known = inspect.signature(getattr(pytest.importorskip("stable_baselines3"), name.upper())).parameters
            theirs[name] = {ours: known[one].default for ours, one in (named | {"discount": "gamma"}).items()}
    for method, wanted in theirs.items():
        said = {one.option: one.value for one in defaults(optimizer_class(method).Options) if "library" in one.source}
        assert said == {name: str(value) for name, value in wanted.items()}, method
    assert "population" in {one.option for one in defaults(optimizer_class("cma-es").Options) if "cma" in one.source}
    assert cma.CMAOptions().eval("popsize", loc={"N": 10}) == pytest.approx(4 + 3 * math.log(10))


def test_what_the_paper_states_of_bo_leap_is_its_default() -> None:
    """Its sections 2, 4 and 5 with the supplement's C."""
    said = {one.option: one.value for one in defaults(optimizer_class("bo-leap").Options) if one.source == PAPER}
    search = {"population": "10", "sigma": "1.0", "local_budget": "100", "patience": "3"}
    assert said == search | {"coefficient": "1.0", "kernel": "rbf"}
