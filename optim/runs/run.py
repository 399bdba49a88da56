"""A run of an optimiser, as one works with it: its episodes, the best of them, its picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor

from ...landscapes.identity import errors_of, stored_identity, stored_provenance, stored_scales
from ...landscapes.space import to_values

if TYPE_CHECKING:
    import pandas as pd

    from ...landscapes.draw.figures.page import Picture

LABELS = {"forwards": "forward equivalents"}  # of columns whose stored names say less


@dataclass(frozen=True)
class BestEpisode:
    """The episode of least loss: the values `x` of its parameters, each in its own unit, and its number, from 1 on."""

    x: Float[Tensor, " dim"]
    loss: float
    episode: int


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """Hold the episodes of a run: `data` is an xarray dataset of x(evaluation, dim), loss(evaluation) and others.

    `x` are points as `evaluate` takes them: of a logarithmic parameter decimal logarithms; `best` and `table` have
    values. `grad`(evaluation, dim) is the gradient where one was asked for, `status` how the episode ended, `kind` what
    it was evaluated for; `episodes`, `forwards` and `seconds` [s] are what the run had cost by then, the second in
    forward equivalents: episodes without gradient. `folder` is where its files are, None of one in memory.
    """

    data: xr.Dataset
    folder: Path | None = None

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What decides the numbers, as plain JSON: scene, options, fidelity, device, engine, method, seed, code."""
        return stored_identity(self.data)

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """What else is known of how it was made: command, date, versions, the loss's unit."""
        return stored_provenance(self.data)

    @property
    def method(self) -> str:
        """The name of the method."""
        return str(self.data.attrs["method"])

    @property
    def seed(self) -> int:
        """The seed of the method's random numbers."""
        return int(self.data.attrs["seed"])

    @cached_property
    def best(self) -> BestEpisode:
        """The episode of least loss. Raises ValueError where no episode has succeeded."""
        loss = self.data["loss"].to_numpy()
        if not np.isfinite(loss).any():
            raise ValueError(f"{self._name()} has no best episode: none of {len(loss)} succeeded")
        row = int(np.nanargmin(loss))
        x = to_values(torch.from_numpy(self.data["x"].to_numpy()[row].copy()), stored_scales(self.data))
        return BestEpisode(x, float(loss[row]), row + 1)

    @property
    def remark(self) -> str:
        """What the method had to say of its search, such as which method `auto` took; empty for most."""
        return str(self.data.attrs.get("remark", ""))

    @property
    def errors(self) -> str:
        """How many episodes raised and what the first of them said, in a line; empty where none did."""
        return errors_of(self.data)

    def table(self) -> pd.DataFrame:
        """Return a row for each episode: number, parameters, loss, status, kind, costs and gradient.

        Columns are named with their units.
        """
        from ...landscapes.export import frame

        return frame(self.data).rename(columns=LABELS)

    def plot(self, *, width: float | None = None) -> Picture:
        """Draw every loss and the best so far against episodes.

        The picture is matplotlib's figure, shown by a notebook as it is; `width` draws it for a page so wide [mm].
        Raises ValueError where there is no episode yet.
        """
        if not self.data.sizes["evaluation"]:
            raise ValueError(f"{self._name()} has no episode to draw yet")
        from ...landscapes.draw.figures.search import run_figure

        return run_figure(self.data, width=width)

    def __repr__(self) -> str:
        """Return in a line what searched and what it found."""
        count = self.data.sizes["evaluation"]
        found = f"best loss {self.best.loss:.6g}" if np.isfinite(self.data["loss"]).any() else "none succeeded"
        where = f", in {self.folder}" if self.folder else ""
        raised = "".join(f"; {one}" for one in (self.errors, self.remark) if one)
        return f"<Run of {self._name()}: {count} of {self.data.attrs['budget']} episodes, {found}{raised}{where}>"

    def _name(self) -> str:
        return f"{self.method} on {self.data.attrs['env']}, seed {self.seed}"
