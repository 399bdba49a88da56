"""`gs.sweep`: as good a sweep as the command's."""

from collections.abc import Callable
from pathlib import Path

import pytest
import xarray as xr

import gradscape
from gradscape.api.sweep import sweep

from ..command import Said

SMALL = ["--frames", "2", "--resolution", "3", "--through", "example:aim", "--device", "cpu"]


def test_a_sweep_from_python_is_the_commands_and_goes_on_in_its_folder(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run("sweep", "bounce", "--dims", "0", "1", "--over", "2", *SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (folder,) = Path("out").iterdir()
    kind = type(gradscape.make("bounce", device="cpu"))
    monkeypatch.setattr(kind, "evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    found = sweep("bounce", (0, 1), 2, frames=2, resolution=3, through="example:aim", device="cpu")
    assert [path.name for path in Path("out").iterdir()] == [folder.name]
    assert (found.label, len(found.values)) == ("velocity z [m/s]", 2)
    for number, dataset in enumerate(found.slices):
        xr.testing.assert_identical(dataset, gradscape.open_slice(folder / f"frames/{number:03d}.zarr").data)


@pytest.mark.drawn
def test_a_frame_shows_in_a_notebook(run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = gradscape.make("bounce", device="cpu", horizon=1.0)
    found = sweep(env, ("velocity x", "velocity y"), "horizon", frames=2, resolution=3, gradients=False, out="late")
    assert found.values == (50.0, 100.0)
    picture = found.plot()
    assert picture._repr_png_().startswith(b"\x89PNG")
    assert picture._repr_png_() == found.plot(1)._repr_png_() != found.plot(0)._repr_png_()


def test_what_cannot_be_swept_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for dims, over, said in (((0, 1), 1, "which the slice varies"), ((0,), 2, "a sweep has two dims")):
        with pytest.raises(ValueError, match=said):
            sweep("bounce", dims, over, frames=2, resolution=3, device="cpu")
    assert not list(tmp_path.iterdir())
