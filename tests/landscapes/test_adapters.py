import math

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from gradscape.envs.adapters import from_numpy, from_torch
from gradscape.landscapes.objective import Objective, Status
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace(("a", "b"), torch.tensor([-1.0, 0.0]).double(), torch.tensor([1.0, 100.0]).double(), ("", ""))
X = SPACE.uniform(7, seed=0)


def wave(x: torch.Tensor) -> torch.Tensor:
    return x[:, 0].sin() * x[:, 1] ** 2


def numpy_wave(x):
    return np.sin(x[:, 0]) * x[:, 1] ** 2


def numpy_wave_with_gradient(x):
    return numpy_wave(x), np.stack([np.cos(x[:, 0]) * x[:, 1] ** 2, 2 * np.sin(x[:, 0]) * x[:, 1]], axis=1)


EXACT = vmap(jacrev(lambda row: wave(row[None])[0]))(X)
ADAPTED = [from_torch(wave, SPACE), from_numpy(numpy_wave_with_gradient, SPACE)]


@pytest.mark.parametrize("objective", ADAPTED)
def test_losses_and_gradients_are_the_functions_own_and_a_wrong_dimension_is_refused(objective):
    with pytest.raises(ValueError, match=r"takes 2 parameters, x of shape \(batch, 2\); got x of shape \(3, 12\)"):
        objective.evaluate(torch.zeros(3, 12))
    result = objective.evaluate(X)
    torch.testing.assert_close(result.loss, wave(X))
    torch.testing.assert_close(result.grad, EXACT)
    assert objective.evaluate(X, grad=False).grad is None
    assert isinstance(objective, Objective)


@pytest.mark.parametrize("objective", [*ADAPTED, from_numpy(numpy_wave, SPACE, differences=1e-3)])
@pytest.mark.parametrize("grad", [True, False])
def test_an_empty_batch_gives_an_empty_evaluation(objective, grad):
    result = objective.evaluate(X[:0], grad=grad)
    assert result.loss.shape == result.status.shape == (0,)
    assert (result.grad.shape == (0, 2)) if grad else (result.grad is None)


def test_central_differences_converge_at_second_order_on_unequal_ranges():
    errors = []
    for step in (4e-3, 2e-3, 1e-3):
        result = from_numpy(numpy_wave, SPACE, differences=step).evaluate(X)
        errors.append(float((result.grad - EXACT).abs().max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2, atol=0.05)


def test_one_failing_row_fails_alone():
    def torn(x):
        return torch.where(x[:, 0] > 0, torch.nan, 1.0) * x[:, 1]

    result = from_torch(torn, SPACE).evaluate(X)
    np.testing.assert_array_equal(result.status == Status.NONFINITE, X[:, 0] > 0)
    assert result.loss[X[:, 0] <= 0].isfinite().all()


def test_the_callers_points_stay_as_they_are_and_single_precision_comes_out_in_double():
    def greedy(x):
        x *= 2
        return x[:, 0]

    before = X.clone()
    from_numpy(greedy, SPACE).evaluate(X, grad=False)
    result = from_torch(lambda x: wave(x.float()), SPACE).evaluate(X)
    assert result.loss.dtype == result.grad.dtype == torch.float64
    assert torch.equal(X, before)
    assert not X.requires_grad


def test_what_the_function_raises_is_said_and_is_the_cause():
    def broken(x):
        raise RuntimeError("my simulator")

    for adapt in (from_torch, from_numpy):
        with pytest.raises(
            ValueError, match=r"broken raised wherever it was tried.*RuntimeError: my simulator"
        ) as said:
            adapt(broken, SPACE).evaluate(X)
        assert isinstance(said.value.__cause__, RuntimeError)


@pytest.mark.parametrize(
    ("objective", "said"),
    [
        (from_torch(lambda x: x, SPACE, name="own"), r"own must return losses of shape \(7,\); got shape \(7, 2\)"),
        (from_torch(lambda x: 3.0, SPACE, name="own"), "own must return a tensor; got float"),
        (from_torch(lambda x: x.detach()[:, 0], SPACE, name="own"), "carry no gradient.*--no-gradients"),
        (from_torch(lambda x: 1.0, SPACE, vectorized=False), "must return a tensor; got float"),
        (from_numpy(lambda x: x[0], SPACE), r"losses of shape \(7,\); got shape \(2,\) .*vectorized=False"),
        (from_numpy(lambda x: (x[:, 0], x[0]), SPACE), r"gradients of shape \(7, 2\); got shape \(2,\)"),
        (from_numpy(numpy_wave, SPACE), "numpy_wave returned losses without gradients.*differences"),
    ],
)
def test_a_wrong_answer_says_who_what_and_what_to_do(objective, said):
    with pytest.raises(ValueError, match=said):
        objective.evaluate(X)


def test_functions_of_one_point_are_called_at_each():
    def at(x):
        return math.sin(x[0]) * x[1] ** 2

    def at_with_gradient(x):
        return at(x), [math.cos(x[0]) * x[1] ** 2, 2 * math.sin(x[0]) * x[1]]

    exact = from_torch(lambda x: x[0].sin() * x[1] ** 2, SPACE, vectorized=False).evaluate(X)
    torch.testing.assert_close(exact.loss, wave(X))
    torch.testing.assert_close(exact.grad, EXACT)
    given = from_numpy(at_with_gradient, SPACE, vectorized=False).evaluate(X)
    torch.testing.assert_close(given.grad, EXACT)
    differed = from_numpy(at, SPACE, differences=1e-5, vectorized=False).evaluate(X)
    torch.testing.assert_close(differed.loss, wave(X))
    torch.testing.assert_close(differed.grad, EXACT, rtol=1e-4, atol=1e-4)


def test_a_function_of_one_point_says_at_which_it_failed():
    def fails(x):
        raise ZeroDivisionError("the arm is singular")

    with pytest.raises(ValueError, match="the arm is singular; the first was x = ") as raised:
        from_numpy(fails, SPACE, vectorized=False).evaluate(X[:1], grad=False)
    assert str(raised.value).endswith(f"x = {X[0].tolist()}")


def test_lists_and_arrays_are_points_too_and_what_is_no_number_is_refused():
    objective = from_torch(wave, SPACE)
    for x in (X.tolist(), X.numpy(), X.numpy()[::-1][::-1]):
        torch.testing.assert_close(objective.evaluate(x).loss, wave(X))
    for wrong in ("0.5", [["a", "b"]], X + 1j, [[1, 2], [3]]):
        with pytest.raises(ValueError, match="wave takes numbers"):
            objective.evaluate(wrong)
    with pytest.raises(ValueError, match="the loss of wave takes numbers"):
        from_numpy(lambda x: 1j * x[:, 0], SPACE, name="wave").evaluate(X, grad=False)
