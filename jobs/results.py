"""Stores in the folders that verbs leave."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..envs.registry import environment_class, make
from ..landscapes.storage.paths import SLICE as SLICE
from ..landscapes.storage.paths import there

if TYPE_CHECKING:
    import xarray as xr
    from torch import Tensor

    from ..envs.base import Environment

RUN = "run.zarr"


def inside(path: Path, store: str) -> Path:
    """Return the store in a results folder, finished or not, or the path itself."""
    return path / store if there(path / store) else path


def environment_of(dataset: xr.Dataset, device: str) -> Environment:
    """Return the environment that a slice was sampled from, on a device."""
    from ..envs.base import Fidelity
    from ..landscapes.identity import stored_identity

    identity = stored_identity(dataset)
    if missing := {"objective", "settings", "engine", "options", "deterministic"} - set(identity):
        raise ValueError(
            f"the slice is not one of an environment, its identity lacks {', '.join(sorted(missing))}; "
            "`landscape slice ENV` samples one"
        )
    how = {"engine": identity["engine"], "deterministic": identity["deterministic"], **identity["options"]}
    try:
        kind = environment_class(identity["objective"])
    except ValueError as error:
        raise ValueError(f"{error}; of a class in a file, say where it is: --env FILE.py:Class") from None
    return make(kind, fidelity=Fidelity(**identity["settings"]), device=device, **how)


def run_tables(paths: Sequence[str]) -> list[xr.Dataset]:
    """Return what runs, or all runs of races, evaluated; those without an episode are left out."""
    from ..optim.run import Run

    tables = []
    for path in paths:
        found = [inside(Path(path), RUN)]
        if not Path(path, RUN).exists() and (members := sorted(Path(path).glob(f"*/{RUN}"))):
            found = members
        tables += [Run.open(store).table() for store in found]
    if not any(table.sizes["evaluation"] for table in tables):
        raise ValueError(f"{', '.join(paths)}: there are no episodes yet; `landscape optimize` evaluates them")
    return [table for table in tables if table.sizes["evaluation"]]


def point_of(env: Environment, text: str) -> Tensor:
    """Return the parameters that `text` names: a point, as `envs.points` has it, or the best that a run found."""
    kind, _, run = text.partition(":")
    if kind != "best":
        from ..envs.points import point

        return point(env, text)
    from ..landscapes.identity import stored_identity
    from ..landscapes.overlay import best_point

    tables = run_tables([run])
    searched = {str(stored_identity(table).get("objective")) for table in tables}
    if searched != {env.name}:
        raise ValueError(f"{run} holds no runs of {env.name} alone; it holds those of {', '.join(sorted(searched))}")
    return best_point(tables)[0]
