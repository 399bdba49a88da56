"""The command line, what reads results, and disks, under what nobody meant them to get.

`benchmarks` asks the same at length: `commands`, `damage` and `full_disks`, of which these are the first few.
"""

import random
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr
from benchmarks import commands, full_disks, results
from benchmarks.damage import BAD, Trial, damage, files
from benchmarks.forked import Limits, last_words

from gradscape import ParameterSpace, Plane, from_torch, open_run
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.storage.store import SliceStore, open_slice
from gradscape.optim.methods.random import RandomSearch
from gradscape.optim.runs.store import RunStore
from gradscape.optim.search import search

from . import processes  # noqa: F401 -- which says what processes are forked from

LIMITS = Limits(cpu=60, clock=600)
QUICK = ("filling slice", "run", "stopped run", "pairs", "report")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("desks") / "desk"
    commands.set_desk(folder, LIMITS, made=("cut", "run"))
    return folder


def test_what_lines_are_made_from_is_valid() -> None:
    known = commands.verbs()
    for line in commands.VALID:
        words = line.split()
        verb = max((one for one in known if words[: len(one.split())] == one.split()), key=len)
        known[verb].make_context(verb, words[len(verb.split()) :])


@pytest.mark.parametrize("verb", commands.verbs())
def test_whatever_is_said_ends_with_a_message(verb: str, desk: Path, tmp_path: Path) -> None:
    """Ctrl-C comes with the first episode or page, so that what is valid is stopped and not computed."""
    for number in range(3):
        _, line = commands.generated(random.Random(number), commands.places(desk), [verb])
        ended = commands.say(line, desk, tmp_path / "at", LIMITS, before=results.nothing)
        found = commands.outcome(ended, tmp_path / "at")
        assert found.isdigit(), f"{found}: landscape {shlex.join(line)[:500]}\n{last_words(ended.err)}"


SPACE = ParameterSpace.box(["a", "b", "c"], -1.0, 1.0)
SINES = from_torch(lambda x: torch.sin(3 * x).sum(dim=1), SPACE)


def made_slice(path: Path) -> None:
    plane = Plane.through(SPACE, SPACE.center, ("a", "b"), resolution=12)
    sample(SINES, plane, SliceStore.create(path, plane, SPACE, identity={"objective": "sines"}))


def made_tiles(path: Path) -> None:
    """Leave the tiles of a slice as they are just before it is finished."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SliceStore, "finish", lambda *_: None)
        made_slice(path)


def made_run(path: Path) -> None:
    run = RunStore.create(path, SPACE, identity={"objective": "sines"}, budget=80)
    search(SINES, RandomSearch.on(SINES, seed=0), run, budget=70)


STORES = {"tiles": made_tiles, "finished": made_slice, "run": made_run}
OPENED = {"tiles": open_slice, "finished": open_slice, "run": lambda path: open_run(path).data}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("whole")
    for kind, make in STORES.items():
        make(folder / f"{kind}.zarr")
    return {kind: folder / ("tiles.filling.zarr" if kind == "tiles" else f"{kind}.zarr") for kind in STORES}


def said_of(dataset: xr.Dataset, name: str) -> np.ndarray[Any, Any]:
    """Return a variable's values with those points blank that have no status."""
    values = dataset[name].to_numpy()
    there = dataset["status"].to_numpy() > 0
    return np.where(there.reshape(there.shape + (1,) * (values.ndim - there.ndim)), values, 0)


def opened(kind: str, path: Path) -> tuple[xr.Dataset | None, str]:
    try:
        return OPENED[kind](path), ""
    except ValueError as error:
        return None, str(error)


@pytest.mark.parametrize("kind", STORES)
def test_a_damaged_store_is_refused_by_name_or_read_right(kind: str, whole: dict[str, Path], tmp_path: Path) -> None:
    """What is there has its values, places and status; what is lost is missing, and never a wrong number."""
    right, path = OPENED[kind](whole[kind]), tmp_path / whole[kind].name
    for number in range(50):
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(whole[kind], path)
        chance = random.Random(number)
        file = chance.choice(files(path))
        done = f"{number}: {damage(chance, file)} {file.relative_to(path)}"
        found, said = opened(kind, path)
        if found is None:
            assert str(path) in said, done
            continue
        rows = {name: slice(0, size) for name, size in found.sizes.items() if name == "evaluation"}
        whole_part = right.isel(rows).where(found["status"] > 0, 0)
        for name in ("loss", "grad", "status", *(["x"] if kind == "run" else [])):
            np.testing.assert_array_equal(said_of(found, name), whole_part[name].transpose(*found[name].dims), done)
        for name in ("u", "v") if kind != "run" else ():
            np.testing.assert_array_equal(found[name], right[name], done)


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Trial:
    return Trial(tmp_path_factory.mktemp("trial"), LIMITS)


@pytest.mark.parametrize("kind", QUICK)
def test_verbs_that_meet_a_damaged_file_refuse_it_or_make_it_right(kind: str, trial: Trial) -> None:
    for case in trial.case(kind, random.Random(kind)):
        assert case.outcome not in BAD, case


@pytest.mark.parametrize(("kind", "disk"), [
    ("slice", full_disks.Disk(files=12)),
    ("run", full_disks.Disk(space=40_000)),
    ("pairs", full_disks.Disk(files=3)),
], ids=lambda value: value if isinstance(value, str) else "")  # fmt: skip
def test_what_met_a_full_disk_goes_on_where_there_is_room(kind: str, disk: full_disks.Disk, tmp_path: Path) -> None:
    job = next(full_disks.jobs([kind]))
    (case,) = full_disks.Disks(tmp_path, LIMITS).cases(job, [disk])
    assert case.outcome in full_disks.GOOD, case
