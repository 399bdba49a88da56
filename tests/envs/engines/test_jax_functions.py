"""Objectives of JAX functions: against torch, in both modes, and what each wrong function is told."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.envs.engines.jax_functions import JaxFunction
from gradscape.landscapes.objective import Objective, Status

SPACE = gs.ParameterSpace({"a": (-1, 1, ""), "b": (1, 9, "")})
X = SPACE.uniform(7, seed=0)


def wave(x):
    return jnp.sin(x[0]) * x[1] ** 2


def same(x):
    return x[:, 0].sin() * x[:, 1] ** 2


def power(x):
    """x0 to the power of x1, rounded up, by a loop whose length depends on the point."""
    return jax.lax.while_loop(lambda at: at[1] < x[1], lambda at: (at[0] * x[0], at[1] + 1), (x[0] / x[0], 0.0))[0]


@pytest.mark.parametrize("mode", ["reverse", "forward"])
@pytest.mark.parametrize("batch", ["vmap", "map"])
@pytest.mark.parametrize(("precision", "error"), [("float64", 1e-12), ("float32", 1e-5)])
def test_losses_and_gradients_are_those_of_the_same_function_in_torch(mode, batch, precision, error):
    objective = gs.from_jax(wave, SPACE, mode=mode, batch=batch, precision=precision)
    wanted = gs.from_torch(same, SPACE).evaluate(X)
    for grad in (True, False):
        got = objective.evaluate(X, grad=grad)
        torch.testing.assert_close(got.loss, wanted.loss, rtol=error, atol=error)
    torch.testing.assert_close(objective.evaluate(X).grad, wanted.grad, rtol=error, atol=error)
    assert isinstance(objective, Objective)
    assert objective.evaluate(X, grad=False).grad is None


@pytest.mark.parametrize("grad", [True, False])
def test_the_engines_own_program_gives_the_same(grad):
    function = JaxFunction(wave, 2, "wave", "float64", rows=len(X))
    (found,) = function.engine_call(X, grad=grad)()
    for got, wanted in zip(found if grad else [found], function(X, grad), strict=False):
        torch.testing.assert_close(torch.tensor(got.tolist(), dtype=torch.float64), wanted)


@pytest.mark.parametrize("rows", [1, 3, 4, 100])
def test_a_row_does_not_depend_on_its_batch(rows):
    objective = gs.from_jax(wave, SPACE, rows=rows)
    whole = objective.evaluate(X)
    for number in range(len(X)):
        alone = objective.evaluate(X[number : number + 1])
        torch.testing.assert_close(alone.loss[0], whole.loss[number], rtol=1e-14, atol=0)
        torch.testing.assert_close(alone.grad[0], whole.grad[number], rtol=1e-14, atol=0)


def test_loops_of_unknown_length_are_differentiated_forward():
    found = gs.from_jax(power, SPACE, mode="forward").evaluate(X)
    times = X[:, 1].ceil()
    torch.testing.assert_close(found.loss, X[:, 0] ** times)
    torch.testing.assert_close(found.grad[:, 0], times * X[:, 0] ** (times - 1))
    with pytest.raises(ValueError, match=r"power cannot be differentiated in reverse: .*mode='forward'"):
        gs.from_jax(power, SPACE).evaluate(X)


def test_double_precision_needs_no_switch_of_jax_and_leaves_it_alone():
    before = jax.config.jax_enable_x64
    small = gs.from_jax(lambda x: (1 + 1e-12 * x[0]) - 1, SPACE).evaluate(X)
    torch.testing.assert_close(small.loss, 1e-12 * X[:, 0], rtol=1e-3, atol=1e-15)
    assert jax.config.jax_enable_x64 == before


def test_a_row_that_is_not_finite_fails_alone():
    found = gs.from_jax(lambda x: jnp.sqrt(x[0]) * x[1], SPACE).evaluate(X)
    np.testing.assert_array_equal(found.status == Status.NONFINITE, X[:, 0] < 0)
    assert found.loss[X[:, 0] >= 0].isfinite().all()


def test_no_points_are_no_call():
    assert len(gs.from_jax(wave, SPACE).evaluate(X[:0]).loss) == 0


def test_it_goes_to_another_process():
    objective = gs.from_jax(wave, SPACE)
    wanted = objective.evaluate(X)
    got = pickle.loads(pickle.dumps(objective)).evaluate(X)
    assert torch.equal(got.grad, wanted.grad)


@pytest.mark.parametrize(
    ("fn", "said"),
    [
        (lambda x: x, r"own must return one loss for one point, of shape \(\); got shape \(2,\)"),
        (lambda x: 3.0, "own must return a JAX array; got float"),
        (lambda x: x[0].astype(int), "own must return a floating-point loss; got int64"),
        (lambda x: jnp.asarray(np.sin(x))[0], "own cannot be traced by JAX: .*from_numpy"),
        (lambda x: x[0] if x[0] > 0 else x[1], "own cannot be traced by JAX: .*jax.lax"),
    ],
)
def test_a_wrong_function_is_told_what_and_what_to_do(fn, said):
    with pytest.raises(ValueError, match=said):
        gs.from_jax(fn, SPACE, name="own").evaluate(X)


@pytest.mark.parametrize("option", [{"mode": "both"}, {"batch": "all"}, {"precision": "float16"}, {"rows": 0}])
def test_a_wrong_option_says_what_there_is(option):
    with pytest.raises(ValueError, match=f"from_jax.* {next(iter(option))}|from_jax's rows"):
        gs.from_jax(wave, SPACE, **option)


def test_what_the_function_raises_is_said():
    def broken(x):
        raise RuntimeError("my simulator")

    with pytest.raises(ValueError, match=r"broken raised wherever it was tried.*RuntimeError: my simulator"):
        gs.from_jax(broken, SPACE).evaluate(X)


def test_it_is_sliced_like_any_other(tmp_path):
    cut, wanted = (
        gs.slice(objective, ("a", "b"), resolution=6, out=tmp_path / name)
        for name, objective in (("jax", gs.from_jax(wave, SPACE)), ("torch", gs.from_torch(same, SPACE)))
    )
    np.testing.assert_allclose(cut.data.loss, wanted.data.loss, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(cut.data.grad, wanted.data.grad, rtol=1e-12, atol=1e-12)


def test_what_was_traced_in_one_precision_is_forgotten_before_the_other():
    """Also what an inner function of JAX's own keeps, which does not know of the objective that called it."""
    traced = []

    @jax.jit
    def inner(x):
        traced.append(str(x.dtype))
        return x.sum()

    for precision in ("float64", "float64", "float32", "float64"):
        found = gs.from_jax(inner, SPACE, precision=precision).evaluate(X[:1], grad=False)
        torch.testing.assert_close(found.loss, X[:1].sum(dim=1), rtol=1e-6, atol=0)
    assert traced == ["float64", "float32", "float64"]
