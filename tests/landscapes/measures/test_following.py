"""How gradients follow functions whose slopes are known, with gradients that are right and wrong in known ways."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape import ParameterSpace, Plane, from_numpy, from_torch, sample
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.measures.following import SCALES, Following, follow_samples, measure_following
from gradscape.landscapes.measures.gradient_quality import central_differences
from gradscape.landscapes.objective import Objective

SPACE = ParameterSpace.box(("x", "y"), -1.0, 1.0)
PLANE = Plane.through(SPACE, SPACE.center, (0, 1), resolution=24)
Points = np.ndarray


def bowl(x: torch.Tensor) -> torch.Tensor:
    return x.square().sum(1)


def with_gradient(change: Callable[[Points, Points], Points]) -> Objective:
    """Return a bowl whose gradient is what `change` makes of its points and its own gradient."""
    return from_numpy(lambda x: ((x**2).sum(axis=1), change(x, 2 * x)), SPACE)


def following(objective: Objective, plane: Plane = PLANE, deviation: float = 0.0, **how: int) -> Following:
    (found,) = measure_following(objective, [plane], ranges=[2.0], deviation=deviation, **how)
    return found


def grades(found: Following) -> list[str | None]:
    return [one.grade for one in found.scales]


def test_right_gradients_of_a_smooth_function_follow_at_every_scale_and_nothing_else_is_said() -> None:
    found = following(from_torch(bowl, SPACE))
    assert found.words == ("gradients follow",)
    assert grades(found) == ["follow"] * 3
    for one in found.scales:
        assert one.quartiles == pytest.approx((1, 1, 1))
        assert (one.points, one.uphill.value) == (100, 0)
    assert 0 == found.missing.value == found.zero.value == found.exploding.value == found.biased.value


def test_gradients_of_a_ripple_follow_it_and_not_the_bowl_that_it_is_on() -> None:
    """A wave of 2 % of the box, or of 0.25 %: differences over 0.1 % see either, those over whole waves neither."""
    found = following(from_torch(lambda x: bowl(x) + 0.05 * torch.sin(50 * math.pi * x).sum(1), SPACE))
    assert found.scales[0].grade == "follow"
    assert found.scales[2].cosine.value < 0.6
    finer = following(from_torch(lambda x: bowl(x) + 0.01 * torch.sin(400 * math.pi * x).sum(1), SPACE))
    assert grades(finer) == ["follow", "not", "not"]
    assert finer.words == ("gradients do not follow",)
    assert "0.1 %: 1.00, follow; 1 %: " in finer.reasons["gradients do not follow"]


@pytest.mark.parametrize(
    ("angle", "grade", "word"),
    [
        (0.2, "follow", "gradients follow"),
        (0.8, "loosely", "gradients follow loosely"),
        (1.4, "not", "gradients do not follow"),
    ],
)
def test_the_mean_cosine_is_that_of_the_angle_of_gradients(angle: float, grade: str, word: str) -> None:
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    found = following(with_gradient(lambda x, slope: slope @ turn.T))
    for one in found.scales:
        assert one.cosine.value == pytest.approx(math.cos(angle))
    assert grades(found) == [grade] * 3
    assert found.words[0] == word


def test_a_grade_whose_interval_straddles_a_threshold_is_not_resolved_but_the_number_stands() -> None:
    found = following(
        with_gradient(lambda x, slope: np.where(np.sin(1e4 * x[:, :1]) > -0.85, slope, 0.3 * slope[:, ::-1]))
    )
    chief = found.at(0.01)
    assert chief is not None
    assert chief.grade is None
    assert chief.cosine.low < 0.9 < chief.cosine.high
    assert found.words == ()
    assert "not resolved" in found.sentence


SAID = {
    "opposite": (with_gradient(lambda x, slope: -slope), "do not follow", "opposite"),
    "random": (
        with_gradient(lambda x, slope: np.random.default_rng(0).normal(size=x.shape)),
        "do not follow",
        "biased",
    ),
    "zero": (with_gradient(lambda x, slope: 0 * slope), "zero"),
    "to rounding": (with_gradient(lambda x, slope: 1e-11 * slope), "zero"),
    "zero in a half": (with_gradient(lambda x, slope: slope * (x[:, :1] > 0)), "zero"),  # where they are stuck
    "plateau": (from_torch(lambda x: bowl(x).clamp(min=0.5), SPACE), "follow", "zero"),
    "flat": (from_torch(lambda x: 1 + 0 * x.sum(1), SPACE), "zero"),
    "a million times": (with_gradient(lambda x, slope: 1e6 * slope), "follow", "exploding"),
    "steep": (from_torch(lambda x: torch.tanh(50 * x[:, 0]) + 0 * x[:, 1], SPACE), "zero"),
    "missing": (with_gradient(lambda x, slope: np.where(x[:, :1] > 0.2, np.nan, slope)), "missing"),
    "few are missing": (with_gradient(lambda x, slope: np.where(x[:, :1] > 0.98, np.nan, slope)), "follow"),
    "failed": (from_torch(lambda x: torch.where(x[:, 0] > 0.2, torch.nan, bowl(x)), SPACE), "follow"),
    # Steps finer than the Gaussian double the slope of the smoothed loss; the gradient sees none of them.
    "stairs": (from_torch(lambda x: x.sum(1) + torch.floor(60 * x).sum(1) / 60, SPACE), "follow", "biased"),
    "one step": (from_torch(lambda x: bowl(x) + 0.5 * (x[:, 0] > 0.2371), SPACE), "follow"),
}


@pytest.mark.parametrize("name", SAID)
def test_each_fault_of_gradients_has_its_words(name: str) -> None:
    objective, *words = SAID[name]
    assert following(objective).words == tuple(f"gradients {word}" for word in words)


def test_shares_and_cosines_are_those_of_the_points_where_gradients_are_of_no_use() -> None:
    opposite, zero, half, plateau, missing, failed, stairs = (
        following(SAID[name][0])
        for name in ("opposite", "zero", "zero in a half", "plateau", "missing", "failed", "stairs")
    )
    assert [one.uphill.value for one in opposite.scales] == [1, 1, 1]
    assert (zero.zero.value, zero.stuck.value) == (1, 1)
    assert all(one.points == 0 and math.isnan(one.cosine.value) for one in zero.scales)
    assert half.stuck.low < 0.5 < half.stuck.high
    assert plateau.zero.low < 0.5 * math.pi / 4 / 0.95**2 < plateau.zero.high  # of the box without its border
    assert plateau.stuck.value < 0.05
    some = following(with_gradient(lambda x, slope: slope * np.where(np.sin(1e4 * x[:, :1]) > 0.9, 1e6, 1)))
    assert some.exploding.low < math.acos(0.9) / math.pi < some.exploding.high
    assert "gradients exploding" in some.words
    assert missing.missing.low < 0.4 < missing.missing.high
    assert failed.missing.value == 0
    assert stairs.biased.value == pytest.approx(1, abs=0.2)
    assert math.isnan(following(SAID["random"][0], smoothed=0).biased.value)


def test_a_line_is_followed_forwards_or_backwards() -> None:
    line = Plane.through(SPACE, SPACE.center, (0,), resolution=24)
    assert following(from_torch(lambda x: x[:, 0] ** 3 + 0 * x[:, 1], SPACE), line).words == ("gradients follow",)


def test_nothing_is_said_of_slopes_below_the_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    noisy = from_torch(lambda x: bowl(x) + 3e-3 * torch.randn(len(x), generator=generator), SPACE)
    found = following(noisy, deviation=3e-3)
    closest, chief, widest = (one.of for one in found.scales)
    assert closest == 0 < 20 < chief < widest <= 100
    assert found.sentence.startswith(
        "mean cosine of gradient and slope, by parts of the box: 0.1 %: no slope above the"
    )
    assert found.scales[2].grade == "follow"
    assert min(one.quartiles[0] for one in found.scales[1:]) > 0.9


def test_nothing_depends_on_the_samples_and_it_comes_back_from_json() -> None:
    rippled = from_torch(lambda x: bowl(x) + 0.01 * torch.sin(400 * math.pi * x).sum(1), SPACE)
    coarse, fine = (
        following(rippled, Plane.through(SPACE, SPACE.center, (0, 1), resolution=resolution), smoothed=36)
        for resolution in (12, 96)
    )
    assert coarse == fine
    assert to_json(fine)["words"] == ["gradients do not follow"]
    assert from_json(Following, to_json(fine)).reasons == fine.reasons


def test_several_planes_are_measured_in_one_batch_as_each_would_be_alone() -> None:
    calls = list[int]()

    def counted(x: torch.Tensor) -> torch.Tensor:
        calls.append(len(x))
        return bowl(x) + 0.1 * torch.sin(9 * x).sum(1)

    objective = from_torch(counted, SPACE)
    planes = [PLANE, Plane.through(SPACE, SPACE.center, (1, 0), resolution=9, window=(-0.5, 0.1))]
    both = measure_following(objective, planes, ranges=[2.0, 1.0], points=5, smoothed=0)
    assert calls == [10, 2 * 5 * 2 * 2 * len(SCALES)]
    alone = [
        measure_following(objective, [plane], ranges=[whole], points=5, smoothed=0)[0]
        for plane, whole in zip(planes, (2.0, 1.0), strict=True)
    ]
    assert [one.scales for one in both] == [one.scales for one in alone]


def test_central_differences_are_exact_on_a_quadratic_and_per_side_of_each_box() -> None:
    planes = [PLANE, Plane.through(SPACE, SPACE.center, (0, 1), resolution=5, window=(0.0, 0.5))]
    u = torch.tensor([[[0.3, -0.2]], [[0.25, 0.125]]]).double()
    found = central_differences(from_torch(bowl, SPACE), planes, u, (0.01, 0.1))
    assert found.shape == (2, 2, 1, 2)
    np.testing.assert_allclose(found[0, :, 0], [[1.2, -0.8]] * 2)
    np.testing.assert_allclose(found[1, :, 0], [[0.25, 0.125]] * 2)


def test_no_point_leaves_the_box_at_any_scale() -> None:
    seen = list[torch.Tensor]()

    def watched(x: torch.Tensor) -> torch.Tensor:
        seen.append(x.detach())
        return bowl(x)

    following(from_torch(watched, SPACE), smoothed=0)
    places = torch.cat(seen)
    assert len(places) == 100 * (1 + 2 * 2 * len(SCALES))  # all that was asked for was inside
    assert float(places.abs().max()) == pytest.approx(1, abs=0.03)


def sliced(objective: Objective, resolution: int, **how: int) -> xr.Dataset:
    return sample(objective, Plane.through(SPACE, SPACE.center, (0, 1), resolution=resolution), **how)


@pytest.mark.parametrize(
    ("resolution", "scales"), [(12, []), (24, [0.05]), (48, [0.05]), (96, [0.05]), (192, [0.01, 0.05])]
)
def test_a_stored_slice_has_the_scales_that_its_samples_allow(resolution: int, scales: list[float]) -> None:
    found = follow_samples(sliced(from_torch(bowl, SPACE), resolution))
    assert found is not None
    assert [one.scale for one in found.scales] == scales
    assert all(one.scale / 2 <= one.width <= 2 * one.scale and one.grade == "follow" for one in found.scales)
    assert found.words == (("gradients follow",) if 0.01 in scales else ())
    assert math.isnan(found.biased.value)


def test_a_stored_slice_says_what_its_gradients_are() -> None:
    assert follow_samples(sliced(SAID["opposite"][0], 192)).words == ("gradients do not follow", "gradients opposite")
    assert follow_samples(sliced(SAID["missing"][0], 24)).words == ("gradients missing",)
    some = follow_samples(sliced(from_torch(bowl, SPACE), 48, gradients=4))
    assert (some.points, some.missing.value) == (100, 0)
    assert follow_samples(sliced(from_torch(bowl, SPACE), 24, gradients=0)) is None
