"""Pictures for dark pages: greys turn over, maps and their bars keep their colours."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.quiver import Quiver
from PIL import Image

from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures import page
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.draw.figures.dark import darken, invert_greys, save_dark
from gradscape.landscapes.draw.figures.overlay import overlay_figure

from ...test_overlay import LAID, SLICE
from .test_contour import DATASET

NIGHT, INK = (np.array(to_rgb(name)) for name in (style.NIGHT, style.NIGHT_INK))


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), dtype=float) / 255


def test_white_becomes_the_ground_black_the_ink_and_colours_stay() -> None:
    np.testing.assert_allclose(invert_greys(np.ones((1, 3))), [NIGHT], atol=1e-9)
    np.testing.assert_allclose(invert_greys(np.zeros((1, 3))), [INK], atol=1e-9)
    quiet = invert_greys(np.array([to_rgb(style.QUIET)]))[0]
    assert quiet.mean() > 0.5
    for name in ("viridis", "cividis"):
        colours = (style.LOSS_MAP if name == "viridis" else style.DISAGREEMENT["cmap"])(np.linspace(0, 1, 256))
        np.testing.assert_allclose(invert_greys(colours), colours, atol=0.02, err_msg=name)


@pytest.mark.parametrize("draw", [lambda: landscape_figure(DATASET), lambda: overlay_figure(SLICE, LAID)])
def test_a_picture_is_dark_and_its_map_is_as_it_was(draw, tmp_path: Path) -> None:
    picture = draw()
    page.save(picture, tmp_path / "light.png")
    darken(picture)
    page.save(picture, tmp_path / "dark.png")
    light, dark = (pixels(tmp_path / f"{name}.png") for name in ("light", "dark"))
    assert dark.shape == light.shape
    np.testing.assert_allclose(dark[0, 0], NIGHT, atol=0.01)
    paper = (light > 0.99).all(axis=-1)
    assert (dark[paper].mean(axis=-1) < 0.3).mean() > 0.99
    height, width = light.shape[:2]
    for ax in (picture.axes[0], picture.axes[2]):  # the map and its bar
        box = ax.get_position()
        rows, columns = (
            slice(int((1 - box.y1) * height) + 4, int((1 - box.y0) * height) - 4),
            slice(int(box.x0 * width) + 4, int(box.x1 * width) - 4),
        )
        coloured = np.ptp(light[rows, columns], axis=-1) > 0.3
        assert coloured.mean() > 0.3
        apart = np.abs(light[rows, columns] - dark[rows, columns]).max(axis=-1)[coloured]
        assert np.median(apart) == 0


def test_arrows_have_a_map_that_is_seen_on_the_dark_and_their_bar_has_it_too() -> None:
    picture = landscape_figure(DATASET)
    (arrows,) = (one for one in picture.axes[1].collections if isinstance(one, Quiver))
    darken(picture)
    assert arrows.get_cmap() == style.SLOPE_MAP_DARK
    bar = picture.axes[3].collections[-1]
    np.testing.assert_allclose(bar.get_cmap()(0.0), style.SLOPE_MAP_DARK(0.0))
    assert style.SLOPE_MAP_DARK(0.0)[0] > 2 * style.SLOPE_MAP(0.0)[0]


def test_a_picture_that_is_there_is_turned_over_pixel_by_pixel(tmp_path: Path) -> None:
    light = np.ones((40, 60, 3))
    light[5:35, 20] = 0.1  # a line, beside it what is half line and half paper
    light[5:35, 21] = 0.55
    light[10:30, 40:50] = style.LOSS_MAP(0.3)[:3]
    light[9, 40:50] = (1 + np.array(style.LOSS_MAP(0.3)[:3])) / 2  # its border, through which the paper shines
    Image.fromarray(np.rint(255 * light).astype(np.uint8)).save(tmp_path / "light.png")
    save_dark(tmp_path / "light.png", tmp_path / "dark.png")
    dark = pixels(tmp_path / "dark.png")
    np.testing.assert_allclose(dark[0, 0], NIGHT, atol=0.01)
    assert dark[20, 20].mean() > 0.8
    np.testing.assert_allclose(dark[20, 45], style.LOSS_MAP(0.3)[:3], atol=0.01)
    assert dark[9, 45].mean() < light[9, 45].mean() - 0.2
    assert not list(tmp_path.glob(".*"))


def test_a_faint_band_is_faint_on_the_dark_too_without_a_seam(tmp_path: Path) -> None:
    light = np.full((60, 90, 3), 255, dtype=np.uint8)
    light[15:45, 20:70] = np.rint(255 * np.array(to_rgb(style.BAND[0])))
    Image.fromarray(light).save(tmp_path / "light.png")
    save_dark(tmp_path / "light.png", tmp_path / "dark.png")
    dark = pixels(tmp_path / "dark.png")
    band = dark[15:45, 20:70].reshape(-1, 3)
    assert np.ptp(band, axis=0).max() == 0
    assert 0.02 < band[0].mean() - NIGHT.mean() < 0.12  # it is 0.1 below white on the light page
    assert band[0, 2] > band[0, 0]  # and blue
    np.testing.assert_allclose(dark[0, 0], NIGHT, atol=1 / 255)
