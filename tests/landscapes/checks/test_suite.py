"""The conformance suite: what is sound passes, and each defect makes its own check fail, and no other."""

import math
from functools import partial

import pytest
import torch

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.checks.extremes import CORNERS, ExtremeCase, corners
from gradscape.landscapes.checks.suite import PROMISE_POINTS, Results, Settings, check
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace.box(["a", "b", "c"], -1.0, 2.0)
NAN = torch.nan


QUICK = {"power": 0.3, "memory_seconds": 0.01}


def loss_of(x):
    return (1 + torch.arange(x.shape[1])).mul(torch.sin(2 * x) + x.square()).sum(dim=1)


def outcomes(objective, **settings):
    return {found.check: found for found in check(objective, Settings(**(QUICK | settings)))}


def diagnoses(objective, **settings):
    results = Results()
    list(check(objective, Settings(**(QUICK | settings)), results))
    return results.diagnoses


def failures(objective, **settings):
    return {name for name, found in outcomes(objective, **settings).items() if found.bad}


class Sound(Objective):
    """A smooth objective that keeps every promise; a defect overrides one part of it."""

    name = "sound"
    space = SPACE
    beyond_box = True

    def evaluate(self, x, *, grad=True):
        if x.ndim != 2 or x.shape[1] != self.space.dim:
            raise ValueError(f"x has shape {tuple(x.shape)}")
        if not x.isfinite().all():
            raise ValueError("x is not finite")
        with torch.enable_grad():
            x = x.detach().clone().requires_grad_()
            losses = loss_of(x)
            (slope,) = torch.autograd.grad(losses.sum(), x)
        return self.spoil(
            x.detach(), Evaluation.from_results(losses.detach(), self.slope(slope) if grad else None), grad
        )

    def slope(self, slope):
        return slope

    def spoil(self, x, found, grad):
        return found


class Spoiled(Sound):
    """Sound but for what becomes of its slopes, and of its losses at points `x` asked for with `grad` or without.

    `read` is what it makes of points, and `status` says how all rows end.
    """

    def __init__(self, slope=lambda slope: slope, loss=lambda loss, x, grad: loss, read=lambda x: x, status=None):
        self.slope, self.spoil_loss, self.read, self.status = slope, loss, read, status

    def evaluate(self, x, *, grad=True):
        return super().evaluate(self.read(x), grad=grad)

    def spoil(self, x, found, grad):
        status = found.status if self.status is None else torch.full((len(x),), self.status)
        return Evaluation(self.spoil_loss(found.loss, x, grad), found.grad, status)


def failing(where):
    """Return what gives no loss at some points, without a status that says so."""
    return partial(Spoiled, loss=lambda loss, x, grad: loss.masked_fill(where(x), NAN))


def leaking(loss, x, grad):
    return loss + 1e-3 * (x.mean(dim=0) - x[0]).sum() if len(x) else loss


def ordered(loss, x, grad):
    """Let what a row gets depend on its place in a batch of eight."""
    places = torch.tensor([0, 1, 1, 0, 0, 1, 1, 0])
    return loss + 1e-3 * places * x.sum(dim=1) if len(x) == PROMISE_POINTS else loss


def unsteady():
    generator = torch.Generator().manual_seed(0)
    return Spoiled(loss=lambda loss, x, grad: loss + 1e-3 * torch.randn(len(x), generator=generator))


TwiceTheGradient = partial(Spoiled, slope=lambda slope: 2 * slope)
OneWrongSign = partial(Spoiled, slope=lambda slope: slope * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
WrongShape = partial(Spoiled, loss=lambda loss, x, grad: loss[:, None])
SilentNan = failing(
    lambda x: (x == SPACE.uniform(PROMISE_POINTS, seed=0)[2]).all(dim=1)
)  # not at an extreme, which has its own say


class WrongWhere(Sound):
    """Its gradient is another one at some components: as of a contact that does not slide, right everywhere else."""

    def __init__(self, where=lambda x: x == 0, wrong=lambda slope: 40 * slope + 1):
        self.where, self.wrong = where, wrong

    def spoil(self, x, found, grad):
        slope = torch.where(self.where(x), self.wrong(found.grad), found.grad) if grad else None
        return Evaluation.from_results(found.loss, slope)


def at_the_centre(x):
    return (x == SPACE.center).all(dim=1, keepdim=True)


def nan_where(where):
    """Return what has a finite loss everywhere, and a gradient of NaN at some points."""
    return WrongWhere(where, lambda slope: slope * NAN)


class LossOfNan(Sound):
    def evaluate(self, x, *, grad=True):
        found = super().evaluate(x.nan_to_num(), grad=grad)
        return Evaluation.from_results(found.loss, found.grad.where(x.isfinite(), NAN) if grad else None)


class Tape(torch.autograd.Function):
    """Zero the tape in the backward, as some simulators do."""

    @staticmethod
    def forward(ctx, x, objective):
        found = objective.evaluate(x)
        ctx.tape = found.grad.clone()
        return found.loss

    @staticmethod
    def backward(ctx, weight):
        grad = weight[:, None] * ctx.tape
        ctx.tape.zero_()
        return grad, None


class SpentTape(Sound):
    def __call__(self, x):
        return Tape.apply(x, self)


GRADIENT = {"gradient", "special places", "parameters"}


@pytest.mark.parametrize("objective", [Sound(), from_torch(loss_of, SPACE)])
def test_a_sound_objective_passes(objective):
    found = outcomes(objective)
    assert not [name for name, finding in found.items() if finding.bad]
    skipped = {"float32 against float64", "energy drift", "forward against reverse", "growth over horizons"}
    skipped |= {"shorter time steps"}
    skipped |= set() if getattr(objective, "beyond_box", False) else {"1% outside the box", "10% outside the box"}
    assert {name for name, finding in found.items() if finding.outcome == "skip"} == skipped
    errors = {row["step"]: row["error"] for row in found["gradient"].table}
    assert errors[1e-6] < 1e-6  # central differences, exact to rounding,
    assert errors[1e-2] / errors[1e-3] == pytest.approx(100, rel=0.5)  # and of second order


@pytest.mark.parametrize(
    ("defect", "checks"),
    [
        (TwiceTheGradient, GRADIENT),
        (OneWrongSign, GRADIENT),
        (partial(Spoiled, slope=torch.zeros_like), GRADIENT),
        (WrongWhere, {"special places"}),
        (partial(WrongWhere, at_the_centre, torch.zeros_like), {"special places"}),
        (partial(Spoiled, loss=leaking), {"rows alone"}),
        (partial(Spoiled, loss=ordered), {"rows in another order"}),
        (SilentNan, {"status"}),
        (unsteady, {"determinism", "order of calls"}),
        (partial(Spoiled, loss=lambda loss, x, grad: loss + 1e-3 * grad), {"loss without gradient"}),
        (WrongShape, {"shapes"}),
        (partial(Spoiled, loss=lambda loss, x, grad: loss.float()), {"shapes"}),
        (partial(Spoiled, loss=lambda loss, x, grad: loss + 0 * loss[0]), {"empty batch"}),
        (
            partial(Spoiled, read=lambda x: x if x.shape[1:] == (3,) else SPACE.lower[None]),
            {"refusal of a wrong shape"},
        ),
        (partial(Spoiled, read=torch.nan_to_num), {"refusal of nan"}),
        (LossOfNan, {"refusal of nan"}),
        (failing(lambda x: (x == SPACE.upper).all(dim=1)), {"corners"}),
        (failing(lambda x: at_the_centre(x)[:, 0]), {"centre"}),
        (failing(lambda x: (x > SPACE.upper + 0.1).any(dim=1)), {"10% outside the box"}),
        (SpentTape, {"second backward"}),
    ],
)
def test_a_defect_makes_its_own_check_fail(defect, checks):
    assert failures(defect()) == checks


def test_a_nan_gradient_beside_a_finite_loss_fails_by_its_name_and_no_other():
    found = outcomes(nan_where(at_the_centre))
    assert {name for name, finding in found.items() if finding.bad} == {"special places", "centre"}
    loss = float(Sound().evaluate(SPACE.center[None]).loss)
    at = f"the gradient is NaN at the centre (a = 0.5, b = 0.5, c = 0.5), where the loss is {loss:.4g}"
    assert found["centre"].why == at
    x = SPACE.uniform(8, seed=0)
    median = x[:, 0].median()
    found = outcomes(nan_where(lambda x: x[:, :1] <= median))
    share = f"{float((x[:, 0] <= median).double().mean()):.0%}".replace("%", " %")
    row = x[x[:, 0] <= median][0].tolist()
    first = ", ".join(f"{name} = {value:.4g}" for name, value in zip(SPACE.names, row, strict=True))
    said = f"the gradient is NaN at {share} of the points (first at {first}), where the loss is finite"
    assert found["status"].why == said
    failing = {"status", "gradient", "parameters", "corners", "centre", "special places"}
    assert {name for name, finding in found.items() if finding.bad} <= failing
    assert not any("depends on grad=" in finding.why for finding in found.values())


def test_an_objective_that_can_be_evaluated_once_only_fails():
    class Once(Sound):
        calls = 0

        def spoil(self, x, found, grad):
            self.calls += 1
            if self.calls > 2:
                raise RuntimeError("the tape is spent")
            return found

    *_, last = check(Once())
    assert (last.check, last.outcome, last.why) == ("determinism", "fail", "the tape is spent")


def test_what_cannot_be_judged_after_a_wrong_shape_is_skipped():
    found = list(check(WrongShape()))
    assert [finding.outcome for finding in found] == ["fail", "skip"]
    assert "loss of shape (8,)" in found[0].why


def test_a_single_wrong_sign_among_ninety_is_seen():
    class Wide(Sound):
        space = ParameterSpace.box([f"x{k}" for k in range(90)], -1.0, 2.0)

        def slope(self, slope):
            return slope * torch.cat([torch.ones(89), -torch.ones(1)])

    assert failures(Wide()) >= {"gradient"}
    (found,) = diagnoses(Wide())
    assert (found.cause, found.parameters) == ("sign", ("x89",))


def test_in_float32_thresholds_follow_from_the_precision():
    def rounded(x):
        return loss_of(x.float()).double()

    found = outcomes(from_torch(rounded, SPACE), precision="float32")
    assert not [name for name, finding in found.items() if finding.bad]
    errors = {row["step"]: row["error"] for row in found["gradient"].table}
    assert errors[1e-8] > 0.1  # small steps are lost in rounding,
    assert errors[1e-3] < 3e-3  # and longer ones are not


def test_a_flat_objective_has_no_slope_to_compare():
    found = outcomes(from_torch(lambda x: 0 * x.sum(dim=1), SPACE))
    assert found["usefulness"].outcome == "skip"
    assert "exactly zero" in found["gradient"].figure
    assert not any(finding.bad for finding in found.values())


def test_gradients_of_the_two_precisions_are_held_against_each_other():
    same = outcomes(Sound(), twin=Sound)["float32 against float64"]
    assert same.outcome == "pass"
    assert same.numbers["gradient"] == 0.0
    assert outcomes(Sound(), twin=TwiceTheGradient)["float32 against float64"].outcome == "fail"


def refusing():
    raise ValueError("no such time step")


def broken():
    raise RuntimeError("a kernel failed:\n\tin one of somebody's files")


Escaping = partial(Spoiled, loss=lambda loss, x, grad: loss * NAN, status=Status.ESCAPED)
HalfFailed = partial(Spoiled, status=Status.ESCAPED)  # loss says nothing happened


@pytest.mark.parametrize(
    ("make", "outcome", "figure"),
    [
        (Sound, "pass", "2 finite; largest |grad| "),
        (refusing, "pass", "refused: no such time step"),
        (Escaping, "pass", "2 escaped"),
        (HalfFailed, "fail", "2 escaped"),
        (SilentNan, "pass", "2 finite"),
        (broken, "fail", "raised RuntimeError"),
    ],
)
def test_a_variant_answers_with_a_number_a_status_or_a_refusal(make, outcome, figure):
    found = outcomes(Sound(), variants=[ExtremeCase("dt 8x", make)])["dt 8x"]
    assert found.outcome == outcome
    assert found.figure.startswith(figure)
    assert found.why == ("a kernel failed" if make is broken else found.why)  # in a line


def test_an_expected_failure_is_excused_until_it_passes():
    reason = dict.fromkeys(GRADIENT, "the same")
    excused = outcomes(TwiceTheGradient(), expected=reason)
    assert not any(finding.bad for finding in excused.values())
    assert excused["gradient"].outcome == "known"
    assert excused["gradient"].why.endswith("known: the same")
    no_longer = outcomes(Sound(), expected=reason)
    assert {name for name, finding in no_longer.items() if finding.bad} == GRADIENT
    assert no_longer["gradient"].outcome == "unexpected"
    assert no_longer["gradient"].why == "it passes, so this reason no longer applies: the same"
    never = outcomes(Sound(), expected={"dt 9x": "it explodes"})["dt 9x"]
    assert (never.outcome, never.bad) == ("unexpected", True)


@pytest.mark.parametrize("dim", [1, 2, 4, 5, 10, 15, 16, 90, 400])
def test_corners_are_all_or_cover_every_pair(dim):
    found = corners(dim)
    assert found.shape[1] == dim
    assert len(found) == (2**dim if 2**dim <= CORNERS else len(found)) <= CORNERS
    assert len({tuple(row) for row in found.tolist()}) == len(found)
    for first in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)):
        met = (found == first[0]).double().T @ (found == first[1]).double() > 0
        assert (met | torch.eye(dim, dtype=torch.bool)).all()


def test_the_same_seed_gives_the_same_figures():
    first, again, other = (outcomes(Sound(), seed=seed)["gradient"] for seed in (0, 0, 1))
    assert first == again != other
    assert first.numbers["wrong"] == 0
    assert math.isfinite(first.numbers["missed"])


class Oscillator(Sound):
    """A unit oscillator let go at x0, its steps explicit or semi-implicit."""

    def __init__(self, explicit=False):
        self.explicit = explicit

    def energy(self, x):
        place, speed, found = x[:, 0].clone(), torch.zeros(len(x)).double(), []
        for _ in range(400):
            force = -place
            speed, before = speed + 0.05 * force, speed
            place = place + 0.05 * (before if self.explicit else speed)
            found.append((place.square() + speed.square()) / 2)
        return torch.stack(found, dim=1)


def test_energy_that_rises_where_nothing_drives_is_a_failure():
    kept, added = (outcomes(Oscillator(explicit))["energy drift"] for explicit in (False, True))
    assert kept.outcome == "pass"
    assert 0.01 < kept.numbers["rise"] < 0.06  # of the order of the step, and not growing
    assert added.outcome == "fail"
    assert added.numbers["left"] == pytest.approx(1.0025**399, rel=0.01)  # explicit steps add dt^2 each
    assert outcomes(Sound())["energy drift"].outcome == "skip"
