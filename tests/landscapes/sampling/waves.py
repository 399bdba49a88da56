"""A wave in three parameters, a plane through it, and slices of it on disk, for tests of how slices are filled."""

from pathlib import Path

import torch
import xarray as xr

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.store import SliceStore

SPACE = ParameterSpace.box(("x", "y", "z"), -2.0, 2.0, "m")
PLANE = Plane.through(SPACE, SPACE.center, ["x", "z"], resolution=(18, 16))


class Counted(Objective):
    """A wave that counts what it is asked, stops after so many points, and has memory for so many.

    `sizes` holds how many points each call has, `batches` the points of those that were answered, by whether gradients
    were asked for.
    """

    space, name = SPACE, "counted"

    def __init__(
        self, stop_after: int | None = None, batch: int = 1, room: int | None = None, error: Exception | None = None
    ) -> None:
        self.stop_after, self.preferred_batch, self.room, self.error = stop_after, batch, room, error or MemoryError()
        self.sizes = list[int]()
        self.batches: dict[bool, list[list[tuple[float, ...]]]] = {True: [], False: []}

    @property
    def asked(self) -> list[tuple[float, ...]]:
        """Every point, in order."""
        return [point for batches in self.batches.values() for batch in batches for point in batch]

    def count(self, grad: bool) -> int:
        """How many points were asked for with gradients, or without."""
        return sum(map(len, self.batches[grad]))

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        self.sizes.append(len(x))
        if self.stop_after is not None and self.count(True) + self.count(False) >= self.stop_after:
            raise KeyboardInterrupt
        if self.room is not None and len(x) > self.room:
            raise self.error
        self.batches[grad].append(list(map(tuple, x.tolist())))
        return self.answer(x, grad=grad)

    def answer(self, x: torch.Tensor, *, grad: bool) -> Evaluation:
        return from_torch(wave, SPACE).evaluate(x, grad=grad)


def wave(x: torch.Tensor) -> torch.Tensor:
    return (3 * x).sin().prod(dim=1) + x.exp().sum(dim=1)


def store_at(path: Path, *, grad: bool = True) -> SliceStore:
    return SliceStore.open_or_create(path, PLANE, SPACE, identity={"objective": "wave"}, grad=grad)


def same(one: xr.Dataset | SliceStore, other: xr.Dataset | SliceStore) -> bool:
    """Whether two slices have the same bits."""
    a, b = (each.dataset() if isinstance(each, SliceStore) else each for each in (one, other))
    return all(a[name].to_numpy().tobytes() == b[name].to_numpy().tobytes() for name in ("loss", "grad", "status"))
