"""Gradients at special places: what is said of wrong ones, and what passes at a kink."""

import pytest
import torch

from gradscape.landscapes.objective import Evaluation

from .test_suite import Sound, WrongWhereOneIsZero, outcomes


def test_a_wrong_gradient_at_a_special_place_is_said_with_what_it_should_be():
    found = outcomes(WrongWhereOneIsZero())["special places"]
    assert "at a zero, by a, the gradient is" in found.figure or "at zero, by a, the gradient is" in found.figure
    assert "the loss rises by" in found.figure


@pytest.mark.parametrize("side", [0.0, 0.4, 1.0])
def test_at_a_kink_either_slope_will_do_and_nothing_beyond(side):
    def kinked(slope):
        class Kinked(Sound):
            def evaluate(self, x, *, grad=True):
                found = super().evaluate(x, grad=grad)
                kink = x.abs().sum(dim=1)
                push = torch.where(x == 0, slope, x.sign()) if grad else None
                return Evaluation(found.loss + kink, None if push is None else found.grad + push, found.status)

        return Kinked()

    assert outcomes(kinked(2 * side - 1))["special places"].outcome == "pass"
    assert outcomes(kinked(3 + side))["special places"].outcome == "fail"
