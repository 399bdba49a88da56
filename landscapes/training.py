"""Checkpoints of a training as points of a space: reading them, and the plane in which they move.

A checkpoint is a state dict of torch (.pt, .pth), a zip of Stable-Baselines3, which contains its policy's state dict,
or arrays of NumPy (.npy, .npz). Nothing in them is executed: torch reads only weights, NumPy no pickles.
"""

from __future__ import annotations

import hashlib
import io
import math
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .convert import from_attribute, to_attribute
from .objective import Objective, evaluate, in_box
from .plane import Plane
from .space import ParameterSpace

Arrays = dict[str, NDArray[Any]]
TORCH, ZIP, NUMPY = (".pt", ".pth"), ".zip", (".npy", ".npz")
SUFFIXES = (*TORCH, ZIP, *NUMPY)
POLICY = "policy.pth"  # in a zip of Stable-Baselines3
ACTORS = (  # what decides in a policy of Stable-Baselines3: of PPO and A2C, of SAC, of TD3 and DDPG
    ("mlp_extractor.policy_net.", "action_net."),
    ("actor.latent_pi.", "actor.mu."),
    ("actor.mu.",),
)
ROUNDING = 1e-9  # distance from a plane that counts as none [half-widths of the box]
LISTED = 6  # arrays that a message names
ATTRIBUTE = "training"  # of a slice that holds the path of a training


@dataclass(frozen=True, eq=False)
class Training:
    """The checkpoints of a training in order: `names` of files, and points `x`, shape (checkpoint, dim)."""

    names: tuple[str, ...]
    x: Float[Tensor, "checkpoint dim"]

    @classmethod
    def read(cls, folder: Path, objective: Objective) -> Training:
        """Return the checkpoints in a folder in the order of their names, sorted numerically: 9 comes before 10.

        Raises ValueError for fewer than three, and for one without the parameters of the objective. Raises it for one
        outside the bounds, unless points there are evaluated, too.
        """
        files = checkpoints_in(folder)
        if len(files) < 3:
            raise ValueError(
                f"a plane needs at least three checkpoints ({', '.join(SUFFIXES)}); {folder} has {len(files)}"
            )
        x = torch.stack([read_checkpoint(one, objective.space, objective.name) for one in files])
        if not objective.beyond_box:
            _refuse_beyond(x, objective.space, objective.name, folder)
        return cls(tuple(one.name for one in files), x)

    def plane(self, space: ParameterSpace, resolution: int) -> Plane:
        """Lay a plane through the last checkpoint, along the two principal directions of the others about it.

        Li et al. 2018, section 7. Their code centres the differences from the last one, so the plane through that one
        is then not the nearest to the others; here they are not centred. As in `principal_plane` it is found in the box
        scaled to [-1, 1], and coordinates are in half-widths of the box. Raises ValueError where the checkpoints spread
        in a single direction.
        """
        half = (space.upper - space.lower) / 2
        z = (self.x - space.center) / half
        flat = Plane.principal(z, resolution=resolution, about=z[-1])
        return replace(flat, origin=space.center + half * flat.origin, basis=half * flat.basis)

    def over(self, plane: Plane, objective: Objective) -> TrainingPath:
        """Evaluate the checkpoints, and return their positions on a plane through the last, or distances from it."""
        half = (objective.space.upper - objective.space.lower) / 2
        z, scaled = self.x / half, replace(plane, origin=plane.origin / half, basis=plane.basis / half)
        u, off = scaled.project(z), scaled.distance(z)
        explained = 1 - float(off.square().sum() / (z - z[-1]).square().sum())
        loss = evaluate(objective, self.x, grad=False).loss
        rows = zip(self.names, *u.T.tolist(), off.tolist(), loss.tolist(), strict=True)
        return TrainingPath(explained, tuple(TrainedPoint(*row) for row in rows))


@dataclass(frozen=True)
class TrainedPoint:
    """The position of a checkpoint: plane coordinates, `distance` off it [half-widths of the box], its own `loss`."""

    name: str
    u: float
    v: float
    distance: float
    loss: float


@dataclass(frozen=True)
class TrainingPath:
    """The path of a training over a slice.

    `explained` is the share of the checkpoints' squared distances from the last one that is in the plane, in
    half-widths of the box.
    """

    explained: float
    checkpoints: tuple[TrainedPoint, ...]

    @property
    def farthest(self) -> float:
        """The largest distance of a checkpoint from the plane [half-widths of the box], 0 if it is rounding."""
        most = max(one.distance for one in self.checkpoints)
        return most if most > ROUNDING else 0.0

    def sentence(self) -> str:
        """Describe how much of the training the plane shows."""
        count = f"{len(self.checkpoints)} checkpoints"
        if not self.farthest:
            return f"{count}, all of them in the plane"
        return (
            f"{count}: the plane has {100 * self.explained:.3g} % of their squared distances from the last, and the "
            f"farthest is {self.farthest:.2g} half-widths of the box off it"
        )

    def attribute(self) -> dict[str, str]:
        """Return the text of the attribute in which a slice stores it."""
        return to_attribute(ATTRIBUTE, self)

    @classmethod
    def of(cls, dataset: xr.Dataset) -> TrainingPath | None:
        """Read it from a slice, None where the slice has none."""
        return from_attribute(cls, dataset.attrs, ATTRIBUTE)


def _refuse_beyond(x: Float[Tensor, "checkpoint dim"], space: ParameterSpace, who: str, folder: Path) -> None:
    """Raise ValueError for checkpoints outside the bounds, where nothing is evaluated."""
    far = (space.to_unit(x) - 0.5).abs()
    if beyond := int((~in_box(space, x)).sum()):
        row, column = divmod(int(far.argmax()), space.dim)
        value, low, high = (float(one) for one in (x[row, column], space.lower[column], space.upper[column]))
        raise ValueError(
            f"{beyond} of {len(x)} checkpoints in {folder} are outside the bounds of {who}: {space.names[column]} is "
            f"{value:.3g}, bounds {low:.3g} to {high:.3g}; give it wider bounds"
        )


def checkpoints_in(folder: Path) -> list[Path]:
    """Return the files in a folder that can be checkpoints, sorted by name with numbers as numbers."""
    return sorted((one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES), key=_order)


def digest_training(folder: Path) -> str:
    """Return a digest of the checkpoints in a folder."""
    found = hashlib.sha256()
    for file in checkpoints_in(folder):
        found.update(file.name.encode() + file.read_bytes())
    return found.hexdigest()[:12]


def _order(file: Path) -> list[tuple[int, str]]:
    """Return the sorting key of files by name, with numbers as numbers."""
    parts = re.split(r"(\d+)", file.name)
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def read_checkpoint(path: Path, space: ParameterSpace, who: str) -> Float[Tensor, " dim"]:
    """Return the point of a checkpoint.

    Arrays are found by the names of those of a space `of_weights`, or else by their order. Raises ValueError for an
    invalid checkpoint, and where its arrays do not match those of `who`.
    """
    try:
        arrays = _read_arrays(path)
    except Exception as error:  # whatever torch, zipfile and NumPy raise of a file that is none
        raise ValueError(f"{path} cannot be read as a checkpoint: {' '.join(str(error).split())[:200]}") from None
    kinds = "f" if len(arrays) > 1 else "iuf"  # counters lie among weights, which are no whole numbers
    floats = {name: one for name, one in arrays.items() if one.dtype.kind in kinds}
    values = np.concatenate([one.ravel() for one in _chosen(floats, path, space, who)]).astype(np.float64)
    if lost := int((~np.isfinite(values)).sum()):
        raise ValueError(f"{path} has {lost} numbers that are not finite")
    return space.from_values(torch.from_numpy(values))


def _read_arrays(path: Path) -> Arrays:
    """Return the arrays of a checkpoint by name, in order; for Stable-Baselines3, those that decide actions."""
    if path.suffix.lower() == ".npy":
        return {"": np.load(path, allow_pickle=False)}
    if path.suffix.lower() == ".npz":
        with np.load(path, allow_pickle=False) as held:
            return dict(held)
    if path.suffix.lower() in TORCH:
        return _arrays_in(torch.load(path, map_location="cpu", weights_only=True))
    with zipfile.ZipFile(path) as held:
        if POLICY not in held.namelist():
            raise ValueError(f"it is a zip without {POLICY}, which zips of Stable-Baselines3 contain")
        found = _arrays_in(torch.load(io.BytesIO(held.read(POLICY)), map_location="cpu", weights_only=True))
    for prefixes in ACTORS:
        if all(any(name.startswith(prefix) for name in found) for prefix in prefixes):
            return {name: one for name, one in found.items() if name.startswith(prefixes)}
    return found


def _arrays_in(held: Any) -> Arrays:
    """Return the arrays of a state dict, or of the only one in a file that a training has saved."""
    if isinstance(held, Tensor):
        held = {"": held}
    tensors = {str(name): one for name, one in held.items() if isinstance(one, Tensor)}
    within = [one for one in held.values() if isinstance(one, Mapping) and one and _has_tensors(one)]
    if not tensors and len(within) == 1:
        return _arrays_in(within[0])
    if not tensors:
        raise ValueError(f"it contains {len(within)} state dicts; save only that of the weights")
    kinds = {name: torch.float64 if one.is_floating_point() else one.dtype for name, one in tensors.items()}
    return {name: one.detach().to(kinds[name]).numpy() for name, one in tensors.items()}


def _has_tensors(held: Mapping[Any, Any]) -> bool:
    return all(isinstance(one, Tensor) for one in held.values())


def _chosen(arrays: Arrays, path: Path, space: ParameterSpace, who: str) -> list[NDArray[Any]]:
    """Return the arrays of the parameters, in their order. Raises ValueError where they are missing."""
    wanted, there = space.arrays, list(arrays.values())
    if wanted and wanted.keys() <= arrays.keys():
        pairs = [(name, name) for name in wanted]
    elif [one.shape for one in there] == [(space.dim,)] or (not wanted and sum(one.size for one in there) == space.dim):
        return there
    elif wanted and len(wanted) == len(arrays):
        pairs = list(zip(arrays, wanted, strict=True))
    else:
        takes = _listed(wanted) if wanted else f"{space.dim} numbers"
        held = _listed({name: one.shape for name, one in arrays.items()})
        raise ValueError(f"{who} takes {takes}; {path} has {held}")
    for name, own in pairs:
        if arrays[name].shape != wanted[own]:
            raise ValueError(
                f"{who} takes {own} of shape {wanted[own]}; {path} has {name} of shape {arrays[name].shape}"
            )
    return [arrays[name] for name, _ in pairs]


def _listed(shapes: Mapping[str, tuple[int, ...]]) -> str:
    """Return the names and shapes of arrays, and their total size, in words."""
    first = [f"{name or 'an array'} {shape}" for name, shape in list(shapes.items())[:LISTED]]
    more = [f"{len(shapes) - LISTED} more"] if len(shapes) > LISTED else []
    total = sum(math.prod(shape) for shape in shapes.values())
    return f"{len(shapes)} arrays of {total} numbers ({', '.join([*first, *more])})"
