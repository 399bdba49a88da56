"""Measures at twice the resolution, held against slices that have it, and the words that would change."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
import xarray as xr
from torch import Tensor

from gradscape import ParameterSpace, Plane, from_torch, sample
from gradscape.landscapes.measures.classify import classify, likeness
from gradscape.landscapes.measures.doubled_resolution import DoubledResolution, double_resolution, doubling_episodes
from gradscape.landscapes.measures.gradient_quality import compare_samples
from gradscape.landscapes.measures.ruggedness import Ruggedness, ruggedness

Function = Callable[[Tensor], Tensor]
SPACE = ParameterSpace.box(("x", "y"), -1.0, 1.0)


def rippled(x: Tensor) -> Tensor:
    """Return a bowl with ripples that samples of 33 miss: they have the same phase at each."""
    return x.square().sum(dim=1) + 0.2 * torch.cos(2 * math.pi * 16 * x).sum(dim=1)


def waves(x: Tensor) -> Tensor:
    return torch.sin(9 * x[:, 0]) * torch.cos(7 * x[:, 1]) + x[:, 0]


def plateau(x: Tensor) -> Tensor:
    return -torch.relu(0.5 - x.square().sum(dim=1))


def measured(function: Function, points: int, dims: tuple[int, ...]) -> tuple[xr.Dataset, Ruggedness, np.ndarray]:
    objective = from_torch(function, SPACE)
    dataset = sample(objective, Plane.through(SPACE, SPACE.center, dims, resolution=points))
    cosine = compare_samples(dataset)["cosine"].isel(scale=0).to_numpy()
    return dataset, ruggedness(dataset, floor=0.0), cosine


def twice(function: Function, points: int, dims: tuple[int, ...] = (0, 1), seed: int = 0) -> DoubledResolution:
    dataset, found, cosine = measured(function, points, dims)
    result = double_resolution(from_torch(function, SPACE), dataset, found, None, cosine, deviation=0.0, seed=seed)
    losses, gradients = doubling_episodes(dataset["loss"].shape)
    own = (losses + gradients) // (17 if len(dims) == 2 else 3)  # one gradient of each block is the slice's own
    assert result.episodes == losses + gradients - own
    return result


@pytest.mark.parametrize(
    ("function", "points", "dims"), [(waves, 33, (0, 1)), (plateau, 41, (0, 1)), (waves, 301, (0,))]
)
def test_measures_are_those_of_a_slice_that_is_twice_as_fine(
    function: Function, points: int, dims: tuple[int, ...]
) -> None:
    found = twice(function, points, dims).measures
    _, fine, cosine = measured(function, 2 * points - 1, dims)
    average, uphill = likeness(cosine)
    wanted = {"turns": fine.turns.value, "level": fine.level.value, "flat": fine.flat.value}
    for name, value in (wanted | {"cosine": average, "uphill": uphill}).items():
        assert found[name].value == pytest.approx(value, abs=0.05), name


def test_words_that_the_samples_miss_appear_and_those_that_they_make_up_go() -> None:
    _, found, cosine = measured(rippled, 33, (0, 1))
    assert classify(found, None, cosine).words == ("very smooth", "gradients good")
    said = twice(rippled, 33)
    assert said.go == ("very smooth",)
    assert said.appear == ("extremely rugged",)


@pytest.mark.parametrize("function", [lambda x: x.square().sum(dim=1), waves, plateau])
def test_of_what_the_samples_show_no_word_changes(function: Function) -> None:
    said = twice(function, 33)
    assert (said.appear, said.go) == ((), ())


def test_a_tenth_of_the_cells_is_sampled() -> None:
    assert doubling_episodes((41, 41)) == (40 * 8, 40 * 9)  # in blocks of four cells
    assert doubling_episodes((201,)) == (0, 10 * 3)


def test_blocks_with_a_failure_are_left_out_and_few_say_nothing() -> None:
    said = twice(lambda x: torch.where(x[:, 0] > 0.5, torch.nan, waves(x)), 33)
    assert np.isfinite(said.measures["turns"].value)
    objective = from_torch(lambda x: torch.where(x[:, 0] > -0.95, torch.nan, waves(x)), SPACE)
    dataset = sample(objective, Plane.through(SPACE, SPACE.center, (0, 1), resolution=9))
    _, found, cosine = measured(waves, 9, (0, 1))
    assert double_resolution(objective, dataset, found, None, cosine, deviation=0.0) is None
