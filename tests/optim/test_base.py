import numpy as np
import pytest
import torch

from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind, NoOptions, Optimizer, Points, Proposal

from .states import restored

SPACE = ParameterSpace(("a", "b"), torch.tensor([-3.0, 10.0]), torch.tensor([1.0, 10.5]), ("m", "s"))


class Recorder(Optimizer):
    """Propose what the test says and remember what it is told."""

    name, Options, needs_grad = "recorder", NoOptions, True

    def _setup(self) -> None:
        self.next = np.zeros((1, 2))

    def _ask(self) -> Proposal:
        return Proposal(torch.from_numpy(self.next), Kind.ACQUISITION, grad=True)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        self.z, self.loss, self.grad = z, loss, grad


class Bowl(Objective):
    space = SPACE

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        return Evaluation.from_results(x.square().sum(dim=1), 2 * x if grad else None)


def told(status: list[int], loss: list[float], grad: list[list[float]] | None = None) -> Recorder:
    optimizer = Recorder(SPACE)
    optimizer.next = np.zeros((len(loss), 2))
    slope = None if grad is None else torch.tensor(grad, dtype=torch.float64)
    evaluation = Evaluation.from_results(torch.tensor(loss, dtype=torch.float64), slope, torch.tensor(status))
    optimizer.tell(optimizer.ask().x, evaluation)
    return optimizer


def test_the_scaled_box_is_the_parameters_box_and_is_never_left() -> None:
    optimizer = Recorder(SPACE)
    optimizer.next = np.array([[-1.0, 1.0], [0.0, 0.0], [-1.5, 7.0], [1.0, -1.0]])
    proposal = optimizer.ask()
    assert proposal.x.tolist() == [[-3.0, 10.5], [-1.0, 10.25], [-3.0, 10.5], [1.0, 10.0]]
    assert (proposal.kind, proposal.grad) == (Kind.ACQUISITION, True)
    ill = ParameterSpace.box(("a",), -0.1, 0.3)  # -0.1 + 1 * (0.3 + 0.1) is above 0.3 in floating point
    edge = Recorder(ill)
    edge.next = np.array([[1.0], [-1.0]])
    assert edge.ask().x.tolist() == [[0.3], [-0.1]]


def test_gradients_reach_a_method_by_its_scaled_parameters() -> None:
    optimizer = told([Status.OK], [2.0], [[3.0, 5.0]])
    assert optimizer.grad.tolist() == [[3.0 * 2.0, 5.0 * 0.25]]  # a step of one is half the box
    assert optimizer.z.tolist() == [[0.0, 0.0]]


def test_a_failed_episode_is_infinite_without_slope_and_counts_as_the_worst_so_far() -> None:
    optimizer = told([Status.OK, Status.ESCAPED, Status.OK], [-7.0, 1.0, -9.0], [[1.0, 1.0]] * 3)
    assert optimizer.loss.tolist() == [-7.0, np.inf, -9.0]
    assert optimizer.grad[1].tolist() == [0.0, 0.0]
    assert optimizer.penalise(optimizer.loss).tolist() == [-7.0, -7.0, -9.0]


def test_a_method_whose_attributes_are_data_is_restored_without_more() -> None:
    optimizer = told([Status.OK, Status.OK], [2.0, np.nan], [[1.0, 2.0]] * 2)
    again = restored(optimizer, Bowl())
    assert again.random.random() == optimizer.random.random()
    assert again.worst == 2.0
    for name in ("next", "z", "loss", "grad"):
        np.testing.assert_array_equal(getattr(again, name), getattr(optimizer, name))


def test_what_is_no_data_is_named() -> None:
    optimizer = told([Status.OK], [2.0])
    optimizer.z = slice(3)  # type: ignore[assignment]
    with pytest.raises(TypeError, match="a state can contain numbers, strings and arrays; got a slice"):
        restored(optimizer, Bowl())


def test_a_state_puts_nothing_in_the_place_of_a_method() -> None:
    state = told([Status.OK], [2.0]).state()
    with pytest.raises(ValueError, match="_ask is no attribute in the state of recorder"):
        Recorder.from_state(Bowl(), state | {"own": {"_ask": 3}})
