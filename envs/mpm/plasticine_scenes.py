"""The eight plasticine scenes of the paper, as data: geometry and material are PlasticineLab's, targets are ours."""

from __future__ import annotations

from typing import ClassVar

from ..base import Fidelity, ModelPart
from ..engines.mpm.boundaries import STICKY, Kind, Tool
from .plasticine import DEMONSTRATION, Anchor, Piece, Plasticine, Scene, fidelities
from .targets import Ball, Box, Point, Ring

SLAB = Piece(Box((0.5, 0.05, 0.5), (0.3, 0.1, 0.3)), 10_000)


def _finger(x: float, y: float, z: float, radius: float, step: Point) -> Anchor:
    return Anchor(Tool(Kind.SPHERE, (radius,), 0.9), (x, y, z), step)


def _parse_demonstration(text: str) -> dict[str, tuple[float, ...]]:
    """Read the parameters that solve a scene."""
    return {DEMONSTRATION: tuple(map(float, text.split()))}


class Assembly(Plasticine):
    """Lift a ball with two spheres and set it on a box.

    The box is 0.16 m wide and stands on a sticky floor; the ball, of 0.06 m radius, is 0.3 m to its left. Yield stress
    100 Pa. The target is the ball on the box, at its upstream position.
    """

    name = "assembly"
    examples: ClassVar[dict[str, tuple[float, ...]]] = _parse_demonstration(
        """
        0.017 0.806 0.02 0.313 0.871 -0.114
        0.431 1 -0.077 0.469 0.888 -0.008
        0.921 0.82 -0.054 0.942 0.629 -0.017
        0.959 -0.142 0.042 0.952 -0.058 -0.01
        0.888 -0.522 0.058 0.956 -0.514 0.089
        """
    )
    scene: ClassVar[Scene] = Scene(
        pieces=(Piece(Box((0.6, 0.08, 0.5), (0.16, 0.16, 0.16)), 6000), Piece(Ball((0.3, 0.06, 0.5), 0.06), 4000)),
        anchors=tuple(_finger(x, 0.06, 0.5, 0.04, (0.009, 0.009, 0.009)) for x in (0.38, 0.22)),
        yield_stress=100.0,
        floor_friction=STICKY,
        target=(Box((0.6, 0.08, 0.5), (0.16, 0.16, 0.16)), Ball((0.6, 0.2205, 0.5), 0.06)),
    )


class Pinch(Plasticine):
    """Press a dent into the front of a cube with a sphere.

    The cube is 0.2 m wide and stands on a sticky floor; a sphere of 0.04 m radius is above it. Yield stress 50 Pa. The
    cube weighs as much as PlasticineLab's target. PlasticineLab's cube weighs 0.6 of its target.
    """

    name = "pinch"
    fidelities: ClassVar[dict[str, Fidelity]] = fidelities(draft=(32, 800, 9), standard=(64, 5000, 20))
    examples: ClassVar[dict[str, tuple[float, ...]]] = _parse_demonstration(
        """
        0 0 1
        0 -1 0
        0 -0.1 -0.78
        0 0 0
        0 0 0
        """
    )
    scene: ClassVar[Scene] = Scene(
        pieces=(Piece(Box((0.5, 0.1, 0.5), (0.2, 0.2, 0.2)), 10_000),),
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
    """Roll a slab flat with a rolling pin.

    The slab is 0.3 m wide and 0.1 m high, on a floor with friction. The pin (0.3 m, radius 0.03 m) rolls without slip,
    turns about the vertical and rises or sinks. Yield stress 50 Pa.
    """

    name = "rolling-pin"
    fidelities: ClassVar[dict[str, Fidelity]] = fidelities(draft=(40, 1500, 12), standard=(64, 10_000, 10))
    examples: ClassVar[dict[str, tuple[float, ...]]] = _parse_demonstration(
        """
        0.6 0 -1
        -1 0 -1
        1 0 -0.7
        -1 0 -0.3
        0.4 0 0
        """
    )
    scene: ClassVar[Scene] = Scene(
        pieces=(SLAB,),
        anchors=(Anchor(Tool(Kind.ROLLER, (0.15, 0.03), 0.9), (0.5, 0.123, 0.5), (2 / 3, 1 / 15, 0.001)),),
        yield_stress=50.0,
        floor_friction=1.5,
    )


class Rope(Plasticine):
    """Bend a rope around a post by its two ends.

    The rope is 0.6 m long, on a floor with friction. Two spheres are in front of it, and a post of 0.1 m radius is
    behind it. Yield stress 50 Pa. The target is a full ring around the post. The rope is too short for it, so its loss
    cannot vanish.
    """

    name = "rope"
    fidelities: ClassVar[dict[str, Fidelity]] = fidelities(draft=(40, 1500, 12), standard=(80, 10_000, 25))
    examples: ClassVar[dict[str, tuple[float, ...]]] = _parse_demonstration(
        """
        0.514 0.292 -0.463 -0.277 0.257 -0.624
        -0.386 -0.065 -1 -0.291 -0.006 -1
        -0.153 0.003 -1 -0.704 -0.003 -0.999
        -0.025 -0.003 -1 -0.727 0.003 -0.866
        0.787 -0.028 -1 -0.785 -0.056 -0.974
        """
    )
    scene: ClassVar[Scene] = Scene(
        pieces=(Piece(Box((0.5, 0.03, 0.73), (0.6, 0.06, 0.06)), 10_000),),
        anchors=tuple(_finger(x, 0.015, 0.82, 0.03, (0.01, 0.01, 0.01)) for x in (0.22, 0.78)),
        yield_stress=50.0,
        floor_friction=0.3,
        posts=((Tool(Kind.CYLINDER, (0.1, 0.2), 0.9), (0.39193, 0.0, 0.49908)),),
        target=(Ring((0.39193, 0.0, 0.49908), inner=0.106, outer=0.166, height=0.06),),
    )


class Table(Plasticine):
    """Bend one leg of a table outwards with a sphere.

    Each of the four legs weighs as much as the top. They stand on a floor with friction; a sphere of 0.04 m radius is
    between them, and its vertical parameters have no effect. Yield stress 50 Pa, Poisson's ratio 0.05. The
    demonstration hits the leg just before the end. A longer push would move the whole table, because a leg bends at
    about the force at which the floor gives way.
    """

    name = "table"
    examples: ClassVar[dict[str, tuple[float, ...]]] = _parse_demonstration(
        """
        0.08 0 -0.08
        0 0 0
        0 0 0
        0 0 0
        0.09 0 -0.09
        """
    )
    scene: ClassVar[Scene] = Scene(
        pieces=(
            *(Piece(Box((x, 0.1, z), (0.04, 0.1, 0.04)), 2000) for x in (0.425, 0.575) for z in (0.425, 0.575)),
            Piece(Box((0.5, 0.18, 0.5), (0.2, 0.05, 0.2)), 2000),
        ),
        anchors=(_finger(0.5, 0.06, 0.5, 0.04, (0.03, 0.0, 0.03)),),
        yield_stress=50.0,
        floor_friction=0.3,
        poisson=0.05,
    )


class Torus(Plasticine):
    """Press a ring into a slab.

    The slab is 0.3 m wide and 0.1 m high, on a sticky floor; a torus (0.05 m, tube 0.03 m) is above it. Yield stress 50
    Pa.
    """

    name = "torus"
    fidelities: ClassVar[dict[str, Fidelity]] = fidelities(draft=(32, 800, 9), standard=(64, 5000, 10))
    examples: ClassVar[dict[str, tuple[float, ...]]] = _parse_demonstration(
        """
        -1 -1 -0.6
        -0.925 -1 -0.475
        0 -1 0
        0 -1 0
        0 0 0
        """
    )
    scene: ClassVar[Scene] = Scene(
        pieces=(SLAB,),
        anchors=(
            Anchor(Tool(Kind.TORUS, (0.05, 0.03), 0.9), (0.5, 0.2, 0.5), (0.004, 0.004, 0.004), lower=(0.0, 0.05, 0.0)),
        ),
        yield_stress=50.0,
        floor_friction=STICKY,
    )


class TripleMove(Plasticine):
    """Carry three blocks through the air with three pairs of spheres.

    The blocks are 0.1 m wide, on a floor with friction, each between two spheres of 0.03 m radius. Yield stress 200 Pa.
    The targets are in the air, so the blocks have to be lifted and held.
    """

    name = "triple-move"
    examples: ClassVar[dict[str, tuple[float, ...]]] = _parse_demonstration(
        """
        0.123 0.083 0.002 -0.071 0.103 0.018 0.221 0.078 -0.161
        -0.152 0.124 -0.06 0.218 0.534 0.011 -0.161 0.4 0.008
        -0.085 0.414 -0.002 -0.064 0.452 0.007 0.115 0.094 -0.895
        0.06 0.213 -0.953 -0.109 0.89 -0.759 -0.096 0.894 -0.722
        -0.299 0.428 -0.008 -0.349 0.423 0.006 1 0.246 -0.945
        0.982 0.228 -0.997 -0.265 0.871 -0.885 -0.324 0.948 -0.856
        -0.308 0.456 0.008 -0.349 0.422 -0.001 1 0.569 -0.525
        1 0.55 -0.635 -0.342 0.638 -0.839 -0.346 0.579 -0.791
        -0.277 0.199 0.023 -0.35 0.152 0.03 1 0.565 -0.519
        1 0.53 -0.62 -0.018 0.02 -0.718 -0.072 0.099 -0.738
        """
    )
    scene: ClassVar[Scene] = Scene(
        pieces=tuple(Piece(Box((x, 0.05, 0.5), (0.1, 0.1, 0.1)), 3333) for x in (0.3, 0.5, 0.7)),
        anchors=tuple(_finger(x, 0.05, 0.5, 0.03, (0.01, 0.01, 0.01)) for x in (0.23, 0.37, 0.43, 0.57, 0.63, 0.77)),
        yield_stress=200.0,
        floor_friction=1.5,
        target=tuple(
            Box(center, (0.1, 0.1, 0.1)) for center in ((0.2, 0.2, 0.5029), (0.8, 0.2, 0.2), (0.6254, 0.3436, 0.2002))
        ),
    )


class Writer(Plasticine):
    """Write a stroke into a slab with a pen.

    The slab is 0.3 m wide and 0.1 m high, on a sticky floor. The pen is a frictionless upright capsule that starts 0.03
    m deep in it. Yield stress 50 Pa.
    """

    name = "writer"
    model_parts: ClassVar[tuple[ModelPart, ...]] = tuple(
        part
        for part in Plasticine.model_parts
        if "tool_friction" not in part.options  # the pen has none
    )
    examples: ClassVar[dict[str, tuple[float, ...]]] = _parse_demonstration(
        """
        -0.9 -0.2 0
        0.3 -0.2 0.8
        0.8 0 0.2
        0.6 0 -0.5
        0 0 0
        """
    )
    scene: ClassVar[Scene] = Scene(
        pieces=(SLAB,),
        anchors=(
            Anchor(Tool(Kind.CAPSULE, (0.03, 0.03), 0.0), (0.5, 0.13, 0.5), (0.01, 0.01, 0.01), lower=(0.0, 0.05, 0.0)),
        ),
        yield_stress=50.0,
        floor_friction=STICKY,
    )
