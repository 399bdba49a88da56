"""Parts of a plasticine loss: the target's mass and distance field, and the distance of tools from plasticine."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from platformdirs import user_cache_path
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ...landscapes.space import sobol
from ...landscapes.storage.files import moved_by, replacing
from ..engines.mpm.boundaries import Kind, Tool
from ..engines.mpm.model import Model
from ..engines.mpm.raster import Raster

# ---- Solid shapes, filled evenly with particles.

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A box: its centre and its widths [m]."""

    center: Point
    widths: Point

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return float(np.prod(self.widths))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m]."""
        return np.subtract(self.center, np.divide(self.widths, 2)), np.add(self.center, np.divide(self.widths, 2))

    def place(self, u: Float[Tensor, "particle 3"]) -> Float[Tensor, "particle 3"]:
        """Map the unit cube onto the shape so that even stays even."""
        return u.new_tensor(self.center) + (u - 0.5) * u.new_tensor(self.widths)


@dataclass(frozen=True)
class Ball:
    """A ball: its centre and its radius [m]."""

    center: Point
    radius: float

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return 4.0 / 3.0 * float(np.pi) * self.radius**3

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m]."""
        return np.subtract(self.center, self.radius), np.add(self.center, self.radius)

    def place(self, u: Float[Tensor, "particle 3"]) -> Float[Tensor, "particle 3"]:
        """Map the unit cube onto the shape so that even stays even."""
        height, angle = 2 * u[:, 1] - 1, 2 * torch.pi * u[:, 2]
        around = (1 - height**2).sqrt()
        direction = torch.stack([around * angle.cos(), height, around * angle.sin()], dim=1)
        return u.new_tensor(self.center) + self.radius * u[:, :1] ** (1 / 3) * direction


@dataclass(frozen=True)
class Ring:
    """A flat ring that stands on `center`: inner and outer radius and height [m]."""

    center: Point
    inner: float
    outer: float
    height: float

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return float(np.pi) * (self.outer**2 - self.inner**2) * self.height

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m]."""
        return np.subtract(self.center, [self.outer, 0.0, self.outer]), np.add(
            self.center, [self.outer, self.height, self.outer]
        )

    def place(self, u: Float[Tensor, "particle 3"]) -> Float[Tensor, "particle 3"]:
        """Map the unit cube onto the shape so that even stays even."""
        radius = (self.inner**2 + u[:, 0] * (self.outer**2 - self.inner**2)).sqrt()
        angle = 2 * torch.pi * u[:, 2]
        offset = torch.stack([radius * angle.cos(), self.height * u[:, 1], radius * angle.sin()], dim=1)
        return u.new_tensor(self.center) + offset


Shape = Box | Ball | Ring


def shares(shapes: Sequence[Shape], total: int) -> list[int]:
    """Return how many of `total` particles each shape gets, by volume."""
    ends = np.cumsum([shape.volume for shape in shapes])
    bounds = np.rint(np.concatenate([[0.0], ends / ends[-1]]) * total).astype(int)
    return [int(count) for count in np.diff(bounds)]


def fill(shape: Shape, count: int, seed: int = 0) -> np.ndarray:
    """Return particles that fill a shape evenly (a scrambled Sobol sequence) [m], shape (particle, 3)."""
    return np.asarray(shape.place(sobol(count, 3, seed=seed)).numpy())


SOLID = 1e-4  # mass at a node of a grid 1/64 m wide from which it is the target's [kg]; PlasticineLab's
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Target:
    """Hold, at each node, the target's `mass` [kg] and the `distance` [m] to its nearest solid node, shape (node,)."""

    mass: Float[Tensor, " node"]
    distance: Float[Tensor, " node"]

    @classmethod
    def of(cls, model: Model, x: np.ndarray, device: str) -> Target:
        """Return the target that a model's particles are at `x` [m], shape (particle, 3), on its grid.

        Distances are from nodes with more than SOLID; what lies around them and holds any of the target costs nothing.
        """
        raster = Raster(model, model.mass, capacity=1, device="cpu")
        at_nodes = raster(torch.from_numpy(x)[None])[0]
        solid = min(SOLID * (64 * model.dx) ** 3, float(at_nodes.max()) / 2)
        empty = (at_nodes <= solid).numpy().reshape(model.nodes)
        distance = torch.from_numpy(model.dx * distance_transform_edt(empty)).flatten()
        return cls(at_nodes.to(device), distance.where(at_nodes == 0, 0.0).to(device))


def compare(mass: Float[Tensor, "batch node"], target: Target) -> Float[Tensor, "batch 2"]:
    """Return the difference of node masses from a target's [kg], and their distance from it [kg m].

    These are sum |m - m_target| and sum m d. Rows are summed one by one, because a batched sum rounds differently with
    each batch size.
    """
    rows = mass.unbind(dim=0)
    return torch.stack([torch.stack([(row - target.mass).abs().sum(), (row * target.distance).sum()]) for row in rows])


def contact(
    x: Float[Tensor, "batch particle 3"], tools: Float[Tensor, "batch slot 3"], movable: Sequence[Tool]
) -> Float[Tensor, " batch"]:
    """Return the sum over movable tools of the squared distance to the closest particle [m^2].

    Only the closest particle has a gradient: it is found first, and its distance is then the loss.
    """
    total = x.new_zeros(len(x))
    slot = 0
    for tool in movable:
        with torch.no_grad():
            closest = distance_outside(tool, x, tools[:, None, slot : slot + tool.slots]).argmin(dim=1)
        nearest = x[torch.arange(len(x), device=x.device), closest]
        total = total + distance_outside(tool, nearest, tools[:, slot : slot + tool.slots]) ** 2
        slot += tool.slots
    return total


def distance_outside(
    tool: Tool, x: Float[Tensor, "*batch 3"], pose: Float[Tensor, "*batch slot 3"]
) -> Float[Tensor, "*batch"]:
    """Return the distance of points from a tool [m], 0 inside; `pose` is its position, then a roller's angles.

    Raises ValueError for a cylinder, which does not move.
    """
    p = x - pose[..., 0, :]
    size = tool.size
    match tool.kind:
        case Kind.SPHERE:
            gap = p.norm(dim=-1) - size[0]
        case Kind.TORUS:
            gap = torch.hypot(torch.hypot(p[..., 0], p[..., 2]) - size[0], p[..., 1]) - size[1]
        case Kind.CAPSULE:
            along = p[..., 1].clamp(-size[0], size[0])
            gap = torch.stack([p[..., 0], p[..., 1] - along, p[..., 2]], dim=-1).norm(dim=-1) - size[1]
        case Kind.ROLLER:
            yaw = pose[..., 1, 1]
            axis = torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()], dim=-1)
            along = (p * axis).sum(dim=-1, keepdim=True).clamp(-size[0], size[0])
            gap = (p - along * axis).norm(dim=-1) - size[1]
        case Kind.CYLINDER:
            raise ValueError("a post does not move, so it has no contact term")
    outer: Tensor = gap.clamp_min(0)
    return outer


def load_or_make(name: str, content: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Return the result of `make`, from the user's cache if it was made from the same `content` before."""
    digest = hashlib.sha256(content.encode()).hexdigest()[:16]
    path = user_cache_path("gradscape") / "targets" / f"{name}-{digest}.npy"
    found = _read(path)
    if found is None:
        log.info("%s: simulating the demonstration to make its target", name)
        found = make()
        with moved_by("XDG_CACHE_HOME", "targets"), replacing(path) as partial, partial.open("wb") as file:
            np.save(file, found)
    return found


def _read(path: Path) -> np.ndarray | None:
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except (OSError, ValueError):
        return None
