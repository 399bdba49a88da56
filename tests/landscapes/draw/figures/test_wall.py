"""The wall of landscapes: each slice on its own scale, under its name, over its words."""

import numpy as np
from matplotlib.colors import Normalize

from gradscape.landscapes.draw.figures.multiples import Landscape, wall_figure
from gradscape.landscapes.draw.style import LOSS_MAP

from .test_contour import DATASET


def test_every_landscape_has_its_own_scale_its_name_and_its_words() -> None:
    other = DATASET.assign(loss=DATASET["loss"] * 1000)
    picture = wall_figure([Landscape("small", "rugged 80 %", DATASET), Landscape("large", "very smooth 10 %", other)])
    shown = [ax.images[0] for ax in picture.axes]
    colours = [image.to_rgba(image.get_array()) for image in shown]
    np.testing.assert_allclose(colours[0], colours[1], atol=0.02)
    loss = DATASET["loss"].to_numpy()
    finite = np.isfinite(loss)
    norm = shown[0].norm
    assert isinstance(norm, Normalize)
    np.testing.assert_allclose(colours[0][finite], LOSS_MAP(norm(loss))[finite])
    said = [ax.get_xlabel().replace("\N{NO-BREAK SPACE}", " ") for ax in picture.axes]
    assert said == ["rugged 80 %", "very smooth 10 %"]
    assert {"small", "large"} <= {text.get_text() for ax in picture.axes for text in ax.texts} | {
        ax.get_title() for ax in picture.axes
    }
