"""The messages of a job to its watch, and how a job ends when it is stopped. A job itself prints nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..landscapes.storage.files import until_full

if TYPE_CHECKING:
    from ..landscapes.objective import Objective

Advance = Callable[..., None]  # advance(done, said=""): how much is done, and the text next to the bar
AdvanceOne = Callable[[str, int, str], None]  # advance(name, done, said): the same, of one of several
Say = Callable[[str], None]  # say(text): what is being done now


PREPARING = "preparing (kernels are compiled once, then cached)"


@dataclass(frozen=True)
class Work:
    """Record what a job has to simulate: `losses` without gradients and `gradients` with, and the bytes it leaves.

    `memory` is the size of its own arrays [bytes], without the simulation's. `others` is the number of variants of the
    objective that it makes, each of which may compile its own programs. `repeats` returns the time of repetitions for
    timing [s], given the time of an episode with gradient [s].
    """

    objective: Objective
    losses: int
    gradients: int = 0
    disk: float = 0.0
    memory: float = 0.0
    others: float = 0.0
    repeats: Callable[[float], float] = lambda each: 0.0


class Stopped(KeyboardInterrupt):
    """A job was stopped by Ctrl-C; the message says what is kept, and the same call or command continues from there.

    If nothing is `kept`, it starts again.
    """

    def __init__(self, said: str, *, kept: bool = True) -> None:
        super().__init__(said)
        self.kept = kept


class Planned(Exception):  # noqa: N818 -- no error, but where a job would begin
    """Say what a job would have to simulate, where it would begin."""

    def __init__(self, works: Sequence[Work]) -> None:
        super().__init__(f"{len(works)} parts of a job are planned, not done")
        self.works = works


@contextmanager
def resumable(kept: Callable[[], str], leave: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Let Ctrl-C and a full disk end a job with what is `kept` of it; what is to be left behind is left before.

    Raises Stopped for KeyboardInterrupt, and DiskFullError for a full disk.
    """
    try:
        with until_full(kept):
            yield
    except KeyboardInterrupt as error:
        said = kept()
        leave()
        raise Stopped(said) from error


class Watch:
    """Take no notice of what a job tells; a watch that shows it derives from this one and overrides its methods."""

    def note(self, text: str) -> None:
        """Take a line that is worth keeping: what a job will cost, a warning, what it has left out."""

    def announce(self, text: str, seconds: float) -> None:
        """Take a line that says what is left to do, which is expected to take so long [s] from now."""
        self.note(text)

    def plan(self, works: Iterable[Work]) -> None:
        """Take what a job is about to simulate; a watch that only plans raises Planned."""

    def finish(self, folder: Path, files: Sequence[str], said: str = "") -> None:
        """Take where a job has left which files, and in a line what came out."""
        self.note(f"{said}\n{folder}: {', '.join(files)}".lstrip())

    @contextmanager
    def busy(self, text: str) -> Iterator[Say]:
        """Take what a job does that nothing can be counted of, as long as it does it; give what says it otherwise."""
        yield lambda text: None

    @contextmanager
    def progress(self, total: int, what: str = "episodes") -> Iterator[Advance]:
        """Give a function that takes how many of `total` are done, and in words what to say next to that."""
        yield lambda done, said="": None

    @contextmanager
    def progress_of(self, totals: Mapping[str, int]) -> Iterator[AdvanceOne]:
        """Give a function that takes of which of several things how many of its total are done, and what to say."""
        yield lambda name, done, said: None
