"""The words for landscapes whose character is known, and the picture of their gradients."""

import math
from collections.abc import Callable

import pytest
import torch

from gradscape import ParameterSpace, Plane, from_torch, sample
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.measures.profile import Profile, effort, measure_profile
from gradscape.landscapes.objective import Evaluation, Objective, Status

Function = Callable[[torch.Tensor], torch.Tensor]


def profile(fn: Function, low: float, high: float, dims: tuple[int, ...] = (0, 1)) -> Profile:
    space = ParameterSpace.box(("x", "y"), low, high)
    objective = from_torch(fn, space)
    dataset = sample(objective, Plane.through(space, space.center, dims, resolution=48))
    return measure_profile(objective, dataset, rounding=2**-52, points=2)


def rastrigin(x: torch.Tensor) -> torch.Tensor:
    return (x**2 - 10 * torch.cos(2 * math.pi * x) + 10).sum(1)


def scrambled(x: torch.Tensor) -> torch.Tensor:
    mixed = torch.sin(x[:, 0] * 12989.8 + x[:, 1] * 78233.0) * 43758.5453
    return mixed - mixed.floor()


@pytest.mark.parametrize(
    ("fn", "box", "words"),
    [
        (scrambled, (-1, 1), {"extremely rugged", "gradients do not follow", "gradients exploding"}),
        (
            lambda x: 1.0 * (x[:, 0] > 0.1) + 0 * x.sum(1),
            (-1, 1),
            {"large flat regions", "discontinuous", "gradients zero"},
        ),
        (lambda x: (x**2 + 1e-3 * torch.sin(3000 * x)).sum(1), (-1, 1), {"very smooth", "gradients do not follow"}),
    ],
    ids=["noise", "step", "ripples"],
)
def test_words_fit_functions_that_are_known(fn: Function, box: tuple[float, float], words: set[str]) -> None:
    found = profile(fn, *box)
    assert set(found.words) == set(found.verdict.reasons) == words


class Partly(Objective):
    """A bowl of which some points have no loss, and others none but a loss."""

    name, space = "partly", ParameterSpace.box(("x", "y"), -1.0, 1.0)

    def __init__(self, missing: float, failing: float) -> None:
        self.missing, self.failing = missing, failing

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        u = self.space.to_unit(x)
        failed = torch.where(u[:, 1] < self.failing, Status.ERROR, Status.OK)
        slope = (2 * x).masked_fill(u[:, :1] < self.missing, torch.nan)
        said = "RuntimeError: too much work" if bool((failed == Status.ERROR).any()) else ""
        return Evaluation.from_results(x.square().sum(dim=1), slope if grad else None, failed, said)

    def profile(self) -> Profile:
        dataset = sample(self, Plane.through(self.space, self.space.center, (0, 1), resolution=16))
        return measure_profile(self, dataset, rounding=2**-52, points=2)


def test_gradients_that_are_missing_are_said_to_be_and_losses_beside_them_count() -> None:
    half = Partly(0.5, 0.0).profile()
    assert set(half.words) == {"very smooth", "gradients missing"}
    assert half.verdict.reasons["gradients missing"] == "no gradient at 52 % (42 to 62) of the points with a loss"
    named = half.measures
    assert named["Gradients missing at points with a loss"].startswith("50.0 %")
    assert "Samples that failed" not in named
    assert half.losses.failed == 0
    whole = Partly(0.0, 0.0).profile()
    for name in ("minima", "range", "level"):
        assert getattr(half.losses, name) == getattr(whole.losses, name)
    assert set(whole.words) == {"very smooth", "gradients follow"}
    few = Partly(0.1, 0.0).profile()
    assert set(few.words) == {"very smooth", "gradients follow"}
    assert few.measures["Gradients missing at points with a loss"].startswith("12.5 %")


def test_a_slice_that_mostly_failed_is_called_nothing_else() -> None:
    found = Partly(0.0, 0.6).profile()
    share = f"{found.losses.failed / found.losses.samples:.0%}"
    assert found.verdict.reasons == {"mostly failed": f"no loss at {share} of the samples"}
    named = found.measures
    assert named["Samples that failed"].startswith(share[:2])
    assert named["Points that raised"] == f"{found.losses.failed} points raised: first 'RuntimeError: too much work'"
    assert Partly(0.0, 1.1).profile().words == ("mostly failed",)


def test_a_character_is_the_same_again_and_has_plain_names() -> None:
    found = [profile(rastrigin, -2, 2) for _ in range(2)]
    assert to_json(found[0]) == to_json(found[1])
    named = found[0].measures
    assert named["Local minima deeper than 1 % of the range"] == "25"  # and at the borders, where it is lower
    assert named["Gradient effectively zero"] == "0.0 % (0.0 % to 0.2 %)"
    assert "Jumps explained by an event" not in named


def test_no_more_is_evaluated_than_is_announced() -> None:
    counts = {True: 0, False: 0}

    def counted(x: torch.Tensor) -> torch.Tensor:
        counts[x.requires_grad] += len(x)
        return scrambled(x)

    space = ParameterSpace.box(("x", "y"), -1.0, 1.0)
    objective = from_torch(counted, space)
    dataset = sample(objective, Plane.through(space, space.center, (0, 1), resolution=10))
    counts.update({True: 0, False: 0})
    measure_profile(objective, dataset, rounding=2**-52, points=3)
    assert counts[True] == effort(2, 3, (10, 10))[1]
    assert 0.4 * effort(2, 3, (10, 10))[0] < counts[False] <= effort(2, 3, (10, 10))[0]
