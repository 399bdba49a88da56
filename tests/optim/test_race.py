import dataclasses
import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape.gallery.paper import read_paper
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim import statistics
from gradscape.optim.base import Kind
from gradscape.optim.claims import ClaimVerdict, check_claims
from gradscape.optim.race import Competitor, picture, race
from gradscape.optim.registry import optimizer_class
from gradscape.optim.runs.store import RunStore
from gradscape.optim.search import search
from gradscape.optim.statistics import difference

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
    assert (goals.loss[0], goals.loss[-1], len(goals.loss)) == (0.01, 100, 50)
    np.testing.assert_allclose(np.diff(np.log(goals.loss)), np.log(1e4) / 49)
    assert (goals.spacing, goals.easiest) == ("log", "median loss of the random points")
    shifted = statistics.targets({"random": [run - 50 for run in random], "a": [table([-60])]})
    assert shifted.spacing == "linear"


def test_targets_without_random_points_begin_where_the_runs_did():
    goals = statistics.targets(RACE)
    assert (goals.loss[0], goals.loss[-1], goals.spacing) == (1, 4.5, "linear")  # of 3, 5, 8, 4
    assert goals.easiest == "median of the first loss of each run"
    assert len(statistics.targets({"a": [table([NAN])]}).loss) == 0


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
    assert difference("a", np.array([0.0]), "b", np.array([9.0])).better is None


def test_better_is_who_the_interval_of_the_difference_leaves_no_doubt_about():
    noise = np.random.default_rng(0).normal(size=(2, 10))
    apart = difference("a", noise[0], "b", noise[1] + 5)
    assert apart.better == "a"
    assert apart.reversed.better == "a"
    assert difference("a", noise[0] + 9, "b", noise[1]).better == "b"
    assert difference("a", noise[0], "b", noise[1]).better is None
    assert difference("a", np.array([NAN, 1.0]), "b", noise[1] + 5).better is None


def synthetic(**centers: float) -> dict[str, list[xr.Dataset]]:
    random = np.random.default_rng(0)
    return {name.replace("_", "-"): [table([c + random.normal()]) for _ in range(10)] for name, c in centers.items()}


def verdicts(env: str, **centers: float) -> dict[str, ClaimVerdict]:
    found = check_claims(read_paper().claims_about(env).claims, statistics.differences(synthetic(**centers)))
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
    assert dataset["hit"].sizes == {"method": 2, "pair": 100}
    np.testing.assert_array_equal(dataset["mean"][1], [6, 2.5, NAN])
    np.testing.assert_array_equal(dataset["episodes"][0], [1, 3, 4])


class Bowl:
    """A bowl that fails in a corner, counts its episodes, and can be interrupted after some."""

    space = ParameterSpace.box(("x", "y"), -2.0, 2.0, "m")
    name = "bowl"

    def __init__(self, stop_after: float = math.inf):
        self.asked, self.stop_after = 0, stop_after
        self.batches: list[int] = []

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        if self.asked >= self.stop_after:
            raise KeyboardInterrupt
        self.asked += len(x)
        self.batches.append(len(x))
        failed = torch.where((x > 1).all(dim=1), Status.ESCAPED, Status.OK)
        return Evaluation.from_results((x**2).sum(dim=1), 2 * x if grad else None, failed)


BUDGET = 37


def field(folder=None, seeds=2) -> list[Competitor]:
    found = []
    for seed in range(seeds):
        for method in ("random", "cma-es", "descents"):
            identity = {"objective": "bowl", "method": method, "seed": seed}
            made = partial(optimizer_class(method).on, Bowl(), seed=seed)
            if folder is None:
                run = RunStore.in_memory(Bowl.space, identity=identity, budget=BUDGET)
            else:
                path = folder / f"{method}-{seed}/run.zarr"
                run = RunStore.open_or_create(path, Bowl.space, identity=identity, budget=BUDGET)
            found.append(Competitor(method, seed, run, made))
    return found


def bits(entries: list[Competitor]) -> dict[tuple[str, int], tuple[bytes, ...]]:
    columns = ("x", "loss", "grad", "status", "kind", "episodes", "forwards")
    return {
        (entry.method, entry.seed): tuple(entry.run.dataset()[name].to_numpy().tobytes() for name in columns)
        for entry in entries
    }


def alone() -> list[Competitor]:
    entries = field()
    for entry in entries:
        search(Bowl(), entry.make(), entry.run, budget=BUDGET, gradient_cost=2.0)
    return entries


def test_every_run_has_the_budget_to_the_episode_and_seeds_differ():
    objective, entries = Bowl(), field()
    race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert objective.asked == BUDGET * len(entries)
    assert [entry.run.count for entry in entries] == [BUDGET] * 6
    assert len(set(bits(entries).values())) == len(entries)


def test_runs_in_lockstep_are_those_of_each_alone():
    objective, entries = Bowl(), field()
    race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert bits(entries) == bits(alone())
    assert objective.batches[:2] == [2 * (16 + 6), 2 * 4]  # of both seeds: populations, then descents with gradient
    assert len(objective.batches) < BUDGET * 2  # a run that has ended is not waited for


@pytest.mark.parametrize("abreast", [1, 4])
def test_more_runs_than_go_on_abreast_take_turns(monkeypatch, abreast):
    monkeypatch.setattr("gradscape.optim.race.ABREAST", abreast)
    entries = field()
    race(Bowl(), entries, budget=BUDGET, gradient_cost=2.0)
    assert bits(entries) == bits(alone())


def test_a_race_that_was_stopped_goes_on_to_the_same_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("gradscape.optim.runs.store.PAUSE", 0.0)
    monkeypatch.setattr("gradscape.optim.runs.store.SHARE", math.inf)
    for stop in (20, 150):
        with pytest.raises(KeyboardInterrupt):
            race(Bowl(stop), field(tmp_path), budget=BUDGET, gradient_cost=2.0)
    kept = sum(entry.run.count for entry in field(tmp_path))
    assert 0 < kept < BUDGET * 6
    objective, entries = Bowl(), field(tmp_path)
    race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert objective.asked == BUDGET * 6 - kept
    assert bits(entries) == bits(alone())


def test_a_finished_race_computes_nothing_and_touches_no_file(tmp_path):
    race(Bowl(), field(tmp_path), budget=BUDGET, gradient_cost=2.0)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")}
    objective, made = Bowl(), []
    again = [dataclasses.replace(entry, make=partial(made.append, entry)) for entry in field(tmp_path)]
    race(objective, again, budget=BUDGET, gradient_cost=2.0)
    assert (objective.asked, made) == (0, [])
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")} == before


def test_what_the_objective_raises_ends_all_runs():
    class Broken(Bowl):
        def evaluate(self, x, *, grad=True):
            if grad:
                raise ValueError("no gradients here")
            return super().evaluate(x, grad=grad)

    objective = Broken()
    with pytest.raises(ValueError, match="no gradients here"):
        race(objective, field(seeds=8), budget=BUDGET, gradient_cost=2.0)
    assert len(objective.batches) <= 1


def test_a_method_that_breaks_ends_the_others():
    objective, entries = Bowl(), field()

    def broken(made=entries[1].make):
        optimizer = made()
        optimizer._ask = lambda: 1 / 0
        return optimizer

    entries[1] = dataclasses.replace(entries[1], make=broken)
    with pytest.raises(ZeroDivisionError):
        race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert len(objective.batches) <= 2
    race(Bowl(), field(), budget=BUDGET, gradient_cost=2.0)  # and nothing of it is left


def test_seconds_are_a_runs_own_and_its_share_of_each_batch():
    class Slow(Bowl):
        def evaluate(self, x, *, grad=True):
            now[0] += 0.01 * len(x)
            return super().evaluate(x, grad=grad)

    now = [0.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gradscape.optim.meeting.time", clock)
        entries = field()
        race(Slow(), entries, budget=BUDGET, gradient_cost=2.0)
    for entry in entries:
        assert entry.run.dataset()["seconds"].to_numpy()[-1] == pytest.approx(0.01 * BUDGET)


def test_what_a_gradient_costs_is_measured_once_before_the_race():
    objective, entries = Bowl(), field()
    race(objective, entries, budget=BUDGET)
    costs = {entry.run.gradient_cost for entry in entries if entry.method == "descents"}
    assert len(costs) == 1
    assert costs.pop() > 0


def test_an_interrupt_while_methods_compute_ends_them(monkeypatch):
    objective, entries = Bowl(), field()

    def interrupted(self):
        self.end()
        raise KeyboardInterrupt

    monkeypatch.setattr("gradscape.optim.meeting.Meeting._wait_for_all", interrupted)
    with pytest.raises(KeyboardInterrupt):
        race(objective, entries, budget=BUDGET, gradient_cost=2.0)
    assert objective.asked == 0


def test_progress_tells_which_run_it_is_of():
    entries, seen = field(), {}
    race(Bowl(), entries, budget=BUDGET, gradient_cost=2.0, progress=lambda e, now: seen.update({e: now}))
    assert {(e.method, e.seed): now.done for e, now in seen.items()} == {(e.method, e.seed): BUDGET for e in entries}
    assert all(now.best == e.run.best_loss for e, now in seen.items())
