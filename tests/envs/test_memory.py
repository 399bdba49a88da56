"""An environment that nobody holds gives its memory back at once: no garbage has to be collected for that."""

import gc
import pickle
import weakref
from contextlib import contextmanager

import pytest
import torch

import gradscape as gs
from gradscape.envs.base import Environment, OwnMethod
from gradscape.envs.engines.mpm.solver import Solver
from gradscape.envs.mpm.scene import MpmScene
from gradscape.landscapes.objective import Evaluation, SimulatorError

from .scenes import SIMULATED, made, of_family, one_of_each

SPACE = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})
SOFT_OR_FLUID = ("fluid", "rope", "triple-move")


@contextmanager
def no_collection():
    """Let nothing collect garbage within a with block."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def solver_of(env):
    with env._solvers.lend() as stage:
        return weakref.ref(getattr(stage, "solver", stage))


def use(env):
    """Evaluate a batch twice, a smaller one, and what else a check asks of an environment."""
    x = env.space.uniform(2, seed=0)
    for rows in (x, x, x[:1]):
        env.evaluate(rows)
    point = x.clone().requires_grad_()
    env(point).sum().backward()
    env.energy(x)
    env.events(x)


@pytest.mark.parametrize("name", one_of_each(SIMULATED))
def test_a_scene_and_its_solver_are_freed_with_their_last_reference(name):
    with no_collection():
        env = made(name)
        use(env)
        held = [weakref.ref(env)]
        if env._solvers is not None:
            held.append(solver_of(env))
        del env
        assert [one() for one in held] == [None] * len(held)


@pytest.mark.parametrize("name", one_of_each(of_family(MpmScene)))
def test_so_is_a_solver_that_adds_up_by_columns_as_on_a_gpu(name, monkeypatch):
    make = Solver.__init__
    monkeypatch.setattr(Solver, "__init__", lambda self, *given, **how: make(self, *given, **how | {"columns": True}))
    with no_collection():
        env = made(name)
        use(env)
        solver = solver_of(env)
        assert solver().columns
        tape = weakref.ref(solver().tapes[0])
        del env
        assert solver() is None
        assert tape() is None


class Broken(Environment):
    space = SPACE

    def _evaluate(self, x, *, grad):
        raise RuntimeError("it never works")


class Half(Environment):
    space = SPACE

    def _evaluate(self, x, *, grad):
        if bool((x[:, 0] > 0).any()):
            raise RuntimeError("too far")
        return Evaluation.from_results(x.sum(1), torch.ones_like(x))


@pytest.mark.parametrize("kind", [Broken, Half])
def test_so_is_one_whose_simulation_has_raised(kind):
    with no_collection():
        env = kind()
        try:
            found = env.evaluate(SPACE.uniform(8, seed=0))
        except SimulatorError:
            assert kind is Broken
        else:
            assert "too far" in found.error
        held = weakref.ref(env)
        del env
        assert held() is None


@pytest.mark.parametrize("name", SOFT_OR_FLUID)
def test_a_scene_that_is_kept_can_give_back_its_solvers_memory_and_then_returns_the_same(name):
    env = made(name)
    x = env.space.uniform(2, seed=0)
    before = env.evaluate(x)
    with no_collection():
        solver = solver_of(env)
        env.release()
        assert solver() is None
    after = env.evaluate(x)
    assert torch.equal(after.loss, before.loss)
    assert torch.equal(after.grad, before.grad)


class Owner:
    def __init__(self):
        self.method = OwnMethod(self.double)

    def double(self, value):
        return 2 * value


def test_a_method_of_ones_own_keeps_nobody_alive_and_goes_to_other_processes():
    with no_collection():
        owner = Owner()
        held = weakref.ref(owner)
        sent = pickle.loads(pickle.dumps(owner))
        assert owner.method(3) == sent.method(3) == 6
        del owner
        assert held() is None
