"""`gs.sweep`: as good a sweep as the command's."""

from pathlib import Path

import pytest
import torch
import xarray as xr

import gradscape
from gradscape.api.sweep import sweep
from gradscape.landscapes.directions import random_directions
from gradscape.landscapes.identity import plane_of, stored_provenance
from gradscape.landscapes.objective import Status
from gradscape.landscapes.verification import POINTS

from ..command import Run

SMALL = ["--frames", "2", "--resolution", "3", "--through", "example:aim", "--device", "cpu"]


def test_a_sweep_from_python_is_the_commands_and_goes_on_in_its_folder(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.ok("sweep", "bounce", "--dims", "0", "1", "--over", "2", *SMALL)
    (folder,) = Path("out").iterdir()
    kind = type(gradscape.make("bounce", device="cpu"))
    evaluate, rows = kind.evaluate, list[int]()
    monkeypatch.setattr(kind, "evaluate", lambda env, x, *, grad: rows.append(len(x)) or evaluate(env, x, grad=grad))
    found = sweep("bounce", (0, 1), 2, frames=2, resolution=3, through="example:aim", device="cpu")
    assert [path.name for path in Path("out").iterdir()] == [folder.name]
    assert (found.label, len(found.values)) == ("velocity z [m/s]", 2)
    assert rows == [POINTS] * 2  # those that are verified, of each slice
    for number, dataset in enumerate(found.slices):
        xr.testing.assert_identical(dataset, gradscape.open_slice(folder / f"frames/{number:03d}.zarr").data)


def test_a_sweep_along_directions_is_the_slices_at_its_points(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is off the box is left out, and the command and the call make one folder of the same samples."""
    monkeypatch.chdir(tmp_path)
    how = ["--along", "random:1", "--over", "2", *SMALL]
    run.ok("sweep", "bounce", *how)
    env = gradscape.make("bounce", device="cpu")
    found = sweep("bounce", over=2, along="random:1", frames=2, resolution=3, through="example:aim", device="cpu")
    assert len(list(Path("out").iterdir())) == 1
    directions, _ = random_directions(env.space, 1)
    for bound, dataset in zip((env.space.lower[2], env.space.upper[2]), found.slices, strict=True):
        plane = plane_of(dataset)
        assert torch.allclose(plane.basis, torch.tensor(directions) * (env.space.upper - env.space.lower))
        point = env.example("aim")
        point[2] = bound
        assert torch.equal(plane.origin, point)
        points = plane.lift(torch.cartesian_prod(*plane.axes())).reshape(3, 3, 3)
        inside = ((points >= env.space.lower) & (points <= env.space.upper)).all(dim=-1)
        assert 0 < int(inside.sum()) < 9
        assert ((dataset["status"].transpose("u", "v").to_numpy() == Status.OK) == inside.numpy()).all()


def test_a_sweep_says_how_it_is_made_again(tmp_path: Path) -> None:
    how = {"through": "random:1", "window": 0.5, "gradients": False, "frames": 2, "resolution": 3}
    found = sweep("bounce", (0, 1), 2, out=tmp_path / "far", device="cpu", **how)
    command = stored_provenance(found.slices[0])["command"]
    again = eval(command.replace(str(tmp_path / "far"), str(tmp_path / "again")))
    for one, other in zip(found.slices, again.slices, strict=True):
        xr.testing.assert_equal(one, other)
    assert "grad" not in again.slices[0]


@pytest.mark.drawn
def test_a_frame_shows_in_a_notebook(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = gradscape.make("bounce", device="cpu", horizon=1.0)
    found = sweep(env, ("velocity x", "velocity y"), "horizon", frames=2, resolution=3, gradients=False, out="late")
    assert found.values == (50.0, 100.0)
    picture = found.plot()
    assert picture._repr_png_().startswith(b"\x89PNG")
    assert picture._repr_png_() == found.plot(1)._repr_png_() != found.plot(0)._repr_png_()
