"""Functions of others as environments: their settings, their random numbers, and what is wrong with them in words."""

from __future__ import annotations

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
from gradscape.landscapes.measures.noise import noise

SPACE = gs.ParameterSpace({"x": (-1, 1, "m"), "y": (-1, 1, "m")})
X = torch.tensor([[0.0, 0.0], [0.5, 0.2], [-0.5, 0.9]], dtype=torch.float64)


def spring(x: torch.Tensor, stiffness: float = 2.0, dt: float = 0.1, steps: int = 10) -> torch.Tensor:
    """A spring, as many explicit steps long as that; the loss is where it is."""
    place, speed = x[:, 0], x[:, 1]
    for _ in range(steps):
        place, speed = place + dt * speed, speed - dt * stiffness * place
    return place


def made(**said: Any) -> gs.Environment:
    fidelities = {"draft": {"dt": 0.1, "steps": 10}, "reference": {"dt": 0.01, "steps": 100}}
    return gs.from_torch(spring, SPACE, fidelities=fidelities, horizon="steps", **said)


def test_keyword_arguments_are_options_and_fidelities() -> None:
    env = made()
    assert env.identity()["options"] == {"stiffness": 2.0}
    assert list(env.fidelities) == ["draft", "reference"]
    stiff = gs.make(env, fidelity="reference", stiffness="8")
    wanted = spring(X, stiffness=8.0, dt=0.01, steps=100)
    assert torch.equal(stiff.evaluate(X).loss, wanted)
    assert torch.equal(env.evaluate(X).loss, spring(X, 2.0, 0.1, 10))


def test_a_horizon_is_a_number_of_steps_and_another_step_keeps_the_time() -> None:
    env = made()
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
        ({"options": {"stiffness": [1.0]}}, "needs a number, a text or a truth value as default"),
        ({"options": {"dt": 0.1}, "fidelities": {"a": {"dt": 0.1}}}, "dt in options and in fidelities"),
        ({"fidelities": {"a": {"dt": 0.1}, "b": {"steps": 2}}}, "fidelity a lacks steps"),
        ({"horizon": "length"}, "horizon is one of its options or fidelities' settings; got 'length'"),
        ({"seeds": 4}, "seeds=4 averages over random numbers, and spring takes no key or seed"),
        ({"precision": "float16"}, "takes precision float64 or float32; got 'float16'"),
        ({"rows": 0}, "rows is a whole number of at least 1"),
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
    assert found.grad is not None
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


def test_points_that_raise_have_a_status_and_the_others_go_on() -> None:
    def fit(p: Any) -> Any:
        if p[0] > 0.4:
            raise RuntimeError("too much work\nand a page more")
        return (p**2).sum()

    env = gs.from_numpy(fit, SPACE, differences=1e-5, vectorized=False)
    found = env.evaluate(X)
    assert found.status.tolist() == [gs.Status.OK, gs.Status.ERROR, gs.Status.OK]
    assert found.error == "RuntimeError: too much work"
    s = gs.slice(env, resolution=8)
    assert s.errors == "24 points raised: first 'RuntimeError: too much work'"
    assert gs.optimize(env, "random", budget=12).best.loss < 1


def test_an_interrupt_is_not_swallowed() -> None:
    def stop(x: Any) -> Any:
        raise KeyboardInterrupt

    for left in (KeyboardInterrupt, SystemExit):
        with pytest.raises(left):
            gs.from_numpy(_raising(left), SPACE).evaluate(X, grad=False)


def _raising(error: type[BaseException]) -> Callable[[Any], Any]:
    def fn(x: Any) -> Any:
        raise error

    return fn


@pytest.mark.parametrize("error", [StopIteration, OSError, ValueError, TypeError])
def test_what_always_raises_is_refused_with_what_it_said(error: type[Exception]) -> None:
    with pytest.raises(ValueError, match=f"fn raised wherever it was tried, at 12 points: {error.__name__}"):
        gs.from_numpy(_raising(error), SPACE).evaluate(X, grad=False)


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
    assert found.grad is not None
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


@wp.kernel
def squares(x: wp.array2d(dtype=wp.float32), loss: wp.array(dtype=wp.float32)):  # type: ignore[valid-type]
    i = wp.tid()
    loss[i] = x[i, 0] * x[i, 0]


def launch(x: Any) -> Any:
    loss = wp.zeros(len(x), dtype=wp.float32, requires_grad=True)
    wp.launch(squares, dim=len(x), inputs=[x], outputs=[loss])
    return loss


@pytest.mark.parametrize(
    ("make", "wanted"),
    [
        (lambda: gs.from_torch(lambda x: (x**2).sum(1, keepdim=True), SPACE), r"squeeze the last axis"),
        (lambda: gs.from_torch(lambda x: ((x**2).sum(1), x), SPACE), r"must return losses alone"),
        (lambda: gs.from_torch(torch.nn.Linear(2, 1), SPACE, name="net"), r"pass precision='float32' to from_torch"),
        (lambda: gs.from_numpy(lambda x: ((x**2).sum(1), 2 * x, 3), SPACE), r"got 3 values, so drop the others"),
        (lambda: gs.from_jax(lambda x: jnp.sum(x**2, axis=1), SPACE), r"It takes one point, of shape \(2,\)"),
        (lambda: gs.from_jax(lambda x: x[:, 0] ** 2, SPACE), r"It takes one point, of shape \(2,\)"),
        (lambda: gs.from_jax(lambda x: (jnp.sum(x**2), x), SPACE), r"must return its loss alone"),
        (
            lambda: gs.from_warp(launch, SPACE, precision="float64", device="cpu"),
            r"pass precision='float32' to from_warp",
        ),
    ],
)
def test_what_a_function_returns_is_held_against_what_it_must_be(make: Callable[[], Any], wanted: str) -> None:
    with pytest.raises(ValueError, match=wanted):
        make().evaluate(X)


def test_a_function_goes_to_another_process() -> None:
    env = gs.from_torch(lambda x, weight=3.0: weight * (x**2).sum(1), SPACE, name="sent")
    sent = cloudpickle.loads(cloudpickle.dumps(env))
    assert torch.equal(sent.evaluate(X).loss, env.evaluate(X).loss)
    assert torch.equal(sent.remake(weight=1.0).evaluate(X).loss, (X**2).sum(1))


def test_an_object_without_what_it_takes_is_told_so() -> None:
    with pytest.raises(ValueError, match="is no simulator: it has no space and no evaluate"):
        gs.check(object())
    with pytest.raises(ValueError, match="launch is a function, and nothing says what its parameters are"):
        gs.check(launch)


def test_an_engine_that_breaks_on_the_way_is_no_landscape_of_errors() -> None:
    calls = []

    def fragile(x: Any) -> Any:
        calls.append(len(x))
        if len(calls) > 2:
            raise RuntimeError("the device is lost")
        return (x**2).sum(1)

    env = gs.from_numpy(fragile, SPACE)
    env.evaluate(X, grad=False)
    env.evaluate(X, grad=False)
    with pytest.raises(ValueError, match=r"fragile raised wherever it was tried.*the device is lost"):
        env.evaluate(X, grad=False)
