"""Lattices: which points and springs there are, and the membrane that the springs make."""

import math

import numpy as np
import pytest

from gradscape.envs.sheets import lattice
from gradscape.envs.sheets.swing import BEND


def stretched(*, reach, bend, strain):
    """Return twice the energy per cell of an unbounded lattice of stiffness 1 in a small strain, shape (2, 2).

    It is the sum over the springs of a vertex in the middle, each shared with its other end.
    """
    cells = 2 * reach + 4
    points = lattice.square(cells)
    pairs, rest, weight = lattice.springs(points, reach=reach, bend=bend)
    middle = (pairs == (cells // 2) * (cells + 2)).any(axis=1)
    along = (points[pairs[:, 1]] - points[pairs[:, 0]]) / rest[:, None]
    elongation = rest * np.einsum("si,ij,sj->s", along, strain, along)
    return float((weight * elongation**2)[middle].sum() / 2)


@pytest.mark.parametrize("bend", [0.0, 0.4, 0.8, 1.0])
@pytest.mark.parametrize("reach", [1, 2, 3, 5])
def test_the_membrane_is_isotropic_with_a_poisson_ratio_of_a_third(reach, bend):
    stiffness = 3 / 2  # C_11 of springs of stiffness 1: 1 of those along, 1 / 2 of the diagonals
    for angle in np.linspace(0, math.pi, 9):
        n = np.array([math.cos(angle), math.sin(angle)])
        m = np.array([-n[1], n[0]])
        along, across = np.outer(n, n), np.outer(m, m)
        energy = {
            name: stretched(reach=reach, bend=bend, strain=strain)
            for name, strain in {"stretch": along, "both": along + across, "narrowing": along - across / 3}.items()
        }
        assert energy["stretch"] == pytest.approx(stiffness)
        # 2 C_11 + 2 C_12 with C_12 = C_11 / 3; free to narrow, it keeps Young's modulus C_11 (1 - 1 / 9).
        assert energy["both"] == pytest.approx(2 * stiffness * (1 + 1 / 3))
        assert energy["narrowing"] == pytest.approx(stiffness * (1 - 1 / 9))


@pytest.mark.parametrize("cells", [1, 2, 5])
def test_a_square_has_its_points_row_by_row(cells):
    points = lattice.square(cells)
    assert len(points) == (cells + 1) ** 2
    assert points.tolist() == sorted(points.tolist())
    assert points.min() == 0
    assert points.max() == cells


@pytest.mark.parametrize("cells", [4, 8, 16])
def test_a_disc_is_symmetric_and_reaches_its_diameter(cells):
    points = {tuple(p) for p in lattice.disc(cells).tolist()}
    r = cells // 2
    assert {(-r, 0), (r, 0), (0, -r), (0, r)} <= points
    for turned in ({(-x, y) for x, y in points}, {(y, x) for x, y in points}):
        assert turned == points
    every = {(x, y) for x in range(-r, r + 1) for y in range(-r, r + 1)}
    assert max(math.hypot(*p) for p in points) == r
    assert min(math.hypot(*p) for p in every - points) > r
    only_one_at_the_left = [p for p in points if p[0] == -r]
    assert only_one_at_the_left == [(-r, 0)]


@pytest.mark.parametrize(("cells", "reach"), [(7, 2), (19, 5), (6, 3)])
def test_a_square_has_all_its_springs_once(cells, reach):
    points = lattice.square(cells)
    pairs, rest, weight = lattice.springs(points, reach=reach, bend=BEND)
    counts = {1.0: 2 * cells * (cells + 1), math.sqrt(2): 2 * cells**2, reach: 2 * (cells + 1) * (cells + 1 - reach)}
    assert {length: int((rest == length).sum()) for length in counts} == counts
    assert len(pairs) == len(weight) == sum(counts.values())
    assert len({frozenset(pair) for pair in pairs.tolist()}) == len(pairs)
    np.testing.assert_allclose(np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1), rest)
    assert {float(w) for w in weight[rest == reach]} == {BEND / reach**2}


def test_sheets_of_all_resolutions_stretch_alike():
    """Near an edge bending springs are missing and springs on it count whole, so that all is but a few percent."""
    energy = {}
    for cells in (7, 8, 16, 19):
        points = lattice.square(cells)
        pairs, rest, weight = lattice.springs(points, reach=round(cells / 4), bend=BEND)
        across = points[pairs[:, 1], 0] - points[pairs[:, 0], 0]
        energy[cells] = float((weight * (across**2 / rest) ** 2).sum()) / cells**2
    for stiffness in energy.values():
        assert stiffness == pytest.approx(1.5, rel=0.06)
