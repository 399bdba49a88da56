"""Gradients that are right and useless, that grow with the episode alone, and that two modes give differently."""

import torch

from gradscape.landscapes.objective import Evaluation

from .test_suite import OneWrongSign, Sound, failures, outcomes, refusing


class Rippled(Sound):
    """A right gradient of ripples that are shorter than an optimiser's step."""

    def evaluate(self, x, *, grad=True):
        found = super().evaluate(x, grad=grad)
        loss = found.loss + 1e-3 * torch.sin(3e4 * x).sum(dim=1)
        return Evaluation.from_results(loss, found.grad + 30 * torch.cos(3e4 * x) if grad else None)


class TenfoldGradient(Sound):
    def slope(self, slope):
        return 20 * slope


def warnings(objective, **settings):
    return {name for name, found in outcomes(objective, **settings).items() if found.outcome == "warn"}


def test_a_right_gradient_that_does_not_hold_over_an_optimiser_s_step_is_a_warning():
    assert warnings(Sound()) == set()
    assert warnings(Rippled()) == {"an optimiser's step"}
    assert failures(Rippled()) == set()


def test_a_gradient_that_grows_with_the_episode_alone_fails():
    assert failures(Sound(), horizons={1: Sound, 4: Sound}) == set()
    assert failures(Sound(), horizons={1: Sound, 4: TenfoldGradient}) == {"growth over horizons"}
    found = outcomes(Sound(), horizons={1: Sound, 4: TenfoldGradient})["growth over horizons"]
    assert found.why == "gradients grow where motions do not part: too steep at 3 of 3 points at 4x"
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
