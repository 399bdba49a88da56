"""Losses up to the largest number are drawn, in a unit that the axis names; what measures them says why it cannot."""

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.draw.figures.profile import profile_figure
from gradscape.landscapes.large import in_unit
from gradscape.landscapes.measures.ruggedness import ruggedness
from gradscape.landscapes.measures.slice_comparison import compare_slices
from gradscape.landscapes.measures.undersampled import find_undersampled

SPACE = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})
LARGE = {
    "both": lambda x: 1e308 * x[:, 0].sign() + 0 * x.sum(dim=1),
    "ramp": lambda x: 1.7e308 * x[:, 0] + 0 * x[:, 1],
    "below": lambda x: -1e308 * (1 + 0.7 * x[:, 0] ** 2) + 0 * x[:, 1],
    "level": lambda x: 1e308 + 0 * x.sum(dim=1),
    "spike": lambda x: torch.where(x[:, 0] > 0.9, 1e308, x.square().sum(dim=1)),
    "gradients": lambda x: 1e154 * x.sum(dim=1),  # whose squares are too large
}


def cut(name: str, dims: tuple[int, ...], *, gradients: bool = True):
    objective = gs.from_torch(LARGE[name], SPACE, name=name, loss_unit="J")
    plane = gs.Plane.through(SPACE, SPACE.center, list(dims), resolution=12)
    return objective, gs.sample(objective, plane, gradients=int(gradients))


@pytest.mark.drawn
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("name", list(LARGE))
def test_large_losses_are_drawn_and_looked_between(name, gradients):
    for dims, draw in (((0, 1), landscape_figure), ((0,), profile_figure)):
        objective, dataset = cut(name, dims, gradients=gradients)
        picture = draw(dataset)
        assert picture._repr_png_().startswith(b"\x89PNG")
        labels = [text for ax in picture.axes for text in (ax.get_ylabel(), ax.get_xlabel())]
        assert ("loss [10³⁰⁸ J]" if name != "gradients" else "loss [J]") in labels
        find_undersampled(objective, dataset)


def test_a_unit_changes_no_ratio_and_no_ordinary_slice():
    _, dataset = cut("ramp", (0, 1))
    scaled = in_unit(dataset)
    assert float(abs(scaled["loss"]).max()) == 1.7
    np.testing.assert_allclose(scaled["loss"], dataset["loss"] / 1e308)
    np.testing.assert_allclose(scaled["grad"], dataset["grad"] / 1e308)
    _, ordinary = cut("gradients", (0, 1))
    assert in_unit(ordinary) is ordinary


@pytest.mark.drawn
def test_of_a_spike_the_gradients_beside_it_are_not_zero():
    """They would be in its unit: of 12 columns one is level."""
    _, dataset = cut("spike", (0, 1))
    said = [text.get_text() for text in landscape_figure(dataset).legends[0].get_texts()]
    assert "gradient exactly zero: 12 of 144" in said


def test_what_needs_differences_says_why_it_has_none():
    why = r"values up to 1e\+308 cannot be measured or drawn, because their differences overflow"
    objective, dataset = cut("both", (0, 1))
    with pytest.raises(ValueError, match=why):
        ruggedness(dataset, floor=0.0)
    with pytest.raises(ValueError, match=why):
        compare_slices(dataset, dataset)
    with pytest.raises(ValueError, match=why):
        gs.slice(objective, (0, 1), resolution=17, refine=0.05)
