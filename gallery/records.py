"""The records that a figure's page shows, and the searches drawn over its slice."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from zipfile import ZipFile

import xarray as xr
from zarr.storage import ZipStore

from ..landscapes.convert import from_json, to_json
from ..landscapes.identity import MODEL_VERSION
from ..landscapes.objective import Status
from ..landscapes.storage.arrays import COMPACT_CODECS
from ..landscapes.storage.files import replacing, write_json
from ..landscapes.storage.records import read_json, reading, sign, verify
from ..optim.runs.store import COLUMNS
from .files import COMPANION_PICTURE, COMPANIONS, REMAKE, SWEEP_FILM, SWEEP_RECORD, episode_name

T = TypeVar("T")


@dataclass(frozen=True)
class SweepRecord:
    """The record `sweep.json` of a sweep's film: how it was sampled, and which value changes."""

    over: str
    fidelity: str
    frames: int
    resolution: tuple[int, ...]
    label: str
    low: float
    high: float
    command: str

    def __post_init__(self) -> None:
        if not self.label:
            raise ValueError("its label is empty")


def read_sweep(folder: Path) -> SweepRecord | None:
    """Return the record of a sweep's film, or None if the film or the record is missing."""
    path = folder / SWEEP_RECORD
    if not path.exists() or not (folder / SWEEP_FILM).exists():
        return None
    with reading(path, REMAKE.format("sweeps")):
        return from_json(SweepRecord, read_json(path))


@dataclass(frozen=True)
class Companion:
    """A companion of a figure's slice: its base point, the range of its losses, and the share of failed episodes.

    The ends of the range are None if all episodes failed.
    """

    through: str
    lowest: float | None
    highest: float | None
    failed: float


def read_companions(folder: Path) -> list[Companion]:
    """Return the companions of a figure's slice; the list is empty if none were made."""
    path = folder / COMPANIONS
    if not path.exists() or not (folder / COMPANION_PICTURE).exists():
        return []
    with reading(path, REMAKE.format("companions")):
        return from_json(list[Companion], read_json(path)["slices"])


@dataclass(frozen=True)
class Node:
    """A node whose episode is shown, and why."""

    row: int
    column: int
    why: str
    loss: float | None
    status: str

    def __post_init__(self) -> None:
        if min(self.row, self.column) < 0:
            raise ValueError(f"row and column count from 0; got {min(self.row, self.column)}")
        Status[self.status]  # a KeyError where there is no such status

    @property
    def name(self) -> str:
        """The name of its files, without the ending."""
        return episode_name(self.row, self.column)


def write_nodes(path: Path, nodes: Sequence[Node]) -> None:
    """Write the nodes whose episodes are shown."""
    write_json(path, [sign(to_json(node)) for node in nodes])


def read_nodes(path: Path) -> list[Node]:
    """Read the nodes whose episodes are shown.

    Raises ValueError, naming the file, if it is not one of `write_nodes`.
    """
    with reading(path, REMAKE.format("episodes")):
        return [from_json(Node, verify(one)) for one in json.loads(path.read_text())]


def save_run(table: xr.Dataset, path: Path) -> None:
    """Write a run's table as one file, whole or not at all."""
    numbers = [str(name) for name, column in table.variables.items() if column.dtype.kind in "fi"]
    encoding = {name: {"compressors": COMPACT_CODECS, "chunks": table[name].shape} for name in numbers}
    with replacing(path) as partial, ZipStore(partial, mode="w") as store, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's specification has no strings yet
        table.to_zarr(store, encoding=encoding, zarr_format=3, consolidated=False)


def open_run(path: Path) -> xr.Dataset:
    """Read a run's table. Raises ValueError, naming the file, if it is not one of `save_run`."""
    with reading(path, REMAKE.format("searches")):
        with ZipFile(path) as packed:
            if torn := packed.testzip():  # a chunk that is not found would be one of nothing but its fill value
                raise ValueError(f"its part {torn} is damaged")
        with ZipStore(path, mode="r") as store:
            how: Any = {"mask_and_scale": False, "decode_times": False}
            table: xr.Dataset = xr.open_zarr(store, zarr_format=3, consolidated=False, **how).load()
        if lost := COLUMNS.keys() - table.variables.keys():
            raise ValueError(f"it lacks {', '.join(sorted(lost))}")
    return table


def searched(run: Mapping[str, Any], slice_: Mapping[str, Any]) -> bool:
    """Whether a run searched the scene of a slice, with the same model version.

    Only options that both of them record are compared.
    """
    ours, theirs = run.get("options", {}), slice_.get("options", {})
    shared = set(ours) & set(theirs)
    known = ("objective", "parameters", MODEL_VERSION)
    return all(run.get(name) == slice_.get(name) for name in known) and all(
        ours[name] == theirs[name] for name in shared
    )


def read_if_sound(read: Callable[[Path], T], path: Path) -> T | None:
    """Read a file with a function, or return None if the file is missing or damaged."""
    try:
        return read(path)
    except (OSError, TypeError, ValueError):
        return None
