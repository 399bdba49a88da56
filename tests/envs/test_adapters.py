"""Functions of others as environments: what every library's promises, their settings, and what is wrong in words."""

from __future__ import annotations

import gc
import math
import pickle
import weakref
from collections.abc import Callable
from typing import Any

import cloudpickle
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
import warp as wp

import gradscape as gs
from gradscape.envs.engines.jax_functions import JaxFunction
from gradscape.landscapes.measures.noise import noise
from gradscape.landscapes.objective import Objective

SPACE = gs.ParameterSpace({"a": (-1, 1, "m"), "b": (1, 9, "m")})
X = SPACE.uniform(7, seed=0)
KEPT = wp.zeros(len(X), dtype=wp.float64, requires_grad=True)


def wave(x: torch.Tensor) -> torch.Tensor:
    return x[:, 0].sin() * x[:, 1] ** 2


def jax_wave(x: jax.Array) -> jax.Array:
    return jnp.sin(x[0]) * x[1] ** 2


def numpy_wave(x: Any) -> Any:
    return np.sin(x[:, 0]) * x[:, 1] ** 2


def numpy_slopes(x: Any) -> Any:
    return numpy_wave(x), np.stack([np.cos(x[:, 0]) * x[:, 1] ** 2, 2 * np.sin(x[:, 0]) * x[:, 1]], axis=1)


def numpy_point(p: Any) -> Any:
    slopes = [math.cos(p[0]) * p[1] ** 2, 2 * math.sin(p[0]) * p[1]]
    return math.sin(p[0]) * p[1] ** 2, slopes


@wp.kernel
def _wave(x: wp.array2d[Any], loss: wp.array[Any]):  # type: ignore[no-untyped-def]
    i = wp.tid()
    loss[i] = wp.sin(x[i, 0]) * x[i, 1] * x[i, 1]


@wp.kernel
def _root(x: wp.array2d[wp.float64], loss: wp.array[wp.float64]):  # type: ignore[no-untyped-def]
    i = wp.tid()
    loss[i] = wp.sqrt(x[i, 0])


@wp.kernel
def _square(a: wp.array[wp.float64], b: wp.array[wp.float64]):  # type: ignore[no-untyped-def]
    i = wp.tid()
    b[i] = a[i] * a[i]


@wp.kernel
def _square_in_place(a: wp.array[wp.float64]):  # type: ignore[no-untyped-def]
    i = wp.tid()
    a[i] = a[i] * a[i]


def warp_of(kernel: Any) -> Callable[[Any], Any]:
    def fn(x: Any) -> Any:
        loss: Any = wp.zeros(len(x), dtype=x.dtype, requires_grad=True)
        wp.launch(kernel, dim=len(x), inputs=[x], outputs=[loss])
        return loss

    return fn


def from_warp(fn: Callable[[Any], Any], **how: Any) -> gs.Environment:
    return gs.from_warp(fn, SPACE, **{"precision": "float64", "device": "cpu", **how})


WAVES: dict[str, Callable[..., gs.Environment]] = {
    "torch": lambda **how: gs.from_torch(wave, SPACE, **how),
    "torch, point by point": lambda **how: gs.from_torch(
        lambda p: p[0].sin() * p[1] ** 2, SPACE, vectorized=False, **how
    ),
    "numpy": lambda **how: gs.from_numpy(numpy_slopes, SPACE, **how),
    "numpy, point by point": lambda **how: gs.from_numpy(numpy_point, SPACE, vectorized=False, **how),
    "jax": lambda **how: gs.from_jax(jax_wave, SPACE, **how),
    "jax, forward": lambda **how: gs.from_jax(jax_wave, SPACE, mode="forward", **how),
    "jax, point by point": lambda **how: gs.from_jax(jax_wave, SPACE, batch="map", **how),
    "warp": lambda **how: from_warp(warp_of(_wave), **how),
}
LIBRARIES = ("torch", "numpy", "jax", "warp")
ROOTS = {
    "torch": lambda: gs.from_torch(lambda x: x[:, 0].sqrt() * x[:, 1], SPACE),
    "numpy": lambda: gs.from_numpy(lambda x: np.sqrt(x[:, 0]), SPACE),
    "jax": lambda: gs.from_jax(lambda x: jnp.sqrt(x[0]) * x[1], SPACE),
    "warp": lambda: from_warp(warp_of(_root)),
}


@pytest.mark.parametrize("made", WAVES)
@pytest.mark.parametrize(("precision", "error"), [("float64", 1e-12), ("float32", 1e-5)])
def test_losses_and_gradients_are_those_of_the_formula(made: str, precision: str, error: float) -> None:
    env, (loss, grad) = WAVES[made](precision=precision), map(torch.from_numpy, numpy_slopes(X.numpy()))
    found, alone = env.evaluate(X), env.evaluate(X, grad=False)
    torch.testing.assert_close(found.loss, loss, rtol=error, atol=error)
    torch.testing.assert_close(found.grad, grad, rtol=error, atol=50 * error)
    torch.testing.assert_close(alone.loss, found.loss, rtol=error, atol=error)
    assert alone.grad is None
    assert isinstance(env, Objective)
    assert len(env.evaluate(X[:0]).loss) == 0


@pytest.mark.parametrize("vectorized", [True, False])
def test_central_differences_converge_at_second_order_on_unequal_ranges(vectorized: bool) -> None:
    fn = numpy_wave if vectorized else (lambda p: numpy_point(p)[0])
    errors, exact = [], torch.from_numpy(numpy_slopes(X.numpy())[1])
    for step in (4e-3, 2e-3, 1e-3):
        found = gs.from_numpy(fn, SPACE, differences=step, vectorized=vectorized).evaluate(X)
        errors.append(float((found.grad - exact).abs().max()))  # type: ignore[operator]
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2, atol=0.05)


def test_the_callers_points_stay_as_they_are() -> None:
    def greedy(x: Any) -> Any:
        x *= 2
        return x[:, 0]

    before = X.clone()
    gs.from_numpy(greedy, SPACE).evaluate(X, grad=False)
    gs.from_torch(wave, SPACE).evaluate(X)
    assert torch.equal(X, before)
    assert not X.requires_grad


@pytest.mark.parametrize("rows", [1, 3, 4])
@pytest.mark.parametrize("library", LIBRARIES)
def test_a_row_does_not_depend_on_its_batch(library: str, rows: int) -> None:
    env = WAVES[library](rows=rows)
    whole, parts = env.evaluate(X), [env.evaluate(row[None]) for row in X]
    torch.testing.assert_close(torch.cat([one.loss for one in parts]), whole.loss, rtol=1e-14, atol=0)
    torch.testing.assert_close(torch.cat([one.grad for one in parts]), whole.grad, rtol=1e-14, atol=0)


@pytest.mark.filterwarnings("ignore:invalid value encountered in sqrt")
@pytest.mark.parametrize("library", LIBRARIES)
def test_a_row_that_is_not_finite_fails_alone(library: str) -> None:
    found = ROOTS[library]().evaluate(X, grad=library != "numpy")
    np.testing.assert_array_equal(found.status == gs.Status.NONFINITE, X[:, 0] < 0)
    assert found.loss[X[:, 0] >= 0].isfinite().all()


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_function_is_freed_with_its_last_reference(library: str) -> None:
    gc.collect()
    gc.disable()
    try:
        env = WAVES[library]()
        for rows in (X, X, X[:1]):
            env.evaluate(rows)
        held = weakref.ref(env)
        del env
        assert held() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("library", ["numpy", "jax"])
def test_a_function_goes_to_another_process_after_it_was_evaluated(library: str) -> None:
    env = WAVES[library]()
    wanted = env.evaluate(X)
    assert torch.equal(pickle.loads(pickle.dumps(env)).evaluate(X).grad, wanted.grad)
    local = gs.from_torch(lambda x, weight=3.0: weight * (x**2).sum(1), SPACE, name="sent")
    sent = cloudpickle.loads(cloudpickle.dumps(local))
    assert torch.equal(sent.evaluate(X).loss, local.evaluate(X).loss)
    assert torch.equal(sent.remake(weight=1.0).evaluate(X).loss, (X**2).sum(1))


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize(
    ("option", "said"),
    [
        ({"precision": "float16"}, "takes precision float64 or float32; got 'float16'"),
        ({"rows": 0}, "rows is a whole number of at least 1"),
        ({"mode": "both"}, "takes mode reverse or forward; got 'both'"),
        ({"batch": "all"}, "takes batch vmap or map; got 'all'"),
        ({"device": "tpu"}, "runs on cpu and cuda; got device 'tpu'"),
    ],
)
def test_a_wrong_option_says_what_there_is(library: str, option: dict[str, Any], said: str) -> None:
    own = {"jax": ("mode", "batch"), "torch": ("device",), "warp": ("device",)}.get(library, ())
    if not {*own, "precision", "rows"} >= option.keys():
        said = "takes no keyword|unexpected keyword"
    with pytest.raises((ValueError, TypeError), match=said):
        WAVES[library](**option)


# ---- What is wrong with a function


def overwritten_later(x: Any) -> Any:
    """The fourth power of the wave, whose square is written where the wave was."""
    first, second = (wp.zeros(len(x), dtype=wp.float64, requires_grad=True) for _ in range(2))
    wp.launch(_wave, dim=len(x), inputs=[x], outputs=[first])
    wp.launch(_square, dim=len(x), inputs=[first], outputs=[second])
    wp.launch(_square, dim=len(x), inputs=[second], outputs=[first])
    return first


def overwritten_in_place(x: Any) -> Any:
    loss = warp_of(_wave)(x)
    wp.launch(_square_in_place, dim=len(x), inputs=[loss])
    return loss


def power(x: jax.Array) -> jax.Array:
    """x0 to the power of x1, rounded up, by a loop whose length depends on the point."""
    end = jax.lax.while_loop(lambda at: at[1] < x[1], lambda at: (at[0] * x[0], at[1] + 1), (x[0] / x[0], 0.0))
    return end[0]


def of_torch(fn: Any, **how: Any) -> Callable[[], Any]:
    return lambda: gs.from_torch(fn, SPACE, name="own", **how)


def of_numpy(fn: Any) -> Callable[[], Any]:
    return lambda: gs.from_numpy(fn, SPACE, name="own")


def of_jax(fn: Any) -> Callable[[], Any]:
    return lambda: gs.from_jax(fn, SPACE, name="own")


def of_warp(fn: Any, **how: Any) -> Callable[[], Any]:
    return lambda: from_warp(fn, **{"name": "own", "check_overwrites": False, **how})


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (of_torch(lambda x: (x**2).sum(1, keepdim=True)), r"squeeze the last axis"),
        (of_torch(lambda x: ((x**2).sum(1), x)), r"must return losses only"),
        (of_torch(torch.nn.Linear(2, 1)), r"pass precision='float32' to from_torch"),
        (of_torch(lambda x: x), r"own must return losses of shape \(7,\); got shape \(7, 2\)"),
        (of_torch(lambda x: 3.0), "own must return a tensor; got float"),
        (of_torch(lambda x: x.detach()[:, 0]), "without a gradient.*--no-gradients"),
        (of_torch(lambda x: 1.0, vectorized=False), "must return a tensor; got float"),
        (of_numpy(lambda x: x[0]), r"losses of shape \(7,\); got shape \(2,\) .*vectorized=False"),
        (of_numpy(lambda x: (x[:, 0], x[0])), r"gradients of shape \(7, 2\); got shape \(2,\)"),
        (of_numpy(numpy_wave), "own returned losses without gradients.*differences"),
        (of_numpy(lambda x: 1j * x[:, 0]), "the loss of own takes numbers"),
        (of_numpy(lambda x: ((x**2).sum(1), 2 * x, 3)), r"got 3 values, so drop the rest"),
        (of_jax(lambda x: jnp.sum(x**2, axis=1)), r"It has to take one point, of shape \(2,\)"),
        (of_jax(lambda x: x[:, 0] ** 2), r"It has to take one point, of shape \(2,\)"),
        (of_jax(lambda x: (jnp.sum(x**2), x)), r"must return only its loss"),
        (of_jax(lambda x: x), r"own must return one loss for one point, of shape \(\); got shape \(2,\)"),
        (of_jax(lambda x: 3.0), "own must return a JAX array; got float"),
        (of_jax(lambda x: x[0].astype(int)), "own must return a floating-point loss; got int64"),
        (of_jax(lambda x: jnp.asarray(np.sin(x))[0]), "own cannot be traced by JAX: .*from_numpy"),
        (of_jax(lambda x: x[0] if x[0] > 0 else x[1]), "own cannot be traced by JAX: .*jax.lax"),
        (of_jax(power), r"own cannot be differentiated in reverse: .*mode='forward'"),
        (of_warp(lambda x: 3.0), "own must return a Warp array; got float"),
        (of_warp(lambda x: x), r"own must return losses of shape \(7,\); got shape \(7, 2\)"),
        (of_warp(lambda x: wp.zeros(len(x), dtype=wp.float32)), "losses of float64, like its points; got float32"),
        (
            of_warp(lambda x: wp.zeros(len(x), dtype=wp.float64, requires_grad=True)),
            "own launched no kernel.*--no-gradients",
        ),
        (
            of_warp(lambda x: wp.clone(warp_of(_wave)(x), requires_grad=False)),
            "without a gradient; make them with requires_grad=True",
        ),
        (
            of_warp(lambda x: warp_of(_wave)(wp.clone(x, requires_grad=False))),
            "launched no kernel that reads its points",
        ),
        (of_warp(warp_of(_root), precision="float32"), r"pass precision='float64' to from_warp"),
        (
            of_warp(overwritten_later, check_overwrites=True),
            "overwrites an array that it .* in kernel _square",
        ),
        (
            of_warp(overwritten_in_place, check_overwrites=True),
            "overwrites an array that it .* in kernel _square",
        ),
    ],
)
def test_a_wrong_function_is_told_what_and_what_to_do(make: Callable[[], Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make().evaluate(X)


@pytest.mark.parametrize(("fn", "exponent"), [(overwritten_later, 4), (overwritten_in_place, 2)])
def test_unchecked_what_is_overwritten_makes_gradients_wrong(fn: Callable[[Any], Any], exponent: int) -> None:
    """Or there would be nothing to find."""
    found, wanted = (
        from_warp(fn, check_overwrites=False).evaluate(X),
        gs.from_torch(lambda x: wave(x) ** exponent, SPACE),
    )
    torch.testing.assert_close(found.loss, wanted.evaluate(X).loss)
    assert not torch.allclose(found.grad, wanted.evaluate(X).grad)  # type: ignore[arg-type]


def test_gradients_of_what_a_function_of_warp_keeps_do_not_add_up() -> None:
    def through_what_is_kept(x: Any) -> Any:
        loss: Any = wp.zeros(len(x), dtype=wp.float64, requires_grad=True)
        wp.launch(_wave, dim=len(x), inputs=[x], outputs=[KEPT])
        wp.launch(_square, dim=len(x), inputs=[KEPT], outputs=[loss])
        return loss

    env, wanted = from_warp(through_what_is_kept, check_overwrites=False), gs.from_torch(lambda x: wave(x) ** 2, SPACE)
    for _ in range(3):
        torch.testing.assert_close(env.evaluate(X).grad, wanted.evaluate(X).grad)


# ---- JAX's own


@pytest.mark.parametrize("grad", [True, False])
def test_the_engines_own_program_gives_the_same(grad: bool) -> None:
    function = JaxFunction(jax_wave, 2, "wave", "float64", rows=len(X))
    (found,) = function.engine_call(X, grad=grad)()  # type: ignore[misc]
    for got, wanted in zip(found if grad else [found], function(X, grad), strict=False):
        torch.testing.assert_close(torch.tensor(got.tolist(), dtype=torch.float64), wanted)


def test_loops_of_unknown_length_are_differentiated_forward() -> None:
    found, times = gs.from_jax(power, SPACE, mode="forward").evaluate(X), X[:, 1].ceil()
    torch.testing.assert_close(found.loss, X[:, 0] ** times)
    torch.testing.assert_close(found.grad[:, 0], times * X[:, 0] ** (times - 1))  # type: ignore[index]


def test_double_precision_needs_no_switch_of_jax_and_what_was_traced_in_one_is_forgotten_before_the_other() -> None:
    """Also what an inner function of JAX's own keeps, which does not know of the objective that called it."""
    traced, before = [], jax.config.jax_enable_x64  # type: ignore[attr-defined]

    @jax.jit
    def inner(x: jax.Array) -> jax.Array:
        traced.append(str(x.dtype))
        return x.sum() + 1e-12 * x[0]

    for precision in ("float64", "float64", "float32", "float64"):
        found = gs.from_jax(inner, SPACE, precision=precision).evaluate(X[:1], grad=False)
        error = 1e-15 if precision == "float64" else 1e-6
        torch.testing.assert_close(found.loss, X[:1].sum(dim=1) + 1e-12 * X[:1, 0], rtol=error, atol=0)
    assert traced == ["float64", "float32", "float64"]
    assert jax.config.jax_enable_x64 == before  # type: ignore[attr-defined]


# ---- Settings


def spring(x: torch.Tensor, stiffness: float = 2.0, dt: float = 0.1, steps: int = 10) -> torch.Tensor:
    """A spring, as many explicit steps long as that; the loss is where it is."""
    place, speed = x[:, 0], x[:, 1]
    for _ in range(steps):
        place, speed = place + dt * speed, speed - dt * stiffness * place
    return place


def made_of_spring() -> gs.Environment:
    fidelities = {"draft": {"dt": 0.1, "steps": 10}, "reference": {"dt": 0.01, "steps": 100}}
    return gs.from_torch(spring, SPACE, fidelities=fidelities, horizon="steps")


def test_keyword_arguments_are_options_and_fidelities() -> None:
    env = made_of_spring()
    assert env.identity()["options"] == {"stiffness": 2.0}
    assert list(env.fidelities) == ["draft", "reference"]
    stiff = gs.make(env, fidelity="reference", stiffness="8")
    assert torch.equal(stiff.evaluate(X).loss, spring(X, stiffness=8.0, dt=0.01, steps=100))
    assert torch.equal(env.evaluate(X).loss, spring(X, 2.0, 0.1, 10))


def test_a_horizon_is_a_number_of_steps_and_another_step_keeps_the_time() -> None:
    env = made_of_spring()
    assert env.horizon == 10
    assert torch.equal(env.with_horizon(20).evaluate(X).loss, spring(X, steps=20))
    finer = env.remake(fidelity=gs.Fidelity("draft-dt-x0.5", dt=0.05, precision="float64", settings={"steps": 10}))
    assert torch.equal(finer.evaluate(X).loss, spring(X, dt=0.05, steps=20))
    assert finer.length() == env.length()
    assert torch.equal(finer.with_horizon(20).evaluate(X).loss, spring(X, dt=0.05, steps=40))


@pytest.mark.parametrize(
    ("said", "wanted"),
    [
        ({"options": {"mass": 1.0}}, "takes no keyword argument mass; it takes stiffness, dt, steps"),
        ({"options": {"stiffness": [1.0]}}, "needs a number, a text or a truth value as its default"),
        ({"options": {"dt": 0.1}, "fidelities": {"a": {"dt": 0.1}}}, "dt in both options and fidelities"),
        ({"fidelities": {"a": {"dt": 0.1}, "b": {"steps": 2}}}, "fidelity a lacks steps"),
        ({"horizon": "length"}, "horizon must be one of its options or fidelity settings; got 'length'"),
        ({"seeds": 4}, "seeds=4 averages over random numbers, but spring takes no key or seed"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(said: dict[str, Any], wanted: str) -> None:
    with pytest.raises(ValueError, match=wanted):
        gs.from_torch(spring, SPACE, **said)


def noisy(p: jax.Array, key: jax.Array) -> jax.Array:
    return jnp.sum((p + 0.1 * jax.random.normal(key, (2,))) ** 2)


@pytest.mark.slow
def test_a_function_of_a_key_gets_the_same_one_everywhere_and_knows_its_noise() -> None:
    one, many = gs.from_jax(noisy, SPACE), gs.from_jax(noisy, SPACE, seeds=16)
    again = one.evaluate(X[[0, 1, 0]]).loss
    assert float(again[0]) == float(again[2])
    assert one.noise(X) is None
    draws = torch.stack([gs.make(one, seed=seed).evaluate(X).loss for seed in range(16)])
    torch.testing.assert_close(many.evaluate(X).loss, draws.mean(dim=0))
    error = many.noise(X)
    assert error is not None
    torch.testing.assert_close(error, draws.std(dim=0) / 4)
    assert noise(many, X, rounding=1e-16).again == pytest.approx(float(error.square().mean().sqrt()))
    assert torch.equal(gs.from_numpy(lambda x, seed: x[:, 0] + seed, SPACE).evaluate(X, grad=False).loss, X[:, 0])


def test_the_greatest_value_is_the_least_loss() -> None:
    hill = gs.from_torch(lambda x: -(x**2).sum(1), SPACE, maximize=True, name="hill")
    found = hill.evaluate(X)
    torch.testing.assert_close(found.loss, (X**2).sum(1))
    torch.testing.assert_close(found.grad, 2 * X)
    assert hill.identity()["maximize"]


class Cart:
    """A cart that is pushed, in Gymnasium's way."""

    class action_space:  # noqa: N801 -- as there
        shape = (1,)

    def reset(self, seed: int | None = None) -> Any:
        self.state = np.zeros(2)
        return self.state, {}

    def step(self, action: Any) -> Any:
        self.state = self.state + 0.1 * np.array([self.state[1], action[0]])
        return self.state, -float((self.state[0] - 1) ** 2), False, bool(self.state[0] > 3), {}


def test_a_simulator_of_reset_and_step_is_one_of_its_actions() -> None:
    cart = Cart()
    space = gs.ParameterSpace.box([f"push {number}" for number in range(2)], -1, 1)
    env = gs.from_step(cart.step, cart.reset, space, steps=20, differences=1e-4)
    cart.reset()
    wanted = sum(-cart.step([0.5 if number < 10 else -0.5])[1] for number in range(20))
    found = env.evaluate(torch.tensor([[0.5, -0.5], [0.5, -0.5]]))
    assert found.loss.tolist() == [pytest.approx(wanted)] * 2
    assert gs.check(env).passed


# ---- What raises, and how torch and buffers are set


def test_points_that_raise_have_a_status_and_the_others_go_on() -> None:
    def fit(p: Any) -> Any:
        if p[0] > 0.4:
            raise RuntimeError("too much work\nand a page more")
        return (p**2).sum()

    env = gs.from_numpy(fit, SPACE, differences=1e-5, vectorized=False)
    found = env.evaluate(torch.tensor([[0.0, 2.0], [0.5, 2.0], [-0.5, 2.0]]))
    assert found.status.tolist() == [gs.Status.OK, gs.Status.ERROR, gs.Status.OK]
    assert found.error == "RuntimeError: too much work"
    s = gs.slice(env, resolution=8)
    assert s.errors == "24 points raised: first 'RuntimeError: too much work'"
    assert gs.optimize(env, "random", budget=12).best.loss < 90


def raising(error: BaseException, after: int = 0) -> Callable[[Any], Any]:
    """Return a function that raises from a call on."""
    calls: list[int] = []

    def fn(x: Any) -> Any:
        calls.append(len(x))
        if len(calls) > after:
            raise error
        return (x**2).sum(1)

    return fn


@pytest.mark.parametrize("left", [KeyboardInterrupt, SystemExit])
def test_an_interrupt_is_not_swallowed(left: type[BaseException]) -> None:
    with pytest.raises(left):
        gs.from_numpy(raising(left()), SPACE).evaluate(X, grad=False)


@pytest.mark.parametrize("error", [StopIteration(), OSError(), ValueError(), TypeError(), RuntimeError("mine")])
def test_what_always_raises_is_refused_with_what_it_said(error: Exception) -> None:
    for adapt in (gs.from_numpy, gs.from_torch):
        where = f"fn raised at all 16 points where it was tried: {type(error).__name__}.*; the first was x = "
        with pytest.raises(ValueError, match=where) as said:
            adapt(raising(error), SPACE).evaluate(X, grad=False)
        assert str(said.value).endswith(f"x = {X[0].tolist()}")
        assert isinstance(said.value.__cause__, type(error))


def test_an_engine_that_breaks_on_the_way_is_no_landscape_of_errors() -> None:
    env = gs.from_numpy(raising(RuntimeError("the device is lost"), after=2), SPACE)
    env.evaluate(X, grad=False)
    env.evaluate(X, grad=False)
    with pytest.raises(ValueError, match=r"fn raised at all .* points where it was tried.*the device is lost"):
        env.evaluate(X, grad=False)


def test_a_buffer_that_is_returned_again_is_copied() -> None:
    buffer = np.zeros(())

    def own(p: Any) -> Any:
        buffer[...] = (p**2).sum()
        return buffer

    found = gs.from_numpy(own, SPACE, vectorized=False).evaluate(X, grad=False)
    torch.testing.assert_close(found.loss, (X**2).sum(1))


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_gradients_are_there_where_torch_was_told_to_make_none(mode: Callable[[], Any]) -> None:
    with mode():
        found = gs.from_torch(lambda x: (x**2).sum(1), SPACE).evaluate(X)
    torch.testing.assert_close(found.grad, 2 * X)


def test_no_function_is_asked_at_what_is_no_number() -> None:
    asked = []
    env = gs.from_numpy(lambda x: asked.append(x) or x[:, 0], SPACE)
    with pytest.raises(ValueError, match="takes finite parameters"):
        env.evaluate(torch.tensor([[float("nan"), 0.0]]), grad=False)
    assert asked == []


def test_losses_of_float32_are_seen() -> None:
    env: Any = gs.from_torch(lambda x: (x.float() ** 2).sum(1), SPACE)
    assert env.precision == "float64"
    env.evaluate(X)
    assert env.precision == "float32"
    given = []
    single = gs.from_torch(lambda x: given.append(x.dtype) or (x**2).sum(1), SPACE, precision="float32")
    assert single.evaluate(X).loss.dtype == torch.float64
    assert given == [torch.float32]


def test_an_object_without_what_it_takes_is_told_so() -> None:
    with pytest.raises(ValueError, match="is no simulator: it has no space and no evaluate"):
        gs.check(object())
    with pytest.raises(ValueError, match="wave is a function without a parameter space"):
        gs.check(wave)
