"""Noise floors, and jumps found by looking closer."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape import ParameterSpace, Plane, from_numpy, from_torch, sample
from gradscape.landscapes.measures.discontinuities import Jumps, find_jumps
from gradscape.landscapes.measures.noise import noise
from gradscape.landscapes.objective import Objective

SPACE = ParameterSpace.box(("x", "y"), -1.0, 1.0)
EDGE = 0.2371


def sampled(
    fn: Callable[[torch.Tensor], torch.Tensor], dims: tuple[int, ...] = (0, 1), resolution: int = 24
) -> tuple[Objective, xr.Dataset]:
    objective = from_torch(fn, SPACE)
    return objective, sample(objective, Plane.through(SPACE, SPACE.center, dims, resolution=resolution))


def jumps(objective: Objective, dataset: xr.Dataset, least: float, **how: Any) -> Jumps:
    (found,) = find_jumps(objective, [dataset], least=[least], **how)
    return found


def step(x: torch.Tensor) -> torch.Tensor:
    return 3.0 * (x[:, 0] > EDGE) + 0.1 * x.square().sum(1)


def test_a_step_is_one_jump_at_its_place_and_of_its_height() -> None:
    objective, dataset = sampled(step, (0,), 50)
    found = jumps(objective, dataset, least=0.1)
    assert len(found.found) == 1
    assert found.found[0].place[0] == pytest.approx(EDGE, abs=2 / 49 / 4096)
    assert found.found[0].height == pytest.approx(3, abs=1e-3)
    assert found.share.value == pytest.approx(1 / 49)


def test_every_row_of_a_plane_crosses_it_once() -> None:
    objective, dataset = sampled(step)
    found = jumps(objective, dataset, least=0.5)
    assert (len(found.found), found.steep, found.neighbours) == (24, 24, 2 * 24 * 23)
    assert found.share.value == found.share.low == found.share.high == pytest.approx(24 / found.neighbours)
    some = jumps(objective, dataset, least=0.5, most=8)
    assert some.share.low < some.share.value == found.share.value


def test_a_steep_slope_between_two_samples_is_no_jump() -> None:
    objective, dataset = sampled(lambda x: torch.tanh((x[:, 0] - EDGE) * 200), (0,), 20)  # a tenth of a step wide
    found = jumps(objective, dataset, least=1e-6)
    assert found.checked > 0
    assert len(found.found) == 0


def test_a_jump_beside_a_failure_is_left_undecided() -> None:
    objective, dataset = sampled(lambda x: torch.where((x[:, 0] - EDGE).abs() < 1e-3, torch.nan, step(x)), (0,), 50)
    found = jumps(objective, dataset, least=0.5)
    assert (found.checked, found.undecided, len(found.found)) == (1, 1, 0)


def test_jumps_are_tied_to_what_is_counted_differently_across_them() -> None:
    objective, dataset = sampled(lambda x: step(x) + 2.0 * (x[:, 1] > EDGE))
    found = jumps(objective, dataset, least=0.5, events=lambda x: {"bounces": (x[:, 0] > EDGE).int()})
    assert found.explained_by_events.value == 0.5
    assert found.found[0].event is True  # the highest
    unseen = jumps(objective, dataset, least=0.5, events=lambda x: {})
    assert unseen.explained_by_events is None


def test_a_constant_slice_has_no_steep_pair() -> None:
    objective, dataset = sampled(lambda x: 0 * x.sum(1))
    assert jumps(objective, dataset, least=0.0).checked == 0


def test_noise_is_measured_where_the_objective_is_noisy() -> None:
    rng = np.random.default_rng(0)

    def noisy(x: np.ndarray) -> np.ndarray:
        return (x**2).sum(axis=1) + 1e-3 * rng.normal(size=len(x))

    found = noise(from_numpy(noisy, SPACE), SPACE.uniform(100, seed=0), rounding=1e-16)
    assert found.again == pytest.approx(1e-3, rel=0.15)
    assert found.batch == pytest.approx(1e-3, rel=0.25)
    assert found.floor(2304) == pytest.approx(2 * found.deviation * math.sqrt(2 * math.log(2304)))


def test_a_deterministic_objective_has_round_off_only() -> None:
    exact = from_torch(lambda x: x.square().sum(1), SPACE)
    found = noise(exact, SPACE.uniform(50, seed=0), rounding=1e-7)
    assert found.again == found.batch == 0
    assert 1e-8 < found.rounding < 1e-6
    rounded = from_torch(lambda x: x.float().square().sum(1), SPACE)
    assert noise(rounded, SPACE.uniform(50, seed=0), rounding=2**-23).rounding > found.rounding / 10


def test_a_loss_that_depends_on_its_batch_is_found_out() -> None:
    leaky = from_torch(lambda x: x.sum(1) + 1e-3 * x.mean(), SPACE)
    found = noise(leaky, SPACE.uniform(30, seed=0), rounding=1e-16)
    assert found.again == 0
    assert found.batch > 1e-5
