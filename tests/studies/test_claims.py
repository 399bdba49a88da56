"""Claims at their edges, shortfalls with their intervals, and the choice, on numbers whose answer is known."""

import math
from dataclasses import replace

import pytest

from gradscape.envs.records import Fidelity
from gradscape.landscapes.convert import from_json, to_json
from gradscape.studies.claims import CLAIMS, Choice, Claim, Shortfall, choose, fronts, nearness, surely_beaten
from gradscape.studies.fidelity import MeasuredVariant
from gradscape.studies.samples import Bootstrap, Comparison, GradientError, LossError, Seconds

DRAFT, STANDARD = CLAIMS
KNOWN = Bootstrap(0.0, 0.0, 0.0)


def point(value: float | None, room: float = 0.0) -> Bootstrap:
    return Bootstrap(value, value and value - room, value and value + room)


def measured(
    name: str = "one",
    seconds: float = 1.0,
    *,
    rank: float | None = 1.0,
    cosine: float | None = 1.0,
    error: float | None = 0.0,
    failed: float | None = 0.0,
    room: float = 0.0,
) -> MeasuredVariant:
    found = Comparison(
        LossError(KNOWN, KNOWN, KNOWN, point(error, room)),
        point(rank, room),
        GradientError(point(cosine, room), KNOWN),
        failed,
        64,
        Seconds(seconds / 2, seconds),
        16,
    )
    return MeasuredVariant(name, "mixed", Fidelity(name, dt=0.1), "warp", "cpu", {}, None, found)


@pytest.mark.parametrize("claim", CLAIMS)
@pytest.mark.parametrize("what", ["rank", "cosine", "error"])
def test_a_claim_is_kept_at_its_limit_and_broken_just_beyond(claim: Claim, what: str) -> None:
    limit = getattr(claim, what)
    worse = math.nextafter(limit, 1.0 if what == "error" else 0.0)
    assert Shortfall.of(measured(**{what: limit}).comparison, claim).value == 1.0
    assert Shortfall.of(measured(**{what: limit}).comparison, claim).kept
    broken = Shortfall.of(measured(**{what: worse}).comparison, claim)
    assert not broken.kept
    assert broken.by == what


@pytest.mark.parametrize(
    "lost", [{"failed": 1 / 64}, {"failed": None}, {"rank": None}, {"error": None}, {"cosine": None}]
)
def test_what_fails_anywhere_or_is_not_known_keeps_no_claim(lost: dict[str, float | None]) -> None:
    assert Shortfall.of(measured(**lost).comparison, DRAFT).value == math.inf  # type: ignore[arg-type]


def test_gradients_of_a_chaotic_motion_promise_nothing() -> None:
    found = measured(cosine=-0.2, rank=0.96).comparison
    assert not Shortfall.of(found, DRAFT).kept
    assert Shortfall.of(found, DRAFT, chaotic=True).kept
    assert Shortfall.of(found, DRAFT, chaotic=True).value == pytest.approx(0.8)
    assert Shortfall.of(measured(cosine=None).comparison, DRAFT, chaotic=True).kept


def test_the_interval_of_a_shortfall_spans_the_largest_ends() -> None:
    found = Shortfall.of(measured(rank=0.97, error=0.05, room=0.01).comparison, DRAFT)
    assert (found.value, found.low, found.high) == pytest.approx((0.6, 0.4, 0.8))
    assert found.by == "rank"


def test_the_cheapest_that_keeps_the_claim_is_chosen_within_the_limit() -> None:
    rows = [
        measured("draft", 1.0, error=0.3),
        measured("coarse", 0.5, error=0.11),
        measured("fine", 3.0, error=0.01),
        measured("enough", 2.0, error=0.09),
        measured("broken", 0.1, failed=0.1),
    ]
    cost = {row.name: row.seconds for row in rows}
    found = choose(rows, DRAFT, cost, max_cost=4)
    assert (found.variant, found.seconds, found.kept, found.lacking) == ("enough", 2.0, True, "")
    assert found.today_shortfall == pytest.approx(3.0)
    assert found.candidates == 4
    assert from_json(Choice, to_json(found)) == found
    assert choose(rows, DRAFT, cost | {"enough": 3.5}, max_cost=4).variant == "fine"  # by the cost that is given
    near = choose(rows, DRAFT, cost, max_cost=1.5)
    assert (near.variant, near.kept, near.lacking) == ("coarse", False, "error")
    assert near.shortfall == pytest.approx(1.1)


def test_the_nearest_has_the_smallest_largest_lack() -> None:
    rows = [
        measured("standard", 1.0, rank=0.95, error=0.0),  # five times what may lack in rank
        measured("even", 2.0, rank=0.98, error=0.06, cosine=0.96),  # twice, in all three
        measured("same", 3.0, rank=0.98, error=0.0599, cosine=0.9601),  # by a thousandth only, at a higher cost
        measured("one", 2.0, rank=1.0, error=0.09),  # three times, in one
    ]
    found = choose(rows, STANDARD, {row.name: row.seconds for row in rows}, max_cost=4)
    assert found.variant == "even"
    assert found.shortfall == pytest.approx(2.0)


def test_where_nothing_answers_everywhere_nothing_is_chosen() -> None:
    found = choose([measured("draft", failed=0.5)], DRAFT, {"draft": 1.0}, max_cost=4)
    assert (found.variant, found.kept, found.candidates, found.today_shortfall) == (None, False, 0, None)
    assert from_json(Choice, to_json(found)) == found


def test_a_front_is_by_the_cost_of_each_claim() -> None:
    rows = [
        measured("poor", 1.0, rank=0.8),
        measured("good", 2.0, rank=0.99),
        measured("beaten", 3.0, rank=0.97),
        measured("failed", 0.1, failed=0.1),
    ]
    here = {row.name: row.seconds for row in rows}
    assert fronts(rows, {"draft": here, "standard": here}) == ["poor", "good"]
    assert fronts(rows, {"draft": here | {"beaten": 0.5}, "standard": here}) == ["poor", "good", "beaten"]
    assert nearness(rows[1].comparison) < nearness(rows[0].comparison)


def test_only_a_quicker_one_that_is_better_beyond_both_intervals_beats_surely() -> None:
    slow = measured("slow", 2.0, error=0.2, room=0.01)
    better = measured("better", 1.0, error=0.1, room=0.01)
    assert surely_beaten(slow, [better])
    assert not surely_beaten(slow, [replace(better, comparison=measured(seconds=3.0, error=0.1).comparison)])
    assert not surely_beaten(slow, [measured("close", 1.0, error=0.19, room=0.01)])
    assert not surely_beaten(slow, [])
