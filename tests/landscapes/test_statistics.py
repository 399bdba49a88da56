"""Quantiles, intervals and fitted lines, against scipy.stats, which the package does without where a command begins."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from gradscape.landscapes.statistics import Estimate, exact_share, fit_line, jackknife, mean, share, student

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("freedom", [1, 2, 3, 15, 40, 1000])
def test_students_quantile_is_that_of_scipy(freedom):
    for level in (0.6, 0.975, 0.9999):
        assert float(student(freedom, level)) == stats.t.ppf(level, freedom)
    assert float(student(freedom)) == stats.t.ppf(0.975, freedom)


@pytest.mark.parametrize(("hits", "tries"), [(0, 1), (1, 1), (0, 17), (3, 17), (17, 17), (1, 1000), (499, 1000)])
def test_the_interval_of_a_share_is_that_of_clopper_and_pearson(hits, tries):
    found, wanted = share(hits, tries), stats.binomtest(hits, tries).proportion_ci(0.95)
    assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high), rel=1e-9, abs=1e-12)
    if 0 < hits < tries:  # what the interval is: either end would leave 2.5 % for what was seen and beyond
        assert stats.binom.sf(hits - 1, tries, found.low) == pytest.approx(0.025, rel=1e-9)
        assert stats.binom.cdf(hits, tries, found.high) == pytest.approx(0.025, rel=1e-9)


def test_a_share_of_dependent_samples_has_the_interval_of_as_many_independent_ones():
    """Of 64 x 64 samples in 4 x 4 blocks that are alike within, 16 count; of independent ones nearly all do."""
    blocks = np.kron(RNG.permutation([1.0] * 4 + [0.0] * 12).reshape(4, 4), np.ones((16, 16)))
    found = exact_share(jackknife(lambda at: float(np.nanmean(at)), blocks), blocks.size)
    assert found.value == 0.25
    wider = share(4, 16)  # Student's factor for 16 blocks comes on top
    assert wider.low - 0.04 < found.low < wider.low
    assert wider.high < found.high < wider.high + 0.06
    free = (RNG.uniform(size=(64, 64)) < 0.1).astype(float)
    known, whole = (
        exact_share(jackknife(lambda at: float(np.nanmean(at)), free), free.size),
        share(int(free.sum()), 4096),
    )
    assert 0.5 < (known.high - known.low) / (whole.high - whole.low) < 2


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_a_share_of_none_or_all_has_an_interval(value):
    flags = np.full((12, 12), value)
    found, wanted = exact_share(jackknife(lambda at: float(np.nanmean(at)), flags), 144), share(int(144 * value), 144)
    assert (found.value, found.low, found.high) == (value, wanted.low, wanted.high)
    assert 0.02 < found.high - found.low < 0.03
    alone = exact_share(Estimate(value, np.nan, np.nan), 144)
    nothing = share(0, 0)
    assert np.isnan([alone.low, alone.high, nothing.value, nothing.low, nothing.high]).all()


def test_the_interval_of_a_share_of_blocks_holds_it_as_often_as_it_says():
    """In blocks that are alike within, of whose sixteen a known share is hit on the mean."""
    held = 0
    for _ in range(400):
        blocks = np.kron((RNG.uniform(size=(4, 4)) < 0.3).astype(float), np.ones((3, 3)))
        found = exact_share(jackknife(lambda at: float(np.nanmean(at)), blocks), 16)
        held += found.low <= 0.3 <= found.high
    assert held / 400 > 0.93


def test_the_interval_of_a_mean_is_students():
    values = RNG.normal(size=9)
    found = mean(np.append(values, np.nan))
    wanted = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high), rel=1e-12)


def test_the_jackknife_of_a_mean_over_blocks_is_the_interval_of_the_blocks_means():
    values = RNG.normal(size=16)
    wanted = mean(values)
    for samples in (np.repeat(values, 3), np.kron(values.reshape(4, 4), np.ones((3, 2)))):  # 16 blocks of one value
        found = jackknife(lambda at: float(np.nanmean(at)), samples)
        assert (found.value, found.low, found.high) == pytest.approx((wanted.value, wanted.low, wanted.high))


@pytest.mark.parametrize("count", [2, 3, 20])
def test_a_fitted_line_is_that_of_scipy(count):
    x = RNG.uniform(-3.0, 5.0, count)
    for noise in (0.0, 1e-3, 1.0):
        y = 2.0 - 0.7 * x + noise * RNG.normal(size=count)
        found, wanted = fit_line(x, y), stats.linregress(x, y)
        assert (found.slope, found.intercept) == (wanted.slope, wanted.intercept)
        assert found.standard_error == pytest.approx(wanted.stderr, rel=1e-9, abs=1e-9)


def test_a_line_through_equal_values_is_level_and_exact_and_one_x_is_refused():
    found = fit_line([0.0, 1.0, 2.0], [0.1, 0.1, 0.1])
    assert (found.slope, found.intercept, found.standard_error) == pytest.approx((0.0, 0.1, 0.0), abs=1e-15)
    with pytest.raises(ValueError, match=r"at two or more x; got 3 at \[0\.1\]"):
        fit_line([0.1, 0.1, 0.1], [1.0, 2.0, 3.0])
