"""Bars: a job that takes longer than it has announced says so, once."""

from io import StringIO

import pytest

from gradscape.api import progress
from gradscape.api.progress import Bars, Console

from ..clock import Clock


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(progress, "time", found)
    return found


def follow(clock: Clock, *, said: float, each: float, resumed: int = 0) -> list[str]:
    """Announce a job of 100 episodes, of which some are done, and return what it says of its delay."""
    shown = StringIO()
    bars = Bars(Console(file=shown, soft_wrap=True))
    bars.announce("100 episodes", said)
    with bars.progress(100) as advance:
        for done in range(resumed, 101):
            advance(done)
            clock.sleep(each)
    with bars.busy("drawing"):
        pass
    return [line for line in shown.getvalue().splitlines() if line.startswith("slower than")]


def test_a_job_that_outruns_its_announcement_says_so_once_with_how_long_it_will_take(clock: Clock) -> None:
    assert follow(clock, said=8.0, each=0.4) == ["slower than estimated: the estimate was 8.0 s, it is now about 40 s"]
    assert follow(clock, said=8.0, each=0.4, resumed=50) == [
        "slower than estimated: the estimate was 8.0 s, it is now about 20 s"
    ]


@pytest.mark.parametrize(("said", "each"), [(30.0, 0.4), (0.1, 0.04)])
def test_one_that_takes_little_longer_says_nothing(clock: Clock, said: float, each: float) -> None:
    assert follow(clock, said=said, each=each) == []


def test_where_nothing_is_counted_the_time_gone_is_said(clock: Clock) -> None:
    shown = StringIO()
    bars = Bars(Console(file=shown, soft_wrap=True))
    bars.announce("a check", 8.0)
    for _ in range(3):
        with bars.busy("checking"):
            clock.sleep(10.0)
    assert shown.getvalue().count("slower than") == 1
    assert "slower than estimated: the estimate was 8.0 s, 20 s have passed" in shown.getvalue()
