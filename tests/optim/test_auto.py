"""The method `auto`: what it measures counts, the method it takes begins with it, and a run goes on as any other."""

from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.jobs.search import make_optimizer
from gradscape.landscapes.measures.character import measure_character
from gradscape.optim import advice
from gradscape.optim.advice import raced_methods
from gradscape.optim.base import Kind
from gradscape.optim.methods import auto
from gradscape.optim.search import search

from .states import restored

SPACE = gs.ParameterSpace.box(("a", "b", "c"), -3.0, 1.0)
MEASURED = 20


def wavy(x: torch.Tensor) -> torch.Tensor:
    return ((x + 1) ** 2).sum(dim=1) + torch.cos(3 * x).sum(dim=1)


WAVY = gs.from_torch(wavy, SPACE, name="wavy")


def took(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """Let a method be chosen, whatever the evidence."""
    chosen = advice.choose
    monkeypatch.setattr(auto, "choose", lambda character, able: chosen(character, [method]))


def searched(budget: int, seed: int = 0, **options: int) -> gs.Run:
    made = make_optimizer("auto", WAVY, seed=seed, options={"evaluations": MEASURED, **options})
    return search(WAVY, made, budget=budget, gradient_cost=2.0).read()


def test_what_it_measures_are_the_points_of_the_advice_and_count() -> None:
    run = searched(60, seed=4)
    kinds = run.data["kind"].to_numpy()
    assert len(kinds) == 60
    assert (kinds[:MEASURED] == Kind.MEASUREMENT).all()
    assert (kinds[MEASURED:] != Kind.MEASUREMENT).all()
    found = measure_character(WAVY, evaluations=MEASURED, seed=4)
    np.testing.assert_allclose(run.data["x"][:MEASURED], found.x, atol=1e-12)
    choice = advice.choose(found.character)
    assert run.remark == f"auto chose {choice.method}: {choice.reason}"
    assert run.remark in repr(run)


@pytest.mark.parametrize("method", raced_methods())
def test_every_method_begins_with_what_was_measured(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    took(monkeypatch, method)
    made = make_optimizer("auto", WAVY, options={"evaluations": MEASURED})
    told = []
    while made.inner is None:
        proposal = made.ask()
        found = WAVY.evaluate(proposal.x, grad=proposal.grad)
        made.tell(proposal.x, found)
        told += list(zip(proposal.x, found.loss.tolist(), strict=True))
    best = min(told, key=lambda one: one[1])[0]
    if method in ("l-bfgs-b", "descents", "adam"):
        torch.testing.assert_close(made.ask().x[0], best)
    elif method in ("cma-es", "cma-es-gradient"):
        mean = np.asarray(made.inner.strategy.gp.pheno(made.inner.strategy.mean))
        torch.testing.assert_close(SPACE.from_unit(torch.from_numpy(mean + 1) / 2), best)
    elif method != "random":
        assert len(made.inner.surrogate.loss) == MEASURED
        assert made.ask().kind != Kind.RANDOM


@pytest.mark.parametrize("method", raced_methods())
def test_a_run_that_is_written_and_read_goes_on_bit_for_bit(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    took(monkeypatch, method)
    plain, kept = (make_optimizer("auto", WAVY, seed=3, options={"evaluations": MEASURED}) for _ in range(2))
    for _ in range(6):
        asks = [one.ask() for one in (plain, kept)]
        assert torch.equal(asks[0].x, asks[1].x)
        for one, ask in zip((plain, kept), asks, strict=True):
            one.tell(ask.x, WAVY.evaluate(ask.x, grad=ask.grad))
        kept = restored(kept, WAVY)
    assert kept.remark == plain.remark != ""


def test_a_run_is_continued_to_a_larger_budget_as_if_it_had_had_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    took(monkeypatch, "adam")
    options = {"evaluations": MEASURED}
    whole = gs.optimize("branin", "auto", budget=220, method_options=options, out=tmp_path / "whole")
    gs.optimize("branin", "auto", budget=200, method_options=options, out=tmp_path / "parts")
    parts = gs.optimize("branin", "auto", budget=220, method_options=options, out=tmp_path / "parts")
    assert parts.data["x"].equals(whole.data["x"])
    assert parts.remark == whole.remark
    assert gs.open_run(tmp_path / "parts").remark == whole.remark


def test_it_races_with_others_and_says_what_it_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    took(monkeypatch, "adam")
    found = gs.race(
        "branin", ["random", "auto"], budget=200, seeds=2, method_options={"auto": {"evaluations": MEASURED}},
        out=tmp_path / "race",
    )  # fmt: skip
    assert [run.remark[:11] for run in found.runs["auto"]] == ["auto chose "] * 2
    assert not any(run.remark for run in found.runs["random"])


def test_a_budget_is_refused_of_which_measures_are_more_than_a_tenth(tmp_path: Path) -> None:
    said = "auto first measures 50 episodes, at most a tenth of the budget; got a budget of 300"
    for call in (gs.optimize, lambda *given, **named: gs.race(given[0], [given[1]], **named)):
        with pytest.raises(ValueError, match=f"{said}: use 500 or more, or --option evaluations=30"):
            call("branin", "auto", budget=300, out=tmp_path / "refused")
    with pytest.raises(ValueError, match="got a budget of 40: use 500 or more, or name a method"):
        gs.optimize(WAVY, "auto", budget=40)
    assert not (tmp_path / "refused").exists()


def test_where_every_episode_fails_it_still_searches() -> None:
    failing = gs.from_torch(lambda x: x[:, 0] * torch.nan, SPACE, name="failing")
    made = make_optimizer("auto", failing, options={"evaluations": MEASURED})
    run = search(failing, made, budget=30, gradient_cost=1.0).read()
    assert len(run.data["loss"]) == 30
    assert run.remark.startswith("auto chose ")


def test_one_parameter_is_searched_by_a_method_that_can() -> None:
    line = gs.from_torch(lambda x: (x[:, 0] + 1) ** 2, gs.ParameterSpace({"x": (-3, 1)}), name="line")
    run = search(line, make_optimizer("auto", line, options={"evaluations": MEASURED}), budget=40, gradient_cost=1.0)
    assert run.read().best.loss < 1e-6
