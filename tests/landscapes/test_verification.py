"""Which stored points are evaluated again, and what of them is another number."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from gradscape.landscapes.identity import StoreMismatchError
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.verification import StoredPoints, verify

SPACE = ParameterSpace({"x": (-1, 1), "y": (-1, 1)})
POINTS = torch.linspace(-1, 1, 9, dtype=torch.float64)[:, None].repeat(1, 2)


class Slope(Objective):
    """A loss that grows by so much along x, and keeps what it is asked."""

    name = "slope"
    space = SPACE

    def __init__(self, rise: float = 1.0) -> None:
        self.rise, self.asked = rise, list[tuple[list[list[float]], bool]]()

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        self.asked.append((x.tolist(), grad))
        slope = torch.tensor([self.rise, 0.0], dtype=torch.float64).expand(len(x), 2)
        return Evaluation.from_results(self.rise * x[:, 0], slope if grad else None)


def stored(found: Evaluation, x: Tensor = POINTS) -> StoredPoints:
    return StoredPoints(Path("cut"), "slice", x, found, found.grad is not None)


def changed(found: Evaluation, **fields: Any) -> Evaluation:
    return Evaluation(**{**vars(found), **fields})


def test_the_least_the_middle_and_the_largest_are_evaluated_anew_and_no_more() -> None:
    objective = Slope()
    verify(objective, [stored(Slope().evaluate(POINTS))])
    assert objective.asked == [([[0.0, 0.0], [-1.0, -1.0], [1.0, 1.0]], True)]


def test_points_beyond_the_box_and_those_that_are_not_numbers_are_passed_over() -> None:
    x = torch.cat([POINTS, torch.tensor([[5.0, 0.0], [torch.nan, 0.0]], dtype=torch.float64)])
    objective = Slope()
    verify(objective, [stored(Slope().evaluate(x), x)])
    assert objective.asked[0][0] == [[0.0, 0.0], [-1.0, -1.0], [1.0, 1.0]]
    verify(objective, [stored(Slope().evaluate(x[9:]), x[9:])])
    verify(objective, [])
    assert len(objective.asked) == 1


def test_a_point_without_a_gradient_is_asked_for_none_and_one_that_is_interpolated_not_at_all() -> None:
    found = Slope().evaluate(POINTS)
    with_none, objective = changed(found, grad=torch.full_like(found.grad, torch.nan)), Slope()
    verify(objective, [stored(with_none)])
    assert [grad for _, grad in objective.asked] == [False]
    with_one = changed(found, grad=torch.where(torch.arange(9)[:, None] == 3, found.grad, torch.nan))
    objective = Slope()
    verify(objective, [stored(with_one)])
    assert objective.asked == [([[-0.25, -0.25]], True)]
    status = torch.where(torch.arange(9) == 4, Status.OK, Status.INTERPOLATED).to(torch.int8)  # which is no point
    verify(objective, [stored(changed(found, status=status, loss=found.loss.where(status == Status.OK, torch.nan)))])
    assert objective.asked[1:] == [([[0.0, 0.0]], True)]


@pytest.mark.parametrize("rise", [1e-300, 1.0, 1e308])
def test_other_losses_are_refused_of_any_size(rise: float) -> None:
    verify(Slope(rise), [stored(Slope(rise).evaluate(POINTS))])
    with pytest.raises(StoreMismatchError, match=r"cut contains a slice of slope whose losses have changed: \S+ then"):
        verify(Slope(-rise), [stored(Slope(rise).evaluate(POINTS))])


def test_several_results_are_evaluated_in_one_batch_and_the_one_that_differs_is_named() -> None:
    run = StoredPoints(Path("run"), "run", POINTS, Slope(2.0).evaluate(POINTS), True)
    objective = Slope()
    with pytest.raises(StoreMismatchError, match=r"run contains a run of slope .*: \S+ then"):
        verify(objective, [stored(Slope().evaluate(POINTS)), run])
    assert len(objective.asked[0][0]) == 6


def test_a_status_that_a_simulator_gives_now_and_then_goes_on() -> None:
    class Flaky(Slope):
        """Every other evaluation fails."""

        def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
            found = super().evaluate(x, grad=grad)
            return changed(found, status=torch.full((len(x),), 1 + len(self.asked) % 2, dtype=torch.int8))

    verify(Flaky(), [stored(Slope().evaluate(POINTS))])
