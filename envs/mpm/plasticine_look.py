"""What a plasticine scene looks like: bodies, tools and targets to draw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes import episode
from ...landscapes.episode import Part, View
from ..engines.mpm.tools import Kind, Tool
from ..outlines import rotate_about
from .plasticine_model import FLOOR, Scene
from .shapes import Ball, Box, Shape

SHAPES: dict[Kind, episode.Shape] = {
    Kind.SPHERE: "sphere",
    Kind.CAPSULE: "capsule",
    Kind.TORUS: "torus",
    Kind.CYLINDER: "cylinder",
    Kind.ROLLER: "capsule",
}


def parts(
    scene: Scene,
    bodies: Sequence[Float[Tensor, "frame particle 3"]],
    tools: Float[Tensor, "frame slot 3"],
    target: np.ndarray,
) -> tuple[Part, ...]:
    """Return bodies, tools at their slots' poses, and targets: shapes, or the bodies' particles where they belong."""
    pitches = [(piece.shape.volume / x.shape[1]) ** (1 / 3) for piece, x in zip(scene.pieces, bodies, strict=True)]
    pieces = [
        Part("lump", "plasticine", x, (pitch,), tint=number)
        for number, (x, pitch) in enumerate(zip(bodies, pitches, strict=True))
    ]
    movers, slot = [], 0
    for tool in scene.tools:
        movers.append(_tool(tool, tools[:, slot : slot + tool.slots]))
        slot += tool.slots
    if scene.target:
        return (*pieces, *movers, *(_target(shape, len(tools)) for shape in scene.target))
    wanted = torch.split(torch.from_numpy(target), [x.shape[1] for x in bodies])
    goals = [
        Part("lump", "target", x.expand(len(tools), -1, 3), (pitch,)) for x, pitch in zip(wanted, pitches, strict=True)
    ]
    return (*pieces, *movers, *goals)


def view(scene: Scene) -> View:
    """Return the view of what bodies, tools at their starts and targets take up."""
    corners = [shape.bounds for shape in (*(piece.shape for piece in scene.pieces), *scene.target)]
    placed = [(anchor.tool, anchor.start) for anchor in scene.anchors] + list(scene.posts)
    corners += [(np.subtract(at, tool.radius), np.add(at, tool.radius)) for tool, at in placed]
    lower, upper = np.min([low for low, _ in corners], axis=0), np.max([high for _, high in corners], axis=0)
    lower[1] = 0.0
    return View(tuple(lower.tolist()), tuple(upper.tolist()), eye=(0.35, 0.55, 1.0), ground=FLOOR - 1 / 128)


def _tool(tool: Tool, pose: Float[Tensor, "frame slot 3"]) -> Part:
    turn = None
    if tool.kind is Kind.ROLLER:  # its axis starts along z; a capsule's is y
        spin, yaw, _ = pose[:, 1].unbind(1)
        turn = rotate_about(1, yaw) @ rotate_about(2, spin) @ rotate_about(0, torch.full_like(yaw, torch.pi / 2))
    material: episode.Material = "wood" if tool.kind in (Kind.ROLLER, Kind.CYLINDER) else "steel"
    return Part(SHAPES[tool.kind], material, pose[:, :1], tool.size, turn)


def _target(shape: Shape, frames: int) -> Part:
    at = torch.tensor(shape.center, dtype=torch.float64).expand(frames, 1, 3)
    if isinstance(shape, Box):
        return Part("box", "target", at, shape.widths)
    if isinstance(shape, Ball):
        return Part("sphere", "target", at, (shape.radius,))
    return Part("ring", "target", at, (shape.inner, shape.outer, shape.height))
