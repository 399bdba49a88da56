"""Orders, limits and floors of sequences whose order is known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from gradscape.envs.records import Fidelity
from gradscape.studies import samples
from gradscape.studies.convergence import Level, Levels, Scale, conclude, estimate_remainders, judge
from gradscape.studies.order import (
    choose_order,
    extrapolate,
    find_floor,
    fit_order,
    measure_order,
    point_order,
    solve_order,
)
from gradscape.studies.samples import Bootstrap

WIDTHS = [1.0, 0.5, 0.25, 0.125]
UNEVEN = [1.5, 1.0, 2 / 3, 0.5]
Array = NDArray[np.float64]


def manufacture(widths: list[float], order: float, *, points: int = 16, noise: float = 0.0, seed: int = 0) -> Array:
    """Return L(h) = L + a h^p of so many points, shape (level, point), with relative noise on the error."""
    generator = np.random.default_rng(seed)
    limit, amount = generator.normal(size=(2, points))
    error = amount * np.array(widths)[:, None] ** order
    found: Array = limit + error * (1 + noise * generator.normal(size=error.shape))
    return found


def refined(setting: str, widths: list[float], losses: Array, designed: float | None = None) -> Levels:
    names = [f"{setting}-{width:g}" if width != 0.5 else "reference" for width in widths]
    levels = [Level(name, width, Fidelity(name, width), 0.0) for name, width in zip(names, widths, strict=True)]
    return Levels(setting, levels, losses, [np.ones((len(loss), 2)) for loss in losses], designed)


@pytest.mark.parametrize("widths", [WIDTHS, UNEVEN])
@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 4.0])
def test_a_known_order_is_found_and_its_limit(widths: list[float], order: float) -> None:
    losses = manufacture(widths, order)
    found = measure_order(widths, losses, scale=1.0, seed=0)
    assert found.verdict == "converges"
    assert found.pooled.value == pytest.approx(order, rel=1e-6)
    assert found.per_point == pytest.approx(np.full(16, order), rel=1e-6)
    assert (found.shapes.monotone, found.shapes.growing) == (16, 0)
    limit = np.random.default_rng(0).normal(size=(2, 16))[0]
    assert extrapolate(widths, losses, order) == pytest.approx(limit, abs=1e-9)


def test_the_two_ways_to_solve_for_an_order_agree_where_steps_are_uneven() -> None:
    for order in (-1.0, 0.0, 0.7, 2.5):
        widths = np.array([3.0, 2.0, 1.5])
        values = widths**order if order else np.log(widths)
        coarse, fine = np.abs(np.diff(values))
        assert solve_order(widths.tolist(), coarse, fine) == pytest.approx(order, abs=1e-6)
        assert float(fit_order(widths.tolist(), np.array([coarse, fine]))) == pytest.approx(order, abs=1e-6)


def test_an_order_s_interval_holds_it_about_as_often_as_it_says() -> None:
    tries, held = 60, 0
    for seed in range(tries):
        found = measure_order(WIDTHS, manufacture(WIDTHS, 2.0, noise=0.1, seed=seed), scale=1.0, seed=seed).pooled
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 2.0 <= found.high
    assert held / tries >= 0.9


def test_an_oscillating_sequence_has_an_order_and_is_called_so() -> None:
    signs = np.array([1.0, -1.0, 1.0, -1.0])[:, None]
    losses = signs * np.array(WIDTHS)[:, None] ** 2 * np.linspace(1, 2, 8)
    found = measure_order(WIDTHS, losses, scale=1.0, seed=0)
    assert (found.shapes.oscillating, found.shapes.monotone) == (8, 0)
    assert found.pooled.value == pytest.approx(2.0, rel=1e-6)
    assert point_order(WIDTHS[-3:], losses[-3:, 0]) == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_what_does_not_converge_gets_no_limit(seed: int) -> None:
    losses = np.random.default_rng(seed).normal(size=(4, 16))
    found = measure_order(WIDTHS, losses, scale=1.0, seed=0)
    assert found.verdict == "does not converge"
    assert found.pooled.low is not None
    assert found.pooled.low <= 0
    assert choose_order(found.verdict, found.pooled, 1.0) is None
    said = conclude(one := refined("dt", WIDTHS, losses), "reference", scale_of(1.0))
    assert estimate_remainders([(one, said)], {"reference": losses[1]}, losses[1], scale_of(1.0)) == ()
    with pytest.raises(ValueError, match="positive order"):
        extrapolate(WIDTHS, losses, -0.5)


def scale_of(off: float) -> Scale:
    return Scale(1.0, Bootstrap(off, off, off), 0)


def test_two_levels_and_what_stands_still_are_said_to_be_so() -> None:
    losses = manufacture(WIDTHS, 1.0)
    assert measure_order(WIDTHS[:2], losses[:2], scale=1.0, seed=0).verdict == "too few levels"
    still = np.repeat(losses[:1], 4, axis=0)
    assert measure_order(WIDTHS, still, scale=1.0, seed=0).verdict == "unmoved"
    assert measure_order(WIDTHS, np.full((4, 5), np.nan), scale=1.0, seed=0).verdict == "too few levels"
    with pytest.raises(ValueError, match="from coarse to fine"):
        measure_order(WIDTHS[::-1], losses, scale=1.0, seed=0)


def test_points_that_fail_at_a_coarse_level_cost_that_level_alone() -> None:
    losses = manufacture(WIDTHS, 2.0)
    losses[0, 3] = np.nan
    found = measure_order(WIDTHS, losses, scale=1.0, seed=0)
    assert len(found.per_point) == 16
    assert found.pooled.value == pytest.approx(2.0, rel=1e-6)


def test_a_floor_is_where_differences_stop_to_fall() -> None:
    widths = [2.0**-k for k in range(6)]
    losses = manufacture(widths, 2.0) + 0.01 * np.array([1, -1, 1, -1, 1, -1])[:, None]
    moves = np.median(np.abs(np.diff(losses, axis=0)), axis=1)
    assert find_floor(moves.tolist(), "converges") == pytest.approx(0.02, rel=0.2)
    assert find_floor([0.4, 0.1, 0.025], "converges") is None
    assert find_floor([0.4, 0.1, 0.3], "does not converge") == 0.1
    assert find_floor([0.4], "too few levels") is None


def test_what_is_left_is_the_distance_from_the_limit_and_corrections_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "RESAMPLES", 99)
    generator = np.random.default_rng(1)
    limit, step, cell = generator.normal(size=(3, 16))
    at = {(dt, h): limit + step * dt + cell * h**2 for dt in WIDTHS for h in WIDTHS}
    both = [
        refined("dt", WIDTHS, np.array([at[dt, 0.5] for dt in WIDTHS]), designed=1.0),
        refined("resolution", WIDTHS, np.array([at[0.5, h] for h in WIDTHS])),
    ]
    reference = at[0.5, 0.5]
    pairs = [(one, conclude(one, "reference", scale_of(1.0))) for one in both]
    found = estimate_remainders(pairs, {"standard": at[1.0, 1.0], "reference": reference}, reference, scale_of(1.0))
    standard, left = found
    assert standard.median.value == pytest.approx(float(np.median(np.abs(step + cell))), rel=1e-6)
    assert left.median.value == pytest.approx(float(np.median(np.abs(0.5 * step + 0.25 * cell))), rel=1e-6)
    assert left.p95.value == pytest.approx(float(np.abs(0.5 * step + 0.25 * cell).max()), rel=1e-6)


def test_a_remainder_s_interval_holds_it_where_the_order_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "RESAMPLES", 99)
    tries, held = 20, 0
    for seed in range(tries):
        losses = manufacture(WIDTHS, 1.5, points=24, noise=0.05, seed=seed)
        one = refined("dt", WIDTHS, losses)
        said = conclude(one, "reference", scale_of(1.0))
        (left,) = estimate_remainders([(one, said)], {"reference": losses[1]}, losses[1], scale_of(1.0))
        truth = 0.5**1.5 * 0.6745  # of the median of |a|, a standard normal
        assert left.median.low is not None
        assert left.median.high is not None
        held += left.median.low <= truth <= left.median.high
    assert held >= 0.8 * tries


@pytest.mark.parametrize(
    ("off", "met", "start"), [(100.0, True, "reference"), (4.0, False, "dt-0.25"), (0.1, False, None)]
)
def test_the_rule_is_a_tenth_of_what_standard_is_off(off: float, met: bool, start: str | None) -> None:
    """With a = 1, halving the step from a half moves losses by 0.25 - 0.5 = 1/4 of a, then by an eighth."""
    losses = np.arange(16.0) + np.array(WIDTHS)[:, None] * 2
    found = conclude(refined("dt", WIDTHS, losses), "reference", scale_of(off))
    assert found.moved is not None
    assert found.moved.value == pytest.approx(0.5)
    assert (found.met, found.met_from) == (met, start)
    rule = judge([found], scale_of(off))
    assert (rule.met, rule.failing) == (met, () if met else ("dt",))
    assert ("is converged" in rule.sentence()) == met


@pytest.mark.parametrize(("moves", "met"), [(1e-10, True), (1e-8, False)])
def test_a_reference_that_moves_by_rounding_alone_is_converged_however_right_standard_is(
    moves: float, met: bool
) -> None:
    losses = np.arange(16.0) + moves * np.array([1, -1, 1, -1])[:, None]
    found = conclude(refined("dt", WIDTHS, losses), "reference", scale_of(1e-10))
    rule = judge([found], scale_of(1e-10))
    assert (rule.met, "is converged to rounding" in rule.sentence()) == (met, met)
    assert "within a tenth" not in found.sentence()


def test_points_that_a_finer_level_fails_at_count_as_infinitely_far_off() -> None:
    losses = manufacture(WIDTHS, 1.0)
    losses[2, :3] = np.nan
    found = conclude(refined("dt", WIDTHS, losses), "reference", scale_of(1.0))
    assert found.moved is not None
    assert found.moved.value is None
    assert found.met is False
