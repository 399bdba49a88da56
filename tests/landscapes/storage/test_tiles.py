import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gradscape.landscapes.storage import arrays
from gradscape.landscapes.storage.arrays import _offsets, coarse_to_fine, tile_side

POINTS = st.integers(2, 600)
FEW = settings(max_examples=40)


@FEW
@given(POINTS)
def test_the_order_visits_every_point_once_and_begins_with_a_centred_uniform_picture_of_the_whole_axis(points):
    side = tile_side(points)
    order = coarse_to_fine(points, side)
    assert sorted(order) == list(range(points))
    steps = [b - a for a, b in itertools.pairwise(order[:side])]
    assert max(steps) - min(steps) <= 1
    assert abs(order[0] - (points - 1 - order[side - 1])) <= 2


@FEW
@given(POINTS, st.data())
def test_every_prefix_of_tiles_covers_the_axis_evenly(points, data):
    side = tile_side(points)
    tiles = data.draw(st.integers(1, -(-points // side)))
    taken = sorted(coarse_to_fine(points, side)[: side * tiles])
    gaps = [b - a for a, b in zip([-1, *taken], [*taken, points], strict=True)]
    cell = -(-points // side)
    assert max(gaps) <= cell + 1  # never worse than the coarsest picture
    if tiles >= 2:
        assert max(gaps) <= -(-cell // 2) + 2  # the second tile halves its gaps


def test_tile_side_is_an_eighth_between_four_and_sixteen():
    assert [tile_side(points) for points in (2, 16, 64, 128, 4096)] == [2, 4, 8, 16, 16]


def farthest(size: int) -> list[int]:
    """The order of a cell's places by going through all of them each time, as slices that are stored were ordered."""
    taken = [size // 2]
    away = [min((at - taken[0]) % size, (taken[0] - at) % size) for at in range(size)]
    while len(taken) < size:
        taken.append(away.index(max(away)))
        away = [min(far, (at - taken[-1]) % size, (taken[-1] - at) % size) for at, far in enumerate(away)]
    return taken


@pytest.mark.parametrize("sizes", [range(1, 130), (255, 256, 257, 500)])
def test_the_order_is_that_of_the_slices_that_are_stored(sizes):
    assert all(_offsets(size) == farthest(size) for size in sizes)


def test_the_order_of_many_points_takes_a_few_steps_for_each(monkeypatch):
    steps = itertools.count()
    push = arrays.heappush
    monkeypatch.setattr(arrays, "heappush", lambda *given: (next(steps), push(*given)))
    points = 10**5
    assert sorted(coarse_to_fine(points, tile_side(points))) == list(range(points))
    assert next(steps) <= 2 * points
