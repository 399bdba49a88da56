"""`--figure-width-mm`: pictures for print beside those for a screen, drawn again without computing anything."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from gradscape.landscapes.storage.records import open_bundle, save_bundle

from .command import Run

pytestmark = pytest.mark.e2e

SLICE = ("slice", "branin", "--dims", "0", "1", "--resolution", "5", "--out", "cut")


def prints(picture: str, *widths: int) -> list[str]:
    return [f"{picture}-{width}mm.{kind}" for width in widths for kind in ("pdf", "svg")]


def whole(folder: Path, names: list[str]) -> bool:
    begins = {"pdf": b"%PDF", "svg": b"<?xml"}
    return all((folder / name).read_bytes().startswith(begins[name[-3:]]) for name in names)


def test_a_report_is_printed_from_what_it_kept(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(*SLICE)
    command = ("report", "cut", "--points-per-axis", "2", "--out", "told")
    run.ok(*command, "--figure-width-mm", "85")
    name = prints("gradient-quality", 85)[0]
    before = (tmp_path / "told" / name).read_bytes()
    (tmp_path / "told" / name).unlink()

    def compute(*_: object) -> None:
        raise AssertionError("it is measured again")

    monkeypatch.setattr("gradscape.jobs.report.measure", compute)
    run.ok(*command, "--figure-width-mm", "85")
    assert (tmp_path / "told" / name).read_bytes() == before
    for file in (tmp_path / "told").iterdir():
        (tmp_path / "cut" / file.name).write_bytes(file.read_bytes())
    beside = run("report cut --points-per-axis 2 --out copied --figure-width-mm 85")
    assert "copied: the report is copied from cut" in beside.stderr
    assert (tmp_path / "copied" / name).read_bytes() == before
    (tmp_path / "told/gradient-quality.npz").unlink()
    older = run(*command, "--figure-width-mm", "85")
    assert older.returncode == 2
    assert older.stderr.splitlines()[-1].endswith("delete it to measure it again")


@pytest.mark.parametrize("width", ["40", "wide"])
def test_no_page_is_so_wide(run: Run, tmp_path: Path, width: str) -> None:
    run.refuse(*SLICE, "--figure-width-mm", width, said="--figure-width-mm")
    assert not (tmp_path / "cut").exists()


def test_datasets_in_a_file_are_read_as_they_were(tmp_path: Path) -> None:
    one = xr.Dataset({"cosine": (("scale", "point"), np.random.default_rng(0).random((2, 3)))}, {"scale": [0.1, 0.2]})
    other = xr.Dataset({"deviation": np.nan})
    save_bundle(tmp_path / "a.npz", one=one, other=other)
    found = open_bundle(tmp_path / "a.npz")
    assert found["one"].identical(one)
    assert found["other"].identical(other)
