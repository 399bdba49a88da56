"""Verdicts on a model's parts by fixed rules, their times in turn, and their picture."""

import numpy as np
import pytest
from matplotlib.text import Text

from gradscape.landscapes import cost
from gradscape.landscapes.draw.figures.accuracy import model_figure
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.space import ParameterSpace
from gradscape.studies import samples
from gradscape.studies.model import Effect, Price, judge_price
from gradscape.studies.samples import Bootstrap

from ..clock import Clock
from ..made_studies import full, part, sample, study

ONE = (1.0, 0.9, 1.1)


def effect_of(loss: np.ndarray, *, noisy: float = 1e-3, failed: int = 0, slope: float = 1.0) -> Effect:
    return part("part", sample(loss, failed=failed, slope=slope), ONE, noisy=noisy).effect


def test_what_is_within_twice_the_noise_is_nothing() -> None:
    assert effect_of(full().loss + 1.9e-3) == Effect.NOTHING
    assert effect_of(full().loss + 2.1e-3) == Effect.LOSSES
    assert effect_of(full().loss + 2.1e-3, noisy=1.0) == Effect.NOTHING


def test_a_single_loss_that_moves_beyond_the_largest_noise_counts() -> None:
    loss = full().loss.copy()
    loss[7] += 0.01
    assert effect_of(loss) == Effect.LOSSES
    assert part("part", sample(loss), ONE).moved == pytest.approx(1 / 40)


def test_without_any_noise_losses_must_move_by_more_than_their_last_digit() -> None:
    assert effect_of(full().loss * (1 + 1e-7), noisy=0.0) == Effect.NOTHING
    assert effect_of(full().loss * (1 + 1e-6), noisy=0.0) == Effect.LOSSES


def test_the_order_changes_below_a_rank_correlation_of_099_and_of_the_noises_own() -> None:
    loss = full().loss
    swapped = np.where(loss < 4, 3 - loss, loss)  # four of forty in reverse: rank correlation 0.998
    assert effect_of(swapped) == Effect.LOSSES
    assert effect_of(-loss) == Effect.ORDER
    half = np.where(loss < 20, 19 - loss, loss)
    assert effect_of(half) == Effect.ORDER
    assert effect_of(half, noisy=30.0) == Effect.NOTHING  # the noise turns the order round as well


def test_gradients_alone_may_change_and_failures_come_first() -> None:
    assert effect_of(full().loss, slope=0.5) == Effect.GRADIENTS
    assert effect_of(full().loss + 1.0, failed=2) == Effect.LOSSES  # one in twenty
    assert effect_of(full().loss + 1.0, failed=3) == Effect.FAILURE


@pytest.mark.parametrize(
    ("ends", "price"),
    [((0.9, 0.8, 0.99), Price.SAVES), ((0.9, 0.8, 1.0), Price.NOTHING), ((1.2, 1.01, 1.3), Price.COSTS)],
)
def test_a_price_is_named_where_the_interval_of_the_ratio_excludes_one(
    ends: tuple[float, float, float], price: Price
) -> None:
    assert judge_price(Bootstrap(*ends)) == price


def test_a_machine_that_gets_slower_and_slower_disturbs_both_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()

    class Slow(Objective):
        """Takes so many seconds a point, more at each call."""

        space, preferred_batch, calls = ParameterSpace.box(["x"], 0.0, 1.0), 8, 0

        def __init__(self, seconds: float) -> None:
            self.seconds = seconds

        def evaluate(self, x, *, grad=True):  # type: ignore[no-untyped-def]
            Slow.calls += 1
            clock.sleep(len(x) * self.seconds * (1 + 0.02 * Slow.calls))
            return Evaluation.from_results(x[:, 0], x if grad else None)

    for module in (samples, cost):
        monkeypatch.setattr(module, "time", clock)
    found = samples.take_turns(Slow(0.1), Slow(0.2), Slow.space.sobol(8, seed=0))
    assert found.first.max() > 1.5 * found.first.min()  # apart, they would differ by that
    assert found.ratio(grad=True, seed=0).value == pytest.approx(2.0, rel=0.02)
    assert found.batch == 2  # which take long enough to be timed


def names(picture: object) -> dict[str, Text]:
    return {text.get_text(): text for text in picture.findobj(Text) if text.get_gid() == "name"}  # type: ignore[attr-defined]


PARTS = {f"part {number}": 0.01 * 1.1**number for number in range(9)} | {"nothing": 0.0, "not there": 5.0}


@pytest.mark.parametrize("width", [None, 85.0])
@pytest.mark.drawn
def test_every_part_is_named_once_and_no_name_covers_another(width: float | None) -> None:
    picture = model_figure(study(PARTS, failing=True), width=width)
    found = names(picture)
    shown = [text.get_text() for legend in picture.legends for text in legend.get_texts()]
    numbered = [said.partition(": ")[2] for said in shown if said.partition(": ")[0].isdecimal()]
    written = {name for name in found if not name.isdecimal()}
    assert sorted([*written, *numbered]) == sorted([*PARTS, "glass"])
    boxes = [text.get_window_extent() for text in found.values()]
    assert not any(a.overlaps(b) for number, a in enumerate(boxes) for b in boxes[:number])


@pytest.mark.drawn
def test_missing_parts_are_hollow_and_what_cannot_be_placed_is_on_the_edges() -> None:
    (ax,) = model_figure(study({"drag": 1.0, "nothing": 0.0, "not there": 5.0}, failing=True)).axes
    marks = [line for line in ax.lines if len(line.get_xdata()) == 1]
    hollow = [line.get_markerfacecolor() == "white" for line in marks]
    assert hollow == [False, False, True, False]
    low, high = ax.get_ylim()
    heights = [float(line.get_ydata()[0]) for line in marks]
    relative = 100 / np.subtract(*np.percentile(full().loss, (95, 5)))
    assert heights == pytest.approx([relative, low, 5 * relative, high])
    assert [float(line.get_xdata()[0]) for line in marks] == pytest.approx([5.0, 10.0, 15.0, 0.0])
    said = [text.get_text() for text in ax.figure.legends[0].get_texts()]
    assert "hollow: missing, added by the change" in said
    assert any(text.startswith("noise of the full model: ") for text in said)
