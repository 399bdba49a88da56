"""`landscape overlay`: what it leaves, cuts again, and refuses."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape
from gradscape.jobs.scene import named_point
from gradscape.landscapes.identity import plane_of
from gradscape.landscapes.overlay import best_point, overlay
from gradscape.landscapes.storage.store import open_slice
from gradscape.optim.runs.store import RunStore

from ..command import Run, make


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a slice of bounce off the runs' best point, and two runs of it."""
    return make(
        tmp_path_factory.mktemp("results"),
        "slice bounce --dims 0 1 --resolution 6 --out cut --device cpu",
        "optimize bounce --method cma-es --budget 24 --out race/cma-es-0 --device cpu",
        "optimize bounce --method descents --budget 16 --out race/descents-0 --device cpu",
    )


@pytest.fixture(autouse=True)
def desk(results: Path, tmp_path: Path) -> None:
    """Work in a folder with the results."""
    shutil.copytree(results, tmp_path, dirs_exist_ok=True)


@pytest.mark.drawn
def test_a_race_is_laid_over_a_slice(run: Run, tmp_path: Path) -> None:
    done = run.ok("overlay cut race --out over")
    assert sorted(file.name for file in Path("over").iterdir()) == ["overlay.png", "overlay.rrd"]
    assert (tmp_path / "over/overlay.png").read_bytes().startswith(b"\x89PNG")
    tables = [RunStore.open(path / "run.zarr").dataset() for path in sorted(Path("race").iterdir())]
    away = max(float(laid["distance"].max()) for laid in overlay(open_slice("cut/slice.zarr"), tables))
    assert f"2 runs, 40 points: 0 outside the map, 0 failed; the farthest point is {away:.2g} half" in done.stderr
    run.ok("overlay cut race")
    assert len(list(Path("out").glob("overlay-bounce-*"))) == 1


def test_a_slice_cut_through_the_best_point_shows_its_loss(run: Run) -> None:
    run.ok("overlay cut race/cma-es-0 race/descents-0/run.zarr --through best --out over --device cpu")
    (folder,) = (path for path in Path("over").iterdir() if path.is_dir())
    dataset = open_slice(folder / "slice.zarr")
    tables = [RunStore.open(path / "run.zarr").dataset() for path in sorted(Path("race").iterdir())]
    x, loss = best_point(tables)
    plane, before = plane_of(dataset), plane_of(open_slice("cut/slice.zarr"))
    assert float(plane.distance(x)) < 1e-12
    torch.testing.assert_close(plane.basis, before.basis, rtol=0, atol=0)
    assert (plane.resolution, plane.labels) == (before.resolution, before.labels)
    env = gradscape.make("bounce", fidelity="draft", device="cpu")
    there = env.evaluate(plane.lift(plane.project(x))[None], grad=False)
    np.testing.assert_allclose(there.loss, loss, rtol=1e-5)
    again = run("overlay cut race --through best --out over --device cpu")
    assert "all 36 episodes with gradients are done already" in again.stderr


@pytest.mark.parametrize("point", ["random:2", "best:race/descents-0", "race/descents-0"])
def test_a_slice_is_cut_anew_through_any_point_that_has_a_name(run: Run, point: str) -> None:
    run.ok(f"overlay cut race --through {point} --resolution 3 --out over --device cpu")
    (folder,) = (path for path in Path("over").iterdir() if path.is_dir())
    env = gradscape.make("bounce", device="cpu")
    x = named_point(env, f"best:{point}" if point == "race/descents-0" else point)
    assert float(plane_of(open_slice(folder / "slice.zarr")).distance(x)) < 1e-12


def test_a_principal_plane_lies_nearer_to_the_run_than_the_slice_did(run: Run) -> None:
    run.ok("overlay cut race/cma-es-0 --plane pca --resolution 4 --out over --device cpu")
    (folder,) = (path for path in Path("over").iterdir() if path.is_dir())
    table = RunStore.open("race/cma-es-0/run.zarr").dataset()
    slices = (open_slice(path) for path in (folder / "slice.zarr", "cut/slice.zarr"))
    principal, before = (overlay(dataset, [table])[0] for dataset in slices)
    assert float((principal["distance"] ** 2).sum()) < float((before["distance"] ** 2).sum())
    assert not principal["outside"].any()


def test_samples_beyond_the_box_are_left_out_of_a_principal_plane(run: Run) -> None:
    run.ok("overlay cut race --plane pca --resolution 7 --out over --device cpu")
    (folder,) = (path for path in Path("over").iterdir() if path.is_dir())
    dataset = open_slice(folder / "slice.zarr")
    u, v = np.meshgrid(dataset["u"], dataset["v"])
    space = gradscape.make("bounce", device="cpu").space
    unit = space.to_unit(plane_of(dataset).lift(torch.from_numpy(np.stack([u, v], axis=-1))))
    beyond = ((unit < -1e-9) | (unit > 1 + 1e-9)).any(dim=-1).numpy()
    assert beyond.any()
    np.testing.assert_array_equal(dataset["status"] == gradscape.Status.ESCAPED, beyond)


def test_another_fidelity_is_drawn_with_a_warning(run: Run) -> None:
    run("optimize bounce --method random --budget 4 --fidelity standard --out fine --device cpu")
    done = run.ok("overlay cut fine --out over")
    differently = (
        "(bounce, random, seed 0) are simulated differently (fidelity 'draft' of the slice, 'standard' of the run)"
    )
    assert differently in done.stderr
