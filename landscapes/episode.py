"""An episode to draw: its frames over time, and the look of its objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

if TYPE_CHECKING:
    from .draw.figure import Picture

Point = tuple[float, float, float]
Shape = Literal[
    "lump",  # the body that particles fill: their mean distance
    "sheet",  # a triangle surface whose vertices are given, with `faces`: its thickness, if it has any
    "path",  # a tube through points, round at both ends: radius
    "trail",  # where a point has been so far: radius
    "sphere",  # radius
    "capsule",  # half the length of its axis, which is y, radius
    "torus",  # around the y axis: radius of the ring, of the tube
    "cylinder",  # around the y axis: radius, half its height
    "box",  # three widths
    "ring",  # flat, standing on its place: inner and outer radius, height
    "ladle",  # its place is the centre of the rim: radius of the bowl, half the thickness of its shell, handle's height
    "pan",  # its place is the middle of the bottom: radius of the bottom, of the arc at its edge, the arc's angle [rad]
    "tank",  # open at the top, standing on its place: three widths
]
Material = Literal[
    "syrup",
    "sugar",
    "plasticine",
    "cloth",
    "dough",
    "rubber",
    "steel",
    "iron",
    "wood",
    "board",
    "glass",
    "target",
    "goal",  # a target drawn alone
]


@dataclass(frozen=True, eq=False)
class Part:
    """The shape, material and motion of one object in an episode.

    `at` [m], shape (frame, point, 3), is its position: the vertices of a sheet, the particles of a lump, the points of
    a path, or the positions of copies of a solid of `size` [m]. `turn`, shape (frame, 3, 3), rotates solids about their
    positions; `tint` distinguishes parts of one material.
    """

    shape: Shape
    material: Material
    at: Float[Tensor, "frame point 3"]
    size: tuple[float, ...] = ()
    turn: Float[Tensor, "frame 3 3"] | None = None
    faces: Int[Tensor, "face 3"] | None = None
    tint: int = 0


@dataclass(frozen=True)
class View:
    """The visible box from `lower` to `upper` [m], seen from the direction `eye`, y upwards.

    `ground` is the height of the drawn ground [m], None for none.
    """

    lower: Point
    upper: Point
    eye: Point = (0.35, 0.5, 1.0)
    ground: float | None = 0.0


@dataclass(frozen=True, eq=False)
class Episode:
    """The frames of one episode to draw.

    `time` [s], shape (frame,); `points` [m], body name -> shape (frame, point, axis); `tools` [m], tool name -> shape
    (frame, axis). `parts` describe their look, and `view` the viewpoint.
    """

    time: Float[Tensor, " frame"]
    points: Mapping[str, Float[Tensor, "frame point 3"]]
    tools: Mapping[str, Float[Tensor, "frame 3"]] = field(default_factory=dict)
    parts: tuple[Part, ...] = ()
    view: View | None = None

    def viewpoint(self) -> View:
        """Return the view of the episode, or one that includes all its parts if it has none."""
        if self.view:
            return self.view
        every = np.concatenate([part.at.reshape(-1, 3).numpy() for part in self.parts])
        low, high = every.min(axis=0), every.max(axis=0)
        room = 0.1 * float((high - low).max() or 1.0)
        return View(tuple((low - room).tolist()), tuple((high + room).tolist()), ground=None)

    def show(self, keys: int = 5) -> Picture:
        """Draw this many key frames in a row, evenly spaced from the first to the last; a notebook shows the picture.

        Raises ValueError where the episode has no `parts`, which describe the look of its objects.
        """
        from .draw.figure import figure_of

        return figure_of(self, keys=keys)
