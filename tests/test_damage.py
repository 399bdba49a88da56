"""What is damaged or somebody else's is refused, and begun again by `--force` where it is ours alone."""

from pathlib import Path

import pytest

from .command import Run

pytestmark = pytest.mark.e2e

CUT = "slice branin --dims 0 1 --resolution 4 --out cut"


def test_a_slice_with_a_damaged_layout_is_begun_anew_by_force(run: Run, tmp_path: Path) -> None:
    run.ok(CUT)
    for layout in (b"cut off", b""):
        file = tmp_path / "cut/slice.zarr.zip"
        file.write_bytes(file.read_bytes()[:2000] if layout else b"")
        run.refuse(CUT, said="restore it, or sample the slice again in another folder")
        run.ok(*CUT.split(), "--force")


def test_a_report_of_several_slices_leaves_somebody_elses_alone(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for name in ("report.md", "report.json"):
        (tmp_path / "mine" / name).write_text("precious")
        done = run("report branin --all --out mine")
        assert done.returncode == 2
        done = run.refuse("report --all --out mine", said="mine/report.json is missing, damaged or not a summary")
        assert (tmp_path / "mine" / name).read_text() == "precious"


@pytest.mark.parametrize("mine", ["frames/notes.txt", "frames/001.png", "slice.zarr/notes.txt"])
def test_a_sweep_with_anything_else_in_it_is_not_begun_anew(run: Run, tmp_path: Path, mine: str) -> None:
    over = "smoothing" if mine.startswith("slice") else "2"
    sweep = ["sweep", "ackley", "--set", "dim=3", "--dims", "0", "1", "--over", over, "--frames", "2"]
    sweep += ["--resolution", "4", "--out", "made"]
    run.ok(*sweep)
    (tmp_path / "made" / mine).parent.mkdir(exist_ok=True)
    (tmp_path / "made" / mine).write_text("precious")
    run.refuse(
        *sweep, "--force", said="not part of this sweep" if mine.startswith("frames") else "do not belong to a slice"
    )
    held = {path.name for path in (tmp_path / "made").iterdir()}
    assert held >= {"sweep.mp4", "sweep.gif", "sweep.rrd", "summary.json"}
    assert (tmp_path / "made" / mine).read_text() == "precious"
