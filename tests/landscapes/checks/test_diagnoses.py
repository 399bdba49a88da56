"""What a check concludes: planted defects are named with their cause and place, healthy awkward functions pass."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.landscapes.checks.causes import causes, recognise
from gradscape.landscapes.checks.examination import Share, could_be_missed, points_for
from gradscape.landscapes.checks.regions import find_region
from gradscape.landscapes.checks.slopes import Judgement, Kind
from gradscape.landscapes.checks.suite import Results, Settings, check

TWO = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})
TEN = gs.ParameterSpace.box([f"x{k}" for k in range(10)], -1, 1)
HUNDRED = gs.ParameterSpace.box([f"x{k}" for k in range(100)], -1, 1)
GAS = gs.ParameterSpace({"p": (1e5, 2e5, "Pa"), "T": (280, 320, "K")})


class Adjoint(torch.autograd.Function):
    """Leave points as they are, and change what comes back."""

    @staticmethod
    def forward(ctx, x, change):
        ctx.save_for_backward(x)
        ctx.change = change
        return x.clone()

    @staticmethod
    def backward(ctx, grad):
        return ctx.change(grad, *ctx.saved_tensors), None


def waves(x):
    return (torch.sin(2 * x + 0.3) ** 2).sum(1) + 0.3 * (x[:, :1] * x[:, -1:]).sum(1)


def spoiled(change, space=TWO, single=False):
    """Return waves whose gradient is changed on its way back."""
    return gs.from_torch(lambda x: waves(Adjoint.apply(x.float() if single else x, change)), space, name="spoiled")


def check_all(objective):
    results = Results()
    found = list(check(objective, Settings(precision=objective.precision, memory_seconds=0.01), results))
    return not any(one.bad for one in found), results


def by_one(dim, which, factor):
    change = torch.ones(dim)
    change[which] = factor
    return lambda grad, x: grad * change.to(grad)


def slab(low, high):
    return lambda grad, x: torch.where((x[:, :1] > low) & (x[:, :1] < high), -grad, grad)


def hit(x):
    """The miss of a ball that is hit at a whole step."""
    a, b, v, u = x[:, 0] / 10, torch.full_like(x[:, 0], 0.52), 1 + 0.4 * x[:, 1], 0 * x[:, 0]
    for _ in range(50):
        touch = (b - a < 0.2) & (v > u)
        v, u = torch.where(touch, u, v), torch.where(touch, v, u)
        a, b = a + 0.02 * v, b + 0.02 * u
    return (b - 1.0) ** 2


def where_nan(x):
    root = torch.where(x[:, 0] > 0, x[:, 0].sqrt(), 0.0)
    return (root - 0.5) ** 2 + x[:, 1] ** 2


def meter(x):
    return (1e6 + (x[:, 0] / 1e5 - 1.4) ** 2 + ((x[:, 1] - 300) / 20) ** 2).astype(np.float32)


def own_slope(x):
    """Return a bowl and its gradient by shares of the box, where that by parameters is wanted."""
    u = (x - np.array([1e5, 280])) / np.array([1e5, 40])
    return ((u - 0.3) ** 2).sum(1), 2 * (u - 0.3)


DEFECTS = {
    "sign": (spoiled(lambda grad, x: -grad), "sign", (), ""),
    "half": (spoiled(lambda grad, x: grad / 2, TEN), "factor 2", (), ""),
    "slab": (spoiled(slab(0.2, 0.4)), "sign", (), "a"),
    "dead of 100": (spoiled(by_one(100, 41, 0.0), HUNDRED), "detached parameter", ("x41",), ""),
    "flipped of 100": (spoiled(by_one(100, 77, -1.0), HUNDRED), "sign", ("x77",), ""),
    "too long in float32": (spoiled(lambda grad, x: 1.01 * grad, TEN, single=True), "scaled", (), ""),
    "reversed": (spoiled(lambda grad, x: grad.flip(1), TEN), "permuted", (), ""),
    "clipped": (spoiled(lambda grad, x: grad.clamp(-0.5, 0.5), TEN), "clipped", (), ""),
    "mean": (spoiled(lambda grad, x: grad / len(grad)), "mean over the batch", (), ""),
    "where": (gs.from_torch(where_nan, TWO), "where over NaN", ("a",), "a < 0.00"),
    "norm": (gs.from_torch(lambda x: x.square().sum(1).sqrt() ** 2, TWO), "norm at zero", (), ""),
    "units": (gs.from_numpy(own_slope, GAS), "units", (), ""),
    "grain": (gs.from_numpy(meter, GAS, differences=1e-6), "float32 grain", (), ""),
    "differences": (
        gs.from_numpy(lambda x: np.sin(20 * x[:, 0]) + x[:, 1] ** 2, TWO, differences=0.1),
        "differences with a bad step", (), "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DEFECTS)
def test_a_planted_defect_is_found_and_its_cause_and_place_named(name):
    objective, cause, parameters, rule = DEFECTS[name]
    passed, results = check_all(objective)
    first = results.diagnoses[0]
    assert not passed
    assert (first.cause, first.outcome) == (cause, "fail")
    if parameters:
        assert first.parameters == parameters
    assert rule in (first.region.rule if first.region else "")
    assert first.remedy


def logistic(x, steps=45):
    state = 0.5 + 0.4 * x
    for _ in range(steps):
        state = 3.99 * state * (1 - state)
    return state.sum(1)


HEALTHY = {
    "drag": lambda x: (x * x.abs()).sum(1),
    "cubic": lambda x: (x**3).sum(1),
    "kinks": lambda x: x.abs().sum(1) + torch.maximum(x[:, 0], x[:, 1]),
    "offset": lambda x: 1e9 + (x**2).sum(1),
    "well": lambda x: 1 - torch.exp(-200 * ((x - 0.6) ** 2).sum(1)),
    "single": lambda x: ((x.float() - 0.3) ** 2).sum(1),
    "single inside": lambda x: ((x.float() - 0.3) ** 2).sum(1).double() + x[:, 0],
    "tiny": lambda x: 1e-17 * ((x - 0.3) ** 2).sum(1),
    "decades": lambda x: torch.exp(20 * x).sum(1),
    "constant": lambda x: 0 * x.sum(1) + 3,
    "one alone": lambda x: torch.sin(3 * x[:, 0]) + 0 * x[:, 1],
    "ripples": lambda x: (x**2).sum(1) + 1e-3 * torch.sin(3e4 * x).sum(1),
    "fine ripples": lambda x: (x**2).sum(1) + 1e-6 * torch.sin(1e9 * x).sum(1),
    "chaos": logistic,
    "jumps": lambda x: (x - (9 * x).floor() / 9).square().sum(1) + (9 * x).floor().sum(1) / 10,
    "barrier": lambda x: (x**2).sum(1) - torch.log(x[:, 0] + 0.5),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_awkward_function_passes(name):
    passed, results = check_all(gs.from_torch(HEALTHY[name], TWO, name="healthy"))
    assert passed, [one.what for one in results.diagnoses]


def test_steps_that_gradients_do_not_see_are_a_warning_that_names_the_parameter():
    passed, results = check_all(gs.from_torch(hit, TWO))
    assert passed
    assert (results.diagnoses[0].cause, results.diagnoses[0].parameters) == ("snapped time of impact", ("a",))


def test_a_wrong_gradient_is_bisected_to_the_step_of_the_episode_where_it_begins():
    def pendulum(x, steps=40):
        angle, rate = x[:, 0], x[:, 1]
        for k in range(steps):
            pull = torch.sin(angle)
            pull = 2 * pull.detach() - pull if k >= 25 else pull
            rate = rate - 0.02 * 9.81 * pull
            angle = angle + 0.02 * rate
        return (angle - 0.5) ** 2

    found = gs.check(gs.from_torch(pendulum, TWO, horizon="steps"), power=0.2)
    assert not found.passed
    assert "right in episodes up to a length of 25, and wrong from 26 on" in found.diagnoses[0].what


def test_power_is_told_by_numbers_of_points():
    assert [points_for(share) for share in (0.01, 0.05, 0.2)] == [299, 59, 14]
    assert could_be_missed(59) == pytest.approx(0.0495, abs=1e-3)
    found = Share.of(
        [Judgement(Kind.WRONG, 1.0)] * 5 + [Judgement(Kind.AGREES, 1.0)] * 54 + [Judgement(Kind.NOISE, 1.0)]
    )
    assert (found.wrong, found.judged, found.points) == (5, 59, 60)
    assert found.low == pytest.approx(0.0281, abs=1e-3)  # of Clopper and Pearson
    assert found.high == pytest.approx(0.1868, abs=1e-3)


@pytest.mark.parametrize("width", [0.05, 0.2])
def test_slabs_of_the_box_are_found_wherever_they_lie(width):
    """As many of twelve as are promised: a slab of 5 % lies between two points of a spread-out sample once in many."""
    starts = np.linspace(-1, 1 - 2 * width, 12)
    found = [not check_all(spoiled(slab(start, start + 2 * width)))[0] for start in starts]
    assert sum(found) >= 11


def test_regions_are_the_simplest_rule_that_holds_and_none_by_chance():
    x = np.random.default_rng(0).uniform(size=(128, 3))
    names = ["u", "v", "w"]
    one = find_region(x, names, (x[:, 1] > 0.3) & (x[:, 1] < 0.6))
    assert one.parameters == ("v",)
    assert one.rule.startswith("v between 0.3")
    two = find_region(x, names, (x[:, 0] > 0.5) & (x[:, 2] < 0.4))
    assert set(two.parameters) == {"u", "w"}
    assert find_region(x, names, np.random.default_rng(1).uniform(size=128) < 0.3) is None
    many = np.random.default_rng(2).uniform(size=(64, 300))
    assert find_region(many, [str(k) for k in range(300)], np.arange(64) < 4) is None


def test_each_cause_has_a_name_words_and_signatures_that_can_hold():
    for cause in causes():
        assert cause.says
        assert cause.remedy.endswith((".", ")"))
        for signature in cause.signatures:
            middle = {name: min(max(0.0, low), high) for name, ((low, high), *_) in signature.numbers.items()}
            assert signature.holds(middle)
            assert not signature.holds({})
    assert recognise("wrong", {"ratio": 2.0, "steady": 1.0})[0].name == "factor 2"
    assert recognise("wrong", {"ratio": math.nan}) is None
