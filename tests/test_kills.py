"""Jobs of all kinds that are stopped end in the bits of undisturbed ones, and what a kill leaves is in nobody's way."""

import re
from functools import partial
from pathlib import Path
from signal import SIGINT, SIGKILL

import pytest

from gradscape.cli import main

from .kinds import numbers
from .processes import Instant, alone, landscape

pytestmark = pytest.mark.e2e

BOUNCE = ["bounce", "--dims", "0", "1", "--resolution", "4", "--fidelity", "draft"]
SEARCH = ["--budget", "4", "--fidelity", "draft"]
KILLED = {  # the command, and the instants of four kills; test_faults.py kills all kinds, at random
    "slice": (
        "slice bounce --dims 0 1 --resolution 12 --fidelity draft --out made",
        (Instant(1), Instant(9, "pieces"), Instant(12, "pieces"), Instant(1, "landscape.png")),
    ),
    "optimize": (
        "optimize rastrigin --set dim=5 --method cma-es --budget 70 --out made",
        (Instant(1), Instant(4, "loss/c"), Instant(5, "status/c"), Instant(1, "progress.png")),
    ),
}


@pytest.mark.parametrize("job", KILLED)
def test_four_kills_change_no_bit(job: str, tmp_path: Path) -> None:
    """One before anything is there, two in the middle of a tile or of columns, one when all values are there."""
    command, four = KILLED[job]
    work, killed, whole = partial(landscape, *command.split()), tmp_path / "killed", tmp_path / "whole"
    for folder in (killed, whole):
        folder.mkdir()
    for instant in four:
        assert alone(work, killed, instant).returncode == -SIGKILL
    ended = {folder: alone(work, folder) for folder in (killed, whole)}
    for done in ended.values():
        assert done.returncode == 0, done.stderr
    assert "done already" in ended[killed].stderr
    assert numbers(killed) == numbers(whole) != {}
    assert not [path for path in killed.rglob(".*") if path.suffix in (".making", ".partial")]


STOPPED = {  # the command, how many points or episodes it has in all, and the instant of Ctrl-C
    "slice": (
        "slice bounce --dims 0 1 --resolution 16 --fidelity standard --out made",
        256,
        Instant(9, "pieces", SIGINT),
    ),
    "sweep": (
        "sweep bounce --dims 0 1 --over 2 --frames 4 --resolution 8 --device cpu --out made",
        256,
        Instant(40, "pieces", SIGINT),
    ),
    "optimize": (
        "optimize rastrigin --set dim=5 --method cma-es --budget 70 --out made",
        70,
        Instant(9, "status/c", SIGINT),
    ),
    "race": (
        "race bounce --methods random,descents --fidelity draft --budget 40 --seeds 2 --workers 2 --out made",
        160,
        Instant(9, "status/c", SIGINT),
    ),
}


@pytest.mark.parametrize("job", STOPPED)
def test_ctrl_c_says_what_is_kept_and_how_to_go_on_and_changes_no_bit(job: str, tmp_path: Path) -> None:
    command, count, instant = STOPPED[job]
    work, stopped, whole = partial(landscape, *command.split(), "--json"), tmp_path / "stopped", tmp_path / "whole"
    for folder in (stopped, whole):
        folder.mkdir()
    done = alone(work, stopped, instant)
    assert (done.returncode, done.stdout) == (130, "")
    assert "Traceback" not in done.stderr
    assert f"the same command continues from there: landscape {command}" in done.stderr
    kept = re.search(rf"stopped: (\d+) of {count} (points|episodes) are kept", done.stderr)
    assert kept
    assert 0 < int(kept[1]) < count
    assert (stopped / "made/progress.png").exists() == (job == "optimize")
    again = alone(work, stopped)
    assert again.returncode == alone(work, whole).returncode == 0, again.stderr
    assert "are done already" in again.stderr
    assert f"all {count}" not in again.stderr
    summary = again.json
    if job == "race":
        assert "The paper compares no optimisers here" in summary["silence"]
        assert summary["loss_unit"] == "m²"
    else:
        assert (summary["resumed"], summary["episodes"]) == (int(kept[1]), count - int(kept[1]))
    assert numbers(stopped) == numbers(whole) != {}


@pytest.mark.parametrize(
    ("command", "left"),
    [
        (["slice", *BOUNCE], ".landscape-85mm.pdf"),
        (["sweep", *BOUNCE, "--over", "2", "--frames", "2"], "frames/.0.zarr"),
        (["race", "bounce", "--methods", "random", "--seeds", "2", *SEARCH], "random-0/.run.zarr"),
        (["pairs", "bounce", "--samples", "2"], ".pairs.json"),
        (["replay", "bounce", "--no-film"], ".episode.mp4"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else None,
)
def test_what_a_kill_left_in_a_folder_is_no_other_file_and_goes(
    command: list[str], left: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "made" / f"{left}.{'0a' * 16}.making"
    place.mkdir(parents=True)
    (place / "zarr.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([*command, "--device", "cpu", "--out", "made"])
    assert not ended.value.code
    assert not [path for path in (tmp_path / "made").rglob(".*") if path.name.startswith(".")]
