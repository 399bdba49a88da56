"""Files that one verb leaves and another reads: whatever is wrong with one is said by its name."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SHOWN = 160  # characters of what is wrong


class DamagedError(ValueError):
    """Say which file is not what was written, why, and what to do."""


@contextmanager
def reading(path: Path, todo: str) -> Iterator[None]:
    """Read a file of ours and take from it what is needed, all within: what goes wrong then is the file's fault."""
    try:
        yield
    except (DamagedError, FileNotFoundError, PermissionError, IsADirectoryError):
        raise
    except Exception as error:  # a file of any content makes libraries raise anything at all
        said = f"it has no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise DamagedError(f"{path} is damaged ({said[:SHOWN] or type(error).__name__}); {todo}") from error


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object that a file holds."""
    found = json.loads(path.read_text())
    if not isinstance(found, dict):
        raise TypeError("it is no JSON object")
    return found


def text(value: Any) -> str:
    """Return what has to be a string."""
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value


def number(value: Any) -> float:
    """Return what has to be a finite number, as it is."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"{value!r} is no number")
    return value


def maybe(kind: Callable[[Any], Any], value: Any) -> Any:
    """Return what has to be of a kind, or None."""
    return None if value is None else kind(value)
