"""Points and springs of sheets, cut from a square lattice."""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations

import numpy as np


def square(cells: int) -> np.ndarray:
    """Return the lattice points of a square of `cells` times `cells` cells, row by row, shape (vertex, 2)."""
    return np.stack(np.meshgrid(*[np.arange(cells + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)


def disc(cells: int) -> np.ndarray:
    """Return the lattice points of a disc that is `cells` cells across, around 0, shape (vertex, 2).

    Raises ValueError where `cells` is odd.
    """
    if cells % 2:
        raise ValueError(f"disc takes an even number of cells; got {cells}")
    points = square(cells) - cells // 2
    return np.asarray(points[(points**2).sum(axis=1) <= (cells / 2) ** 2])


def areas(points: np.ndarray) -> np.ndarray:
    """Return the area of each lattice point's share of the sheet, in cells, shape (vertex,).

    A cell belongs equally to its four corners; a cell with a missing corner is the triangle of the others.
    """
    number = {tuple(point): i for i, point in enumerate(points.tolist())}
    area = np.zeros(len(points))
    for corners in _cells(number):
        area[corners] += {4: 1 / 4, 3: 1 / 6}[len(corners)]
    return area


def springs(
    points: np.ndarray, *, reach: int, bend: float, shear: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs, rest lengths in cells and weights of the springs between lattice points.

    Structural springs join neighbours along the lattice, shear springs those along its diagonals. Bending springs join
    what is `reach` cells apart along the lattice and take the share `bend` of the structural springs' stiffness.
    `shear` scales the shear springs. At 1 the membrane is isotropic (Poisson's ratio 1/3) and equally stiff at every
    resolution. At the same reach in metres, so is its bending. The weight of a spring is its share of the sheet's area,
    so springs along an edge weigh half.
    """
    number = {tuple(point): i for i, point in enumerate(points.tolist())}
    weights: defaultdict[tuple[int, int], float] = defaultdict(float)
    for corners in _cells(number):  # each gives its edges and its diagonals half a spring
        for first, second in combinations(sorted(corners), 2):
            diagonal = (points[first] != points[second]).all()
            weights[first, second] += 0.5 * (shear if diagonal else 1.0 - bend)
    for di, dj in ((reach, 0), (0, reach)):
        starts = np.array([(i, j) for i, j in number if (i + di, j + dj) in number], dtype=int)
        for (i, j), area in zip(starts.tolist(), areas(starts), strict=True):  # as much as they stand for by themselves
            weights[number[i, j], number[i + di, j + dj]] += bend / reach**2 * float(area)
    pairs = np.array(sorted(pair for pair, weight in weights.items() if weight > 0), dtype=int)
    rest = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    return pairs, rest, np.array([weights[first, second] for first, second in pairs.tolist()])


def plate(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of lattice points and the attractions between them that make the sheet resist bending.

    The energy of a plate of bending stiffness D [N m] without Poisson's effect, D / 2 times the integral of |x_uu|^2 +
    2 |x_uv|^2 + |x_vv|^2, is a sum of squares c |a_1 x_1 + a_2 x_2 + ...|^2 of second differences. Since the a sum to
    0, it is the sum over pairs of -c a_i a_j |x_i - x_j|^2: linear attractions, some negative, to be multiplied by D
    over the square of a cell's width. Rotations do no work against them.
    """
    number = {tuple(point): i for i, point in enumerate(points.tolist())}
    squares: list[tuple[list[int], tuple[float, ...], float]] = []
    found: defaultdict[tuple[int, int], float] = defaultdict(float)
    for (i, j), area in zip(number, areas(points), strict=True):
        for di, dj in ((1, 0), (0, 1)):
            line = ((i - di, j - dj), (i, j), (i + di, j + dj))
            if all(point in number for point in line):
                squares.append(([number[point] for point in line], (1.0, -2.0, 1.0), float(area)))
    squares += [(corners, (1.0, -1.0, 1.0, -1.0), 2.0) for corners in _cells(number) if len(corners) == 4]
    for numbers, factors, share in squares:
        for (one, a), (other, b) in combinations(zip(numbers, factors, strict=True), 2):
            found[min(one, other), max(one, other)] -= share * a * b
    pairs = sorted(pair for pair, stiffness in found.items() if stiffness)
    return np.array(pairs, dtype=int), np.array([found[pair] for pair in pairs])


def merge(
    points: np.ndarray, springs: tuple[np.ndarray, np.ndarray, np.ndarray], attractions: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return all pairs, their rest lengths in cells, weights as springs (or 0), and attractions (or 0)."""
    weights = dict(zip(map(tuple, springs[0].tolist()), springs[2].tolist(), strict=True))
    linear = dict(zip(map(tuple, attractions[0].tolist()), attractions[1].tolist(), strict=True))
    pairs = np.array(sorted(weights.keys() | linear.keys()), dtype=int)
    rest = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    both = [[known.get(tuple(pair), 0.0) for pair in pairs.tolist()] for known in (weights, linear)]
    return pairs, rest, np.array(both[0]), np.array(both[1])


def _cells(number: dict[tuple[int, ...], int]) -> list[list[int]]:
    """Return the corners of every cell that has at least three, in order around it."""
    places = sorted({(i - di, j - dj) for i, j in number for di in (0, 1) for dj in (0, 1)})
    around = [((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)) for i, j in places]
    cells = [[number[corner] for corner in corners if corner in number] for corners in around]
    return [corners for corners in cells if len(corners) > 2]
