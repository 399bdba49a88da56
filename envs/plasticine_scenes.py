"""The eight plasticine scenes of the paper, as data: geometry and material are PlasticineLab's, targets are ours."""

from __future__ import annotations

from typing import ClassVar

from .engines.manipulators import STICKY, Kind, Tool
from .plasticine import Anchor, Lump, Plasticine, Scene
from .shapes import Ball, Box, Point, Ring

SLAB = Lump(Box((0.5, 0.05, 0.5), (0.3, 0.1, 0.3)), 10_000)


def _finger(x: float, y: float, z: float, radius: float, step: Point) -> Anchor:
    return Anchor(Tool(Kind.SPHERE, (radius,), 0.9), (x, y, z), step)


class Assembly(Plasticine):
    """Lift a ball with two spheres and set it on a box."""

    name: ClassVar[str] = "assembly"
    scene: ClassVar[Scene] = Scene(
        lumps=(Lump(Box((0.6, 0.08, 0.5), (0.16, 0.16, 0.16)), 6000), Lump(Ball((0.3, 0.06, 0.5), 0.06), 4000)),
        anchors=tuple(_finger(x, 0.06, 0.5, 0.04, (0.009, 0.009, 0.009)) for x in (0.38, 0.22)),
        yield_stress=100.0,
        floor_friction=STICKY,
        target=(Box((0.6, 0.08, 0.5), (0.16, 0.16, 0.16)), Ball((0.6, 0.2205, 0.5), 0.06)),
    )


class Pinch(Plasticine):
    """Press a dent into the front of a cube with a sphere."""

    name: ClassVar[str] = "pinch"
    scene: ClassVar[Scene] = Scene(
        lumps=(Lump(Box((0.5, 0.1, 0.5), (0.2, 0.2, 0.2)), 10_000),),
        anchors=(
            Anchor(
                Tool(Kind.SPHERE, (0.04,), 0.9),
                (0.5, 0.35, 0.5),
                (0.02, 0.02, 0.02),
                lower=(0.1, 0.1, 0.1),
                upper=(0.9, 0.9, 0.9),
            ),
        ),
        yield_stress=50.0,
        floor_friction=STICKY,
    )


class RollingPin(Plasticine):
    """Roll a slab flat with a rolling pin."""

    name: ClassVar[str] = "rolling-pin"
    scene: ClassVar[Scene] = Scene(
        lumps=(SLAB,),
        anchors=(Anchor(Tool(Kind.ROLLER, (0.15, 0.03), 0.9), (0.5, 0.123, 0.5), (2 / 3, 1 / 15, 0.001)),),
        yield_stress=50.0,
        floor_friction=1.5,
    )


class Rope(Plasticine):
    """Bend a rope around a post by its two ends."""

    name: ClassVar[str] = "rope"
    scene: ClassVar[Scene] = Scene(
        lumps=(Lump(Box((0.5, 0.03, 0.73), (0.6, 0.06, 0.06)), 10_000),),
        anchors=tuple(_finger(x, 0.015, 0.82, 0.03, (0.01, 0.01, 0.01)) for x in (0.22, 0.78)),
        yield_stress=50.0,
        floor_friction=0.3,
        posts=((Tool(Kind.CYLINDER, (0.1, 0.2), 0.9), (0.39193, 0.0, 0.49908)),),
        target=(Ring((0.39193, 0.0, 0.49908), inner=0.106, outer=0.166, height=0.06),),
    )


class Table(Plasticine):
    """Bend one leg of a table outwards with a sphere."""

    name: ClassVar[str] = "table"
    scene: ClassVar[Scene] = Scene(
        lumps=(
            *(Lump(Box((x, 0.1, z), (0.04, 0.1, 0.04)), 2000) for x in (0.425, 0.575) for z in (0.425, 0.575)),
            Lump(Box((0.5, 0.18, 0.5), (0.2, 0.05, 0.2)), 2000),
        ),
        anchors=(_finger(0.5, 0.06, 0.5, 0.04, (0.03, 0.0, 0.03)),),
        yield_stress=50.0,
        floor_friction=0.3,
        poisson=0.05,
    )


class Torus(Plasticine):
    """Press a ring into a slab."""

    name: ClassVar[str] = "torus"
    scene: ClassVar[Scene] = Scene(
        lumps=(SLAB,),
        anchors=(
            Anchor(
                Tool(Kind.TORUS, (0.05, 0.03), 0.9), (0.5, 0.2, 0.5), (0.004, 0.004, 0.004), lower=(0.0, 0.05, 0.0)
            ),
        ),
        yield_stress=50.0,
        floor_friction=STICKY,
    )


class TripleMove(Plasticine):
    """Carry three blocks through the air with three pairs of spheres."""

    name: ClassVar[str] = "triple-move"
    scene: ClassVar[Scene] = Scene(
        lumps=tuple(Lump(Box((x, 0.05, 0.5), (0.1, 0.1, 0.1)), 3333) for x in (0.3, 0.5, 0.7)),
        anchors=tuple(_finger(x, 0.05, 0.5, 0.03, (0.01, 0.01, 0.01)) for x in (0.23, 0.37, 0.43, 0.57, 0.63, 0.77)),
        yield_stress=200.0,
        floor_friction=1.5,
        target=tuple(
            Box(center, (0.1, 0.1, 0.1))
            for center in ((0.2, 0.2, 0.5029), (0.8, 0.2, 0.2), (0.6254, 0.3436, 0.2002))
        ),
    )


class Writer(Plasticine):
    """Write a stroke into a slab with a pen."""

    name: ClassVar[str] = "writer"
    scene: ClassVar[Scene] = Scene(
        lumps=(SLAB,),
        anchors=(
            Anchor(
                Tool(Kind.CAPSULE, (0.03, 0.03), 0.0), (0.5, 0.13, 0.5), (0.01, 0.01, 0.01), lower=(0.0, 0.05, 0.0)
            ),
        ),
        yield_stress=50.0,
        floor_friction=STICKY,
    )
