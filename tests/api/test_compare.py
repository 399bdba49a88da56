"""`gs.compare`: what it promises."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.landscapes.convert import to_json


def doubled(x: torch.Tensor) -> torch.Tensor:
    return 2 * x.square().sum(dim=1)


def bowl(x: torch.Tensor) -> torch.Tensor:
    return x.square().sum(dim=1)


SPACE = gs.ParameterSpace(("x", "y"), -torch.ones(2).double(), torch.ones(2).double(), ("m", "m"))


@pytest.mark.drawn
def test_slices_are_compared_as_they_are_or_from_their_folders(tmp_path: Path) -> None:
    a = gs.slice("bounce", (0, 1), resolution=5, out=tmp_path / "a")
    b = gs.slice("bounce", (0, 1), resolution=5, fidelity="standard", out=tmp_path / "b")
    found = gs.compare(a, b, out=tmp_path / "both")
    np.testing.assert_array_equal(found.difference, b.data["loss"] - a.data["loss"])
    assert found.plot()._repr_png_().startswith(b"\x89PNG")
    assert "<table" in found._repr_html_()
    assert repr(found).startswith("<SliceComparison of bounce · draft and bounce · standard: rank correlation")
    assert json.loads((tmp_path / "both/compare.json").read_text())["loss"] == to_json(found.loss)
    again = gs.compare(str(tmp_path / "a"), tmp_path / "b", out=tmp_path / "again")
    assert to_json(again.loss) == to_json(found.loss)


def test_an_environment_or_anyones_objective_is_sampled_where_a_slice_is(tmp_path: Path) -> None:
    a = gs.slice("bounce", (0, 1), resolution=4, out=tmp_path / "a")
    found = gs.compare(a, "bounce", options={"drag": 0.1}, out=tmp_path / "named")
    assert found.differing == {"options.drag": ("0.0", "0.1")}
    made = gs.compare(a, gs.make("bounce", drag=0.1), out=tmp_path / "made")
    assert to_json(made.loss) == to_json(found.loss)
    assert "gradscape.compare(" in made.command
    memory = gs.slice(gs.from_torch(bowl, SPACE), (0, 1), resolution=5)
    twice = gs.compare(memory, gs.from_torch(doubled, SPACE), out=tmp_path / "mine")
    assert (twice.a, twice.b) == ("bowl", "doubled")
    assert twice.slopes is not None
    assert twice.slopes.ratio.value == pytest.approx(2.0)


@pytest.mark.drawn
def test_a_slice_without_gradients_asks_for_none(tmp_path: Path) -> None:
    a = gs.slice("bounce", (0, 1), resolution=4, gradients=False, out=tmp_path / "a")
    found = gs.compare(a, "bounce", fidelity="standard", out=tmp_path / "both")
    assert found.slopes is None
    assert "gradients" not in found.differing
    assert found.plot()._repr_png_().startswith(b"\x89PNG")
