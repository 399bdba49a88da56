"""What `landscape gallery compute` makes beside slices: films, episodes at nodes, searches."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape.cli import main
from gradscape.commands import gallery_report
from gradscape.envs.bounce import Bounce
from gradscape.gallery import episodes as gallery_episodes
from gradscape.gallery import measures as gallery_measures
from gradscape.gallery import parts as gallery_parts
from gradscape.gallery.episodes import Node, nodes_shown
from gradscape.gallery.figures import Figure
from gradscape.gallery.runs import open_run, save_run
from gradscape.landscapes.adapters import from_numpy
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.search import search

SPACE = ParameterSpace.box(["x", "y"], -1.0, 1.0)
FIGURES = [
    Figure("ball", "bounce", (0, 1), "It jumps.", through="example:aim", resolution=8, fidelity="draft"),
    Figure("ball-y", "bounce", (1,), "It jumps.", through="example:aim", resolution=8, fidelity="draft"),
    Figure("branin", "branin", (0, 1), "Three minima.", resolution=8, fidelity="exact", over=""),
]


def shown(function, dims=(0, 1), at=(0.0, 0.0), resolution=9) -> list[Node]:  # type: ignore[no-untyped-def]
    through = torch.tensor(at).double()
    plane = Plane.through(SPACE, through, dims, resolution=resolution)
    return nodes_shown(sample(from_numpy(function, SPACE), plane, grad=False), through)


def test_nodes_are_the_extremes_the_median_and_the_slices_own_point() -> None:
    def tilted(x: np.ndarray) -> np.ndarray:
        return np.where(x[:, 1] > 0.9, np.nan, x[:, 0] + 10 * x[:, 1])

    nodes = shown(tilted, at=(0.5, -0.5))
    found = {node.why: (node.row, node.column, node.loss) for node in nodes}
    assert found["lowest loss"] == (0, 0, -11.0)
    assert found["highest loss"] == (7, 8, 8.5)  # the row above failed
    assert found["through the slice's point"] == (2, 6, -4.5)
    values = sorted(u + 10 * v for u in np.linspace(-1, 1, 9) for v in np.linspace(-1, 0.75, 8))
    assert found["median loss"][2] == values[36]
    assert {node.status for node in nodes} == {"OK"}


def test_a_point_that_failed_is_shown_as_failed_and_no_node_twice() -> None:
    nodes = shown(lambda x: np.full(len(x), np.nan), resolution=5)
    assert [(node.row, node.column, node.loss, node.status) for node in nodes] == [(2, 2, None, "NONFINITE")]


def test_a_lines_nodes_are_in_row_0() -> None:
    nodes = shown(lambda x: x[:, 1], dims=(1,), at=(0.0, 0.6), resolution=5)
    assert {(node.row, node.column, node.why) for node in nodes} == {
        (0, 0, "lowest loss"), (0, 4, "highest loss"), (0, 2, "median loss"), (0, 3, "through the slice's point"),
    }  # fmt: skip


def test_a_run_is_one_file_and_comes_back(tmp_path: Path) -> None:
    table = search(from_numpy(lambda x: (x**2).sum(axis=1), SPACE), "random", budget=7).table()
    save_run(table, tmp_path / "random-0.zarr.zip")
    again = open_run(tmp_path / "random-0.zarr.zip")
    xr.testing.assert_equal(again, table)
    assert again.attrs == table.attrs
    assert [file.name for file in tmp_path.iterdir()] == ["random-0.zarr.zip"]


@pytest.fixture
def small(blank: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Let all there is to make be little, and steps of time long."""
    monkeypatch.setattr(gallery_report, "read_figures", lambda: list(FIGURES))
    for name, value in (("FRAMES", 2), ("COARSE", 4), ("DPI", 40), ("METHODS", ("random", "cma-es")), ("BUDGET", 9)):
        monkeypatch.setattr(gallery_parts, name, value)
    for name, value in (("HEIGHT", 60), ("LONGEST", 2)):
        monkeypatch.setattr(gallery_episodes, name, value)
    for name, value in (("REPORT_POINTS", 2), ("TRADEOFF_POINTS", 4), ("TURNED", ["precision"])):
        monkeypatch.setattr(gallery_measures, name, value)
    for name in ("REPETITION", "LARGEST"):
        monkeypatch.setattr(f"gradscape.landscapes.measures.fidelity.{name}", 0.01)
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
    kept = sorted(str(file.relative_to(small)) for file in small.glob("runs/*/*"))
    methods = ("cma-es", "random")
    assert kept == [f"runs/{env}/{method}-0.zarr.zip" for env in ("bounce", "branin") for method in methods]
    assert not list((small / "branin").glob("episode*"))
    for figure in ("ball", "ball-y", "branin"):
        report = json.loads((small / figure / "report.json").read_text())
        assert report["name"] == figure
        assert (small / figure / "gradient-quality.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(file.name for file in (small / "tradeoff").iterdir()) == ["bounce-cpu.json", "bounce-cpu.png"]
    rungs = {row["name"] for row in json.loads((small / "tradeoff/bounce-cpu.json").read_text())["rungs"]}
    assert rungs > {"draft", "standard", "reference", "draft-float64"}
    before = {file: file.stat().st_mtime_ns for file in small.rglob("*") if file.is_file()}
    capsys.readouterr()
    assert compute(small) == 0
    assert {file: file.stat().st_mtime_ns for file in small.rglob("*") if file.is_file()} == before
    said = capsys.readouterr().err
    assert all(f"{part}: 3 of 3 are there already" in said for part in gallery_report.PARTS)


def test_films_of_other_nodes_go_when_the_slice_changes(small: Path) -> None:
    assert compute(small, "--only", "ball", "--part", "slices", "--part", "episodes") == 0
    listed = json.loads((small / "ball/episodes.json").read_text())
    (small / "ball/episodes.json").write_text(json.dumps([{**listed[0], "row": 5, "column": 5}, *listed[1:]]))
    stale = small / "ball/episode-5-5.mp4"
    stale.write_bytes(b"")
    assert compute(small, "--only", "ball", "--part", "episodes") == 0
    assert json.loads((small / "ball/episodes.json").read_text()) == listed
    assert not stale.exists()


def test_an_unknown_part_is_refused(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compute(small, "--part", "films") == 2
    assert "--part takes slices, sweeps, episodes, searches, reports, tradeoffs; got films" in " ".join(
        capsys.readouterr().err.split()
    )
