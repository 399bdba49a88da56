"""Hessians by differences, held against closed forms: the errors that are stated cover what is off."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.landscapes import curvature as curvature_module
from gradscape.landscapes.curvature import EDGE, Curvature, FailedPointsError, measure_spectrum
from gradscape.landscapes.objective import Objective

SPECTRA = {  # of quadratic forms, by the number of parameters
    2: np.array([3.0, 0.5]),
    10: np.array([1000.0, 500.0, 30.0, 4.0, 1.0, 0.1, 1e-3, -0.2, -3.0, -200.0]),
    200: np.concatenate([np.linspace(0, 1, 190), np.linspace(2, 50, 8), [-3.0, -10.0]]),
}
SPACE = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1), "c": (-1, 1)})
A = torch.diag(torch.tensor([3.0, 1.0, -0.2], dtype=torch.float64))  # times 4 in box units
TRUE = np.array([12.0, 4.0, -0.8])
POINT = torch.tensor([0.2, 0.1, 0.3], dtype=torch.float64)


def form(spectrum: np.ndarray, dtype: torch.dtype = torch.float64) -> gs.Environment:
    """Return the quadratic form of a spectrum in the unit box, along random axes."""
    dim = len(spectrum)
    frame = np.linalg.qr(np.random.default_rng(0).standard_normal((dim, dim)))[0]
    matrix = torch.from_numpy(frame @ np.diag(spectrum) @ frame.T).to(dtype)
    space = gs.ParameterSpace.box([f"p{at}" for at in range(dim)], 0.0, 1.0)

    def loss(x: torch.Tensor) -> torch.Tensor:
        z = x.to(dtype) - 0.3
        return 0.5 * (z @ matrix * z).sum(dim=1)

    return gs.from_torch(loss, space, precision=str(dtype).removeprefix("torch."))


def own(fn: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]) -> gs.Environment:
    """Return an environment of a function from points to losses and whatever it calls gradients."""

    class Own:
        space = SPACE

        def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> gs.Evaluation:
            loss, slope = fn(x)
            return gs.Evaluation.from_results(loss, slope if grad else None)

    return gs.as_environment(Own())


def half_square(x: torch.Tensor) -> torch.Tensor:
    return 0.5 * (x @ A * x).sum(dim=1)


def spectrum(objective: Objective, x: torch.Tensor = POINT, *, pairs: int = 3, probes: int = 8):  # type: ignore[no-untyped-def]
    return measure_spectrum(Curvature(objective, x), pairs=pairs, probes=probes)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("dim", SPECTRA)
@pytest.mark.parametrize("seed", range(3))
def test_the_eigenvalues_of_a_quadratic_form_lie_within_their_errors(dim: int, dtype: torch.dtype, seed: int) -> None:
    f = form(SPECTRA[dim], dtype)
    found = spectrum(f, f.space.uniform(1, seed=seed)[0])
    true = np.sort(SPECTRA[dim])[::-1]
    ends = true if dim <= 100 else np.r_[true[:3], true[-3:]]
    off = np.abs(found.values - ends)
    assert (off <= found.error).all()
    assert found.error.max() < (1e-6 if dtype == torch.float64 else 0.05) * true.max()  # and they say something
    assert not found.disputed.any()
    assert found.trace.low <= true.sum() <= found.trace.high
    assert found.asymmetry <= 3 * found.asymmetry_explained + 1e-9


def test_eigenvectors_are_those_of_the_form_and_equal_eigenvalues_are_found_twice() -> None:
    f = form(SPECTRA[10])
    found = spectrum(f, f.space.center)
    frame = np.linalg.qr(np.random.default_rng(0).standard_normal((10, 10)))[0]
    np.testing.assert_allclose(np.abs(found.vectors @ frame), np.eye(10), atol=1e-6)
    assert (np.take_along_axis(found.vectors, np.abs(found.vectors).argmax(axis=1)[:, None], axis=1) > 0).all()
    twice = form(np.concatenate([np.ones(60), 2 * np.ones(58), [7.0, 7.0]]))
    assert spectrum(twice, twice.space.center).values[:3] == pytest.approx([7, 7, 2])


def test_the_sampled_spectrum_has_the_share_of_negative_eigenvalues_and_the_trace() -> None:
    values = np.linspace(-1, 3, 200)
    f = form(values)
    found = spectrum(f, f.space.center)
    assert found.weights.sum(axis=1) == pytest.approx(np.ones(8))
    assert (found.weights * (found.nodes < 0)).sum() / 8 == pytest.approx((values < 0).mean(), abs=0.05)
    assert (found.weights * found.nodes).sum(axis=1).mean() * 200 == pytest.approx(found.trace.value)


def test_intervals_of_the_trace_cover_it_as_often_as_they_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 40 samples of 8 probes 95 % cover; fewer than 32 do with a chance of 1e-4."""
    monkeypatch.setattr(curvature_module, "LANCZOS", 2)
    values = np.r_[np.linspace(0, 1, 108), [20.0, -10.0]]
    f = form(values)
    x, true = f.space.center, values.sum()
    traces = [measure_spectrum(Curvature(f, x), pairs=1, probes=8, seed=seed).trace for seed in range(40)]
    assert sum(one.low <= true <= one.high for one in traces) >= 32
    assert len({one.value for one in traces}) == 40


def test_truncation_is_within_the_errors_where_higher_derivatives_are_large() -> None:
    found = spectrum(gs.from_torch(lambda x: torch.sin(30 * x).sum(dim=1), SPACE))
    true = np.sort(-4 * 900 * np.sin(30 * POINT.numpy()))[::-1]
    assert (np.abs(found.values - true) <= found.error).all()
    assert found.error.max() < 1e-4 * np.abs(true).max()
    lowest = spectrum(gs.make("rosenbrock"), torch.ones(2, dtype=torch.float64))
    exact = np.linalg.eigvalsh(np.array([[802.0, -400.0], [-400.0, 200.0]]) * 15**2)[::-1]  # its box is 15 wide
    assert (np.abs(lowest.values - exact) <= lowest.error).all()
    assert lowest.values[0] / lowest.values[1] == pytest.approx(2508.01, abs=0.1)


@pytest.mark.parametrize("noise", [1e-4, 1e-2, 1.0])
def test_errors_cover_the_truth_where_gradients_are_noisy(noise: float) -> None:
    generator = torch.Generator().manual_seed(1)

    def fn(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return half_square(x), x @ A + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64)

    found = [spectrum(own(fn)) for _ in range(20)]
    covered = np.mean([np.abs(one.values - TRUE) <= one.error for one in found])
    untold = np.mean([np.abs(one.values) <= one.error for one in found])
    assert covered > 0.95
    assert untold < 0.1 if noise == 1e-4 else untold > 0.3


def test_noise_of_losses_alone_disputes_no_gradient() -> None:
    generator = torch.Generator().manual_seed(1)
    f = own(lambda x: (half_square(x) + 1e-3 * torch.randn(len(x), generator=generator, dtype=torch.float64), x @ A))
    for _ in range(20):
        found = spectrum(f)
        assert not found.disputed.any()
        assert found.values == pytest.approx(TRUE)


def test_gradients_of_no_loss_are_asymmetric() -> None:
    skew = torch.tensor([[0, 0.5, 0], [-0.5, 0, 0], [0, 0, 0]], dtype=torch.float64)
    found = spectrum(own(lambda x: (half_square(x), x @ A + x @ skew)))
    assert found.asymmetry == pytest.approx(0.5 * 2**0.5 / float(A.norm()))
    assert found.asymmetry > 1e6 * found.asymmetry_explained
    assert (found.error[:2] >= 2 - 1e-9).all()  # |skew v| in box units


def test_gradients_of_no_loss_are_asymmetric_by_probes_too() -> None:
    f = form(SPECTRA[200])
    mixed = np.random.default_rng(5).standard_normal((200, 200)) / 20
    skew = mixed - mixed.T

    def fn(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = f.evaluate(torch.from_numpy(x))
        assert found.grad is not None
        return found.loss.numpy(), found.grad.numpy() + x @ skew

    found = spectrum(gs.from_numpy(fn, f.space), f.space.center)
    size = np.linalg.norm(np.r_[np.linalg.norm(SPECTRA[200]), np.linalg.norm(skew)])
    assert found.asymmetry == pytest.approx(np.linalg.norm(skew) / size, rel=0.3)
    assert found.asymmetry > 1e3 * found.asymmetry_explained


def test_losses_dispute_gradients_of_twice_the_loss_jumps_and_kinks_at_the_point() -> None:
    twice = spectrum(own(lambda x: (half_square(x), 2 * x @ A)))
    assert twice.disputed.all()
    assert twice.error == pytest.approx(np.abs(TRUE))
    assert twice.by_losses == pytest.approx(TRUE)
    jump = spectrum(own(lambda x: (half_square(x) + (x[:, 0] > 0.2 + 1e-7), x @ A)))
    assert jump.disputed.tolist() == [True, False, False]
    assert jump.error[0] > abs(jump.values[0])
    f = gs.from_torch(lambda x: x.abs().sum(dim=1) + half_square(x), SPACE)
    kink, near = (spectrum(f, torch.tensor([at, 0.5, 0.5], dtype=torch.float64)) for at in (0.0, 1e-2))
    assert abs(kink.values[0]) < kink.error[0]
    assert near.values == pytest.approx(TRUE, rel=1e-6)
    assert (near.error < 1e-6).all()


def test_differences_of_losses_where_there_are_no_gradients() -> None:
    def fn(x: np.ndarray) -> np.ndarray:
        return np.sin(3 * x).sum(axis=1) + x[:, 0] * x[:, 1]  # type: ignore[no-any-return]

    curvature = Curvature(gs.from_numpy(fn, SPACE), POINT)
    found = measure_spectrum(curvature, pairs=3, probes=8)
    matrix = np.diag(-9 * np.sin(3 * POINT.numpy()))
    matrix[0, 1] = matrix[1, 0] = 1
    assert curvature.source == "losses"
    assert (np.abs(found.values - np.linalg.eigvalsh(4 * matrix)[::-1]) <= found.error).all()
    assert found.error.max() < 1e-4


@pytest.mark.parametrize(
    ("f", "x", "said"),
    [
        (
            gs.from_numpy(lambda x: (x**2).sum(axis=1), gs.ParameterSpace.box([f"p{k}" for k in range(31)], -1.0, 1.0)),
            torch.zeros(31).double(),
            r"at most 30 parameters, and it has 31; give it gradients \(gs.from_torch",
        ),
        (
            gs.from_torch(lambda x: half_square(x) + (1e-9 - (x - POINT).norm(dim=1)).sqrt() * 0, SPACE, name="thin"),
            POINT,
            r"thin failed near this point.*NONFINITE at [abc] [-+].* of the box from there",
        ),
        (
            gs.from_torch(lambda x: x.abs().sqrt().sum(dim=1), SPACE),
            torch.zeros(3).double(),
            "no finite loss and gradient at this point: NO_GRADIENT there",
        ),
    ],
    ids=["no gradients", "fails at every step", "fails itself"],
)
def test_points_without_a_hessian_are_refused(f: gs.Environment, x: torch.Tensor, said: str) -> None:
    with pytest.raises(ValueError, match=said) as refused:
        spectrum(f, x)
    assert isinstance(refused.value, FailedPointsError) is (f.space.dim == 3)


def test_a_failing_step_gives_way_to_a_smaller_one() -> None:
    """The wall is nearer than the step along its own axis, and not along the directions that are tried."""
    f = gs.from_torch(lambda x: half_square(x) + torch.where(x[:, 0] > 0.21, torch.nan, 0.0), SPACE)
    curvature = Curvature(f, POINT)
    found = measure_spectrum(curvature, pairs=3, probes=8)
    assert curvature.failures[-1] == "NONFINITE at a +0.016 of the box from there"
    assert found.step == 1 / 256
    assert found.values == pytest.approx(TRUE)


def test_a_point_at_the_bounds_is_moved_inwards_and_one_beyond_refused() -> None:
    f = gs.from_torch(lambda x: (x**3).sum(dim=1), gs.ParameterSpace.box("ab", 0.0, 1.0))
    curvature = Curvature(f, torch.tensor([0.0, 1.0], dtype=torch.float64))
    found = measure_spectrum(curvature, pairs=2, probes=8)
    assert curvature.moved == EDGE
    assert found.values == pytest.approx([6 * (1 - EDGE), 6 * EDGE])
    with pytest.raises(ValueError, match="outside its bounds"):
        Curvature(f, torch.tensor([0.0, 1.1], dtype=torch.float64))


def test_a_step_is_not_lost_in_the_rounding_of_a_parameter_far_from_zero() -> None:
    space = gs.ParameterSpace.box("ab", 1000.0, 1001.0)
    found = spectrum(gs.from_torch(lambda x: ((x.float() - 1000.5) ** 2).sum(dim=1), space), space.center)
    assert (np.abs(found.values - 2) <= found.error).all()
    assert found.step > 1e-3


@pytest.mark.parametrize("loss", [lambda x: 0 * x.sum(dim=1), lambda x: x.sum(dim=1)], ids=["flat", "linear"])
def test_no_curvature_is_zero_without_error(loss: Callable[[torch.Tensor], torch.Tensor]) -> None:
    found = spectrum(gs.from_torch(loss, SPACE))
    assert not found.values.any()
    assert not found.error.any()
