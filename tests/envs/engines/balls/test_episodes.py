"""An episode of a ball among bars is one launch, whatever room there is for its events."""

from dataclasses import replace

import torch
import warp as wp

from gradscape.envs.engines.balls.impacts import Flight

from .test_impacts import BOARD, CROWDED, flights, solver, vectors


def test_an_episode_is_one_launch_there_and_one_back(monkeypatch):
    """However many events it has: a launch costs more than an event."""
    backwards, launch = [], wp.launch

    def counted(*given, **how):
        backwards.append(how.get("adjoint", False))
        return launch(*given, **how)

    monkeypatch.setattr(wp, "launch", counted)
    for contacts in ("impact", "step"):
        thrown, _, _ = flights(CROWDED, 1 / 60, seed=5, contacts=contacts)
        thrown.gradient(torch.ones(16, 2))
        assert backwards == [False, True]
        backwards.clear()


def test_rows_that_need_more_room_than_was_made_end_as_they_do_where_there_is_enough():
    """Of two balls one jams between two faces and continues from where room ended, as often as that takes."""
    board = replace(BOARD, pivots=((3.45, 5.0), (4.55, 5.0)), half_length=0.6)
    angle, start = vectors((-0.8, 0.8), (0.3, -0.2)), vectors((4.0, 6.0), (1.0, 6.0))
    roomy, cramped = (solver(board, dt=1 / 60, duration=6.0, rows=2) for _ in range(2))
    cramped.flight = Flight(40, 2, "float64", "cpu")
    roomy._double_length()
    found = [(*made_of(used, angle, start), used.taken.clone()) for used in (roomy, cramped)]
    assert int(found[0][-1].max()) > 9 * 40  # room is doubled more than thrice
    assert int(found[0][-1].min()) < int(found[0][-1].max())
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def made_of(used, angle, start):
    """Return ends, and slopes of their sum."""
    end = used.run(angle, start).clone()
    slopes = used.gradient(torch.ones_like(end))
    return end, slopes.angle, slopes.start, slopes.velocity, slopes.spin
