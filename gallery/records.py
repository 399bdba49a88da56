"""The records that are computed for a figure and shown on its page: which film is of what."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

from ..landscapes.objective import Status
from ..landscapes.plain import number, optional, text
from ..landscapes.storage.files import write_json
from ..landscapes.storage.records import read_json, reading, sign, verify, write_record
from .files import REMAKE, episode_name

T = TypeVar("T")


@dataclass(frozen=True)
class SweepRecord:
    """Say what a sweep's film shows, as `sweep.json` beside it has it: how it was sampled, and what moves."""

    over: str
    fidelity: str
    frames: int
    resolution: Sequence[int]
    label: str
    low: float
    high: float
    command: str

    @classmethod
    def read(cls, path: Path) -> SweepRecord:
        """Read a record. Raises ValueError, naming the file, where it is not what `write` wrote."""
        with reading(path, REMAKE.format("sweeps")):
            found = read_json(path)
            if not text(found["label"]):
                raise ValueError("its label is empty")
            return cls(
                over=text(found["over"]),
                fidelity=text(found["fidelity"]),
                frames=int(number(found["frames"])),
                resolution=[int(number(side)) for side in found["resolution"]],
                label=found["label"],
                low=number(found["low"]),
                high=number(found["high"]),
                command=text(found["command"]),
            )

    def write(self, path: Path) -> None:
        """Write what `read` reads."""
        write_record(path, asdict(self))


@dataclass(frozen=True)
class Node:
    """A node whose episode is shown, and why."""

    row: int
    column: int
    why: str
    loss: float | None
    status: str

    @property
    def name(self) -> str:
        """The name of its files, without their ending."""
        return episode_name(self.row, self.column)


def write_nodes(path: Path, nodes: Sequence[Node]) -> None:
    """Write which nodes' episodes are shown."""
    write_json(path, [sign(asdict(node)) for node in nodes])


def read_nodes(path: Path) -> list[Node]:
    """Read which nodes' episodes are shown.

    Raises ValueError, naming the file, where it is not what `write_nodes` wrote.
    """
    with reading(path, REMAKE.format("episodes")):
        return [_node(one) for one in json.loads(path.read_text())]


def _node(found: object) -> Node:
    record = verify(found)
    row, column = int(record["row"]), int(record["column"])
    if min(row, column) < 0:
        raise ValueError(f"a place is counted from 0; got {min(row, column)}")
    return Node(row, column, text(record["why"]), optional(number, record["loss"]), Status[record["status"]].name)


def read_if_sound(read: Callable[[Path], T], path: Path) -> T | None:
    """Return what a function reads of a file, None where the file is not there or damaged."""
    try:
        return read(path)
    except (OSError, TypeError, ValueError):
        return None
