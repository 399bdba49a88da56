"""Launches that come again, with stand-ins for a GPU's streams and graphs."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import warp as wp

from gradscape.envs.engines.launches import Launches


def test_work_that_is_interrupted_is_not_taken_for_whole_when_it_comes_again():
    launches, done = Launches("cpu"), []

    def work():
        launches.call(lambda: done.append("first"))
        if len(done) == 1:
            raise KeyboardInterrupt
        launches.call(lambda: done.append("second"))

    with pytest.raises(KeyboardInterrupt):
        launches.run("key", 1, work, small=True)
    done.append("again")
    for _ in range(2):
        launches.run("key", 1, work, small=True)
    assert done == ["first", "again", *["first", "second"] * 2]


@pytest.fixture
def seen(monkeypatch):
    """Return what stand-ins for a GPU's streams, commands and graphs are told."""
    seen, names = [], iter(["first", *(f"stream {number}" for number in range(1, 9))])

    class Stream:
        def __init__(self):
            self.name = next(names)

        def wait_stream(self, other):
            seen.append((self.name, "waits for", other.name))

    first = Stream()
    monkeypatch.setattr(wp, "ScopedCapture", lambda device: nullcontext(SimpleNamespace(graph="graph")))
    monkeypatch.setattr(wp, "capture_launch", seen.append)
    monkeypatch.setattr(wp, "get_stream", lambda device: first)
    monkeypatch.setattr(wp, "Stream", lambda device: Stream())
    return seen


class Command:
    """Launch nothing, and note on which stream."""

    def __init__(self, name, seen):
        self.name, self.seen = name, seen

    def launch(self, stream=None):
        if self.name == "interrupted":
            raise KeyboardInterrupt
        self.seen.append((self.name, "on", stream.name if stream else None))


def test_what_comes_after_an_interrupted_run_waits_for_what_that_has_begun(seen):
    launches = Launches("cuda")

    def work():
        with launches.on_stream(1):
            launches._recording.launches.append(Command("beside", seen))
        launches._recording.launches.append(Command("interrupted", seen))
        launches.join()

    launches.run("key", 1, work, small=False)
    with pytest.raises(KeyboardInterrupt):
        launches.run("key", 1, work, small=False)
    stream = "stream 1"
    assert seen == [(stream, "waits for", "first"), ("beside", "on", stream), ("first", "waits for", stream)]


def test_launches_of_which_some_were_moved_are_all_moved_again():
    class Sized:
        dim = 1

        def set_dim(self, dim):
            if interrupted.pop("now", False):
                raise KeyboardInterrupt
            self.dim = dim

        def launch(self, stream=None):
            launched.append(self.dim)

    launches, launched, interrupted = Launches("cpu"), [], {}

    def work():
        launches._recording.launches += commands
        launches._recording.sized += [(command, lambda extent: extent) for command in commands]

    commands = [Sized(), Sized()]
    launches.run("key", 1, work, small=True)
    commands[0].dim, interrupted["now"] = 2, True  # as if the second of them were moved when it is interrupted
    with pytest.raises(KeyboardInterrupt):
        launches.run("key", 2, work, small=True)
    launches.run("key", 1, work, small=True)
    assert launched == [1, 1]


def test_launches_are_told_where_their_work_lies_by_whichever_argument_asks_for_it():
    @wp.kernel
    def note(found: wp.array[int], where: int, when: int):
        found[wp.tid()] = 10 * where + when

    launches, found, first, when = Launches("cpu"), wp.zeros(1, dtype=int, device="cpu"), wp.int32(300), wp.int32(5)

    def work():
        launches.launch(note, (1, 1), [found, first, when])

    launches.run("key", 1, work, place=first, small=True)
    assert found.numpy().tolist() == [3005]
    launches.run("key", 2, work, place=wp.int32(400), small=True)
    assert found.numpy().tolist() == [4005]


def test_a_program_of_a_cpu_launches_what_it_is_made_of_over_any_extent(monkeypatch):
    @wp.kernel
    def add(total: wp.array[float], some: float):
        i, _ = wp.tid()
        total[i] = total[i] + some

    launches, python, relaunch = Launches("cpu", programs=True), [], wp.Launch.launch
    monkeypatch.setattr(wp.Launch, "launch", lambda *given: (python.append(given), relaunch(*given)))
    total = wp.zeros(3, dtype=float, device="cpu")

    def work():
        for some in (1.0, 2.0):
            launches.launch(add, lambda extent: (extent, 1), [total, some])
        launches.call(lambda: python.append("between"))
        launches.launch(add, lambda extent: (extent, 1), [total, 4.0])

    for extent, count in ((3, 4), (3, 3), (1, 3), (2, 3)):
        python.clear()
        launches.run("key", extent, work, small=True)
        assert len(python) == count  # two programs, and what is between
    assert total.numpy().tolist() == [28.0, 21.0, 14.0]


@pytest.mark.parametrize("small", [True, False])
def test_a_gpu_runs_beside_each_other_what_does_not_wait_for_each_other(seen, small):
    launches = Launches("cuda")

    def launch(name):
        launches._recording.launches.append(Command(name, seen))

    def work():
        for number in (1, 2, 1):
            with launches.on_stream(number):
                launch(f"beside {number}")
        launch("meanwhile")
        launches.join()
        launches.join()
        launch("after")

    for _ in range(2):
        launches.run("key", 1, work, small=small)
    assert [what for what in seen if "on" in what] == [
        ("beside 1", "on", "stream 1"),
        ("beside 2", "on", "stream 2"),
        ("beside 1", "on", "stream 1"),
        ("meanwhile", "on", "first"),
        ("after", "on", "first"),
    ]
    begun, joined = seen.index(("meanwhile", "on", "first")), seen.index(("after", "on", "first"))
    assert seen[begun + 1 : joined] == [("first", "waits for", "stream 1"), ("first", "waits for", "stream 2")]
    assert seen[0] == ("stream 1", "waits for", "first")
    assert seen[-1] == ("graph" if small else ("after", "on", "first"))
