"""Ownership of a folder's files: a folder is replaced or removed only where all of them are of ours."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path

from .files import MAKING, discard

Ours = Callable[[str], object]  # whether a file is of ours, by its path in the folder, with slashes
LISTED_FILES = 3  # files that a refusal names
HALF = r"\.[0-9a-f]{32}\.partial"  # the end of the name of a file that zarr has not written whole


def store_files(arrays: Iterable[str], *others: str) -> Ours:
    """Return what tells the files of a zarr store of these arrays, and `others` in its folder, from all else."""
    names = "|".join(map(re.escape, arrays))
    root, own = rf"zarr(?:\.json|{HALF})", "".join(f"|{re.escape(one)}" for one in others)
    return re.compile(rf"{root}|(?:{names})/(?:{root}|c(?:/\d+)*(?:{HALF})?){own}").fullmatch


def foreign_files(folder: Path, ours: Ours) -> Iterator[str]:
    """Yield the files of a folder, at any depth, that are not `ours`, by their paths in it; a link never is."""
    for path, name in _files(folder):
        if path.is_symlink() or not (ours(name) or any(map(MAKING.fullmatch, Path(name).parts))):
            yield name


def check_ours(folder: Path, ours: Ours, what: str) -> None:
    """Raise ValueError, naming some, where a folder that is to be replaced holds files that no such thing does."""
    others = list(islice(foreign_files(folder, ours), LISTED_FILES + 1))
    if others:
        more = " and more" if len(others) > LISTED_FILES else ""
        raise ValueError(
            f"{folder} is not replaced, as it holds files that are not of {what}: "
            f"{', '.join(others[:LISTED_FILES])}{more}; move them away, or write elsewhere with --out"
        )


def refuse_others(folder: Path, strange: Iterable[Path], what: str) -> None:
    """Raise ValueError, naming some, where a folder that results are to go to holds files of something else."""
    names = sorted(path.name for path in strange)
    if names:
        more = f" and {len(names) - LISTED_FILES} more" if len(names) > LISTED_FILES else ""
        raise ValueError(
            f"{folder} holds other files and no {what}: {', '.join(names[:LISTED_FILES])}{more}; "
            "give --out a new or an empty folder"
        )


def has_lost_root(store: Path, ours: Ours) -> bool:
    """Whether a zarr store has lost the file that says what it is, and everything else in it is of ours."""
    try:
        said = json.loads((store / "zarr.json").read_text())
    except (OSError, ValueError):
        said = None
    known = isinstance(said, dict) and isinstance(said.get("attributes"), dict)
    return not known and (store / "status").is_dir() and not any(foreign_files(store, ours))


def remove(folder: Path, ours: Ours) -> None:
    """Remove a folder, at once where everything in it is of ours; what is not stays where it is."""
    if not any(foreign_files(folder, ours)):
        discard(folder)
        return
    for path, name in _files(folder):
        if ours(name) and not path.is_symlink():
            path.unlink(missing_ok=True)


def clear_halves(folder: Path) -> None:
    """Remove from a store that nobody else writes to what zarr had not written whole when a process was killed."""
    for path, name in _files(folder):
        if re.search(rf"{HALF}$", name):
            path.unlink(missing_ok=True)


def _files(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield the files of a folder at any depth, with their paths in it; a link to a folder is one of them.

    A folder that another process removes meanwhile has none.
    """

    def unreadable(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):
            raise error

    for parent, folders, files in os.walk(folder, onerror=unreadable):
        folders.sort()
        for name in sorted([*files, *(name for name in folders if Path(parent, name).is_symlink())]):
            path = Path(parent, name)
            yield path, path.relative_to(folder).as_posix()
