"""Slices on disk for tests of them: a store with known values, filled or finished."""

from pathlib import Path
from zipfile import ZipFile

import torch

from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.paths import archive_path, folder_path
from gradscape.landscapes.storage.store import SliceStore

SPACE = ParameterSpace(
    ("x", "y", "z"), -torch.ones(3).double(), torch.tensor([1.0, 2.0, 3.0]).double(), ("m", "m/s", "")
)
PLANE = Plane.through(SPACE, SPACE.center, ["x", "y"], resolution=(10, 8))
IDENTITY = {"objective": "wave", "options": {"steps": 3, "tilt": (0.1, 0.2)}, "device": "cpu"}


def make(path: Path, **changes) -> SliceStore:
    settings = {"plane": PLANE, "space": SPACE, "identity": IDENTITY, "provenance": {"command": "x", "loss_unit": "J"}}
    return SliceStore.open_or_create(path, **settings | changes)


def evaluated(x: torch.Tensor) -> Evaluation:
    return Evaluation.from_results(torch.where(x[:, 0] > 0.8, torch.nan, x.sum(dim=1)), 2 * x)


def fill(store: SliceStore, tiles=None) -> SliceStore:
    for tile in store.tiles() if tiles is None else tiles:
        store.write(tile, evaluated(store.points(tile)))
    return store


def finished(path: Path, **changes) -> SliceStore:
    store = fill(make(path, **changes))
    store.finish(store.dataset())
    return store


def unpacked(path: Path) -> Path:
    """Make the folder of a finished slice that earlier versions left, and return it."""
    with ZipFile(archive_path(path)) as archive:
        archive.extractall(folder_path(path))
    archive_path(path).unlink()
    return folder_path(path)


def break_chunk(path: Path, name: str) -> None:
    """Damage a chunk of a finished slice, by its name in the store."""
    with ZipFile(archive_path(path)) as archive:
        chunk = archive.read(name)
    content = bytearray(archive_path(path).read_bytes())
    content[content.index(chunk) + len(chunk) // 2] ^= 1
    archive_path(path).write_bytes(bytes(content))


def chunks(place: Path) -> list[Path]:
    """Return the files of a slice's samples: of its tiles, or of its chunks in a folder of a finished one."""
    parts = (place / name / "c" for name in ("loss", "grad", "status", "checksum"))
    return sorted(file for part in (*parts, place / "pieces") for file in part.rglob("*") if file.is_file())
