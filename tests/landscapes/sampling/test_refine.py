"""Refined slices: where they are sampled, that they continue, and that nothing interpolated is taken for a sample."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr
from torch import Tensor
from zarr.storage import ZipStore

from gradscape import ParameterSpace, Plane, from_numpy, from_torch, sample
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.export import frame
from gradscape.landscapes.identity import DamagedError, StoreMismatchError, plane_of
from gradscape.landscapes.lattice import own_cells, sampled_lattice
from gradscape.landscapes.measures.undersampled import find_undersampled
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.sampling.quadtree import Quadtree
from gradscape.landscapes.sampling.refine import Refined, Refinement, refine
from gradscape.landscapes.slice import Slice
from gradscape.landscapes.storage.paths import filling_path
from gradscape.landscapes.storage.store import SliceStore, open_slice

from ..storage.stores import break_chunk
from .waves import Counted

Function = Callable[[Tensor], Tensor]
SPACE = ParameterSpace.box(("a", "b"), -1.0, 1.0)
RIDGE = 0.006 * 2.355  # full width at half maximum; of 32 samples it is a fifth of a step, of 257 it is two steps


def bowl(x: Tensor) -> Tensor:
    return x.square().sum(dim=1) + x[:, 0] * x[:, 1]


def ridged(x: Tensor) -> Tensor:
    across = (x[:, 0] + 0.37 * x[:, 1] - 0.1) / math.hypot(1.0, 0.37)
    return bowl(x) + 2 * torch.exp(-4 * math.log(2) * (across / RIDGE) ** 2)


def jumping(x: Tensor) -> Tensor:
    return bowl(x) + (x[:, 0] + 0.3 * x[:, 1] > 0.11).double()


def waves(x: Tensor) -> Tensor:
    return torch.sin(6 * x[:, 0]) * torch.cos(4 * x[:, 1])


def plane(points: int | tuple[int, ...], dims: tuple[int, ...] = (0, 1)) -> Plane:
    return Plane.through(SPACE, torch.zeros(2), dims, resolution=points)


def refined(
    function: Function, points: int | tuple[int, ...], share: float | None = 0.02, budget: int | None = None,
    dims: tuple[int, ...] = (0, 1), grad: bool = True,
) -> xr.Dataset:  # fmt: skip
    over = plane(points, dims)
    store = SliceStore.in_memory(over, SPACE, grad=grad)
    return refine(from_torch(function, SPACE), over, store, Refinement(share, budget))


def sampled(dataset: xr.Dataset) -> np.ndarray:
    return np.asarray(dataset["status"] != Status.INTERPOLATED)


def off(dataset: xr.Dataset, function: Function, points: int | tuple[int, ...], dims: tuple[int, ...] = (0, 1)) -> Any:
    """Return how far what is interpolated is off, in ranges."""
    whole = sample(from_torch(function, SPACE), plane(points, dims))["loss"]
    return (np.abs(dataset["interpolated"] - whole) / float(whole.max() - whole.min())).to_numpy()


@pytest.mark.parametrize("rank", [1, 2])
def test_gradients_interpolate_a_cubic_exactly(rank: int) -> None:
    tree = Quadtree((20, 33)[-rank:])
    powers = np.array([[3, 0], [2, 1], [1, 2], [0, 3], [1, 1], [0, 2]])[:, :rank]

    def loss(at: np.ndarray) -> np.ndarray:
        return sum(((at / 10) ** power).prod(axis=-1) for power in powers)

    def slope(at: np.ndarray) -> np.ndarray:
        steps = 1e-5 * np.eye(rank)
        return np.stack([(loss(at + step) - loss(at - step)) / 2e-5 for step in steps], axis=-1)

    lattice = tree.lattice()
    tree.add(lattice, loss(lattice.astype(float)), slope(lattice.astype(float)))
    places = np.random.default_rng(0).random((50, rank)) * (np.array(tree.shape) - 1)
    assert tree.predict(places) == pytest.approx(loss(places), rel=1e-6)


@pytest.mark.parametrize("points", [65, (40, 65), 100])
def test_what_is_smooth_takes_few_samples(points: int | tuple[int, ...]) -> None:
    for function in (bowl, waves):
        dataset = refined(function, points)
        assert sampled(dataset).mean() < (0.1 if function is bowl else 0.25)
        assert np.nanmax(off(dataset, function, points)) < 0.02


def test_a_line_is_refined_too() -> None:
    dataset = refined(jumping, 513, dims=(0,))
    assert sampled(dataset).sum() < 100
    assert np.nanmax(off(dataset, jumping, 513, (0,))) < 0.02
    changes = np.flatnonzero(np.diff(dataset["u"] > 0.11))
    assert sampled(dataset)[changes[0] : changes[0] + 2].all()


def test_samples_lie_where_the_loss_jumps() -> None:
    dataset = refined(jumping, 129)
    over = dataset["u"] + 0.3 * dataset["v"] - 0.11
    near = np.asarray(np.abs(over) < 0.01).T
    assert sampled(dataset)[near].mean() > 0.9
    assert sampled(dataset).mean() < 0.15
    assert (np.nan_to_num(off(dataset, jumping, 129)) > 0.02).mean() < 0.001


@pytest.mark.slow
def test_a_thin_ridge_is_undersampled_at_32_and_resolved_by_refinement() -> None:
    objective = from_torch(ridged, SPACE)
    coarse = find_undersampled(objective, sample(objective, plane(32)))
    assert coarse is not None
    assert coarse.share.low > 0.01
    dataset = refined(ridged, 513)
    fine = find_undersampled(objective, dataset)
    assert fine is not None
    assert fine.share.high < 0.01
    assert sampled(dataset).mean() < 0.06
    between = off(dataset, ridged, 513)
    assert np.nanquantile(between, 0.9999) < 0.02
    assert np.nanmax(between) < 0.1


def test_samples_have_the_bits_of_a_slice_that_is_sampled_everywhere() -> None:
    dataset, whole = refined(waves, 65), sample(from_torch(waves, SPACE), plane(65))
    there = sampled(dataset)
    for name in ("loss", "grad"):
        assert np.array_equal(dataset[name].to_numpy()[there], whole[name].to_numpy()[there])
        assert np.isnan(dataset[name].to_numpy()[~there]).all()
    assert np.array_equal(np.isnan(dataset["interpolated"]), there)


@pytest.mark.parametrize("budget", [90, 200, 1000])
def test_a_budget_is_not_exceeded_and_is_used(budget: int) -> None:
    for share in (None, 1e-5):
        dataset = refined(jumping, 65, share, budget)
        assert 0.8 * budget <= sampled(dataset).sum() <= budget
    finest = refined(lambda x: x[:, 0], 33, None, 5000)  # what is exact is not sampled for the budget's sake alone
    assert sampled(finest).mean() < 0.8


@pytest.mark.parametrize(("share", "budget"), [(None, None), (0.0, None), (1.5, None), (math.nan, None), (None, 80)])
def test_a_share_and_a_budget_are_numbers_that_make_sense(share: float | None, budget: int | None) -> None:
    said = "begins with 81 points; got a budget of 80" if budget else "refining takes a share"
    with pytest.raises(ValueError, match=said):
        refined(bowl, 65, share, budget)


@pytest.mark.parametrize("points", [2, 3, (2, 9), (7, 50)])
def test_small_and_narrow_grids_are_refined_too(points: int | tuple[int, ...]) -> None:
    for grad in (True, False):
        dataset = refined(jumping, points, grad=grad)
        assert np.isfinite(dataset["loss"].fillna(dataset["interpolated"])).all()


def test_failures_are_surrounded_and_not_interpolated_over() -> None:
    def failing(x: Tensor) -> Tensor:
        return torch.where(x.square().sum(dim=1) < 0.3, torch.nan, bowl(x))

    dataset = refined(failing, 65)
    failed = np.asarray(dataset["u"] ** 2 + dataset["v"] ** 2 < 0.3).T
    filled = dataset["loss"].fillna(dataset["interpolated"]).to_numpy()
    assert (np.isnan(filled) == failed).mean() > 0.99
    drawn = own_cells(dataset)
    assert set(np.unique(drawn["status"])) == {Status.OK, Status.NONFINITE}
    everywhere = refined(lambda x: torch.nan * x[:, 0], 33)
    assert set(np.unique(everywhere["status"])) == {Status.NONFINITE, Status.INTERPOLATED}


class Stopping(Counted):
    """A function that is stopped at every so many calls, as Ctrl-C does."""

    space, name = SPACE, "stopping"

    def __init__(self, function: Function, every: int) -> None:
        super().__init__(batch=40)
        self.inner, self.every = from_torch(function, SPACE, name="stopping"), every

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        if self.every and (len(self.sizes) + 1) % self.every == 0:
            self.sizes.append(0)
            raise KeyboardInterrupt
        return super().evaluate(x, grad=grad)

    def answer(self, x: Tensor, *, grad: bool) -> Evaluation:
        return self.inner.evaluate(x, grad=grad)


def runs(objective: Objective, path: Path, over: Plane, **how: Any) -> Iterator[xr.Dataset | None]:
    """Yield what each attempt to refine a slice on disk comes to, None where it was stopped."""
    while True:
        store = SliceStore.open_or_create(path, over, SPACE, identity={"objective": "stopping"})
        try:
            yield refine(objective, over, store, Refinement(0.02), **how)
        except KeyboardInterrupt:
            yield None


def test_one_that_is_stopped_goes_on_and_has_the_same_bits_and_so_have_workers(tmp_path: Path) -> None:
    over = plane(65)
    whole = next(runs(Stopping(jumping, 0), tmp_path / "one" / "slice.zarr", over))
    with ThreadPoolExecutor(3) as executor:
        many = next(runs(Stopping(jumping, 0), tmp_path / "many" / "slice.zarr", over, executor=executor))
    stopping = Stopping(jumping, 3)
    ended = [one for one, _ in zip(runs(stopping, tmp_path / "two" / "slice.zarr", over), range(60), strict=False)]
    first = next(number for number, one in enumerate(ended) if one is not None)
    assert first > 3
    assert whole is not None
    xr.testing.assert_identical(many, whole)
    xr.testing.assert_identical(ended[first], whole)
    xr.testing.assert_identical(ended[-1], whole)  # which was finished
    assert len(stopping.asked) == len(set(stopping.asked)) == sampled(whole).sum()
    assert sorted(path.name for path in (tmp_path / "two").iterdir()) == ["slice.zarr.zip"]
    stored = open_slice(tmp_path / "two" / "slice.zarr")
    xr.testing.assert_equal(stored, whole)
    plain = xr.open_zarr(ZipStore(tmp_path / "two" / "slice.zarr.zip")).load()
    assert "interpolated" in plain["status"].attrs["flag_meanings"]
    assert np.isfinite(plain["loss"].fillna(plain["interpolated"])).all()


def test_a_damaged_piece_is_evaluated_again(tmp_path: Path) -> None:
    over, path = plane(65), tmp_path / "slice.zarr"
    attempts = runs(Stopping(jumping, 6), path, over)
    assert next(attempts) is None
    piece = next(filling_path(path).rglob("*.npz"))
    piece.write_bytes(b"no piece")
    with pytest.warns(RuntimeWarning, match="damaged"):
        result = next(one for one in attempts if one is not None)
    xr.testing.assert_identical(result, next(runs(Stopping(jumping, 0), tmp_path / "b" / "slice.zarr", over)))


def test_a_damaged_slice_is_refused_and_another_grid_too(tmp_path: Path) -> None:
    over, path = plane(65), tmp_path / "slice.zarr"
    next(runs(Stopping(jumping, 0), path, over))
    break_chunk(path, "loss/c/0/0")
    with pytest.raises(DamagedError, match="samples are lost"):
        next(runs(Stopping(jumping, 0), path, over))
    store = SliceStore.in_memory(plane(33), SPACE)
    with pytest.raises(StoreMismatchError):
        refine(from_torch(bowl, SPACE), over, store, Refinement(0.02))


def test_nothing_interpolated_enters_a_measure() -> None:
    dataset = refined(waves, 65)
    lattice = sampled_lattice(dataset)
    stride = 64 // (lattice.sizes["u"] - 1)
    assert not (lattice["status"] == Status.INTERPOLATED).any()
    assert np.array_equal(lattice["loss"], dataset["loss"][::stride, ::stride])
    for one in (lattice, sampled_lattice(refined(bowl, (40, 65)))):  # of an odd grid, too
        for name, axis in zip("uv", plane_of(one).axes(), strict=True):
            assert np.allclose(axis, one[name])
    whole = sample(from_torch(waves, SPACE), plane(64 // stride + 1))
    measured, wanted = (Slice(one).minima() for one in (dataset, whole))
    assert np.allclose(measured.to_numpy(), wanted.to_numpy())
    poisoned = dataset.assign(interpolated=dataset["interpolated"] + 1e9)
    objective = from_torch(waves, SPACE)
    for one in (dataset, poisoned):
        report = Slice(one, None, lambda: objective).report(points=2)
        assert report.losses.range < 3
        assert report.losses.samples == lattice["loss"].size
        assert report.losses.failed == 0
    assert to_json(report) == to_json(Slice(dataset, None, lambda: objective).report(points=2))
    table = frame(dataset)
    assert set(table["status"]) == {"ok", "interpolated"}
    assert table["loss"][table["status"] == "interpolated"].isna().all()


def test_it_says_what_it_came_to() -> None:
    dataset = refined(waves, 65)
    about = Refined.of(dataset)
    assert about is not None
    assert (about.points, about.sampled) == (65 * 65, sampled(dataset).sum())
    assert about.error is not None
    assert about.error <= 0.02
    assert about.say().startswith(f"{about.sampled} of 4225 points sampled, 95 % of the others to ")
    assert Refined.of(sample(from_torch(waves, SPACE), plane(5))) is None


def test_a_function_that_raises_says_so() -> None:
    def raising(x: object) -> object:
        raise RuntimeError("no more")

    with pytest.raises(ValueError, match=r"raising raised at all .* points where it was tried.*RuntimeError: no more"):
        refine(from_numpy(raising, SPACE), plane(33), SliceStore.in_memory(plane(33), SPACE), Refinement(0.1))
