"""The slices under a folder as a table, from the `summary.json` of each, without opening a slice.

The table is a file of SQLite in that folder, and every read brings it up to date. Summaries that are new, or have
another size, time or inode than before, are read, and rows of summaries that are gone are removed. So any process or
user can add, sample again, move and remove slices, and delete the file. If it cannot be written, or another process
writes it for a long time, the table is made in memory.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..landscapes.convert import from_json
from ..landscapes.storage.paths import FILLING, FOLDER, slice_places
from .folder import SLICE_STORE, SUMMARY
from .slice import SliceSummary

if TYPE_CHECKING:
    import pandas as pd

TABLE = ".slices.sqlite"
WAIT_SECONDS = 30.0  # for another process that writes the table
AT_ONCE = 10_000  # summaries read between two writes
PLACES = {place.name for place in slice_places(Path(SLICE_STORE))}  # names of a slice in its folder
SUMMARISED, DAMAGED, BARE, OTHER = "slice", "damaged", "bare", "other"  # a folder: with what summary, or none

COLUMNS: Mapping[str, Callable[[SliceSummary], Any]] = {
    "env": lambda one: one.env,
    "dims": lambda one: ", ".join(one.dims),
    "fidelity": lambda one: one.fidelity,
    "device": lambda one: one.device,
    "options": lambda one: json.dumps(one.options or {}, sort_keys=True),
    "resolution": lambda one: " x ".join(map(str, one.resolution)),
    "samples": lambda one: math.prod(one.resolution),
    "gradients_every": lambda one: one.gradients_every if one.gradients else 0,
    "episodes": lambda one: one.episodes,
    "seconds": lambda one: one.seconds,
    "ok": lambda one: one.status["ok"],
    "failed": lambda one: sum(one.status[kind] for kind in ("missing", "nonfinite", "escaped", "error")),
    "interpolated": lambda one: one.status["interpolated"],
    "no_gradient": lambda one: one.status["no_gradient"],
    "lowest": lambda one: one.loss["lowest"],
    "highest": lambda one: one.loss["highest"],
    "flat": lambda one: one.flat,
    "undersampled": lambda one: one.undersampled.share.value if one.undersampled else None,
    "floor": lambda one: one.floor.share.value if one.floor else None,
    "barrier": lambda one: one.barrier,
    "error": lambda one: one.error,
    "command": lambda one: one.command,
}
SCHEMA = f"CREATE TABLE slices (folder PRIMARY KEY, stamp, kind, {', '.join(COLUMNS)}, checksum) WITHOUT ROWID"
VERSION = zlib.crc32(f"{__version__} {SCHEMA}".encode()) >> 1  # a table of another one is made again
NAME = "CAST(? AS TEXT)"  # of bytes, as names of folders need not be Unicode


@dataclass(frozen=True)
class SliceTable:
    """The slices under a folder, one row each, and the number of slice folders without a row.

    `damaged` counts folders with a summary that cannot be read. `bare` counts folders without a summary, because they
    are not finished.
    """

    folder: Path
    rows: pd.DataFrame
    damaged: int
    bare: int

    @property
    def summary(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        rows = self.rows.astype(object).where(self.rows.notna(), None)
        return {"slices": rows.to_dict("records"), "damaged": self.damaged, "bare": self.bare}


def find_slices(folder: Path, where: str | None = None) -> SliceTable:
    """Return the slices at any depth in a folder for which `where` holds.

    `where` is a condition of SQLite over the columns of the table. Folders of results are not searched further, and
    links are not followed. Raises ValueError where there is no such folder, and for what is no condition.
    """
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}; give one that contains folders of slices")
    _check(where)
    path = folder / TABLE
    try:
        return _read(path, folder, where)
    except sqlite3.DatabaseError as error:
        if not isinstance(error, sqlite3.OperationalError):  # it is damaged, and not only out of reach
            with suppress(OSError):
                path.unlink()
    try:
        return _read(":memory:", folder, where)
    except sqlite3.DatabaseError as error:
        raise ValueError(_refusal(where, error)) from error


def _check(where: str | None) -> None:
    """Raise ValueError for what is no condition over the columns of the table."""
    with closing(sqlite3.connect(":memory:")) as table:
        table.execute(SCHEMA)
        try:
            table.execute(_query(where))
        except (sqlite3.Error, sqlite3.Warning, ValueError) as error:
            raise ValueError(_refusal(where, error)) from error


def _refusal(where: str | None, error: Exception) -> str:
    return f"--where takes an SQLite condition over folder, {', '.join(COLUMNS)}; got {where!r}: {error}"


def _query(where: str | None) -> str:
    listed = f"SELECT folder, {', '.join(COLUMNS)} FROM slices WHERE kind = '{SUMMARISED}'"
    return f"SELECT * FROM ({listed}) WHERE ({where or 1}\n) ORDER BY folder"


def _read(path: str | Path, folder: Path, where: str | None) -> SliceTable:
    """Bring the table at a path up to date, and read it."""
    import pandas as pd

    with closing(sqlite3.connect(path, timeout=WAIT_SECONDS)) as table:
        table.text_factory = _text
        _prepare(table)
        _update(table, folder)
        table.execute("PRAGMA query_only = 1")
        found = table.execute(_query(where)).fetchall()
        rows = pd.DataFrame([values for _, *values in found], columns=list(COLUMNS))
        rows.insert(0, "folder", pd.Series([str(folder / name) for name, *_ in found], dtype=object))
        counts = dict(table.execute("SELECT kind, count(*) FROM slices GROUP BY kind"))
    return SliceTable(folder, rows, counts.get(DAMAGED, 0), counts.get(BARE, 0))


def _prepare(table: sqlite3.Connection) -> None:
    """Make the table where there is none of this version."""

    def is_ours() -> bool:
        return bool(table.execute("PRAGMA user_version").fetchone()[0] == VERSION)

    if not is_ours():
        with table:
            table.execute("BEGIN IMMEDIATE")
            if not is_ours():  # another process may have made it meanwhile
                table.execute("DROP TABLE IF EXISTS slices")
                table.execute(SCHEMA)
                table.execute(f"PRAGMA user_version = {VERSION}")


def _update(table: sqlite3.Connection, folder: Path) -> None:
    """Read the summaries that are new or were changed, and forget those that are gone."""
    known = dict[str, str]()
    for name, stamp, *values, checksum in table.execute("SELECT * FROM slices"):
        if checksum != _checksum([name, stamp, *values]):
            raise sqlite3.DatabaseError(f"the row of {name} is not what was written")
        known[name] = stamp
    found = dict(_stamps(str(folder)))
    if gone := known.keys() - found.keys():
        with table:
            table.executemany(f"DELETE FROM slices WHERE folder = {NAME}", ((os.fsencode(name),) for name in gone))
    changed = ((name, stamp) for name, stamp in found.items() if known.get(name) != stamp)
    put = f"INSERT OR REPLACE INTO slices VALUES ({', '.join([NAME, *'??', *('?' * len(COLUMNS)), '?'])})"
    while rows := [_row(folder, name, stamp) for name, stamp in islice(changed, AT_ONCE)]:
        with table:
            table.executemany(put, rows)


def _stamps(folder: str, name: str = ".") -> Iterator[tuple[str, str]]:
    """Yield each folder of results under one, by its path there, and a stamp of its summary, empty where it has none.

    A summary that is written again is another file, or has another time or size.
    """
    with suppress(FileNotFoundError, NotADirectoryError):
        about = os.stat(os.path.join(folder, name, SUMMARY))
        yield name, f"{about.st_mtime_ns} {about.st_size} {about.st_ino}"
        return
    with suppress(FileNotFoundError), os.scandir(os.path.join(folder, name)) as entries:
        inside = list(entries)
        if any(one.name in PLACES for one in inside):
            yield name, ""
            return
        for one in inside:
            hidden = one.name.startswith(".") or one.name.endswith((FOLDER, FILLING))
            if not hidden and one.is_dir(follow_symlinks=False):
                yield from _stamps(folder, one.name if name == "." else f"{name}/{one.name}")


def _row(folder: Path, name: str, stamp: str) -> list[Any]:
    """Return the row of a folder; a summary that changes meanwhile has another stamp the next time."""
    place, record = folder / name, dict[str, Any]()
    kind, values = OTHER if stamp else BARE, [None] * len(COLUMNS)
    try:
        if stamp:
            record = dict(json.loads((place / SUMMARY).read_bytes()))
            summary = from_json(SliceSummary, record)
            values, kind = [of(summary) for of in COLUMNS.values()], SUMMARISED
    except Exception:  # a file of any content; that of a run or a sweep is no slice's
        if "frames" not in record and any((place / one).exists() for one in PLACES):
            kind = DAMAGED
    row = [stamp, kind, *map(_storable, values)]
    return [os.fsencode(name), *row, _checksum([name, *row])]


def _storable(value: Any) -> Any:
    """Return a value as SQLite keeps it: text is Unicode there, zero has no sign, and NaN is nothing."""
    if isinstance(value, float):
        return None if math.isnan(value) else value + 0.0
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _checksum(row: Sequence[Any]) -> int:
    return zlib.crc32(repr(row).encode(errors="surrogatepass"))


def _text(content: bytes | None) -> str:
    """Return a text that SQLite reads; it has none to give where the file is cut off."""
    if content is None:
        raise sqlite3.DatabaseError("a text of the table is lost")
    return os.fsdecode(content)
