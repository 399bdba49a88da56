"""Holding a folder: of several processes that would fill it, one does, and the others wait or are refused.

The lock is of the folder itself and goes with the process that holds it, however that ends. Where a file system has no
locks, nobody holds anything.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..identity import StoreError
from .files import make_folder


@contextmanager
def holding(folder: Path, say: Callable[[str], object] = lambda text: None) -> Iterator[bool]:
    """Hold a folder, and give whether it had to be waited for; where another process holds it, that is said first."""
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
    """Raise StoreError where another process fills a folder that is to be begun anew."""
    if not folder.is_dir():
        return
    lock = _open(folder)
    try:
        if not _lock(lock, wait=False):
            raise StoreError(
                f"{folder} is being filled by another process, so it is not begun anew; wait for it or stop it, or "
                "write elsewhere with --out"
            )
    finally:
        os.close(lock)


def _open(folder: Path) -> int:
    make_folder(folder)
    return os.open(folder, os.O_RDONLY)


def _lock(lock: int, *, wait: bool) -> bool:
    """Take a lock, and say whether it is taken; Ctrl-C ends the waiting."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def _is_in_place(folder: Path, lock: int) -> bool:
    """Whether the folder is still the one that was opened: another process may have removed it meanwhile."""
    with contextlib.suppress(FileNotFoundError):
        return folder.stat().st_ino == os.fstat(lock).st_ino
    return False
