"""Surfaces: high where the loss is, holes where it failed, labels and runs in their places."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from matplotlib.colors import to_rgb

from gradscape.landscapes.draw import style, surface
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling import sample
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace.box(["a", "b"], -1.0, 1.0, "m")
PEAK = (0.5, -0.5)


class Hill:
    """A hill, a loss that is not finite where a and b are both above a half."""

    space = SPACE
    name = "hill"

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        loss = 0.1 + torch.exp(-8 * (x - x.new_tensor(PEAK)).square().sum(dim=1))
        loss[(x > 0.5).all(dim=1)] = torch.nan
        return Evaluation.judged(loss, torch.zeros_like(x) if grad else None, torch.ones(len(x), dtype=torch.int8))


def cut(dims: tuple[str, ...] = ("a", "b")) -> xr.Dataset:
    return sample(Hill(), Plane.through(SPACE, SPACE.center, dims, resolution=(24,) * len(dims)))


DATASET = cut()


def drawn() -> tuple[np.ndarray, np.ndarray, surface.Relief]:
    with surface._scene(DATASET, []) as (plotter, relief):
        return plotter.screenshot(return_img=True), surface._projection(plotter), relief


PICTURE, SEEN, RELIEF = drawn()


def spot(u: float, v: float, loss: float) -> tuple[int, int]:
    """Return the pixel (row, column) of a place of the surface."""
    place = RELIEF.at(np.array([u]), np.array([v]), np.array([loss]))
    ((x, y),) = surface.on_picture(SEEN, place)
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
    wanted = surface.on_picture(SEEN, np.array([surface._beside(2, float(RELIEF.shade(np.array(0.8))), surface.AWAY)]))
    np.testing.assert_allclose(texts["0.8"], wanted[0], atol=1e-6)
    assert any(
        "holes: 36 of 576 samples" in text.get_text() for legend in figure.legends for text in legend.get_texts()
    )


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
    with surface._scene(DATASET, [run]) as (plotter, _):
        picture = plotter.screenshot(return_img=True).astype(int)
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
    assert not list(tmp_path.glob(".*"))


def test_a_line_has_no_surface() -> None:
    with pytest.raises(ValueError, match="a slice of rank 1"):
        surface.surface_figure(cut(("a",)))
