"""The report card: which verdict follows from what was measured, and where gradients oppose losses."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.draw.figures.multiples import opposing
from gradscape.landscapes.measures.card import Card, ClosedFormError, Grade, describe_share
from gradscape.landscapes.objective import Evaluation

from ..draw.figures.records import card, grade


@pytest.mark.parametrize(
    ("of", "verdict", "margin"),
    [
        (grade(judged=64), "passes", "no"),
        (grade(judged=58), "not decided", "not decided"),  # 59 points find a defect in 5 % of the box
        (grade(judged=0), "not decided", "not decided"),
        (grade(wrong=2, judged=64), "fails", "not decided"),  # 3 %, from 0.4 to 11 %
        (grade(wrong=3, judged=4096), "fails", "no"),
        (grade(wrong=21, judged=64), "fails", "yes"),
        (grade(missing="pip install it"), "not installed", "not decided"),
        (replace(grade(), share=None), "not decided", "not decided"),
    ],
)  # fmt: skip
def test_a_verdict_follows_from_what_was_measured(of: Grade, verdict: str, margin: str) -> None:
    assert (of.verdict, of.margin) == (verdict, margin)


def test_a_card_is_read_again_but_for_verdicts_which_are_computed() -> None:
    found = card()
    record = json.loads(json.dumps(to_json(found)))
    assert to_json(from_json(Card, record)) == record
    verdicts = ["passes", "not installed", "fails", "not decided"]
    assert [one["verdict"] for one in record["grades"]] == list(found.table()["verdict"]) == verdicts
    for one in record["grades"]:
        one["verdict"] = one["margin"] = "passes"
    again = from_json(Card, record)
    assert [one.verdict for one in again.grades] == verdicts
    assert again.tally() == "1 passes, 1 fails, 1 not decided, 1 not installed"
    assert (again.count("fails"), again.engines()) == (1, ["engine 1.2.3"])
    with pytest.raises(TypeError):
        from_json(Grade, {**record["grades"][0], "power": "much"})


def test_what_is_said_is_the_first_diagnosis_and_else_the_first_check_that_failed() -> None:
    wrong = grade(wrong=21)
    assert (wrong.cause, wrong.finding) == ("sign", "the gradient has the wrong sign at 21 of 64 points")
    undiagnosed = replace(wrong, diagnosis=None)
    assert undiagnosed.finding.startswith("gradient: wrong at 33 % (22 to 46 %) of 64 points: ")
    assert (grade().cause, grade().finding) == ("", "")
    assert grade(judged=16).unjudged == 0.75


def test_a_gradient_that_is_far_from_the_closed_form_may_be_right_of_the_program() -> None:
    far, near = (ClosedFormError(64, off, off, off, 0.0) for off in (0.4, 0.004))
    assert replace(grade(), closed_form=far).program_only
    assert not replace(grade(), closed_form=near).program_only
    assert not replace(grade(wrong=21), closed_form=far).program_only  # it is wrong of the program too


def evaluation(loss: list[float], grad: list[list[float]]) -> Evaluation:
    return Evaluation.from_results(torch.tensor(loss).double(), torch.tensor(grad).double())


def test_errors_against_a_closed_form_are_shares_of_its_gradient() -> None:
    exact = evaluation([0.0, 2.0, 1.0], [[1.0, 0.0], [0.0, 2.0], [3.0, 4.0]])
    found = evaluation([0.0, 2.0, 1.2], [[1.0, 0.1], [0.0, -2.0], [3.0, 4.0]])
    off = ClosedFormError.of(found, exact)
    assert (off.points, off.centre, off.median) == (3, pytest.approx(0.1), pytest.approx(0.1))
    assert 1.5 < off.upper < 2.0
    assert off.loss == 0.0
    assert ClosedFormError.of(replace(found, grad=None), exact) is None
    assert describe_share(ClosedFormError.of(exact, exact).median) == "none"
    lost = ClosedFormError.of(replace(exact, grad=exact.grad * torch.tensor([[torch.nan], [1.0], [1.0]])), exact)
    assert describe_share(lost.median) == "not finite"
    assert np.isnan(from_json(ClosedFormError, json.loads(json.dumps(to_json(lost)))).median)
    said = {134.1: "134 times", 1.51: "151 %", 0.013: "1 %", 2e-6: "0.0002 %", 1e-15: "none"}
    assert {value: describe_share(value) for value in said} == said


def test_gradients_oppose_the_slope_where_they_point_uphill() -> None:
    right, wrong = card().slices[0], card().slices[2]
    assert opposing(right)[1] == 0.0
    assert opposing(wrong)[1] == 1.0
    assert opposing(wrong)[0].sum() == 80  # all but the flat corner
    assert np.isnan(opposing(card().slices[3].__class__(**{**vars(right), "slope": 0 * right.slope}))[1])
