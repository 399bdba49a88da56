"""What is damaged or somebody else's is refused, and begun again by `--force` where it is ours alone."""

from collections.abc import Callable
from pathlib import Path

import pytest

from .command import Said

pytestmark = pytest.mark.e2e

Command = Callable[..., Said]
CUT = "slice branin --dims 0 1 --resolution 4 --out cut"


def test_a_slice_with_a_damaged_layout_is_begun_anew_by_force(run: Command, tmp_path: Path) -> None:
    assert run(*CUT.split(), cwd=tmp_path).returncode == 0
    for place in ("zarr.json", "loss/zarr.json"):
        (tmp_path / "cut/slice.zarr" / place).write_text("{")
        refused = run(*CUT.split(), cwd=tmp_path)
        assert refused.returncode == 2
        assert "restore it, or sample the slice anew in another folder" in refused.stderr
        assert run(*CUT.split(), "--force", cwd=tmp_path).returncode == 0


def test_a_report_of_several_slices_leaves_somebody_elses_alone(run: Command, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for name in ("report.md", "report.json"):
        (tmp_path / "mine" / name).write_text("precious")
        done = run("report", "branin", "--all", "--out", "mine", cwd=tmp_path)
        assert done.returncode == 2
        done = run("report", "--all", "--out", "mine", cwd=tmp_path)
        assert done.returncode == 2
        assert "mine/report.json is not there, damaged or of something else" in done.stderr
        assert (tmp_path / "mine" / name).read_text() == "precious"


@pytest.mark.parametrize("mine", ["frames/000.zarr/notes.txt", "frames/001.png", "slice.zarr/notes.txt"])
def test_a_sweep_with_anything_else_in_it_is_not_begun_anew(run: Command, tmp_path: Path, mine: str) -> None:
    over = "smoothing" if mine.startswith("slice") else "2"
    sweep = ["sweep", "ackley", "--set", "dim=3", "--dims", "0", "1", "--over", over, "--frames", "2"]
    sweep += ["--resolution", "4", "--out", "made"]
    assert run(*sweep, cwd=tmp_path).returncode == 0
    (tmp_path / "made" / mine).write_text("precious")
    done = run(*sweep, "--force", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "holds" in done.stderr
    held = {path.name for path in (tmp_path / "made").iterdir()}
    assert held >= {"sweep.mp4", "sweep.gif", "sweep.rrd", "summary.json"}
    assert (tmp_path / "made" / mine).read_text() == "precious"
