"""Every JSON file that a verb leaves is damaged, and every verb that reads its folder ends in words that name it."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gradscape.jobs import tolerance
from gradscape.landscapes.measures import fidelity as tradeoff

from .command import Said

Command = Callable[..., Said]
CUT = "slice branin --dims 0 1 --resolution 4 --out cut"
MADE = {  # by folder: the verb that leaves it, then those that read it
    "cut": [
        CUT,
        "report cut --points 2 --out anew",
        "overlay cut run --out over",
        "compare cut cut --out alike",
        "export cut --out cut.csv --force",
    ],
    "run": ["optimize branin --method random --budget 4 --out run"],
    "race": ["race branin --methods random --seeds 1 --budget 4 --out race"],
    "told": ["report cut --points 2 --out told"],
    "both": ["compare cut branin --out both"],
    "pairs": ["pairs branin --samples 2 --out pairs"],
    "trade": ["tradeoff bounce --set horizon=0.05 --points 2 --variants precision --device cpu --out trade"],
    "user": ["slice bounce --set horizon=0.05 --dims 0 1 --resolution 2 --tolerance 50% --device cpu --out chosen"],
}
DAMAGES = ("", "[]", "{}", '{"attributes": 3', "cut")
READ_ALIKE = {
    "grad",
    "status",
    "u",
    "dim",
    "unit",
    "x",
    "kind",
    "slope",
    "episodes",
    "forwards",
    "seconds",
}  # as loss is


@pytest.fixture
def desk(run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of each kind of result, made by the verbs themselves."""
    monkeypatch.setattr(tolerance, "user_data_path", lambda name: tmp_path / "user" / name)
    for name in ("REPETITION", "LARGEST"):
        monkeypatch.setattr(tradeoff, name, 0.002)
    monkeypatch.setattr(tradeoff, "RESAMPLES", 9)
    for verb, *_ in MADE.values():
        done = run(*verb.split(), cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    return tmp_path


def records(desk: Path) -> Iterator[tuple[str, Path]]:
    """Yield the JSON files of each folder; of a kind of array one, since all are read alike."""
    for folder in MADE:
        for file in sorted((desk / folder).rglob("*.json")):
            if file.parent.name not in READ_ALIKE:
                yield folder, file


def test_a_damaged_file_is_passed_over_or_named(run: Command, desk: Path) -> None:
    found, named = list(records(desk)), set[str]()
    assert {folder for folder, _ in found} >= {"cut", "told", "pairs", "trade", "user"}
    for number, (folder, file) in enumerate(found):
        content = file.read_text()
        damage = DAMAGES[number % len(DAMAGES)]
        file.write_text(content[: len(content) // 2] if damage == "cut" else damage)
        for verb in MADE[folder]:
            done = run(*verb.split(), cwd=desk)
            assert "Traceback" not in done.stderr
            if done.returncode:
                named.add(file.name)
                assert done.returncode in (1, 2), done.stderr
                assert done.stderr.strip().count("\n") == 0, done.stderr
                place = file.relative_to(desk)
                assert str(place) in done.stderr or str(place.parent) in done.stderr, done.stderr
        file.write_text(content)
    for verb in (verb for verbs in MADE.values() for verb in verbs):
        assert run(*verb.split(), cwd=desk).returncode == 0
    assert named >= {"zarr.json", "report.json", "settings.json"}


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
