"""The verb `plan`: episodes times what one takes, for any verb, and nothing is written."""

from pathlib import Path

import pytest

import gradscape as gs
from gradscape.jobs import plan as module
from gradscape.jobs.report import ReportedSlice, ReportJob
from gradscape.jobs.watch import Watch
from gradscape.landscapes.measures.census import judging_effort
from gradscape.landscapes.measures.undersampled import probes
from gradscape.landscapes.measures.verdict import RANGE_POINTS

from ..command import Run

JUDGED = judging_effort()  # losses, at most, and gradients, of a slice of a census
FLOOR = 4  # evaluations of a replica of bounce, at least
EACH = {False: 0.5, True: 2.0}  # seconds of a loss and of a gradient


@pytest.fixture(autouse=True)
def priced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give every episode a price, in place of a clock."""
    monkeypatch.setattr(module, "seconds_per_episode", lambda objective, x, *, grad, count: EACH[grad])


@pytest.mark.parametrize(
    ("words", "losses", "gradients"),
    [
        ("slice branin --resolution 8", probes(64, grad=True), 64),
        ("slice branin --resolution 8 --no-gradients", 64 + probes(64, grad=False), 0),
        ("slice branin --resolution 9 --gradients 4", 81 - 9 + probes(81, grad=False), 9),
        ("slice bounce --along random:1 --window 0.2 --resolution 5", probes(25, grad=True), 25 + FLOOR),
        ("slice bounce --dims 0 1 --resolution 5 --floor", probes(25, grad=True), 3 * 25 + FLOOR),
        ("bounce --axis y --resolution 16", probes(16, grad=True), 16 + FLOOR),
        ("sweep ackley --set dim=3 --dims 0 1 --over 2 --frames 3 --resolution 5", 0, 75),
        ("optimize branin --method random --budget 30", 30, 0),
        ("optimize branin --method descents --budget 30", 0, 30),
        ("race branin --methods random,descents --budget 20 --seeds 3", 60, 60),
        ("league branin beale --methods random --budget 20 --seeds 2", 80, 0),
        ("census ackley --slices 1 --resolution 6", 16 * 5 + RANGE_POINTS + JUDGED[0], 36 + JUDGED[1]),
        ("hessian branin", 18, 1 + 9 * 4 + 2 * 4 + 2 * 4),
        ("replay bounce --no-film", 2, 0),
    ],
)
def test_a_plan_counts_what_the_verb_evaluates(
    run: Run, tmp_path: Path, words: str, losses: int, gradients: int
) -> None:
    found = run.json("plan", *words.split(), "--device", "cpu")
    assert (found["episodes"], found["gradients"]) == (losses + gradients, gradients)
    compiling = sum(part["compiling"] for part in found["parts"])
    assert found["seconds"] - compiling == pytest.approx(losses * EACH[False] + gradients * EACH[True])
    assert found["device_hours"] == pytest.approx(found["seconds"] / 3600)
    assert found["memory"] > 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", ["check branin --power 20%", "pairs ackley --samples 2", "report ackley"])
def test_verbs_whose_episodes_depend_on_what_they_find_are_planned_too(run: Run, tmp_path: Path, words: str) -> None:
    found = run.json("plan", *words.split())
    assert found["episodes"] > 10
    assert list(tmp_path.iterdir()) == []


def test_what_samples_a_slice_first_is_planned_by_that_slice(run: Run, tmp_path: Path) -> None:
    run.ok("slice bounce --dims 0 1 --resolution 4 --out cut")
    search = ("optimize", "bounce", "--method", "random", "--budget", "3", "--out", "run")
    run.ok(*search)
    before = sorted(tmp_path.rglob("*"))
    for words, points in (
        ("compare cut bounce --fidelity standard", 16),
        ("overlay cut run --through best", 16),
        ("overlay cut run --through best --resolution 6", 36),
    ):
        found = run.json("plan", *words.split())
        assert found["gradients"] == points + FLOOR
    assert "simulates nothing" in run("plan overlay cut run").stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_a_plan_takes_as_many_episodes_as_the_slice(run: Run, tmp_path: Path) -> None:
    words = ("slice", "branin", "--resolution", "6", "--json")
    planned = run.json("plan", *words)
    made = run.json(*words)
    assert planned["gradients"] == made["episodes"]
    assert planned["episodes"] - planned["gradients"] >= made["undersampled"]["episodes"]
    assert (tmp_path / made["folder"] / "slice.zarr.zip").stat().st_size <= planned["disk"]


def test_a_plan_of_several_reports_counts_the_slices_that_have_none(tmp_path: Path) -> None:
    slices = [gs.slice("branin", (0, 1), resolution=points, out=tmp_path / str(points)).folder for points in (6, 8)]
    one, other = (gs.plan(gs.report, folder, points_per_axis=2) for folder in slices)
    subjects = [ReportedSlice.of(folder) for folder in slices if folder]
    job = ReportJob.open(subjects, what="all", single=False, out=tmp_path / "told", points=2)
    both = module.plan_work(list(job.work()), "", Watch())
    assert (both.gradients, both.episodes) == (one.gradients + other.gradients, one.episodes + other.episodes)
    job.report(subjects[0], Watch())
    left = module.plan_work(list(job.work()), "", Watch())
    assert (left.gradients, left.episodes) == (other.gradients, other.episodes)


def test_python_plans_a_function_of_its_own() -> None:
    bowl = gs.from_numpy(lambda x: (x**2).sum(-1), gs.ParameterSpace({"a": (0, 1), "b": (0, 1)}))
    found = gs.plan(gs.slice, bowl, resolution=4, gradients=False)
    assert found.episodes == 16 + probes(16, grad=False)
    assert found.command.startswith("gradscape.plan(")


def test_a_device_that_is_not_here_is_planned_by_what_was_measured_on_one(run: Run) -> None:
    pytest.importorskip("torch")
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    found = run.json("plan slice fluid --dims 6 8 --device cuda")
    (part,) = found["parts"]
    assert part["device"] == "cuda"
    assert "fluid-cuda" in part["rate"]
    assert part["gpu_memory"] > 0
    run.refuse("plan slice branin --device cuda", said="branin")
