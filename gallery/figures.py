"""The slices that the gallery shows, and the commands that make them."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..jobs.scene import SceneSpec
from ..landscapes.convert import from_json
from .files import FIGURES
from .paper import PaperCaption, read_paper

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.plane import Plane

SCENE_OPTIONS = {"fidelity", "device", "engine", "deterministic"}  # of a SceneSpec, so none of a scene's own


@dataclass(frozen=True)
class Figure:
    """A slice of an environment to show, and the paper's caption for it.

    One dimension makes a line, two make a plane. `through`, `options`, `fidelity` and `gradients` are those of
    `landscape slice`. `over` is what the sweep changes, empty for none. `searched` is the result of the search for
    `through`, as benchmarks/base_points.py writes it: the ends of the `losses` [loss unit], those of the `paper`, their
    `distance`, and the number of `candidates`. It is empty where there was no search.
    """

    id: str
    env: str
    dims: tuple[int, ...]
    caption: PaperCaption = field(default_factory=PaperCaption)
    through: str = "center"
    resolution: int = 48
    gradients: int = 1
    fidelity: str = "standard"
    options: Mapping[str, Any] = field(default_factory=dict)
    over: str = "horizon"
    searched: Mapping[str, Any] = field(default_factory=dict)

    def scene(self, device: str, fidelity: str | None = None) -> SceneSpec:
        """Return the scene of the slice on a device, at the figure's fidelity or another."""
        return SceneSpec(self.env, fidelity or self.fidelity, device=device, options=self.options)

    def plane(self, env: Environment, resolution: int | None = None) -> Plane:
        """Return the plane to sample, with the figure's own resolution by default."""
        from ..envs.points import point
        from ..landscapes.plane import Plane

        through = point(env, self.through)
        return Plane.through(env.space, through, self.dims, resolution=resolution or self.resolution)

    def command(self, device: str) -> str:
        """Return the command that makes only this slice."""
        if len(self.dims) == 1 and self.env == "bounce":
            axis = ["bounce", "--axis", "xyz"[self.dims[0]]]
        else:
            axis = ["slice", self.env, "--dims", *map(str, self.dims)]
        how = ["--resolution", str(self.resolution), "--fidelity", self.fidelity, "--through", self.through]
        how += ["--gradients", str(self.gradients)] if self.gradients > 1 else []
        return shlex.join(["landscape", *axis, *how, *self.set_options, "--device", device])

    def python(self, device: str) -> str:
        """Return Python code that makes only this slice, draws it and prints its verdict."""
        options = {"options": dict(self.options)} if self.options else {}
        how = {"resolution": self.resolution, "through": self.through, "fidelity": self.fidelity, "device": device}
        how |= {"gradients": self.gradients} if self.gradients > 1 else {}
        said = ", ".join(f"{name}={value!r}" for name, value in {**how, **options}.items())
        lines = ["import gradscape as gs", "", f"s = gs.slice({self.env!r}, {self.dims!r}, {said})"]
        return "\n".join([*lines, "s.plot()", "print(s.report().words)"])

    @property
    def set_options(self) -> list[str]:
        """The part of a command that sets the scene's options."""
        return [word for name, value in self.options.items() for word in ("--set", f"{name}={value}")]


def read_figures(path: Path = FIGURES) -> list[Figure]:
    """Read a list of figures. Raises ValueError, naming the file, if it is not one."""
    tables = tomllib.loads(path.read_text()).get("figure", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise ValueError(f"{path} needs figures, each in a table [[figure]]")
    figures = [_figure(path, table) for table in tables]
    repeated = {figure.id for figure in figures if [other.id for other in figures].count(figure.id) > 1}
    if repeated or not figures:
        raise ValueError(f"{path} needs figures, each with a unique id; repeated: {', '.join(sorted(repeated))}")
    return figures


def choose_figures(figures: Sequence[Figure], only: Sequence[str]) -> list[Figure]:
    """Return the figures with these ids or environments, or all of them if none is named.

    Raises ValueError for a name that is neither.
    """
    for name in only:
        if not any(name in (figure.id, figure.env) for figure in figures):
            raise ValueError(f"the gallery has no figure or environment {name!r}; `landscape gallery list` lists all")
    return [figure for figure in figures if not only or {figure.id, figure.env} & set(only)]


def _figure(path: Path, table: dict[str, Any]) -> Figure:
    unknown = set(table) - ({one.name for one in fields(Figure)} - {"caption"})
    missing = {"id", "env", "dims"} - set(table)
    if unknown or missing:
        raise ValueError(
            f"{path}: figure {table.get('id', '?')} has unknown keys {sorted(unknown)} and lacks {sorted(missing)}"
        )
    try:
        figure = from_json(Figure, table)
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: figure {table['id']} cannot be read: {error}") from error
    if taken := SCENE_OPTIONS & set(figure.options):
        raise ValueError(f"{path}: figure {figure.id} has {', '.join(sorted(taken))} among options; no scene has these")
    if len(figure.dims) not in (1, 2):
        raise ValueError(f"{path}: figure {figure.id} needs one dimension or two; got {table['dims']}")
    return replace(figure, caption=read_paper().caption_of(figure.id))
