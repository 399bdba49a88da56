import json
import os
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape.landscapes.identity import StoreError, StoreMismatchError
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.store import SliceStore, open_slice, pack, plane_of

from ..processes import Instant, alone

SPACE = ParameterSpace(
    ("x", "y", "z"), -torch.ones(3).double(), torch.tensor([1.0, 2.0, 3.0]).double(), ("m", "m/s", "")
)
PLANE = Plane.through(SPACE, SPACE.center, ["x", "y"], resolution=(10, 8))
IDENTITY = {"objective": "wave", "options": {"steps": 3, "tilt": (0.1, 0.2)}, "device": "cpu"}


def make(path: Path, **changes) -> SliceStore:
    settings = {"plane": PLANE, "space": SPACE, "identity": IDENTITY, "provenance": {"command": "x", "loss_unit": "J"}}
    return SliceStore.open_or_create(path, **settings | changes)


def evaluated(x: torch.Tensor) -> Evaluation:
    return Evaluation.judged(torch.where(x[:, 0] > 0.8, torch.nan, x.sum(dim=1)), 2 * x)


def fill(store: SliceStore, tiles=None) -> SliceStore:
    for tile in store.tiles() if tiles is None else tiles:
        store.write(tile, evaluated(store.points(tile)))
    return store


def chunks(path: Path) -> list[Path]:
    return sorted(
        file for name in ("loss", "grad", "status") for file in (path / name / "c").rglob("*") if file.is_file()
    )


def test_every_value_comes_back_at_its_own_coordinates(tmp_path):
    path = tmp_path / "deep" / "slice.zarr"
    fill(make(path))
    dataset = open_slice(path)
    assert dataset["loss"].dims == ("v", "u")
    assert dataset["grad"].dims == ("v", "u", "dim")
    assert dataset["grad"].dtype == dataset["loss"].dtype == np.float64
    assert (np.diff(dataset["u"]) > 0).all()
    assert (np.diff(dataset["v"]) > 0).all()
    u, v = np.meshgrid(dataset["u"], dataset["v"])
    wanted = evaluated(PLANE.lift(torch.from_numpy(np.stack([u.ravel(), v.ravel()], axis=1))))
    np.testing.assert_array_equal(dataset["loss"], wanted.loss.reshape(8, 10))
    np.testing.assert_array_equal(dataset["grad"], wanted.grad.reshape(8, 10, 3))
    np.testing.assert_array_equal(dataset["status"], wanted.status.reshape(8, 10))


def test_the_file_says_what_it_holds_to_anyone_who_opens_it(tmp_path):
    fill(make(tmp_path / "s.zarr"))
    with xr.open_zarr(tmp_path / "s.zarr", chunks=None) as raw:
        assert raw.attrs["identity"]["options"] == {"steps": 3, "tilt": [0.1, 0.2]}
        assert raw.attrs["provenance"]["command"] == "x"
        assert raw["u"].attrs == {"label": "x [m]", "long_name": "x", "units": "m"}
        assert raw["loss"].attrs["units"] == "J"
        assert list(raw["dim"].values) == ["x", "y", "z"]
        xr.testing.assert_equal(raw["loss"].sortby(["u", "v"]), open_slice(tmp_path / "s.zarr")["loss"])
    assert plane_of(open_slice(tmp_path / "s.zarr")).record() == PLANE.record()


def test_a_nan_result_is_finished_and_not_missing(tmp_path):
    store = make(tmp_path / "s.zarr")
    tile = store.tiles()[0]
    count = store.count(tile)
    nan = torch.full((count,), torch.nan).double()
    store.write(tile, Evaluation.judged(nan, nan[:, None].expand(-1, 3)))
    assert tile not in store.pending()
    status = store.dataset()["status"].to_numpy()
    assert (status == Status.NONFINITE).sum() == count
    assert (status == Status.MISSING).sum() == status.size - count


@pytest.mark.parametrize("damage", ["truncated", "removed", "altered"])
def test_a_damaged_chunk_costs_exactly_its_tile(tmp_path, damage):
    path = tmp_path / "s.zarr"
    small = {"plane": Plane.through(SPACE, SPACE.center, ["x", "y"], resolution=(7, 5))}
    store = fill(make(path, **small))
    whole = open_slice(path)
    for file in chunks(path):
        sound = file.read_bytes()
        torn = {"truncated": sound[: len(sound) // 2], "altered": sound[:-1] + bytes([sound[-1] ^ 1])}
        file.unlink() if damage == "removed" else file.write_bytes(torn[damage])
        index = tuple(map(int, file.relative_to(path).parts[2:4]))
        pending = make(path, **small).pending()
        assert [tile.index for tile in pending] == [index]
        seen = open_slice(path)["status"].to_numpy()
        assert (seen == Status.MISSING).sum() == store.count(pending[0])
        fill(store, pending)
        assert file.read_bytes() == sound
    xr.testing.assert_identical(open_slice(path), whole)


def test_a_tile_without_its_status_is_not_there_yet(tmp_path):
    path = tmp_path / "s.zarr"
    store = fill(make(path))
    (path / "status" / "c" / "0" / "0").unlink()
    assert [tile.index for tile in store.pending()] == [(0, 0)]
    dataset = store.dataset()
    assert np.isnan(dataset["loss"].values[dataset["status"].values == Status.MISSING]).all()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"identity": IDENTITY | {"device": "cuda"}}, r"\(device: wanted 'cuda', found 'cpu'\)"),
        ({"identity": {**IDENTITY, "options": {"steps": 4, "tilt": (0.1, 0.2)}}}, "options.steps: wanted 4, found 3"),
        ({"identity": {"objective": "wave", "device": "cpu"}}, "options.steps: wanted none, found 3"),
        ({"grad": False}, "gradients: wanted False, found True"),
        ({"plane": Plane.through(SPACE, SPACE.center, ["x", "y"], resolution=8)}, r"plane.resolution\[0\]: wanted 8"),
        ({"plane": Plane.through(SPACE, SPACE.lower, ["x", "y"], resolution=(10, 8))}, r"plane.origin\[2\]"),
    ],
)
def test_other_settings_are_refused_by_name_and_harm_nothing(tmp_path, changes, said):
    path = tmp_path / "s.zarr"
    fill(make(path))
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    with pytest.raises(StoreMismatchError, match=said) as error:
        make(path, **changes)
    assert "--out" in str(error.value)
    assert "--force" in str(error.value)
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


def test_what_is_no_slice_store_is_never_touched(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").write_text("five years")
    (tmp_path / "file").write_text("five years")
    for path in (tmp_path / "folder", tmp_path / "file"):
        with pytest.raises(StoreError, match="no slice store"):
            make(path)
        for overwrite in (False, True):
            with pytest.raises(StoreError):
                SliceStore.create(path, PLANE, SPACE, identity=IDENTITY, overwrite=overwrite)
    assert (tmp_path / "folder" / "thesis.tex").read_text() == (tmp_path / "file").read_text() == "five years"
    with pytest.raises(StoreError, match="there is no slice store"):
        SliceStore.open(tmp_path / "nowhere")


def test_overwriting_is_asked_for_and_leaves_only_the_new_store(tmp_path):
    path = tmp_path / "s.zarr"
    old = fill(make(path))
    with pytest.raises(StoreError, match="exists already"):
        SliceStore.create(path, PLANE, SPACE, identity=IDENTITY)
    new = SliceStore.create(path, PLANE, SPACE, identity={"objective": "hill"}, overwrite=True)
    assert new.pending() == new.tiles()
    assert os.listdir(tmp_path) == ["s.zarr"]
    with pytest.raises(StoreError, match="was replaced"):
        fill(old)
    assert new.pending() == new.tiles()


def test_plain_json_is_asked_for():
    with pytest.raises(ValueError, match="identity must be plain JSON"):
        SliceStore.in_memory(PLANE, SPACE, identity={"seed": torch.ones(1)})
    with pytest.raises(ValueError, match="plane from the slice"):
        SliceStore.in_memory(PLANE, SPACE, identity={"plane": "mine"})


def test_a_creation_that_is_killed_leaves_nothing_in_the_way(tmp_path):
    """Kill the making of a store at ever later instants; whatever is left, the same call goes on from it."""
    left = []
    for instant in range(1, alone(partial(make, tmp_path / "whole.zarr"), tmp_path).changes + 1, 5):
        path = tmp_path / str(instant) / "s.zarr"
        assert alone(partial(make, path), tmp_path, Instant(instant)).returncode == -signal.SIGKILL
        left.append(len(list(path.parent.glob(".*"))))
        store = make(path)
        assert store.pending() == store.tiles()
        fill(store)
        assert make(path).pending() == []
    assert left.count(1) > 1  # some were killed half way


def test_hidden_leftovers_are_ignored_and_cleared_away_when_old(tmp_path):
    fresh, stale = (tmp_path / f".s.zarr.{name}.making" for name in ("fresh", "stale"))
    for folder in (fresh, stale):
        folder.mkdir()
        (folder / "zarr.json").write_text("{")
    os.utime(stale, (0, 0))
    os.utime(fresh, (2**33, 2**33))  # to come, whenever this is read
    make(tmp_path / "s.zarr")
    assert fresh.exists()
    assert not stale.exists()


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
        store.write(tile, Evaluation.judged(store.points(tile)[:, 1], None))
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
    about = json.loads((path / "zarr.json").read_text())
    about["attributes"]["gradscape_slice"] = 99
    (path / "zarr.json").write_text(json.dumps(about))
    with pytest.raises(StoreError, match="format 1"):
        make(path)


def test_a_packed_slice_is_the_same_in_few_files_and_still_finished(tmp_path):
    path = tmp_path / "slice.zarr"
    fill(make(path))
    before, files = open_slice(path), len(chunks(path))
    pack(path)
    assert open_slice(path).identical(before)
    assert len(chunks(path)) == 3 < files
    assert make(path).pending() == []
    xr.testing.assert_equal(xr.open_zarr(path)["loss"].sortby(["u", "v"]), before["loss"])
    assert [file.name for file in tmp_path.iterdir()] == ["slice.zarr"]


def test_a_slice_that_is_not_finished_is_not_packed(tmp_path):
    store = make(tmp_path / "slice.zarr")
    fill(store, store.tiles()[:2])
    with pytest.raises(StoreError, match="not finished, so it is not packed"):
        pack(tmp_path / "slice.zarr")
    assert len(make(tmp_path / "slice.zarr").pending()) == len(store.tiles()) - 2


def test_a_damaged_packed_slice_is_as_if_never_sampled(tmp_path):
    path = tmp_path / "slice.zarr"
    fill(make(path))
    pack(path)
    torn = path / "loss" / "c" / "0" / "0"
    content = bytearray(torn.read_bytes())
    content[len(content) // 2] ^= 1
    torn.write_bytes(bytes(content))
    assert (SliceStore.open(path).status() == Status.MISSING).all()
    fill(make(path))
    assert SliceStore.open(path).pending() == []
