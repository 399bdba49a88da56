"""A league: races in many scenes that are stopped, continue and fail by themselves, and what they say together."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gradscape.envs.functions import Branin
from gradscape.envs.registry import make
from gradscape.gallery.paper import read_paper
from gradscape.jobs.league import LeagueJob, simulated_scenes
from gradscape.jobs.race import RaceJob
from gradscape.jobs.scene import SceneSpec, read_scene
from gradscape.jobs.search import divide_methods
from gradscape.jobs.watch import Stopped, Watch
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.storage.records import read_json
from gradscape.optim.claims import ClaimVerdict
from gradscape.optim.league import League
from gradscape.optim.runs.store import RunStore

METHODS = ("random", "cma-es", "descents")
SMALL: dict[str, Any] = {"budget": 12, "seeds": 2, "command": "landscape league"}


class Broken(Branin):
    """Branin's function where it cannot be computed."""

    name = "broken"

    def _evaluate(self, x: Any, *, grad: bool) -> Any:
        raise RuntimeError("the engine is on fire")


class Notes(Watch):
    """Keep what a job notes, and be interrupted at a note that begins with some words."""

    def __init__(self, stop: str = "never") -> None:
        self.said, self.stop = list[str](), stop

    def note(self, text: str) -> None:
        self.said.append(text)
        if text.startswith(self.stop):
            raise KeyboardInterrupt


def job(out: Path, *scenes: str | type, methods: tuple[str, ...] = METHODS, **how: Any) -> LeagueJob:
    specs = [read_scene(one, SceneSpec("", device="cpu")) if isinstance(one, str) else SceneSpec(one) for one in scenes]
    return LeagueJob.of(specs, methods, out=out, **{**SMALL, **how})


def rows(league: League) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name != "command"} for row in to_json(league)["rows"]]


@pytest.mark.slow
def test_a_league_has_the_races_that_each_scene_has_alone(tmp_path: Path) -> None:
    league = job(tmp_path / "league", "branin", "beale").run()
    assert [scene.env for scene in league.scenes] == ["branin", "beale"]
    for scene in league.scenes:
        env = make(scene.env, device="cpu")
        alone = RaceJob.of(env, METHODS, budget=12, seeds=2, command="", out=tmp_path / scene.env).run()
        ranks = {rank.method: (rank.rank, rank.mean, rank.low) for rank in alone.statistics.ranks}
        assert {one.method: (one.rank, one.mean, one.low) for one in scene.standings} == ranks
        assert scene.pairs == tuple(alone.statistics.superiorities)
        assert scene.best is not None
        assert scene.best.loss == min(run.best.loss for runs in alone.runs.values() for run in runs)
        found = env.evaluate(torch.tensor([scene.best.x], dtype=torch.float64), grad=False).loss
        assert float(found) == pytest.approx(scene.best.loss, rel=1e-9)
        for one in scene.standings:
            times = [np.inf if time is None else time for time in one.times]
            np.testing.assert_allclose(times, alone.running_times()[one.method].to_numpy()[::10], rtol=1e-5)


def test_it_is_written_and_read_again_with_a_row_for_each_scene_and_method(tmp_path: Path) -> None:
    league = job(tmp_path, "branin", "beale").run()
    kept = read_json(tmp_path / "league.json")
    assert kept == json.loads(json.dumps(to_json(league)))
    assert to_json(from_json(League, kept)) == kept
    assert {(row["env"], row["method"]) for row in kept["rows"]} == {
        (env, method) for env in ("branin", "beale") for method in METHODS
    }
    row = kept["rows"][0]
    assert sorted(row["probability"]) == sorted(set(METHODS) - {row["method"]})
    assert len(row["running_times"]) == 6
    assert len(league.table()) == 6
    assert (tmp_path / "league.png").read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in tmp_path.iterdir()} == {"branin-exact", "beale-exact", "league.json", "league.png"}


def test_over_all_scenes_a_method_has_the_mean_of_its_mean_ranks(tmp_path: Path) -> None:
    league = job(tmp_path, "branin", "beale", "ackley", methods=("random", "cma-es")).run()
    by = {scene.env: {one.method: one.rank for one in scene.standings} for scene in league.scenes}
    for one in league.overall:
        mine = [ranks[one.method] for ranks in by.values()]
        assert (one.rank, one.scenes) == (pytest.approx(np.mean(mine)), 3)
        assert min(mine) <= one.low <= one.rank <= one.high <= max(mine)
    assert [one.rank for one in league.overall] == sorted(one.rank for one in league.overall)


@pytest.mark.e2e
def test_a_league_that_is_stopped_goes_on_scene_by_scene(tmp_path: Path) -> None:
    whole = job(tmp_path / "whole", "branin", "beale").run()
    with pytest.raises(Stopped, match=r"72 of 144 episodes are kept"):
        job(tmp_path / "stopped", "branin", "beale").run(Notes("2 of 2"))
    assert [scene["env"] for scene in read_json(tmp_path / "stopped/league.json")["scenes"]] == ["branin"]
    watch = Notes()
    again = job(tmp_path / "stopped", "branin", "beale").run(watch)
    assert watch.said[0].startswith("branin@exact · cpu: 72 of 72 episodes are done")
    assert watch.said[1].startswith("beale@exact · cpu: 0 of 72 episodes are done, the rest takes ")
    assert "2 of 2 scenes, 3 methods, 2 seeds, 12 episodes each" in watch.said[2]
    assert rows(again) == rows(whole)


def test_more_methods_seeds_and_episodes_go_on_and_finished_runs_are_not_touched(tmp_path: Path) -> None:
    job(tmp_path, "branin", methods=("random",)).run()
    run = tmp_path / "branin-exact/random-0/run.zarr"
    before = RunStore.open(run).dataset()["loss"].to_numpy()
    watch = Notes()
    more = job(tmp_path, "branin", methods=("random", "cma-es"), budget=20, seeds=3).run(watch)
    assert "24 of 120 episodes are done" in watch.said[0]
    np.testing.assert_array_equal(RunStore.open(run).dataset()["loss"].to_numpy()[:12], before)
    assert (more.scenes[0].seeds, more.scenes[0].budget, sorted(more.methods)) == (3, 20, ["cma-es", "random"])


def test_a_scene_that_breaks_is_named_and_the_others_are_raced(tmp_path: Path) -> None:
    watch = Notes()
    league = job(tmp_path, Broken, "branin").run(watch)
    assert [scene.env for scene in league.scenes] == ["branin"]
    (why,) = league.failed.values()
    assert "tried: RuntimeError: the engine is on fire" in why
    assert any(f"broken@exact is left out: {why}" in line for line in watch.said)
    assert read_json(tmp_path / "league.json")["failed"] == league.failed
    with pytest.raises(ValueError, match="no scene of the league could be raced: broken@exact: SimulatorError"):
        job(tmp_path / "none", Broken).run()


def test_a_method_that_cannot_search_a_scene_is_left_out_there_with_the_reason() -> None:
    able, unable = divide_methods(make("cartpole", device="cpu"), ("random", "bo-gradient"))
    assert able == ["random"]
    assert "bo-gradient" in unable["bo-gradient"]
    assert divide_methods(make("branin"), ("bo-gradient",)) == (["bo-gradient"], {})


@pytest.mark.parametrize(
    ("scenes", "how", "said"),
    [
        (["nothing"], {}, "no environment is called 'nothing'"),
        (["branin@draft"], {}, "branin has fidelities exact; got 'draft'"),
        (["branin", "branin@exact"], {}, "each only once; got branin more than once"),
        ([], {}, "league takes at least one scene, and each only once; got none"),
        (["branin"], {"methods": ("magic",)}, "no method is called 'magic'"),
        (["branin"], {"budget": 0}, "a budget is a whole number of at least 1; got 0"),
    ],
)
def test_what_is_no_league_is_refused_before_anything_is_made(
    tmp_path: Path, scenes: list[str], how: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        job(tmp_path, *scenes, **how)
    assert not list(tmp_path.iterdir())


def test_a_name_says_its_fidelity_and_a_path_does_not() -> None:
    plain = SceneSpec("", "draft")
    assert read_scene("fluid", plain) == SceneSpec("fluid", "draft")
    assert read_scene("fluid@standard", plain) == SceneSpec("fluid", "standard")
    assert read_scene("a@b/own.py:Bowl", plain) == SceneSpec("a@b/own.py:Bowl", "draft")


def test_all_scenes_are_those_of_the_papers_words() -> None:
    assert set(simulated_scenes()) == set(read_paper().words)


def test_claims_are_held_against_a_scenes_pairs(tmp_path: Path) -> None:
    (scene,) = job(tmp_path, "branin").run().scenes
    findings = scene.findings(read_paper().claims_about("cartpole"))
    by = {str(one.claim): one for one in findings}
    assert by["bo-leap better than random"].verdict == ClaimVerdict.NOT_RUN
    asked = by["descents better than random"]
    assert asked.superiority is not None
    assert asked.superiority.probability == scene.probabilities("descents")["random"]
    assert asked.verdict == ClaimVerdict.UNDECIDED  # by two seeds
