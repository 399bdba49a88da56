"""Searches that the gallery keeps."""

from pathlib import Path

import xarray as xr

from gradscape.envs.adapters import from_numpy
from gradscape.gallery.records import open_run, save_run
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.search import search

SPACE = ParameterSpace.box(["x", "y"], -1.0, 1.0)


def test_a_run_is_one_file_and_comes_back(tmp_path: Path) -> None:
    table = search(from_numpy(lambda x: (x**2).sum(axis=1), SPACE), "random", budget=7).dataset()
    save_run(table, tmp_path / "random-0.zarr.zip")
    again = open_run(tmp_path / "random-0.zarr.zip")
    xr.testing.assert_equal(again, table)
    assert again.attrs == table.attrs
    assert [file.name for file in tmp_path.iterdir()] == ["random-0.zarr.zip"]
