"""A run of an optimiser for users: its episodes, the best of them, its picture."""

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
    """The episode with the lowest loss: the values `x` of its parameters in their own units, and its number, from 1."""

    x: Float[Tensor, " dim"]
    loss: float
    episode: int


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """The episodes of a run: `data` is an xarray dataset of x(evaluation, dim), loss(evaluation) and others.

    `x` are points as `evaluate` takes them: a logarithmic parameter is its decimal logarithm. `best` and `table` have
    values. `grad`(evaluation, dim) is the gradient where it was requested, `status` the end of the episode, and `kind`
    the purpose of the evaluation. `episodes`, `forwards` and `seconds` [s] are the cost of the run up to that row.
    `forwards` are forward equivalents: episodes without gradient. `folder` contains its files, None for one in memory.
    """

    data: xr.Dataset
    folder: Path | None = None

    @cached_property
    def identity(self) -> dict[str, Any]:
        """The settings that decide the numbers, as plain JSON."""
        return stored_identity(self.data)

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """How the run was made: command, date, versions, the loss's unit."""
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
        """The episode with the lowest loss. Raises ValueError where no episode has succeeded."""
        loss = self.data["loss"].to_numpy()
        if not np.isfinite(loss).any():
            raise ValueError(f"{self._name()} has no best episode: none of {len(loss)} succeeded")
        row = int(np.nanargmin(loss))
        x = to_values(torch.from_numpy(self.data["x"].to_numpy()[row].copy()), stored_scales(self.data))
        return BestEpisode(x, float(loss[row]), row + 1)

    @property
    def remark(self) -> str:
        """The method's remark on its search, such as the method that `auto` chose; empty for most."""
        return str(self.data.attrs.get("remark", ""))

    @property
    def errors(self) -> str:
        """The number of episodes that raised and the first message, in a line; empty where none did."""
        return errors_of(self.data)

    def table(self) -> pd.DataFrame:
        """Return a row for each episode: number, parameters, loss, status, kind, costs and gradient.

        Columns are named with their units.
        """
        from ...landscapes.export import frame

        return frame(self.data).rename(columns=LABELS)

    def plot(self, *, width: float | None = None) -> Picture:
        """Draw every loss and the best so far against episodes.

        It returns a matplotlib figure, which notebooks show. `width` draws it for a page of this width [mm]. Raises
        ValueError where there is no episode yet.
        """
        if not self.data.sizes["evaluation"]:
            raise ValueError(f"{self._name()} has no episode to draw yet")
        from ...landscapes.draw.figures.search import run_figure

        return run_figure(self.data, width=width)

    def __repr__(self) -> str:
        """Return the search and its result in a line."""
        count = self.data.sizes["evaluation"]
        found = f"best loss {self.best.loss:.6g}" if np.isfinite(self.data["loss"]).any() else "none succeeded"
        where = f", in {self.folder}" if self.folder else ""
        raised = "".join(f"; {one}" for one in (self.errors, self.remark) if one)
        return f"<Run of {self._name()}: {count} of {self.data.attrs['budget']} episodes, {found}{raised}{where}>"

    def _name(self) -> str:
        return f"{self.method} on {self.data.attrs['env']}, seed {self.seed}"
