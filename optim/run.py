"""A run on disk: every point an optimiser evaluated, and what it goes on from.

A run is a zarr group of columns along `evaluation`, as long as the budget; a row without a status is not there yet.
Beside the columns lies the file `state`: a line that counts the rows and those the optimiser has been told, then the
optimiser itself, its random numbers included. Rows are written first, that file at once after them, so rows it does not
count do not exist: whatever is lost by stopping a run at any instant is computed again, to the same bits.

Rows that are there and not told belong to a proposal that the budget cut short. The optimiser is told of none of its
points, so that a run continued to a larger budget is the run that had it from the beginning.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
import zarr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .. import __version__
from ..landscapes.files import placing, replacing, resolved
from ..landscapes.identity import StoreError, StoreExistsError, check_identity, plain_json
from ..landscapes.layout import FILL, consolidate, create_array, flags
from ..landscapes.objective import Evaluation, Status
from ..landscapes.space import ParameterSpace
from .base import Kind

FORMAT = 1
CHUNK = 64  # rows
PAUSE = 1.0  # least seconds between two writes, so that quick episodes are not held up
SHARE = 0.05  # most of the time that may go into writing, so that a large state is not written too often
RUN, STATE = "run.zarr", "state"
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


class Run:
    """Keep what an optimiser evaluates, row by row, so that a run stopped at any instant can go on.

    Make one with `create`, `open`, `open_or_create` or `in_memory`; `search` fills it. `identity` holds what decides
    the numbers (objective, options, fidelity, device, method, its options, seed); the budget is not of it, since a run
    can be continued to a larger one.
    """

    def __init__(self, attributes: Mapping[str, Any], path: Path | None = None) -> None:
        self.path = path
        self.attributes = dict(attributes)
        self.count = 0  # rows
        self.told = 0  # rows that the kept state has been told
        self._state: bytes | None = None
        self._written = 0  # rows known to be on disk
        self._saved_at = time.monotonic()
        self._next_save = PAUSE  # seconds after that
        self._columns = self._empty(self.budget)
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
    ) -> Run:
        """Make an empty run at a path where there is none, all at once; `overwrite` replaces a run, nothing else."""
        path = resolved(path)
        attributes = _attributes(space, identity, provenance or {}, budget)
        if path.exists() and not overwrite:
            raise StoreExistsError(f"{path} exists already; write elsewhere with --out, or replace it with --force")
        if path.exists() and not is_run(path):
            raise StoreError(f"{path} is no run, so it is not replaced; move it away or write elsewhere")
        try:
            with placing(path, overwrite=overwrite) as new:
                _lay_out(zarr.create_group(new, zarr_format=3), attributes)
                consolidate(new)
        except FileExistsError as error:
            raise StoreExistsError(str(error)) from None
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> Run:
        """Open a run that exists."""
        path = resolved(path)
        if not path.exists():
            raise StoreError(f"there is no run at {path}; make one with `landscape optimize`")
        if not is_run(path):
            raise StoreError(f"{path} is no run of format {FORMAT}; move it away or write elsewhere")
        return cls(zarr.open_group(path, mode="r", use_consolidated=False).attrs.asdict(), path)

    @classmethod
    def open_or_create(
        cls,
        path: str | Path,
        space: ParameterSpace,
        *,
        identity: Mapping[str, Any],
        provenance: Mapping[str, Any] | None = None,
        budget: int,
    ) -> Run:
        """Go on with the run at `path`, or make it; a run made by other settings raises `StoreMismatchError`."""
        with contextlib.suppress(StoreExistsError):
            return cls.create(path, space, identity=identity, provenance=provenance, budget=budget)
        run = cls.open(path)
        wanted = _attributes(space, identity, {}, budget)["identity"]
        check_identity(run.path, wanted=wanted, found=run.identity, what="run")
        return run

    @classmethod
    def in_memory(cls, space: ParameterSpace, *, identity: Mapping[str, Any] | None = None, budget: int) -> Run:
        """Make a run that lives as long as the object."""
        return cls(_attributes(space, identity or {}, {}, budget))

    @property
    def identity(self) -> dict[str, Any]:
        """What decides the run's numbers."""
        found: dict[str, Any] = self.attributes["identity"]
        return found

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
    def best(self) -> float:
        """The least loss so far, NaN before there is one."""
        losses = self._columns["loss"][: self.count]
        return float(np.nanmin(losses)) if np.isfinite(losses).any() else float("nan")

    @property
    def failed(self) -> int:
        """Number of episodes that failed."""
        return int((self._columns["status"][: self.count] != Status.OK).sum())

    def state(self) -> bytes | None:
        """Return the optimiser's state after `told` rows, None before the first."""
        return self._state

    def table(self) -> xr.Dataset:
        """Return every row as a long table: shapes (evaluation,) or (evaluation, dim).

        Its attributes are plain numbers and strings, identity and provenance among them as JSON.
        """
        units = {"loss": {"units": self.attributes["loss_unit"]}}
        columns = {
            name: (_dims(name), self._columns[name][: self.count].copy(), {**about, **units.get(name, {})})
            for name, (_, about) in COLUMNS.items()
        }
        names = {"dim": ("dim", self.identity["parameters"]), "unit": ("dim", self.attributes["units"])}
        return xr.Dataset(columns, names, _plain(self.attributes))

    @contextlib.contextmanager
    def filling(self) -> Iterator[None]:
        """Hold the run against every other process that would fill it, and drop what the kept state does not know."""
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
            self._load(self.path)
            yield
        finally:
            os.close(folder)

    def begin(self, *, gradient_cost: float) -> None:
        """Keep what an episode with gradient costs, in episodes without."""
        self._set(gradient_cost=gradient_cost)

    def extend(self, budget: int) -> None:
        """Make room for so many episodes, if there is less."""
        if budget <= self.budget:
            return
        columns = self._empty(budget)
        for name, values in self._columns.items():
            columns[name][: len(values)] = values
        self._columns = columns
        if self.path:
            for array in self._arrays().values():
                array.resize((budget, *array.shape[1:]))
        self._set(budget=budget)

    def rewind(self) -> None:
        """Drop the rows of a proposal that was cut short: it is evaluated again, whole."""
        for name, values in self._columns.items():
            values[self.told :] = FILL[COLUMNS[name][0]]
        self.count = self.told
        self._written = min(self._written, self.told)

    def append(
        self,
        x: Float[Tensor, "count dim"],
        evaluation: Evaluation,
        kind: Kind,
        seconds: float,
        state: Callable[[], bytes] | None = None,
    ) -> None:
        """Add the points of a proposal, which took so many seconds, and write them if that is due.

        `state` returns the optimiser once it has been told of them; without it they are rows that it does not know.
        """
        rows = slice(self.count, self.count + len(x))
        if rows.stop > self.budget:
            raise ValueError(f"a run of {self.budget} episodes has {self.budget - self.count} left; got {len(x)} more")
        for name, values in self._rows(x, evaluation, kind, seconds).items():
            self._columns[name][rows] = values
        self.count = rows.stop
        if state and self.path and time.monotonic() - self._saved_at >= self._next_save:
            self.save(state)

    def save(self, state: Callable[[], bytes] | None) -> None:
        """Write what is not written yet, rows first; without a state the one kept before stays."""
        began = time.monotonic()
        if state:
            self._state, self.told = state(), self.count
        if self.path:
            self._write(self.path)
        self._saved_at = time.monotonic()
        self._next_save = max(PAUSE, (self._saved_at - began) / SHARE)

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
            "forwards": self._last("forwards") + cost * number,
            "seconds": self._last("seconds") + seconds,
            "status": evaluation.status.numpy(),
        }

    def _last(self, column: str) -> float:
        return float(self._columns[column][self.count - 1]) if self.count else 0.0

    def _write(self, path: Path) -> None:
        self._check_in_place()
        rows = slice(self._written // CHUNK * CHUNK, min(-(-self.count // CHUNK) * CHUNK, self.budget))  # whole chunks
        if rows.stop > rows.start:
            for name, array in self._arrays().items():
                array[rows] = self._columns[name][rows]
        self._written = self.count
        with replacing(path / STATE) as partial, partial.open("wb") as file:
            file.write(json.dumps({"rows": self.count, "told": self.told}).encode() + b"\n")
            file.write(self._state or b"")

    def _load(self, path: Path) -> None:
        """Read the rows that the state counts."""
        head, _, state = _kept(path).partition(b"\n")
        counts = json.loads(head)
        self.attributes = self._group("r").attrs.asdict()
        self._columns = self._empty(self.budget)
        for name, array in self._arrays().items():
            rows = slice(min(counts["rows"], array.shape[0], self.budget))
            self._columns[name][rows] = array[rows]
        missing = np.append(self._columns["status"] == Status.MISSING, True)
        self.count, self.told = int(missing.argmax()), counts["told"]
        if self.count < self.told:
            raise StoreError(f"{self.path} is damaged: row {self.count + 1} is missing; begin anew with --force")
        self._state = state or None
        self._written = self.count
        for name, values in self._columns.items():
            values[self.count :] = FILL[COLUMNS[name][0]]

    def _set(self, **attributes: Any) -> None:
        self.attributes.update(attributes)
        if self.path:
            self._group().attrs.update(attributes)
            consolidate(self.path)

    def _group(self, mode: Any = "r+") -> zarr.Group:
        return zarr.open_group(str(self.path), mode=mode, use_consolidated=False)

    def _arrays(self) -> dict[str, zarr.Array[Any]]:
        group = self._group()
        return {name: group[name] for name in COLUMNS}  # type: ignore[misc]

    def _empty(self, budget: int) -> dict[str, NDArray[Any]]:
        dim = len(self.identity["parameters"])
        return {
            name: np.full((budget, dim) if name in DEEP else budget, FILL[dtype], dtype)
            for name, (dtype, _) in COLUMNS.items()
        }

    def _check_in_place(self) -> None:
        """Refuse to write into a run that was replaced or removed since it was opened."""
        with contextlib.suppress(FileNotFoundError):
            if self.path is None or self.path.stat().st_ino == self._inode:
                return
        raise StoreError(f"{self.path} was replaced or removed while it was being filled; run the command again")


def open_run(path: str | Path) -> xr.Dataset:
    """Read a run from disk as its `table`: a row for each episode that was evaluated so far.

    `path` is the run, or the folder that `landscape optimize` left it in.
    """
    path = Path(path)
    return Run.open(path / RUN if (path / RUN).exists() else path).table()


def is_run(path: str | Path) -> bool:
    """Say whether a run of this format is at `path`."""
    try:
        group = zarr.open_group(Path(path), mode="r", use_consolidated=False)
    except Exception:  # whatever else is there is none
        return False
    return group.attrs.get("gradscape_run") == FORMAT


def _kept(path: Path) -> bytes:
    try:
        return (path / STATE).read_bytes()
    except FileNotFoundError:
        return b'{"rows": 0, "told": 0}\n'


def _plain(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's attributes as any format of files has them; what is not known yet is left out."""
    known = {name: value for name, value in attributes.items() if value is not None and name != "units"}
    return {name: json.dumps(value) if isinstance(value, dict) else value for name, value in known.items()}


def _dims(column: str) -> tuple[str, ...]:
    return ("evaluation", "dim") if column in DEEP else ("evaluation",)


def _attributes(
    space: ParameterSpace, identity: Mapping[str, Any], provenance: Mapping[str, Any], budget: int
) -> dict[str, Any]:
    box = {"parameters": space.names, "lower": space.lower.tolist(), "upper": space.upper.tolist()}
    whole = plain_json({**identity, **box, "gradscape": __version__}, "a run's identity")
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
        "provenance": plain_json(provenance, "a run's provenance"),
    }


def _lay_out(group: zarr.Group, attributes: dict[str, Any]) -> None:
    group.attrs.update(attributes)
    budget, parameters = attributes["budget"], attributes["identity"]["parameters"]
    for name, (dtype, about) in COLUMNS.items():
        unit = {"units": attributes["loss_unit"]} if name == "loss" else {}
        deep = (len(parameters),) if name in DEEP else ()
        create_array(group, name, (budget, *deep), (CHUNK, *deep), _dims(name), dtype, **{**about, **unit})
    axis = create_array(
        group, "dim", (len(parameters),), (len(parameters),), ("dim",), "string",
        long_name="parameter", units=attributes["units"],
    )  # fmt: skip
    axis[:] = np.array(parameters, dtype=object)
