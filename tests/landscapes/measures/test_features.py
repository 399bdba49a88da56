"""Features over all parameters: what gradients give against closed forms, and what cannot be told."""

import json
import math

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.measures.features import (
    Features,
    active_subspace,
    effort,
    measure_features,
    sobol_indices,
)
from gradscape.landscapes.measures.polynomials import fit_with_gradients
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.space import ParameterSpace, sobol

RNG = np.random.default_rng


class Bowl(Objective):
    """A bowl of two parameters, of which a share of the box fails; gradients may be missing, or of other signs."""

    name = "bowl"
    preferred_batch = 32

    def __init__(self, *, fails: float = 0.0, sign: float = 1.0, step: float = 0.0, scale: float = 1.0) -> None:
        self.space = ParameterSpace.box(["a", "b"], -1.0, 1.0)
        self.fails, self.sign, self.step, self.scale, self.asked = fails, sign, step, scale, [0, 0]

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        self.asked[grad] += len(x)
        loss = self.scale * (x.square().sum(dim=1) + self.step * (x[:, 1] > 0.3))
        loss = torch.where(x[:, 0] < 2 * self.fails - 1, torch.nan, loss)
        return Evaluation.from_results(loss, self.scale * self.sign * 2 * x if grad else None)


def features(objective: Objective) -> Features:
    return measure_features(objective, seed=0, rounding=2.0**-52)


def test_everything_is_measured_announced_and_read_again() -> None:
    bowl, heard = Bowl(), list[int]()
    found = measure_features(bowl, seed=0, rounding=2.0**-52, follow=heard.append)
    assert tuple(bowl.asked) == effort(2) == (512, 100)
    assert heard == sorted(heard)
    assert heard[-1] == 612
    assert found.exploratory
    assert found.exploratory.ela_meta.quad_simple_adj_r2 == pytest.approx(1)
    data = json.loads(json.dumps(to_json(found)))
    assert to_json(from_json(Features, data)) == data


def test_losses_count_in_ranges_and_parameters_in_sides_of_the_box() -> None:
    one, other = features(Bowl()), features(Bowl(scale=1e-6))
    assert [row.value for row in one.rows()] == [row.value for row in other.rows()]
    assert other.range == pytest.approx(1e-6 * one.range)


def test_failed_points_are_left_out_and_counted() -> None:
    found = features(Bowl(fails=0.25))
    assert 20 <= found.failed <= 30
    assert not found.why
    assert found.exploratory.ela_meta.quad_simple_adj_r2 == pytest.approx(1)
    assert found.sobol.failed > 100
    assert found.sobol.points < 128
    few = features(Bowl(fails=0.85))
    assert few.why.endswith("points have a loss; at least 20 are needed, 10 for each parameter")
    assert few.exploratory is None
    assert few.rows()[-1].value == "cannot tell"
    flat = from_torch(lambda x: 3 + 0 * x.sum(dim=1), ParameterSpace.box(["a", "b"], -1, 1))
    assert features(flat).why == "all losses are equal up to rounding: 3 to 3"


@pytest.mark.parametrize(("step", "named"), [(0.0, []), (4.0, ["b"])])
def test_a_step_is_more_variance_than_gradients_allow(step: float, named: list[str]) -> None:
    assert features(Bowl(step=step)).sobol.unexplained == named


def test_models_with_gradients_explain_what_losses_alone_do_not_determine() -> None:
    """A polynomial of degree 4 in 10 parameters has 1001 coefficients, and there are 450 losses to fit."""
    x = sobol(500, 10, seed=0).numpy()
    w = np.linspace(1, 2, 10) / 5
    *_, cubic, quartic = fit_with_gradients(x, (x @ w) ** 4, 4 * ((x @ w) ** 3)[:, None] * w, RNG(0))
    assert (cubic.coefficients, quartic.coefficients) == (286, 1001)
    assert math.isnan(quartic.losses_alone.value)
    assert quartic.with_gradients.value == pytest.approx(1, abs=1e-6)
    assert quartic.of_gradients.value == pytest.approx(1, abs=1e-6)
    assert cubic.with_gradients.value > cubic.losses_alone.value
    assert [one.degree for one in fit_with_gradients(x[:, :1], x[:, 0], np.ones((500, 1)), RNG(0))] == [1, 2, 3, 4]


def test_gradients_that_contradict_the_losses_weigh_little() -> None:
    x = sobol(150, 3, seed=0).numpy()
    y = np.sin(3 * x).sum(axis=1) + RNG(1).normal(0, 0.05, 150)
    noise = RNG(2).normal(0, 30, x.shape)
    right, wrong = (fit_with_gradients(x, y, slopes, RNG(0))[2] for slopes in (3 * np.cos(3 * x), noise))
    assert right.with_gradients.value >= right.losses_alone.value - 0.005
    assert right.of_gradients.value > 0.9
    assert wrong.with_gradients.value == pytest.approx(wrong.losses_alone.value, abs=0.02)
    assert wrong.of_gradients.high < 0.1
    assert wrong.weight < 1e-3 < 1e-1 < right.weight


def test_many_parameters_have_squares_without_products() -> None:
    x = sobol(200, 63, seed=0).numpy()
    found = fit_with_gradients(x, np.square(x).sum(axis=1), 2 * x, RNG(0))
    assert [(one.degree, one.separable, one.coefficients) for one in found] == [(1, False, 64), (2, True, 127)]
    assert found[1].with_gradients.value == pytest.approx(1)


def test_a_ridge_has_one_direction_and_a_bowl_those_of_its_axes() -> None:
    """The bowl sum of a_i (x_i - 1/2)^2 has eigenvalues a_i^2 / 3."""
    x, names = sobol(400, 3, seed=0).numpy(), ["a", "b", "c"]
    ridge = active_subspace(np.cos(x @ [3.0, 4.0, 0.0])[:, None] * [3.0, 4.0, 0.0], names, RNG(0))
    assert ridge.participation.value == pytest.approx(1)
    assert ridge.directions.value == 1
    assert ridge.leading == pytest.approx({"a": 0.6, "b": 0.8, "c": 0.0})
    a = np.array([3.0, 2.0, 1.0])
    bowl = active_subspace(2 * a * (x - 0.5), names, RNG(0))
    for found, wanted in zip(bowl.shares, a**2 / 14, strict=True):
        assert found.low <= wanted <= found.high
    assert bowl.participation.low <= 14**2 / (a**4).sum() <= bowl.participation.high
    flat = active_subspace(np.zeros((400, 3)), names, RNG(0))
    assert math.isnan(flat.participation.value)


def test_intervals_of_ishigamis_indices_hold_the_closed_ones() -> None:
    """First 0.314, 0.442, 0 and total 0.558, 0.442, 0.244, in 95 % intervals of 20 samples; the bounds are above."""

    def f(u: np.ndarray) -> np.ndarray:
        x = math.pi * (2 * u - 1)
        return np.asarray(np.sin(x[..., 0]) + 7 * np.sin(x[..., 1]) ** 2 + 0.1 * x[..., 2] ** 4 * np.sin(x[..., 0]))

    def slopes(u: np.ndarray) -> np.ndarray:
        a, b, c = np.moveaxis(math.pi * (2 * u - 1), -1, 0)
        parts = (1 + 0.1 * c**4) * np.cos(a), 7 * np.sin(2 * b), 0.4 * c**3 * np.sin(a)
        return 2 * math.pi * np.stack(parts, axis=-1)

    held, names = 0, ["a", "b", "c"]
    for seed in range(20):
        base, far = np.split(sobol(128, 6, seed=seed).numpy(), 2, axis=1)
        varied = np.repeat(base[:, None], 3, axis=1)
        varied[:, [0, 1, 2], [0, 1, 2]] = far
        found = sobol_indices(f(base), f(far), f(varied), slopes(base), names, RNG(seed))
        pairs = zip(
            [*found.first.values(), *found.total.values(), found.interaction],
            [0.314, 0.442, 0.0, 0.558, 0.442, 0.244, 0.244],
            strict=True,
        )
        held += sum(one.low <= wanted <= one.high for one, wanted in pairs)
        assert found.unexplained == []
        assert all(found.bound[name].value > found.total[name].value for name in names)
    assert 0.85 <= held / 140 <= 1
