"""Files and folders that appear whole or not at all.

Work in progress is in a hidden folder next to its final path; its process holds a lock on it. So anyone can recognise
the remains of a killed process at once, without a clock: nobody holds the lock.
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
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TypeGuard

from ..identity import StoreError

MAKING = re.compile(r"\..+\.[0-9a-f]{32}\.making", re.DOTALL)  # the hidden folder of what is being made


def resolve(path: str | Path) -> Path:
    """Return an absolute path without links; raises ValueError for links that lead in a circle."""
    try:
        os.stat(path)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise ValueError(f"{path} leads in a circle of symbolic links; use another path") from None
    return Path(os.path.realpath(path))


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents, at any depth: `mkdir` calls itself for each."""
    if not folder.is_dir():  # which raises OSError for a path that is too long, before any of it is made
        for one in (*reversed(folder.parents), folder):
            one.mkdir(exist_ok=True)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path to write to, and move the result to `path` at the end.

    An empty folder there, which a damaged disk can leave instead of a file, is replaced; one with files is not.
    """
    with _hidden_folder(path) as folder:
        partial = folder / f"{path.name}.partial"
        yield partial
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        os.replace(partial, path)


def visible_files(folder: Path) -> list[Path]:
    """Return the content of a folder without hidden files: a killed process can leave unfinished work.

    Raises ValueError where a file is in its place.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file, not a folder; use another path")
    return [path for path in folder.iterdir() if not path.name.startswith(".")] if folder.exists() else []


def print_width(name: str, picture: str) -> float | None:
    """Return the page width [mm] for which a file of this name is a print of a picture, None if it is none."""
    found = re.fullmatch(rf"{re.escape(Path(picture).stem)}-(\d+(?:\.\d+)?)mm\.(?:pdf|svg)", name)
    return float(found[1]) if found else None


def other_files(folder: Path, ours: Collection[str], picture: str) -> list[Path]:
    """Return the content of a folder except files of our names and prints of a picture."""
    return [file for file in visible_files(folder) if not _is_ours(file, ours, picture)]


def clear(folder: Path, ours: Collection[str], picture: str) -> None:
    """Remove files of our names and prints of a picture from a folder."""
    for file in visible_files(folder):
        if _is_ours(file, ours, picture):
            file.unlink()


def _is_ours(file: Path, ours: Collection[str], picture: str) -> bool:
    return file.name in ours or print_width(file.name, picture) is not None


def write_json(path: Path, record: object) -> None:
    """Write a JSON file; its numbers are as Python writes them, including NaN and Infinity."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(record, indent=1) + "\n")


@contextmanager
def placing(path: Path, *, overwrite: bool, check: Callable[[], None] = lambda: None) -> Iterator[Path]:
    """Give a temporary folder to build in, and rename it to `path` at the end, unless that is taken by then.

    `check` is called just before an existing folder is replaced, and can refuse that. Raises FileExistsError where
    another process has made it meanwhile, and any error of `check`.
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
    """Remove a folder at once, if it exists: after a kill, nothing is left under its name."""
    _clear_left(folder)
    if folder.exists():
        with _hidden_folder(folder) as gone, contextlib.suppress(FileNotFoundError):  # another process was quicker
            os.rename(folder, gone / folder.name)


def tidy(folder: Path) -> None:
    """Remove the unfinished work of killed processes in a folder, at any depth; that of running ones stays."""
    for parent, names, _ in os.walk(folder):
        for name in [name for name in names if MAKING.fullmatch(name)]:
            names.remove(name)
            _clear(Path(parent, name))


@contextmanager
def _hidden_folder(path: Path) -> Iterator[Path]:
    """Give a hidden folder next to `path`, locked during use; clear away unlocked ones."""
    make_folder(path.parent)
    _clear_left(path)
    folder, lock = _hold(path)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _hold(path: Path) -> tuple[Path, int]:
    """Make a hidden folder next to `path` and lock it; return it with the descriptor of the lock."""
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
    """Remove an unlocked hidden folder."""
    with contextlib.suppress(OSError):
        lock = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)


Ours = Callable[[str], object]  # whether a file is of ours, by its path in the folder, with slashes
LISTED_FILES = 3  # files that a refusal names
HALF = r"\.[0-9a-f]{32}\.partial"  # the end of the name of a file that zarr has not written whole


def store_files(arrays: Iterable[str], *others: str) -> Ours:
    """Return the pattern for the files of a zarr store with these arrays, and `others` in its folder."""
    names = "|".join(map(re.escape, arrays))
    root, own = rf"zarr(?:\.json|{HALF})", "".join(f"|{re.escape(one)}" for one in others)
    return re.compile(rf"{root}|(?:{names})/(?:{root}|c(?:/\d+)*(?:{HALF})?){own}").fullmatch


def foreign_files(folder: Path, ours: Ours) -> Iterator[str]:
    """Yield the files of a folder, at any depth, that are not `ours`, by their paths in it.

    A link is ours only if it leads nowhere: a damaged disk can leave one instead of a file of ours.
    """
    for path, name in _files(folder):
        leads_somewhere = path.is_symlink() and path.exists()
        if leads_somewhere or not (ours(name) or any(map(MAKING.fullmatch, Path(name).parts))):
            yield name


def check_ours(folder: Path, ours: Ours, what: str) -> None:
    """Raise ValueError, naming some, where a folder to be replaced has files that do not belong to it."""
    others = list(islice(foreign_files(folder, ours), LISTED_FILES + 1))
    if others:
        more = " and more" if len(others) > LISTED_FILES else ""
        raise ValueError(
            f"{folder} is not replaced, because it has files that do not belong to {what}: "
            f"{', '.join(others[:LISTED_FILES])}{more}; move them away, or write elsewhere with --out"
        )


def refuse_others(folder: Path, strange: Iterable[Path], what: str) -> None:
    """Raise ValueError, naming some, where a folder for results has files of something else."""
    names = sorted(path.name for path in strange)
    if names:
        more = f" and {len(names) - LISTED_FILES} more" if len(names) > LISTED_FILES else ""
        raise ValueError(
            f"{folder} contains files that are not part of this {what}: {', '.join(names[:LISTED_FILES])}{more}; give "
            "--out a new or an empty folder"
        )


def lost_root(store: Path, ours: Ours) -> bool:
    """Whether a zarr store has lost the file that identifies it, and everything else in it is ours."""
    try:
        said = json.loads((store / "zarr.json").read_text())
    except (OSError, ValueError):
        said = None
    known = isinstance(said, dict) and isinstance(said.get("attributes"), dict)
    return not known and (store / "status").is_dir() and not any(foreign_files(store, ours))


def remove(folder: Path, ours: Ours) -> None:
    """Remove a folder, at once if everything in it is ours; foreign files stay."""
    if not any(foreign_files(folder, ours)):
        discard(folder)
        return
    for path, name in _files(folder):
        if ours(name) and not path.is_symlink():
            path.unlink(missing_ok=True)


def clear_halves(folder: Path) -> None:
    """Remove from a store without other writers the files that zarr had not finished when a process was killed."""
    for path, name in _files(folder):
        if re.search(rf"{HALF}$", name):
            path.unlink(missing_ok=True)


def _files(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield the files of a folder at any depth, with their paths in it, including links to folders.

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


@contextmanager
def holding(folder: Path, say: Callable[[str], object] = lambda text: None) -> Iterator[bool]:
    """Lock a folder, and return whether that took waiting; a message announces the wait."""
    waited = False
    while True:
        lock = _open(folder)
        try:
            if not _lock(lock, wait=False):
                if not waited:
                    say(f"another process is filling {folder}; waiting for it")
                waited = True
                _lock(lock, wait=True)
            if _is_in_place(folder, lock):
                yield waited
                return
        finally:
            os.close(lock)


def check_free(folder: Path) -> None:
    """Raise StoreError where another process fills a folder to be replaced."""
    if not folder.is_dir():
        return
    lock = _open(folder)
    try:
        if not _lock(lock, wait=False):
            raise StoreError(
                f"{folder} is being filled by another process, so it is not started again; wait for that process or "
                "stop it, or write elsewhere with --out"
            )
    finally:
        os.close(lock)


def _open(folder: Path) -> int:
    make_folder(folder)
    return os.open(folder, os.O_RDONLY)


def _lock(lock: int, *, wait: bool) -> bool:
    """Take a lock, and return whether it is taken; Ctrl-C ends the waiting."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def _is_in_place(folder: Path, lock: int) -> bool:
    """Whether the folder is still the opened one: another process can have removed it."""
    with contextlib.suppress(FileNotFoundError):
        return folder.stat().st_ino == os.fstat(lock).st_ino
    return False


CODES = (errno.ENOSPC, errno.EDQUOT)
FULL_DISK_WORDS = "No space left on device"  # of a program that writes for us, such as ffmpeg


class _SaidError(OSError):
    """A system error with its own message."""

    def __str__(self) -> str:
        return str(self.strerror)


class DiskFullError(_SaidError):
    """A disk is full; the message says what is kept."""


class UnwritableError(_SaidError):
    """A folder chosen by the system cannot be written to; the message says how to move it."""


@contextmanager
def moved_by(variable: str, what: str) -> Iterator[None]:
    """Raise UnwritableError where `what` cannot be stored, with the environment variable that moves its folder."""
    try:
        yield
    except OSError as error:
        if is_full(error) or error.filename is None or error.strerror is None:
            raise
        why = f"{what} cannot be stored at {error.filename} ({error.strerror.lower()})"
        said = f"{why}; set the environment variable {variable} to a writable folder"
        raise UnwritableError(error.errno, said) from error


def is_full(error: BaseException) -> TypeGuard[OSError]:
    """Whether an error comes from a full disk or quota."""
    return isinstance(error, OSError) and (error.errno in CODES or FULL_DISK_WORDS in str(error))


def full(error: OSError, kept: str) -> DiskFullError:
    """Return the error for a full disk; `kept` describes what is kept."""
    said = f"the disk is full; {kept}: free some space, and the same command continues from there"
    return DiskFullError(error.errno or errno.ENOSPC, said)


@contextmanager
def until_full(kept: Callable[[], str]) -> Iterator[None]:
    """Report what is `kept` when the disk is full, unless that is already reported.

    Raises DiskFullError then; every other error passes.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, DiskFullError) or not is_full(error):
            raise
        raise full(error, kept()) from error
