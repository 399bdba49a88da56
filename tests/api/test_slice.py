"""`gs.slice` and `gs.open_slice`: what they promise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.jobs.slice import SliceSummary
from gradscape.landscapes.convert import from_json
from gradscape.landscapes.objective import Objective

BOX = gs.ParameterSpace.box(["a", "b"], -1.0, 1.0)


def bowl() -> gs.Objective:
    return gs.from_torch(lambda x: (x**2).sum(dim=1), BOX)


def test_slope_and_minima_are_those_of_a_closed_form() -> None:
    cut = gs.slice(bowl(), (0, 1), resolution=(5, 9))
    u, v = np.meshgrid(cut.data["u"], cut.data["v"])
    np.testing.assert_allclose(cut.slope, np.stack([2 * u, 2 * v], axis=-1), atol=1e-15)
    (lowest,) = cut.minima().to_dict("records")
    assert lowest == {"a": 0.0, "b": 0.0, "loss": 0.0, "depth": 2.0}
    assert cut.folder is None
    assert cut.plane.resolution == (5, 9)


class Raises(Objective):
    """A bowl that raises in a corner, and has no gradient at its minimum."""

    name, space = "raises", BOX

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> gs.Evaluation:
        raised = (x > 0.5).all(dim=1)
        slope = (2 * x).masked_fill((x == 0).all(dim=1, keepdim=True), torch.nan)
        said = "RuntimeError: too much work" if bool(raised.any()) else ""
        status = torch.where(raised, gs.Status.ERROR, gs.Status.OK)
        return gs.Evaluation.from_results(x.square().sum(dim=1), slope if grad else None, status, said)


def test_what_raised_is_counted_and_said_and_a_loss_without_gradient_is_no_failure(tmp_path: Path) -> None:
    cut = gs.slice(Raises(), (0, 1), resolution=9, out=tmp_path / "cut")
    said = "4 points raised: first 'RuntimeError: too much work'"
    for one in (cut, gs.open_slice(tmp_path / "cut")):
        assert one.errors == said
        assert said in repr(one)
    assert float(cut.data["loss"].min()) == 0.0
    summary = from_json(SliceSummary, json.loads((tmp_path / "cut" / "summary.json").read_text()))
    assert "76 ok, 4 error, 1 no gradient; " + said in summary.outcome()
    assert gs.slice(bowl(), (0, 1), resolution=3).errors == ""


def test_a_point_and_an_extent_cut_what_they_say() -> None:
    line = gs.slice(bowl(), ("b",), resolution=3, through=torch.tensor([0.5, 0.0]), window=(-0.5, 0.5))
    np.testing.assert_array_equal(line.data["loss"], [0.5, 0.25, 0.5])
    assert "1 points" not in repr(line)
    with pytest.raises(ValueError, match="has no example 'aim'; it has none"):
        gs.slice(bowl(), (0,), through="example:aim")


@pytest.mark.drawn
def test_a_picture_shows_in_a_notebook_with_events_along_a_line(tmp_path: Path) -> None:
    cut = gs.slice("branin", (0, 1), resolution=4, out=tmp_path / "cut")
    assert cut.plot()._repr_png_().startswith(b"\x89PNG")
    line = gs.slice("bounce", ("velocity y",), resolution=4, through="example:aim", out=tmp_path / "line")
    assert any("bounces" in text.get_text() for ax in line.plot().axes for text in [*ax.texts, ax.yaxis.label])


def test_what_is_made_already_takes_other_settings() -> None:
    ball = gs.make("bounce")
    assert gs.slice(ball, (0, 1), resolution=2, fidelity="standard").identity["fidelity"] == "standard"
    assert ball.fidelity.name == "draft"
    with pytest.raises(ValueError, match="no environment is called 'brannin'; did you mean branin"):
        gs.slice("brannin", (0, 1))


def test_a_slice_says_the_call_that_makes_it_again(tmp_path: Path) -> None:
    how = {"resolution": 2, "through": "example:aim", "gradients": False}
    cut = gs.slice("bounce", (0,), **how, out=tmp_path / "cut")
    again = "gradscape.slice('bounce', (0,), resolution=2, through='example:aim', gradients=False, "
    again += f"out={str(tmp_path / 'cut')!r})"
    assert cut.provenance["command"] == again
    plain = gs.slice("branin", (0, 1), resolution=2, through=torch.tensor([1.0, 2.0]), out=tmp_path / "plain")
    assert "resolution=2, through=[1.0, 2.0], out=" in plain.provenance["command"]
