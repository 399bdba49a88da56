"""What goes wrong while a slice is filled: memory, disk, damaged files, another process."""

import errno
import os
import re
import warnings
from pathlib import Path

import pytest
import torch

from gradscape.envs.adapters import from_torch
from gradscape.envs.engines.sheets import springs
from gradscape.envs.registry import make
from gradscape.landscapes.cost import seconds_per_episode
from gradscape.landscapes.identity import StoreError
from gradscape.landscapes.objective import Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.sampling.memory import MemoryBound, is_out_of_memory
from gradscape.landscapes.storage.paths import filling_path
from gradscape.landscapes.storage.store import SliceStore
from gradscape.landscapes.verification import POINTS
from gradscape.studies.stability import ask, is_stable

from ...processes import FORK
from ..storage.stores import break_chunk
from .waves import PLANE, SPACE, Counted, same, store_at, wave

MESSAGES = [
    "CUDA out of memory. Tried to allocate 2.00 GiB",
    "Failed to allocate 123456 bytes on device 'cuda:0'",
    "DefaultCPUAllocator: can't allocate memory: you tried to allocate 8000000000000 bytes",
    "Out of CUDA pre-allocated memory",
    "Failed to acquire primary context for device cuda:0",  # Warp's, on a GPU that other programs fill
]


def small(room: int, error: Exception) -> Counted:
    """Return a wave on a device with memory for so many points."""
    found = Counted(room=room, error=error)
    found.name, found.device = "wave", "cpu"
    return found


@pytest.fixture
def kept(monkeypatch):
    """Leave the tiles of a slice that is complete: as it is just before it is finished."""
    monkeypatch.setattr(SliceStore, "finish", lambda *_: None)


@pytest.fixture(scope="module")
def whole():
    return sample(from_torch(wave, SPACE), PLANE)


@pytest.mark.parametrize("error", [*map(RuntimeError, MESSAGES), torch.OutOfMemoryError("x"), MemoryError()])
def test_a_batch_that_does_not_fit_is_halved_with_a_warning_and_the_same_bits(whole, error):
    device = small(20, error)
    with pytest.warns(RuntimeWarning, match="wave ran out of memory at") as said:
        dataset = sample(device, PLANE, batch=60)
    assert same(dataset, whole)
    assert [str(one.message).split(" at ")[1] for one in said] == [
        "64 points; continuing with 32",
        "32 points; continuing with 16",
    ]
    assert device.sizes[:3] == [64, 32, 16]
    assert max(device.sizes[2:]) == 16  # learnt


def test_a_solver_that_does_not_fit_is_made_smaller(monkeypatch):
    def sampled():
        env = make("flip", fidelity="draft", device="cpu", horizon=0.1)
        plane = Plane.through(env.space, env.space.center, [0, 1], resolution=4)
        return env, sample(env, plane, batch=16)

    _, wanted = sampled()
    fitting, made = springs.Solver.__init__, []

    def init(self, *args, capacity, **settings):
        made.append(capacity)
        if capacity > 2:
            raise RuntimeError("Failed to allocate 1 bytes on device 'cuda:0'")
        fitting(self, *args, capacity=capacity, **settings)

    monkeypatch.setattr("gradscape.envs.sheets.sheets.capacity", lambda memory, device: 16)
    monkeypatch.setattr(springs.Solver, "__init__", init)
    with pytest.warns(RuntimeWarning, match="flip ran out of memory at"):
        env, found = sampled()
    assert same(found, wanted)
    assert env.preferred_batch == 2 * env.threads
    assert {16, 8, 4, 2} == set(made)


def test_memory_for_no_point_at_all_ends_it_and_other_errors_pass():
    with pytest.raises(MemoryError, match=r"wave ran out of memory at a single point: .*--fidelity"):
        MemoryBound(small(0, RuntimeError(MESSAGES[0]))).evaluate(SPACE.uniform(3, seed=0))
    with pytest.raises(RuntimeError, match="broken cable"):
        MemoryBound(small(0, RuntimeError("broken cable"))).evaluate(SPACE.uniform(3, seed=0))
    assert not is_out_of_memory(RuntimeError("the ball is out of the memory foam"))


def test_memory_that_runs_out_says_nothing_of_a_setting():
    points = SPACE.uniform(16, seed=0)
    device = small(4, RuntimeError(MESSAGES[1]))
    assert is_stable(ask(device, points))
    assert device.sizes[:3] == [16, 8, 4]
    found = ask(small(0, RuntimeError(MESSAGES[1])), points)
    assert "wave ran out of memory at a single point" in found.refused
    assert len(found.status) == 0
    broken = ask(small(0, RuntimeError("broken cable")), points)
    assert (broken.refused, broken.error) == ("", "RuntimeError: broken cable")
    assert (broken.status == Status.ERROR).all()


def test_what_an_episode_costs_is_measured_with_the_memory_that_is_there():
    device = small(4, RuntimeError(MESSAGES[1]))
    device.device = "cuda"
    assert seconds_per_episode(device, SPACE.uniform(16, seed=0), grad=True) > 0
    assert device.sizes[:3] == [16, 8, 4]
    with pytest.raises(MemoryError, match="wave ran out of memory at a single point"):
        seconds_per_episode(small(0, RuntimeError(MESSAGES[1])), SPACE.uniform(16, seed=0), grad=True)


@pytest.mark.parametrize("damage", ["truncated", "altered", "empty", "removed", "finished"])
def test_a_damaged_tile_is_named_and_computed_again_and_one_that_never_was_is_none(tmp_path, whole, damage, request):
    path, device = tmp_path / "s.zarr", small(1000, MemoryError())
    if damage != "finished":
        request.getfixturevalue("kept")
    sample(from_torch(wave, SPACE), PLANE, store_at(path))
    if damage == "finished":
        break_chunk(path, "loss/c/0/0")
    else:
        file = filling_path(path) / "pieces/2-3.npz"
        sound = file.read_bytes()
        torn = {"truncated": sound[: len(sound) // 2], "altered": sound.replace(b"NUMPY", b"numpy", 1), "empty": b""}
        file.unlink() if damage == "removed" else file.write_bytes(torn[damage])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", RuntimeWarning)
        assert same(sample(device, PLANE, store_at(path)), whole)
    place = r"s\.zarr\.zip: tile \(0, 0\)" if damage == "finished" else r"s\.filling: tile \(2, 3\)"
    assert len(said) == (damage != "removed")
    assert all(re.search(f"{place} is damaged and is computed again", str(one.message)) for one in said)
    assert device.sizes == ([288] if damage == "finished" else [POINTS, 16])  # those that are verified first


def test_a_damaged_axis_is_said_with_what_to_do(tmp_path):
    path = tmp_path / "s.zarr"
    sample(from_torch(wave, SPACE), PLANE, store_at(path))
    break_chunk(path, "u/c/0")
    with pytest.raises(StoreError, match=r"s\.zarr\.zip/u is damaged .*restore it, or sample the slice again"):
        store_at(path)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_ends_it_with_what_is_kept_and_the_slice_goes_on(tmp_path, whole, monkeypatch, code):
    store, replace, room = store_at(tmp_path / "s.zarr"), os.replace, [5]

    def full(source, target):
        room[0] -= 1
        if room[0] < 0:
            raise OSError(code, os.strerror(code), str(target))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    said = r"the disk is full; 80 of 288 points are kept in .*s\.filling: free some space, and the same command"
    with pytest.raises(OSError, match=said) as ended:
        sample(from_torch(wave, SPACE), PLANE, store)
    assert ended.value.errno == code
    monkeypatch.undo()
    assert not list(tmp_path.rglob("*.partial"))
    device = small(1000, MemoryError())
    assert same(sample(device, PLANE, store_at(tmp_path / "s.zarr")), whole)
    assert sum(device.sizes) == 288 - 80 + POINTS


def _fill(path: Path, barrier) -> None:
    store = store_at(path)
    barrier.wait()
    sample(from_torch(wave, SPACE), PLANE, store)


def test_two_processes_fill_the_same_store_and_harm_nothing(tmp_path, whole):
    barrier = FORK.Barrier(2)
    both = [FORK.Process(target=_fill, args=(tmp_path / "s.zarr", barrier)) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    store = store_at(tmp_path / "s.zarr")
    assert not store.pending()
    assert same(store, whole)
