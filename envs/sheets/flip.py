"""The Flip scene: a pan tosses a pancake so that it lands on its other side."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.episode import Part, View
from ...landscapes.space import ParameterSpace
from ..base import Fidelity, ModelPart
from ..controls import extend, ramp
from ..engines.sheets.contact import Floor, Pan, PanOverFloor
from ..engines.sheets.springs import Sheet
from ..outlines import rotate_about, triangles
from . import lattice
from .sheets import Drive, SheetOptions, SheetScene

ACROSS = 0.2  # the pancake's diameter [m]
AREAL_DENSITY, STIFFNESS = 3.0, 60.0  # [kg/m^2], [N/m]
THICK, MARK = 0.01, 0.009  # of the pancake and of the mark on its rim, as they are drawn [m]
SEGMENTS = 5
BEND, DAMPING = 0.8, 0.02  # the bending springs' share, the springs' damping [N s/m]
FLOOR = -0.25  # its height: the pan's underside comes down to -0.197 at most [m]
PAN = Pan(flat=0.14, bend=0.07, sweep=math.asin(6 / 7), thickness=0.03)
LOWER, UPPER = (-0.075, -0.075, -0.6), (0.075, 0.15, 0.6)  # of a waypoint [m], [m], [rad]


@dataclass(frozen=True)
class FlipOptions(SheetOptions):
    """`damping` of the springs [N s/m], `drag` of the air [1/s]; `bending` is the share of the bending springs.

    `rim`: the pan has a bent edge, or is a flat disc of the full radius. `floor`: whether there is a floor below the
    pan. `friction` is Coulomb's coefficient of pan and floor.
    """

    damping: float = DAMPING
    drag: float = 0.0
    bending: float = BEND
    rim: bool = True
    floor: bool = True
    friction: float = 0.0


class Flip(SheetScene):
    """Toss a pancake with a pan so that it ends on its other side.

    Model: the pancake is 20 cm across, weighs 3 kg/m^2 and resists stretching by 60 N/m, which is much softer for its
    weight than the cloth. It starts at rest in the middle of the pan; x right, y up, z to the front. The pan has a
    radius of 0.2 m and an edge that bends up along an arc of 7 cm, to 3.4 cm. It moves in x and y and tilts about z,
    through the middle of its bottom, regardless of its load. A floor lies 0.25 m below the start of the pan. That is 5
    cm below the lowest point that the underside of the pan can reach in the box. An episode lasts 1 s.
    Parameters: x [m], y [m] and tilt [rad] of the pan at the end of each of 5 segments of 0.2 s, starting at 0 and
    linear in between.
    Loss: mean distance [m] of the left-, right-, back- and frontmost vertices from their initial positions with left
    and right exchanged. CMA-ES at draft found the example `flip` in 2400 episodes; it flips the pancake at every
    fidelity.
    Preset paper: contact changes the velocity of vertices that are in contact, as the supplement says (contact=start).
    Simplifications: the pan has no handle and no mass. The pancake is a sheet without thickness. Pan and floor are
    frictionless, because contact removes only the normal part of a velocity.
    Source: task Flip of "Rethinking Optimization with Differentiable Simulation from a Global Perspective" (CoRL 2022),
    appendix A.2.3; we chose the geometry and material that it does not give.
    """

    name = "flip"
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 400, resolution=8),
        "standard": Fidelity("standard", dt=1 / 1000, resolution=24),
        "reference": Fidelity("reference", dt=1 / 8000, resolution=32, precision="float64"),
    }
    examples: ClassVar[dict[str, tuple[float, ...]]] = {
        "flip": (
            *(0.042, -0.016, -0.463, -0.039, -0.071, 0.596, 0.041, -0.055, -0.115),
            *(0.045, -0.012, -0.138, 0.074, 0.003, -0.005),
        )
    }
    model_parts: ClassVar[tuple[ModelPart, ...]] = (
        ModelPart("springs' damping", {"damping": 0.0}, "undamped springs"),
        ModelPart("bending springs", {"bending": 0.0}, "a membrane"),
        ModelPart("rim", {"rim": False}, "a flat pan of the same radius"),
        ModelPart("floor", {"floor": False}, "what misses the pan falls on"),
        ModelPart("exact contact", {"contact": "start"}, "vertices stop once they are inside"),
        ModelPart("friction", {"friction": 0.3}, "friction of pan and floor", missing=True),
        ModelPart("air", {"drag": 0.5}, "drag of the air", missing=True),
    )
    decisions = SEGMENTS
    duration: ClassVar[float] = 1.0
    Options: ClassVar[type[Any]] = FlipOptions
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {"contact": "start"}}
    view: ClassVar[View] = View((-0.24, FLOOR, -0.2), (0.24, 0.26, 0.2), eye=(0.2, 0.5, 1.0), ground=FLOOR)
    space = ParameterSpace(
        tuple(f"pan {what}, segment {k}" for k in range(1, SEGMENTS + 1) for what in ("x", "y", "tilt")),
        torch.tensor(LOWER * SEGMENTS, dtype=torch.float64),
        torch.tensor(UPPER * SEGMENTS, dtype=torch.float64),
        ("m", "m", "rad") * SEGMENTS,
    )

    @property
    def pan(self) -> Pan:
        """The pan, with or without its edge."""
        flat = {} if self.options.rim else {"flat": PAN.radius, "sweep": 0.0}
        return replace(PAN, friction=self.options.friction, **flat)

    @property
    def surface(self) -> Pan | PanOverFloor:
        """The pan, above a floor unless there is none."""
        return PanOverFloor(self.pan, Floor(FLOOR, self.options.friction)) if self.options.floor else self.pan

    def _sheet(self) -> Sheet:
        cells, options = self.fidelity.resolution, self.options
        points, pitch = lattice.disc(cells), ACROSS / cells
        pairs, rest, weight = lattice.springs(points, reach=max(1, round(cells / 4)), bend=options.bending)
        x = np.stack([points[:, 0] * pitch, np.zeros(len(points)), points[:, 1] * pitch], axis=1)
        area = lattice.areas(points)
        mass = AREAL_DENSITY * math.pi * (ACROSS / 2) ** 2 * area / area.sum()
        return Sheet(x, pairs, rest * pitch, weight, mass, damping=options.damping, drag=options.drag)

    def _drive(self, x: Float[Tensor, "batch dim"]) -> Drive:
        course = ramp(x.new_zeros(3), x.view(len(x), SEGMENTS, 3), self.own_steps)
        poses = extend(course, self.steps + 1, then=course[:, -1:])
        return Drive(x.new_zeros(len(x), 3), x.new_full((len(x), len(self.sheet.x)), STIFFNESS), poses)

    def _extremes(self) -> list[int]:
        """Return the numbers of the left-, right-, back- and frontmost vertices."""
        x, _, z = self.sheet.x.T
        return [int(i) for i in (x.argmin(), x.argmax(), z.argmin(), z.argmax())]

    def _loss(self, end: Float[Tensor, "vertex 3"]) -> Float[Tensor, ""]:
        extremes = self._extremes()
        loss: Tensor = (end[extremes] - self._goal().to(end)).norm(dim=1).mean()
        return loss

    def _goal(self) -> Float[Tensor, "vertex 3"]:
        """Return the target positions of those vertices [m]."""
        return torch.from_numpy(self.sheet.x[self._extremes()] * (-1.0, 1.0, 1.0))

    def _surroundings(self, poses: Float[Tensor, "frame 3"]) -> Mapping[str, Float[Tensor, "frame 3"]]:
        return {"pan": poses}

    def _parts(self, frames: Float[Tensor, "frame vertex 3"], poses: Float[Tensor, "frame 3"]) -> tuple[Part, ...]:
        faces = triangles(lattice.disc(self.fidelity.resolution))
        place = torch.cat([poses[:, :2], torch.zeros_like(poses[:, :1])], dim=1)[:, None]
        size = (self.pan.flat, self.pan.bend, self.pan.sweep)
        return (
            Part("sheet", "dough", frames, (THICK,), faces=faces),
            Part("pan", "iron", place, size, rotate_about(2, poses[:, 2])),
            Part("sphere", "rubber", frames[:, self._extremes()[:1]], (MARK,)),  # one of the four, to tell its sides
            Part("sphere", "target", self._goal()[:1].expand(len(frames), 1, 3), (1.5 * MARK,)),
        )
