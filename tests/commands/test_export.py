"""`landscape export`: slices and runs as files that other programs read."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import gradscape
from gradscape.landscapes.export import SUFFIXES

from ..command import Run, make

READ = {"csv": pd.read_csv, "parquet": pd.read_parquet}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Leave a slice, a line and a run of the bouncing ball."""
    return make(
        tmp_path_factory.mktemp("made"),
        "slice bounce --dims 0 2 --resolution 5 --fidelity draft --device cpu --out cut",
        "bounce --axis y --resolution 6 --fidelity draft --device cpu --out line",
        "optimize bounce --method descents --budget 7 --fidelity draft --device cpu --out searched",
    )


@pytest.fixture
def results(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path, dirs_exist_ok=True)


@pytest.mark.parametrize("kind", list(READ))
def test_a_table_has_a_row_for_each_sample_with_its_place_loss_status_and_gradient(
    run: Run, results: Path, kind: str
) -> None:
    done = run.ok("export", "cut", "--to", kind)
    assert done.stderr == f"cut/slice{SUFFIXES[kind]}: 25 samples\n"
    table, slice_ = READ[kind](results / f"cut/slice{SUFFIXES[kind]}"), gradscape.open_slice(results / "cut").data
    gradients = [f"gradient by velocity {axis} [m²/(m/s)]" for axis in "xyz"]
    assert list(table) == ["velocity x [m/s]", "velocity z [m/s]", "loss [m²]", "status", *gradients]
    for row in table.to_dict("records"):
        node = slice_.sel(u=row["velocity x [m/s]"], v=row["velocity z [m/s]"])  # exactly: no digit is lost
        assert row["loss [m²]"] == float(node["loss"])
        assert [row[name] for name in gradients] == node["grad"].to_numpy().tolist()
        assert row["status"] == "ok"


@pytest.mark.parametrize("kind", list(READ))
def test_a_run_has_a_row_for_each_episode(run: Run, results: Path, kind: str) -> None:
    run.ok("export", "searched", "--to", kind, "--out", f"my{kind}")
    table, rows = READ[kind](results / f"my{kind}"), gradscape.open_run(results / "searched").data
    assert table["episode"].tolist() == [1, 2, 3, 4, 5, 6, 7]
    np.testing.assert_array_equal(table["loss [m²]"], rows["loss"])
    np.testing.assert_array_equal(table[[f"velocity {axis} [m/s]" for axis in "xyz"]], rows["x"])
    np.testing.assert_array_equal(table["gradient by velocity y [m²/(m/s)]"], rows["grad"].sel(dim="velocity y"))
    assert set(table["kind"]) == {"descent"}
    assert table["seconds [s]"].is_monotonic_increasing


@pytest.mark.parametrize(("folder", "store"), [("cut", "slice"), ("line", "slice"), ("searched", "run")])
def test_netcdf_keeps_arrays_names_and_units(run: Run, results: Path, folder: str, store: str) -> None:
    run.ok("export", folder, "--to", "netcdf")
    ours = {"slice": gradscape.open_slice, "run": gradscape.open_run}[store](results / folder).data
    with xr.open_dataset(results / folder / f"{store}.nc") as back:
        for name in ours.data_vars:
            np.testing.assert_array_equal(back[name], ours[name])
            assert back[name].attrs.get("units") == ours[name].attrs.get("units")
        assert back.attrs["identity"] == ours.attrs["identity"]
        assert list(back["unit"].to_numpy()) == ["m/s"] * 3


def test_what_is_there_is_not_replaced_unless_asked_for(run: Run, results: Path) -> None:
    (results / "mine.csv").write_text("precious")
    run.refuse(
        "export cut --out mine.csv",
        cwd=results,
        said="mine.csv exists already; write elsewhere with --out, or replace it with --force",
    )
    assert (results / "mine.csv").read_text() == "precious"
    run.ok("export cut --out mine.csv --force")
    assert len(pd.read_csv(results / "mine.csv")) == 25
