"""The gallery's league: what is kept of its races, in how little room, and how it continues."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gradscape.cli import main
from gradscape.envs.adapters import from_numpy
from gradscape.envs.registry import make
from gradscape.gallery import league as gallery_league
from gradscape.gallery.compute import PARTS
from gradscape.gallery.figures import Figure
from gradscape.gallery.files import LeagueFiles
from gradscape.gallery.league import PLACES, KeptRun, KeptRuns, LeaguePart, read_league, read_standings
from gradscape.jobs import scene
from gradscape.jobs.race import RaceJob
from gradscape.jobs.scene import point_of
from gradscape.jobs.watch import Watch
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.identity import DamagedError, plane_of, stored_identity
from gradscape.landscapes.overlay import IMPROVEMENTS_OF, best_point, lowered
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.store import open_slice
from gradscape.optim.race import Race
from gradscape.optim.runs.run import Run
from gradscape.optim.search import search
from gradscape.optim.statistics import best_so_far

FIGURES = [
    Figure("branin", "branin", (0, 1), resolution=8, fidelity="exact", over=""),
    Figure("again", "branin", (0, 1), resolution=9, fidelity="exact", over=""),
    Figure("beale", "beale", (0, 1), resolution=8, fidelity="exact", over=""),
]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    for place in ("figures", "league"):
        monkeypatch.setattr(f"gradscape.gallery.{place}.read_figures", lambda: list(FIGURES))
    for name, value in (("METHODS", ("random", "descents")), ("BUDGET", 12), ("SEEDS", 3)):
        monkeypatch.setattr(gallery_league, name, value)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"


def compute(data: Path, *arguments: str) -> int:
    with pytest.raises(SystemExit) as left:
        main(["gallery", "compute", "--part", "league", "--device", "cpu", "--data", str(data), *arguments])
    return int(left.value.code or 0)


@pytest.fixture(scope="module")
def race(tmp_path_factory: pytest.TempPathFactory) -> Race:
    env = make("branin", device="cpu")
    out = tmp_path_factory.mktemp("race")
    return RaceJob.of(env, ("random", "cma-es"), budget=20, seeds=3, command="landscape race", out=out).run()


def test_a_scene_is_raced_once_for_all_its_figures_and_kept(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compute(small, "--only", "branin") == 0
    said = capsys.readouterr().err
    assert "league: 0 of 2 are done already" in said
    assert said.count("2 methods, 3 seeds: after 12 episodes ") == 1
    assert {path.name for path in (small / "league").iterdir()} == {
        "branin.json", "branin.npz", "branin.png", "branin-dark.png"
    }  # fmt: skip
    assert compute(small) == 0  # and continues with the scene that is left
    assert "league: 2 of 3 are done already" in capsys.readouterr().err
    league = read_league(small)
    assert league is not None
    assert [scene.env for scene in league.scenes] == ["beale", "branin"]
    before = {file: file.stat().st_mtime_ns for file in small.rglob("*") if file.is_file()}
    assert compute(small) == 0
    assert "league: 3 of 3 are done already" in capsys.readouterr().err
    assert {file: file.stat().st_mtime_ns for file in small.rglob("*") if file.is_file()} == before


def test_its_races_are_those_of_the_verb_and_neither_repeats_the_other(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(
            [
                "league",
                "branin",
                "--methods",
                "random,descents",
                "--budget",
                "12",
                "--seeds",
                "3",
                "--device",
                "cpu",
                "--json",
            ]
        )
    theirs = json.loads(capsys.readouterr().out)["scenes"][0]
    assert compute(small, "--only", "branin") == 0
    assert "all 72 episodes are done already" in capsys.readouterr().err
    ours = to_json(read_standings(small / "league/branin.json"))
    assert {**ours, "command": ""} == {**theirs, "command": ""}
    assert ours["command"].startswith("landscape league branin@exact --methods random,descents --budget 12 --seeds 3")


def test_more_seeds_or_a_damaged_file_make_it_anew(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = LeaguePart(FIGURES[0], small, "cpu")
    assert part.count_left() == 1
    part.make(Watch())
    assert part.count_left() == 0
    monkeypatch.setattr(gallery_league, "SEEDS", 4)
    assert part.count_left() == 1
    monkeypatch.setattr(gallery_league, "SEEDS", 2)
    assert part.count_left() == 0
    (small / "league/branin.npz").write_bytes(b"torn")
    assert part.count_left() == 1


def test_what_is_kept_of_a_run_is_each_improvement_and_its_best_point(race: Race) -> None:
    for run in (run for runs in race.runs.values() for run in runs):
        kept, losses = KeptRun.of(run, race.budget), run.data["loss"].to_numpy()
        least = np.minimum.accumulate(losses)
        assert kept.loss[-1] == losses.min() == run.best.loss
        np.testing.assert_array_equal(kept.best, run.best.x)
        assert (np.diff(kept.loss) < 0).all()
        rebuilt = kept.loss[np.searchsorted(kept.episode, np.arange(1, race.budget + 1), side="right") - 1]
        np.testing.assert_array_equal(rebuilt, least)
        assert kept.spent == run.data["forwards"][-1]


def test_kept_runs_come_back_and_the_median_run_has_the_points_of_its_improvements(race: Race, tmp_path: Path) -> None:
    kept = KeptRuns.of(race)
    kept.write(tmp_path / "branin.npz")
    again = KeptRuns.read(tmp_path / "branin.npz")
    for one, two in zip(kept.runs, again.runs, strict=True):
        assert (one.method, one.seed, one.episodes, one.spent) == (two.method, two.seed, two.episodes, two.spent)
        for name in ("episode", "forwards", "loss", "best"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    for method, table in again.medians.items():
        finals = sorted((run.best.loss, run.seed) for run in race.runs[method])
        assert table.attrs["seed"] == finals[1][1]
        whole = race.runs[method][table.attrs["seed"]].data
        rows = lowered(best_so_far(whole["loss"].to_numpy()))
        truth = whole.isel(evaluation=rows)
        np.testing.assert_array_equal(table["episodes"], rows + 1)
        assert table.attrs[IMPROVEMENTS_OF] == whole.sizes["evaluation"] > len(rows)
        width = np.array(truth.attrs["upper"]) - np.array(truth.attrs["lower"])
        assert (np.abs(table["x"] - truth["x"]) <= width / PLACES / 1.99).all()
        np.testing.assert_allclose(table["loss"], truth["loss"], rtol=1e-7)
        assert table.identical(kept.medians[method])
        assert best_point([table])[1] == pytest.approx(finals[1][0], rel=1e-7)


def test_a_run_without_success_has_no_improvement(race: Race, tmp_path: Path) -> None:
    run = race.runs["random"][0]
    failed = KeptRun.of(type(run)(run.data.assign(loss=run.data["loss"] * np.nan)), race.budget)
    assert (len(failed.loss), failed.episodes) == (0, 20)
    assert np.isnan(failed.best).all()
    KeptRuns([failed], {"random": KeptRuns.of(race).packed["random"]}).write(tmp_path / "one.npz")
    assert len(KeptRuns.read(tmp_path / "one.npz").runs[0].loss) == 0


def test_a_league_of_sixteen_scenes_is_light_enough(tmp_path: Path) -> None:
    """A race of the paper's size in a tenth of the 690 parameters of all scenes, at points that do not compress."""
    space = ParameterSpace.box([f"x{number}" for number in range(69)], -1.0, 1.0)
    objective = from_numpy(lambda x: (x**2).sum(axis=1), space)
    run = search(objective, "random", budget=1000).read()
    methods = [f"method-{number}" for number in range(9)]
    named = {name: [Run(run.data.assign_attrs(method=name)) for _ in range(10)] for name in methods}
    KeptRuns.of(Race(named, 1000)).write(tmp_path / "scene.npz")
    assert 10 * (tmp_path / "scene.npz").stat().st_size < 20e6


def test_the_best_point_of_the_gallery_is_known_to_slices(
    small: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    env = make("branin", device="cpu")
    with pytest.raises(ValueError, match="there is no run of branin with these options"):
        point_of(env, "best")
    LeaguePart(FIGURES[0], small, "cpu").make(Watch())
    found = read_standings(small / "league/branin.json").best
    assert found is not None
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")  # where no race is known
    monkeypatch.setattr(scene, "league_file", lambda name: small / "league" / f"{name}.json")
    best = point_of(env, "best")
    assert best.tolist() == list(found.x)
    assert float(env.evaluate(best[None], grad=False).loss) == found.loss  # the episode, again
    assert scene.best_of_league(make("ackley", device="cpu")) is None
    torn = small / "league/branin.json"
    torn.write_text(torn.read_text().replace('"budget": 12', '"budget": 13'))
    with pytest.raises(DamagedError, match="is damaged"):
        point_of(env, "best")


def test_a_better_run_is_preferred_to_the_gallery_s(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make("branin", device="cpu")
    LeaguePart(FIGURES[0], small, "cpu").make(Watch())
    own = point_of(env, "best")
    for loss, expected in ((1e9, own), (-1e9, torch.zeros(2, dtype=torch.float64))):
        monkeypatch.setattr(scene, "best_of_league", lambda env, loss=loss: (torch.zeros(2, dtype=torch.float64), loss))
        assert torch.equal(point_of(env, "best"), expected)


@pytest.mark.slow
def test_median_runs_are_laid_over_the_slice_through_the_best_point(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def slices(*only: str) -> str:
        asked = ["gallery", "compute", "--part", "league-slices", "--device", "cpu", "--data", str(small), *only]
        with pytest.raises(SystemExit) as left:
            main(asked)
        assert not left.value.code
        return capsys.readouterr().err

    assert "league-slices: 3 of 3 are done already" in slices()  # no league, no slice
    assert compute(small, "--only", "branin") == 0
    capsys.readouterr()
    assert "league-slices: 1 of 3 are done already" in slices()
    standings, files = read_standings(small / "league/branin.json"), LeagueFiles.of(small, "branin").slice
    assert {path.name for path in files.record.parent.iterdir()} == {
        "slice.zarr.zip", "medians.json", "medians.png", "medians-dark.png"
    }  # fmt: skip
    dataset = open_slice(files.record.parent / "slice.zarr")
    assert standings.best is not None
    plane, best = plane_of(dataset), torch.tensor(standings.best.x, dtype=torch.float64)
    assert float(plane.distance(best[None])) < 1e-9
    assert stored_identity(dataset)["fidelity"] == standings.fidelity
    assert "3 of 3 are done already" in slices()
    for run in KeptRuns.read(small / "league/branin.npz").medians.values():
        assert (np.diff(run["loss"]) < 0).all()
        assert run["episodes"][0] == 1
    (small / "league/branin.json").unlink()  # another league has another best point
    assert compute(small, "--only", "branin") == 0
    record = json.loads(files.record.read_text())
    record["key"]["best"][0] += 1
    files.record.write_text(json.dumps(record))
    capsys.readouterr()
    assert "league-slices: 1 of 3 are done already" in slices()


def test_the_league_is_a_part_that_figures_share() -> None:
    parts = [PARTS["league"](figure, Path("data"), "cpu") for figure in FIGURES]
    assert [part.shared for part in parts] == ["branin", "branin", "beale"]
