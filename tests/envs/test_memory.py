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
from gradscape.envs.engines.sheets.springs import Solver as Springs
from gradscape.envs.mpm.scene import MpmScene
from gradscape.landscapes.objective import Evaluation, SimulatorError, Status
from gradscape.landscapes.sampling.memory import MemoryBound

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
    made(name)  # imports its engine: what Newton raises meanwhile holds the first scene
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


def test_a_solver_gets_the_memory_of_idle_ones(monkeypatch):
    held, room = gs.make("flip", fidelity="draft", horizon=0.1), list[int]()
    held.evaluate(x := held.space.uniform(1, seed=0))
    idle, init = solver_of(held), Springs.__init__

    def fitting(self, *args, **settings):
        room.append(idle() is None)
        if not room[-1]:
            raise RuntimeError("Failed to allocate 1 bytes on device 'cuda:0'")
        init(self, *args, **settings)

    monkeypatch.setattr(Springs, "__init__", fitting)
    other = gs.make("flip", fidelity="draft", horizon=0.1)
    assert other.evaluate(x).loss == held.evaluate(x).loss
    assert room[:2] == [False, True]


def test_a_single_point_gets_all_memory_before_it_fails():
    held = gs.make("flip", fidelity="draft", horizon=0.1)
    held.evaluate(held.space.uniform(1, seed=0))
    idle = solver_of(held)

    def greedy(x):
        if idle() is not None:
            raise RuntimeError("CUDA out of memory")
        return x.sum(dim=1)

    bound = MemoryBound(gs.from_torch(greedy, SPACE))
    assert bound.evaluate(SPACE.center[None]).status == Status.OK
    assert idle() is None


def test_a_remedy_shrinks_and_releases_all_that_it_evaluates():
    env = gs.average(gs.make("flip", fidelity="draft", horizon=0.1))
    within = [env.inner, *env.remedy.others()]
    env.evaluate(env.space.uniform(2, seed=0))
    solvers = [solver_of(one) for one in within]
    env.release()
    assert [one() for one in solvers] == [None] * len(within)
    env.shrink(2)
    assert {one._capacity for one in within} == {2}
    smoothed = gs.smooth(env, 0.1, samples=6)
    smoothed.shrink(1)
    assert {one._capacity for one in within} == {6}
