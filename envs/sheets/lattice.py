"""Points and springs of sheets, cut from a square lattice."""

from __future__ import annotations

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


def springs(points: np.ndarray, *, reach: int, bend: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs, rest lengths in cells and weights of the springs between lattice points.

    Structural springs join neighbours along the lattice, shear springs those along its diagonals. Bending springs join
    what is `reach` cells apart along the lattice and take the share `bend` of the structural springs' stiffness. The
    membrane is isotropic then (Poisson's ratio 1/3), as stiff at every resolution, and at the same reach in metres its
    bending is, too.
    """
    along = [(1, 0), (0, 1)]
    weights = dict.fromkeys(along, 1.0 - bend) | dict.fromkeys([(1, 1), (1, -1)], 0.5)
    for i, j in along:  # those of reach 1 lie along structural springs
        far = reach * i, reach * j
        weights[far] = weights.get(far, 0.0) + bend / reach**2
    number = {tuple(point): i for i, point in enumerate(points.tolist())}
    found = [
        (i, number[other], float(np.hypot(*step)), weight)
        for point, i in number.items()
        for step, weight in weights.items()
        if (other := (point[0] + step[0], point[1] + step[1])) in number
    ]
    first, second, rest, weight = zip(*found, strict=True)
    return np.stack([first, second], axis=1), np.array(rest), np.array(weight)
