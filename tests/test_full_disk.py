"""A disk that is full ends every verb that writes with what is kept, where, and how to continue."""

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from gradscape.cli import verbs
from gradscape.studies import samples

from .command import Run

pytestmark = pytest.mark.e2e

SLICE = "slice branin --dims 0 1 --resolution 4 --out"
SEARCH = "optimize branin --method random --budget 4 --out"
SWEEP = "sweep ackley --set dim=3 --dims 0 1 --over 2 --frames 2 --resolution 4 --no-gradients --out made"
ANEW = "each file that is there is whole"
WRITING = {  # the command, the file for which there is no room any more, what is kept
    "slice": (f"{SLICE} made", "landscape.png", "16 of 16 points are kept in made"),
    "bounce": (
        "bounce --axis y --resolution 4 --fidelity draft --out made", "summary.json", "4 of 4 points are kept in made"
    ),
    "sweep": (SWEEP, "summary.json", "32 of 32 points are kept in made"),
    "optimize": (f"{SEARCH} made", "progress.png", "4 of 4 episodes are kept in made"),
    "race": (
        "race branin --methods random --seeds 1 --budget 4 --out made", "race.json", "4 of 4 episodes are kept in made"
    ),
    "league": (
        "league branin --methods random --seeds 1 --budget 4 --out made", "league.json",
        "4 of 4 episodes are kept in made",
    ),
    "study": (
        "study fidelity bounce --set horizon=0.05 --points 2 --settings precision --device cpu --out made",
        "fidelity.json", "variants are kept in made",
    ),
    "pairs": ("pairs branin --samples 2 --out made", "pairs.json", "2 batches are kept in made"),
    "hessian": ("hessian branin --out made", "hessian.json", "batches are kept in made"),
    "remedy": (
        "remedy branin --starts 6 --budget 16 --remedies clip:9 --out made", "remedy.json", "2 remedies are kept in made"
    ),
    "census": ("census branin --slices 1 --resolution 6 --out made", "census.json", "1 of 1 slices are kept in made"),
    "check": ("check branin --power 50% --device cpu --out made", "check.json", "nothing of the check is kept"),
    "card": (
        "card --scene control --resolution 3 --out made", "card.json", "1 of 1 engines in scenes are kept in made"
    ),
    "report": ("report cut --points-per-axis 2 --out made", "report.json", "0 of 1 reports are kept in"),
    "overlay": ("overlay cut run --out made", "overlay.png", "each file in made is whole"),
    "compare": ("compare cut branin --out made", "compare.json", "each file in made is whole"),
    "surface": ("surface cut --out made", "surface.png", "each file in made is whole"),
    "replay": ("replay bounce --no-film --out made", "episode.json", "each file in made is whole"),
    "export": ("export cut --out made.csv", "made.csv", ANEW),
    "gallery": (
        "gallery compute --only bounce-y --part slices --fidelity draft --resolution 4 --device cpu --data made",
        "landscape.png", "all that is finished is kept in made",
    ),
}  # fmt: skip


def test_every_verb_that_writes_is_tried() -> None:
    writing = {name for name, one in verbs().items() if any("--out" in option.names for option in one.options)}
    writing -= {"gallery build", "gallery serve"}
    assert writing | {"gallery"} == set(WRITING)


@pytest.mark.parametrize("verb", WRITING)
def test_a_full_disk_says_what_is_kept_and_the_same_command_goes_on(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, verb: str
) -> None:
    monkeypatch.setattr("gradscape.studies.own_folder.user_data_path", lambda name: tmp_path / "data" / name)
    for name in ("REPETITION", "LARGEST"):
        monkeypatch.setattr(samples, name, 0.002)
    monkeypatch.setattr(samples, "RESAMPLES", 9)
    command, last, kept = WRITING[verb]
    for needed, made in (("cut", SLICE), ("run", SEARCH)):
        if needed in command.split():
            run.ok(*made.split(), needed)
    replace, full = os.replace, [True]

    def put(source: Any, target: Any) -> None:
        if full and Path(target).name == last:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
        replace(source, target)

    monkeypatch.setattr(os, "replace", put)
    ended = run(command)
    assert ended.returncode == 1, ended.stderr
    assert "landscape: the disk is full" in ended.stderr
    assert kept in ended.stderr
    assert "same command" in ended.stderr
    assert not list(tmp_path.rglob(last))
    full.clear()
    run.ok(command)
    assert not [path for path in tmp_path.rglob(".*") if path.name.startswith(".")]
