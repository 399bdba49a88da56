"""Advice: closed forms, cases that decide nothing and cases that decide all, and what is published."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import gradscape as gs
from gradscape.landscapes.measures.character import Character, measure_character
from gradscape.optim import advice
from gradscape.optim.advice import (
    EVALUATIONS,
    Case,
    Cases,
    Choice,
    choose,
    expected_ranks,
    hold_out,
    read_cases,
    score_held_out,
)
from gradscape.optim.registry import optimizer_class

SPACE = gs.ParameterSpace.box([f"x{k}" for k in range(5)], -3.0, 1.0)


def character(loss: Callable[[Tensor], Tensor], **more: float) -> Character:
    found = measure_character(gs.from_torch(loss, SPACE, name="known"), evaluations=EVALUATIONS).character
    return replace(found, **more)


def bowl(x: Tensor) -> Tensor:
    return ((x + 1) ** 2 * torch.arange(1, 6)).sum(dim=1)


def noise(x: Tensor) -> Tensor:
    """Return losses without any order, whose gradients are as large as they are wrong."""
    return torch.frac((x * torch.tensor([12989.8, 78233.1, 3571.3, 911.7, 60013.9])).sum(dim=1).sin() * 43758.5)


def made(families: int, tells: Callable[[int], bool], size: int = 12) -> list[Case]:
    """Return cases of two kinds; in those of which `tells` says so, by number, the kind is seen in its character."""
    rng, cases = np.random.default_rng(0), list[Case]()
    plain = character(bowl)
    for number in range(families * size):
        good = number % 2 == 0
        seen = good if tells(number) else bool(rng.integers(2))
        agreement = (0.99, 0.9, 0.5) if seen else (-0.3, 0.0, 0.1)
        one = replace(plain, agreement=agreement, coherence=float(rng.uniform()), across=float(seen))
        ranks = {"l-bfgs-b": 1.0, "turbo": 2.0} if good else {"l-bfgs-b": 2.0, "turbo": 1.0}
        cases.append(Case(f"case {number}", f"family {number // size}", False, (one,), ranks, ranks))
    return cases


def test_where_measures_tell_the_best_method_advice_is_always_right() -> None:
    found = score_held_out(hold_out(made(6, lambda number: True)))
    assert (found.cases, found.families) == (72, 6)
    assert (found.advised.value, found.best.value, found.single.value) == (1, 1, 1.5)
    assert found.helps


def test_where_measures_tell_nothing_it_says_that_there_is_no_evidence() -> None:
    found = score_held_out(hold_out(made(6, lambda number: False)))
    assert found.difference.low < 0 < found.difference.high
    assert not found.helps


def test_a_family_is_never_advised_by_its_own_cases() -> None:
    for one in hold_out(made(3, lambda number: True)):
        assert {case.family for case in one.near}.isdisjoint({one.case.family})


def test_a_choice_says_no_evidence_and_takes_the_best_single_method(monkeypatch: pytest.MonkeyPatch) -> None:
    cases = made(6, lambda number: False)
    worse = [replace(one, ranks={**one.ranks, "turbo": one.ranks["turbo"] + 0.1}) for one in cases]
    found = chosen(monkeypatch, worse, character(bowl))
    assert (found.method, found.by_cases) == ("l-bfgs-b", False)
    assert found.reason.startswith("advice by similar landscapes is not shown to beat one method everywhere")
    told = chosen(monkeypatch, made(6, lambda number: True), character(bowl, agreement=(-0.3, 0.0, 0.1), across=0.0))  # type: ignore[arg-type]
    assert (told.method, told.by_cases) == ("turbo", True)
    assert told.reason.startswith("it was best in 10 of the 10 nearest cases")


def chosen(monkeypatch: pytest.MonkeyPatch, cases: list[Case], of: Character) -> Choice:
    """Choose by cases that are scenes and, the same again, functions."""
    scenes = [replace(one, name=f"scene {one.name}", scene=True) for one in cases]
    monkeypatch.setattr(advice, "read_cases", lambda: Cases(500, 2.0, (*cases, *scenes)))
    advice.published_scores.cache_clear()
    try:
        return choose(of)
    finally:
        advice.published_scores.cache_clear()


def test_in_a_bowl_gradient_methods_are_expected_ahead_and_in_noise_they_are_not() -> None:
    """The nearest cases say that, whatever is advised."""
    in_bowl, in_noise = choose(character(bowl)), choose(character(noise))
    assert optimizer_class(next(iter(in_bowl.expected))).needs_grad
    assert in_bowl.expected["l-bfgs-b"] < in_bowl.expected["turbo"]
    assert not optimizer_class(next(iter(in_noise.expected))).needs_grad
    assert in_noise.expected["l-bfgs-b"] > in_noise.expected["turbo"]


def test_methods_that_cannot_search_are_not_chosen() -> None:
    found = choose(character(bowl), ["random", "cma-es", "bo"])
    assert set(found.expected) == {"random", "cma-es"}
    assert found.method in found.expected
    with pytest.raises(ValueError, match="there is no evidence on bo; choose from random, cma-es"):
        choose(character(bowl), ["bo"])


def test_measures_that_are_not_known_count_as_average() -> None:
    none = replace(character(bowl), across=math.nan, linear=math.nan, quadratic=math.nan, noise=math.nan)
    assert all(math.isfinite(one.distance) for one in choose(none).nearest)


def test_the_published_cases_are_whole() -> None:
    cases = read_cases().cases
    assert len({one.name for one in cases}) == len(cases) > 100
    assert sum(one.scene for one in cases) == 16
    assert len({one.family for one in cases}) == 14
    for one in cases:
        assert sum(one.ranks.values()) == pytest.approx(45, abs=0.1)
        assert len(one.characters) == 3
        assert {each.evaluations for each in one.characters} == {EVALUATIONS}
        assert np.isfinite(one.measures[0])


def test_what_the_page_on_advice_says_of_its_evidence_is_what_the_cases_say() -> None:
    """Sentences are written by hand: that there is no evidence, and which method is advised instead."""
    found = choose(character(bowl))
    assert not found.by_cases
    assert found.method == found.scores.scenes.method == "l-bfgs-b"
    assert (
        next(iter(expected_ranks([one for one in read_cases().cases if one.scene], ["random", "cma-es", "turbo"])))
        == "turbo"
    )
