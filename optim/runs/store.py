"""A run on disk: every point an optimiser evaluated, and what it goes on from.

A run is a zarr group of columns along `evaluation`, as long as the budget; a row without a status is not there yet.
Beside the columns lies the file `state` (see `journal`): it counts the rows and those the optimiser has been told, has
their checksums, and then the optimiser itself, its random numbers included, as data that is read and never run. Rows
are written first, that file at once after them, so rows it does not count do not exist: whatever is lost by stopping a
run at any instant is computed again, to the same bits. Rows that are not what the file says are damage, which is
refused by name.

Rows that are there and not told belong to a proposal that the budget cut short. The optimiser is told of none of its
points, so that a run continued to a larger budget is the run that had it from the beginning.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
import zarr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ...landscapes.identity import ERROR, StoreError, StoreExistsError, check_identity, current_identity
from ...landscapes.objective import Evaluation, failed
from ...landscapes.space import ParameterSpace
from ...landscapes.storage.arrays import FILL, consolidate, open_group
from ...landscapes.storage.files import check_ours, clear_halves, has_lost_root, placing, resolve
from ..base import Kind
from . import RUN as RUN
from .arrays import (
    COLUMNS,
    FILES,
    FORMAT,
    FORWARD_EQUIVALENTS,
    Columns,
    attributes_of,
    dims_of,
    empty,
    lay_out,
    plain_attributes,
    read_rows,
)
from .journal import CHUNK, STATE, Journal, checksums, damage_error, digest_of, find_damage
from .run import Run
from .state import decode, encode

PAUSE = 1.0  # least seconds between two writes, so that quick episodes are not held up
SHARE = 0.05  # most of the time that may go into writing, that of all runs that go on abreast


class RunStore:
    """Keep what an optimiser evaluates, row by row, so that a run stopped at any instant can go on.

    Make one with `create`, `open`, `open_or_create` or `in_memory`; `search` fills it. `identity` holds what decides
    the numbers (objective, options, fidelity, device, method, its options, seed); the budget is not of it, since a run
    can be continued to a larger one.
    """

    def __init__(self, attributes: Mapping[str, Any], path: Path | None = None) -> None:
        self.path = path
        self.attributes = dict(attributes)
        self._columns: Columns = {} if path else empty(CHUNK, self.dim)
        self.count = 0  # rows
        self.told = 0  # rows that the kept state has been told
        self._state: bytes | None = None
        self._sums: list[int] = []  # checksums of the rows on disk
        self._written = 0  # rows known to be on disk
        self._saved_at = time.monotonic()
        self._next_save = PAUSE  # seconds after that
        self.abreast = 1  # runs that are filled beside each other, this one included
        if path:
            self._inode = path.stat().st_ino
            self._load(path)

    @classmethod
    def create(
        cls,
        path: str | Path,
        space: ParameterSpace,
        *,
        identity: Mapping[str, Any],
        provenance: Mapping[str, Any] | None = None,
        budget: int,
        overwrite: bool = False,
    ) -> RunStore:
        """Make an empty run at a path where there is none, all at once; `overwrite` replaces a run, nothing else.

        Raises StoreExistsError where there is one, StoreError where something else is to be replaced.
        """
        path = resolve(path)
        attributes = attributes_of(space, identity, provenance or {}, budget)
        if path.exists() and not overwrite:
            raise StoreExistsError(f"{path} exists already; write elsewhere with --out, or replace it with --force")
        if path.exists():
            check_replaceable(path)
        try:
            with placing(path, overwrite=overwrite, check=partial(check_replaceable, path)) as new:
                lay_out(zarr.create_group(new, zarr_format=3), attributes)
                consolidate(new)
                Journal(about=digest_of(attributes)).write(new)
        except FileExistsError as error:
            raise StoreExistsError(str(error)) from None
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> RunStore:
        """Open a run that exists. Raises StoreError where there is none, and where it is damaged."""
        path = resolve(path)
        if not path.exists():
            raise StoreError(f"there is no run at {path}; make one with `landscape optimize`")
        if not is_run(path):
            if has_lost_root(path, FILES):
                raise damage_error(path / "zarr.json", "it cannot be read")
            raise StoreError(f"{path} is no run of format {FORMAT}; move it away or write elsewhere")
        return cls(open_group(path).attrs.asdict(), path)

    @classmethod
    def open_or_create(
        cls,
        path: str | Path,
        space: ParameterSpace,
        *,
        identity: Mapping[str, Any],
        provenance: Mapping[str, Any] | None = None,
        budget: int,
    ) -> RunStore:
        """Go on with the run at `path`, or make it; a run made by other settings raises `StoreMismatchError`."""
        with contextlib.suppress(StoreExistsError):
            return cls.create(path, space, identity=identity, provenance=provenance, budget=budget)
        run = cls.open(path)
        wanted = attributes_of(space, identity, {}, budget)["identity"]
        check_identity(run.path, wanted=wanted, found=run.identity, what="run")
        return run

    @classmethod
    def in_memory(cls, space: ParameterSpace, *, identity: Mapping[str, Any] | None = None, budget: int) -> RunStore:
        """Make a run that lives as long as the object."""
        return cls(attributes_of(space, identity or {}, {}, budget))

    @property
    def identity(self) -> dict[str, Any]:
        """What decides the run's numbers."""
        return current_identity(self.attributes["identity"])

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.identity["parameters"])

    @property
    def budget(self) -> int:
        """Most episodes the run has room for."""
        return int(self.attributes["budget"])

    @property
    def gradient_cost(self) -> float | None:
        """What an episode with gradient costs, in episodes without; None until it is measured."""
        cost: float | None = self.attributes["gradient_cost"]
        return cost

    @property
    def best_loss(self) -> float:
        """The least loss so far, NaN before there is one."""
        losses = self._columns["loss"][: self.count]
        return float(np.nanmin(losses)) if np.isfinite(losses).any() else float("nan")

    @property
    def failed(self) -> int:
        """Number of episodes that failed."""
        return int(failed(self._columns["status"][: self.count]).sum())

    @property
    def error(self) -> str:
        """What the first episode that raised said; empty where none did."""
        return str(self.attributes.get(ERROR, ""))

    def state(self) -> dict[str, Any] | None:
        """Return the optimiser's state after `told` rows, None before the first.

        Raises StoreError where the file holds none.
        """
        try:
            found: dict[str, Any] | None = decode(self._state) if self._state else None
        except Exception as error:  # whatever is read instead of arrays
            raise damage_error((self.path or Path()) / STATE, f"it holds no state ({error})") from None
        return found

    def dataset(self) -> xr.Dataset:
        """Return every row as a long table: shapes (evaluation,) or (evaluation, dim).

        Its attributes are plain numbers and strings, identity and provenance among them as JSON.
        """
        units = {"loss": {"units": self.attributes["loss_unit"]}}
        columns = {
            name: (dims_of(name), self._columns[name][: self.count].copy(), {**about, **units.get(name, {})})
            for name, (_, about) in COLUMNS.items()
        }
        names = {"dim": ("dim", self.identity["parameters"]), "unit": ("dim", self.attributes["units"])}
        return xr.Dataset(columns, names, plain_attributes(self.attributes))

    def read(self) -> Run:
        """Return the run as one works with it, with the episodes that are there."""
        return Run(self.dataset(), self.path.parent if self.path else None)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the run against every other process that would fill it, and drop what the journal does not know.

        Raises StoreError where another process holds it, and where it was replaced or removed.
        """
        if self.path is None:
            yield
            return
        folder = os.open(self.path, os.O_RDONLY)
        try:
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreError(f"{self.path} is being filled by another process; wait for it or stop it") from None
            self._check_in_place()
            clear_halves(self.path)
            self._load(self.path)
            yield
        finally:
            os.close(folder)

    def set_gradient_cost(self, gradient_cost: float) -> None:
        """Keep what an episode with gradient costs, in episodes without."""
        self.attributes["gradient_cost"] = gradient_cost
        self._write_journal()
        self._set(gradient_cost=gradient_cost)

    def extend(self, budget: int) -> None:
        """Make room for so many episodes, if there is less."""
        if budget <= self.budget:
            return
        if self.path:
            for array in self._arrays().values():
                array.resize((budget, *array.shape[1:]))
        self._set(budget=budget)

    def rewind(self) -> None:
        """Drop the rows of a proposal that was cut short: it is evaluated again, whole."""
        if self.count == self.told:
            return
        self.count = self.told
        self._blank_rest()
        if self._written > self.told:
            self._written = self.told
            self._write_journal()  # before other rows are in their place

    def append(
        self,
        x: Float[Tensor, "count dim"],
        evaluation: Evaluation,
        kind: Kind,
        seconds: float,
        state: Callable[[], dict[str, Any]] | None = None,
    ) -> None:
        """Add the points of a proposal, which took so many seconds, and write them if that is due.

        `state` returns the optimiser once it has been told of them; without it they are rows that it does not know.
        Raises ValueError where they are more than the budget has left.
        """
        rows = slice(self.count, self.count + len(x))
        if rows.stop > self.budget:
            raise ValueError(f"a run of {self.budget} episodes has {self.budget - self.count} left; got {len(x)} more")
        self._make_room(rows.stop)
        if evaluation.error and not self.error:
            self._set(**{ERROR: evaluation.error})
        for name, values in self._rows(x, evaluation, kind, seconds).items():
            self._columns[name][rows] = values
        self.count = rows.stop
        if state and self.path and time.monotonic() - self._saved_at >= self._next_save:
            self.save(state)

    def stage(self, state: Callable[[], dict[str, Any]]) -> None:
        """Take in the optimiser as it is once it has been told every row, to be written with the next `save`."""
        self._state, self.told = encode(state()), self.count

    def save(self, state: Callable[[], dict[str, Any]] | None = None) -> None:
        """Write what is not written yet, rows first; without a state the one held before stays."""
        began = time.monotonic()
        if state:
            self.stage(state)
        if self.path:
            self._write()
        self._saved_at = time.monotonic()
        self._next_save = max(PAUSE, self.abreast * (self._saved_at - began) / SHARE)

    def _rows(
        self, x: Float[Tensor, "count dim"], evaluation: Evaluation, kind: Kind, seconds: float
    ) -> dict[str, NDArray[Any] | float | int]:
        grad = torch.full_like(x, torch.nan) if evaluation.grad is None else evaluation.grad
        number = np.arange(1, len(x) + 1)
        cost = 1.0 if evaluation.grad is None else self.gradient_cost or float("nan")
        return {
            "x": x.numpy(),
            "loss": evaluation.loss.numpy(),
            "grad": grad.numpy(),
            "slope": grad.norm(dim=1).numpy(),
            "kind": int(kind),
            "episodes": self.count + number,
            FORWARD_EQUIVALENTS: self._last(FORWARD_EQUIVALENTS) + cost * number,
            "seconds": self._last("seconds") + seconds,
            "status": evaluation.status.numpy(),
        }

    def _last(self, column: str) -> float:
        return float(self._columns[column][self.count - 1]) if self.count else 0.0

    def _write(self) -> None:
        self._check_in_place()
        rows = slice(self._written // CHUNK * CHUNK, min(-(-self.count // CHUNK) * CHUNK, self.budget))  # whole chunks
        if rows.stop > rows.start:
            for name, array in self._arrays().items():
                array[rows] = self._columns[name][rows]
        self._write_journal()
        self._written = self.count

    def _write_journal(self) -> None:
        """Write which rows count, and the optimiser."""
        if self.path is None:
            return
        whole = self._sums[: min(self._written, self.count) // CHUNK]
        self._sums = checksums(self._columns, self.count, whole)
        about = digest_of(self.attributes)
        Journal(self.count, self.told, self.gradient_cost, about, self._sums, self._state or b"").write(self.path)

    def _load(self, path: Path) -> None:
        """Read the rows that the state counts, and refuse what is not as it was written."""
        journal, group = Journal.read(path), open_group(path)
        attributes = group.attrs.asdict()
        if digest_of(attributes) != journal.about or not isinstance(attributes.get("budget"), int):
            raise damage_error(path / "zarr.json", "what the run says of itself is not what was written")
        self.attributes = attributes | {"gradient_cost": journal.gradient_cost}
        self.count = self._written = 0
        self._columns = empty(CHUNK, self.dim)
        self._make_room(journal.rows)
        for name, values in self._columns.items():
            values[: journal.rows] = read_rows(path, group, name, journal.rows, self.dim)
        self._sums = checksums(self._columns, journal.rows, [])
        if wrong := find_damage(self._sums, journal):
            raise damage_error(path, f"rows {wrong[0] + 1} to {wrong[-1] + 1} are not what was written")
        self.count = self._written = journal.rows
        self.told, self._state = journal.told, journal.state or None

    def _make_room(self, rows: int) -> None:
        """Let the columns in memory grow with the rows: a budget may be larger than what is ever used."""
        if rows <= len(self._columns["status"]):
            return
        columns = empty(max(-(-rows // CHUNK) * CHUNK, 2 * len(self._columns["status"])), self.dim)
        for name, values in self._columns.items():
            columns[name][: self.count] = values[: self.count]
        self._columns = columns

    def _blank_rest(self) -> None:
        for name, values in self._columns.items():
            values[self.count :] = FILL[COLUMNS[name][0]]

    def _set(self, **attributes: Any) -> None:
        self.attributes.update(attributes)
        if self.path:
            open_group(self.path, "r+").attrs.update(attributes)
            consolidate(self.path)

    def _arrays(self) -> dict[str, zarr.Array[Any]]:
        assert self.path is not None  # as its callers have seen
        group = open_group(self.path, "r+")
        return {name: group[name] for name in COLUMNS}  # type: ignore[misc]

    def _check_in_place(self) -> None:
        """Refuse to write into a run that was replaced or removed since it was opened."""
        with contextlib.suppress(FileNotFoundError):
            if self.path is None or self.path.stat().st_ino == self._inode:
                return
        raise StoreError(f"{self.path} was replaced or removed while it was being filled; run the command again")


def check_replaceable(path: Path) -> None:
    """Raise ValueError unless a folder is a run's, its root damaged or not, and everything in it is of that."""
    if not is_run(path) and not has_lost_root(path, FILES):
        raise StoreError(f"{path} is no run, so it is not replaced; move it away or write elsewhere")
    check_ours(path, FILES, "a run")


def is_run(path: str | Path) -> bool:
    """Say whether a run of this format is at `path`."""
    try:
        return open_group(Path(path)).attrs.get("gradscape_run") == FORMAT
    except Exception:  # whatever else is there is none
        return False
