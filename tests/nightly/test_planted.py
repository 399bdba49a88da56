"""Nothing that is read from a result's folder is run: somebody else's result is data, whatever is in it."""

import contextlib
import io
import json
import os
import pickle
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numcodecs.pickles
import numpy as np
import pytest
import zarr

from gradscape import Environment
from gradscape.cli import verbs

from ..kinds import KINDS, copy, files, say, whole

READ_AS_TEXT = {".json", ".md", ".csv", ".js", ".html", ".toml", ".css"}
SHOWN = {".png", ".mp4", ".webp", ".rrd", ".gltf", ".pdf", ".svg"}  # and never read
SPRUNG = "sprung"  # the folder that appears where what was planted is run


class Trap:
    """What makes a folder when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.makedirs, (SPRUNG, 0o777, True)


def archived() -> bytes:
    """An archive of arrays that can only be unpickled."""
    traps = np.empty(2, dtype=object)
    traps[:] = [Trap(), Trap()]
    kept = io.BytesIO()
    np.savez(kept, outline=traps, loss=traps, settings=traps)
    return kept.getvalue()


def old_store(place: Path) -> None:
    """Replace a zarr store by one of format 2, which says the same of itself, and whose arrays are pickled."""
    attributes = json.loads((place / "zarr.json").read_text())["attributes"]
    names = [folder.name for folder in place.iterdir() if folder.is_dir()]
    shutil.rmtree(place)
    group = zarr.create_group(place, zarr_format=2)
    group.attrs.update(attributes)
    for name in names:
        group.create_array(name, shape=(2,), chunks=(2,), dtype="float64")
        about = json.loads((place / name / ".zarray").read_text())
        about |= {"dtype": "|O", "filters": [{"id": "vlen-utf8"}, {"id": "pickle"}], "compressor": None}
        about |= {"fill_value": ""}
        (place / name / ".zarray").write_text(json.dumps(about))
        (place / name / "0").write_bytes(pickle.dumps(Trap()))


def planted(folder: Path) -> Iterator[Path]:
    """Plant a trap in a file of each kind that is no text, chunk or picture, one after another, and in stores."""
    seen = set[str]()
    for file in [file for file in files(folder) if not file.name.isdecimal()]:
        if file.name == "state" and "state" not in seen:
            head, _, _ = file.read_bytes().partition(b"\n")
            yield from replaced(file, head + b"\n" + pickle.dumps(Trap()))
        if (kind := file.suffix or file.name) not in {*seen, *READ_AS_TEXT, *SHOWN}:
            seen.add(kind)
            yield from replaced(file, archived() if kind in (".npz", ".zip") else pickle.dumps(Trap()))
    for store in [path for path in sorted(folder.rglob("*.zarr")) if (path / "zarr.json").exists()]:
        if store.name not in seen:
            seen.add(store.name)
            kept = store.with_name("kept")
            shutil.copytree(store, kept)
            old_store(store)
            yield store
            shutil.rmtree(store)
            kept.rename(store)


def replaced(file: Path, content: bytes) -> Iterator[Path]:
    kept = file.read_bytes()
    file.write_bytes(content)
    yield file
    file.write_bytes(kept)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_that_is_read_is_run(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    folder = copy(whole(kind))
    monkeypatch.setattr(Environment, "evaluate", stopped)
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True)  # as it was in earlier versions
    for trap in planted(folder / KINDS[kind].where):
        place = copy(folder)
        for command in (*KINDS[kind].reads, KINDS[kind].make):
            said = say(command, place)
            assert not (place / SPRUNG).exists(), (trap, command, said)
        shutil.rmtree(place)


@pytest.mark.nightly
def test_a_trap_is_sprung_by_who_unpickles_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True)
    place = tmp_path / "store.zarr"
    zarr.create_group(place).create_array("loss", shape=(2,), dtype="float64")
    old_store(place)
    with contextlib.suppress(Exception):
        zarr.open_group(place)["loss"][...]  # type: ignore[index]
    assert Path(SPRUNG).exists()


def test_every_verb_that_reads_a_folder_is_tried() -> None:
    tried = {command.split()[0] for kind in KINDS.values() for command in (kind.make, *kind.reads)}
    folders = {name.split()[0] for name, verb in verbs().items() if any("--out" in one.names for one in verb.options)}
    assert tried >= folders
