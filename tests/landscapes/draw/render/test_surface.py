"""Surfaces: high where the loss is, holes where it failed, labels and runs in their places."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from matplotlib.colors import to_rgb

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.render import relief, solids, surface
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace

pytestmark = pytest.mark.slow

SPACE = ParameterSpace.box(["a", "b"], -1.0, 1.0, "m")
PEAK = (0.5, -0.5)


def hill(x: torch.Tensor) -> torch.Tensor:
    """Return a hill, not finite where a and b are both above a half."""
    loss = 0.1 + torch.exp(-8 * (x - x.new_tensor(PEAK)).square().sum(dim=1))
    return torch.where((x > 0.5).all(dim=1), torch.nan, loss)


DATASET = sample(from_torch(hill, SPACE), Plane.through(SPACE, SPACE.center, ("a", "b"), resolution=24))


def drawn() -> tuple[np.ndarray, surface.Shown]:
    with surface.scene(DATASET, []) as shown:
        return shown.plotter.screenshot(return_img=True), shown


PICTURE, SHOWN = drawn()
RELIEF = SHOWN.relief


def spot(u: float, v: float, loss: float) -> tuple[int, int]:
    """Return the pixel (row, column) of a place of the surface."""
    place = RELIEF.at(np.array([u]), np.array([v]), np.array([loss]))
    ((x, y),) = SHOWN.on_picture(place)
    return round(y), round(x)


def saturated() -> np.ndarray:
    return np.ptp(PICTURE.astype(int), axis=2) > 40


def test_the_surface_is_highest_and_yellow_where_the_loss_is() -> None:
    row, column = spot(*PEAK, 1.1)
    bright = (PICTURE[..., 0].astype(int) > 140) & (PICTURE[..., 2].astype(int) < 90)  # viridis' upper end
    rows, columns = np.nonzero(bright)
    assert abs(rows.min() - row) < 30
    assert abs(columns[rows.argmin()] - column) < 30
    low = PICTURE[spot(-0.5, 0.0, 0.1)].astype(int)
    assert low[2] > low[1]  # viridis' lower end is violet


def test_failed_samples_are_a_hole() -> None:
    inside = [spot(u, v, 0.0) for u in (0.7, 0.8, 0.9) for v in (0.7, 0.8, 0.9)]
    assert all(PICTURE[place].min() > 240 for place in inside)  # white
    assert saturated()[spot(-0.8, 0.8, 0.0)]


def test_ticks_are_where_parameters_are() -> None:
    figure = surface.surface_figure(DATASET)
    ax = figure.axes[0]
    texts = {text.get_text(): np.array(text.get_position()) for text in ax.texts}
    assert {"a [m]", "b [m]", "loss", "0.5"} <= set(texts)
    high = float(RELIEF.shade(np.array(0.8)))
    wanted = SHOWN.on_picture(np.array([RELIEF.beside(2, high, surface.AWAY[2])]))
    np.testing.assert_allclose(texts["0.8"], wanted[0], atol=1e-6)
    assert any(
        "holes: 36 of 576 samples" in text.get_text() for legend in figure.legends for text in legend.get_texts()
    )


def test_every_sample_is_flat_and_in_one_colour_with_nothing_between_samples() -> None:
    made, loss = relief.cells(RELIEF, DATASET), DATASET["loss"].to_numpy()
    tops = made.normals[:, 2] == 1
    whole = np.isfinite(loss)
    assert tops.sum() == whole.sum()
    np.testing.assert_array_equal(np.sort(made.sample[tops]), np.flatnonzero(whole))
    wanted = RELIEF.height(loss).ravel()[made.sample[tops]]
    np.testing.assert_allclose(made.corners[tops, :, 2], np.repeat(wanted[:, None], 4, axis=1))
    wide = relief.SIDE / 24
    np.testing.assert_allclose(np.ptp(made.corners[tops], axis=1)[:, :2], wide)  # as wide as its cell of the map
    ground = np.pad(np.nan_to_num(RELIEF.height(loss)), 1)  # walls are as high as neighbours differ, and no higher
    steps = sum(np.abs(np.diff(ground, axis=axis)).sum() for axis in (0, 1))
    assert np.ptp(made.corners[~tops, :, 2], axis=1).sum() == pytest.approx(steps)
    edges = made.corners[:, [1, 3]] - made.corners[:, :1]
    outwards = np.cross(edges[:, 0], edges[:, 1])
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    np.testing.assert_allclose(outwards, made.normals, atol=1e-9)


def behind_a_plateau(angle: float) -> tuple[relief.Relief, xr.Dataset]:
    """Return a slice whose one half, towards an angle [degrees], is high: from there the other half is hidden."""
    u, v = np.meshgrid(DATASET["u"], DATASET["v"])
    towards = u * np.cos(np.radians(angle)) + v * np.sin(np.radians(angle))
    dataset = DATASET.assign(loss=(("v", "u"), np.where(towards > 0, 1.0, 0.0)))
    return relief.Relief(RELIEF.plane, style.Scale.between(0.0, 1.0)), dataset


@pytest.mark.parametrize("angle", [0.0, 90.0, 180.0, 270.0])
def test_the_valley_is_seen_over_no_plateau(angle: float) -> None:
    eye = np.radians(relief.azimuth(*behind_a_plateau(angle)))
    assert np.cos(eye - np.radians(angle)) < 0


def test_where_all_is_seen_from_everywhere_or_nothing_is_there_the_eye_stays() -> None:
    flat = DATASET.assign(loss=DATASET["loss"] * 0.0)
    assert relief.azimuth(RELIEF, flat) == relief.azimuth(RELIEF, flat * np.nan) == relief.AZIMUTHS[0]


@pytest.mark.parametrize("azimuth", relief.AZIMUTHS)
def test_names_and_ticks_are_beside_the_edges_in_front(azimuth: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relief, "azimuth", lambda *_: azimuth)
    with surface.scene(DATASET, []) as shown:
        pass
    ax = surface.surface_figure(DATASET).axes[0]
    half = relief.SIDE / 2
    corners = np.array([(x, y, z) for x in (-half, half) for y in (-half, half) for z in (0.0, relief.HEIGHT)])
    left, upper = shown.on_picture(corners).min(axis=0)
    right, lower = shown.on_picture(corners).max(axis=0)
    middle = shown.on_picture(np.zeros((1, 3)))[0]
    places = {text.get_text(): np.array(text.get_position()) for text in ax.texts}
    for name in ("a [m]", "b [m]"):
        assert places[name][1] > middle[1] + 0.1 * (lower - upper)  # rows count downwards
    assert places["loss"][0] > right - 0.05 * (right - left)
    assert (places["a [m]"][0] - middle[0]) * (places["b [m]"][0] - middle[0]) < 0  # on either side


def test_a_run_is_seen_where_it_went() -> None:
    kind = ("evaluation", np.zeros(2, dtype=np.int8), {"flag_values": [0], "flag_meanings": "random"})
    columns = {
        "u": ("evaluation", np.array([-0.5, 0.0])),
        "v": ("evaluation", np.array([-0.5, 3.0])),
        "loss": ("evaluation", np.array([0.5, 0.1])),
        "outside": ("evaluation", np.array([False, True])),
        "previous": ("evaluation", np.array([-1, -1])),
        "kind": kind,
    }
    run = xr.Dataset(columns, attrs={"label": "bo-s0", "method": "bo"})
    with surface.scene(DATASET, [run]) as shown:
        picture = shown.plotter.screenshot(return_img=True).astype(int)
    red, green, blue = picture[spot(-0.5, -0.5, 0.5)]
    wanted = np.array(to_rgb(style.METHODS["bo"]["color"]))
    assert green > red
    assert np.argmax(wanted) == np.argmax([red, green, blue])
    assert (PICTURE[spot(-0.5, -0.5, 0.5)] != picture[spot(-0.5, -0.5, 0.5)]).any()


def test_files_are_a_picture_and_a_model_that_needs_nothing_else(tmp_path: Path) -> None:
    surface.save_surface(DATASET, [], tmp_path / "a.png", tmp_path / "a.gltf")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    model = json.loads((tmp_path / "a.gltf").read_text())
    assert any("COLOR_0" in part["attributes"] for one in model["meshes"] for part in one["primitives"])
    assert all(buffer["uri"].startswith("data:") for buffer in model["buffers"])
    matrix = np.array(next(node["matrix"] for node in model["nodes"] if "mesh" in node)).reshape(4, 4).T[:3, :3]
    np.testing.assert_allclose(matrix @ [0, 0, 1], [0, 1, 0], atol=1e-9)  # losses go up, as glTF has it
    eye = np.radians(RELIEF.azimuth)
    np.testing.assert_allclose(matrix @ [np.cos(eye), np.sin(eye), 0], [0, 0, 1], atol=1e-9)  # towards who opens it
    assert not list(tmp_path.glob(".*"))


def test_triton_is_imported_before_anything_is_rendered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mesa brings an LLVM of its own; triton, which CUDA builds of torch bring, crashes where it comes second."""
    (tmp_path / "triton.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "triton", None)
    monkeypatch.delitem(sys.modules, "triton")
    seen = list[bool]()

    def plotter(**_: object) -> None:
        seen.append("triton" in sys.modules)
        raise RuntimeError("enough")

    monkeypatch.setattr(solids.pv, "Plotter", plotter)
    with pytest.raises(RuntimeError, match="enough"), solids.off_screen((8, 8)):
        pass
    assert seen == [True]
