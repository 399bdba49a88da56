"""The folder of a check: written where one is asked for, and never over something else."""

from pathlib import Path

import numpy as np
import pytest

import gradscape as gs
from gradscape.jobs.check import CheckJob
from gradscape.jobs.watch import Stopped, Watch
from gradscape.landscapes.checks.slopes import Kind
from gradscape.landscapes.storage.records import read_json

SPACE = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})
HALVED = 0.3  # of the box, where the gradient is half of the slope


def bowl(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    slope = 2 * x
    slope[x[:, 0] > 1 - 2 * HALVED] *= 0.5
    return (x**2).sum(1), slope


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.drawn
def test_the_folder_holds_the_report_and_its_picture(tmp_path: Path) -> None:
    found = gs.check(gs.from_numpy(bowl, SPACE, name="halved"), power="20%", out=tmp_path / "made", figure_width_mm=85)
    names = {"check.json", "check.png", "check-85mm.pdf", "check-85mm.svg"}
    assert {file.name for file in (tmp_path / "made").iterdir()} == names
    kept = read_json(tmp_path / "made/check.json")
    assert kept.pop("identity")["power"] == 0.2
    assert kept == found.record()
    assert sum(found.kinds.values()) == found.share.points
    assert found.kinds[Kind.WRONG] == found.share.wrong > 0
    assert kept["kinds"] == {str(kind): count for kind, count in found.kinds.items()}
    picture = (tmp_path / "made/check.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert found.plot()._repr_png_() == picture
    assert "check" in found._repr_html_()


def test_a_check_that_is_stopped_leaves_no_file_and_says_that_nothing_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: CheckJob, watch: Watch) -> None:
        raise Stopped("3 checks were done, but nothing is kept", kept=False)

    monkeypatch.setattr(CheckJob, "run", interrupted)
    with pytest.raises(Stopped, match="nothing is kept") as stopped:
        gs.check("branin", out="made")
    assert not stopped.value.kept
    assert not list(tmp_path.iterdir())
