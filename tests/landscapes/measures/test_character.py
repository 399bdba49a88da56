"""The character of landscapes whose measures are known in closed form, by exactly as many points as are allowed."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.measures.character import (
    MIN_EVALUATIONS,
    STEPS,
    Character,
    CharacterSample,
    measure_character,
)
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace.box([f"x{k}" for k in range(4)], -3.0, 1.0)


class Known(Objective):
    """A loss whose gradient may be another one's; it keeps what it was asked for."""

    space = SPACE

    def __init__(self, loss: Callable[[Tensor], Tensor], change: Callable[[Tensor], Tensor] = lambda g: g) -> None:
        self.loss, self.change = loss, change
        self.asked: list[tuple[int, bool]] = []

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        self.asked.append((len(x), grad))
        x = x.clone().requires_grad_()
        loss = self.loss(x)
        (slope,) = torch.autograd.grad(loss.sum() + 0 * x.sum(), x)
        return Evaluation.from_results(loss.detach(), self.change(slope) if grad else None)


def bowl(x: Tensor) -> Tensor:
    return ((x + 1) ** 2).sum(dim=1)


def measured(loss: Callable[[Tensor], Tensor], *change: Callable[[Tensor], Tensor], count: int = 50) -> Character:
    return measure_character(Known(loss, *change), evaluations=count).character


def test_a_parabola_keeps_what_its_gradients_promise() -> None:
    found = measured(bowl)
    assert (found.failed, found.flat, found.noise, found.convex) == (0, 0, 0, 1)
    assert found.falls == (1, 1, 1)
    assert found.across == pytest.approx(1)
    assert found.quadratic == pytest.approx(1)
    # down the gradient g of |x|^2 a step h lowers it by h |g| - h^2: the shorter, the nearer to the promise
    assert all(a > b for a, b in zip(found.agreement, found.agreement[1:], strict=False))
    assert found.agreement[0] > 0.99


def test_a_plane_has_gradients_that_point_one_way() -> None:
    found = measured(lambda x: x @ torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64))
    assert found.coherence == pytest.approx(1)
    assert found.steepest == pytest.approx(0)
    assert found.agreement == pytest.approx((1, 1, 1))
    assert found.linear == pytest.approx(1)
    assert found.skewness == pytest.approx(0, abs=0.5)


def test_opposite_gradients_break_every_promise() -> None:
    found = measured(bowl, lambda slope: -slope)
    assert found.falls == (0, 0, 0)
    assert found.agreement == (-1, -1, -1)
    assert found.across == pytest.approx(-1)
    assert found.convex == 0


def test_gradients_of_zero_and_failures_are_counted() -> None:
    found = measured(bowl, torch.zeros_like)
    assert found.flat == 1
    assert all(math.isnan(one) for one in (*found.falls, *found.agreement, found.across, found.coherence))
    half = measured(lambda x: torch.where(x[:, 0] > -1, torch.nan, bowl(x)), count=400)
    assert half.failed == pytest.approx(0.5, abs=0.1)
    every = measured(lambda x: bowl(x) * torch.nan)
    assert every.failed == 1
    assert math.isnan(every.dispersion)


def test_noise_is_told_from_a_function() -> None:
    draws = torch.Generator().manual_seed(0)
    noisy = measured(lambda x: bowl(x) + 10 * torch.randn(len(x), generator=draws, dtype=torch.float64))
    assert noisy.noise > 0.1
    assert measured(bowl).noise == 0


@pytest.mark.parametrize("count", [MIN_EVALUATIONS, 37, 50, 100])
@pytest.mark.parametrize("dim", [1, 4, 60])
def test_as_many_points_as_are_allowed_are_evaluated_and_a_quarter_with_gradients(count: int, dim: int) -> None:
    known = Known(bowl)
    known.space = ParameterSpace.box([f"x{k}" for k in range(dim)], -3.0, 1.0)
    found = measure_character(known, evaluations=count, seed=3)
    asked = {grad: sum(rows for rows, way in known.asked if way == grad) for grad in (False, True)}
    assert asked == {True: count // 4, False: count - count // 4}
    assert found.x.shape == (count, dim)
    torch.testing.assert_close(found.loss, bowl(found.x))
    again = measure_character(known, evaluations=count, seed=3)
    assert torch.equal(found.x, again.x)
    assert found.character == again.character or dim in (1, 60)  # where some are NaN


def test_steps_are_as_long_as_they_say() -> None:
    sample = CharacterSample(9, 50, 0)
    slopes = torch.eye(9, dtype=torch.float64)[:1].repeat(sample.gradients, 1).numpy()
    moved = sample.ends(slopes) - sample.first[: sample.stepped]
    lengths = [float((one**2).sum() ** 0.5) for one in moved[:, 0]]
    assert lengths[:2] == pytest.approx([3 * step for step in STEPS[:2]])
    assert (sample.others(slopes) >= 0).all()
    assert (sample.others(slopes) <= 1).all()


def test_words_are_said_of_every_measure() -> None:
    rows = measured(bowl).rows()
    assert ("Points without a loss", "0 %", "") in rows
    assert next(row.value for row in rows if "Decrease" in row.name).startswith("100 %, 9")
    assert all(row.value for row in measured(lambda x: bowl(x) * torch.nan).rows())
    env = from_torch(bowl, SPACE)
    assert measure_character(env, evaluations=20).character.evaluations == 20
