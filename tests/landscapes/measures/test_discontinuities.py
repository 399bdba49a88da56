"""Noise floors, and jumps found by looking closer."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape import ParameterSpace, Plane, from_numpy, from_torch, sample
from gradscape.landscapes.measures.discontinuities import EVALUATIONS_PER_PAIR, HALVINGS, LEAST, Jump, Jumps, find_jumps
from gradscape.landscapes.measures.noise import noise, noise_floor
from gradscape.landscapes.objective import Objective
from gradscape.landscapes.statistics import Estimate, share

SPACE = ParameterSpace.box(("x", "y"), -1.0, 1.0)
EDGE = 0.2371


def sampled(
    fn: Callable[[torch.Tensor], torch.Tensor], dims: tuple[int, ...] = (0, 1), resolution: int = 24
) -> tuple[Objective, xr.Dataset]:
    objective = from_torch(fn, SPACE)
    return objective, sample(objective, Plane.through(SPACE, SPACE.center, dims, resolution=resolution))


def jumps(objective: Objective, dataset: xr.Dataset, **how: Any) -> Jumps:
    (found,) = find_jumps(objective, [dataset], **how)
    return found


def step(x: torch.Tensor) -> torch.Tensor:
    return 3.0 * (x[:, 0] > EDGE) + 0.1 * x.square().sum(1)


def bowl(x: torch.Tensor) -> torch.Tensor:
    return x.square().sum(1) / 2


def noise_of_place(x: torch.Tensor) -> torch.Tensor:
    """Return what looks like noise, uniform in [-1, 1], and is the same again at the same place."""
    mixed = 43758.5453 * (x.detach() @ torch.tensor([12.9898, 78.233]).double())
    return torch.frac(9999 * torch.sin(mixed)) + 0 * x[:, 0]


def test_a_step_is_one_jump_at_its_place_and_of_its_height() -> None:
    objective, dataset = sampled(step, (0,), 50)
    found = jumps(objective, dataset)
    assert len(found.found) == 1
    assert found.found[0].place[0] == pytest.approx(EDGE, abs=2 / 49 / 4096)
    assert found.found[0].height == pytest.approx(3, abs=2e-3)
    assert found.largest == pytest.approx(3 / found.range, rel=1e-3)
    assert (found.lines, found.crossed, found.share) == (1, 1, Estimate(1.0, 1.0, 1.0))


@pytest.mark.parametrize("resolution", [12, 24, 48, 96, 192])
def test_a_step_crosses_every_row_and_no_column_at_any_resolution(resolution: int) -> None:
    objective, dataset = sampled(step, resolution=resolution)
    found = jumps(objective, dataset, most=resolution)
    assert found.lines == 2 * resolution
    assert found.share == Estimate(0.5, 0.5, 0.5)
    some = jumps(objective, dataset, most=8)
    assert 0 < some.share.low < some.share.value == some.share.high == 0.5


def test_16_pairs_find_a_step_through_half_of_the_range_at_96_samples() -> None:
    objective, dataset = sampled(lambda x: 2 * bowl(x) + 2.0 * (x[:, 0] > EDGE), resolution=96)
    found = jumps(objective, dataset, most=16)
    assert (found.checked, len(found.found)) == (16, 16)
    assert found.largest == pytest.approx(0.5, abs=0.01)
    assert found.sentence.startswith("jumps up to 50 % of the range; 50 % (")


@pytest.mark.parametrize("resolution", [12, 48, 96])
@pytest.mark.parametrize("height", [0.005, 0.02, 0.05, 0.1, 0.5])
@pytest.mark.parametrize("sign", [-1, 1])
def test_faults_count_from_a_hundredth_of_the_range_on(height: float, sign: int, resolution: int) -> None:
    """A fault against the slope differs by less than its height from sample to sample, and counts all the same."""

    def fault(x: torch.Tensor) -> torch.Tensor:
        return bowl(x) - sign * height * (x[:, 0] + 0.3 * x[:, 1] > EDGE)

    found = jumps(*sampled(fault, resolution=resolution))
    if height < LEAST:
        assert (found.found, found.share.value) == ((), 0)
        assert found.sentence.startswith("none of 1 % of the range or more")
    else:
        assert found.found[0].height == pytest.approx(height, rel=0.02)
        assert found.share.low < 0.66 < 0.6 + found.share.high  # all rows, and the columns between -0.1 and 0.6
        assert found.share.value == pytest.approx((1 + 0.3) / 2, abs=1.2 / resolution)


@pytest.mark.parametrize("resolution", [24, 96])
def test_a_curved_fault_crosses_rows_and_columns(resolution: int) -> None:
    radius = 0.61
    found = jumps(*sampled(lambda x: bowl(x) + 0.1 * (x.norm(dim=1) > radius), resolution=resolution))
    assert found.share.low <= radius <= found.share.high + 2 / resolution
    assert all(math.hypot(*jump.place) == pytest.approx(radius, abs=1e-4) for jump in found.found)


def test_a_staircase_of_small_steps_jumps_at_every_resolution() -> None:
    for resolution in (12, 51, 96):  # 51 samples: a step between each two of them
        found = jumps(*sampled(lambda x: torch.floor(25 * x[:, 0]) / 25 + 0 * x[:, 1], resolution=resolution), most=16)
        assert found.found[0].height == pytest.approx(0.04)
        assert found.share.high == pytest.approx(0.5)


@pytest.mark.parametrize("steepness", [20, 200, 5000])
@pytest.mark.parametrize("resolution", [12, 20, 96])
def test_a_steep_slope_between_two_samples_is_no_jump(steepness: float, resolution: int) -> None:
    found = jumps(*sampled(lambda x: torch.tanh((x[:, 0] - EDGE) * steepness), (0,), resolution))
    assert found.found == ()
    assert found.checked > 0 or resolution == 96


def test_jumps_are_found_without_gradients_and_with_exploding_ones() -> None:
    objective, dataset = sampled(step, resolution=48)
    assert len(jumps(objective, dataset.drop_vars("grad"), most=16).found) == 16
    exploding = from_numpy(lambda x: ((x**2).sum(axis=1) + (x[:, 0] > EDGE), 1e9 * np.sign(np.sin(1e5 * x))), SPACE)
    dataset = sample(exploding, Plane.through(SPACE, SPACE.center, (0, 1), resolution=48))
    found = jumps(exploding, dataset, most=16)
    assert found.settled == found.crossed - found.hit == 8  # each of the strongest traces is a jump
    assert found.share.low < 0.5 < found.share.high


def test_noise_is_no_jump_and_hides_none_that_is_larger() -> None:
    generator = torch.Generator().manual_seed(0)

    def noisy(x: torch.Tensor) -> torch.Tensor:
        return bowl(x) + 0.05 * torch.randn(len(x), generator=generator)  # 5 % of the range

    def fault(x: torch.Tensor) -> torch.Tensor:
        return noisy(x) + 0.8 * (x[:, 0] > EDGE)

    for resolution in (12, 24, 96):
        found = jumps(*sampled(noisy, resolution=resolution))
        assert (found.found, found.checked > 0) == ((), True)
        assert jumps(*sampled(fault, resolution=resolution), least=[0.4]).found
    objective, dataset = sampled(lambda x: bowl(x) + 0.05 * noise_of_place(x), resolution=48)
    assert jumps(objective, dataset, most=500).found == ()


def test_a_fractal_surface_does_not_jump() -> None:
    """Weierstrass's function with a Hölder exponent of 0.2, rough down to a millionth of the box."""
    waves = 2.0 ** torch.arange(21, dtype=torch.float64)
    objective, dataset = sampled(
        lambda x: (waves**-0.2 * torch.cos(waves * math.pi * (x[:, :1] + 0.7 * x[:, 1:]))).sum(1), resolution=48
    )
    found = jumps(objective, dataset, most=500)
    assert (found.found, found.checked > 400) == ((), True)


def test_the_power_of_a_search_is_that_of_the_lines_that_were_drawn() -> None:
    record = Jumps(
        (), 1.0, 100.0, 100, crossed=0, settled=40, drawn=20, hit=0, clear=20, checked=0, undecided=0, evaluations=0
    )
    assert record.unseen == pytest.approx(0.6 * (1 - 0.05 ** (1 / 20)))
    assert record.sentence == "none of 1 % of the range or more; up to 9 % of lines could have one"
    assert replace(record, drawn=60, clear=60).unseen == 0
    assert replace(record, drawn=0, clear=0).unseen == 0.6
    assert replace(record, drawn=60, clear=57).unseen == pytest.approx(0.03)
    found = replace(record, found=(Jump((0.0,), 30.0, None),), crossed=12, hit=10, clear=10)
    assert found.sentence == "jumps up to 30 % of the range; 32 % (18 to 46) of lines cross one"
    assert found.share.low == pytest.approx((2 + 60 * share(10, 20).low) / 100)
    assert math.isnan(found.unseen)
    vague = replace(found, clear=0)
    assert vague.sentence == "jumps up to 30 % of the range; 18 to 62 % of lines cross one"


def test_shares_of_lines_hold_in_most_of_many_searches() -> None:
    """A fault through 40 % of the columns' height, every line of which has ripples that are traces, too."""

    def rippled(x: torch.Tensor) -> torch.Tensor:
        return torch.sin(40 * x).sum(1) / 8 + 0.5 * ((x[:, 0] > EDGE) & (x[:, 1] > 0.2))

    objective, dataset = sampled(rippled, resolution=40)
    every = jumps(objective, dataset, most=10**6)
    assert every.drawn == 0
    held = [
        one.low <= every.share.value <= one.high
        for one in (jumps(objective, dataset, most=24, seed=seed).share for seed in range(40))
    ]
    assert sum(held) >= 36
    assert every.share.value == pytest.approx((0.4 + (1 - EDGE) / 2) / 2, abs=0.02)


def test_a_jump_beside_a_failure_is_left_undecided() -> None:
    objective, dataset = sampled(lambda x: torch.where((x[:, 0] - EDGE).abs() < 1e-3, torch.nan, step(x)), (0,), 50)
    found = jumps(objective, dataset)
    assert (found.checked, found.undecided, len(found.found)) == (1, 1, 0)
    assert found.unseen == 1


def test_jumps_are_tied_to_what_is_counted_differently_across_them() -> None:
    objective, dataset = sampled(lambda x: step(x) + 2.0 * (x[:, 1] > EDGE))
    found = jumps(objective, dataset, events=lambda x: {"bounces": (x[:, 0] > EDGE).int()})
    assert found.explained_by_events is not None
    assert found.explained_by_events.value == 0.5
    assert found.found[0].event is True  # the highest
    unseen = jumps(objective, dataset, events=lambda x: {})
    assert unseen.explained_by_events is None


def test_several_slices_are_one_batch_and_each_has_its_own_jumps() -> None:
    calls = list[int]()

    def counted(x: torch.Tensor) -> torch.Tensor:
        calls.append(len(x))
        return step(x)

    objective = from_torch(counted, SPACE)
    windows = ((-1.0, 1.0), (0.0, 1.0), (-1.0, 0.0))
    planes = [Plane.through(SPACE, SPACE.center, (0, 1), resolution=8, window=window) for window in windows]
    datasets = [sample(objective, plane) for plane in planes]
    calls.clear()
    found = find_jumps(objective, datasets)
    assert [one.crossed for one in found] == [8, 8, 0]
    assert len(calls) == 2 + HALVINGS
    assert sum(calls) == sum(one.evaluations for one in found) == 16 * EVALUATIONS_PER_PAIR


def test_a_slice_of_failures_or_of_one_value_has_no_jump() -> None:
    for constant in (1.0, math.nan):
        objective, dataset = sampled(lambda x: torch.full_like(x[:, 0], constant) + 0 * x.sum(1))  # noqa: B023
        found = jumps(objective, dataset)
        assert (found.checked, found.found, found.largest) == (0, (), 0)


def test_noise_is_that_of_repeats_of_batches_and_of_rounding() -> None:
    rng, x = np.random.default_rng(0), SPACE.uniform(100, seed=0)
    noisy = from_numpy(lambda x: (x**2).sum(axis=1) + 1e-3 * rng.normal(size=len(x)), SPACE)
    found = noise(noisy, x, rounding=1e-16)
    assert found.again == pytest.approx(1e-3, rel=0.15)
    assert found.batch == pytest.approx(1e-3, rel=0.25)
    assert noise_floor(1.0, 2304) == pytest.approx(2 * math.sqrt(2 * math.log(2304)))
    exact = noise(from_torch(lambda x: x.square().sum(1), SPACE), x, rounding=1e-7)
    assert exact.again == exact.batch == 0
    assert 1e-8 < exact.rounding < 1e-6
    rounded = from_torch(lambda x: x.float().square().sum(1), SPACE)
    assert noise(rounded, x, rounding=2**-23).rounding > exact.rounding / 10
    leaky = noise(from_torch(lambda x: x.sum(1) + 1e-3 * x.mean(), SPACE), x, rounding=1e-16)
    assert leaky.again == 0
    assert leaky.batch > 1e-5
