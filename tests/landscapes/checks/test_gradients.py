"""Gradients: useless ones, those that grow with the episode, differ by mode or repeat, and are wrong in one place."""

import pytest
import torch

from gradscape.landscapes.checks.suite import Settings, check
from gradscape.landscapes.objective import Evaluation

from .test_suite import OneWrongSign, Sound, Spoiled, WrongWhere, failures, outcomes, refusing


class Rippled(Sound):
    """A right gradient of ripples that are shorter than an optimiser's step."""

    def spoil(self, x, found, grad):
        loss = found.loss + 1e-3 * torch.sin(3e4 * x).sum(dim=1)
        return Evaluation.from_results(loss, found.grad + 30 * torch.cos(3e4 * x) if grad else None)


def steep():
    return Spoiled(slope=lambda slope: 20 * slope)


def warnings(objective, **settings):
    return {name for name, found in outcomes(objective, **settings).items() if found.outcome == "warn"}


def test_a_right_gradient_that_does_not_hold_over_an_optimiser_s_step_is_a_warning():
    assert warnings(Sound()) == set()
    assert warnings(Rippled()) == {"usefulness"}
    assert failures(Rippled()) == set()


def test_a_gradient_that_grows_with_the_episode_alone_fails():
    assert failures(Sound(), horizons={1: Sound, 4: Sound}) == set()
    checked = outcomes(Sound(), horizons={1: Sound, 4: steep})
    assert {name for name, found in checked.items() if found.bad} == {"growth over horizons"}
    found = checked["growth over horizons"]
    assert found.why == "gradients grow although motions do not diverge: too steep at 3 of 3 points at 4x"
    assert outcomes(Sound(), horizons={1: refusing})["growth over horizons"].outcome == "skip"


def test_true_gradients_of_motions_that_part_are_not_too_steep():
    """Of sin(1e9 x), neighbours over any step of a difference have nothing to do with one another."""

    class Parting(Sound):
        def evaluate(self, x, *, grad=True):
            loss, slope = torch.sin(1e9 * x).sum(dim=1), 1e9 * torch.cos(1e9 * x)
            return Evaluation.from_results(loss, slope if grad else None)

    assert "growth over horizons" not in failures(Parting(), horizons={1: Parting, 2: Parting})


def test_forward_is_held_against_reverse():
    name = "forward against reverse"
    assert outcomes(Sound(), other_mode=Sound)[name].outcome == "pass"
    assert failures(Sound(), other_mode=OneWrongSign) == {name}
    assert outcomes(Sound(), other_mode=refusing)[name].figure == "not checked"


def test_a_wrong_gradient_at_a_special_place_is_said_with_what_it_should_be():
    found = outcomes(WrongWhere())["special places"]
    assert "at zero, by a, the gradient is 243, but the loss rises by 6 and 6 to either side" in found.why


@pytest.mark.parametrize("side", [0.0, 0.4, 1.0])
def test_at_a_kink_either_slope_will_do_and_nothing_beyond(side):
    def kinked(slope):
        class Kinked(Sound):
            def spoil(self, x, found, grad):
                push = found.grad + torch.where(x == 0, slope, x.sign()) if grad else None
                return Evaluation(found.loss + x.abs().sum(dim=1), push, found.status)

        return Kinked()

    assert outcomes(kinked(2 * side - 1))["special places"].outcome == "pass"
    assert outcomes(kinked(3 + side))["special places"].outcome == "fail"


def unsteady(share):
    """Return an objective whose repeats differ by a share of its gradients."""
    generator = torch.Generator().manual_seed(0)
    return Spoiled(slope=lambda slope: slope * (1 + share * torch.randn(slope.shape, generator=generator)))


def test_gradients_that_do_not_repeat_fail_and_may_repeat_less_exactly_than_losses():
    assert failures(unsteady(1e-4)) == {"determinism", "order of calls"}
    found = outcomes(unsteady(1e-7))["determinism"]
    assert found.outcome == "pass"
    assert found.numbers["limit"] < found.numbers["gradient"] < found.numbers["gradient_limit"]


def test_memory_that_runs_out_is_said_with_what_to_do():
    class Large(Sound):
        def evaluate(self, x, *, grad=True):
            if len(x) > 8:
                raise RuntimeError("Failed to allocate 123456 bytes on device 'cuda:0'")
            return super().evaluate(x, grad=grad)

    found = [finding for finding in check(Large(), Settings(power=0.3)) if finding.bad]
    assert found
    assert all("end other programs on the device" in finding.why for finding in found)
