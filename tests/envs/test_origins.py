"""Which operation makes a gradient NaN, and in which line of the program; for Warp see `test_warp_origins`."""

import contextlib
import io
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
import torch

import gradscape as gs
from gradscape.landscapes.objective import BoxedObjective

SPACE = gs.ParameterSpace({"x": (-1, 1), "y": (-1, 1)})
LINES = Path(__file__).read_text().splitlines()
ORIGIN, NEGATIVE, ONE = (torch.full((2,), value, dtype=torch.float64) for value in (0.0, -0.5, 1.0))


def torch_norm(p):
    squares = (p**2).sum(1)
    return squares.sqrt()


def torch_where(p):
    root = p[:, 0].sqrt()
    return torch.where(p[:, 0] > 0, root, p[:, 1])


def torch_ratio(p):
    ratio = p[:, 0] / p[:, 1]
    return ratio.nan_to_num() + p[:, 0]


class Slip(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x

    @staticmethod
    def backward(ctx, slope):
        return slope / 0


def torch_own(p):
    return Slip.apply(p[:, 0])


def one_point(p):
    return p.norm() ** 2 / p.norm()


def jax_norm(p):
    size = jnp.linalg.norm(p)
    return size**2


def jax_where(p):
    root = jnp.sqrt(p[0])
    return jnp.where(p[0] > 0, root, p[1])


def jax_ratio(p):
    ratio = p[0] / p[1]
    return jnp.where(p[1] == 0, p[0], ratio)


@jax.jit
def compiled_before(p):
    return jnp.linalg.norm(p)


def jax_jitted(p):
    return compiled_before(p)


def jax_loop(p):
    def step(state, weight):
        length = jnp.linalg.norm(state)
        return state - p * length, weight * state[0]

    state, out = jax.lax.scan(step, 1 * p, jnp.arange(5.0), reverse=True)
    return state.sum() + out.sum() + jax.nn.softplus(p[0])


def jax_until(p):
    def step(state):
        number, value = state
        return number + 1, jnp.sqrt(value)

    return jax.lax.while_loop(lambda state: state[0] < 4, step, (0, p[0]))[1]


def jax_branch(p):
    def low(q):
        return jnp.where(q[0] > 0, jnp.log(q[0]), q[1])

    return jax.lax.cond(p[0] > 2, lambda q: q[0] + 0.0, low, p)


@jax.custom_vjp
def slip(x):
    return x


slip.defvjp(lambda x: (x, None), lambda _, slope: (slope / 0,))


def jax_own(p):
    return slip(p[0]) + p[1]


TORCH = [
    (torch_norm, ORIGIN, "sqrt", "return squares.sqrt()"),
    (torch_where, NEGATIVE, "sqrt", "root = p[:, 0].sqrt()"),
    (torch_ratio, ORIGIN, "div", "ratio = p[:, 0] / p[:, 1]"),
    (torch_own, ONE, "Slip", "return Slip.apply(p[:, 0])"),
]


def jax_single(p, key=0):
    drawn = jax.random.normal(key, (2,), dtype=jnp.float32)
    angle = jnp.arccos(jnp.where(drawn > 9, drawn, p.astype(jnp.float32)))
    return angle.sum()


JAX = [
    (jax_norm, ORIGIN, "sqrt", "size = jnp.linalg.norm(p)"),
    (jax_where, NEGATIVE, "sqrt", "root = jnp.sqrt(p[0])"),
    (jax_ratio, ORIGIN, "div", "ratio = p[0] / p[1]"),
    (jax_jitted, ORIGIN, "sqrt", "return jnp.linalg.norm(p)"),
    (jax_loop, ORIGIN, "sqrt", "length = jnp.linalg.norm(state)"),
    (jax_branch, ORIGIN, "log", "return jnp.where(q[0] > 0, jnp.log(q[0]), q[1])"),
    (jax_single, ONE, "acos", "angle = jnp.arccos(jnp.where(drawn > 9, drawn, p.astype(jnp.float32)))"),
    (jax_own, ONE, "slip", "return slip(p[0]) + p[1]"),
]


def at_line(operation, code):
    """What is to be said of an operation in a line of this file."""
    (line,) = (number for number, one in enumerate(LINES, start=1) if one.strip() == code)
    return f'{operation} in line {line} of test_origins.py ("{code}")'


def quiet_origin(objective, x):
    """What an objective says of a point, while nothing else is said anywhere."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        said = objective.nan_origin(x)
    assert out.getvalue() == err.getvalue() == ""
    return said


@pytest.mark.parametrize(("fn", "x", "operation", "code"), TORCH)
def test_torch_says_the_operation_and_its_line(fn, x, operation, code):
    assert quiet_origin(gs.from_torch(fn, SPACE), x) == at_line(operation, code)
    assert gs.from_torch(fn, SPACE).nan_origin(torch.tensor([0.3, 0.7]).double()) == "" or fn is torch_own
    assert not torch.is_anomaly_enabled()


def test_torch_says_it_of_a_function_of_one_point():
    said = quiet_origin(gs.from_torch(lambda p: (p**2).sum().sqrt(), SPACE, vectorized=False), ORIGIN)
    assert said.startswith("sqrt in line ")


@pytest.mark.parametrize(("fn", "x", "operation", "code"), JAX)
def test_jax_says_the_primitive_and_its_line(fn, x, operation, code):
    compiled_before(jnp.ones(2))  # from another line: where JAX first traced a function is not where it is called
    objective = gs.from_jax(fn, SPACE)
    assert quiet_origin(objective, x) == at_line(operation, code)
    assert objective.nan_origin(torch.tensor([0.3, 0.7]).double()) == "" or fn is jax_own


@pytest.mark.parametrize(
    ("fn", "code"),
    [
        (jax_norm, "size = jnp.linalg.norm(p)"),
        (jax_loop, "length = jnp.linalg.norm(state)"),
        (jax_until, "return number + 1, jnp.sqrt(value)"),
    ],
)
def test_jax_says_it_of_tangents_too(fn, code):
    assert quiet_origin(gs.from_jax(fn, SPACE, mode="forward"), ORIGIN) == at_line("sqrt", code)


def test_what_wraps_an_objective_passes_it_on():
    assert BoxedObjective(gs.from_torch(torch_norm, SPACE)).nan_origin(ORIGIN).startswith("sqrt")


def test_the_first_of_several_seeds_and_a_logarithmic_scale_are_understood():
    space = gs.ParameterSpace({"k": gs.log(1e-3, 1e3)})

    def fn(x, seed=0):
        return torch.acos(x[:, 0] + 0 * seed)

    objective = gs.from_torch(fn, space, seeds=2, options={})
    assert objective.nan_origin(torch.zeros(1).double()).startswith("acos in line ")
