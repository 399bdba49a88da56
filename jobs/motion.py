"""What a sweep moves from frame to frame: a third parameter, where the episode ends, the width of a smoothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..landscapes.capacity import BLOCK, Need, require
from .folder import SWEEP

if TYPE_CHECKING:
    import xarray as xr
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.plane import Plane

SMOOTHING, WIDEST = "smoothing", 0.25  # the widest Gaussian's standard deviation, as a fraction of the box's sides
SAME = 1e-9  # of a parameter's unit: as near as rounding lets a point on a plane be to it
HORIZON = "horizon"  # a scene option: the episode's duration as a multiple of the scene's own
STORE_MEMORY, STORE_FILES = 100e3, 25  # what a slice takes beside its samples: bytes of its arrays' records, and files
FRAMES, ONLY = SWEEP.files[:2]  # the folder of a sweep's slices, and the slice where there is one


@dataclass(frozen=True)
class Motion:
    """Say what moves: frames show `slices` of what is sampled on `planes` at the `values` of what `label` names.

    `env_at` makes the environment of a plane, by its number. A `logarithmic` one moves by equal ratios.
    """

    label: str
    values: tuple[float, ...]
    planes: tuple[Plane, ...]
    env_at: Callable[[int], Environment]
    slices: Callable[[Sequence[xr.Dataset]], Sequence[xr.Dataset]] = list
    logarithmic: bool = False

    @classmethod
    def of(cls, env: Environment, plane: Plane, over: int | str, frames: int) -> Motion:
        """Return what `over` names: a parameter, horizon or smoothing.

        Raises ValueError for a parameter that the plane varies, and for a horizon that the scene does not have.
        """
        if over == SMOOTHING:
            return _smoothing(env, plane, frames)
        return _horizon(env, plane, frames) if over == HORIZON else _parameter(over, env, plane, frames)

    @property
    def stores(self) -> tuple[str, ...]:
        """Where in the sweep's folder the slice of each plane is."""
        if len(self.planes) == 1:
            return (ONLY,)
        return tuple(f"{FRAMES}/{number:03d}.zarr" for number in range(len(self.planes)))


def refuse_too_large(plane: Plane, frames: int, folder: Path, *, grad: bool, over: int | str) -> None:
    """Refuse a sweep of which a single frame is larger than this machine, or all of them are.

    Raises TooLargeError, which is a ValueError.
    """

    def need(side: int, count: int) -> Need:
        return need_of((side,) * plane.rank, plane.dim, count, grad=grad, over=over)

    side = max(plane.resolution)
    require("resolution", side, lambda points: need(points, 1), folder)
    require("frames", frames, lambda count: need(side, count), folder)


def need_of(shape: tuple[int, ...], dim: int, frames: int, *, grad: bool, over: int | str) -> Need:
    """Return what sampling a sweep and filming it takes: every frame's slice is stored, of a smoothing's only one."""
    from ..landscapes.storage.arrays import need_of as slice_need

    slices, samples = 1 if over == SMOOTHING else frames, math.prod(shape)
    array, one = samples * (9 + 8 * dim * grad), slice_need(shape, dim, grad=grad)
    memory = one.memory + slices * (STORE_MEMORY + array) + frames * 9.0 * samples
    return Need(memory, one.disk + slices * (STORE_FILES * BLOCK + float(array)))


def _parameter(name: int | str, env: Environment, plane: Plane, frames: int) -> Motion:
    """Move a parameter from one of its bounds to the other."""
    import torch

    from ..landscapes.space import LOG10, to_values

    number = env.space.index(name)
    if _holds(plane, number):
        raise ValueError(
            f"a sweep moves a third parameter, {HORIZON} or {SMOOTHING}; got --over {name}, which the slice varies"
        )
    space = env.space
    places = torch.linspace(float(space.lower[number]), float(space.upper[number]), frames, dtype=torch.float64)
    planes = tuple(replace(plane, origin=_with(plane.origin, number, place)) for place in places.tolist())
    scale = space.scales[number]
    values = tuple(to_values(places[:, None], [scale])[:, 0].tolist())
    return Motion(space.labels[number], values, planes, lambda _: env, logarithmic=scale == LOG10)


def _horizon(env: Environment, plane: Plane, frames: int) -> Motion:
    """End the episode later and later, up to the scene's own end."""
    whole = env.horizon
    if whole is None:
        raise ValueError(
            f"{env.name} has no {HORIZON} to sweep over: no setting says how long an episode is (horizon= of a "
            f"function names one); sweep a third parameter or {SMOOTHING}"
        )
    if env.horizon_option == HORIZON and whole != 1 and env.model_version:
        raise ValueError(f"--over {HORIZON} moves that option itself; leave out --set {HORIZON}=...")
    shares = [(frame + 1) / frames for frame in range(frames)]
    values = tuple(100 * share for share in shares)
    return Motion(
        "share of the scene's duration [%]", values, (plane,) * frames,
        lambda number: env.with_horizon(shares[number] * whole),
    )  # fmt: skip


def _smoothing(env: Environment, plane: Plane, frames: int) -> Motion:
    """Average one slice over wider and wider Gaussians."""
    widths = np.linspace(0, WIDEST, frames).tolist()

    def slices(sampled: Sequence[xr.Dataset]) -> list[xr.Dataset]:
        from ..landscapes.smoothing import smooth

        return [smooth(sampled[0], width) for width in widths]

    label = "smoothing width [% of the box's sides]"
    return Motion(label, tuple(100 * width for width in widths), (plane,), lambda _: env, slices)


def _holds(plane: Plane, number: int) -> bool:
    """Say whether moving a parameter leads from a plane to itself."""
    import torch

    step = torch.zeros(plane.dim, dtype=torch.float64)
    step[number] = 1.0
    return bool(plane.distance(plane.origin + step) < SAME)


def _with(origin: Tensor, number: int, value: float) -> Tensor:
    origin = origin.clone()
    origin[number] = value
    return origin
