"""Remedies: gradients against differences of their own losses and against closed forms, costs, refusals."""

import math
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

import gradscape as gs
from gradscape.envs.base import Environment
from gradscape.envs.remedies import (
    RemediedEnvironment,
    average,
    clip,
    remedied,
    rescale,
    shorten,
    smooth,
    soften,
)
from gradscape.jobs.scene import first_line
from gradscape.landscapes.randomised import ORDERS, Order, reflect

SQUARE = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})
WIDTH = 0.05  # of the box, whose sides are 2 long
POINTS = torch.tensor([[0.12, 0.3], [0.0, -0.2]], dtype=torch.float64)


def _step(x: Tensor) -> Tensor:
    return (x[:, 0] > 0.1).double() + 0 * x.sum(dim=1)


def _cubic(x: Tensor) -> Tensor:
    return x[:, 0] ** 2 + 3 * x[:, 0] * x[:, 1] + x[:, 1] ** 3


def _kinked(x: Tensor) -> Tensor:
    """Return a loss that is known everywhere, whose gradient is NaN where the root would be of less than 0."""
    return torch.where(x[:, 0] > 0.1, (x[:, 0] - 0.1).sqrt(), 0.0) + x[:, 1]


STEP, CUBIC = gs.from_torch(_step, SQUARE, name="step"), gs.from_torch(_cubic, SQUARE, name="cubic")


def _smoothed_step(x: Tensor) -> Tensor:
    """Return the gradient of a step that a Gaussian smooths: the Gaussian's density at the step."""
    sigma = 2 * WIDTH
    density = torch.exp(-(((x[:, 0] - 0.1) / sigma) ** 2) / 2) / (sigma * math.sqrt(2 * math.pi))
    return torch.stack([density, torch.zeros(len(x))], dim=1)


def _smoothed_cubic(x: Tensor) -> Tensor:
    """Return the gradient of a cubic polynomial that a Gaussian smooths: E (b + w)^3 = b^3 + 3 b sigma^2."""
    a, b = x.unbind(1)
    return torch.stack([2 * a + 3 * b, 3 * a + 3 * b**2 + 3 * (2 * WIDTH) ** 2], dim=1)


def _estimates(env: Environment, estimator: Order, count: int = 200) -> Tensor:
    """Return gradients of as many seeds, shape (seed, point, axis)."""
    found = [smooth(env, WIDTH, estimator=estimator, seed=seed).evaluate(POINTS).grad for seed in range(count)]
    return torch.stack([grad for grad in found if grad is not None])


def _differences(env: Environment, x: Tensor, step: float = 1e-5) -> Tensor:
    """Return central differences of an environment's own losses."""
    ends = [env.evaluate(x + sign * step * axis, grad=False).loss for axis in torch.eye(2) for sign in (1, -1)]
    return torch.stack([(up - down) / (2 * step) for up, down in (ends[:2], ends[2:])], dim=1)


@pytest.mark.parametrize(
    ("env", "truth", "unbiased"),
    [(STEP, _smoothed_step, ("zeroth", "mixed")), (CUBIC, _smoothed_cubic, ORDERS)],
    ids=["step", "cubic"],
)
@pytest.mark.parametrize("estimator", ORDERS)
def test_smoothed_gradients_have_the_mean_of_the_closed_form(env, truth, unbiased, estimator) -> None:
    """First order knows nothing of a step."""
    found = _estimates(env, estimator)
    error = (found.mean(dim=0) - truth(POINTS)).abs()
    sure = 4.5 * found.std(dim=0) / len(found) ** 0.5 + 1e-9
    assert bool((error <= sure).all()) == (estimator in unbiased)


def test_variances_are_those_of_theory() -> None:
    """Of a linear loss g.x: first order has none, zeroth order has (|g|^2 + g_i^2) / pairs, mixed has none."""
    slope = torch.tensor([3.0, -1.0], dtype=torch.float64)
    line = gs.from_torch(lambda x: x @ slope, SQUARE, name="line")
    variance = {one: _estimates(line, one).var(dim=0)[0] for one in ORDERS}
    assert variance["first"].max() < 1e-20
    assert variance["mixed"].max() < 1e-20
    torch.testing.assert_close(variance["zeroth"], (slope.square().sum() + slope**2) / 8, rtol=0.35, atol=0.0)


def test_mixed_varies_less_than_zeroth_order_where_gradients_explain_the_loss() -> None:
    mixed, zeroth = (_estimates(CUBIC, one).var(dim=0) for one in ("mixed", "zeroth"))
    assert bool((mixed < zeroth / 50).all())


@pytest.mark.parametrize(
    "env",
    [
        smooth(CUBIC, WIDTH, estimator="first"),
        smooth(CUBIC, 0.3, estimator="first"),  # much of which is reflected at the bounds
        clip(CUBIC, 1e6),
        remedied(CUBIC, "smooth:5%:first,smooth:2%:first:8"),
        rescale(CUBIC),
    ],
    ids=lambda env: env.identity()["remedy"],
)
def test_gradients_are_those_of_their_own_losses(env: Environment) -> None:
    torch.testing.assert_close(env.evaluate(POINTS).grad, _differences(env, POINTS), rtol=1e-6, atol=1e-7)


def test_clipped_gradients_keep_their_direction() -> None:
    plain, short = (env.evaluate(POINTS).grad for env in (CUBIC, clip(CUBIC, 0.5)))
    torch.testing.assert_close((2 * short).norm(dim=1), torch.full((2,), 0.5, dtype=torch.float64))  # sides are 2 long
    torch.testing.assert_close(torch.cosine_similarity(plain, short), torch.ones(2, dtype=torch.float64))
    torch.testing.assert_close(clip(CUBIC, 0.5).evaluate(POINTS).loss, CUBIC.evaluate(POINTS).loss)


def test_reflection_stays_in_the_cube_and_turns_its_slope() -> None:
    places, signs = reflect(torch.tensor([-0.25, 0.25, 1.25, 2.25]))
    assert places.tolist() == [0.25, 0.25, 0.75, 0.25]
    assert signs.tolist() == [-1, 1, -1, 1]


def test_a_smoothed_point_fails_where_most_around_it_fail() -> None:
    broken = gs.from_torch(lambda x: torch.where(x[:, 0] > 0, torch.nan, x[:, 1]), SQUARE, name="broken")
    found = smooth(broken, WIDTH).evaluate(torch.tensor([[-0.9, 0.0], [0.9, 0.0]], dtype=torch.float64))
    assert [gs.Status(one) for one in found.status.tolist()] == [gs.Status.OK, gs.Status.NONFINITE]


def test_a_smoothed_loss_is_the_same_with_and_without_gradients_where_some_lack() -> None:
    """Where some pairs have a loss and no gradient, the mean is over all losses."""
    kinked = gs.from_torch(_kinked, SQUARE, name="kinked")
    env, x = smooth(kinked, WIDTH), torch.tensor([[0.16, 0.0]], dtype=torch.float64)
    with_slopes, alone = env.evaluate(x), env.evaluate(x, grad=False)
    assert kinked.evaluate(x - 0.1).status.tolist() == [gs.Status.NO_GRADIENT]
    torch.testing.assert_close(with_slopes.loss, alone.loss, rtol=0, atol=0)


def test_rescaling_finds_the_scale_of_even_sensitivity() -> None:
    """A loss of log k has the same slope everywhere on a logarithmic scale; values stay the same."""
    space = gs.ParameterSpace({"k": (1, 1e4), "c": (1, 1e4), "d": (-1, 1)})
    env = gs.from_torch(lambda x: x[:, 0].log() + x[:, 1] + x[:, 2], space, name="log")
    found = rescale(env)
    assert found.space.scales == ("log10", "linear", "linear")
    values = torch.tensor([[100.0, 5.0, 0.5]], dtype=torch.float64)
    result = found.evaluate(found.space.from_values(values))
    torch.testing.assert_close(result.loss, env.evaluate(values).loss)
    torch.testing.assert_close(result.grad, torch.tensor([[math.log(10), 1, 1]], dtype=torch.float64))


def test_the_average_is_the_mean_of_the_replicas() -> None:
    env = gs.make("bounce", fidelity="draft")
    x, names = env.space.sobol(4, seed=0), list(env.replicas())
    of_all = torch.stack([one.evaluate(x).grad for one in (env, *env.replicas().values())])
    torch.testing.assert_close(average(env).evaluate(x).grad, of_all.mean(dim=0))
    assert average(env).episodes_per_point == 1 + len(names)
    assert average(env, names[:1]).identity()["remedy"] == f"average:{names[0]}"


def test_the_average_takes_the_replicas_of_its_own_settings() -> None:
    env = average(gs.make("bounce", fidelity="draft"))
    assert {one.horizon for one in env.with_horizon(0.5).remedy.others()} == {0.5}
    finer = env.remake(fidelity="standard")
    x = env.space.sobol(2, seed=0)
    torch.testing.assert_close(finer.evaluate(x).loss, average(gs.make("bounce", fidelity="standard")).evaluate(x).loss)


def test_an_average_of_functions_has_no_replicas_of_its_own() -> None:
    def moved(x: torch.Tensor, horizon: float = 1.0, by: float = 0.1) -> torch.Tensor:
        return horizon * ((x + by) ** 2).sum(dim=1)

    options = {"horizon": 1.0}
    env = average(
        gs.from_torch(
            lambda x, horizon: moved(x, horizon, 0.0), SQUARE, name="bowl", options=options, horizon="horizon",
            replicas={"moved": moved},
        )
    )  # fmt: skip
    assert not env.replicas()
    half = env.with_horizon(0.5)
    torch.testing.assert_close(half.evaluate(POINTS).loss, env.evaluate(POINTS).loss / 2)


def test_settings_of_the_scene_are_remedies_too() -> None:
    env = gs.make("bounce", fidelity="draft")
    assert shorten(env, 0.5).horizon == env.horizon / 2
    assert soften(env, 0.1).options.ke == env.options.ke / 10
    assert soften(env, fidelity="standard").fidelity.name == "standard"


def test_a_chain_says_what_it_is_and_what_a_point_costs() -> None:
    env = remedied(CUBIC, "smooth:2%:zeroth:8, clip:1")
    assert isinstance(env, RemediedEnvironment)
    assert env.identity()["remedy"] == "smooth:0.02:zeroth:8,clip:1"
    assert env.episodes_per_point == 8
    assert env.without() is CUBIC
    assert env.identity() == env.remake().identity()
    again = remedied(CUBIC, env.identity()["remedy"])
    torch.testing.assert_close(again.evaluate(POINTS).grad, env.evaluate(POINTS).grad, rtol=0, atol=0)


def test_wider_smoothing_flattens() -> None:
    ripples = gs.from_torch(lambda x: torch.sin(20 * x).sum(dim=1), SQUARE, name="ripples")
    points = SQUARE.sobol(64, seed=0)
    spreads = [float(smooth(ripples, width, samples=64).evaluate(points).loss.std()) for width in (0.01, 0.03, 0.05)]
    assert all(wide < narrow for narrow, wide in pairwise(spreads))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("polish:1", "no remedy 'polish'; the remedies are smooth:WIDTH"),
        ("smooth", "write the remedy as smooth:WIDTH"),
        ("smooth:0", "width above 0"),
        ("smooth:2%:second", "first, zeroth, mixed"),
        ("smooth:2%:mixed:4", "at least 6 if mixed"),
        ("clip:-1", "norm above 0"),
        ("average", "no replicas"),
        ("rescale:log10", "2 scales"),
        ("shorten:50%", "for the length of an episode"),
        ("soften:10%", "no contact stiffness"),
    ],
)
def test_what_no_remedy_is_gets_refused(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        remedied(CUBIC, text)


@pytest.mark.slow
@pytest.mark.parametrize(
    "function", [lambda x: (x * x.abs()).sum(dim=1), lambda x: ((x.round() - 3) ** 2).sum(dim=1) + 0 * x.sum(dim=1)]
)
def test_a_remedy_around_a_function_goes_through_every_door(function, tmp_path: Path) -> None:
    """A drag force, whose second derivative jumps, and a staircase, whose gradient is zero."""
    space = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})
    env = gs.smooth(gs.from_torch(function, space, name="own"), 0.05, estimator="first", samples=4)
    found = gs.slice(env, (0, 1), resolution=6)
    assert "smooth:0.05:first:4" in found.data.attrs["identity"]
    assert found.report().words
    assert gs.check(env, power=0.2)
    best = gs.optimize(env, "l-bfgs-b", budget=42)
    assert len(best.data["loss"]) == 10  # points of 4 episodes
    assert best.data["episodes"][-1] == 10
    assert best.data["forwards"][-1] >= 40
    gs.race(env, ["random"], seeds=1, budget=8, out=tmp_path / "race")
    gs.census(env, slices=1, resolution=6, out=tmp_path / "census")


def test_a_job_says_first_how_often_an_episode_runs_the_simulator() -> None:
    smoothed = smooth(average(gs.make("bounce", fidelity="draft")), 0.02, samples=6)
    said = first_line(smoothed.identity(), "out")
    assert said == "bounce · draft · average,smooth:0.02:mixed:6 · each episode runs the simulator 18 times · cpu · out"
    assert first_line(smoothed.without().identity()) == "bounce · draft · cpu"
