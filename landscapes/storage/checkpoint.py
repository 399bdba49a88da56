"""The checkpoint of a study: its arrays by name in a folder, each written whole, so that it can be stopped."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..identity import DamagedError, check_identity
from ..plain import plain_json, text
from .files import discard, replacing, visible_files, write_json
from .ownership import check_ours, refuse_others, remove
from .records import read_json, reading

SETTINGS, PARTS = "settings.json", "pieces"
NAME_KEY = "piece"  # the array with a part's own name, which tells files that were swapped
PART = re.compile(r"[^/]+\.npz")  # the name of one


@dataclass(frozen=True)
class Checkpoint:
    """Hold the arrays of a study in `folder`, together with what decides its numbers."""

    folder: Path

    @classmethod
    def open(cls, folder: Path, identity: Mapping[str, Any], *, what: str, force: bool = False) -> Checkpoint:
        """Go on with a study of the same settings, or begin one; `force` begins anew where another one is.

        Raises ValueError where the folder holds something else, StoreMismatchError where it holds another study.
        """
        wanted, path = plain_json({"kind": what, **identity}, f"a {what}'s identity"), folder / SETTINGS
        if not path.exists():
            refuse_others(folder, visible_files(folder), what)
        if path.exists():
            with reading(path, f"it is no study's or damaged: write elsewhere with --out, or delete {folder}"):
                found = read_json(path)
                text(found["kind"])
            if force:
                check_ours(folder / PARTS, PART.fullmatch, f"a {what}")
                discard(folder / PARTS)
            else:
                check_identity(folder, wanted=wanted, found=found, what="study")
        write_json(path, wanted)
        return cls(folder)

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of a part, None where it is missing or damaged; the latter raises a warning, too."""
        path = self._path(name)
        if not path.exists():
            return None
        try:
            with reading(path, "it is computed again"), np.load(path, allow_pickle=False) as arrays:
                found = dict(arrays)
                if str(found.pop(NAME_KEY, name)) != name:  # those of earlier versions do not say
                    raise ValueError("it is another part")
                return found
        except DamagedError as error:
            warnings.warn(str(error), RuntimeWarning, stacklevel=2)
            return None

    def save(self, name: str, **arrays: Any) -> None:
        """Write the arrays of a part, whole or not at all."""
        with replacing(self._path(name)) as partial, partial.open("wb") as file:
            np.savez(file, **{NAME_KEY: np.array(name), **arrays})

    def names(self) -> list[str]:
        """Return the names of the parts, in order."""
        return sorted(path.stem for path in (self.folder / PARTS).glob("[!.]*.npz"))

    def remove(self) -> None:
        """Remove the parts, and the folder where nothing else is in it."""
        remove(self.folder, re.compile(rf"{PARTS}/{PART.pattern}").fullmatch)

    def count(self) -> int:
        """Count the parts."""
        return len(list((self.folder / PARTS).glob("[!.]*.npz")))

    def _path(self, name: str) -> Path:
        return self.folder / PARTS / f"{name}.npz"
