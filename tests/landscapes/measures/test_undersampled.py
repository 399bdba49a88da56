"""What the samples of a slice hide: functions whose jumps, ridges and slopes have a known width."""

import math
import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
import xarray as xr
from torch import Tensor

from gradscape.envs.adapters import from_numpy, from_torch
from gradscape.jobs.slice import look_between
from gradscape.landscapes.measures.undersampled import (
    ATTRIBUTE,
    Undersampled,
    contradicted_cells,
    find_undersampled,
    probes,
)
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace(["a", "b"], [-1.0, -1.0], [1.0, 1.0])
RIDGE = 0.006  # standard deviation of a ridge; samples of 32 are 0.065 apart
ACROSS = math.hypot(1.0, 0.37)


def bowl(x: Tensor) -> Tensor:
    return x.square().sum(dim=1) + x[:, 0] * x[:, 1]


def ridged(x: Tensor) -> Tensor:
    return bowl(x) + 2 * torch.exp(-(((x[:, 0] + 0.37 * x[:, 1] - 0.1) / ACROSS / RIDGE) ** 2) / 2)


def jumping(x: Tensor) -> Tensor:
    return bowl(x) + (x[:, 0] + 0.3 * x[:, 1] > 0.11).double()


def steep(x: Tensor) -> Tensor:
    return torch.tanh(8 * x[:, 0])


def cut(
    function: Callable[[Tensor], Tensor], points: int = 32, dims: tuple[int, ...] = (0, 1), grad: bool = True
) -> tuple[Objective, xr.Dataset]:
    objective = from_torch(function, SPACE)
    plane = Plane.through(SPACE, torch.zeros(2), dims, resolution=points)
    return objective, sample(objective, plane, gradients=int(grad))


def look(
    function: Callable[[Tensor], Tensor], points: int = 32, dims: tuple[int, ...] = (0, 1), **how: bool
) -> Undersampled:
    found = find_undersampled(*cut(function, points, dims, **how))
    return found


@pytest.mark.parametrize("grad", [True, False])
@pytest.mark.parametrize("function", [bowl, steep, lambda x: x[:, 0], lambda x: 0 * x[:, 0] + 1.0])
def test_what_is_smooth_is_resolved_however_steep(function: Callable[[Tensor], Tensor], grad: bool) -> None:
    found = look(function, grad=grad)
    assert (found.share.value, found.found, found.undecided) == (0.0, 0, 0)


def test_a_ridge_thinner_than_a_sample_is_flagged_and_one_of_many_samples_is_not() -> None:
    share = look(ridged).share
    crossed = 31 * (2 / 31) / 2 * (1 + 0.37) * 31 / 31**2  # cells that a line across the box of this slope meets
    assert 0.5 * crossed < share.value < 2 * crossed
    assert share.low > 0
    wide = look(lambda x: bowl(x) + 2 * torch.exp(-(((x[:, 0] + 0.37 * x[:, 1]) / 0.3) ** 2)))
    assert wide.found == 0


@pytest.mark.parametrize("grad", [True, False])
def test_the_cells_of_a_jump_are_the_share_that_is_found(grad: bool) -> None:
    _, dataset = cut(jumping)
    sides = dataset["u"].to_numpy()[None, :] + 0.3 * dataset["v"].to_numpy()[:, None] > 0.11
    corners = np.stack([sides[:-1, :-1], sides[1:, :-1], sides[:-1, 1:], sides[1:, 1:]])
    crossed = float((corners.any(axis=0) & ~corners.all(axis=0)).mean())
    share = look(jumping, grad=grad).share
    assert share.low <= crossed <= share.high
    assert share.value == pytest.approx(crossed, rel=0.6)


@pytest.mark.parametrize("dims", [(0, 1), (0,)])
def test_cells_of_a_jump_and_no_others_are_contradicted(dims: tuple[int, ...]) -> None:
    _, dataset = cut(jumping, dims=dims)
    loss = dataset["loss"].to_numpy()
    found = contradicted_cells(dataset)
    assert found.shape == tuple(points - 1 for points in loss.shape)
    assert found.sum() >= 31 * (len(dims) - 1) + 1
    beyond = sum(dataset[name] * weight for name, weight in (("u", 1.0), ("v", 0.3)) if name in dataset) - 0.11
    corners = beyond.transpose(*dataset["loss"].dims).to_numpy()
    low, high = (corners[(part,) * len(dims)] for part in (slice(-1), slice(1, None)))
    assert ((low <= 0) & (high >= 0))[found].all()
    assert not contradicted_cells(cut(steep, dims=dims)[1]).any()


def test_no_cell_beside_a_failure_is_contradicted() -> None:
    _, dataset = cut(jumping)
    loss = dataset["loss"].to_numpy().copy()
    loss[10:20] = np.nan
    found = contradicted_cells(dataset.assign(loss=dataset["loss"].copy(data=loss)))
    assert found.any()
    assert not found[9:20].any()


def test_shares_of_lines_of_halved_jumps_and_of_what_left_no_trace() -> None:
    # In the middle of an interval the loss is the mean of both sides; half the height is left after a halving.
    assert look(lambda x: torch.sign(x[:, 0]) + 0 * x[:, 0]).share.value == pytest.approx(1 / 31)
    assert look(jumping, 200, (0,)).share.value == pytest.approx(1 / 199)
    assert look(bowl, 200, (0,)).found == 0
    comb = 31 / 2 * math.pi  # a ripple that is zero, with its slope, at every sample
    met = look(lambda x: 0.01 * x[:, 0] + torch.sin(comb * (x[:, 0] + 1)).square()).share
    assert (met.value, met.low > 0.9) == (1.0, True)


@pytest.mark.parametrize(("points", "grad"), [(8, True), (24, True), (24, False), (50, True)])
def test_it_takes_a_tenth_of_the_slice_at_most(points: int, grad: bool) -> None:
    asked = 0

    def counted(x: Tensor) -> Tensor:
        nonlocal asked
        asked += len(x)
        return jumping(x)

    objective, dataset = cut(counted, points, grad=grad)
    asked = 0
    found = find_undersampled(objective, dataset)
    assert asked == found.episodes <= probes(points**2, grad=grad) <= points**2 / (5 if grad else 10)


@pytest.mark.parametrize("points", [2, 3, 4])
def test_of_few_samples_nothing_is_said(points: int) -> None:
    assert find_undersampled(*cut(jumping, points)) is None


def test_failures_are_left_out() -> None:
    def failing(x: Tensor) -> Tensor:
        return torch.where(x[:, 0] > 0.3, torch.nan, jumping(x))

    found = look(failing)
    assert found.cells == 20 * 31  # between the samples that did not fail
    assert found.share.value > 0
    assert find_undersampled(*cut(lambda x: torch.nan * x[:, 0])) is None

    def failing_between(x: Tensor) -> Tensor:
        steps = (x + 1) / 2 * 31
        return torch.where(((steps - steps.round()).abs() > 1e-6).any(dim=1), torch.nan, bowl(x))

    found = look(failing_between)
    assert found.undecided == found.probed > 0
    assert math.isnan(found.share.value)
    assert found.describe() == ""


def test_it_is_the_same_every_time_and_travels_as_text() -> None:
    objective, dataset = cut(jumping)
    said = look_between(objective, dataset)
    assert said == look_between(objective, dataset)
    found = Undersampled.of(dataset.assign_attrs(said))
    assert found.attribute() == said
    assert "undersampled cells: 4 %" in found.describe()
    assert Undersampled.of(dataset) is None
    assert Undersampled.of(dataset.assign_attrs({ATTRIBUTE: "["})) is None


def test_what_raises_between_the_samples_is_warned_of() -> None:
    _, dataset = cut(jumping)

    def raising(x: object) -> object:
        raise RuntimeError("no more")

    with pytest.warns(RuntimeWarning, match="raising raised an error between samples.*no more"):
        assert look_between(from_numpy(raising, SPACE), dataset) == {}
    with warnings.catch_warnings(), pytest.raises(OSError, match="gone"):
        look_between(Gone(), dataset)


class Gone(Objective):
    """An objective whose workers are lost."""

    space = SPACE

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        raise OSError("gone")
