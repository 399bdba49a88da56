"""A slice on disk that is damaged, in the way or somebody else's: computed again or refused, and never harmed."""

import fcntl
import os
import signal
from functools import partial
from itertools import combinations
from pathlib import Path

import pytest
import torch
import xarray as xr

from gradscape.landscapes.identity import StoreError, StoreMismatchError
from gradscape.landscapes.objective import Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.storage.paths import archive_path, filling_path, folder_path
from gradscape.landscapes.storage.store import SliceStore, open_slice

from ...processes import Instant, alone
from .stores import IDENTITY, PLANE, SPACE, break_chunk, chunks, fill, finished, make, unpacked


@pytest.mark.parametrize("place", [archive_path, folder_path])
def test_a_damaged_chunk_of_a_finished_slice_is_computed_again(tmp_path, place):
    path = tmp_path / "slice.zarr"
    finished(path)
    whole, again = open_slice(path), archive_path(path).read_bytes()
    for name in ("loss/c/0/0", "grad/c/0/0/0", "status/c/0/0", "checksum/c/0/0"):
        if place is archive_path:
            break_chunk(path, name)
        else:
            file = unpacked(path) / name
            file.write_bytes(file.read_bytes()[:-1])
        assert (SliceStore.open(path).status() == Status.MISSING).all()
        assert make(path).coarse() is None
        one, other = fill(make(path)), fill(make(path))  # as two processes may
        for store in (one, other):
            store.finish(store.dataset())
        assert one.pending() == other.pending() == []
        assert os.listdir(tmp_path) == ["slice.zarr.zip"]
        assert open_slice(path).identical(whole)
        assert archive_path(path).read_bytes() == again


def test_no_byte_of_a_finished_slice_changes_it_unseen(tmp_path):
    """A damaged byte costs the samples of its chunk, or the slice is refused."""
    path = tmp_path / "s.zarr"
    finished(path)
    whole, file = open_slice(path), archive_path(path)
    sound, lost = file.read_bytes(), 0
    for at in range(0, len(sound), 7):
        file.write_bytes(sound[:at] + bytes([sound[at] ^ 16]) + sound[at + 1 :])
        try:
            found = open_slice(path)
        except StoreError:
            lost += 1
            continue
        missing = bool((found["status"] == Status.MISSING).all())
        assert missing or found.identical(whole)
        lost += missing
    assert lost > len(sound) / 7 / 2


@pytest.mark.parametrize("damage", ["truncated", "removed", "altered"])
def test_a_damaged_tile_costs_exactly_its_points(tmp_path, damage):
    path = tmp_path / "s.zarr"
    small = {"plane": Plane.through(SPACE, SPACE.center, ["x", "y"], resolution=(7, 5))}
    fill(make(path, **small))
    whole = open_slice(path)
    for file in chunks(filling_path(path)):
        sound = file.read_bytes()
        torn = {"truncated": sound[: len(sound) // 2], "altered": sound.replace(b"NUMPY", b"numpy", 1)}
        file.unlink() if damage == "removed" else file.write_bytes(torn[damage])
        store = make(path, **small)
        pending = store.pending()
        assert [tile.name for tile in pending] == [file.stem]
        assert store.damaged_tiles(pending) == ([] if damage == "removed" else pending)
        seen = open_slice(path)["status"].to_numpy()
        assert (seen == Status.MISSING).sum() == store.tiling.count(pending[0])
        fill(store, pending)
        xr.testing.assert_identical(open_slice(path), whole)


def test_no_byte_of_a_tile_changes_a_sample_unseen(tmp_path):
    path = tmp_path / "s.zarr"
    store = fill(make(path))
    first, *_ = store.tiles()
    file, values = filling_path(path) / f"pieces/{first.name}.npz", store.read_tile(first)
    sound, lost = file.read_bytes(), 0
    for at in range(0, len(sound), 5):
        file.write_bytes(sound[:at] + bytes([sound[at] ^ 16]) + sound[at + 1 :])
        found = SliceStore.open(path).read_tile(first)
        lost += found is None
        for name in found or {}:
            assert found[name].tobytes() == values[name].tobytes()
    assert lost > len(sound) / 5 / 2


@pytest.mark.parametrize("place", [filling_path, Path])
def test_chunks_in_each_others_place_are_missing_and_not_taken_for_right(tmp_path, monkeypatch, place):
    monkeypatch.setattr("gradscape.landscapes.storage.arrays.SIDE", 4)  # so that a finished slice has several, too
    path = tmp_path / "s.zarr"
    fill(make(path)) if place is filling_path else unpacked(finished(path).path)
    whole, swapped = open_slice(path), 0
    for one, other in combinations(chunks(place(path)), 2):
        if one.relative_to(path.parent).parts[:2] == other.relative_to(path.parent).parts[:2]:
            contents = one.read_bytes(), other.read_bytes()
            if contents[0] == contents[1]:
                continue
            one.write_bytes(contents[1])
            other.write_bytes(contents[0])
            found = open_slice(path)
            known = found["status"] != Status.MISSING
            assert 0 < known.sum() < found["status"].size
            for name in ("loss", "grad", "status"):
                xr.testing.assert_equal(found[name].where(known), whole[name].where(known))
            one.write_bytes(contents[0])
            other.write_bytes(contents[1])
            swapped += 1
    assert swapped > 10
    xr.testing.assert_identical(open_slice(path), whole)


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
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    with pytest.raises(StoreMismatchError, match=f"{said}.*--out.*--force"):
        make(path, **changes)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


def test_what_is_no_slice_store_is_never_touched(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").write_text("five years")
    (tmp_path / "file").write_text("five years")
    for path in (tmp_path / "folder", tmp_path / "file"):
        with pytest.raises(StoreError, match="not a slice store"):
            make(path)
        for overwrite in (False, True):
            with pytest.raises(StoreError):
                SliceStore.create(path, PLANE, SPACE, identity=IDENTITY, overwrite=overwrite)
    assert (tmp_path / "folder" / "thesis.tex").read_text() == (tmp_path / "file").read_text() == "five years"
    with pytest.raises(StoreError, match="there is no slice store"):
        SliceStore.open(tmp_path / "nowhere")


def test_overwriting_is_asked_for_and_leaves_only_the_new_store(tmp_path):
    path = tmp_path / "s.zarr"
    for prepare in (lambda: fill(make(path)), lambda: finished(path, identity={"objective": "hill"})):
        old = prepare()
        with pytest.raises(StoreError, match="already exists"):
            SliceStore.create(path, PLANE, SPACE, identity=IDENTITY)
        new = SliceStore.create(path, PLANE, SPACE, identity={"objective": "hill"}, overwrite=True)
        assert new.pending() == new.tiles()
        assert os.listdir(tmp_path) == ["s.filling"]
        with pytest.raises(StoreError, match="was replaced"):
            fill(old)
        assert new.pending() == new.tiles()


def test_plain_json_is_asked_for():
    with pytest.raises(ValueError, match="identity must be plain JSON"):
        SliceStore.in_memory(PLANE, SPACE, identity={"seed": torch.ones(1)})
    with pytest.raises(ValueError, match="plane from the slice"):
        SliceStore.in_memory(PLANE, SPACE, identity={"plane": "mine"})


def test_a_creation_that_is_killed_leaves_nothing_in_the_way(tmp_path):
    """Kill the making of a store at ever later instants; whatever is left, the same call continues from it."""
    left = []
    for instant in range(1, alone(partial(make, tmp_path / "whole.zarr"), tmp_path).changes + 1):
        path = tmp_path / str(instant) / "s.zarr"
        assert alone(partial(make, path), tmp_path, Instant(instant)).returncode == -signal.SIGKILL
        left.append(len(list(path.parent.glob(".*"))))
        store = make(path)
        assert store.pending() == store.tiles()
        fill(store)
        assert make(path).pending() == []
    assert left.count(1) > 1  # some were killed half way


def test_hidden_leftovers_are_ignored_and_cleared_away_where_nobody_holds_them(tmp_path):
    for name in ("s.zarr", "s.filling"):
        held, left = (tmp_path / f".{name}.{digit * 32}.making" for digit in "ab")
        for folder in (held, left):
            folder.mkdir()
            (folder / "zarr.json").write_text("{")
        lock = os.open(held, os.O_RDONLY)
        fcntl.flock(lock, fcntl.LOCK_EX)
        make(tmp_path / "s.zarr")
        assert held.exists()
        assert not left.exists()
        os.close(lock)
        finished(tmp_path / "s.zarr")
