"""`landscape hessian` and `gs.hessian`: what they leave, say, continue from, and refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.jobs.hessian import HessianJob
from gradscape.jobs.scene import SceneSpec
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.curvature import Curvature
from gradscape.landscapes.identity import StoreMismatchError
from gradscape.landscapes.measures.hessian import Hessian
from gradscape.landscapes.storage.records import read_json

from ..command import Run

SPACE = gs.ParameterSpace({"mass": (0, 2, "kg"), "k": (0, 2, "N/m"), "c": (0, 2)})
CURVATURES = torch.tensor([4.0, -1.0, 0.5], dtype=torch.float64)  # times 4 in box units
FUNCTIONS = """
import numpy as np
import torch
import gradscape as gs

space = gs.ParameterSpace({"mass": (0, 2, "kg"), "k": (0, 2, "N/m"), "c": (0, 2)})
curvatures = torch.tensor([4.0, -1.0, 0.5], dtype=torch.float64)
saddle = gs.from_torch(lambda x: 0.5 * (x**2 * curvatures).sum(1), space, loss_unit="J")
bare = gs.from_numpy(lambda x: 0.5 * (x**2 * curvatures.numpy()).sum(1), space)


def swirl(x):
    return 0.5 * (x**2).sum(1), x + np.stack([x[:, 1], -x[:, 0], 0 * x[:, 2]], axis=1)


turning = gs.from_numpy(swirl, space)


def broken(x):
    if (x[:, 0] > 1.0 + 1e-9).any():
        raise RuntimeError("too heavy")
    return 0.5 * (x**2).sum(1)


heavy = gs.from_torch(broken, space, rows=1)
"""


def saddle() -> gs.Environment:
    return gs.from_torch(lambda x: 0.5 * (x**2 * CURVATURES).sum(dim=1), SPACE, name="saddle", loss_unit="J")


def big(dim: int = 120) -> gs.Environment:
    space = gs.ParameterSpace.box([f"p{at}" for at in range(dim)], 0.0, 1.0)
    weights = torch.linspace(-1, 3, dim, dtype=torch.float64)
    return gs.from_torch(lambda x: (0.5 * x**2 * weights + x**4).sum(dim=1), space, name="big")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "own.py").write_text(FUNCTIONS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.drawn
@pytest.mark.parametrize("make", [saddle, big])
def test_a_hessian_is_written_and_drawn_and_read_again(make, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    found = gs.hessian(make(), eigenpairs=2, probes=3, out=tmp_path / "made")
    kept = read_json(tmp_path / "made/hessian.json")
    assert to_json(from_json(Hessian, kept)) == to_json(found) == {k: v for k, v in kept.items() if k != "checksum"}
    with np.load(tmp_path / "made/hessian.npz", allow_pickle=False) as arrays:
        for name in ("values", "errors", "vectors", "nodes", "weights"):
            assert np.array_equal(arrays[name], getattr(found, name))
    assert (tmp_path / "made/hessian.png").read_bytes().startswith(b"\x89PNG")
    table = found.table()
    assert list(table.index) == ([1, 2, 3] if found.dim == 3 else [1, 2, 119, 120])
    assert table["value"].is_monotonic_decreasing
    assert "<table" in found._repr_html_()


def test_it_is_in_box_units_and_says_so(tmp_path: Path) -> None:
    found = gs.hessian(saddle(), [1.0, 1.0, 1.5], out=tmp_path / "made")
    assert [pair.value for pair in found.pairs] == pytest.approx([16, 2, -4])
    assert [pair.along for pair in found.pairs] == [{"mass": 1.0}, {"c": 1.0}, {"k": 1.0}]
    assert found.kind == "saddle"
    assert found.trace.value == pytest.approx(14)
    assert found.condition.value == pytest.approx(8)
    assert found.negative.value == found.negative.low == found.negative.high == pytest.approx(1 / 3)
    assert found.point == {"mass [kg]": 1.0, "k [N/m]": 1.0, "c": 1.5}
    assert found.gradient == pytest.approx(np.linalg.norm(2 * np.array([4.0, -1.0, 0.75])))
    assert found.units == "box units: every parameter runs from 0 to 1 between its bounds"
    assert not found.warnings


def test_what_cannot_be_told_has_no_sign_and_no_condition(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)

    def fn(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (x**2 * [10, 0, 0.1]).sum(axis=1), 2 * x * [10, 0, 0.1] + 0.01 * generator.standard_normal(x.shape)

    found = gs.hessian(gs.from_numpy(fn, SPACE, name="noisy"), out=tmp_path / "made")
    assert [pair.sign for pair in found.pairs] == ["positive", "cannot tell", "cannot tell"]
    assert found.kind == "convexity cannot be told"
    assert np.isnan(found.condition.value)
    assert found.condition.low > 1
    assert found.negative.high == found.undecided == pytest.approx(2 / 3)
    assert "2 of 3 eigenvalues are not distinguishable from 0" in found.warnings[0]


def test_a_stopped_one_goes_on_with_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    how = {"pairs": 3, "probes": 2}
    whole = HessianJob.open(SceneSpec(big()), **how, out=tmp_path / "whole").run()
    ask, rows = Curvature._at, []

    def stop(self: Curvature, offsets: np.ndarray, *, grad: bool) -> object:
        if len(rows) == 20:
            raise KeyboardInterrupt
        rows.append(len(offsets))
        return ask(self, offsets, grad=grad)

    monkeypatch.setattr(Curvature, "_at", stop)
    with pytest.raises(BaseException, match="20 batches are kept"):
        HessianJob.open(SceneSpec(big()), **how, out=tmp_path / "stopped").run()
    monkeypatch.setattr(Curvature, "_at", ask)
    asked: list[int] = []

    def note(self: Curvature, offsets: np.ndarray, *, grad: bool) -> object:
        asked.append(len(offsets))
        return ask(self, offsets, grad=grad)

    monkeypatch.setattr(Curvature, "_at", note)
    again = HessianJob.open(SceneSpec(big()), **how, out=tmp_path / "stopped").run()
    assert to_json(again) == to_json(whole)
    assert np.array_equal(again.vectors, whole.vectors)
    assert sum(rows) + sum(asked) + 18 == whole.episodes  # 18 tell the noise of the loss


def test_the_directions_of_a_cut_are_its_eigenvectors(tmp_path: Path) -> None:
    x = torch.tensor([1.0, 1.0, 1.5], dtype=torch.float64)
    found = gs.hessian(saddle(), x, out=tmp_path / "made")
    cut = gs.slice(saddle(), along="hessian", through=x, resolution=5, out=tmp_path / "cut")
    u, v = (cut.data[name].attrs["long_name"] for name in ("u", "v"))
    assert "curvature 16 " in u
    assert "curvature -4 " in v
    np.testing.assert_allclose(cut.plane.basis.numpy() / 2, found.vectors[[0, 2]], atol=1e-9)  # the box is 2 wide


def test_a_function_without_gradients_is_measured_by_losses_and_goes_on(here: Path, run: Run) -> None:
    said = run.json("hessian own.py:bare --through random:1 --out made")
    assert said["source"] == "losses"
    assert said["gradient"] is None
    assert said["warnings"][0].startswith("differences are of losses, not of gradients: bare returned losses without")
    assert [pair["value"] for pair in said["pairs"]] == pytest.approx([16, 2, -4])
    assert run.json("hessian own.py:bare --through random:1 --out made")["pairs"] == said["pairs"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("turning", ["not symmetric: its antisymmetric part is 0.82 of the symmetric one", "check swirl"]),
        (
            "saddle",
            [
                "In box units: every parameter runs from 0 to 1 between its bounds.", "eigenvalue [J]",
                "condition number: 8 (8 to 8)", "negative curvature: 33% of the eigenvalues",
            ],
        ),
    ],
)  # fmt: skip
def test_what_it_prints(here: Path, run: Run, name: str, said: list[str]) -> None:
    done = " ".join(run.ok(f"hessian own.py:{name} --out made").stdout.split())
    assert all(part in done for part in said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("saddle --through nowhere", "got 'nowhere', which is none of these"),
        ("saddle --through far.txt", "outside its bounds"),
        ("saddle --eigenpairs 0", "--eigenpairs"),
        ("saddle --probes 0", "--probes"),
        ("heavy", "broken failed near this point"),
        ("heavy", "of the box from there (RuntimeError: too heavy)"),
    ],
)
def test_refusals(here: Path, run: Run, words: str, said: str) -> None:
    (here / "far.txt").write_text("1 1 5")
    run.refuse(f"hessian own.py:{words} --out made", said=said)
    assert not list(here.glob("made/hessian.*"))


def test_another_point_is_another_hessian(tmp_path: Path) -> None:
    gs.hessian(saddle(), "random:1", out=tmp_path / "made")
    with pytest.raises(StoreMismatchError):
        gs.hessian(saddle(), "random:2", out=tmp_path / "made")
    gs.hessian(saddle(), "random:2", out=tmp_path / "made", force=True)
    with pytest.raises(ValueError, match="saddle takes 3 parameters"):
        gs.hessian(saddle(), [1.0, 2.0], out=tmp_path / "made")
