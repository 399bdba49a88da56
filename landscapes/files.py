"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
import time
import uuid
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

STALE = 60.0  # seconds after which a hidden folder of a creation that was killed is cleared away


def resolved(path: str | Path) -> Path:
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
    make_folder(path.parent)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def visible(folder: Path) -> list[Path]:
    """Return what a folder holds, but for hidden files: a process that was killed may have left what it was making."""
    return [path for path in folder.iterdir() if not path.name.startswith(".")] if folder.exists() else []


def print_width(name: str, picture: str) -> float | None:
    """Return for how wide a page [mm] a file of this name is a print of a picture, None where it is none."""
    found = re.fullmatch(rf"{re.escape(Path(picture).stem)}-([\d.]+)mm\.(?:pdf|svg)", name)
    return float(found[1]) if found else None


def others(folder: Path, ours: Collection[str], picture: str) -> list[Path]:
    """Return what a folder holds beside files of our names and prints of a picture."""
    return [file for file in visible(folder) if not _is_ours(file, ours, picture)]


def clear(folder: Path, ours: Collection[str], picture: str) -> None:
    """Remove files of our names and prints of a picture from a folder."""
    for file in visible(folder):
        if _is_ours(file, ours, picture):
            file.unlink()


def _is_ours(file: Path, ours: Collection[str], picture: str) -> bool:
    return file.name in ours or print_width(file.name, picture) is not None


def write_json(path: Path, record: object) -> None:
    """Write a JSON file; its numbers are as Python writes them, NaN and Infinity included."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(record, indent=1) + "\n")


@contextmanager
def placing(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Give a folder's path of its own to build at, and rename it to `path` at the end, unless that is taken by then."""
    make_folder(path.parent)
    _clear_stale(path)
    new, old = _hidden(path), _hidden(path)
    try:
        yield new
        if overwrite and path.exists():
            os.rename(path, old)
        try:
            os.rename(new, path)
        except OSError as error:
            taken = FileExistsError(f"{path} was made by another process meanwhile; run the command again")
            raise (taken if path.exists() else error) from None
    finally:
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)


def discard(folder: Path) -> None:
    """Remove a folder at once: killed in the middle of it, nothing is left under its name."""
    _clear_stale(folder)
    gone = _hidden(folder)
    with contextlib.suppress(FileNotFoundError):  # another process was quicker
        os.rename(folder, gone)
        shutil.rmtree(gone, ignore_errors=True)


def _hidden(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.making")


def _clear_stale(path: Path) -> None:
    for folder in path.parent.glob(f".{path.name}.*.making"):
        with contextlib.suppress(OSError):
            if time.time() - folder.stat().st_mtime > STALE:
                shutil.rmtree(folder, ignore_errors=True)
