"""Points and springs of sheets, cut from a square lattice."""

from __future__ import annotations

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
        raise ValueError(f"a disc is an even number of cells across; got {cells}")
    points = square(cells) - cells // 2
    return np.asarray(points[(points**2).sum(axis=1) <= (cells / 2) ** 2])


def areas(points: np.ndarray) -> np.ndarray:
    """Return the area that each lattice point stands for, in cells, shape (vertex,).

    A cell belongs to its four corners alike; one of which a corner is missing is the triangle of the others.
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
    `shear` scales the shear springs. At 1 the membrane is isotropic (Poisson's ratio 1/3), as stiff at every
    resolution, and at the same reach in metres its bending is, too: a spring weighs what its share of the sheet's area
    is, so that those along an edge weigh half.
    """
    number = {tuple(point): i for i, point in enumerate(points.tolist())}
    weights: dict[tuple[int, int], float] = {}
    _add_cells(weights, points, number, bend=bend, shear=shear)
    for step in ((reach, 0), (0, reach)):
        _add_bending(weights, points, number, step, share=bend / reach**2)
    pairs = np.array(sorted(pair for pair, weight in weights.items() if weight > 0), dtype=int)
    rest = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    return pairs, rest, np.array([weights[first, second] for first, second in pairs.tolist()])


def _cells(number: dict[tuple[int, ...], int]) -> list[list[int]]:
    """Return the corners of every cell that has at least three, in order around it."""
    places = sorted({(i - di, j - dj) for i, j in number for di in (0, 1) for dj in (0, 1)})
    around = [((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)) for i, j in places]
    cells = [[number[corner] for corner in corners if corner in number] for corners in around]
    return [corners for corners in cells if len(corners) > 2]


def _add_cells(
    weights: dict[tuple[int, int], float],
    points: np.ndarray,
    number: dict[tuple[int, ...], int],
    *,
    bend: float,
    shear: float,
) -> None:
    """Add what each cell gives its edges and its diagonals: half a spring each."""
    for corners in _cells(number):
        for first, second in combinations(sorted(corners), 2):
            diagonal = (points[first] != points[second]).all()
            share = 0.5 * (shear if diagonal else 1.0 - bend)
            weights[first, second] = weights.get((first, second), 0.0) + share


def _add_bending(
    weights: dict[tuple[int, int], float],
    points: np.ndarray,
    number: dict[tuple[int, ...], int],
    step: tuple[int, int],
    *,
    share: float,
) -> None:
    """Add the springs between points a `step` apart, by the area that their first ends stand for among themselves."""
    starts = np.array([p for p in points.tolist() if (p[0] + step[0], p[1] + step[1]) in number], dtype=int)
    for (i, j), area in zip(starts.tolist(), areas(starts), strict=True):
        pair = number[i, j], number[i + step[0], j + step[1]]
        weights[pair] = weights.get(pair, 0.0) + share * float(area)
