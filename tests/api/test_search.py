"""`gs.optimize`, `gs.race` and `gs.open_run`: what they promise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import gradscape as gs


def test_a_function_is_searched_in_memory_unless_it_is_given_a_folder(tmp_path: Path) -> None:
    bowl = gs.from_torch(lambda x: (x**2).sum(dim=1), gs.ParameterSpace.box(["a", "b"], -1.0, 1.0))
    found = gs.optimize(bowl, "cma-es", budget=60)
    assert found.best.loss < 1e-2
    assert found.folder is None
    kept = gs.optimize(bowl, "random", budget=2, out=tmp_path / "run")
    assert gs.open_run(tmp_path / "run").best.loss == kept.best.loss


def test_where_nothing_succeeded_there_is_no_best_and_it_is_said() -> None:
    failing = gs.from_torch(lambda x: x[:, 0] * torch.nan, gs.ParameterSpace.box(["a"], -1.0, 1.0))
    found = gs.optimize(failing, "random", budget=4)
    assert "none succeeded" in repr(found)
    with pytest.raises(ValueError, match="none of 4 succeeded"):
        _ = found.best


def test_a_number_of_threads_is_left_as_it_was(tmp_path: Path) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        gs.optimize("branin", "random", budget=2, out=tmp_path / "run")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.drawn
def test_a_race_has_a_table_a_picture_and_a_line(tmp_path: Path) -> None:
    found = gs.race("branin", "random", budget=6, seeds=2, out=tmp_path / "race")
    table = found.table()
    assert table["method"].tolist() == ["random"]
    assert table["best loss"][0] == np.mean([one.best.loss for one in found.runs["random"]])
    assert table["forward equivalents"][0] == 6
    assert found.plot()._repr_png_().startswith(b"\x89PNG")
    assert "random has the best mean rank" in repr(found)
    more = gs.race("branin", ("random", "cma-es"), budget=6, seeds=2, out=tmp_path / "race")
    assert more.methods == ["random", "cma-es"]


def test_a_race_tells_pairs_and_running_times(tmp_path: Path) -> None:
    found = gs.race("branin", ("random", "cma-es"), budget=6, seeds=2, best_known=0.25, out=tmp_path / "race")
    (pair,) = found.pairs().to_dict("records")
    finals = {method: [one.best.loss for one in runs] for method, runs in found.runs.items()}
    won = [a < b for a in finals["random"] for b in finals["cma-es"]]
    assert pair["probability"] == np.mean(won)
    assert pair["difference"] == pytest.approx(np.mean(finals["random"]) - np.mean(finals["cma-es"]))
    times = found.running_times()
    assert times.columns.tolist() == ["random", "cma-es"]
    assert (times.index[0], len(times)) == (0.25, 51)
    assert np.isinf(times.iloc[0]).all()  # less than any point of branin has
    with pytest.raises(ValueError, match="--best-known takes a finite number; got nan"):
        gs.race("branin", "random", budget=6, seeds=2, best_known=np.nan, out=tmp_path / "race")


@pytest.mark.parametrize(
    ("verb", "wrong", "said"),
    [
        (gs.optimize, {"method": "random", "budget": 0}, "optimize takes budget >= 1; got 0"),
        (gs.optimize, {"method": "random", "budget": 2.5}, "optimize takes a whole number for budget; got 2.5"),
        (gs.optimize, {"method": "random", "seed": -1}, "optimize takes seed >= 0; got -1"),
        (gs.race, {"methods": "random", "seeds": 0}, "race takes seeds >= 1; got 0"),
        (gs.race, {"methods": "random", "workers": 0}, "--workers takes a whole number of at least 1"),
    ],
)
def test_numbers_that_cannot_be_are_refused(
    verb: Any, wrong: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Words that cannot be are refused by the command in the same way."""
    monkeypatch.chdir(tmp_path)  # a checkout has a folder `out` after `make demo`
    with pytest.raises(ValueError, match=said):
        verb("branin", **wrong)
    assert not Path("out").exists()
