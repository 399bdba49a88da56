"""What a check concludes: planted defects are named with their cause and place, healthy awkward functions pass."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from benchmarks.diagnosis.catalogue import defects, healthy_functions
from benchmarks.diagnosis.examine import examine
from benchmarks.diagnosis.planted import slab

import gradscape as gs
from gradscape.landscapes.checks import suite
from gradscape.landscapes.checks.causes import causes, recognise
from gradscape.landscapes.checks.examination import Share, could_be_missed, points_for
from gradscape.landscapes.checks.memory import memory_growth
from gradscape.landscapes.checks.regions import find_region
from gradscape.landscapes.checks.slopes import Judgement, Kind

TWO = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})


CASES = {case.name: case for case in [*defects(), *healthy_functions()]}
DEFECTS = """
    sign-torch-throw-2 factor-2-numpy-springs-10 region-numpy-cart-10-two region-jax-springs-10-5%
    detached-torch-cart-detached-10 sign-of-one-numpy-nozzle-3 too-long-jax-throw-2-1% permuted-numpy-cart-10-reversed
    clipped-numpy-springs-10 mean-over-the-batch-numpy-cart-10 nan-torch-reach-2 nan-numpy-cone-2 units-numpy-gas-2
    grain-numpy-tank-2 differences-numpy-waves-2 impact-torch-collide-2 late-torch-late-sign-2
"""
HEALTHY = """
    healthy-drag-torch-2 healthy-cubic-torch-2 healthy-maximum-torch-2 healthy-offset-1e9-torch-2 healthy-well-torch-2
    healthy-float32-inside-torch-2 healthy-tiny-torch-2 healthy-decades-torch-2 healthy-constant-torch-2
    healthy-one-torch-1 healthy-ripples-1e-3-torch-2 healthy-ripples-1e-6-jax-2 healthy-logistic-60-jax-2
    healthy-jump-torch-2 healthy-barrier-torch-2 healthy-dead-jax-2
"""


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    """Look for memory that grows but shortly."""
    monkeypatch.setattr(suite, "memory_growth", lambda objective, x, seconds: memory_growth(objective, x, seconds=0.01))


@pytest.mark.parametrize("name", DEFECTS.split())
def test_a_planted_defect_is_found_and_its_cause_and_place_named(name):
    found = examine(CASES[name])
    assert found.found, found.said
    assert found.cause, found.said
    assert found.place is not False, found.said


@pytest.mark.parametrize("name", HEALTHY.split())
def test_a_healthy_awkward_function_passes(name):
    found = examine(CASES[name])
    assert found.passed, found.said


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


def test_slabs_of_the_box_are_found_wherever_they_lie():
    """As many as are promised: a slab of 5 % lies between two points of a spread-out sample once in many."""
    for width, count, least in ((0.05, 12, 11), (0.2, 3, 3)):
        starts = np.linspace(-2, 3 - 5 * width, count)
        found = [not gs.check(slab((1.0, 0.0), start, start + 5 * width)).passed for start in starts]
        assert sum(found) >= least


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
