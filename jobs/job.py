"""The base of every job with results in a folder: it can be stopped, continued and watched, and writes its results."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

import torch

from ..landscapes.convert import to_json
from ..landscapes.objective import Evaluation, Objective
from ..landscapes.sampling.memory import free_memory
from ..landscapes.storage.checkpoint import Checkpoint
from ..landscapes.storage.files import holding, tidy, write_json
from ..landscapes.storage.records import write_record
from ..landscapes.threads import one_torch_thread
from ..landscapes.verification import POINTS, StoredPoints, verify
from .folder import Results
from .watch import PREPARING, Watch, Work, resumable

if TYPE_CHECKING:
    from ..optim.runs.store import RunStore

Found = TypeVar("Found")


@dataclass(frozen=True, kw_only=True)
class Job(abc.ABC, Generic[Found]):
    """Work whose results lie in `folder`: a job computes what is missing there, draws it and writes it down.

    `command` is how the results are made again; `prints` are widths of pages [mm] that the figure is also drawn for.
    The record is the first file of its `results`, which also name the figure.
    """

    results: ClassVar[Results]
    folder: Path
    command: str = ""
    prints: Sequence[float] = ()

    @abc.abstractmethod
    def compute(self, watch: Watch) -> Found:
        """Say what is left and what it costs, compute it and return what was found."""

    def kept(self) -> str:
        """Say how much of it is on disk; the default says that no file is half written."""
        return f"every file in {self.folder} is complete"

    def work(self) -> Iterable[Work]:
        """Return what it has to simulate."""
        return []

    def run(self, watch: Watch | None = None) -> Found:
        """Compute what is missing; draw, write and return what was found.

        Raises Stopped where it is interrupted, and DiskFullError; the same job continues from what is kept then.
        """
        watch = watch or Watch()
        watch.plan(self.work())
        with self.holding(watch):
            found = self.compute(watch)
            files = self.write(found)
        watch.finish(self.folder, files, self.outcome(found))
        return found

    def holding(self, watch: Watch) -> AbstractContextManager[None]:
        """Give the context to work in; that of a job that is continued also locks its folder, and verifies it."""
        return resumable(self.kept)

    def outcome(self, found: Found) -> str:
        """Say in a line what came out."""
        return ""

    def record(self, found: Found) -> Any:
        """Return what is written of it."""
        return to_json(found)

    def write(self, found: Found) -> list[str]:
        """Draw and write what was found; return the names of the files."""
        printed = self.draw(found.plot) if self.results.picture and hasattr(found, "plot") else []
        write_record(self.folder / self.results.files[0], self.record(found))
        tidy(self.folder)
        return [*self.results.files, *printed]

    def draw(self, plot: Callable[..., Any]) -> list[str]:
        """Draw the figure, for a screen and for pages; return the names of those for pages."""
        from ..landscapes.draw.figures.page import save, save_prints

        path = self.folder / self.results.picture
        save(plot(), path)
        return save_prints(lambda width: plot(width=width), path, self.prints)


class Summary(Protocol):
    """What a job came to, as its last file has it."""

    @property
    def files(self) -> list[str]:
        """The files that it left."""

    def outcome(self) -> str:
        """Say in a line what came out."""


Summed = TypeVar("Summed", bound=Summary)


@dataclass(frozen=True, kw_only=True)
class SummaryJob(Job[Summed]):
    """A job that draws as it computes, and leaves a summary of what it came to."""

    def write(self, found: Summed) -> list[str]:
        """Write the summary."""
        write_json(self.folder / self.results.files[-1], to_json(found))
        tidy(self.folder)
        return found.files

    def outcome(self, found: Summed) -> str:
        """Say in a line what came out."""
        return found.outcome()


@dataclass(frozen=True, kw_only=True)
class CheckpointedJob(Job[Found]):
    """A job that keeps its parts in a checkpoint while it is not finished."""

    checkpoint: Checkpoint

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.checkpoint.count()} batches are kept in {self.folder}"

    def holding(self, watch: Watch) -> AbstractContextManager[None]:
        """Lock the folder, and verify that the simulator still gives the numbers in the checkpoint."""
        return self._going_on(watch)

    @contextmanager
    def _going_on(self, watch: Watch) -> Iterator[None]:
        with resumable(self.kept), holding(self.checkpoint.folder, watch.note):
            if (env := self.verified()) is not None:
                with watch.busy(PREPARING):
                    self.checkpoint.verify(env)
                    del env
                    free_memory()
            yield

    def verified(self) -> Objective | None:
        """Return the objective that the checkpoint is verified with; None verifies parts as they are read."""
        return None


@contextmanager
def filling(
    objective: Objective,
    runs: Sequence[RunStore],
    folder: Path,
    kept: Callable[[], str],
    watch: Watch,
    leave: Callable[[], object] = lambda: None,
) -> Iterator[None]:
    """Lock a folder of runs, waiting for another process that fills it, verify the runs, and let torch use one core.

    Three points of a single run are evaluated again, one of each of several, in one batch. Raises StoreMismatchError
    where the objective gives other numbers than they hold, and as `resumable` does.
    """
    with resumable(kept, leave), one_torch_thread(), holding(folder, watch.note) as waited:
        for run in runs if waited else ():
            with run.lock():  # reads it
                pass
        begun = [_points(run) for run in runs if run.count]
        with watch.busy(PREPARING):
            verify(objective, begun, points=POINTS if len(begun) == 1 else 1)
        yield


def _points(run: RunStore) -> StoredPoints:
    """Return what a run evaluated."""
    data = run.dataset()
    x, loss, grad, status = (torch.from_numpy(data[name].to_numpy()) for name in ("x", "loss", "grad", "status"))
    path, sloped = run.path or Path(), run.gradient_cost is not None
    return StoredPoints(path, "run", x, Evaluation(loss, grad, status), sloped)
