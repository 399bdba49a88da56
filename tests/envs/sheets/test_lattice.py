"""Lattices: which points and springs there are, and the membrane that the springs make."""

import math

import numpy as np
import pytest

from gradscape.envs.sheets import lattice


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
    pairs, rest, weight = lattice.springs(points, reach=reach, bend=0.4)
    counts = {1.0: 2 * cells * (cells + 1), math.sqrt(2): 2 * cells**2, reach: 2 * (cells + 1) * (cells + 1 - reach)}
    assert {length: int((rest == length).sum()) for length in counts} == counts
    assert len(pairs) == len(weight) == sum(counts.values())
    assert len({frozenset(pair) for pair in pairs.tolist()}) == len(pairs)
    np.testing.assert_allclose(np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1), rest)


@pytest.mark.parametrize("cells", [4, 7, 16])
def test_a_square_weighs_and_stretches_as_its_area_does_at_every_resolution(cells):
    """The energy of a stretch along x, with the sides held, is C_11 = 3/2 times the area, edges included."""
    points = lattice.square(cells)
    assert lattice.areas(points).sum() == pytest.approx(cells**2)
    pairs, rest, weight = lattice.springs(points, reach=1, bend=0.0)
    across = (points[pairs[:, 1]] - points[pairs[:, 0]]).T
    for u, v, energy in ((1, 0, 1.5), (0, 1, 1.5), (1, 1, 4.0), (1, -1, 2.0)):  # C_11, and 2 (C_11 +- C_12)
        elongation = (u * across[0] ** 2 + v * across[1] ** 2) / rest
        assert (weight * elongation**2).sum() == pytest.approx(energy * cells**2)


@pytest.mark.parametrize("cells", [8, 16, 32])
def test_a_disc_has_a_circles_centre_and_its_area_but_for_the_steps_of_its_edge(cells):
    points = lattice.disc(cells)
    area = lattice.areas(points)
    assert area.sum() == pytest.approx(math.pi * (cells / 2) ** 2, rel=2.5 / cells)
    np.testing.assert_allclose(area @ points, 0.0, atol=1e-9)


def bent(points, height):
    """Return twice the bending energy of a surface of a height at each point, of bending stiffness 1."""
    pairs, attraction = lattice.plate(points)
    return float(attraction @ (height[pairs[:, 0]] - height[pairs[:, 1]]) ** 2)


def test_a_plate_resists_curvature_and_twist_and_neither_rotation_nor_stretch():
    cells = 12
    points = lattice.square(cells)
    x, y = points.T.astype(float)
    assert bent(points, 3 * x - 2 * y + 1) == pytest.approx(0.0, abs=1e-9)
    # x^2 / 2 has curvature 1; what an edge's own row would add lies half a cell beyond the next.
    assert bent(points, x**2 / 2) == pytest.approx(cells * (cells - 1))
    assert bent(points, x * y) == pytest.approx(2 * cells**2)  # |x_uv|^2 counts twice
    # A saddle turned by 45 degrees is the same surface: the plate is isotropic.
    assert bent(points, (x**2 - y**2) / 2) == pytest.approx(2 * cells * (cells - 1))


def test_a_plates_energy_converges_as_the_mesh_is_refined():
    """That of sin(k x) on a unit square, by second order in the interior: k^4 / 2 over whole waves."""
    k, errors = 4 * math.pi, []
    for cells in (16, 32, 64):
        points = lattice.square(cells)
        energy = bent(points, np.sin(k * points[:, 0] / cells)) * cells**2
        errors.append(abs(energy / (k**4 / 2) - 1))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)
    assert math.log2(errors[1] / errors[2]) == pytest.approx(2, abs=0.1)
