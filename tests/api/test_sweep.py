"""`gs.sweep`: as good a sweep as the command's."""

from pathlib import Path

import pytest
import torch

import gradscape
from gradscape.api.sweep import sweep
from gradscape.landscapes.directions import random_directions
from gradscape.landscapes.identity import plane_of
from gradscape.landscapes.objective import Status

from ..command import Run

SMALL = ["--frames", "2", "--resolution", "3", "--through", "example:aim", "--device", "cpu"]


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


@pytest.mark.drawn
def test_a_frame_shows_in_a_notebook(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = gradscape.make("bounce", device="cpu", horizon=1.0)
    found = sweep(env, ("velocity x", "velocity y"), "horizon", frames=2, resolution=3, gradients=False, out="late")
    assert found.values == (50.0, 100.0)
    picture = found.plot()
    assert picture._repr_png_().startswith(b"\x89PNG")
    assert picture._repr_png_() == found.plot(1)._repr_png_() != found.plot(0)._repr_png_()
