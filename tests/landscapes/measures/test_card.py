"""The report card: what is said of an engine, and where its gradients oppose its losses."""

import json

import numpy as np
import pytest

from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.draw.figures.multiples import opposing
from gradscape.landscapes.measures.card import Card, Grade, count_outcomes, first_finding

from ..draw.figures.records import card


def checked(*ends: str) -> list[dict[str, str]]:
    return [{"check": f"check {n}", "outcome": end, "figure": "3 of 4", "why": ""} for n, end in enumerate(ends)]


def test_the_first_failure_is_what_is_said_and_else_the_first_warning() -> None:
    assert first_finding(checked("pass", "skip")) == ""
    assert first_finding(checked("pass", "warn", "warn")) == "check 1: 3 of 4"
    assert first_finding(checked("warn", "fail", "fail", "unexpected")) == "check 1: 3 of 4 (and 2 more)"
    assert count_outcomes(checked("pass", "warn", "pass")) == {"pass": 2, "warn": 1}


def test_gradients_oppose_the_slope_where_they_point_uphill() -> None:
    right, wrong = card().slices[0], card().slices[2]
    assert opposing(right)[1] == 0.0
    assert opposing(wrong)[1] == 1.0
    assert opposing(wrong)[0].sum() == 80  # all but the flat corner
    assert np.isnan(opposing(card().slices[3].__class__(**{**vars(right), "slope": 0 * right.slope}))[1])


def test_a_card_is_read_again_as_it_was_written() -> None:
    found = card()
    again = from_json(Card, json.loads(json.dumps(to_json(found))))
    assert to_json(again) == to_json(found)
    assert (again.failed, again.engines()) == (1, ["engine 1.2.3"])
    assert list(found.table()["outcome"]) == ["passes", "not installed", "fails", "passes"]


@pytest.mark.parametrize("change", [{"outcome": "good"}, {"dims": 3}, {"counts": {"pass": "many"}}, {"engine": None}])
def test_a_record_of_something_else_is_refused(change: dict[str, object]) -> None:
    record = to_json(card())["grades"][0]
    with pytest.raises(Exception, match=r".+"):
        from_json(Grade, {**record, **change})
