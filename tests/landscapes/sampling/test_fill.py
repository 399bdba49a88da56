import contextlib
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from gradscape.landscapes.identity import StoreError
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.storage.paths import archive_path
from gradscape.landscapes.storage.store import SliceStore
from gradscape.landscapes.verification import POINTS

from ...processes import Instant, alone
from .waves import PLANE, SPACE, Counted, same, store_at

SAID = "RuntimeError: too much work"


class Wave(Counted):
    """A smooth wave that escapes in one corner and raises in another, and has no gradients in the middle."""

    def answer(self, x: torch.Tensor, *, grad: bool) -> Evaluation:
        loss = (3 * x).sin().prod(dim=1) + x.exp().sum(dim=1)
        loss[(x > 1).all(dim=1)] = torch.nan
        failed = torch.where((x[:, 0] < -1) & (x[:, 2] < -1), Status.ESCAPED, Status.OK)
        failed[raised := (x[:, 0] > 1) & (x[:, 2] < -1)] = Status.ERROR
        slope = (3 * (3 * x).cos()).masked_fill((x[:, [0, 2]].abs() < 0.5).all(dim=1, keepdim=True), torch.nan)
        return Evaluation.from_results(loss, slope if grad else None, failed, SAID if bool(raised.any()) else "")


def test_a_slice_holds_the_objective_at_its_own_points():
    dataset = sample(Wave(), PLANE)
    v, u = np.meshgrid(dataset["v"], dataset["u"], indexing="ij")
    x = PLANE.lift(torch.from_numpy(np.stack([u.ravel(), v.ravel()], axis=1)))
    wanted = Wave().evaluate(x)
    np.testing.assert_array_equal(dataset["status"], wanted.status.reshape(16, 18))
    np.testing.assert_allclose(dataset["loss"], wanted.loss.reshape(16, 18), rtol=1e-14)
    np.testing.assert_allclose(dataset["grad"], wanted.grad.reshape(16, 18, 3), rtol=1e-14)
    ended = {Status.OK, Status.ESCAPED, Status.ERROR, Status.NO_GRADIENT}
    assert {int(s) for s in np.unique(dataset["status"])} == ended
    lacking = (dataset["status"] == Status.NO_GRADIENT).to_numpy()
    assert np.isfinite(dataset["loss"].to_numpy()[lacking]).all()
    assert np.isnan(dataset["grad"].to_numpy()[lacking]).all()
    assert dataset.attrs["error"] == SAID


@settings(max_examples=4)
@given(stops=st.lists(st.integers(0, 120), max_size=4), batch=st.integers(1, 100))
def test_interruptions_change_no_bit_and_cost_no_finished_tile(tmp_path_factory, stops, batch):
    path = tmp_path_factory.mktemp("slice") / "s.zarr"
    asked: list[tuple[float, ...]] = []
    for stop in stops:
        objective = Wave(stop_after=stop)
        with contextlib.suppress(KeyboardInterrupt):
            sample(objective, PLANE, store_at(path), batch=batch)
        asked += objective.asked
    last = Wave()
    resumed = sample(last, PLANE, store_at(path), batch=batch)
    asked += last.asked
    assert len(set(asked)) == 18 * 16
    assert len(asked) <= 18 * 16 + POINTS * len(stops)  # those that are verified where it continues
    assert same(resumed, sample(Wave(), PLANE, batch=batch))


def test_an_interruption_between_two_tiles_of_a_batch_keeps_the_first(tmp_path):
    store = store_at(tmp_path / "s.zarr")

    def interrupt(progress):
        if progress.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(Wave(), PLANE, store, batch=100, progress=interrupt)
    assert len(store.pending()) == len(store.tiles()) - 1
    objective, first = Wave(), store.points(store.tiles()[0])
    sample(objective, PLANE, store, batch=100)
    assert len(objective.asked) == 18 * 16 - len(first) + POINTS


def sampling(path: Path) -> None:
    sample(Wave(), PLANE, store_at(path))


@pytest.mark.e2e
def test_sigkill_at_any_instant_changes_no_bit(tmp_path):
    undisturbed, found = tmp_path / "undisturbed.zarr", []
    instants, whole = alone(partial(sampling, undisturbed), tmp_path).changes, sample(Wave(), PLANE)
    for instant in range(1, instants + 1, 31):
        path = tmp_path / f"{instant}.zarr"
        assert alone(partial(sampling, path), tmp_path, Instant(instant)).returncode == -signal.SIGKILL
        left = store_at(path)
        pending = left.pending()
        found.append(18 * 16 - sum(left.tiling.count(tile) for tile in pending))
        objective = Wave()
        resumed = sample(objective, PLANE, store_at(path))
        verified = len(pending) < len(left.tiles())
        assert len(objective.sizes) == verified + len(pending)
        xr.testing.assert_equal(resumed, whole)
        assert same(resumed, whole)
        assert resumed.attrs["error"] == SliceStore.open(path).dataset().attrs["error"] == SAID
        assert archive_path(path).read_bytes() == archive_path(undisturbed).read_bytes()
    assert found[0] == 0
    assert found == sorted(found)
    assert len(set(found)) > 3


def test_progress_counts_up_by_status_and_announces_each_finer_picture(tmp_path):
    store, seen, drawn = store_at(tmp_path / "s.zarr"), [], []

    def watch(progress):
        seen.append(progress)
        if progress.level_complete:
            drawn.append(store.coarse().sizes["u"])

    dataset = sample(Wave(), PLANE, store, progress=watch)
    assert [p.done for p in seen] == sorted({p.done for p in seen})
    assert (seen[0].done, seen[-1].done, seen[-1].total) == (0, 288, 288)
    assert drawn == [4, 8, 12, 16, 18]
    for kind, count in seen[-1].statuses.items():
        assert count == int((dataset["status"] == kind).sum())
    again = []
    sample(Wave(), PLANE, store, progress=again.append)
    assert [(p.done, p.resumed, p.level_complete) for p in again] == [(288, 288, False)]


def test_batches_are_as_large_as_the_objective_prefers():
    objective = Wave(batch=60)
    sample(objective, PLANE)
    assert all(size >= 60 for size in objective.sizes[:-1])
    assert sum(objective.sizes) == 288


def test_without_gradients_none_is_asked_for_and_none_stored(tmp_path):
    objective = Wave()
    assert "grad" not in sample(objective, PLANE, store_at(tmp_path / "s.zarr", grad=False), gradients=0)
    assert objective.count(True) == 0
    other = Plane.through(SPACE, SPACE.center, ["x", "y"], resolution=16)
    with pytest.raises(StoreError, match=r"plane\.basis"):
        sample(Wave(), other, store_at(tmp_path / "t.zarr"))
    with pytest.raises(StoreError, match="gradients: wanted True, found False"):
        sample(Wave(), PLANE, store_at(tmp_path / "s.zarr", grad=False))


class Bent(Wave):
    """A wave whose answer is changed."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def answer(self, x, *, grad):
        return self.change(super().answer(x, grad=grad))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda e: Evaluation(e.loss[:-1], e.grad, e.status),
            r"counted must return loss of shape \(16,\).*got \(15,\)",
        ),
        (lambda e: Evaluation(e.loss, e.grad[:, :2], e.status), r"grad of shape \(16, 3\).*got \(16, 2\)"),
        (lambda e: Evaluation(e.loss, None, e.status), "returned no gradients with grad=True"),
        (lambda e: Evaluation(e.loss, e.grad, 0 * e.status), "got status MISSING"),
        (lambda e: Evaluation(e.loss, e.grad, 0 * e.status + Status.INTERPOLATED), "got status INTERPOLATED"),
    ],
)
def test_an_objective_that_breaks_the_protocol_is_named(change, said):
    with pytest.raises(ValueError, match=said):
        sample(Bent(change), PLANE)


def test_a_silent_nan_becomes_a_status():
    def silent(found):
        first = torch.arange(len(found.loss))[:, None] == 0
        return Evaluation(
            0 * found.status.double(),
            torch.where(first, torch.inf, 0.0 * found.grad.nan_to_num()),
            0 * found.status + 1,
        )

    dataset = sample(Bent(silent), PLANE)
    assert (dataset["status"] == Status.NO_GRADIENT).sum() == len(SliceStore.in_memory(PLANE, SPACE).tiles())
    assert not dataset["loss"].isnull().any()
