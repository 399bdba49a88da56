"""Slices with gradients at every so many samples along each axis, and losses at all."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from matplotlib.quiver import Quiver
from torch import Tensor

import gradscape as gs
from gradscape import Plane, from_torch
from gradscape.jobs.slice import SliceJob
from gradscape.landscapes.draw.figures.contour import arrows_along, landscape_figure
from gradscape.landscapes.measures.gradient_quality import compare_samples
from gradscape.landscapes.measures.undersampled import find_undersampled
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.sampling.distribution import equal_groups
from gradscape.landscapes.sampling.fill import Progress, sample
from gradscape.landscapes.storage.arrays import Tiling
from gradscape.landscapes.storage.store import SliceStore, open_slice
from gradscape.landscapes.verification import POINTS

from ...command import Said
from .waves import SPACE, Counted, same

PLANE = Plane.through(SPACE, SPACE.center, ["x", "z"], resolution=(18, 21))
LINE = Plane.through(SPACE, SPACE.center, ["y"], resolution=30)


class Torn(Counted):
    """A wave that is not finite in a corner."""

    def answer(self, x: Tensor, *, grad: bool) -> Evaluation:
        loss = (3 * x).sin().sum(dim=1)
        loss[(x > 1.5).all(dim=1)] = torch.nan
        return Evaluation.from_results(loss, 3 * (3 * x).cos() if grad else None)


def slopes_of(dataset: xr.Dataset) -> np.ndarray:
    return np.isfinite(dataset["grad"].to_numpy()).all(axis=-1)


def kept(dataset: xr.Dataset, every: int) -> np.ndarray:
    """Which samples may have a gradient, by their place alone."""
    grids = np.indices(dataset["loss"].shape)
    return (grids % every == 0).all(axis=0)


@pytest.mark.parametrize("plane", [PLANE, LINE], ids=["plane", "line"])
@pytest.mark.parametrize("every", [2, 5])
def test_gradients_are_those_of_the_whole_slice_where_they_are(plane: Plane, every: int, tmp_path: Path) -> None:
    whole, counted = sample(Torn(), plane), Torn()
    job = SliceJob.of(counted, plane, command="", out=tmp_path / "cut", gradients=every)
    job.run()
    found = open_slice(tmp_path / "cut")
    inside = kept(whole, every)
    np.testing.assert_array_equal(found["loss"], whole["loss"])
    np.testing.assert_array_equal(found["status"], whole["status"])
    np.testing.assert_array_equal(slopes_of(found), inside & (whole["status"] == Status.OK))
    np.testing.assert_array_equal(found["grad"].to_numpy()[inside], whole["grad"].to_numpy()[inside])
    assert found.identical(open_slice(tmp_path / "cut"))
    with ThreadPoolExecutor(2) as threads:
        job = SliceJob.of(Torn(), plane, command="", out=tmp_path / "threads", gradients=every, executor=threads)
        job.run()
    assert same(open_slice(tmp_path / "threads"), found)


def test_one_that_was_stopped_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    SliceJob.of(Torn(), PLANE, command="", out=tmp_path / "whole", gradients=3).run()
    for _ in range(100):
        job = SliceJob.of(Torn(150), PLANE, command="", out=tmp_path / "cut", gradients=3)
        try:
            job.run()
        except KeyboardInterrupt:
            continue
        break
    assert same(*(open_slice(tmp_path / name) for name in ("whole", "cut")))


SQUARE = Plane.through(SPACE, SPACE.center, ["x", "z"], resolution=64)  # its first tiles have all of the gradients


@pytest.mark.parametrize("plane", [PLANE, SQUARE, LINE], ids=["plane", "square", "line"])
@pytest.mark.parametrize(("every", "batch"), [(2, 24), (3, 16), (4, 33)])
def test_batches_of_gradients_and_of_losses_are_full_but_the_last(plane: Plane, every: int, batch: int) -> None:
    counted = Torn(batch=batch)
    found = sample(counted, plane, gradients=every)
    number = int(kept(found, every).sum())
    for grad, points in ((True, number), (False, found["loss"].size - number)):
        full = full_batch(plane, every, batch, grad=grad)
        sizes = list(map(len, counted.batches[grad]))
        assert full % batch == 0
        assert sizes == [full] * (points // full) + [points % full] * (points % full > 0)


def full_batch(plane: Plane, every: int, batch: int, *, grad: bool) -> int:
    """As many points as the batch, or the least multiple of it that those of any tile fit into."""
    tiling = Tiling(plane, every)
    most = max(int((tiling.sloped(tile) == grad).sum()) for tile in tiling.tiles())
    return next(size for size in range(batch, 10**6, batch) if size >= most)


def test_no_more_than_a_batch_of_either_kind_is_evaluated_ahead() -> None:
    counted, ahead = Torn(batch=32), list[int]()
    sample(counted, SQUARE, gradients=3, progress=lambda now: ahead.append(len(counted.asked) - now.done))
    kinds = [full_batch(SQUARE, 3, 32, grad=grad) for grad in (True, False)]
    assert 32 < max(ahead) < sum(kinds)
    assert ahead[-1] == 0
    assert len(ahead) == 65  # at the start and after each tile


def test_gradients_that_do_not_fit_into_memory_are_halved_to_the_same_bits() -> None:
    small = Torn(batch=64, room=40)
    with pytest.warns(RuntimeWarning, match="counted ran out of memory at 64 points; continuing with 32"):
        found = sample(small, SQUARE, gradients=3)
    assert {len(one) for one in small.batches[True][:-1]} == {32}
    assert same(found, sample(Torn(), SQUARE, gradients=3))


def test_a_run_that_goes_on_repeats_the_batches(tmp_path: Path) -> None:
    whole, stopped, last = Torn(batch=32), Torn(2000, batch=32), Torn(batch=32)
    sample(whole, SQUARE, strided_store(tmp_path / "whole.zarr", SQUARE))
    with pytest.raises(KeyboardInterrupt):
        sample(stopped, SQUARE, strided_store(tmp_path / "cut.zarr", SQUARE))
    sample(last, SQUARE, strided_store(tmp_path / "cut.zarr", SQUARE))
    assert len(last.batches[True].pop(0)) == POINTS  # which are verified
    for grad in (True, False):
        mine, theirs = last.batches[grad], whole.batches[grad]
        assert 3 < len(mine) < len(theirs)
        assert mine[1:] == theirs[1 - len(mine) :]
        assert set(mine[0]) < set(theirs[-len(mine)])


@pytest.mark.parametrize("workers", [1, 3])
def test_workers_get_groups_of_tiles_whose_gradients_fill_a_batch(workers: int) -> None:
    plane = Plane.through(SPACE, SPACE.center, ["x", "z"], resolution=90)
    tiling = Tiling(plane, every=3)
    groups = equal_groups(tiling, tiling.tiles(), 32, workers)
    having = [sum(int(tiling.sloped(tile).sum()) for tile in group) for group in groups]
    most = max(int(tiling.sloped(tile).sum()) for tile in tiling.tiles())
    assert [tile for group in groups for tile in group] == tiling.tiles()
    assert len(groups) % workers == 0
    assert max(having) < 32 + most
    assert sum(having) / len(having) > 32 / 2


def test_workers_ask_for_few_batches_of_gradients(tmp_path: Path) -> None:
    counted = Torn(batch=32)
    with ThreadPoolExecutor(2) as threads:
        sample(counted, SQUARE, gradients=3, executor=threads)
    assert counted.count(True) == 22 * 22
    assert len(counted.batches[True]) < 2 * 22 * 22 / 32  # of tiles there are 64


def test_a_slice_that_another_process_finishes_meanwhile_is_left_as_it_is(tmp_path: Path) -> None:
    plane = Plane.through(SPACE, SPACE.center, ["x", "z"], resolution=(600, 17))  # of three chunks once it is finished
    path, counted = tmp_path / "s.zarr", Torn(batch=32)
    store = strided_store(path, plane)

    def finish(now: Progress) -> None:
        if now.done and not (path / "zarr.json").exists():
            sample(Torn(), plane, strided_store(path, plane))

    found = sample(counted, plane, store, progress=finish)
    assert store.ascending
    assert len(counted.asked) < plane.resolution[0] * plane.resolution[1] / 2
    assert same(found, sample(Torn(), plane, gradients=3))


def strided_store(path: Path, plane: Plane = PLANE) -> SliceStore:
    return SliceStore.open_or_create(path, plane, SPACE, identity={"objective": "wave", "gradients_every": 3})


def test_other_gradients_are_another_slice(tmp_path: Path) -> None:
    job = SliceJob.of(Torn(), PLANE, command="", out=tmp_path, gradients=3)
    job.run()
    with pytest.raises(ValueError, match="gradients_every: wanted 4, found 3"):
        SliceJob.of(Torn(), PLANE, command="", out=tmp_path, gradients=4)
    with pytest.raises(ValueError, match="gradients_every: wanted none, found 3"):
        SliceJob.of(Torn(), PLANE, command="", out=tmp_path)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"gradients": 17}, "got 17 x 17 samples and gradients at every 17"),
        ({"gradients": 2, "refine": 0.05}, "leave out one of the two"),
        ({"gradients": -1}, "gradients is a whole number of at least 0; got -1"),
        ({"gradients": 2.5}, "slice takes a whole number for gradients; got 2.5"),
    ],
)
def test_what_cannot_be_is_refused(how: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        gs.slice(from_torch(lambda x: x.sum(dim=1), SPACE), (0, 1), resolution=17, **how)  # type: ignore[arg-type] # on purpose


def test_the_command_and_the_call_make_the_same_slice(run: Callable[..., Said], tmp_path: Path) -> None:
    words = "slice branin --dims 0 1 --resolution 9 --gradients 4 --out cut"
    done = run(*words.split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "81 episodes (gradients at every 4 samples along each axis) to compute" in done.stderr
    theirs = gs.open_slice(tmp_path / "cut")
    ours = gs.slice("branin", (0, 1), resolution=9, gradients=4, out=tmp_path / "ours")
    assert same(theirs.data, ours.data)
    assert "gradients=4" in ours.provenance["command"]


def waves(x: Tensor) -> Tensor:
    return torch.sin(9 * x[:, 0]) * torch.cos(7 * x[:, 1]) + x[:, 0] + (x[:, 0] > 0.3)


def both_of(every: int) -> Iterator[xr.Dataset]:
    plane = Plane.through(SPACE, SPACE.center, (0, 1), resolution=41)
    return (sample(from_torch(waves, SPACE), plane, **how) for how in ({}, {"gradients": every}))


def test_what_is_finer_than_the_samples_is_looked_for_as_without_gradients() -> None:
    plane, objective = Plane.through(SPACE, SPACE.center, (0, 1), resolution=41), from_torch(waves, SPACE)
    _, strided = both_of(4)
    assert find_undersampled(objective, strided) == find_undersampled(objective, sample(objective, plane, gradients=0))


def test_gradients_are_held_against_the_losses_of_all_samples() -> None:
    dense, strided = (compare_samples(data) for data in both_of(4))
    for name in ("cosine", "sign", "error"):
        some = strided[name].to_numpy()
        known = np.isfinite(some)
        np.testing.assert_array_equal(some[known], dense[name].to_numpy()[known])
        assert 0 < known.sum() <= known.size / 16 * 1.2


def test_arrows_stand_where_gradients_are() -> None:
    _, strided = both_of(4)
    having = slopes_of(strided)
    rows, columns = (arrows_along(strided, name) for name in ("v", "u"))
    assert having[np.ix_(rows, columns)].all()
    assert len(rows) == 11  # all that there are
    drawn = [one for ax in landscape_figure(strided).axes for one in ax.collections if isinstance(one, Quiver)]
    assert [one.N for one in drawn] == [11 * 11]


def test_a_line_of_gradients_goes_through_all_that_there_are(tmp_path: Path) -> None:
    cut = gs.slice(from_torch(waves, SPACE), (0,), resolution=41, gradients=4)
    (line,) = [one for ax in cut.plot().axes for one in ax.lines if one.get_label() == "gradient"]
    assert np.isfinite(line.get_ydata()).all()
    np.testing.assert_array_equal(line.get_xdata(), cut.data["u"][::4])
