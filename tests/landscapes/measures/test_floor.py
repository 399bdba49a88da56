"""The numerical floor: a known change of the numerics is found in losses and gradients, and none where none is."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

import gradscape as gs
from gradscape.landscapes.measures.floor import Floor, evaluate_replicas, floor_between
from gradscape.landscapes.objective import Evaluation, Objective, evaluate

SPACE = gs.ParameterSpace({"x": (0.0, 2 * np.pi), "y": (-1.0, 1.0)})
SIZE, PITCH = 0.02, 40.0


def wave(x: Tensor, size: float = 0.0, phase: float = 0.0) -> Tensor:
    """A sine whose grid adds a ripple."""
    return x[:, 0].sin() + size * torch.sin(PITCH * x[:, 0] + phase)


def measure_floor(env: Objective, x: Tensor, *, grad: bool = True, range: float | None = None) -> Floor:
    own, sides = evaluate(env, x, grad=grad), env.space.upper - env.space.lower
    return floor_between(own, evaluate_replicas(env, x, env.replicas(), grad=grad), sides=sides, range=range)


def test_the_floor_of_a_ripple_is_the_ripple() -> None:
    """Two members differ by a sin: a standard deviation of a sin / sqrt 2, a root mean square of a / 2, and a range of
    2. The gradients are cos x and cos x + a k cos(k x + phase), both along x: the cosine is 1 or -1."""
    env = gs.from_torch(wave, SPACE, replicas={"other grid": partial(wave, size=SIZE, phase=1.0)})
    x = SPACE.sobol(256, seed=0)
    found = measure_floor(env, x)
    assert (found.names, found.points, found.failed) == (("other grid",), 256, 0)
    assert found.deviation == pytest.approx(SIZE / 2, rel=0.06)
    assert found.range == pytest.approx(2, abs=0.01)
    assert found.share.value == found.deviation / found.range
    assert found.share.low < SIZE / 4 < found.share.high < 1.2 * found.share.low
    assert found.sentence() == "numerical floor 0.5 % of the range; gradients of replicas: cosine 1.000"
    losses_only = measure_floor(env, x, grad=False, range=4.0)
    assert losses_only.cosine is None
    assert losses_only.share.value == pytest.approx(found.deviation / 4)


def test_gradients_of_replicas_are_compared_in_the_box() -> None:
    """Turned by 90 degrees in the box, which is pi times as wide along x as along y."""

    def slope(x: Tensor, turn: float = 0.0) -> Tensor:
        at = (x - SPACE.lower) / (SPACE.upper - SPACE.lower)
        return np.cos(turn) * at[:, 0] + np.sin(turn) * at[:, 1]

    env = gs.from_torch(slope, SPACE, replicas={"turned": partial(slope, turn=np.pi / 3)})
    found = measure_floor(env, SPACE.sobol(8, seed=0))
    assert [found.cosine.value, found.cosine.low, found.cosine.high] == pytest.approx([0.5] * 3)


def test_a_replica_that_is_the_same_has_no_floor() -> None:
    x = SPACE.sobol(8, seed=0)
    found = measure_floor(gs.from_torch(wave, SPACE, replicas={"same": wave}), x)
    assert (found.deviation, found.share.value, found.share.low, found.share.high) == (0.0, 0.0, 0.0, 0.0)
    assert found.cosine.value == pytest.approx(1)


class Fails(Objective):
    """Its replica has no loss above x = 4."""

    space = SPACE

    def __init__(self, most: float = np.inf) -> None:
        self.most = most

    def replicas(self) -> dict[str, Objective]:
        return {"other": Fails(4.0)}

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        loss = torch.where(x[:, 0] > self.most, torch.inf, x[:, 0])
        return Evaluation.from_results(loss, torch.zeros_like(x) if grad else None)


def test_points_at_which_a_replica_fails_are_left_out_and_counted() -> None:
    x = torch.linspace(0, 6, 7).double()[:, None].repeat(1, 2) * torch.tensor([1.0, 0.0])
    found = measure_floor(Fails(), x)
    assert (found.points, found.failed, found.deviation) == (5, 2, 0.0)
    few = measure_floor(Fails(), x[3:])
    assert (few.points, few.share.value) == (2, 0.0)
    assert np.isnan([few.share.low, few.share.high]).all()  # of two points there is no interval
    none = measure_floor(Fails(), x[5:])
    assert none.sentence() == "numerical floor unknown: every point failed"


def test_an_objects_own_replicas_come_with_it_and_must_take_its_points() -> None:
    env = gs.as_environment(Fails())
    assert measure_floor(env, SPACE.sobol(8, seed=0)) is not None
    other = gs.from_torch(wave, gs.ParameterSpace({"a": (0, 1), "b": (0, 1)}))
    env.given.replicas = lambda: {"strange": other}  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="'strange' must take the same parameters, x, y; got a, b"):
        measure_floor(env, SPACE.sobol(8, seed=0))


def test_a_replica_binds_a_setting_of_its_function_and_keeps_the_others() -> None:
    """An option that the replica binds is neither overridden by the original's, nor asked of it."""
    fidelities = {"draft": {"dt": 0.1}, "fine": {"dt": 0.01}}

    def loss(x: Tensor, shift: float = 0.0, gain: float = 1.0, dt: float = 0.1) -> Tensor:
        return gain * x[:, 0] + dt * shift

    made = gs.from_torch(
        loss,
        SPACE,
        options={"shift": 0.0, "gain": 1.0},
        fidelities=fidelities,
        replicas={"half": partial(loss, shift=0.5)},
    )
    (replica,) = gs.make(made, fidelity="fine", gain=3.0).replicas().values()
    x = SPACE.sobol(4, seed=0)
    torch.testing.assert_close(replica.evaluate(x).loss, 3 * x[:, 0] + 0.005)
    with pytest.raises(ValueError, match="loss's replica 'none' must be a function; got int"):
        gs.from_torch(loss, SPACE, replicas={"none": 3})  # type: ignore[dict-item]
