"""`gs.overlay`: what it promises."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace as Named
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.text import Text

import gradscape as gs
from gradscape.jobs.foreign import tables_over
from gradscape.landscapes.export import save_as
from gradscape.landscapes.foreign import points_table

from ..command import make
from ..watches import Told


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a slice of Branin's function."""
    return make(tmp_path_factory.mktemp("sampled"), "slice branin --dims 0 1 --resolution 6 --out cut")


@pytest.fixture
def cut(sampled: Path, tmp_path: Path) -> gs.Slice:
    return gs.open_slice(shutil.copytree(sampled / "cut", tmp_path / "cut"))


def test_points_of_other_programs_lie_where_a_run_lies(cut: gs.Slice, tmp_path: Path) -> None:
    run = gs.optimize("branin", "random", budget=8, out=tmp_path / "run")
    expected = gs.overlay(cut, run, out=tmp_path / "over").runs[0]
    table = pd.DataFrame({"loss": run.data["loss"], "x1": run.data["x"][:, 1], "x0": run.data["x"][:, 0], "note": "a"})
    table = table.rename(columns=dict(zip(("x0", "x1"), map(str, run.data["dim"].to_numpy()), strict=True)))
    table.to_csv(tmp_path / "my points.csv", index=False)
    table.to_parquet(tmp_path / "points.parquet")
    for number, given in enumerate((table, tmp_path / "my points.csv", str(tmp_path / "points.parquet"))):
        laid = gs.overlay(cut, given, out=tmp_path / str(number))
        for name in ("u", "v", "distance", "outside", "beneath", "best"):
            np.testing.assert_allclose(laid.runs[0][name], expected[name], atol=1e-12)
        assert laid.runs[0].attrs["label"] == ("table", "my-points", "points")[number]
    both = gs.overlay(cut, [table, run], out=tmp_path / "both")
    assert [one.attrs["label"] for one in both.runs] == ["random-s0", "table"]


def test_what_export_writes_of_a_run_can_be_laid_over_a_slice(tmp_path: Path) -> None:
    cut = gs.slice("bounce", (0, 1), resolution=4, out=tmp_path / "cut", device="cpu")
    run = gs.optimize("bounce", "random", budget=4, out=tmp_path / "run", device="cpu")
    save_as(run.data, tmp_path / "run.csv", "csv")
    laid = gs.overlay(cut, tmp_path / "run.csv", out=tmp_path / "over")
    np.testing.assert_allclose(laid.runs[0]["x"], run.data["x"])
    np.testing.assert_allclose(laid.runs[0]["loss"], run.data["loss"])


def test_a_point_without_a_loss_has_failed(cut: gs.Slice, tmp_path: Path) -> None:
    first, second = map(str, cut.data["dim"].to_numpy())
    table = pd.DataFrame({first: [0.0, 1.0, 2.0], second: [3.0, 4.0, 500.0], "loss": [1.0, None, np.inf]})
    laid = gs.overlay(cut, table, out=tmp_path / "over")
    assert (laid.summary.points, laid.summary.failed, laid.summary.outside) == (3, 2, 1)


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"a": [1.0], "loss": [1.0]}, "has no column"),
        ({0: [1.0], 1: [1.0]}, "has no column 'loss'"),
        ({0: ["failed"], 1: [1.0], "loss": [1.0]}, "the column 'x0' of table contains no numbers: row 0 has 'failed'"),
        ({0: [1.0, 2.0], 1: [1.0, 2.0], "loss": ["low", "high"]}, "contains no numbers: row 0 has 'low'"),
        ({0: [1.0, None], 1: [None, 2.0], "loss": [1.0, 2.0]}, "each of its 2 rows lacks a number in column x0, x1"),
        ({0: [], 1: [], "loss": []}, "has no point: there is no row of numbers below its heading"),
        ({0: ["m"], 1: ["m"], "loss": ["J"]}, "has no point: there is no row of numbers below its heading"),
        ({0: [1.0], 1: [1.0], "params_x0": [1.0], "loss": [1.0]}, "'x0' .column 1. and 'params_x0' .column 3."),
    ],
)
def test_a_table_that_lacks_something_is_refused(
    cut: gs.Slice, columns: dict[object, list[object]], said: str, tmp_path: Path
) -> None:
    names = dict(enumerate(map(str, cut.data["dim"].to_numpy())))
    with pytest.raises(ValueError, match=said):
        gs.overlay(cut, pd.DataFrame(columns).rename(columns=names), out=tmp_path / "over")
    assert not (tmp_path / "over").exists()


@pytest.mark.parametrize("name", ["none.csv", "none.parquet"])
def test_files_that_are_no_tables_are_refused(cut: gs.Slice, name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no table of points"):
        gs.overlay(cut, tmp_path / name)
    (tmp_path / name).write_bytes(b"\xff\x00\x01")
    with pytest.raises(ValueError, match=r"cannot be read as a table|has no column"):
        gs.overlay(cut, tmp_path / name)
    with pytest.raises(ValueError, match="overlay takes runs"):
        gs.overlay(cut, 3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="--plane takes pca"):
        gs.overlay(cut, tmp_path / name, plane="tsne")  # type: ignore[arg-type]


def test_a_study_of_optuna_is_laid_over_a_slice(cut: gs.Slice, tmp_path: Path) -> None:
    optuna = pytest.importorskip("optuna")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    env, names = gs.make("branin"), tuple(map(str, cut.data["dim"].to_numpy()))
    sides = list(zip(names, env.space.lower.tolist(), env.space.upper.tolist(), strict=True))

    def loss(trial: Any) -> float:
        x = [trial.suggest_float(*side) for side in sides]
        if trial.number == 2:
            raise optuna.TrialPruned
        return float(env.evaluate(torch.tensor([x], dtype=torch.float64), grad=False).loss[0])

    study = optuna.create_study(study_name="of branin", sampler=optuna.samplers.RandomSampler(seed=0))
    study.optimize(loss, n_trials=6)
    laid = gs.overlay(cut, study, out=tmp_path / "over")
    assert (laid.summary.points, laid.summary.failed) == (6, 1)
    assert laid.runs[0].attrs["label"] == "optuna-of-branin"
    np.testing.assert_allclose(float(laid.runs[0]["best"][-1]), study.best_value)
    frame = study.trials_dataframe()
    frame.to_csv(tmp_path / "trials.csv")
    going = pd.concat([frame, frame.tail(1).assign(state="RUNNING", value=-1e9)], ignore_index=True)
    for given in (frame, tmp_path / "trials.csv", study.trials_dataframe(multi_index=True), going):
        again = gs.overlay(cut, given, out=tmp_path / "again")
        for name in ("x", "loss", "status"):
            np.testing.assert_array_equal(again.runs[0][name], laid.runs[0][name])
    with pytest.raises(ValueError, match="has the directions MINIMIZE, MAXIMIZE; a loss is a single value"):
        gs.overlay(cut, optuna.create_study(directions=["minimize", "maximize"]))
    with pytest.raises(ValueError, match="study 'none' has no trial yet"):
        gs.overlay(cut, optuna.create_study(study_name="none"))


def test_values_that_a_study_maximises_are_negated_and_its_name_says_so(
    cut: gs.Slice, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    optuna = pytest.importorskip("optuna")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(study_name="gain", direction="maximize", sampler=optuna.samplers.RandomSampler(seed=0))
    study.optimize(lambda trial: trial.suggest_float("x0", 0, 1) + trial.suggest_float("x1", 0, 1), n_trials=3)
    told = Told()
    (table,) = tables_over(cut, [study], told)
    np.testing.assert_array_equal(table["loss"], -study.trials_dataframe()["value"])
    assert told.lines == ["optuna-gain maximises: its values are negated, so that a smaller loss is better"]
    laid = gs.overlay(cut, study, out=tmp_path / "over")
    assert laid.runs[0].attrs["label"] == "optuna-gain (negated)"
    assert "optuna-gain (negated): " in " ".join(text.get_text() for text in laid.plot().findobj(Text))
    assert not capfd.readouterr().err  # a recording takes any name


COMMAS = "X0;x1;LOSS;note\n[m];[m];[J];\n1,5;2,25;3,5;a\n\n1,5;failed;3;b\n2,5;;1e0;\n-0,5;1;failed;c;;\n;;;\n"


def test_a_table_as_a_spreadsheet_writes_it_is_read(cut: gs.Slice, tmp_path: Path) -> None:
    """It has other capitals, a row of units, decimal commas, and rows without a number."""
    path, told = tmp_path / "sheet.csv", Told()
    path.write_bytes(COMMAS.encode("utf-8-sig"))
    (table,) = tables_over(cut, [path], told)
    np.testing.assert_array_equal(table["x"], [[1.5, 2.25], [-0.5, 1.0]])
    np.testing.assert_array_equal(table["loss"], [3.5, np.nan])
    assert told.lines == [
        "sheet: row 2 contains units ([m], [m], [J]) and is skipped",
        "sheet: 2 of 4 rows skipped: no number in column x1",
    ]
    laid = gs.overlay(cut, path, out=tmp_path / "over")
    assert "2 points: 0 outside the map, 1 failed, 2 rows skipped" in repr(laid)
    path.write_text("x0,x1,loss\n1,2,3,4\n")
    with pytest.raises(ValueError, match="row 2 has 4 cells, the heading 3"):
        gs.overlay(cut, path)
    path.write_text("x0,x0,x1,loss\n1,1,2,3\n")
    with pytest.raises(ValueError, match=r"several columns for 'x0': 'x0' \(column 1\) and 'x0' \(column 2\)"):
        gs.overlay(cut, path)
    for nothing, said in (("", "it is empty"), ("x0,x1,loss\n", "sheet has no point")):
        path.write_text(nothing)
        with pytest.raises(ValueError, match=said):
            gs.overlay(cut, path)


def test_capitals_tell_parameters_apart_where_both_are_there(cut: gs.Slice) -> None:
    space = gs.ParameterSpace({"k": (0, 1), "K": (0, 1)})
    dataset = cut.data.assign_coords(dim=["k", "K"])
    table = points_table(pd.DataFrame({"K": [0.25], "k": [0.5], "loss": [1.0]}), dataset, space, "both")
    np.testing.assert_array_equal(table["x"], [[0.5, 0.25]])
    with pytest.raises(ValueError, match="both has no column 'k'"):
        points_table(pd.DataFrame({"K": [0.25], "loss": [1.0]}), dataset, space, "both")


def experiment_of_ax(names: tuple[str, ...], *, minimize: bool = True) -> Any:
    """What Ax 1.3.1 has of an experiment of five trials: one is measured twice, one failed and one continues."""
    ends = ("COMPLETED", "COMPLETED", "FAILED", "COMPLETED", "RUNNING")
    points = gs.make("branin").space.uniform(len(ends), seed=3).tolist()
    arms = [Named(name=f"{n}_0", parameters=dict(zip(names, x, strict=True))) for n, x in enumerate(points)]
    trials = {n: Named(status=Named(name=end), arms=[arms[n]]) for n, end in enumerate(ends)}
    measured = pd.DataFrame(
        [("0_0", "time", 1.0), ("0_0", "miss", 9.0), ("0_0", "miss", 4.0), ("1_0", "miss", 2.0), ("3_0", "miss", 8.0)],
        columns=["arm_name", "metric_name", "mean"],
    )
    objective = Named(metric_names=["miss"], minimize=minimize)
    held = {"optimization_config": Named(objective=objective), "lookup_data": lambda: Named(df=measured)}
    return Named(name="of branin", trials=trials, **held)


def test_an_experiment_of_ax_and_its_client_are_laid_over_a_slice(cut: gs.Slice, tmp_path: Path) -> None:
    names = tuple(map(str, cut.data["dim"].to_numpy()))
    experiment = experiment_of_ax(names)
    for number, given in enumerate((experiment, Named(_experiment=experiment), Named(experiment=experiment))):
        laid = gs.overlay(cut, given, out=tmp_path / f"over-{number}")
        assert (laid.summary.points, laid.summary.failed) == (4, 1)
        assert laid.runs[0].attrs["label"] == "ax-of-branin"
        np.testing.assert_array_equal(laid.runs[0]["best"], [4.0, 2.0, 2.0, 2.0])
    laid = gs.overlay(cut, experiment_of_ax(names, minimize=False), out=tmp_path / "most")
    assert laid.runs[0].attrs["label"] == "ax-of-branin (negated)"
    np.testing.assert_array_equal(laid.runs[0]["best"], [-4.0, -4.0, -4.0, -8.0])
    experiment.trials.clear()
    with pytest.raises(ValueError, match="Ax's experiment 'of branin' has no ended trial"):
        gs.overlay(cut, experiment)
