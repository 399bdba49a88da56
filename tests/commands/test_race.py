"""`landscape race`: what it computes, keeps, draws, says and refuses."""

from pathlib import Path

import numpy as np
import pytest

from gradscape.landscapes.storage.records import read_json
from gradscape.optim.registry import methods
from gradscape.optim.runs.store import RunStore

from ..command import Run

RACE = ["race", "branin", "--methods", "random,cma-es", "--methods", "descents", "--budget", "40", "--seeds", "3"]


@pytest.mark.drawn
def test_race_leaves_runs_picture_and_figures(run: Run, tmp_path: Path) -> None:
    done = run.ok(*RACE, "--json", "--out", "r")
    said, kept = done.json, read_json(tmp_path / "r/race.json")
    assert said == {key: kept[key] for key in kept if key not in ("curves", "ecdf")} | {"folder": "r"}
    assert kept["methods"] == ["random", "cma-es", "descents"]
    assert "360 episodes to compute" in done.stderr
    assert (tmp_path / "r/race.png").read_bytes().startswith(b"\x89PNG")
    for rank in kept["ranks"]:
        runs = [RunStore.open(tmp_path / f"r/{rank['method']}-{seed}/run.zarr").dataset() for seed in range(3)]
        assert [table.sizes["evaluation"] for table in runs] == [40, 40, 40]
        assert rank["final"] == [float(table["loss"].min()) for table in runs]
        for cost in ("episodes", "forwards", "seconds"):
            mean = kept["curves"][cost][rank["method"]]["mean"]
            assert mean or cost == "seconds"  # where a run may be over before another has begun to succeed
            assert mean[-1:] <= mean[:1]
        assert kept["curves"]["episodes"][rank["method"]]["mean"][-1] == pytest.approx(np.mean(rank["final"]))


def test_more_seeds_methods_and_episodes_go_on_where_the_race_ended(run: Run, tmp_path: Path) -> None:
    first = run("race branin --methods random --budget 20 --seeds 2")
    assert "40 episodes to compute" in first.stderr
    again = run("race branin --methods random --budget 20 --seeds 2")
    assert "all 40 episodes are done already" in again.stderr
    more = run("race branin --methods random,cma-es --budget 30 --seeds 3 --json")
    assert "140 episodes to compute, 40 are done already" in more.stderr
    less = run("race branin --methods random --budget 20 --seeds 2 --json")
    assert less.json["folder"] == more.json["folder"]
    assert len(list(tmp_path.glob("out/race-branin-exact-*/*/run.zarr"))) == 6
    both = [next(rank for rank in said.json["ranks"] if rank["method"] == "random") for said in (less, more)]
    assert both[0]["final"][0] >= both[1]["final"][0]
    assert both[0]["forwards"] == 20
    again = run("race branin --methods random --budget 20 --seeds 2 --force")
    assert "40 episodes to compute:" in again.stderr


def test_report_holds_the_papers_claims_against_the_race(run: Run) -> None:
    command = ["race", "cartpole", "--methods", "random,descents", "--budget", "8", "--seeds", "2"]
    done = run.ok(*command, "--claims")
    lines = [line for line in done.stdout.splitlines() if " better than " in line and "│" in line]
    by_claim = {line.split("│")[1].strip(): line.split("│")[2].strip() for line in lines}
    assert by_claim["descents better than random"] in ("holds", "does not hold", "not decided")
    assert by_claim["bo-leap better than cma-es"] == "not run"


def test_options_of_a_method_reach_it_and_make_another_race(run: Run) -> None:
    short = ["race", "branin", "--methods", "cma-es", "--budget", "9", "--seeds", "1", "--json"]
    plain = run.json(*short)
    other = run.json(*short, "--option", "cma-es.population=9")
    assert other["method_options"]["cma-es"]["population"] == 9
    assert plain["folder"] != other["folder"]


def test_all_methods_that_can_run_here_race_by_default_and_by_name(run: Run) -> None:
    small = ["race", "branin", "--budget", "3", "--seeds", "1", "--json"]
    named, default = (
        run.json(*small, *more, "--out", name)["methods"]
        for name, more in (("named", ["--methods", "all"]), ("default", []))
    )
    assert named == default
    assert {name for name, one in methods().items() if not one.extra and name != "auto"} <= set(named)
