"""What every registered environment promises. A newly registered one is held to it without another line here."""

from dataclasses import fields, replace

import pytest
import torch

from gradscape.envs.mjx.scene import MjxScene
from gradscape.envs.mjx.scenes import Drop
from gradscape.envs.registry import entries, environment_class, make
from gradscape.landscapes.objective import Evaluation, Objective, Status

from .corners import faults, small
from .numbers import POINTS, moved, points_of
from .scenes import SETTINGS, SHORT, SIMULATED, SMALL_STEPS, assert_returns_stay, made, made_once, one_of_each

ROWS = POINTS["tiny"][0]


STAND = ("mjx-bounce", "mjx-push")  # for all scenes of MuJoCo: JAX compiles each for up to a minute


def known():
    """Return all environments, those of MuJoCo's scenes that others stand for as nightly ones."""
    for one in one_of_each(sorted(entries())):
        param = one if hasattr(one, "values") else pytest.param(one)
        stood_for = param.values[0].startswith("mjx-") and param.values[0] not in STAND
        yield pytest.param(*param.values, marks=[*param.marks, *([pytest.mark.nightly] if stood_for else [])])


@pytest.fixture(scope="module", params=known())
def env(request):
    return made(request.param)


@pytest.fixture(scope="module")
def points(env):
    return points_of(env, "tiny")


@pytest.fixture(scope="module")
def result(env, points):
    return env.evaluate(points)


def assert_same_bits(got, wanted):
    assert torch.equal(got.status, wanted.status)
    for ours, theirs in ((got.loss, wanted.loss), (got.grad, wanted.grad)):
        assert torch.equal(ours.view(torch.int64), theirs.view(torch.int64))


def test_it_is_an_objective(env, points, result):
    dim = env.space.dim
    assert isinstance(env, Objective)
    assert (result.loss.shape, result.loss.dtype) == ((ROWS,), torch.float64)
    assert (result.grad.shape, result.grad.dtype) == ((ROWS, dim), torch.float64)
    assert (result.status.shape, result.status.dtype) == ((ROWS,), torch.int8)
    assert (result.status == Status.OK).all()
    assert result.loss.isfinite().all()
    assert result.grad.isfinite().all()
    assert not result.loss.requires_grad


def test_numbers_are_those_of_the_model_version(env, result):
    assert not moved(env, "tiny", result)


def test_the_loss_is_the_same_bits_without_its_gradient(env, points, result):
    alone = env.evaluate(points, grad=False)
    assert alone.grad is None
    assert torch.equal(alone.loss, result.loss)
    assert torch.equal(alone.status, result.status)


def test_gradcheck(env):
    """Against central differences in float64, backward twice included; one full Jacobian, then random directions."""
    if env.fidelity.precision != "float64":
        pytest.skip(f"{env.name} computes in float32 only; its own tests hold its gradients against closed forms")
    full, x = env.space.uniform(1, seed=2).requires_grad_(), env.space.uniform(3, seed=3).requires_grad_()
    step = SMALL_STEPS.get(env.name, 1e-6)
    assert torch.autograd.gradcheck(env, (full,), eps=step, fast_mode=env.space.dim > 5)
    assert torch.autograd.gradcheck(env, (x,), eps=step, fast_mode=True)


@pytest.mark.parametrize("size", [1, 3])
def test_rows_do_not_depend_on_their_batch(env, points, result, size):
    parts = [env.evaluate(part) for part in points.split(size)]
    together = replace(
        result,
        loss=torch.cat([part.loss for part in parts]),
        grad=torch.cat([part.grad for part in parts]),
        status=torch.cat([part.status for part in parts]),
    )
    assert_same_bits(together, result)


def test_rows_do_not_depend_on_their_order(env, points, result):
    order = torch.tensor([4, 2, 0, 1, 3])
    shuffled = env.evaluate(points[order])
    assert_same_bits(shuffled, replace(result, **{f: getattr(result, f)[order] for f in ("loss", "grad", "status")}))


def test_threads_share_a_batch_without_changing_a_bit(env, points, result, monkeypatch):
    monkeypatch.setattr(type(env), "threads", 3)  # 2, 2 and 1 rows
    assert_same_bits(env.evaluate(points), result)


def test_an_empty_batch_gives_an_empty_evaluation(env, points):
    result = env.evaluate(points[:0])
    assert result.loss.shape == result.status.shape == (0,)
    assert result.grad.shape == (0, env.space.dim)
    assert env.evaluate(points[:0], grad=False).grad is None
    x = points[:0].clone().requires_grad_()
    env(x).sum().backward()
    assert x.grad.shape == (0, env.space.dim)


def test_another_call_leaves_what_was_returned_as_it_was(env):
    if isinstance(env, MjxScene) and not isinstance(env, Drop):
        pytest.skip("nothing writes to JAX's arrays, and to trace episodes takes a minute; Drop's stand for that class")
    assert_returns_stay(env)


OTHER_PRECISIONS = [
    (name, precision)
    for name in SIMULATED
    for precision in sorted({one.precision for one in environment_class(name).fidelities.values()})
    if precision != SETTINGS[name]["fidelity"].precision
]


@pytest.mark.parametrize(("name", "precision"), one_of_each(OTHER_PRECISIONS))
def test_so_it_does_in_every_precision_of_its_fidelities(name, precision):
    settings = {"fidelity": replace(SETTINGS[name]["fidelity"], precision=precision)} | SHORT.get(name, {})
    assert_returns_stay(make(name, device="cpu", **settings))


def test_the_same_point_gives_the_same_bits(env, points, result):
    assert_same_bits(env.evaluate(points), result)
    other = made_once(env.name)
    assert other is not env
    if isinstance(env, MjxScene) and not isinstance(env, Drop):
        # Tracing a gradient again takes up to 15 s: Drop's stands for all of that class, in reverse a dart's.
        assert torch.equal(other.evaluate(points, grad=False).loss, result.loss)
    else:
        assert_same_bits(other.evaluate(points), result)


def test_losses_are_weighed_row_by_row_in_every_backward(env, points, result):
    x, weight = points[:2].clone().requires_grad_(), torch.tensor([3.0, -0.5], dtype=torch.float64)
    total = (weight * env(x)).sum()
    for _ in range(2):
        x.grad = None
        total.backward(retain_graph=True)
        assert torch.equal(x.grad, weight[:, None] * result.grad[:2])


def test_parameters_of_any_precision_get_gradients_of_their_own(env, points):
    x = points[:2].float().requires_grad_()
    losses = env(x)
    losses.sum().backward()
    exact = env.evaluate(x.detach().double())
    assert losses.dtype == x.grad.dtype == torch.float32
    torch.testing.assert_close(losses.detach(), exact.loss.float())
    torch.testing.assert_close(x.grad, exact.grad.float())


def test_whatever_is_called_ok_at_corners_and_beyond_is_finite_and_was_simulated_there(env):
    """And where no float32 goes; the nightly test asks more. JAX takes up to 20 s to trace another scene."""
    asked = env if isinstance(env, MjxScene) else small(env.name)
    assert list(faults(asked, outward=(0.0, 0.1, 1e39), max_corners=2)) == []


def refusal(call):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 -- each caller looks into the message
        call()
    return str(caught.value)


def test_points_of_another_shape_or_type_are_refused(env, points):
    dim = env.space.dim
    shapes = {(3, dim + 2): points.new_zeros(3, dim + 2), (dim,): points[0], (1, 1, dim): points[None, :1]}
    for shape, x in shapes.items():
        for call in (env.evaluate, env):
            message = refusal(lambda call=call, x=x: call(x))
            assert message.startswith(f"{env.name} takes {dim} parameters")
            assert message.endswith(f"got x of shape {shape}")
    wrong = {"a tensor of torch.bool": points > 0, "a tensor of torch.complex128": points + 1j, "str": "0.5"}
    for kind, x in wrong.items():
        message = refusal(lambda x=x: env.evaluate(x))
        assert message.startswith(f"{env.name} takes numbers")
        assert message.endswith(f"got {kind}")
    assert refusal(lambda: env(points.long())).endswith("got a tensor of torch.int64")


def test_arrays_and_lists_are_points_too(env, points, monkeypatch):
    reversed_, swapped, asked = points.numpy()[::-1].copy()[::-1], points.numpy().astype(">f8"), []

    def evaluated(x, *, grad):
        asked.extend(x.tolist())
        return Evaluation.from_results(x.sum(dim=1), torch.ones_like(x) if grad else None)

    monkeypatch.setattr(env, "_evaluate", evaluated)
    for x in (points.numpy(), points.tolist(), reversed_, swapped):
        asked.clear()
        env.evaluate(x)
        assert sorted(asked) == sorted(points.tolist())


def test_points_that_are_not_finite_are_refused(env, points):
    for bad in (torch.nan, torch.inf):
        x = points.clone()
        x[3, -1] = bad
        message = refusal(lambda x=x: env.evaluate(x))
        assert message.startswith(f"{env.name} takes finite parameters; row 3 of x is [")
        assert str(bad) in message


def test_unknown_settings_are_refused(env):
    cls = type(env)
    unknown = refusal(lambda: cls(wind=3.0))
    assert f"{env.name} has no option 'wind'; it has " in unknown
    for option in fields(cls.Options):
        assert option.name in unknown
        wrong = refusal(lambda option=option: cls(**{option.name: "a wrong value"}))
        assert f"{env.name} option {option.name} takes " in wrong
        assert "got 'a wrong value'" in wrong
    fidelity = refusal(lambda: cls(fidelity="perfect"))
    assert fidelity == f"{env.name} has fidelities {', '.join(cls.fidelities)}; got 'perfect'"
    device = refusal(lambda: cls(device="tpu"))
    assert device == f"{env.name} runs on {' and '.join(cls.devices)}; got device 'tpu'"


def test_every_named_example_is_a_point_it_can_simulate(env):
    for name in env.examples:
        x = env.example(name)
        assert (x.shape, x.dtype) == ((env.space.dim,), torch.float64)
        assert env.evaluate(x[None]).status.tolist() == [Status.OK], name
    assert refusal(lambda: env.example("nothing")).startswith(f"{env.name} has no example 'nothing'; it has ")


def test_its_row_in_the_registry_is_true(env):
    entry = entries()[env.name]
    if entry.dim == "any":
        assert type(env)(dim=3).space.dim == 3
    elif entry.dim != "?":
        assert env.space.dim == int(entry.dim)
    if entry.fidelities:
        assert entry.fidelities == tuple(env.fidelities)
    if entry.parameters != "?":
        for unit in set(env.space.units):
            assert (f"[{unit}]" if unit else "no unit") in entry.parameters


def test_every_fidelity_can_be_made(env):
    cls = environment_class(env.name)
    for name, fidelity in cls.fidelities.items():
        assert fidelity.name == name
        assert make(env.name, fidelity=name, device="cpu").fidelity is fidelity
    assert make(env.name, device="cpu").fidelity is next(iter(cls.fidelities.values()))


def test_an_unknown_environment_is_refused_with_the_closest_name():
    assert "no environment is called 'flood'; did you mean fluid?" in refusal(lambda: make("flood"))
    far = refusal(lambda: make("zzz"))
    assert "did you mean" not in far
    assert f"`landscape envs` lists all {len(entries())}" in far
