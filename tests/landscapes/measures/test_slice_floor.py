"""The numerical floor of slices: what is counted above it, what is said of it, and how it is kept."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from torch import Tensor

import gradscape as gs
from gradscape.jobs.slice import SliceJob
from gradscape.jobs.watch import Stopped
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.measures.slice_floor import split_effort
from gradscape.landscapes.measures.verdict import FLAT
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.storage.floor_map import FLOOR
from gradscape.landscapes.storage.store import open_slice

from ...command import Run

SPACE = gs.ParameterSpace.box(("a", "b"), -1.0, 1.0)
PLANE = gs.Plane.through(SPACE, SPACE.center, (0, 1), resolution=24)
EPS, PITCH = 0.02, 40.0
APART = EPS * np.sqrt(2 / 3)  # four sines a quarter apart: their squares add up to 2 everywhere, over 3


def ripples(x: Tensor, phase: float = 0.0, depth: float = 1.0) -> Tensor:
    """A bowl whose grid adds ripples."""
    return depth * (x**2).sum(dim=1) + EPS * torch.sin(PITCH * x[:, 0] + phase)


def quarters(fn: Callable[..., Tensor]) -> dict[str, Callable[..., Tensor]]:
    return {f"grid {n}": partial(fn, phase=n * np.pi / 2) for n in (1, 2, 3)}


ALONE, MADE = (gs.from_torch(ripples, SPACE, replicas=some) for some in (None, quarters(ripples)))


def foot(dataset: xr.Dataset) -> str:
    return "\n".join(text.get_text() for text in landscape_figure(dataset).legends[0].get_texts())


def test_ripples_of_the_grid_are_minima_without_replicas_and_none_with_them() -> None:
    bare, whole = (gs.slice(env, resolution=64) for env in (ALONE, MADE))
    assert np.array_equal(bare.data["loss"], whole.data["loss"])
    before, after = (one.report(points=2) for one in (bare, whole))
    assert (before.losses.notable, after.losses.notable) == (2, 1)
    assert (before.losses.minima, after.losses.minima) == (5, 1)
    assert [one.verdict.surface.minima.value for one in (before, after)] == [2, 1]
    assert after.words[0] == "very smooth"
    assert after.losses.level.value == before.losses.level.value == 0  # however finely it is sampled
    assert whole.floor == after.floor is not None
    assert after.losses.floor == pytest.approx(4 * after.floor.deviation)
    assert after.floor.deviation == pytest.approx(APART)
    said = "numerical floor 0.8 % of the range; gradients of replicas: cosine 0.9"
    assert said in foot(whole.data)
    assert said in repr(whole)
    assert after.measures["Noise floor"].endswith(", the numerical floor")
    assert bare.floor is before.floor is None
    assert "numerical floor" not in foot(bare.data)


def test_a_slice_whose_range_is_numerics_is_called_nothing_else() -> None:
    flat = partial(ripples, depth=1e-3)
    found = gs.slice(gs.from_torch(flat, SPACE, replicas=quarters(flat)), resolution=16).report(points=2)
    assert found.words == (FLAT,)


def test_the_map_is_what_replicas_are_apart_and_lines_have_it_too() -> None:
    plane = gs.slice(MADE, resolution=12, gradients=2, floor=True)
    line = gs.slice(MADE, ("a",), resolution=30, floor=True)
    for found in (plane, line):
        assert found.floor_map is not None
        np.testing.assert_allclose(found.floor_map["deviation"], APART)
        assert found.floor is not None
        assert found.floor.points == found.data["loss"].size
    assert plane.floor_map is not None
    assert np.isfinite(plane.floor_map["cosine"].to_numpy()).sum() == 36  # where there are gradients
    assert [ax.get_ylabel() for ax in plane.plot().axes].count("numerical floor") == 1
    assert [ax.get_ylabel() for ax in line.plot().axes].count("numerical floor") == 1


@pytest.mark.parametrize(("samples", "replicas"), [(30, 1), (30, 5), (256, 3), (9216, 4), (9216, 60)])
def test_the_floor_costs_about_a_tenth_and_has_four_points_at_least(samples: int, replicas: int) -> None:
    points, used = split_effort(samples, replicas)
    assert 4 <= points <= 16
    assert 1 <= used <= replicas
    assert points * used <= max(4, samples / 10)


class Stopping(Objective):
    """The ripples, which stop after so many points of all replicas together."""

    space, name, preferred_batch = SPACE, "stopping", 32

    def __init__(self, phase: float = 0.0, left: list[float] | None = None) -> None:
        self.phase, self.left = phase, [np.inf] if left is None else left

    def replicas(self) -> Mapping[str, Objective]:
        return {f"grid {n}": Stopping(n * np.pi / 2, self.left) for n in (1, 2, 3)}

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        self.left[0] -= len(x)
        if self.left[0] < 0:
            raise KeyboardInterrupt
        x = x.detach().requires_grad_()
        loss = ripples(x, self.phase)
        slope = torch.autograd.grad(loss.sum(), x)[0] if grad else None
        return Evaluation.from_results(loss.detach(), slope)


@pytest.mark.parametrize("after", [300, 1100])
def test_a_slice_that_was_stopped_has_the_same_floor(tmp_path: Path, after: int) -> None:
    """Stopped among its own samples, or among those of a replica."""

    def job(name: str, left: float = np.inf) -> SliceJob:
        return SliceJob.of(Stopping(left=[left]), PLANE, command="", out=tmp_path / name, floor=True)

    whole = job("whole").run()
    with pytest.raises(Stopped):
        job("cut", after).run()
    assert job("cut").run().floor == whole.floor is not None
    ours, theirs = (gs.open_slice(tmp_path / name, env=Stopping()) for name in ("whole", "cut"))
    xr.testing.assert_identical(ours.floor_map, theirs.floor_map)
    few = [open_slice(tmp_path / name).attrs["floor"] for name in ("whole", "cut")]
    assert few[0] == few[1]
    assert sorted(path.name for path in (tmp_path / "cut").iterdir()) == [
        FLOOR, "landscape.png", "slice.zarr.zip", "summary.json",
    ]  # fmt: skip


def test_replicas_that_raise_are_warned_of_and_lose_no_slice() -> None:
    class Raises(Stopping):
        def replicas(self) -> Mapping[str, Objective]:
            return {"raises": Raised()}

    class Raised(Stopping):
        def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
            raise RuntimeError("no such grid")

    with pytest.warns(RuntimeWarning, match="raised an error, so the numerical floor is not known: .*no such grid"):
        assert gs.slice(Raises(), resolution=8).floor is None


FILE = """
import math
from functools import partial
import torch
import gradscape as gs

def ripples(x, phase=0.0):
    return (x**2).sum(dim=1) + 0.02 * torch.sin(40 * x[:, 0] + phase)

grids = {f"grid {n}": partial(ripples, phase=n * math.pi / 2) for n in (1, 2, 3)}
made = gs.from_torch(ripples, gs.ParameterSpace.box(("a", "b"), -1.0, 1.0), replicas=grids)
"""


def test_the_commands_take_a_users_replicas(run: Run, tmp_path: Path) -> None:
    (tmp_path / "my.py").write_text(FILE)
    slice_ = ["slice", "my.py:made", "--resolution", "16", "--out", "made", "--json"]
    first = run.ok(*slice_)
    assert first.json["floor"]["deviation"] == pytest.approx(APART)
    assert "numerical floor 0.81 % of the range; gradients of replicas: cosine 0.9" in first.stderr
    losses = open_slice(tmp_path / "made")["loss"]
    mapped = run.ok(*slice_, "--floor")
    assert (mapped.json["episodes"], mapped.json["floor"]["points"]) == (0, 256)
    assert np.array_equal(open_slice(tmp_path / "made")["loss"], losses)
    np.testing.assert_allclose(xr.open_zarr(tmp_path / "made" / FLOOR)["deviation"], APART)
    said = run.ok(*["report", "made", "--env", "my.py:made", "--points-per-axis", "2", "--out", "said"])
    assert "numerical floor 0.81 % of the range; gradients of replicas: cosine 0.9" in said.stdout
    assert run.ok(*slice_, "--force").json["floor"]["points"] < 256
    assert not (tmp_path / "made" / FLOOR).exists()
    run.refuse(*["slice", "ackley", "--dims", "0", "1", "--floor"], said="ackley has no replicas, so its")
    run.refuse(*slice_[:2], "--refine", "5%", "--floor", said="got --refine or --budget: leave out one")


@pytest.mark.drawn
def test_a_census_says_the_floor_and_counts_nothing_below_it(tmp_path: Path) -> None:
    named = (ALONE, "bare"), (MADE, "whole")
    bare, whole = (gs.census(env, slices=1, resolution=24, out=tmp_path / name) for env, name in named)
    assert bare.floor is None
    assert whole.floor is not None
    assert whole.floor.deviation == pytest.approx(APART)
    assert "numerical floor 0.8 % of the range" in whole.plot().legends[0].get_title().get_text()
    assert [one.slices[0].measures[1] for one in (bare, whole)] == [2, 1]  # notable minima
