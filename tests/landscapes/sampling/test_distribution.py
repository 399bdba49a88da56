import functools
import sys
import threading
import uuid
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import cloudpickle
import numpy as np
import pytest
import torch
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling import distribution as spread
from gradscape.landscapes.sampling.distribution import WorkersLostError, equal_groups
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.storage.arrays import Tiling
from gradscape.landscapes.storage.store import open_slice

from ...clock import Clock
from ...processes import FORK
from . import waves
from .waves import PLANE, SPACE, Counted, same, store_at, wave

for module in (sys.modules[__name__], waves):
    cloudpickle.register_pickle_by_value(module)  # workers need not find the tests


@pytest.fixture(scope="module")
def processes():
    with ProcessPoolExecutor(2, mp_context=FORK) as pool:
        yield pool


@pytest.fixture
def alone(tmp_path):
    store = store_at(tmp_path / "alone.zarr")
    sample(from_torch(wave, SPACE), PLANE, store)
    return store


@pytest.mark.e2e
def test_processes_write_the_bits_of_one_and_progress_counts_every_tile(tmp_path, alone, processes):
    store, seen = store_at(tmp_path / "s.zarr"), []
    sample(from_torch(wave, SPACE), PLANE, store, batch=40, executor=processes, progress=seen.append)
    assert same(store, alone)
    assert [now.done for now in seen] == sorted({now.done for now in seen})
    assert (seen[-1].done, seen[-1].levels) == (288, 5)


class Raising(Objective):
    """A sum that raises in half of the box, and has no gradient in a part of the other half."""

    space, name = SPACE, "raising"

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        raised = x[:, 0] > 0
        status = torch.where(raised, Status.ERROR, Status.OK)
        slope = torch.ones_like(x).masked_fill(x[:, :1] < -1, torch.nan) if grad else None
        return Evaluation.from_results(x.sum(dim=1), slope, status, "RuntimeError: no" if bool(raised.any()) else "")


@pytest.mark.slow
def test_what_the_first_point_that_raised_said_comes_back_from_workers_and_stays(tmp_path, processes):
    store, here = (store_at(tmp_path / f"{name}.zarr") for name in ("workers", "here"))
    found, wanted = (
        sample(Raising(), PLANE, one, batch=40, executor=pool) for one, pool in ((store, processes), (here, None))
    )
    assert found.attrs["error"] == wanted.attrs["error"] == "RuntimeError: no"
    assert open_slice(store.path).attrs["error"] == "RuntimeError: no"
    assert same(store, here)
    counts = {kind: int((found["status"] == kind).sum()) for kind in (Status.ERROR, Status.NO_GRADIENT)}
    assert min(counts.values()) > 0
    assert int(found["loss"].isnull().sum()) == counts[Status.ERROR]


def test_threads_share_the_objective_and_a_slice_in_memory(alone):
    asked, both = [], threading.Barrier(2)

    def counted(x: torch.Tensor) -> torch.Tensor:
        asked.append(threading.get_ident())
        both.wait()
        return wave(x)

    with ThreadPoolExecutor(2) as threads:
        dataset = sample(from_torch(counted, SPACE), PLANE, batch=40, executor=threads)
    assert np.array_equal(dataset["loss"], alone.dataset()["loss"])
    assert len(set(asked)) == 2
    assert len(asked) == 8  # 288 points, batches of at most 40, as many for each


def made_in(folder: Path) -> Objective:
    (folder / uuid.uuid4().hex).touch()
    return from_torch(wave, SPACE)


def test_an_objective_is_made_once_in_each_worker(tmp_path, alone, processes):
    store, made = store_at(tmp_path / "s.zarr"), tmp_path / "made"
    made.mkdir()
    how = functools.partial(made_in, made)
    sample(from_torch(wave, SPACE), PLANE, store, batch=20, executor=processes, made=how)
    assert same(store, alone)
    assert 1 <= len(list(made.iterdir())) <= 2  # for some 16 batches


def test_what_cannot_be_sent_is_refused_with_what_to_do(tmp_path, processes):
    lock = threading.Lock()
    holding = from_torch(lambda x: wave(x) + lock.locked(), SPACE, name="locked")
    with pytest.raises(ValueError, match=r"locked cannot be sent .* pass sample made="):
        sample(holding, PLANE, store_at(tmp_path / "s.zarr"), executor=processes)


def test_a_function_of_a_notebook_travels_and_its_slice_may_be_in_memory(alone, processes):
    found = sample(from_torch(lambda x: wave(x), SPACE, name="wave"), PLANE, executor=processes)
    xr.testing.assert_equal(found, alone.dataset())


@pytest.mark.slow
def test_an_error_in_a_worker_comes_back_and_what_was_done_is_kept(tmp_path, alone, processes):
    store = store_at(tmp_path / "s.zarr")
    with pytest.raises(RuntimeError, match="broken cable"):
        sample(Broken(), PLANE, store, batch=1, executor=processes)
    kept = len(store.tiles()) - len(store.pending())
    assert kept < len(store.tiles())
    sample(from_torch(wave, SPACE), PLANE, store, executor=processes)
    assert same(store, alone)


class Broken(Counted):
    """A wave whose evaluation ends in a corner, and not as a status of a point."""

    def answer(self, x: torch.Tensor, *, grad: bool) -> Evaluation:
        if bool((x > 1.9).any()):
            raise RuntimeError("broken cable")
        return super().answer(x, grad=grad)


class Slow(Executor):
    """Never do anything, and remember what was asked for."""

    def __init__(self) -> None:
        self.futures: list[Future] = []

    def submit(self, fn, /, *args, **kwargs):
        self.futures.append(Future())
        if len(self.futures) == 2:
            self.futures[0].set_result(fn(*args))
        return self.futures[-1]


def test_stopping_cancels_what_is_queued_and_the_slice_goes_on(tmp_path, alone):
    store, slow = store_at(tmp_path / "s.zarr"), Slow()

    def interrupt(now):
        if now.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(from_torch(wave, SPACE), PLANE, store, batch=32, executor=slow, progress=interrupt)
    first, queued = slow.futures  # no more are handed out ahead
    assert first.done()
    assert queued.cancelled()
    sample(from_torch(wave, SPACE), PLANE, store)
    assert same(store, alone)


def test_workers_that_are_gone_end_it_with_what_is_kept(tmp_path):
    store, slow = store_at(tmp_path / "s.zarr"), Slow()

    def lose(now):
        for future in slow.futures[1:]:
            if now.done and not future.cancelled():
                future.cancel()
                future.set_running_or_notify_cancel()

    said = r"the workers are gone.*; \d+ of 288 points are kept in .*s\.filling.*continues"
    with pytest.raises(WorkersLostError, match=said):
        sample(from_torch(wave, SPACE), PLANE, store, batch=32, executor=slow, progress=lose)


class Deserted(Executor):
    """Like Dask's, with a scheduler that answers and no worker."""

    class _client:  # noqa: N801 -- Dask's name for it
        status, nthreads = "running", staticmethod(dict)

    def submit(self, fn, /, *args, **kwargs):
        return Future()


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(spread, "time", clock)
    return clock


def test_workers_that_never_come_back_are_given_up(tmp_path, clock, monkeypatch):
    def wait(pending, timeout, return_when):
        clock.sleep(timeout)
        return set(), pending

    monkeypatch.setattr(spread, "wait", wait)
    store = store_at(tmp_path / "s.zarr")
    with pytest.raises(WorkersLostError, match=r"none was there for 60 s.*0 of .* the same command continues"):
        sample(from_torch(wave, SPACE), PLANE, store, executor=Deserted())
    assert spread.WITHOUT_WORKERS < clock.now <= spread.WITHOUT_WORKERS + spread.POLL


@given(batch=st.integers(1, 400), workers=st.integers(1, 9))
def test_batches_are_equal_and_as_many_for_every_worker(batch, workers):
    tiling = Tiling(Plane.through(SPACE, SPACE.center, ["x", "z"], resolution=32), every=1)
    groups = equal_groups(tiling, tiling.tiles(), batch, workers)
    assert [tile for group in groups for tile in group] == tiling.tiles()
    sizes = [sum(map(tiling.count, group)) for group in groups]
    assert len(groups) == 64 or len(groups) % workers == 0
    assert max(sizes) - min(sizes) <= 16  # a tile
    assert max(sizes) < max(batch, 16) + 16
    if len(groups) > workers and len(groups) < 64:
        assert batch * (len(groups) - workers) < 1024  # no more than needed
