"""The surface in a word: counts at fixed scales, what samples do not tell, and words that are left out then."""

import itertools
import json
import math

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape import ParameterSpace, Plane, from_torch, sample
from gradscape.landscapes.measures.surface import (
    Between,
    Surface,
    level_share,
    look_between,
    measure_surface,
    rounding,
    short_exponent,
    turning_points,
)

SPACE = ParameterSpace.box(("x", "y"), 0.0, 1.0)
NONE = np.zeros(0)


def data(loss: np.ndarray) -> xr.Dataset:
    """Return losses as a slice without gradients."""
    dims = ("v", "u")[-loss.ndim :]
    plane = Plane.through(SPACE, SPACE.center, (0, 1)[: loss.ndim], resolution=loss.shape[0])
    return xr.Dataset({"loss": (dims, loss)}, attrs={"identity": json.dumps({"plane": plane.record()})})


def judged(fn, resolution: int, *, alone: bool = False) -> Surface:
    objective = from_torch(fn, SPACE)
    dataset = sample(objective, Plane.through(SPACE, SPACE.center, (0, 1), resolution=resolution))
    between = None if alone else look_between(objective, [dataset], [0.0])[0]
    return measure_surface(dataset, between=between)


def test_a_line_turns_back_where_it_goes_by_more_than_the_depth_however_many_samples_it_has() -> None:
    line = np.array([0.0, 1.0, 0.9, 2.0, 0.0, 0.05, np.nan, 3.0])
    assert turning_points(line, 0, 0.5) == 2  # at 2 and at 0
    assert turning_points(line, 0, 0.05) == 4  # at 1 and 0.9, too
    assert turning_points(line[::-1].copy(), 0, 0.5) == 2
    assert turning_points(np.stack([line, np.arange(8.0)]), 1, 0.5) == 1  # the mean of two lines
    assert math.isnan(turning_points(np.full(8, np.nan), 0, 0.5))
    for periods, points in itertools.product((2, 5), (40, 41, 160)):
        waves = np.sin(2 * np.pi * periods * np.linspace(0, 1, points))
        assert turning_points(waves, 0, 0.02) == 2 * periods


def test_a_plateau_fills_the_share_of_the_box_that_it_has() -> None:
    for points in (40, 160):
        u = np.linspace(0, 1, points)
        loss = np.maximum(u - 0.4, 0.0)[None, :] + np.zeros((points, 1))
        assert level_share(loss, 0.0).value == pytest.approx(0.4, abs=0.03)
        hidden = level_share(loss, 0.05)
        assert math.isnan(hidden.value)
        assert 0.4 <= hidden.high <= 1.0


@pytest.mark.parametrize("power", [0.3, 0.6, 1.0])
def test_the_exponent_over_short_distances_is_that_of_the_differences(power: float) -> None:
    draw = np.random.default_rng(0)
    rise = np.abs(draw.standard_normal((96, 1))) * 2.0 ** (-power * np.array([11, 10, 9, 8]))
    found = short_exponent(Between(NONE, NONE, rise, NONE), 0.0)
    assert found.value == pytest.approx(power)
    assert math.isnan(short_exponent(Between(NONE, NONE, rise, NONE), 1.0).value)  # all within the noise
    assert math.isnan(short_exponent(Between(NONE, NONE, rise[:10], NONE), 0.0).value)


def test_a_narrow_valley_has_one_minimum_though_its_samples_have_several() -> None:
    """Along a valley at an angle samples lie now nearer to its bottom and now farther from it."""

    def valley(x: torch.Tensor) -> torch.Tensor:
        return (x[:, 0] + 0.4 * x[:, 1] - 0.6).abs()

    found = judged(valley, 24)
    assert (found.minima.value, found.word) == (1, "very smooth")
    alone = judged(valley, 24, alone=True)
    assert alone.minima.value > 1
    assert alone.word is None
    assert "minima" in alone.unresolved


def test_what_lies_between_samples_is_seen_and_the_word_left_out() -> None:
    """Waves with a sample at each of their crests look level; both gradients and other places contradict that."""

    def waves(x: torch.Tensor) -> torch.Tensor:
        return x[:, 0] + 0.3 * torch.cos(2 * math.pi * 23 * x[:, 0]) + 0 * x[:, 1]

    for alone in (False, True):
        found = judged(waves, 24, alone=alone)
        assert found.word != "rugged"
        if not alone:
            assert (found.word, found.probed) == (None, True)
            assert found.off.low > 0.5
    fine = judged(waves, 96)
    assert fine.word == "rugged"
    assert fine.turns[0].value == pytest.approx(46, abs=1)  # u first
    assert fine.turns[1].value == 0


def test_a_rugged_surface_of_too_few_samples_is_rugged_at_least() -> None:
    loss = np.random.default_rng(0).random((20, 20))
    found = measure_surface(data(loss))
    assert (found.word, found.at_least) == ("rugged", True)


def test_what_ranges_over_no_more_than_noise_or_rounding_or_the_whole_is_flat() -> None:
    ramp = np.linspace(0, 1, 12)[None, :] + np.zeros((12, 1))
    assert not measure_surface(data(ramp)).flat
    assert measure_surface(data(ramp), floor=1.1).flat
    assert measure_surface(data(ramp), own_range=101.0).flat
    assert measure_surface(data(0 * ramp)).flat
    single = (1e4 + 1e-3 * ramp).astype(np.float32).astype(float)
    assert measure_surface(data(single)).flat
    assert not measure_surface(data(1e4 + 1e-3 * ramp)).flat  # in float64 that is a slope
    failed = measure_surface(data(np.full((12, 12), np.nan)))
    assert (failed.flat, failed.word) == (False, None)
    assert rounding(np.full(3, np.nan)) == 0


def test_lines_have_a_word_too_and_noise_hides_what_is_below_it() -> None:
    u, fine = np.linspace(-1, 1, 40), np.linspace(-1, 1, 160)
    wells = data((u**2 - 0.4) ** 2)
    assert measure_surface(data(u**2)).word == "very smooth"
    assert measure_surface(wells).word == "smooth with local minima"
    step, noisy = measure_surface(data(fine**2 + (fine > 0.3))), measure_surface(wells, floor=0.1)
    assert step.word is noisy.word is None
    assert "could be a jump, of " in step.unresolved
    assert noisy.unresolved == "noise or numerics hide differences below 28 % of the range"
