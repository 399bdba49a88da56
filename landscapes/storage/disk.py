"""Disks that take nothing: a job ends with what is kept and how to go on, or with how a folder is moved."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeGuard

CODES = (errno.ENOSPC, errno.EDQUOT)
FULL_DISK_WORDS = "No space left on device"  # of a program that writes for us, such as ffmpeg


class DiskFullError(OSError):
    """A disk is full; the message says what is kept of the job."""

    def __str__(self) -> str:
        return str(self.strerror)


class UnwritableError(OSError):
    """A folder that the system chose cannot be written to; the message says how it is moved."""

    def __str__(self) -> str:
        return str(self.strerror)


@contextmanager
def moved_by(variable: str, what: str) -> Iterator[None]:
    """Raise UnwritableError where `what` cannot be kept, which says that an environment variable moves its folder."""
    try:
        yield
    except OSError as error:
        if is_full(error) or error.filename is None or error.strerror is None:
            raise
        why = f"{what} cannot be kept at {error.filename} ({error.strerror.lower()})"
        said = f"{why}; set the environment variable {variable} to a folder that can be written to"
        raise UnwritableError(error.errno, said) from error


def is_full(error: BaseException) -> TypeGuard[OSError]:
    """Whether an error comes of a disk or a quota that is full."""
    return isinstance(error, OSError) and (error.errno in CODES or FULL_DISK_WORDS in str(error))


def full(error: OSError, kept: str) -> DiskFullError:
    """Return the error to raise for a full disk; `kept` says what of the job is."""
    said = f"the disk is full; {kept}: make room, and the same command goes on from there"
    return DiskFullError(error.errno or errno.ENOSPC, said)


@contextmanager
def until_full(kept: Callable[[], str]) -> Iterator[None]:
    """Say what is `kept` where the disk is full, unless that is said already.

    Raises DiskFullError then; every other error passes.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, DiskFullError) or not is_full(error):
            raise
        raise full(error, kept()) from error
