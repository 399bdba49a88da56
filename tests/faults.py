"""Faults of disks and processes, in this process: changes of files that fail, and files that are damaged."""

import errno
import json
import os
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CHANGES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir"}  # events of PEP 578
WAYS = ("flip", "cut", "empty", "remove", "grow", "swap", "edit", "folder", "loop")
ODD = (None, 0, 1, -1, 7, 1e300, "", "x", "[/b]", [], {}, [1], {"x": 1}, True, "float32", "int64")


class Killed(BaseException):
    """Stand for the end of a process: nothing handles it, and nothing can be changed after it."""


class Faults:
    """Let every change of files under a folder fail, from a given one on."""

    def __init__(self) -> None:
        self.within, self.left, self.kills, self.met = "", 0, False, False

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Count a change as Python announces it, and raise in its place once none is left."""
        if not self.within or not (event in CHANGES or (event == "open" and _writes(*arguments))):
            return
        path = os.path.abspath(os.fsdecode(arguments[0]))
        if path.startswith(self.within) and (self.kills or event not in ("os.remove", "os.rmdir")):
            self.left -= 1
            if self.left < 0:
                self.met = True
                raise Killed if self.kills else OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)

    @contextmanager
    def after(self, changes: int, folder: Path, *, kills: bool) -> Iterator[None]:
        """Let so many changes in a folder succeed, and none after: the process is killed, or the disk full."""
        self.within, self.left, self.kills, self.met = f"{folder}{os.sep}", changes, kills, False
        try:
            yield
        finally:
            self.within = ""


def _writes(path: object, mode: object, flags: int) -> bool:
    return not isinstance(path, int) and bool(flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR))


FAULTS = Faults()
sys.addaudithook(FAULTS)


def damage(chance: random.Random, file: Path) -> str:
    """Do to a file what disks, copies and hands do, and say what."""
    content = file.read_bytes()
    others = [one for one in sorted(file.parent.iterdir()) if one.is_file() and one != file and _alike(one, file)]
    ways = [way for way in WAYS if (way != "swap" or others) and (way != "edit" or file.suffix == ".json")]
    way = chance.choice(ways if content else ["remove", "grow", "folder", "loop"])
    if way in ("remove", "folder", "loop"):
        file.unlink()
        if way == "folder":
            file.mkdir()
        elif way == "loop":
            file.symlink_to(file.name)
    elif way == "swap":
        other = chance.choice(others)
        theirs = other.read_bytes()
        other.write_bytes(content)
        file.write_bytes(theirs)
    elif way == "edit":
        file.write_text(json.dumps(edited(chance, json.loads(content))))
    elif way in ("cut", "flip"):
        at = chance.randrange(len(content))
        flipped = bytes([content[at] ^ chance.randint(1, 255)]) + content[at + 1 :]
        file.write_bytes(content[:at] + (flipped if way == "flip" else b""))
    else:
        file.write_bytes(content + chance.randbytes(chance.randint(1, 9)) if way == "grow" else b"")
    return way


def _alike(one: Path, other: Path) -> bool:
    """Say whether two files are of a kind: chunks of one array, pieces of one study."""
    return one.suffix == other.suffix and one.suffix in ("", ".npz") and one.name != "state"


def edited(chance: random.Random, value: Any) -> Any:
    """Change or remove something deep inside of a JSON value."""
    if isinstance(value, dict | list) and value and chance.randrange(5):
        key = chance.choice(sorted(value) if isinstance(value, dict) else range(len(value)))
        if chance.randrange(6):
            value[key] = edited(chance, value[key])
        else:
            del value[key]
        return value
    return chance.choice([odd for odd in ODD if odd != value])
