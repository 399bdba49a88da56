"""A run on disk: every point an optimiser evaluated, and the state from which it continues.

A run is a zarr group of columns along `evaluation`, as long as the budget; a row without a status does not exist yet.
The file `state` (see `Journal`) is next to the columns. It counts the rows and those the optimiser has been told, and
has their checksums. It also contains the optimiser itself with its random numbers, as data that is read and never
executed. Rows are written first, and that file immediately after them, so rows that it does not count do not exist.
After a stop at any moment, the lost part is computed again, to the same bits. Rows that differ from the file are
damage, which an error reports by name.

Rows that the optimiser has not been told belong to a proposal that the budget cut short. The optimiser is told none of
its points, so a run continued to a larger budget equals a run with that budget from the beginning.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import json
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
import zarr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ...landscapes.identity import (
    EPISODES_PER_POINT,
    ERROR,
    StoreError,
    StoreExistsError,
    check_identity,
    current_identity,
    record_parameters,
    with_package,
)
from ...landscapes.objective import Evaluation, Status, failed
from ...landscapes.plain import plain_json
from ...landscapes.space import ParameterSpace
from ...landscapes.storage.arrays import FILL, consolidate, create_array, flags, open_group
from ...landscapes.storage.files import check_ours, clear_halves, lost_root, placing, replacing, resolve, store_files
from ..base import Kind
from . import RUN as RUN
from .run import Run

ARRAY = "__array__"  # stands in the outline for the number of an array
STATE = "state"
CHUNK = 64  # rows
REMARK = "remark"  # the attribute of a run with what its method had to say of the search
CHANGING = {
    "budget",
    "gradient_cost",
    ERROR,
    REMARK,
}  # attributes of a run that are not what they were when it was made
FORMAT = 2
DEEP = ("x", "grad")
COLUMNS: dict[str, tuple[str, dict[str, Any]]] = {  # status last: a row that has one is whole
    "x": ("float64", {"long_name": "parameters, each in its own unit"}),
    "loss": ("float64", {"long_name": "loss"}),
    "grad": ("float64", {"long_name": "gradient of the loss by each parameter in its own unit"}),
    "slope": ("float64", {"long_name": "length of the gradient"}),
    "kind": ("int8", {"long_name": "what the point was evaluated for", **flags(Kind)}),
    "episodes": ("int64", {"long_name": "episodes so far"}),
    "forwards": ("float64", {"long_name": "episodes so far, in episodes without gradient"}),
    "seconds": ("float64", {"long_name": "time so far", "units": "s"}),
    "status": ("int8", {"long_name": "how the evaluation ended", **flags(Status)}),
}
Columns = dict[str, NDArray[Any]]
FILES = store_files((*COLUMNS, "dim"), STATE)  # of a run on disk
PAUSE = 1.0  # least seconds between two writes, so that quick episodes are not held up
SHARE = 0.05  # most of the time that may go into writing, summed over all runs in lockstep


def encode(state: Any) -> bytes:
    """Return a state as the bytes of an `.npz` file: its arrays by number, and the rest as JSON in `outline`.

    Raises TypeError for anything but numbers, strings, arrays, lists and mappings.
    """
    arrays: list[NDArray[Any]] = []

    def stand_in(value: object) -> Any:
        if isinstance(value, np.ndarray) and value.dtype != object:
            arrays.append(value)
            return {ARRAY: len(arrays) - 1}
        if isinstance(value, np.generic):
            return value.item()
        raise TypeError(f"a state can contain numbers, strings and arrays; got a {type(value).__name__}")

    outline = json.dumps(state, default=stand_in).encode()
    kept = io.BytesIO()
    numbered = {str(number): array for number, array in enumerate(arrays)}
    np.savez(kept, outline=np.frombuffer(outline, np.uint8), **numbered)  # type: ignore[arg-type]
    return kept.getvalue()


def decode(kept: bytes) -> Any:
    """Return the state that `encode` wrote; tuples come back as lists."""
    with np.load(io.BytesIO(kept), allow_pickle=False) as arrays:

        def put_back(found: dict[str, Any]) -> Any:
            return arrays[str(found[ARRAY])] if ARRAY in found else found

        return json.loads(arrays["outline"].tobytes(), object_hook=put_back)


@dataclass(frozen=True)
class Journal:
    """The content of a run's file `state`: the valid rows, their checksums, and the state of the optimiser.

    Its first line is the SHA-256 digest of everything after it, its second a JSON object, and the rest is a result of
    `encode`. A changed file is refused. There are `rows` rows, and the optimiser has received the first `told` of
    them; `sums` are the checksums of every 64 rows. `gradient_cost` is that of the run, `about` the digest of the run's
    attributes; `state` is encoded.
    """

    rows: int = 0
    told: int = 0
    gradient_cost: float | None = None
    about: str = ""
    sums: list[int] = field(default_factory=list)
    state: bytes = b""

    def write(self, run: Path) -> None:
        """Write the file into a run's folder, whole or not at all."""
        head = asdict(replace(self, state=b"")) | {"state": len(self.state)}
        content = json.dumps(head).encode() + b"\n" + self.state
        with replacing(run / STATE) as partial:
            partial.write_bytes(hashlib.sha256(content).hexdigest().encode() + b"\n" + content)

    @classmethod
    def read(cls, run: Path) -> Journal:
        """Read the file of a run. Raises StoreError, which names it, where it is missing or was changed."""
        try:
            digest, _, content = (run / STATE).read_bytes().partition(b"\n")
        except OSError as error:
            raise damage_error(run / STATE, f"it cannot be read ({error.strerror})") from None
        if digest.decode(errors="replace") != hashlib.sha256(content).hexdigest():
            raise damage_error(run / STATE, "it differs from what was written")
        head, _, state = content.partition(b"\n")
        try:
            return cls(**(json.loads(head) | {"state": state}))
        except (TypeError, ValueError) as error:
            raise damage_error(run / STATE, str(error)) from None


def damage_error(path: Path, why: str) -> StoreError:
    """Return the error for a damaged run, or a damaged file in it."""
    return StoreError(f"{path} is damaged: {why}; restore it, or start the run again in another folder")


def digest_of(attributes: Mapping[str, Any]) -> str:
    """Return a digest of a run's attributes, except those that change while it is filled."""
    lasting = {name: value for name, value in attributes.items() if name not in CHANGING}
    return hashlib.sha256(json.dumps(lasting, sort_keys=True).encode()).hexdigest()


def checksums(columns: Mapping[str, NDArray[Any]], count: int, known: list[int]) -> list[int]:
    """Return the checksum of every 64 of the first `count` rows, given those of the first ones.

    Each includes the number of its first row, so rows moved elsewhere have another checksum.
    """
    found = list(known)
    for low in range(len(known) * CHUNK, count, CHUNK):
        total = zlib.crc32(str(low).encode())
        for values in columns.values():
            total = zlib.crc32(values[low : min(low + CHUNK, count)].tobytes(), total)
        found.append(total)
    return found


def find_damage(sums: list[int], journal: Journal) -> range | None:
    """Return the first rows whose checksum differs from the journal's, None where all are right."""
    for low, pair in zip(range(0, journal.rows, CHUNK), zip_longest(sums, journal.sums), strict=False):
        if len({*pair}) > 1:
            return range(low, min(low + CHUNK, journal.rows))
    return None


def empty(rows: int, dim: int) -> Columns:
    """Return empty columns of this many rows."""
    return {
        name: np.full((rows, dim) if name in DEEP else rows, FILL[dtype], dtype) for name, (dtype, _) in COLUMNS.items()
    }


def read_rows(path: Path, group: zarr.Group, name: str, rows: int, dim: int) -> NDArray[Any]:
    """Return the first rows of a column of the run at `path`.

    Raises StoreError, which names the column, where they cannot be read.
    """
    wanted = empty(0, dim)[name]
    try:
        array: Any = group[name]
        if (array.dtype, array.shape[1:], array.chunks[0]) != (wanted.dtype, wanted.shape[1:], CHUNK):
            raise ValueError("its layout differs from what was written")
        if array.shape[0] < rows:
            raise ValueError(f"it has room for {array.shape[0]} rows, but {rows} were written")
        return np.asarray(array[:rows])
    except Exception as error:  # whatever a missing array, a damaged layout or a codec raises
        raise damage_error(path / name, f"it cannot be read ({' '.join(str(error).split())})") from None


def plain_attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's attributes in a form for any file format; unknown ones are left out."""
    known = {name: value for name, value in attributes.items() if value is not None and name != "units"}
    return {name: json.dumps(value) if isinstance(value, dict) else value for name, value in known.items()}


def dims_of(column: str) -> tuple[str, ...]:
    """Return the names of a column's dimensions."""
    return ("evaluation", "dim") if column in DEEP else ("evaluation",)


def attributes_of(
    space: ParameterSpace, identity: Mapping[str, Any], provenance: Mapping[str, Any], budget: int
) -> dict[str, Any]:
    """Return a run's description, stored as attributes of its group."""
    box = {**record_parameters(space), "lower": space.lower.tolist(), "upper": space.upper.tolist()}
    whole = plain_json({**identity, **box}, "a run's identity")
    return {
        "gradscape_run": FORMAT,
        "env": whole.get("objective", ""),
        "method": whole.get("method", ""),
        "seed": whole.get("seed", 0),
        "budget": budget,
        "fidelity": whole.get("fidelity", ""),
        "loss_unit": str(provenance.get("loss_unit", "")),
        "units": list(space.units),
        "lower": whole["lower"],
        "upper": whole["upper"],
        "gradient_cost": None,
        "identity": whole,
        "provenance": plain_json(with_package(provenance), "a run's provenance"),
    }


def lay_out(group: zarr.Group, attributes: dict[str, Any]) -> None:
    """Make the empty arrays of a run."""
    group.attrs.update(attributes)
    budget, parameters = attributes["budget"], attributes["identity"]["parameters"]
    for name, (dtype, about) in COLUMNS.items():
        unit = {"units": attributes["loss_unit"]} if name == "loss" else {}
        deep = (len(parameters),) if name in DEEP else ()
        create_array(group, name, (budget, *deep), (CHUNK, *deep), dims_of(name), dtype, **{**about, **unit})
    axis = create_array(
        group, "dim", (len(parameters),), (len(parameters),), ("dim",), "string",
        long_name="parameter", units=attributes["units"],
    )  # fmt: skip
    axis[:] = np.array(parameters, dtype=object)


class RunStore:
    """Store the evaluations of an optimiser, row by row, so that a run can be stopped at any moment and continued.

    Make one with `open`, `open_or_create` or `in_memory`; `search` fills it. `identity` contains the settings that
    decide the numbers (objective, options, fidelity, device, method, its options, seed). The budget is not part of it,
    because a run can be continued to a larger one.
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
        self.abreast = 1  # number of runs that advance in lockstep, this one included
        if path:
            self._inode = path.stat().st_ino
            self._load(path)

    @classmethod
    def open(cls, path: str | Path) -> RunStore:
        """Open a run that exists. Raises StoreError where there is none, and where it is damaged."""
        path = resolve(path)
        if not path.exists():
            raise StoreError(f"there is no run at {path}; make one with `landscape optimize`")
        if not is_run(path):
            if lost_root(path, FILES):
                raise damage_error(path / "zarr.json", "it cannot be read")
            raise StoreError(f"{path} is not a run of format {FORMAT}; move it away or choose another folder")
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
        overwrite: bool = False,
    ) -> RunStore:
        """Continue the run at `path`, or make an empty one in one step; `overwrite` replaces a run and nothing else.

        Raises StoreMismatchError for a run with other settings, StoreError where anything but a run would be replaced,
        and StoreExistsError where another process has replaced it meanwhile.
        """
        path = resolve(path)
        attributes = attributes_of(space, identity, provenance or {}, budget)
        if path.exists() and overwrite:
            check_replaceable(path)
        if overwrite or not path.exists():
            try:
                with placing(path, overwrite=overwrite, check=partial(check_replaceable, path)) as new:
                    lay_out(zarr.create_group(new, zarr_format=3), attributes)
                    consolidate(new)
                    Journal(about=digest_of(attributes)).write(new)
            except FileExistsError as error:
                if overwrite:
                    raise StoreExistsError(str(error)) from None
        run = cls.open(path)
        check_identity(run.path, wanted=attributes["identity"], found=run.identity, what="run")
        return run

    @classmethod
    def in_memory(cls, space: ParameterSpace, *, identity: Mapping[str, Any] | None = None, budget: int) -> RunStore:
        """Make a run that lives as long as the object."""
        return cls(attributes_of(space, identity or {}, {}, budget))

    @property
    def identity(self) -> dict[str, Any]:
        """The settings that decide the run's numbers."""
        return current_identity(self.attributes["identity"])

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.identity["parameters"])

    @property
    def budget(self) -> int:
        """The largest number of episodes of the run."""
        return int(self.attributes["budget"])

    @property
    def gradient_cost(self) -> float | None:
        """The cost of an episode with gradient, in episodes without; None until it is measured."""
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
        """The message of the first episode that raised; empty where none did."""
        return str(self.attributes.get(ERROR, ""))

    def state(self) -> dict[str, Any] | None:
        """Return the optimiser's state after `told` rows, None before the first.

        Raises StoreError where the file has none.
        """
        try:
            found: dict[str, Any] | None = decode(self._state) if self._state else None
        except Exception as error:  # whatever is read instead of arrays
            raise damage_error((self.path or Path()) / STATE, f"it contains no state ({error})") from None
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
        """Return the run for users, with its present episodes."""
        return Run(self.dataset(), self.path.parent if self.path else None)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the run against every other process that would fill it, and drop rows that the journal does not count.

        Raises StoreError where another process has the lock, and where the run was replaced or removed.
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
        """Store the cost of an episode with gradient, in episodes without."""
        self.attributes["gradient_cost"] = gradient_cost
        self._write_journal()
        self._set(gradient_cost=gradient_cost)

    def keep_remark(self, remark: str) -> None:
        """Store the method's remark on its search."""
        if remark != self.attributes.get(REMARK, ""):
            self._set(**{REMARK: remark})

    def extend(self, budget: int) -> None:
        """Make room for this many episodes, if there is less."""
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
        """Add the points of a proposal and their time in seconds, and write them if that is due.

        `state` returns the optimiser after it has been told of them; without it, it has not been told of these rows.
        Raises ValueError for more points than the remaining budget.
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
        """Take the state of the optimiser after it has been told every row, to be written with the next `save`."""
        self._state, self.told = encode(state()), self.count

    def save(self, state: Callable[[], dict[str, Any]] | None = None) -> None:
        """Write everything that is not written yet, rows first; without a state the previous one stays."""
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
        cost *= self.identity.get(EPISODES_PER_POINT, 1)
        return {
            "x": x.numpy(),
            "loss": evaluation.loss.numpy(),
            "grad": grad.numpy(),
            "slope": grad.norm(dim=1).numpy(),
            "kind": int(kind),
            "episodes": self.count + number,
            "forwards": self._last("forwards") + cost * number,
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
        """Write the counts and the optimiser."""
        if self.path is None:
            return
        whole = self._sums[: min(self._written, self.count) // CHUNK]
        self._sums = checksums(self._columns, self.count, whole)
        about = digest_of(self.attributes)
        Journal(self.count, self.told, self.gradient_cost, about, self._sums, self._state or b"").write(self.path)

    def _load(self, path: Path) -> None:
        """Read the rows that the state counts, and refuse rows that were changed."""
        journal, group = Journal.read(path), open_group(path)
        attributes = group.attrs.asdict()
        if digest_of(attributes) != journal.about or not isinstance(attributes.get("budget"), int):
            raise damage_error(path / "zarr.json", "the run's attributes differ from what was written")
        self.attributes = attributes | {"gradient_cost": journal.gradient_cost}
        self.count = self._written = 0
        self._columns = empty(CHUNK, self.dim)
        self._make_room(journal.rows)
        for name, values in self._columns.items():
            values[: journal.rows] = read_rows(path, group, name, journal.rows, self.dim)
        self._sums = checksums(self._columns, journal.rows, [])
        if wrong := find_damage(self._sums, journal):
            raise damage_error(path, f"rows {wrong[0] + 1} to {wrong[-1] + 1} differ from what was written")
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
    """Raise ValueError unless a folder is a run, its root damaged or not, with no other files in it."""
    if not is_run(path) and not lost_root(path, FILES):
        raise StoreError(f"{path} is not a run and is not replaced; move it away or choose another folder")
    check_ours(path, FILES, "a run")


def is_run(path: str | Path) -> bool:
    """Say whether a run of this format is at `path`."""
    try:
        return open_group(Path(path)).attrs.get("gradscape_run") == FORMAT
    except Exception:  # whatever else is there is none
        return False
