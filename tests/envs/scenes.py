"""Every registered scene, cheap and in float64 if it has that, for tests that take many episodes.

A new one is found by its family.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from gradscape.envs.base import Environment, Fidelity
from gradscape.envs.functions import Function
from gradscape.envs.mjx.scene import MjxScene
from gradscape.envs.mpm.fluid import Fluid
from gradscape.envs.mpm.plasticine import Plasticine
from gradscape.envs.mpm.scene import MpmScene
from gradscape.envs.newton.scene import NewtonScene
from gradscape.envs.registry import entries, environment_class, make
from gradscape.envs.sheets.sheets import SheetScene

COARSE = {  # families whose cheapest fidelity takes too long
    Fluid: {"dt": Fluid.control_step / 2, "resolution": 6, "sampling": 1.5},
    Plasticine: {"dt": Plasticine.control_step / 5, "resolution": 16, "particles": 100},
    SheetScene: {"dt": 1 / 500, "resolution": 4},
    MjxScene: {"dt": 1 / 50},
    NewtonScene: {"dt": 1 / 400, "precision": "float32"},
}


def of_family(*families: type[Environment]) -> list[str]:
    """Return the names of the registered scenes of some families."""
    return [name for name in entries() if issubclass(environment_class(name), families)]


def cheap(kind: type[Environment]) -> Fidelity:
    """Return a fidelity in float64, or what else a scene computes in, that takes little time."""
    for family, settings in COARSE.items():
        if issubclass(kind, family):
            return Fidelity("tiny", **{"precision": "float64", **settings})
    return replace(next(iter(kind.fidelities.values())), precision="float64")


REGISTERED = tuple(entries())  # before other tests register classes from files
ONE_OF_EACH = {"bounce", "branin", "cartpole", "fluid", "mjx-drop", "newton-flight", "pinball-2", "rope", "flip"}
SIMULATED = [name for name in REGISTERED if not issubclass(environment_class(name), Function)]
SETTINGS = {name: {"fidelity": cheap(environment_class(name))} for name in SIMULATED}
SOFT = of_family(Plasticine)
# Of these two fifths of an episode, in which every tool works: `test_plasticine` holds whole ones against slopes.
SHORT = {name: {"horizon": 0.4} for name in SOFT}
TAICHI = [*of_family(Fluid, SheetScene), "rolling-pin"]  # of plasticine one scene, with the tool that rolls
# Where vertices strike a surface their losses jump, by little but often: differences need a step between the jumps.
SMALL_STEPS = dict.fromkeys(of_family(SheetScene), 1e-8)
SMALL_STEPS["pinball-16"] = 1e-8  # many impacts amplify: at a slope of 5e5 m/rad, differences over 1e-6 rad err by 2 %


def one_of_each(cases: Iterable[Any]) -> list[Any]:
    """Return cases of tests, scenes or tuples that begin with one; those of a family's other scenes are slow."""
    names = [(case, case if isinstance(case, str) else case[0]) for case in cases]
    marked = [(case, [] if name in ONE_OF_EACH else [pytest.mark.slow]) for case, name in names]
    return [pytest.param(*([case] if isinstance(case, str) else case), marks=marks) for case, marks in marked]


def made(name: str) -> Environment:
    """Make a scene as the contract's tests take it."""
    return make(name, device="cpu", **SETTINGS.get(name, {}), **SHORT.get(name, {}))


@cache
def made_once(name: str) -> Environment:
    """Return one such scene for all tests of a process: JAX takes up to 20 s to trace one, and a minute to compile it.

    The contract's fixture is another one.
    """
    return made(name)


def assert_returns_stay(env: Environment) -> None:
    """Hold what a scene returns of one point while it simulates another, in the memory of the same solver."""
    first, second = env.space.uniform(2, seed=5)
    returned = _returns(env, first)
    before = [one.clone() for one in returned]
    _returns(env, second)
    for one, kept in zip(returned, before, strict=True):
        assert torch.equal(one.nan_to_num(), kept.nan_to_num())


def _returns(env: Environment, x: Tensor) -> list[Tensor]:
    """Return every tensor that a scene gives of one point."""
    found = env.evaluate(x[None])
    assert found.grad is not None
    tensors = [found.loss, found.grad, found.status, env(x[None]), *env.events(x[None]).values()]
    if getattr(env.options, "horizon", 1.0) == 1.0:
        tensors.append(env.observe(x[None], env.decisions - 1))
    if (energy := env.energy(x[None])) is not None:
        tensors.append(energy)
    if isinstance(env, MpmScene | SheetScene):
        tensors.append(env.end(x))
    if not isinstance(env, Function):
        episode = env.episode(x)
        tensors += [episode.time, *episode.points.values(), *(part.at for part in episode.parts)]
    return tensors
