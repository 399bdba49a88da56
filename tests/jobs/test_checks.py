"""Several environments are checked by processes that end with whoever started them."""

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from gradscape.jobs.checks import ChecksJob
from gradscape.jobs.scene import SceneSpec
from gradscape.jobs.watch import Advance, Stopped, Watch


class Interrupted(Watch):
    """Ctrl-C once the first environment is done."""

    @contextmanager
    def progress(self, total: int, what: str = "episodes") -> Iterator[Advance]:
        def advance(done: int, said: str = "") -> None:
            if done:
                raise KeyboardInterrupt

        yield advance


@pytest.mark.e2e
def test_an_interrupt_ends_the_processes_and_says_that_nothing_is_kept() -> None:
    specs = [SceneSpec(name) for name in ("branin", "ackley", "rope", "fluid", "writer")]
    with pytest.raises(Stopped, match=r"^1 of 5 environments are checked, and nothing is kept of them$") as stopped:
        ChecksJob(specs, 0.2, 0, 2).run(Interrupted())
    assert not stopped.value.kept
    assert multiprocessing.active_children() == []
