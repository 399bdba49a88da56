"""Errors, fronts, orders and the choice of a variant, on numbers whose answer is known, and their picture."""

from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.text import Text
from scipy.stats import spearmanr
from torch import Tensor

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.draw.figures.accuracy import fidelity_figure, short_name
from gradscape.landscapes.draw.figures.page import save
from gradscape.landscapes.objective import Objective, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.statistics import gradient_error, spearman
from gradscape.studies import samples
from gradscape.studies.fidelity import fit_order_in_dt
from gradscape.studies.samples import Bootstrap, Comparison, Sample, compare, pareto_front

from ..made_studies import VARIANTS, fidelities, sample, variant


def test_errors_are_shares_of_the_spread_between_the_5th_and_95th_percentile() -> None:
    reference = sample([float(k) for k in range(101)])
    off = sample([k + (9.0 if k in (3, 50, 97) else 1.0) for k in range(101)])
    found = compare(off, reference, seed=0)
    assert samples.spread(reference) == pytest.approx(90.0)
    assert found.loss_error.median.value == 1.0
    assert found.loss_error.median_relative.value == pytest.approx(1 / 90)
    assert found.loss_error.p95.value == 1.0  # three in a hundred are farther off
    assert found.loss_error.p95.high == 9.0
    assert found.diverged == 0


def test_an_episode_that_failed_is_infinitely_far_off_and_a_failed_reference_is_left_out() -> None:
    reference = sample([float(k) for k in range(20)], failed=2)
    few, many = (compare(sample([k + 1.0 for k in range(20)], failed=lost), reference, seed=0) for lost in (2, 3))
    assert few.compared == many.compared == 18
    assert (few.diverged, few.loss_error.p95.value) == (0, 1.0)
    assert many.diverged == pytest.approx(1 / 18)
    assert few.failed is not None
    assert many.failed is not None
    assert (many.failed.low, many.failed.high) == pytest.approx((0.0014, 0.2729), abs=1e-4)  # of 1 in 18
    assert few.failed.high == pytest.approx(1 - 0.025 ** (1 / 18))  # none in 18
    assert many.loss_error.p95.value is None
    assert many.loss_error.median.value == 1.0


def test_a_loss_without_a_gradient_is_no_failure_and_the_share_of_missing_gradients_is_said() -> None:
    reference, variant = sample([float(k) for k in range(20)]), sample([k + 1.0 for k in range(20)])
    reference.status[:4], reference.grad[:4] = Status.NO_GRADIENT, np.nan
    variant.status[2:8], variant.grad[2:8] = Status.NO_GRADIENT, np.nan
    found = compare(variant, reference, seed=0)
    assert (found.compared, found.diverged, found.loss_error.median.value) == (20, 0, 1.0)
    assert found.missing == pytest.approx(4 / 16)
    assert found.gradient.cosine.value == pytest.approx(1.0)
    assert from_json(Comparison, to_json(found)) == found


def test_rank_correlation_is_spearmans() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 50)).round(1)  # with ties
    assert spearman(a, b) == pytest.approx(spearmanr(a, b).statistic)


def test_gradients_that_are_both_zero_agree_and_one_that_is_zero_alone_does_not() -> None:
    grad = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, 3.0], [-2.0, 0.0]])
    reference = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 2.0], [1.0, 0.0]])
    cosine, off = gradient_error(grad, reference)
    np.testing.assert_array_equal(cosine, [1, 0, 0, 1, -1])
    np.testing.assert_array_equal(off, [0, 1, np.inf, 0.5, 3])


def test_intervals_cover_what_they_should() -> None:
    rng, hits = np.random.default_rng(1), 0
    for seed in range(200):
        found = Bootstrap.of(lambda values: np.median(values, axis=-1), rng.normal(size=40), seed=seed)
        assert found.low is not None
        assert found.high is not None
        hits += found.low <= 0 <= found.high
    assert 0.9 <= hits / 200 <= 0.99


def test_the_front_holds_what_no_other_beats() -> None:
    seconds = [1.0, 2.0, 3.0, 2.5, 4.0, 0.5, 5.0]
    error = [0.5, 0.2, 0.2, 0.3, 0.1, np.inf, np.nan]
    assert pareto_front(seconds, error) == [0, 1, 4]


@pytest.mark.parametrize("p", [1.0, 2.0, 4.0])
def test_the_order_of_convergence_is_found(p: float) -> None:
    dt = np.array([0.1, 0.05, 0.025, 0.0125])
    found = fit_order_in_dt([(step, 3.0 * step**p, "") for step in dt])
    assert found is not None
    assert found.order == pytest.approx(p)
    assert fit_order_in_dt([(step, off, "") for step, off in zip(dt, [0.1, 0.05, np.inf, 0.0], strict=True)]) is None


def test_the_cheapest_variant_within_a_tolerance_is_chosen() -> None:
    rows = [("coarse", 1.0, 0.2), ("middle", 2.0, 0.05), ("dear", 3.0, 0.01), ("broken", 0.1, None)]
    found = fidelities([VARIANTS[0], *(variant(*row) for row in rows)])
    for tolerance, name in ((0.3, "coarse"), (0.05, "middle"), (0.049, "dear")):
        assert (one := found.cheapest(tolerance)) is not None
        assert one.name == name
    assert found.cheapest(0.001) is None


def test_gradients_are_per_width_of_the_box_and_points_are_evaluated_once_in_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(samples, "REPETITION", 0.01)
    space = ParameterSpace(("a", "b"), torch.tensor([0.0, 0.0]), torch.tensor([1.0, 10.0]), ("", ""))
    x = space.sobol(8, seed=3)
    heard: list[int] = []
    found = samples.measure(from_torch(lambda x: 2 * x[:, 0] + x[:, 1], space, rows=1), x, follow=heard.append)
    np.testing.assert_allclose(found.grad, np.tile([2.0, 10.0], (8, 1)))
    np.testing.assert_allclose(found.loss, 2 * x[:, 0] + x[:, 1])
    assert heard == list(range(1, 9))
    assert bool((space.sobol(8, seed=4) != x).any())
    again = Sample.of_arrays({name: np.asarray(value) for name, value in found.arrays().items()})
    assert (again.forward, again.batch) == (found.forward, found.batch)


def test_seconds_are_those_of_an_episode_in_a_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "REPETITION", 0.2)
    clock = [0.0]
    monkeypatch.setattr(samples.time, "perf_counter", lambda: clock[0])
    space = ParameterSpace.box(["a"], 0.0, 1.0)

    class Slow(Objective):
        preferred_batch = 4
        space = ParameterSpace.box(["a"], 0.0, 1.0)

        def evaluate(self, x: Tensor, *, grad: bool = True) -> Any:
            clock[0] += 0.01 + len(x) * (0.003 if grad else 0.001)
            return from_torch(lambda x: x[:, 0], space).evaluate(x, grad=grad)

    found = samples.measure(Slow(), space.sobol(10, seed=0))
    assert found.batch == 4
    assert found.forward == pytest.approx(0.014 / 4)
    assert found.with_gradient == pytest.approx(0.022 / 4)


@pytest.fixture
def figure(tmp_path: Any) -> Figure:
    drawn = fidelity_figure(fidelities())
    save(drawn, tmp_path / "fidelity.png")
    return drawn


@pytest.mark.drawn
def test_the_picture_draws_the_front_and_stands_broken_variants_on_the_edge(figure: Figure) -> None:
    (ax,) = figure.axes
    lines = {line.get_gid(): line for line in ax.lines if line.get_gid()}
    np.testing.assert_allclose(lines["front"].get_xydata()[:3], [(0.1, 30), (0.2, 10), (1, 2)])
    np.testing.assert_allclose(lines["front"].get_xydata()[3:], [(10, ax.get_ylim()[0])])  # where the reference is
    np.testing.assert_allclose(lines["dt"].get_xydata()[2], (0.05, ax.get_ylim()[1]))
    (legend,) = figure.legends
    assert "dt (1 failed too often: on the edge)" in [text.get_text() for text in legend.get_texts()]


@pytest.mark.drawn
def test_no_legend_is_wider_than_its_page(tmp_path: Any) -> None:
    lost = [variant(f"{what} {n}", 0.05, None, what) for what in ("resolution", "particles") for n in range(12)]
    more = [variant(what, 0.3, 0.2, what) for what in ("precision", "engine")]
    drawn = fidelity_figure(fidelities([*VARIANTS, *lost, *more]))
    save(drawn, tmp_path / "fidelity.png")
    (legend,) = drawn.legends
    assert {"resolution (12 failed too often: on the edge)", "engine"} < {
        text.get_text() for text in legend.get_texts()
    }
    box = legend.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= drawn.bbox.width


@pytest.mark.parametrize("width", [None, 85.0])
@pytest.mark.parametrize("crowd", [0, 8])
@pytest.mark.drawn
def test_every_variant_is_named_beside_its_mark_or_by_number_in_the_legend(width: float | None, crowd: int) -> None:
    crowded = [(f"standard-resolution-{n}", 1.0 + 0.02 * n, 0.021 + 0.002 * n, "resolution") for n in range(crowd)]
    found = fidelities([*VARIANTS, *(variant(*one) for one in crowded)])
    drawn = fidelity_figure(found, width=width)
    (ax,), (legend,) = drawn.axes, drawn.legends
    entries = [text.get_text().split(": ", 1) for text in legend.get_texts()]
    keyed = {entry[0]: entry[1] for entry in entries if entry[0].isdigit()}
    said = sorted(keyed.get(text.get_text(), text.get_text()) for text in ax.texts)
    assert said == sorted(short_name(row) for row in found.variants[1:])
    drawn.canvas.draw()
    boxes = [Text.get_window_extent(text) for text in ax.texts]
    assert not any(one.overlaps(other) for number, one in enumerate(boxes) for other in boxes[:number])
