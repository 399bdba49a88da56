"""`gs.overlay`: what it promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gradscape as gs


@pytest.fixture
def cut(tmp_path: Path) -> gs.Slice:
    return gs.slice("branin", (0, 1), resolution=6, out=tmp_path / "cut")


def test_runs_are_laid_over_a_slice_as_they_are_or_from_their_folders(cut: gs.Slice, tmp_path: Path) -> None:
    found = gs.optimize("branin", "random", budget=8, out=tmp_path / "run")
    laid = gs.overlay(cut, [found], out=tmp_path / "over")
    assert sorted(file.name for file in (tmp_path / "over").iterdir()) == ["overlay.png", "overlay.rrd"]
    assert (laid.summary.runs, laid.summary.points, laid.summary.outside) == (1, 8, 0)
    assert laid.plot()._repr_png_().startswith(b"\x89PNG")
    assert "8 points" in repr(laid)
    again = gs.overlay(tmp_path / "cut", tmp_path / "run", out=tmp_path / "again")
    np.testing.assert_array_equal(again.runs[0]["beneath"], laid.runs[0]["beneath"])


def test_a_slice_is_cut_anew_through_the_best_point(tmp_path: Path) -> None:
    env = gs.make("ackley", dim=3)
    cut = gs.slice(env, (0, 1), resolution=4, out=tmp_path / "cut")
    found = gs.optimize(env, "random", budget=8, out=tmp_path / "run")
    laid = gs.overlay(cut, found, through="best", resolution=5, out=tmp_path / "over")
    assert float(laid.slice.plane.distance(found.best.x)) < 1e-12
    assert laid.slice.plane.resolution == (5, 5)
    assert laid.slice.folder is not None
    assert laid.slice.folder.parent == tmp_path / "over"


def test_what_does_not_belong_together_is_refused(cut: gs.Slice, tmp_path: Path) -> None:
    other = gs.optimize("ackley", "random", budget=2, out=tmp_path / "run")
    with pytest.raises(ValueError, match="objective is 'branin' there and 'ackley' here"):
        gs.overlay(cut, other)
    with pytest.raises(ValueError, match="--plane takes pca"):
        gs.overlay(cut, other, plane="tsne")
    assert not Path("out/overlay").exists()
