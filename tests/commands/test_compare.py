"""`landscape compare`: what it leaves, samples, continues with, and refuses."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gradscape.landscapes.storage.store import open_slice

from ..command import Run, make

CUT = "slice bounce --dims 0 1 --resolution 5 --device cpu"

STANDARD = "compare a bounce --fidelity standard --device cpu --out made"


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a slice at draft and one of the same plane at standard."""
    return make(tmp_path_factory.mktemp("both"), f"{CUT} --out a", f"{CUT} --fidelity standard --out b")


@pytest.fixture
def desk(both: Path, tmp_path: Path) -> Path:
    """A folder with the two slices."""
    return shutil.copytree(both, tmp_path, dirs_exist_ok=True)


def test_two_slices_are_compared_and_nothing_is_sampled(run: Run, desk: Path) -> None:
    done = run.ok("compare a b --out both --json")
    assert sorted(file.name for file in (desk / "both").iterdir()) == ["compare.json", "compare.png"]
    said = done.json
    kept = json.loads((desk / "both/compare.json").read_text())
    assert {name: kept[name] for name in ("a", "loss", "differing")} == {
        name: said[name] for name in ("a", "loss", "differing")
    }
    one, other = (open_slice(desk / name)["loss"].to_numpy() for name in "ab")
    assert said["loss"]["largest"]["value"] == np.abs(other - one).max()
    assert (said["points"], said["compared"]) == (25, 25)
    assert set(said["differing"]) == {"fidelity", "settings.dt"}
    assert "fidelity: 'draft' in A, 'standard' in B" in done.stderr
    assert "both: compare.json, compare.png" in done.stderr


def test_an_environment_is_sampled_on_the_slices_own_plane_as_it_would_be_by_itself(run: Run, desk: Path) -> None:
    command = (*STANDARD.split(), "--json")
    done = run.ok(*command)
    (folder,) = (path for path in (desk / "made").iterdir() if path.is_dir())
    np.testing.assert_array_equal(open_slice(folder)["loss"], open_slice(desk / "b")["loss"])
    given = run.json("compare a b --out both")
    assert done.json["loss"] == given["loss"]
    again = run(*command)
    assert "all 25 episodes with gradients are done already" in again.stderr
    assert again.json == done.json


def test_what_lies_off_the_box_is_left_out_of_b_where_it_is_of_a(run: Run) -> None:
    cut = "slice bounce --along random:3 --through random:1 --resolution 5 --window 1.5 --device cpu --out a"
    run.ok(cut)
    done = run(*STANDARD.split(), "--json")
    said = done.json
    assert said["statuses"] == []
    assert 0 < said["compared"] < said["points"] == 25
    assert not {"cut", "boxed"} & set(said["differing"])


def test_another_comparison_is_replaced_by_force_alone(run: Run, desk: Path) -> None:
    run.ok("compare a b --out both")
    run.refuse(
        "compare b a --out both",
        cwd=desk,
        said="both contains a comparison made by other settings (a.fidelity: wanted 'standard', found 'draft'",
    )
    run.ok("compare b a --out both --force")
    assert json.loads((desk / "both/compare.json").read_text())["a"] == "bounce · standard"


def test_lines_are_compared_too(run: Run) -> None:
    line = "slice bounce --dims 1 --resolution 8 --device cpu --out a"
    run.ok(line)
    done = run.ok(STANDARD)
    assert "largest difference at velocity y [m/s]" in done.stdout
