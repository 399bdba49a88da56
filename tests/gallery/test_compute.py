"""What `landscape gallery compute` makes beside slices: films, episodes at nodes, searches."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from gradscape.cli import main
from gradscape.envs.bounce import Bounce
from gradscape.gallery import league as gallery_league
from gradscape.gallery import parts as gallery_parts
from gradscape.gallery.compute import IF_NAMED, PARTS
from gradscape.gallery.figures import Figure
from gradscape.gallery.paper import PaperCaption
from gradscape.gallery.records import open_run, save_run

pytestmark = pytest.mark.e2e

FIGURES = [
    Figure("ball", "bounce", (0, 1), PaperCaption("It jumps."), through="example:aim", resolution=8, fidelity="draft"),
    Figure("ball-y", "bounce", (1,), PaperCaption("It jumps."), through="example:aim", resolution=8, fidelity="draft"),
    Figure("branin", "branin", (0, 1), PaperCaption("Three minima."), resolution=8, fidelity="exact", over=""),
]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Let all there is to make be little, and steps of time long."""
    monkeypatch.setattr("gradscape.gallery.figures.read_figures", lambda: list(FIGURES))
    for module, values in (
        (gallery_parts, {"SWEEP_FRAMES": 2, "SWEEP_RESOLUTION": 5, "SWEEP_DPI": 40, "COMPANION_RESOLUTION": 4}),
        (gallery_parts, {"EPISODE_HEIGHT": 60, "EPISODE_FRAMES": 2, "METHODS": ("random", "cma-es"), "BUDGET": 9}),
        (gallery_parts, {"REPORT_POINTS": 2, "STUDY_POINTS": 4, "CHANGED": ["precision"]}),
        (gallery_league, {"METHODS": ("random", "descents"), "BUDGET": 12, "SEEDS": 3}),
    ):
        for name, value in values.items():
            monkeypatch.setattr(module, name, value)
    for name in ("REPETITION", "LARGEST"):
        monkeypatch.setattr(f"gradscape.studies.samples.{name}", 0.01)
    longer = {name: replace(one, dt=4 * one.dt) for name, one in Bounce.fidelities.items()}
    monkeypatch.setattr(Bounce, "fidelities", longer)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"


def compute(data: Path, *arguments: str) -> int:
    with pytest.raises(SystemExit) as left:
        main(["gallery", "compute", "--device", "cpu", "--data", str(data), *arguments])
    return int(left.value.code or 0)


def test_everything_is_made_once(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compute(small) == 0
    for figure in ("ball", "ball-y"):
        episodes = json.loads((small / figure / "episodes.json").read_text())
        assert 3 <= len(episodes) <= 4
        for episode in episodes:
            name = small / figure / f"episode-{episode['row']}-{episode['column']}"
            assert name.with_suffix(".mp4").stat().st_size > 0
            assert name.with_suffix(".webp").stat().st_size > 0
    sweep = json.loads((small / "ball/sweep.json").read_text())
    assert sweep["label"] == "share of the scene's duration [%]"
    assert (sweep["low"], sweep["high"], sweep["frames"]) == (50.0, 100.0, 2)
    assert sweep["command"].startswith("landscape sweep bounce --dims 0 1 --over horizon")
    assert not (small / "ball-y/sweep.mp4").exists()
    for figure in ("ball", "ball-y"):
        (beside,) = json.loads((small / figure / "companions.json").read_text())["slices"]
        assert (beside["through"], beside["failed"]) == ("center", 0.0)
        assert 0 < beside["lowest"] < beside["highest"]
        assert (small / figure / "companions.png").read_bytes().startswith(b"\x89PNG")
    assert not (small / "branin/companions.json").exists()  # its slice is the same through any point
    kept = sorted(str(file.relative_to(small)) for file in small.glob("runs/*/*"))
    methods = ("cma-es", "random")
    assert kept == [f"runs/{env}/{method}-0.zarr.zip" for env in ("bounce", "branin") for method in methods]
    assert not list((small / "branin").glob("episode*"))
    for figure in ("ball", "ball-y", "branin"):
        report = json.loads((small / figure / "report.json").read_text())
        assert report["name"] == figure
        assert (small / figure / "gradient-quality.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(file.name for file in (small / "studies").iterdir()) == [
        "bounce-cpu.fidelity.json",
        "bounce-cpu.fidelity.png",
    ]
    names = {row["name"] for row in json.loads((small / "studies/bounce-cpu.fidelity.json").read_text())["variants"]}
    assert names > {"draft", "standard", "reference", "draft-float64"}
    before = {file: file.stat().st_mtime_ns for file in small.rglob("*") if file.is_file()}
    capsys.readouterr()
    assert compute(small) == 0
    assert {file: file.stat().st_mtime_ns for file in small.rglob("*") if file.is_file()} == before
    said = capsys.readouterr().err
    assert all(f"{part}: 3 of 3 are done already" in said for part in PARTS if part not in IF_NAMED)
    assert not any(f"{part}:" in said for part in IF_NAMED)
    assert not (small / "league").exists()


def test_a_run_at_another_fidelity_or_over_other_parameters_is_none(small: Path) -> None:
    part = gallery_parts.SearchPart(FIGURES[0], small, "cpu")
    assert compute(small, "--only", "ball", "--part", "slices", "--part", "searches") == 0
    assert part.there()
    assert replace(part, figure=replace(part.figure, fidelity="standard")).count_left() == 2
    file = small / "runs/bounce/random-0.zarr.zip"
    run = open_run(file)
    identity = json.loads(run.attrs["identity"])
    renamed = [[f"{name} then", unit] for name, unit in zip(run["dim"].values, run["unit"].values, strict=True)]
    assert identity["parameters"]
    save_run(run.assign_attrs(identity=json.dumps({**identity, "parameters": renamed})), file)
    assert part.count_left() == 1


def test_films_of_other_nodes_go_when_the_slice_changes(small: Path) -> None:
    assert compute(small, "--only", "ball", "--part", "slices", "--part", "episodes") == 0
    listed = json.loads((small / "ball/episodes.json").read_text())
    (small / "ball/episodes.json").write_text(json.dumps([{**listed[0], "row": 5, "column": 5}, *listed[1:]]))
    stale = small / "ball/episode-5-5.mp4"
    stale.write_bytes(b"")
    assert compute(small, "--only", "ball", "--part", "episodes") == 0
    assert json.loads((small / "ball/episodes.json").read_text()) == listed
    assert not stale.exists()


def test_the_help_names_every_part(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["gallery", "compute", "--help"])
    said = capsys.readouterr().out.replace("-\n", "-")
    said = re.sub(r"-\s+", "-", said)
    assert [part for part in PARTS if part not in said] == []


def test_an_unknown_part_is_refused(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compute(small, "--part", "films") == 2
    assert f"--part takes {', '.join(PARTS)}; got films" in " ".join(capsys.readouterr().err.split())


def test_a_figure_through_another_point_is_not_there(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = gallery_parts.SlicePart(FIGURES[0], small, "cpu")
    assert compute(small, "--only", "ball", "--part", "slices") == 0
    assert part.there()
    moved = replace(part, figure=replace(part.figure, through="random:3"))
    assert str(moved.state()) == "other settings"
    assert not replace(part, figure=replace(part.figure, through="center")).there()
