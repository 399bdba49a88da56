"""Objectives of functions that launch Warp kernels: against torch, and each way in which a tape goes wrong unseen."""

import numpy as np
import pytest
import torch
import warp as wp

import gradscape as gs
from gradscape.landscapes.objective import Objective, Status

SPACE = gs.ParameterSpace({"a": (-1, 1, ""), "b": (1, 9, "")})
X = SPACE.uniform(7, seed=0)
KEPT = wp.zeros(len(X), dtype=wp.float64, requires_grad=True)


@wp.kernel
def _wave(x: wp.array2d(dtype=wp.float64), loss: wp.array(dtype=wp.float64)):
    i = wp.tid()
    loss[i] = wp.sin(x[i, 0]) * x[i, 1] * x[i, 1]


@wp.kernel
def _wave32(x: wp.array2d(dtype=wp.float32), loss: wp.array(dtype=wp.float32)):
    i = wp.tid()
    loss[i] = wp.sin(x[i, 0]) * x[i, 1] * x[i, 1]


@wp.kernel
def _square(a: wp.array(dtype=wp.float64), b: wp.array(dtype=wp.float64)):
    i = wp.tid()
    b[i] = a[i] * a[i]


@wp.kernel
def _square_in_place(a: wp.array(dtype=wp.float64)):
    i = wp.tid()
    a[i] = a[i] * a[i]


@wp.kernel
def _root(x: wp.array2d(dtype=wp.float64), loss: wp.array(dtype=wp.float64)):
    i = wp.tid()
    loss[i] = wp.sqrt(x[i, 0])


def losses_of(kernel, real=wp.float64):
    def fn(x):
        loss = wp.zeros(len(x), dtype=real, requires_grad=True)
        wp.launch(kernel, dim=len(x), inputs=[x], outputs=[loss])
        return loss

    return fn


wave = losses_of(_wave)


def through_what_is_kept(x):
    """The square of the wave, which lies in an array that the function keeps between calls."""
    loss = wp.zeros(len(x), dtype=wp.float64, requires_grad=True)
    wp.launch(_wave, dim=len(x), inputs=[x], outputs=[KEPT])
    wp.launch(_square, dim=len(x), inputs=[KEPT], outputs=[loss])
    return loss


def overwritten_later(x):
    """The fourth power of the wave, whose square is written where the wave was."""
    first, second = (wp.zeros(len(x), dtype=wp.float64, requires_grad=True) for _ in range(2))
    wp.launch(_wave, dim=len(x), inputs=[x], outputs=[first])
    wp.launch(_square, dim=len(x), inputs=[first], outputs=[second])
    wp.launch(_square, dim=len(x), inputs=[second], outputs=[first])
    return first


def overwritten_in_place(x):
    loss = wave(x)
    wp.launch(_square_in_place, dim=len(x), inputs=[loss])
    return loss


def same(x):
    return x[:, 0].sin() * x[:, 1] ** 2


@pytest.mark.parametrize(("kernel", "precision", "error"), [(_wave, "float64", 1e-12), (_wave32, "float32", 1e-5)])
@pytest.mark.parametrize("rows", [3, 256])
def test_losses_and_gradients_are_those_of_the_same_function_in_torch(kernel, precision, error, rows):
    fn = losses_of(kernel, getattr(wp, precision))
    objective = gs.from_warp(fn, SPACE, precision=precision, device="cpu", rows=rows)
    wanted = gs.from_torch(same, SPACE).evaluate(X)
    got = objective.evaluate(X)
    torch.testing.assert_close(got.loss, wanted.loss, rtol=error, atol=error)
    torch.testing.assert_close(got.grad, wanted.grad, rtol=error, atol=error)
    assert torch.equal(objective.evaluate(X, grad=False).loss, got.loss)
    assert objective.evaluate(X, grad=False).grad is None
    assert isinstance(objective, Objective)
    assert len(objective.evaluate(X[:0]).loss) == 0


def test_gradients_of_what_the_function_keeps_do_not_add_up():
    objective = gs.from_warp(through_what_is_kept, SPACE, precision="float64", device="cpu", check_overwrites=False)
    wanted = gs.from_torch(lambda x: same(x) ** 2, SPACE).evaluate(X)
    for _ in range(3):
        torch.testing.assert_close(objective.evaluate(X).grad, wanted.grad)


@pytest.mark.parametrize(("fn", "power"), [(overwritten_later, 4), (overwritten_in_place, 2)])
def test_what_is_overwritten_after_it_was_read_is_found_before_it_makes_gradients_wrong(fn, power):
    how = {"precision": "float64", "device": "cpu"}
    with pytest.raises(ValueError, match=f"{fn.__name__} writes to what it has read, .* in kernel _square"):
        gs.from_warp(fn, SPACE, **how).evaluate(X)
    unchecked = gs.from_warp(fn, SPACE, check_overwrites=False, **how).evaluate(X)
    wanted = gs.from_torch(lambda x: same(x) ** power, SPACE).evaluate(X)
    torch.testing.assert_close(unchecked.loss, wanted.loss)
    assert not torch.allclose(unchecked.grad, wanted.grad)  # or there would be nothing to find


def test_a_row_that_is_not_finite_fails_alone():
    found = gs.from_warp(losses_of(_root), SPACE, precision="float64", device="cpu").evaluate(X)
    np.testing.assert_array_equal(found.status == Status.NONFINITE, X[:, 0] < 0)


@pytest.mark.parametrize(
    ("fn", "said"),
    [
        (lambda x: 3.0, "own must return a Warp array; got float"),
        (lambda x: x, r"own must return losses of shape \(7,\); got shape \(7, 2\)"),
        (lambda x: wp.zeros(len(x), dtype=wp.float32), "losses of float64, as its points are; got float32"),
        (lambda x: wp.zeros(len(x), dtype=wp.float64, requires_grad=True), "own launched no kernel.*--no-gradients"),
        (lambda x: wp.clone(wave(x), requires_grad=False), "carry no gradient; make them with requires_grad=True"),
        (lambda x: wave(wp.clone(x, requires_grad=False)), "launched no kernel that reads its points"),
    ],
)
def test_a_wrong_function_is_told_what_and_what_to_do(fn, said):
    with pytest.raises(ValueError, match=said):
        gs.from_warp(fn, SPACE, name="own", precision="float64", device="cpu", check_overwrites=False).evaluate(X)


@pytest.mark.parametrize("option", [{"device": "tpu"}, {"precision": "float16"}, {"rows": 0}])
def test_a_wrong_option_says_what_there_is(option):
    with pytest.raises(ValueError, match=r"from_warp|precision|runs on cpu and cuda; got device 'tpu'"):
        gs.from_warp(wave, SPACE, **option)
