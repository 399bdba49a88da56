"""Batches of the points of tiles: those that have a gradient and those that have none are evaluated apart."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..objective import Evaluation, Objective
from ..storage.store import SliceStore
from ..storage.tiles import Tile


def evaluate_tiles(
    objective: Objective, store: SliceStore, tiles: Sequence[Tile], batch: int, pending: Collection[Tile]
) -> Iterator[tuple[Tile, Evaluation]]:
    """Evaluate the points of those tiles that are pending, in order; a point without gradient has one of NaN."""
    kinds = [Batches(objective, store, tiles, batch, pending, grad).evaluations() for grad in (True, False)]
    left = [tile for tile in tiles if tile in pending]
    for tile, having, lacking in zip(left, *kinds, strict=True):
        yield tile, _merge(having, lacking, torch.from_numpy(store.sloped(tile)), store)


def _merge(having: Evaluation, lacking: Evaluation, sloped: Tensor, store: SliceStore) -> Evaluation:
    """Put both kinds of a tile's points into the order of its points."""
    dim = store.plane.dim
    blank = replace(lacking, grad=torch.full((len(lacking.loss), dim), torch.nan, dtype=torch.float64))
    order = torch.cat([sloped.nonzero(), (~sloped).nonzero()])[:, 0].argsort()
    return Evaluation.join([having, blank], dim=dim, grad=store.grad).rows(order)


@dataclass(frozen=True, eq=False)
class Batches:
    """The points of tiles that have a gradient, or with `grad` false those that have none, in batches.

    Where all points are of one kind, a batch is whole tiles: `batch` points or more. Otherwise batches go on from tile
    to tile, so that all are full but the last, however few points of the kind a tile has: they hold `batch` points, or
    the least multiple of it that the points of any tile fit into.

    Batches are the same however many of the tiles are `pending`, so that a run that goes on repeats them; each is
    evaluated at the points of tiles that are.
    """

    objective: Objective
    store: SliceStore
    tiles: Sequence[Tile]
    batch: int
    pending: Collection[Tile]
    grad: bool

    def evaluations(self) -> Iterator[Evaluation]:
        """Yield the evaluation of every pending tile's points of the kind, in order.

        No more is evaluated ahead than the batch that a tile's last point is in.
        """
        batches, dim = self.points(), self.store.plane.dim
        ahead, start = Evaluation.empty(dim, grad=self.grad), 0
        for tile in self.tiles:
            if tile not in self.pending:
                continue
            count = len(self._of(tile))
            while len(ahead.loss) < start + count:
                parts = [ahead.rows(slice(start, None)), self.objective.evaluate(next(batches), grad=self.grad)]
                ahead, start = Evaluation.join(parts, dim=dim, grad=self.grad), 0
            yield ahead.rows(slice(start, start + count))
            start += count

    def points(self) -> Iterator[Float[Tensor, "batch dim"]]:
        """Yield the points of one batch after another."""
        size, whole = self._size(), self.store.every == 1
        parts, room = list[Tensor](), size
        for tile in self.tiles:
            left = self._of(tile)
            while len(left):
                here, left = np.split(left, [len(left) if whole else room])
                if tile in self.pending:
                    parts.append(self.store.points(tile)[here])
                room -= len(here)
                if room <= 0:
                    if parts:
                        yield torch.cat(parts)
                    parts, room = [], size
        if parts:
            yield torch.cat(parts)

    def _size(self) -> int:
        """Return how many points a full batch has."""
        if self.store.every == 1:
            return self.batch
        most = max((len(self._of(tile)) for tile in self.tiles), default=0)
        return self.batch * max(1, -(-most // self.batch))

    def _of(self, tile: Tile) -> NDArray[np.intp]:
        """Return the numbers of a tile's points that are of the kind."""
        return np.flatnonzero(self.store.sloped(tile) == self.grad)
