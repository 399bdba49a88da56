"""Surfaces of what scenes simulate, to draw: triangles between lattice points, skins of blocks, rotations."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def triangles(points: np.ndarray) -> Int[Tensor, "face 3"]:
    """Return the triangles between lattice points, shape (vertex, 2): two a cell, one where it has three corners."""
    number = {tuple(point): i for i, point in enumerate(points.tolist())}
    faces = []
    for i, j in {(i - di, j - dj) for i, j in number for di in (0, 1) for dj in (0, 1)}:
        around = ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j))
        corners = [number[corner] for corner in around if corner in number]
        faces += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
    return torch.tensor(sorted(faces))


def skin(frames: Float[Tensor, "frame particle 3"]) -> tuple[Float[Tensor, "frame vertex 3"], Int[Tensor, "face 3"]]:
    """Return vertices and triangles of the surface of a cube of n x n x n particles, half a pitch outside of them."""
    edge = round(frames.shape[1] ** (1 / 3))
    block = frames.reshape(-1, edge, edge, edge, 3)
    for axis in (1, 2, 3):
        first, last = block.narrow(axis, 0, 1), block.narrow(axis, edge - 1, 1)
        before = 1.5 * first - 0.5 * block.narrow(axis, 1, 1)
        after = 1.5 * last - 0.5 * block.narrow(axis, edge - 2, 1)
        block = torch.cat([before, block.narrow(axis, 1, edge - 2), after], dim=axis)
    number = torch.arange(edge**3).view(edge, edge, edge)
    sides = [number.select(axis, place) for axis in range(3) for place in (0, edge - 1)]
    return block.reshape(len(frames), -1, 3), torch.cat([_split(side) for side in sides])


def rotate_about(axis: int, angle: Float[Tensor, " frame"]) -> Float[Tensor, "frame 3 3"]:
    """Return the rotations by angles [rad] about a coordinate axis."""
    c, s = angle.cos(), angle.sin()
    turn = torch.eye(3, dtype=angle.dtype).repeat(len(angle), 1, 1)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn[:, i, i], turn[:, i, j], turn[:, j, i], turn[:, j, j] = c, -s, s, c
    return turn


def _split(side: Int[Tensor, "row column"]) -> Int[Tensor, "face 3"]:
    a, b, c, d = side[:-1, :-1], side[:-1, 1:], side[1:, 1:], side[1:, :-1]
    return torch.cat([torch.stack([a, b, c], dim=-1).view(-1, 3), torch.stack([a, c, d], dim=-1).view(-1, 3)])
