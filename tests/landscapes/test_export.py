"""Tables that other programs open: what no spreadsheet may run."""

import csv
from pathlib import Path

import pandas as pd
import pytest

import gradscape as gs
from gradscape.gallery.site.downloads import save_table
from gradscape.landscapes.export import quoted, save_as, unquoted
from gradscape.landscapes.foreign import read_points

SPACE = gs.ParameterSpace({"=cmd|' /C calc'!A0": (0, 1, "m"), "-k": (0, 1), "+1": (0, 1), "@y": (-2, -1)})


@pytest.mark.parametrize("cell", ["=1+1", "+x", "-x", "@SUM(A1)", "\t=1", "\r=1", "\n=1", "-1-1", "--1", "\t-1"])
def test_a_word_that_is_a_formula_is_quoted(cell: str) -> None:
    assert quoted(cell) == f"'{cell}"
    assert unquoted(quoted(cell)) == cell


@pytest.mark.parametrize("cell", ["", "x", "-1.5", "+2e-3", "-inf", "'x", " =x", -1.5, None])
def test_numbers_and_other_words_are_as_they_were(cell: object) -> None:
    assert quoted(cell) == cell
    assert not isinstance(cell, str) or unquoted(cell) == cell


def test_names_of_others_are_no_formulas_in_what_is_exported(tmp_path: Path) -> None:
    run = gs.optimize(gs.from_torch(lambda x: -x.sum(dim=-1), SPACE), "random", budget=3)
    save_as(run.data, tmp_path / "run.csv", "csv")
    with (tmp_path / "run.csv").open(newline="") as file:
        heading, *rows = csv.reader(file)
    assert heading[1:5] == ["'=cmd|' /C calc'!A0 [m]", "'-k", "+1", "'@y"]
    assert [float(row[4]) for row in rows] == run.data["x"].to_numpy()[:, 3].tolist()  # negative, and numbers
    assert list(read_points(tmp_path / "run.csv"))[1:5] == [*SPACE.labels]
    save_table([{"method": "=1+1", "-loss": -1.5, "more": {"a": ["@x", 1]}}], tmp_path / "league.csv")
    assert (tmp_path / "league.csv").read_text() == "method,'-loss,more a\n'=1+1,-1.5,'@x; 1\n"
    assert pd.read_csv(tmp_path / "league.csv")["'-loss"].tolist() == [-1.5]
