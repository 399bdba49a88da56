"""A wave in three parameters, a plane through it, and slices of it on disk, for tests of how slices are filled."""

from pathlib import Path

import torch
import xarray as xr

from gradscape.landscapes.plane import Plane
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.store import SliceStore

SPACE = ParameterSpace.box(("x", "y", "z"), -2.0, 2.0, "m")
PLANE = Plane.through(SPACE, SPACE.center, ["x", "z"], resolution=(18, 16))


def wave(x: torch.Tensor) -> torch.Tensor:
    return (3 * x).sin().prod(dim=1) + x.exp().sum(dim=1)


def store_at(path: Path, *, grad: bool = True) -> SliceStore:
    return SliceStore.open_or_create(path, PLANE, SPACE, identity={"objective": "wave"}, grad=grad)


def same(one: xr.Dataset | SliceStore, other: xr.Dataset | SliceStore) -> bool:
    """Whether two slices have the same bits."""
    a, b = (each.dataset() if isinstance(each, SliceStore) else each for each in (one, other))
    return all(a[name].to_numpy().tobytes() == b[name].to_numpy().tobytes() for name in ("loss", "grad", "status"))
