"""The checkpoint of a study: its arrays by name in a folder, each written whole, so that it can be stopped.

Every part names its study, so one from another study counts as damaged. A separate part has the results of the study's
simulator at a few points when it began. They verify it before it is continued.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..identity import DamagedError, StoreMismatchError, check_identity
from ..objective import Evaluation, Objective, evaluate
from ..plain import digest, plain_json, text
from ..verification import POINTS, StoredPoints, verify
from .files import check_free, check_ours, discard, refuse_others, replacing, visible_files, write_json
from .records import read_json, reading

SETTINGS, PARTS, PROBES = "settings.json", "pieces", "probes"
NAME_KEY, STUDY_KEY = "piece", "study"  # the arrays with a part's own name and its study's digest
PART = re.compile(r"[^/]+\.npz")  # the name of one
AGAIN = "it is computed again"


@dataclass(frozen=True)
class Checkpoint:
    """The arrays of a study in `folder`, with the settings that decide its numbers; their digest is `study`."""

    folder: Path
    study: str = ""

    @classmethod
    def open(cls, folder: Path, identity: Mapping[str, Any], *, what: str, force: bool = False) -> Checkpoint:
        """Continue a study with the same settings, or start one; `force` starts again over another one.

        Raises ValueError where the folder contains something else, StoreMismatchError where it contains another study,
        and StoreError where another process fills the study to be replaced.
        """
        wanted, path = plain_json({"kind": what, **identity}, f"a {what}'s identity"), folder / SETTINGS
        if not path.exists():
            refuse_others(folder, visible_files(folder), what)
        if path.exists():
            with reading(path, f"it belongs to no study or is damaged: write elsewhere with --out, or delete {folder}"):
                found = read_json(path)
                text(found["kind"])
            if not force:
                check_identity(folder, wanted=wanted, found=found, what="study")
                return cls(folder, digest(found))
            check_free(folder)
            check_ours(folder / PARTS, PART.fullmatch, f"a {what}")
            discard(folder / PARTS)
        write_json(path, wanted)
        return cls(folder, digest(wanted))

    def verify(self, objective: Objective, *, of: str = "") -> None:
        """Compare an objective with its results when the study began; at the beginning, store its results.

        Three points of its space are evaluated with their gradients. A study of several objectives has a part for each,
        `of` this name. Raises StoreMismatchError where its numbers differ now, and DamagedError where there are parts
        but not those results.
        """
        name, x = f"{PROBES}-{of}" if of else PROBES, objective.space.sobol(POINTS, seed=0)
        path, todo = self._path(name), f"restore it, or start {self.folder} again with --force"
        if not path.exists():
            if any(map(self._is_ours, [of] if of else self.names())):
                raise DamagedError.of(path, "it is missing, so the other parts cannot be identified", todo)
            now = evaluate(objective, x, grad=True)
            self.save(name, **{part: getattr(now, part).numpy() for part in ("loss", "grad", "status")})
            return
        with reading(path, todo):
            kept = self.read(name, todo)
            loss, slope, status = (torch.from_numpy(kept[part]) for part in ("loss", "grad", "status"))
            then = Evaluation(loss, slope, status)
            known = slope.shape[1]
        if known != objective.space.dim:
            has = f"{objective.name} has {objective.space.dim}"
            raise StoreMismatchError(f"{self.folder} is a study of {known} parameters, but {has}; {todo}")
        verify(objective, [StoredPoints(self.folder, "study", x, then, True)])

    def _is_ours(self, name: str) -> bool:
        """Whether a part exists, is whole and belongs to this study; those of earlier versions do not say."""
        try:
            self.read(name)
        except (DamagedError, FileNotFoundError):
            return False
        return True

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of a part, None where it is missing or damaged; the latter also raises a warning."""
        if not self._path(name).exists():
            return None
        try:
            return self.read(name)
        except DamagedError as error:
            warnings.warn(str(error), RuntimeWarning, stacklevel=2)
            return None

    def read(self, name: str, todo: str = AGAIN) -> dict[str, NDArray[Any]]:
        """Return the arrays of a part. Raises DamagedError, with the advice `todo`, where it is damaged."""
        path = self._path(name)
        with reading(path, todo), path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            found = dict(arrays)
            if str(found.pop(NAME_KEY, "")) != name:
                raise ValueError("it is another part")
            if str(found.pop(STUDY_KEY, None)) != self.study:
                raise ValueError("it belongs to another study, or to an earlier version without a name")
            return found

    def save(self, name: str, **arrays: Any) -> None:
        """Write the arrays of a part, whole or not at all."""
        with replacing(self._path(name)) as partial, partial.open("wb") as file:
            np.savez(file, **{NAME_KEY: np.array(name), STUDY_KEY: np.array(self.study), **arrays})

    def load_or_compute(self, name: str, compute: Callable[[], Mapping[str, Any]]) -> dict[str, NDArray[Any]]:
        """Return the arrays of a part, computed and saved where it is missing or damaged."""
        if (found := self.load(name)) is None:
            found = {key: np.asarray(value) for key, value in compute().items()}
            self.save(name, **found)
        return found

    def names(self) -> list[str]:
        """Return the names of the parts, in order, without those for verification."""
        paths = (self.folder / PARTS).glob("[!.]*.npz")
        return sorted(path.stem for path in paths if not path.stem.startswith(PROBES))

    def count(self) -> int:
        """Count the parts."""
        return len(self.names())

    def _path(self, name: str) -> Path:
        return self.folder / PARTS / f"{name}.npz"
