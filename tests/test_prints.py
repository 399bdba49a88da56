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


@pytest.mark.parametrize(
    ("command", "picture", "resumed"),
    [
        (SLICE, "landscape", "all 25 episodes with gradients are there already"),
        (
            ("bounce", "--axis", "x", "--resolution", "8", "--fidelity", "draft", "--device", "cpu"),
            "landscape",
            "all 8",
        ),
        (("optimize", "ackley", "--method", "random", "--budget", "6"), "progress", "all 6 episodes are there already"),
        (("race", "ackley", "--methods", "random,cma-es", "--budget", "6", "--seeds", "1"), "race", "all 12 episodes"),
    ],
    ids=["slice", "bounce", "optimize", "race"],
)
def test_a_command_repeated_with_print_draws_and_computes_nothing(
    run: Run, tmp_path: Path, command: tuple[str, ...], picture: str, resumed: str
) -> None:
    command = (*command, "--json", *(() if "--out" in command else ("--out", "cut")))
    run.ok(*command)
    assert not [file for file in (tmp_path / "cut").iterdir() if file.suffix in (".pdf", ".svg")]
    again = run.ok(*command, "--figure-width-mm", "85", "--figure-width-mm", "170")
    assert resumed in again.stderr
    wanted = prints(picture, 85, 170)
    assert whole(tmp_path / "cut", wanted)
    assert wanted[0] in again.stderr
    run.ok(*command)
    assert whole(tmp_path / "cut", wanted)


def test_what_begins_anew_leaves_no_print_of_what_was(run: Run, tmp_path: Path) -> None:
    run(*SLICE, "--figure-width-mm", "85")
    run.ok(*SLICE, "--force", "--resolution", "4", "--json")
    assert not list((tmp_path / "cut").glob("*.pdf"))


def test_overlays_comparisons_surfaces_and_replays_are_printed_too(run: Run, tmp_path: Path) -> None:
    cut = ("slice", "bounce", "--dims", "0", "1", "--resolution", "5", "--device", "cpu", "--out", "cut")
    search = ("optimize", "bounce", "--method", "random", "--budget", "6", "--device", "cpu", "--out", "run")
    for command in (cut, search):
        run.ok(*command)
    for name, command in (
        ("overlay", ("overlay", "cut", "run", "--out", "overlay")),
        ("compare", ("compare", "cut", "cut", "--out", "compare")),
        ("surface", ("surface", "cut", "run", "--out", "surface")),
        ("episode", ("replay", "bounce", "--no-film", "--device", "cpu", "--out", "episode")),
    ):
        for _ in range(2):  # the second time into a folder that has prints
            done = run.ok(*command, "--figure-width-mm", "85")
            assert whole(tmp_path / name, prints(name, 85))
            assert prints(name, 85)[-1] in done.stderr


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
    assert "copied is copied from cut" in beside.stderr
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
