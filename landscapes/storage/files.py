"""Files and folders that appear whole or not at all.

What is being made lies in a hidden folder beside its place, which its maker holds by a lock as long as it lives. So
what a process that was killed has left is known at once, by anyone and on any clock: nobody holds it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import json
import os
import re
import shutil
import uuid
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

MAKING = re.compile(r"\..+\.[0-9a-f]{32}\.making", re.DOTALL)  # the hidden folder of what is being made


def resolve(path: str | Path) -> Path:
    """Return a path from the root, without links; raises ValueError for links that lead in a circle."""
    try:
        os.stat(path)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise ValueError(f"{path} leads in a circle, by symbolic links; give another path") from None
    return Path(os.path.realpath(path))


def make_folder(folder: Path) -> None:
    """Make a folder and those it is in, where they are missing, however deep: `mkdir` calls itself for each."""
    if not folder.is_dir():  # which raises OSError for a path that is too long, before any of it is made
        for one in (*reversed(folder.parents), folder):
            one.mkdir(exist_ok=True)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path of its own to write to, and put what was written in the place of `path` at the end."""
    with _hidden_folder(path) as folder:
        partial = folder / f"{path.name}.partial"
        yield partial
        os.replace(partial, path)


def visible_files(folder: Path) -> list[Path]:
    """Return what a folder holds, but for hidden files: a process that was killed may have left what it was making.

    Raises ValueError where a file is in its place.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file and no folder; give another path")
    return [path for path in folder.iterdir() if not path.name.startswith(".")] if folder.exists() else []


def print_width(name: str, picture: str) -> float | None:
    """Return for how wide a page [mm] a file of this name is a print of a picture, None where it is none."""
    found = re.fullmatch(rf"{re.escape(Path(picture).stem)}-(\d+(?:\.\d+)?)mm\.(?:pdf|svg)", name)
    return float(found[1]) if found else None


def other_files(folder: Path, ours: Collection[str], picture: str) -> list[Path]:
    """Return what a folder holds beside files of our names and prints of a picture."""
    return [file for file in visible_files(folder) if not _is_ours(file, ours, picture)]


def clear(folder: Path, ours: Collection[str], picture: str) -> None:
    """Remove files of our names and prints of a picture from a folder."""
    for file in visible_files(folder):
        if _is_ours(file, ours, picture):
            file.unlink()


def _is_ours(file: Path, ours: Collection[str], picture: str) -> bool:
    return file.name in ours or print_width(file.name, picture) is not None


def write_json(path: Path, record: object) -> None:
    """Write a JSON file; its numbers are as Python writes them, NaN and Infinity included."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(record, indent=1) + "\n")


@contextmanager
def placing(path: Path, *, overwrite: bool, check: Callable[[], None] = lambda: None) -> Iterator[Path]:
    """Give a folder's path of its own to build at, and rename it to `path` at the end, unless that is taken by then.

    `check` is called just before a folder that is there is replaced, to refuse that.

    Raises FileExistsError where another process has made it meanwhile, and what `check` raises.
    """
    with _hidden_folder(path) as folder:
        new, old = folder / f"{path.name}.partial", folder / f"{path.name}.replaced"
        yield new
        if overwrite and path.exists():
            check()
            os.rename(path, old)
        try:
            os.rename(new, path)
        except OSError as error:
            if path.exists():
                said = f"{path} was made by another process meanwhile; run the command again"
                raise FileExistsError(said) from None
            if old.exists():
                os.rename(old, path)
            raise error from None


def discard(folder: Path) -> None:
    """Remove a folder at once, if it is there: killed in the middle of it, nothing is left under its name."""
    _clear_left(folder)
    if folder.exists():
        with _hidden_folder(folder) as gone, contextlib.suppress(FileNotFoundError):  # another process was quicker
            os.rename(folder, gone / folder.name)


def tidy(folder: Path) -> None:
    """Remove what processes that were killed were making in a folder, at any depth; what a living one makes stays."""
    for parent, names, _ in os.walk(folder):
        for name in [name for name in names if MAKING.fullmatch(name)]:
            names.remove(name)
            _clear(Path(parent, name))


@contextmanager
def _hidden_folder(path: Path) -> Iterator[Path]:
    """Give a hidden folder beside `path`, held while something is made in it; clear away those that nobody holds."""
    make_folder(path.parent)
    _clear_left(path)
    folder, lock = _hold(path)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _hold(path: Path) -> tuple[Path, int]:
    """Make a hidden folder beside `path` and hold it; return it with the descriptor that does."""
    while True:
        folder = path.with_name(f".{path.name}.{uuid.uuid4().hex}.making")
        folder.mkdir()
        with contextlib.suppress(FileNotFoundError):  # somebody has cleared it away before it was held
            lock = os.open(folder, os.O_RDONLY)
            with contextlib.suppress(OSError):  # a file system without locks: nobody can hold it, so nobody clears it
                fcntl.flock(lock, fcntl.LOCK_EX)
            if folder.exists():  # its name is like no other, so it is this one
                return folder, lock
            os.close(lock)


def _clear_left(path: Path) -> None:
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.making"):
        if MAKING.fullmatch(left.name):
            _clear(left)


def _clear(folder: Path) -> None:
    """Remove a hidden folder that nobody holds."""
    with contextlib.suppress(OSError):
        lock = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)
