"""Which kernel of Warp makes a gradient NaN, or a finite one wrong: its adjoint is not that of what it computes."""

import numpy as np
import pytest
import torch
import warp as wp

import gradscape as gs
from gradscape.envs.engines.warp_origins import wrong_kernel

SPACE = gs.ParameterSpace({"a": (0.2, 1), "b": (0.2, 1)})
X = torch.tensor([0.3, 0.7], dtype=torch.float64)


@wp.struct
class State:
    x: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)
    count: wp.array(dtype=wp.int32)


@wp.func
def doubled(x: float):
    return 2.0 * x * x


@wp.func_grad(doubled)
def adj_doubled(x: float, adj_ret: float):
    wp.adjoint[x] += 2.0 * x * adj_ret  # where 4 x is right


@wp.kernel
def _take(x: wp.array2d(dtype=float), out: wp.array(dtype=float)):
    i, j = wp.tid()
    out[j] = wp.sin(x[i, j]) + x[i, 0] * x[i, 1]


@wp.kernel
def _own_adjoint(a: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = doubled(a[i])


@wp.kernel
def _root(a: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = wp.where(a[i] > 0.5, wp.sqrt(a[i] - 0.5), a[i])  # below 0.5 the slope of what is not taken is NaN


@wp.kernel
def _in_place(a: wp.array(dtype=float)):
    i = wp.tid()
    a[i] = a[i] * a[i]


@wp.kernel
def _power(a: wp.array(dtype=float), count: int, out: wp.array(dtype=float)):
    i = wp.tid()
    power = a[i]
    for _ in range(count):  # of which Warp stores the last value of a variable only
        power = power * power
    out[i] = power


@wp.kernel
def _sum(a: wp.array(dtype=float), loss: wp.array(dtype=float), count: wp.array(dtype=wp.int32)):
    i = wp.tid()
    wp.atomic_add(loss, 0, a[i] * a[i])
    wp.atomic_add(count, 0, 1)


@wp.kernel
def _push(state: State, x: wp.array(dtype=float), step: float):
    i = wp.tid()
    state.v[i] = -wp.exp(x[i])
    state.x[i] = x[i] + step * wp.max(-wp.exp(x[i]), -100.0)
    wp.atomic_add(state.count, 0, 1)


@wp.kernel
def _vectors(a: wp.array(dtype=float), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = wp.normalize(wp.vec3(a[i], 1.0, a[0] * a[1]))


@wp.kernel
def _lengths(a: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = wp.length(wp.cross(a[i], wp.vec3(1.0, 2.0, 3.0)))


@wp.kernel
def _clamped(a: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = wp.floor(10.0 * a[i]) + wp.clamp(a[i], 0.0, 0.1)


def arrays(count, size, dtype=float):
    return [wp.zeros(size, dtype=dtype, requires_grad=True) for _ in range(count)]


def through(kernel, *given, outputs=True):
    """Return the function of a kernel between two that are sound; it may have an array of its own to write to."""

    def fn(x):
        first, second = arrays(2, 2)
        loss, count = wp.zeros(1, dtype=float, requires_grad=True), wp.zeros(1, dtype=wp.int32)
        wp.launch(_take, dim=(1, 2), inputs=[x], outputs=[first])
        wp.launch(kernel, dim=2, inputs=[first, *given], outputs=[second] if outputs else [])
        wp.launch(_sum, dim=2, inputs=[second if outputs else first], outputs=[loss, count])
        return loss

    return fn


in_place = through(_in_place, outputs=False)


def sound(x):
    """Structs, vectors, whole numbers, sums by atomics, steps and arrays that are written to: all are right."""
    first, second, third = arrays(3, 2)
    (way,) = arrays(1, 2, wp.vec3)
    loss, count = wp.zeros(1, dtype=float, requires_grad=True), wp.zeros(1, dtype=wp.int32)
    state = State()
    state.x, state.v = arrays(2, 2)
    state.count = count
    wp.launch(_take, dim=(1, 2), inputs=[x], outputs=[first])
    wp.launch(_push, dim=2, inputs=[state, first, 0.1])
    wp.launch(_vectors, dim=2, inputs=[state.x], outputs=[way])
    wp.launch(_lengths, dim=2, inputs=[way, second])
    wp.launch(_clamped, dim=2, inputs=[second], outputs=[third])
    wp.launch(_sum, dim=2, inputs=[second, loss, count])
    wp.launch(_sum, dim=2, inputs=[third, loss, count])
    return loss


def of(fn):
    return gs.from_warp(fn, SPACE, device="cpu", check_overwrites=False)


@pytest.mark.parametrize(("fn", "name"), [(through(_own_adjoint), "_own_adjoint"), (through(_power, 3), "_power")])
def test_the_kernel_with_another_adjoint_than_its_own_is_named(fn, name, capfd):
    objective = of(fn)
    objective.evaluate(X[None])
    capfd.readouterr()
    assert objective.wrong_origin(X).startswith(f"kernel {name} in line ")
    assert capfd.readouterr() == ("", "")


def test_the_kernel_and_the_argument_by_which_a_gradient_is_not_finite_are_named(capfd):
    objective = of(through(_root))
    assert objective.nan_origin(torch.tensor([1.0, 1.0], dtype=torch.float64)) == ""
    objective.evaluate(torch.tensor([[0.2, 0.2]], dtype=torch.float64))
    capfd.readouterr()
    said = objective.nan_origin(torch.tensor([0.2, 0.2], dtype=torch.float64))
    line = _root.adj.fun_lineno
    assert said == f"kernel _root in line {line} of test_warp_origins.py, by its argument a"
    assert capfd.readouterr() == ("", "")


def test_a_kernel_that_overwrites_what_it_reads_is_named_by_what_it_writes_to_and_by_its_adjoint():
    assert "argument a in kernel _in_place at " in of(in_place).wrong_origin(X)
    points = wp.array(X.numpy()[None].astype(np.float32), dtype=float, requires_grad=True)
    with wp.Tape() as tape:
        in_place(points)
    assert wrong_kernel(tape).startswith("kernel _in_place in line ")


def test_no_sound_kernel_is_named_wherever_it_is_asked():
    objective = of(sound)
    for x in SPACE.uniform(8, seed=0):
        assert objective.wrong_origin(x) == ""


def test_arrays_of_the_function_stay_as_they_were():
    points = wp.array(X.numpy()[None].astype(np.float32), dtype=float, requires_grad=True)
    with wp.Tape() as tape:
        loss = sound(points)
    seen = [array.numpy().copy() for launch in tape.launches for array in launch[3] if isinstance(array, wp.array)]
    before = float(loss.numpy()[0])
    assert wrong_kernel(tape) == ""
    after = [array.numpy() for launch in tape.launches for array in launch[3] if isinstance(array, wp.array)]
    assert float(loss.numpy()[0]) == before
    assert all(np.array_equal(one, other) for one, other in zip(seen, after, strict=True))
