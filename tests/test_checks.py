"""The rows of the table of checks in BENCHMARKS.md hold what `landscape check` said."""

import json
from pathlib import Path

import pytest
from benchmarks import checks
from benchmarks.checks import HEAD

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.conformance.suite import check
from gradscape.landscapes.space import ParameterSpace


def record() -> dict:
    space = ParameterSpace.box(("x", "y"), -1.0, 2.0)
    found = check(from_torch(lambda x: (x**3).sum(dim=1), space), points=4)
    plain = [{"check": one.check, "outcome": one.outcome, "numbers": one.numbers or {}} for one in found]
    return {"env": "cubic", "device": "cpu", "passed": True, "checks": plain}


def test_a_row_holds_what_a_check_said(tmp_path: Path) -> None:
    (tmp_path / "cubic-cpu.json").write_text(json.dumps(record()))
    (found,) = checks.rows(tmp_path)
    row = dict(zip(HEAD, found, strict=True))
    assert (row["environment"], row["device"], row["noise"]) == ("`cubic`", "cpu", "0")
    assert row["largest \\|grad\\| in the box"] == "1.2e+01"  # 3 x 2^2
    assert float(row["over 0.01 of the box"]) < 0.01
    assert row["finite up to"] == "none"  # it has no time step


def test_a_step_at_which_a_row_fails_is_not_finite() -> None:
    numbers = {"finite": 1.0, "non-finite": 1.0, "escaped": 0.0, "error": 0.0, "largest_gradient": 9.0}
    steps = [("dt 1x", numbers | {"non-finite": 0.0}), ("dt 2x", numbers), ("dt 4x", numbers | {"non-finite": 0.0})]
    made = record()
    made["checks"] += [{"check": name, "outcome": "pass", "numbers": numbers} for name, numbers in steps]
    row = dict(zip(HEAD, checks.row(made), strict=True))
    assert row["finite up to"] == "dt 4x"


def test_an_empty_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        checks.main([str(tmp_path)])
    assert "holds no records; `landscape check" in capsys.readouterr().err
