"""The list of figures that the gallery shows, and where their data is."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
DATA = HERE / "data"  # of a checkout; what is installed from a wheel has trade-offs there and no figures
ELSEWHERE = Path("out") / "gallery-data"
KINDS: dict[str, type] = {  # of a figure's fields in TOML
    **dict.fromkeys(("id", "env", "says", "through", "fidelity", "over"), str),
    **{"dims": list, "number": int, "resolution": int, "options": dict},
}


@dataclass(frozen=True)
class Figure:
    """A slice of an environment: `number` is the paper's, `says` what the paper says of it, in our words.

    One dimension makes a line, two a plane; `through`, `options` and `fidelity` are those of `landscape slice`, and
    `over` is what its sweep moves, nothing if empty.
    """

    id: str
    env: str
    dims: tuple[int, ...]
    says: str
    number: int | None = None
    through: str = "center"
    resolution: int = 48
    fidelity: str = "standard"
    options: dict[str, Any] = field(default_factory=dict)
    over: str = "horizon"

    def command(self, device: str) -> str:
        """Return the command that makes this slice alone."""
        if len(self.dims) == 1 and self.env == "bounce":
            axis = ["bounce", "--axis", "xyz"[self.dims[0]]]
        else:
            axis = ["slice", self.env, "--dims", *map(str, self.dims)]
        how = ["--resolution", str(self.resolution), "--fidelity", self.fidelity, "--through", self.through]
        return shlex.join(["landscape", *axis, *how, *self._set, "--device", device])

    def sweep_command(self, *, frames: int, resolution: int, fidelity: str, device: str) -> str:
        """Return the command that makes its sweep."""
        axes = ["--dims", *map(str, self.dims), "--over", self.over, "--frames", str(frames)]
        how = ["--resolution", str(resolution), "--fidelity", fidelity, "--through", self.through]
        return shlex.join(["landscape", "sweep", self.env, *axes, *how, *self._set, "--device", device])

    def search_command(self, method: str, *, budget: int, seed: int, fidelity: str, device: str) -> str:
        """Return the command that searches its environment."""
        how = ["--method", method, "--budget", str(budget), "--seed", str(seed), "--fidelity", fidelity]
        return shlex.join(["landscape", "optimize", self.env, *how, *self._set, "--device", device])

    @property
    def _set(self) -> list[str]:
        return [word for name, value in self.options.items() for word in ("--set", f"{name}={value}")]


def data_folder(named: str | None) -> Path:
    """Return where the figures' data is: as named, else a checkout's own, else under the folder where one stands."""
    if named:
        return Path(named)
    return DATA if any(DATA.glob("*/slice.zarr")) else ELSEWHERE


def read_figures(path: Path = HERE / "figures.toml") -> list[Figure]:
    """Read a list of figures."""
    with path.open("rb") as file:
        tables = tomllib.load(file).get("figure", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise ValueError(f"{path} needs figures, each a table [[figure]]")
    figures = [_figure(path, table) for table in tables]
    repeated = {figure.id for figure in figures if [other.id for other in figures].count(figure.id) > 1}
    if repeated or not figures:
        raise ValueError(f"{path} needs figures, each with an id of its own; repeated: {', '.join(sorted(repeated))}")
    return figures


def chosen(figures: Sequence[Figure], only: Sequence[str]) -> list[Figure]:
    """Return the figures of these ids or environments, all of them if none is named."""
    for name in only:
        if not any(name in (figure.id, figure.env) for figure in figures):
            raise ValueError(f"no figure or environment {name!r} is in the gallery; `landscape gallery list` shows all")
    return [figure for figure in figures if not only or {figure.id, figure.env} & set(only)]


def _figure(path: Path, table: dict[str, Any]) -> Figure:
    unknown = set(table) - {one.name for one in fields(Figure)}
    missing = {"id", "env", "dims", "says"} - set(table)
    if unknown or missing:
        raise ValueError(
            f"{path}: figure {table.get('id', '?')} has unknown {sorted(unknown)} and lacks {sorted(missing)}"
        )
    for name, kind in KINDS.items():
        if not isinstance(value := table.get(name, kind()), kind):
            raise ValueError(f"{path}: figure {table['id']} has {name} {value!r}, which is no {kind.__name__}")
    if taken := {"fidelity", "device", "engine", "deterministic"} & set(table.get("options", {})):
        raise ValueError(f"{path}: figure {table['id']} has options {', '.join(sorted(taken))}, which no scene has")
    if len(table["dims"]) not in (1, 2):
        raise ValueError(f"{path}: figure {table['id']} needs one dimension or two; got {table['dims']}")
    return Figure(**(table | {"dims": tuple(table["dims"])}))
