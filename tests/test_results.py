"""What every verb owes that leaves results in a folder: its files, the same again, prints, refusals, full disks."""

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from gradscape.cli import verbs
from gradscape.landscapes.storage.records import read_json

from .command import Said
from .kinds import KINDS, MADE, before, copy, files, numbers, say, whole

pytestmark = pytest.mark.e2e

BEGINS = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
THERE, OTHER = "done already", "made by other settings"
DIM = "--set dim=4"  # of another scene than `ackley --set dim=3`


@dataclass(frozen=True)
class Left:
    """What a kind of result leaves: its record first, then its picture, if it has one.

    Once more it says `again`; with the words `other` added it is another result, and refused with `said`. With a full
    disk, met where `last` is put, it says what is `kept`. `mine` is what it is called where somebody else's files lie.
    """

    files: str
    kept: str
    mine: str
    last: str = ""
    again: str = ""
    other: str = ""
    said: str = OTHER


RESULTS = {
    "slice": Left(
        "summary.json landscape.png slice.zarr.zip", "36 of 36 points are kept", "slice", "landscape.png",
        "all 36 episodes with gradients are done already", "--resolution 5",
    ),
    "line": Left(
        "summary.json landscape.png slice.zarr.zip", "16 of 16 points are kept", "slice", "",
        "all 16 episodes with gradients are done already", "--resolution 5",
    ),
    "sweep": Left(
        "summary.json sweep.gif sweep.mp4 sweep.rrd frames", "32 of 32 points are kept", "sweep", "",
        "all 32 episodes with gradients of 2 slices are done already", "--resolution 3",
    ),
    "run": Left(
        "summary.json progress.png run.zarr", "30 of 30 episodes are kept", "run", "progress.png",
        "all 30 episodes are done already", "--seed 2",
    ),
    "race": Left(
        "race.json race.png random-0 random-1 descents-0 descents-1", "64 of 64 episodes are kept", "race", "",
        "all 64 episodes are done already", DIM,
    ),
    "league": Left(
        "league.json league.png branin-exact ackley-exact", "32 of 64 episodes are kept", "league", "",
        "32 of 32 episodes are done",
    ),
    "pairs": Left("pairs.json - pieces", "batches are kept", "pairs", other=DIM),
    "hessian": Left("hessian.json hessian.png hessian.npz pieces", "batches are kept", "Hessian", other=DIM),
    "remedy": Left("remedy.json remedy.png remedy.npz pieces", "2 remedies are kept", "study of remedies", other=DIM),
    "census": Left(
        "census.json census.png census.npz pieces", "4 of 4 slices are kept", "census", "", "done already", DIM
    ),
    "advise": Left("advice.json -", "the advice is not saved", "advice", other="--seed 1"),
    "check": Left("check.json check.png", "the check is not saved", "check", other="--seed 1"),
    "card": Left(
        "card.json card.png card.html card.npz pieces", "1 of 1 engine checks are kept", "report card", "", "",
        "--resolution 4",
    ),
    "fidelity": Left(
        "fidelity.json fidelity.png pieces", "variants are kept", "fidelity study", "", THERE, "--points 3"
    ),
    "report": Left(
        "report.json gradient-quality.png gradient-quality.npz measures.json", "0 of 1 reports are kept", "report", "",
        "the report exists already", "--points-per-axis 3", "contains another report (points 2 there, 3 now)",
    ),
    "overlay": Left("- overlay.png overlay.rrd", "every file in", "overlay", "overlay.png"),
    "comparison": Left("compare.json compare.png", "every file in", "comparison"),
    "replay": Left("episode.json episode.png episode.rrd", "every file in", "episode"),
    "surface": Left("- surface.png surface.gltf", "every file in", "surface", "surface.png"),
}  # fmt: skip
VERBS = {kind: KINDS[kind].make.split()[0] for kind in RESULTS}
PRINTED = [kind for kind in RESULTS if VERBS[kind] not in ("sweep", "pairs", "advise")]
REPLACING = [kind for kind, one in RESULTS.items() if one.other]


def test_every_verb_that_leaves_results_is_tried() -> None:
    leaving = {name for name, one in verbs().items() if any("--out" in option.names for option in one.options)}
    assert leaving - {"gallery build", "gallery serve", "export"} == set(VERBS.values())
    printing = {name for name in leaving if any("--figure-width-mm" in one.names for one in verbs()[name].options)}
    assert printing == {VERBS[kind] for kind in PRINTED}


def prints(kind: str) -> list[str]:
    """Return the files of a kind's picture on a page of 85 mm."""
    name = RESULTS[kind].files.split()[1].removesuffix(".png")
    return [f"{name}-85mm.pdf", f"{name}-85mm.svg"]


def repeated(kind: str, folder: Path, *more: str) -> Said:
    return say(" ".join([KINDS[kind].make, *more]), folder)


@pytest.mark.parametrize("kind", RESULTS)
def test_it_leaves_its_files_and_the_same_command_draws_for_print_and_changes_no_number(kind: str) -> None:
    folder, (record, picture, *others) = copy(whole(kind)), RESULTS[kind].files.split()
    made, before = folder / MADE, numbers(folder)
    assert {one.name for one in made.iterdir() if not one.name.startswith(".")} >= {record, picture, *others} - {"-"}
    assert before or kind in ("overlay", "surface")
    more = ["--json"] if "--json" not in KINDS[kind].make else []
    again = repeated(kind, folder, *more, *(["--figure-width-mm 85"] if kind in PRINTED else []))
    assert again.returncode == 0, again.stderr
    assert RESULTS[kind].again in again.stderr
    assert numbers(folder) == before or kind == "check"  # which says how often it had to look at its memory
    for name in (picture, *prints(kind)) if kind in PRINTED else ():
        assert (made / name).read_bytes().startswith(BEGINS[name[-3:]])
        assert name == picture or name in again.stderr
    if record == "-" or kind == "replay":
        assert again.json
    else:
        kept = {"command": again.json.get("command"), **read_json(made / record), "folder": MADE}
        assert {name: kept[name] for name in again.json} == again.json


@pytest.mark.parametrize("kind", REPLACING)
def test_another_is_refused_and_replaced_by_force_alone(kind: str) -> None:
    folder, left = copy(whole(kind)), RESULTS[kind]
    if kind in PRINTED:
        (folder / MADE / prints(kind)[0]).write_bytes(b"%PDF")  # which are no other files
    held = {path: path.read_bytes() for path in files(folder / MADE)}
    refused = repeated(kind, folder, left.other)
    assert refused.returncode == 2
    assert left.said in refused.stderr
    assert {path: path.read_bytes() for path in files(folder / MADE)} == held
    if kind == "report":  # which replaces nothing
        return
    forced = repeated(kind, folder, left.other, "--force")
    assert forced.returncode == 0, forced.stderr
    record = folder / MADE / left.files.split()[0]
    assert record.read_bytes() != held[record]
    assert not list((folder / MADE).glob("*.pdf")) or kind not in ("slice", "line", "run", "race")


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("kind", RESULTS)
def test_a_folder_of_other_files_is_left_alone(kind: str, force: bool) -> None:
    folder = copy(before(kind))
    (folder / MADE).mkdir()
    for name in ("landscape.png", "thesis.tex"):
        (folder / MADE / name).write_text("precious")
    force = force and any("--force" in one.names for one in verbs()[VERBS[kind]].options)
    done = repeated(kind, folder, *(["--force"] if force else []))
    assert done.returncode == 2
    assert f"{MADE} contains files that are not part of this {RESULTS[kind].mine}" in done.stderr
    assert [file.read_text() for file in files(folder / MADE)] == ["precious"] * 2


def fill(monkeypatch: pytest.MonkeyPatch, last: str) -> Callable[[], None]:
    """Let a disk be full where a file is put in its place; return what makes room."""
    replace, full = os.replace, [True]

    def put(source: Any, target: Any) -> None:
        if full and Path(target).name == last:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
        replace(source, target)

    monkeypatch.setattr(os, "replace", put)
    return full.clear


FULL = {
    **{
        kind: (KINDS[kind].make, one.last or one.files.split()[0], one.kept)
        for kind, one in RESULTS.items()
    },
    "export": (f"export cut --out {MADE}.csv", f"{MADE}.csv", "every finished file is complete"),
    "gallery": (
        "gallery compute --only bounce-y --part slices --fidelity draft --resolution 4 --device cpu "
        f"--data {MADE}", "landscape.png", f"finished parts are kept in {MADE}",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FULL)
def test_a_full_disk_says_what_is_kept_and_the_same_command_goes_on(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    command, last, kept = FULL[kind]
    folder = copy(before({"export": "report"}.get(kind, kind)))
    make_room = fill(monkeypatch, last)
    ended = say(command, folder)
    assert ended.returncode == 1, ended.stderr
    assert "landscape: the disk is full" in ended.stderr
    assert kept in ended.stderr
    assert "same command" in ended.stderr
    assert not list(folder.rglob(last))
    make_room()
    done = say(command, folder)
    assert done.returncode == 0, done.stderr
    assert not [path for path in folder.rglob(".*") if path.name.startswith(".")]
    shutil.rmtree(folder)
