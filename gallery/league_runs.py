"""The runs of a race as the gallery keeps them, in one small file: the improvements of each, and where some lie.

Of every run there are the episodes that lowered its least loss, what it had cost by then, and its best point in full.
Of the median run of each method, by final loss, there are the points of these episodes, too, each parameter as one of
65 536 places in its box, which is finer than any picture. Gradients are not kept.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..landscapes.objective import Status
from ..landscapes.overlay import IMPROVEMENTS_OF, lowered
from ..landscapes.storage.arrays import flags
from ..landscapes.storage.files import replacing
from ..landscapes.storage.records import reading
from ..optim.base import Kind
from ..optim.curves import best_so_far
from ..optim.race import Race
from ..optim.runs.arrays import FORWARD_EQUIVALENTS
from ..optim.runs.run import Run
from .files import REMAKE

PLACES = 65_535  # of a parameter in its box, less one


@dataclass(frozen=True, eq=False)
class KeptRun:
    """What is kept of a run: its improvements, shapes (improvement,), its whole cost, and its best point, shape (dim,).

    `episode` counts from 1 and `forwards` in forward equivalents; `loss` falls from the first to the last, which is the
    run's final one. A run without success has no improvement, and a best point of NaN.
    """

    method: str
    seed: int
    episode: NDArray[np.int64]
    forwards: NDArray[np.float64]
    loss: NDArray[np.float64]
    episodes: int
    spent: float
    best: NDArray[np.float64]

    @classmethod
    def of(cls, run: Run, budget: int) -> KeptRun:
        """Return what is kept of the first `budget` episodes of a run."""
        data = run.data.isel(evaluation=slice(budget))
        loss, x = data["loss"].to_numpy(), data["x"].to_numpy()
        best = best_so_far(loss)
        rows = lowered(best)
        spent = data[FORWARD_EQUIVALENTS].to_numpy()
        last = x[rows[-1]] if len(rows) else np.full(x.shape[1], np.nan)
        return cls(run.method, run.seed, rows + 1, spent[rows], loss[rows], len(loss), float(spent[-1]), last)


@dataclass(frozen=True, eq=False)
class KeptRuns:
    """What is kept of a race: every run's improvements, and those of the median run of each method with their points.

    The latter are tables with the columns of a run but for seconds, with gradients of NaN.
    """

    runs: Sequence[KeptRun]
    medians: Mapping[str, xr.Dataset]

    @classmethod
    def of(cls, race: Race) -> KeptRuns:
        """Return what is kept of a race."""
        runs = [KeptRun.of(run, race.budget) for members in race.runs.values() for run in members]
        return cls(runs, {method: _median(members, race.budget) for method, members in race.runs.items()})

    def write(self, path: Path) -> None:
        """Write it as one file, whole or not at all."""
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **_packed_runs(self.runs), **_packed_medians(self.medians))

    @classmethod
    def read(cls, path: Path) -> KeptRuns:
        """Read it. Raises ValueError, naming the file, where it is not what `write` wrote."""
        with reading(path, REMAKE.format("league")), np.load(path, allow_pickle=False) as found:
            arrays = dict(found)
            return cls(list(_unpacked_runs(arrays)), dict(_unpacked_medians(arrays)))


def _median(members: Sequence[Run], budget: int) -> xr.Dataset:
    """Return the improvements of the run of median final loss, of two the better, with points as exact as kept."""
    final = np.array([best_so_far(run.data["loss"].to_numpy()[:budget])[-1] for run in members])
    order = np.argsort(np.where(np.isfinite(final), final, np.inf), kind="stable")
    whole = members[order[(len(members) - 1) // 2]].data.isel(evaluation=slice(budget))
    rows = lowered(best_so_far(whole["loss"].to_numpy()))
    data = whole.isel(evaluation=rows).assign_attrs({IMPROVEMENTS_OF: whole.sizes["evaluation"]})
    places = _places(data["x"].to_numpy(), *(np.array(data.attrs[name]) for name in ("lower", "upper")))
    loss = data["loss"].to_numpy().astype(np.float32)
    return _table(places, loss, data["kind"].to_numpy(), rows + 1, _about(data))


def _about(data: xr.Dataset) -> dict[str, Any]:
    """Return what a table says of itself, as JSON has it."""
    wanted = ("env", "method", "seed", "budget", "fidelity", "loss_unit", "identity", "provenance", IMPROVEMENTS_OF)
    attrs = {name: data.attrs[name] for name in wanted}
    box = {name: np.asarray(data.attrs[name], float).tolist() for name in ("lower", "upper")}
    named = {name: [str(one) for one in data[name].to_numpy()] for name in ("dim", "unit")}
    return {**attrs, **box, "names": named}


def _places(x: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.uint16]:
    share = np.clip((x - lower) / (upper - lower), 0, 1)
    return np.round(share * PLACES).astype(np.uint16)


def _table(
    places: NDArray[np.uint16], loss: NDArray[Any], kind: NDArray[Any], episode: NDArray[Any], about: Mapping[str, Any]
) -> xr.Dataset:
    """Return the table of a run's improvements from what is kept of them."""
    lower, upper = np.array(about["lower"]), np.array(about["upper"])
    x = lower + places / PLACES * (upper - lower)
    columns = {
        "x": (("evaluation", "dim"), x),
        "grad": (("evaluation", "dim"), np.full_like(x, np.nan)),
        "loss": ("evaluation", loss.astype(float)),
        "kind": ("evaluation", kind.astype(np.int8), flags(Kind)),
        "status": ("evaluation", np.full(len(loss), Status.OK, np.int8), flags(Status)),
        "episodes": ("evaluation", episode),
    }
    coords = {name: ("dim", list(values)) for name, values in about["names"].items()}
    attrs = {name: value for name, value in about.items() if name != "names"}
    return xr.Dataset(columns, coords, attrs)


def _packed_runs(runs: Sequence[KeptRun]) -> dict[str, Any]:
    """Return runs as arrays, their improvements one after the other."""
    return {
        **{name: np.array([getattr(one, name) for one in runs]) for name in ("method", "seed", "episodes", "spent")},
        "best": np.stack([one.best for one in runs]),
        "count": np.array([len(one.loss) for one in runs]),
        **{name: np.concatenate([getattr(one, name) for one in runs]) for name in ("episode", "forwards", "loss")},
    }


def _unpacked_runs(arrays: Mapping[str, NDArray[Any]]) -> Iterator[KeptRun]:
    ends = np.cumsum(arrays["count"])
    if not len(arrays["loss"]) == len(arrays["episode"]) == len(arrays["forwards"]) == ends[-1]:
        raise ValueError("its improvements are not as many as its runs have")
    for row, (end, count) in enumerate(zip(ends, arrays["count"], strict=True)):
        part = slice(end - count, end)
        yield KeptRun(
            str(arrays["method"][row]),
            int(arrays["seed"][row]),
            arrays["episode"][part],
            arrays["forwards"][part],
            arrays["loss"][part],
            int(arrays["episodes"][row]),
            float(arrays["spent"][row]),
            arrays["best"][row],
        )


def _packed_medians(medians: Mapping[str, xr.Dataset]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for method, table in medians.items():
        box = (np.array(table.attrs[name]) for name in ("lower", "upper"))
        found[f"places {method}"] = _places(table["x"].to_numpy(), *box)
        found[f"losses {method}"] = table["loss"].to_numpy().astype(np.float32)
        found[f"kind {method}"], found[f"episode {method}"] = table["kind"].to_numpy(), table["episodes"].to_numpy()
        found[f"about {method}"] = np.array(json.dumps(_about(table)))
    return found


def _unpacked_medians(arrays: Mapping[str, NDArray[Any]]) -> Iterator[tuple[str, xr.Dataset]]:
    for method in dict.fromkeys(map(str, arrays["method"])):
        places, losses, kind, episode, about = (
            arrays[f"{name} {method}"] for name in ("places", "losses", "kind", "episode", "about")
        )
        yield method, _table(places, losses, kind, episode, json.loads(str(about)))
