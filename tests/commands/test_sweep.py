"""`landscape sweep`: what it leaves, continues from, and refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

import gradscape
from gradscape.landscapes.identity import plane_of, stored_identity
from gradscape.landscapes.smoothing import smooth
from gradscape.landscapes.storage.store import open_slice
from gradscape.landscapes.verification import POINTS

from ..command import Run

SWEEP = "sweep bounce --dims 0 1 --over 2 --frames 3 --resolution 5 --through example:aim --device cpu --out moved"
FILES = ["frames", "summary.json", "sweep.gif", "sweep.mp4", "sweep.rrd"]


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def test_through_several_points_there_is_a_sweep_for_each(run: Run, tmp_path: Path) -> None:
    words = "sweep bounce --dims 0 1 --over horizon --frames 2 --resolution 3 --through center,random:1 --device cpu"
    found = run.json(f"{words} --out moved")
    assert [one["folder"] for one in found["sweeps"]] == ["moved/center", "moved/random-1"]
    space = gradscape.make("bounce", device="cpu").space
    for folder, point in (("center", space.center), ("random-1", space.uniform(1, seed=1)[0])):
        assert names(tmp_path / "moved" / folder) == FILES
        frame = plane_of(open_slice(tmp_path / "moved" / folder / "frames/000.zarr"))
        torch.testing.assert_close(frame.origin[2], point[2])


def test_each_frame_is_the_slice_at_its_value(run: Run, tmp_path: Path) -> None:
    done = run.ok(f"{SWEEP} --json")
    assert names(tmp_path / "moved") == FILES
    summary = done.json
    assert summary == {**json.loads((tmp_path / "moved/summary.json").read_text()), "folder": "moved"}
    space, aim = gradscape.make("bounce", device="cpu").space, gradscape.make("bounce", device="cpu").example("aim")
    low, high = float(space.lower[2]), float(space.upper[2])
    assert [frame["value"] for frame in summary["frames"]] == [low, (low + high) / 2, high]
    for number, frame in enumerate(summary["frames"]):
        (tmp_path / "at.json").write_text(json.dumps([*aim.tolist()[:2], frame["value"]]))
        cut = "slice bounce --dims 0 1 --resolution 5 --through at.json --device cpu --out"
        run.ok(f"{cut} cut{number}")
        alone = open_slice(f"cut{number}/slice.zarr")
        moved = open_slice(f"moved/frames/{number:03d}.zarr")
        xr.testing.assert_identical(moved.drop_attrs(), alone.drop_attrs())
        assert moved.attrs["identity"] == alone.attrs["identity"]
        assert frame["loss"]["lowest"] == float(alone["loss"].min())
    assert summary["loss"]["highest"] == max(frame["loss"]["highest"] for frame in summary["frames"])
    assert summary["episodes"] == 75
    assert "75 episodes with gradients of 3 slices to compute: about" in done.stderr


def test_gradients_may_be_at_some_of_the_samples(run: Run) -> None:
    some = run.ok(f"{SWEEP} --gradients 2 --json")
    assert "75 episodes (gradients at every 2 samples along each axis) of 3 slices to compute" in some.stderr
    assert some.json["gradients_every"] == 2
    grad = open_slice("moved/frames/002.zarr")["grad"]
    assert int(grad[::2, ::2].notnull().all("dim").sum()) == int(grad.notnull().all("dim").sum()) == 9
    run.refuse(SWEEP, said="gradients")


def test_nothing_is_computed_twice(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run(SWEEP)
    first = [open_slice(f"moved/frames/{number:03d}.zarr") for number in range(3)]
    Path("moved/frames/001.zarr.zip").unlink()
    again = run(f"{SWEEP} --json")
    assert (again.json["episodes"], again.json["resumed"]) == (25, 50)
    assert "25 episodes with gradients of 3 slices to compute, 50 are done already" in again.stderr
    for number, before in enumerate(first):
        xr.testing.assert_equal(open_slice(f"moved/frames/{number:03d}.zarr"), before)
    kind = type(gradscape.make("bounce", device="cpu"))
    evaluate, rows = kind.evaluate, list[int]()
    monkeypatch.setattr(kind, "evaluate", lambda env, x, *, grad: rows.append(len(x)) or evaluate(env, x, grad=grad))
    third = run(SWEEP)
    assert "all 75 episodes with gradients of 3 slices are done already" in third.stderr
    assert third.returncode == 0
    assert rows == [POINTS] * 3  # those that are verified, of each slice


@pytest.mark.drawn
def test_smoothing_averages_one_slice(run: Run) -> None:
    found = run.json("sweep branin --dims 0 1 --over smoothing --frames 3 --resolution 9 --out soft")
    summary, dataset = found, open_slice("soft/slice.zarr")
    assert [frame["value"] for frame in summary["frames"]] == [0.0, 12.5, 25.0]
    assert summary["episodes"] == 81
    for frame in summary["frames"]:
        assert frame["loss"]["lowest"] == float(smooth(dataset, frame["value"] / 100)["loss"].min())
    assert names(Path("soft")) == ["slice.zarr.zip", *FILES[1:]]


def test_over_the_horizon_each_frame_is_a_shorter_episode(run: Run) -> None:
    sweep = (
        "sweep bounce --dims 0 1 --over horizon --frames 2 --resolution 4 --through example:aim --device cpu --out late"
    )
    found = run.json(f"{sweep}")
    assert [frame["value"] for frame in found["frames"]] == [50.0, 100.0]
    half, whole = (open_slice(f"late/frames/{number:03d}.zarr") for number in range(2))
    assert [stored_identity(one)["options"]["horizon"] for one in (half, whole)] == [0.5, 1.0]
    env = gradscape.make("bounce", device="cpu", horizon=0.5)
    points = plane_of(half).lift(torch.tensor([[float(half["u"][1]), float(half["v"][2])]]).double())
    assert float(half["loss"].sel(u=half["u"][1], v=half["v"][2])) == float(env.evaluate(points).loss[0])
    assert not np.allclose(half["loss"], whole["loss"])
    assert "all 32 episodes" in run(sweep).stderr
    for wrong, said in (("--set horizon=2", "changes this option itself"), ("", "branin has no horizon")):
        run.refuse(
            f"{sweep.replace('bounce', 'branin').replace('example:aim', 'center') if not wrong else sweep} {wrong}",
            said=said,
        )
