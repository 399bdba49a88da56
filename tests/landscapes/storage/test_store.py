import json
import shutil
import signal
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
import xarray as xr
from zarr.storage import ZipStore

from gradscape.landscapes.identity import StoreError, plane_of
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.storage.arrays import consolidate
from gradscape.landscapes.storage.paths import filling_path
from gradscape.landscapes.storage.records import read_json, write_record
from gradscape.landscapes.storage.store import SliceStore, open_slice

from ...processes import Instant, alone
from .stores import IDENTITY, PLANE, SPACE, chunks, evaluated, fill, finished, make, unpacked


def test_every_value_comes_back_at_its_own_coordinates(tmp_path):
    path = tmp_path / "deep" / "slice.zarr"
    fill(make(path))
    tiles = open_slice(path)
    finished(path)
    dataset = open_slice(path)
    assert dataset.identical(tiles)
    assert dataset["loss"].dims == ("v", "u")
    assert dataset["grad"].dims == ("v", "u", "dim")
    assert dataset["grad"].dtype == dataset["loss"].dtype == np.float64
    u, v = np.meshgrid(dataset["u"], dataset["v"])
    wanted = evaluated(PLANE.lift(torch.from_numpy(np.stack([u.ravel(), v.ravel()], axis=1))))
    np.testing.assert_array_equal(dataset["loss"], wanted.loss.reshape(8, 10))
    np.testing.assert_array_equal(dataset["grad"], wanted.grad.reshape(8, 10, 3))
    np.testing.assert_array_equal(dataset["status"], wanted.status.reshape(8, 10))


def test_the_file_says_what_it_holds_to_plain_xarray(tmp_path):
    finished(tmp_path / "s.zarr")
    with xr.open_zarr(ZipStore(tmp_path / "s.zarr.zip"), chunks=None) as raw:
        assert json.loads(raw.attrs["identity"])["options"] == {"steps": 3, "tilt": [0.1, 0.2]}
        assert json.loads(raw.attrs["provenance"])["command"] == "x"
        assert raw.attrs["title"] == "wave over x and y"
        assert raw.attrs["Conventions"].startswith("CF-")
        assert raw["u"].attrs == {"label": "x [m]", "long_name": "x", "units": "m"}
        assert raw["loss"].attrs["units"] == "J"
        assert list(raw["dim"].values) == ["x", "y", "z"]
        assert list(raw["unit"].values) == ["m", "m/s", ""]
        ours = open_slice(tmp_path / "s.zarr")
        for name in ours.variables:
            np.testing.assert_array_equal(raw[name], ours[name])
        assert raw.attrs == ours.attrs
        assert all((np.diff(raw[axis]) > 0).all() for axis in "uv")  # so that nearest samples and pictures are right
        near = raw["loss"].sel(u=-0.5, v=0.1, method="nearest")
        assert float(near) == float(ours["loss"].sel(u=near["u"], v=near["v"]))
        raw["loss"].plot()
    plt.close("all")
    assert plane_of(open_slice(tmp_path / "s.zarr")).record() == PLANE.record()


def attribute_values(dataset: xr.Dataset) -> list[object]:
    about = [dataset.attrs, *(one.attrs for one in dataset.variables.values())]
    values = [value for attrs in about for value in attrs.values()]
    return [one for value in values for one in (value if isinstance(value, list) else [value])]


def test_a_slice_goes_to_netcdf_and_back(tmp_path):
    finished(tmp_path / "s.zarr")
    ours = open_slice(tmp_path / "s.zarr")
    assert {type(value) for value in attribute_values(ours)} == {str, int}
    ours.to_netcdf(tmp_path / "s.nc")
    with xr.open_dataset(tmp_path / "s.nc") as back:
        np.testing.assert_array_equal(back["grad"], ours["grad"])
        assert plane_of(back).record() == PLANE.record()
        assert list(back["dim"].values) == ["x", "y", "z"]


def test_what_xarray_writes_of_a_slice_is_a_slice(tmp_path):
    store = fill(SliceStore.in_memory(PLANE, SPACE, identity=IDENTITY, provenance={"loss_unit": "J"}))
    ours = store.dataset()
    for name, indexed in (("plain", False), ("indexed", True)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of zarr, whose specification knows no index yet
            ours.to_zarr(tmp_path / f"{name}.zarr", consolidated=indexed)
        back = open_slice(tmp_path / f"{name}.zarr")
        xr.testing.assert_equal(back, ours)
        assert back.attrs == ours.attrs
    ours.isel(u=slice(1, None)).to_zarr(tmp_path / "cut.zarr", consolidated=False)
    with pytest.raises(StoreError, match=r"u is damaged \(it contradicts the store's identity"):
        open_slice(tmp_path / "cut.zarr")


def test_a_finished_slice_is_one_file_of_large_chunks_always_the_same_and_found_by_its_folder(tmp_path):
    path = tmp_path / "slice.zarr"
    fill(make(path))
    assert [file.name for file in tmp_path.iterdir()] == ["slice.filling"]
    tiles = len(chunks(filling_path(path)))
    assert open_slice(tmp_path).identical(open_slice(filling_path(path)))
    finished(path)
    assert [file.name for file in tmp_path.iterdir()] == ["slice.zarr.zip"]
    assert make(path).pending() == []
    assert make(path).coarse().identical(open_slice(path))
    assert open_slice(tmp_path).identical(open_slice(path))
    content, whole = (tmp_path / "slice.zarr.zip").read_bytes(), open_slice(path)
    assert len(chunks(unpacked(path))) == 4 < tiles
    assert open_slice(path).identical(whole)  # as earlier versions left it
    shutil.rmtree(tmp_path / "slice.zarr")
    finished(path)
    assert (tmp_path / "slice.zarr.zip").read_bytes() == content


def test_a_slice_that_is_not_complete_is_not_finished(tmp_path):
    store = make(tmp_path / "slice.zarr")
    fill(store, store.tiles()[:2])
    with pytest.raises(StoreError, match="not complete"):
        store.finish(store.dataset())
    assert len(make(tmp_path / "slice.zarr").pending()) == len(store.tiles()) - 2


def test_tiles_that_a_kill_left_beside_a_finished_slice_go(tmp_path):
    path = tmp_path / "slice.zarr"
    fill(make(path))
    shutil.copytree(filling_path(path), tmp_path / "kept")
    finished(path)
    (tmp_path / "kept").rename(filling_path(path))  # as if the process had been killed before they were removed
    whole = open_slice(path)
    assert make(path).pending() == []
    assert [file.name for file in tmp_path.iterdir()] == ["slice.zarr.zip"]
    assert open_slice(path).identical(whole)


def test_tiles_come_in_squares_and_the_coarse_picture_grows_with_them():
    store = SliceStore.in_memory(PLANE, SPACE)
    assert store.coarse() is None
    sizes = []
    for tile in store.tiles():
        fill(store, [tile])
        coarse = store.coarse()
        sizes.append((coarse.sizes["v"], coarse.sizes["u"]))
        assert (coarse["status"] != Status.MISSING).all()
        assert (np.diff(coarse["u"]) > 0).all()
    assert sizes == [(4, 4), (4, 4), (4, 4), (8, 8), (8, 8), (8, 10)]
    xr.testing.assert_identical(store.coarse(), store.dataset())


def test_a_line_has_one_axis_and_a_slice_without_gradients_has_none():
    line = Plane.through(SPACE, SPACE.center, ["y"], resolution=37)
    store = SliceStore.in_memory(line, SPACE, grad=False)
    for tile in store.tiles():
        store.write(tile, Evaluation.from_results(store.points(tile)[:, 1], None))
    dataset = store.dataset()
    assert "grad" not in dataset
    assert dataset["loss"].dims == ("u",)
    np.testing.assert_array_equal(dataset["loss"], dataset["u"])


def test_a_half_evaluated_tile_is_refused():
    store = SliceStore.in_memory(PLANE, SPACE)
    x = store.points(store.tiles()[0])
    good = evaluated(x)
    with pytest.raises(ValueError, match="grad=True"):
        store.write(store.tiles()[0], Evaluation(good.loss, None, good.status))
    with pytest.raises(ValueError, match="MISSING"):
        store.write(store.tiles()[0], Evaluation(good.loss, good.grad, torch.zeros(len(x), dtype=torch.int8)))
    assert store.pending() == store.tiles()


def test_a_store_of_another_format_is_refused(tmp_path):
    path = tmp_path / "s.zarr"
    make(path)
    header = filling_path(path) / "slice.json"
    write_record(header, read_json(header) | {"gradscape_slice": 99})
    with pytest.raises(StoreError, match="format 2"):
        make(path)


def test_threads_that_gather_layouts_warn_of_nothing(tmp_path):
    """Which warnings are shown is shared by threads: each that changes it for a while has to be alone."""
    stores = [finished(tmp_path / f"{number}.zarr").path for number in range(2)]
    with ThreadPoolExecutor(2) as threads:
        for _ in threads.map(lambda number: consolidate(unpacked(stores[number])), range(2)):
            pass


def finishing(path):
    store = make(path)
    store.finish(store.dataset())


@pytest.mark.e2e
def test_a_kill_at_any_instant_of_finishing_leaves_a_slice_whole(tmp_path):
    """Kill as the tiles are copied, as the copy takes its place, and in the middle of the tiles' removal."""
    whole = fill(SliceStore.in_memory(PLANE, SPACE, identity=IDENTITY)).dataset()
    fill(make(tmp_path / "0" / "slice.zarr"))
    shutil.copytree(tmp_path / "0", tmp_path / "filled")
    instants, places = alone(partial(finishing, tmp_path / "0" / "slice.zarr"), tmp_path).changes, set()
    for instant in range(1, instants + 1, 7):
        desk = shutil.copytree(tmp_path / "filled", tmp_path / str(instant))
        path = desk / "slice.zarr"
        assert alone(partial(finishing, path), tmp_path, Instant(instant)).returncode == -signal.SIGKILL
        places.add(frozenset(file.name for file in desk.iterdir() if not file.name.startswith(".")))
        left = make(path)
        assert left.pending() == []
        left.finish(left.dataset())
        for name in ("loss", "grad", "status"):
            np.testing.assert_array_equal(open_slice(path)[name], whole[name])
        assert [file.name for file in desk.iterdir() if not file.name.startswith(".")] == ["slice.zarr.zip"]
    assert places >= {frozenset({"slice.filling"}), frozenset({"slice.zarr.zip"})}
