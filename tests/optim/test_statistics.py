import math

import numpy as np
import pytest
import xarray as xr

from gradscape.gallery.paper import read_paper
from gradscape.optim import statistics
from gradscape.optim.base import Kind
from gradscape.optim.claims import ClaimVerdict, check_claims
from gradscape.optim.race import picture
from gradscape.optim.statistics import (
    Superiority,
    difference,
    differences,
    holm,
    rank_test,
    superiorities,
    win_probability,
)

NAN = math.nan


def table(losses, *, kind=Kind.POPULATION, forward=1.0) -> xr.Dataset:
    episodes = np.arange(1, len(losses) + 1)
    columns = {"loss": np.array(losses, float), "kind": np.full(len(losses), kind), "episodes": episodes}
    columns |= {"forwards": forward * episodes, "seconds": 0.5 * episodes}
    return xr.Dataset({name: ("evaluation", values) for name, values in columns.items()})


# Best losses: a 3, 3, 1, 1 and 5, 5, 5, 2; b none, 8, 8, 1 and 4, 4, 4, 4.
RACE = {
    "a": [table([3, 4, 1, NAN]), table([5, NAN, 6, 2])],
    "b": [table([NAN, 8, 9, 1], forward=2.0), table([4, 5, 6, 7], forward=2.0)],
}


def test_a_failed_episode_improves_nothing_and_before_a_success_there_is_no_best():
    np.testing.assert_array_equal(statistics.best_so_far(np.array([NAN, 3, NAN, 5, 2])), [NAN, 3, 3, 3, 2])


def test_a_mean_curve_begins_with_the_last_seeds_first_success_and_steps_where_one_improves():
    a, b = (statistics.curve(RACE[name], "episodes") for name in "ab")
    np.testing.assert_array_equal([a.cost, a.mean], [[1, 3, 4], [4, 3, 1.5]])
    np.testing.assert_array_equal([b.cost, b.mean], [[2, 4], [6, 2.5]])
    np.testing.assert_array_equal([b.low, b.high], [[4, 1], [8, 4]])  # two seeds: as wide as the seeds themselves


def test_costs_are_those_that_were_paid_and_a_curve_ends_with_its_first_run():
    b = statistics.curve(RACE["b"], "forwards")
    np.testing.assert_array_equal([b.cost, b.mean], [[4, 8], [6, 2.5]])
    apart = [table([2, 1, 1], forward=1.0), table([4, 3, 0], forward=10.0)]
    assert len(statistics.curve(apart, "forwards").cost) == 0  # the second had not begun when the first had ended
    late = [table([2, 1, 1], forward=10.0), table([4, 3, 0], forward=4.0)]
    curve = statistics.curve(late, "forwards")
    np.testing.assert_array_equal([curve.cost, curve.mean], [[10, 12], [2.5, 1.0]])


def test_a_method_with_a_seed_that_never_succeeds_has_no_mean():
    runs = [table([1, 2]), table([NAN, NAN])]
    assert len(statistics.curve(runs, "episodes").cost) == 0
    (rank,) = statistics.ranks({"a": runs})
    assert math.isnan(rank.mean)
    assert (rank.unsuccessful, rank.failed) == (1, 2)


def test_ranks_average_ties_put_failures_last_and_share_wins():
    final = {"a": [1, 2, 5, NAN], "b": [1, 4, 3, NAN], "c": [7, 2, 4, 6]}
    runs = {name: [table([x]) for x in final[name]] for name in final}
    ranks = {rank.method: rank for rank in statistics.ranks(runs)}
    # per seed a 1.5, 1.5, 3, 2.5; b 1.5, 3, 1, 2.5; c 3, 1.5, 2, 1
    assert {name: rank.rank for name, rank in ranks.items()} == {"a": 8.5 / 4, "b": 8 / 4, "c": 7.5 / 4}
    assert {name: rank.wins for name, rank in ranks.items()} == {"a": 2, "b": 2, "c": 2}
    assert list(ranks) == ["c", "b", "a"]
    assert ranks["c"].rank_low < 7.5 / 4 < ranks["c"].rank_high


def test_targets_run_from_the_best_loss_to_the_median_of_random_points():
    random = [table([100, 1000, NAN], kind=Kind.RANDOM), table([10, 100, 1], kind=Kind.RANDOM)]
    goals = statistics.targets({"random": random, "a": [table([9000, 0.01, 5])] * 2})
    assert (goals.loss[0], goals.loss[-1], len(goals.loss)) == (0.01, 100, 51)
    np.testing.assert_allclose(np.diff(np.log(goals.loss)), np.log(1e4) / 50)
    assert (goals.spacing, goals.easiest) == ("log", "median loss of the random points")
    shifted = statistics.targets({"random": [run - 50 for run in random], "a": [table([-60])]})
    assert shifted.spacing == "linear"


def test_targets_without_random_points_begin_where_the_runs_did():
    goals = statistics.targets(RACE)
    assert (goals.loss[0], goals.loss[-1], goals.spacing) == (1, 4.5, "log")  # of 3, 5, 8, 4
    assert goals.easiest == "median of the first loss of each run"
    assert len(statistics.targets({"a": [table([NAN])]}).loss) == 0


def test_targets_go_down_to_the_best_that_is_known_and_not_below_what_coco_asks_for():
    known = statistics.targets(RACE, best_known=0.3)
    assert (known.loss[0], known.best_known) == (0.3, 0.3)
    assert statistics.running_times(RACE["a"], known)[0] == math.inf  # none has reached it
    worse = statistics.targets(RACE, best_known=2.0)
    assert (worse.loss[0], worse.best_known) == (1, 1)
    zero = statistics.targets(RACE, best_known=0.0)
    assert zero.loss[0] == pytest.approx(4.5e-8)
    assert (zero.spacing, zero.best_known) == ("log", 0.0)


def test_an_expected_running_time_is_all_that_was_spent_by_how_many_succeeded():
    goals = statistics.Targets(np.array([0.5, 1.0, 2.0, 4.5]), "log", "")
    # a: never; after 3 and in vain all 4; after 3 and 4; after 1 and 4
    np.testing.assert_array_equal(statistics.running_times(RACE["a"], goals), [math.inf, 7, 3.5, 2.5])
    np.testing.assert_array_equal(statistics.running_times(RACE["b"], goals), [math.inf, 8, 8, 2.5])
    assert statistics.times_record(np.array([math.inf, 10 / 3])) == [None, 3.33333]


def test_the_ecdf_counts_each_target_from_the_episode_that_reached_it():
    goals = statistics.Targets(np.array([1.0, 2.0, 4.5]), "linear", "")
    np.testing.assert_array_equal(statistics.hits(RACE["a"], goals), [[3, 3, 1], [NAN, 4, 4]])
    np.testing.assert_array_equal(statistics.hits(RACE["b"], goals), [[4, 4, 4], [NAN, NAN, 1]])
    share = statistics.Shares.of(statistics.hits(RACE["a"], goals))
    assert share.episodes == [1, 3, 3, 4, 4]
    assert share.share == [pytest.approx(n / 6) for n in range(1, 6)]


def test_intervals_cover_the_mean_as_often_as_they_say():
    samples = np.random.default_rng(5).exponential(size=(50, 800))
    low, high = statistics.interval(samples)
    assert 0.92 < ((low < 1) & (high > 1)).mean() < 0.97


def test_an_interval_is_that_of_scipys_bootstrap():
    from scipy.stats import bootstrap

    sample = np.random.default_rng(1).normal(size=12)
    theirs = bootstrap((sample,), np.mean, n_resamples=100_000, method="percentile", rng=2).confidence_interval
    np.testing.assert_allclose(statistics.interval(sample), theirs, atol=0.02)


def test_one_seed_has_no_interval_and_decides_nothing():
    assert np.isnan(statistics.interval(np.array([[1.0, 2.0]]))).all()
    alone = difference("a", np.array([0.0]), "b", np.array([9.0]))
    assert (alone.mean, math.isnan(alone.low), math.isnan(alone.high)) == (-9.0, True, True)
    (pair,) = superiorities({"a": np.array([0.0]), "b": np.array([9.0])})
    assert (pair.probability, pair.p, pair.better) == (1.0, 1.0, None)


def test_better_is_who_the_corrected_test_says_whatever_the_interval_of_the_difference():
    """Its interval excludes zero here, and p is below 0.05 for the pair alone, but not corrected for ten pairs."""
    noise = np.random.default_rng(0).normal(size=(5, 10))
    apart = difference("a", noise[0], "b", noise[1] + 5)
    assert apart.high < 0 < apart.reversed.low
    final = {"a": noise[0], "b": noise[1] + 1.4} | {f"c{number}": noise[number] + 100 for number in (2, 3, 4)}
    close = difference("a", final["a"], "b", final["b"])
    pair = next(one for one in superiorities(final) if {one.first, one.second} == {"a", "b"})
    assert close.high < 0
    assert pair.p < 0.05 < pair.corrected
    assert pair.better is None


def test_a_win_is_counted_over_all_pairs_of_seeds_with_ties_as_half():
    a, b = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0])
    assert win_probability(a, b) == (2 + 1.5 + 1) / 6  # 1 beats both, 2 ties one, 3 beats one
    assert win_probability(b, a) == 1 - win_probability(a, b)
    none = np.array([NAN, NAN])
    assert win_probability(a, none) == 1
    assert win_probability(none, none) == 0.5


def test_the_rank_test_is_exact_where_nothing_ties():
    low, high = np.arange(3.0), np.arange(3.0, 6.0)
    assert rank_test(low, high) == pytest.approx(2 / 20)  # of 20 arrangements the first and the last are so far apart
    ten = np.arange(10.0)
    assert rank_test(ten, ten + 10) == pytest.approx(2 / math.comb(20, 10))
    assert rank_test(np.ones(4), np.ones(3)) == 1
    assert 0.05 < rank_test(np.array([1.0, 1, 2, 2]), np.array([1.0, 2, 2, 2])) < 1
    assert rank_test(ten, np.full(10, NAN)) == rank_test(ten, np.full(10, 99.0))


def test_holms_correction_is_what_his_procedure_decides():
    found = holm([0.01, 0.04, 0.03, 0.005])
    assert found == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []
    # step by step at a level: reject from the least on, as long as p is below the level by how many are left
    random = np.random.default_rng(3).uniform(size=(50, 6)) ** 4
    for ps in random:
        rejected, left = set(), 6
        for number in np.argsort(ps):
            if ps[number] > 0.05 / left:
                break
            rejected.add(int(number))
            left -= 1
        assert rejected == {number for number, one in enumerate(holm(list(ps))) if one <= 0.05}


def test_who_is_ahead_is_decided_over_all_pairs_together():
    one = Superiority("a", "b", 0.9, 0.01, 0.04)
    assert (one.better, one.reversed.better, one.reversed.first) == ("a", "a", "b")
    assert one.reversed.probability == pytest.approx(0.1)
    assert Superiority("a", "b", 0.9, 0.01, 0.06).better is None
    runs = synthetic(a=0, b=1, c=9)
    pairs = compare(runs)
    for pair in pairs:
        assert pair.p <= pair.corrected <= 3 * pair.p
    assert {pair.better for pair in pairs if "c" in (pair.first, pair.second)} == {"a", "b"}


def synthetic(**centers: float) -> dict[str, list[xr.Dataset]]:
    random = np.random.default_rng(0)
    return {name.replace("_", "-"): [table([c + random.normal()]) for _ in range(10)] for name, c in centers.items()}


def compare(runs) -> list[Superiority]:
    return superiorities(dict(zip(runs, statistics.final_losses(runs), strict=True)))


def test_a_method_is_first_only_where_it_is_ahead_of_every_other_one():
    found = statistics.RaceStatistics.of(synthetic(a=0, b=9, c=12))
    assert (found.lead.method, found.lead.rivals, found.lead.is_first) == ("a", (), True)
    assert found.lead.describe() == "a is first: ahead of every other method (corrected p at most 3.2e-05)"
    level = statistics.RaceStatistics.of(synthetic(a=0, b=0.9, c=12)).lead
    assert (level.method, level.rivals, level.is_first) == ("a", ("b",), False)
    assert level.describe().startswith("no method is first: a has the best mean rank, not distinguishable from b (")
    alone = Superiority("a", "b", 0.8, 0.02, 0.04)  # by itself b is behind
    assert statistics.Lead.of(["a", "b"], [alone]).is_first
    assert not statistics.Lead.of(["a", "b"], [Superiority("a", "b", 0.8, 0.02, 0.06)]).is_first
    assert not statistics.Lead.of(["a", "b"], [Superiority("a", "b", 0.4, 0.02, 0.04)]).is_first  # it is behind
    assert not statistics.Lead.of(["a"], []).is_first


def test_of_equal_methods_none_is_better_in_more_than_a_twentieth_of_races():
    random, races = np.random.default_rng(5), 400
    told = sum(
        any(pair.better for pair in superiorities({name: random.normal(size=10) for name in "abcd"}))
        for _ in range(races)
    )
    assert told / races < 0.05 + 2 * math.sqrt(0.05 * 0.95 / races)


def test_what_is_not_told_from_another_method_is_what_the_corrected_test_leaves_open():
    pairs = [
        Superiority("a", "b", 0.9, 0.01, 0.03),
        Superiority("a", "c", 0.7, 0.1, 0.2),
        Superiority("b", "c", 0.5, 1, 1),
    ]
    assert statistics.not_told_from("c", ["a", "b", "c"], pairs) == ("a", "b")
    assert statistics.not_told_from("a", ["a", "b", "c"], pairs) == ("c",)


def test_at_equal_cost_each_run_counts_up_to_the_least_that_one_spent():
    """Episodes of `b` cost twice as much, so that of four of them two count; of the second race's, one."""
    cost = statistics.EqualCost.of(RACE)
    assert cost.forwards == 4.0
    np.testing.assert_array_equal(statistics.final_losses(RACE, 4.0), [[1, 2], [8, 4]])
    assert [(one.method, one.rank) for one in cost.ranks] == [("a", 1.0), ("b", 2.0)]
    quick = {"a": [table([5, 4, 3, 2])] * 2, "b": [table([9, 8, 1, 1], forward=3.0)] * 2}
    assert [rank.method for rank in statistics.ranks(quick)] == ["b", "a"]
    assert [one.method for one in statistics.EqualCost.of(quick).ranks] == ["a", "b"]  # of b one episode counts
    dear = {"a": [table([5, 4])], "b": [table([9, 1], forward=9.0)]}
    assert np.isnan(statistics.final_losses(dear, 2.0)[1, 0])  # its first episode costs more than all of a's


def verdicts(env: str, **centers: float) -> dict[str, ClaimVerdict]:
    runs = synthetic(**centers)
    found = check_claims(read_paper().claims_about(env).claims, differences(runs), compare(runs))
    return {str(finding.claim): finding.verdict for finding in found}


def test_a_claim_holds_fails_is_not_decided_or_not_run():
    ours = verdicts("rolling-pin", bo_leap=0, cma_es=9, descents=-9)
    assert ours == {
        "bo-leap better than cma-es": ClaimVerdict.HOLDS,
        "bo-leap better than descents": ClaimVerdict.FAILS,
        "bo-leap better than bo-descents": ClaimVerdict.NOT_RUN,
    }
    reverse = verdicts("rolling-pin", descents=9, cma_es=-9, bo_leap=0)  # whichever of a pair comes first
    assert reverse["bo-leap better than cma-es"] == ClaimVerdict.FAILS
    assert reverse["bo-leap better than descents"] == ClaimVerdict.HOLDS
    assert verdicts("rolling-pin", bo_leap=0, cma_es=0)["bo-leap better than cma-es"] == ClaimVerdict.UNDECIDED


def test_that_two_are_alike_can_be_refuted_and_never_shown():
    assert verdicts("pinch", bo_leap=0, cma_es=0)["bo-leap and cma-es alike"] == ClaimVerdict.UNDECIDED
    assert verdicts("pinch", bo_leap=0, cma_es=9)["bo-leap and cma-es alike"] == ClaimVerdict.FAILS


def test_the_picture_holds_every_curve_and_every_pair_of_seed_and_target():
    dataset = picture(RACE, statistics.RaceStatistics.of(RACE))
    assert dataset["hit"].sizes == {"method": 2, "pair": 102}
    np.testing.assert_array_equal(dataset["mean"][1], [6, 2.5, NAN])
    np.testing.assert_array_equal(dataset["episodes"][0], [1, 3, 4])
