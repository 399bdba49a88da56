"""How studies and runs go on: alone in their folder, with a simulator that gives the numbers that are stored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from ..landscapes.objective import Evaluation, Objective
from ..landscapes.sampling.memory import free_memory
from ..landscapes.storage.locks import holding
from ..landscapes.verification import POINTS, StoredPoints, verify
from .watch import PREPARING, Watch, resumable

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.storage.checkpoint import Checkpoint
    from ..optim.runs.store import RunStore


@contextmanager
def going_on(
    pieces: Checkpoint, make: Callable[[], Environment | None], kept: Callable[[], str], watch: Watch
) -> Iterator[None]:
    """Hold a study's folder, after another process that fills it, and verify the environment that `make` returns.

    Raises StoreMismatchError where it gives other numbers than when the study began, and as `resumable` does.
    """
    with resumable(kept), holding(pieces.folder, watch.note):
        _verify(pieces, make, watch)
        yield


def _verify(pieces: Checkpoint, make: Callable[[], Environment | None], watch: Watch) -> None:
    """Verify the environment that `make` returns, which is gone afterwards with the memory it has taken."""
    if (env := make()) is not None:
        with watch.busy(PREPARING):
            pieces.verify(env)
            del env
            free_memory()


@contextmanager
def filling(objective: Objective, runs: Sequence[RunStore], folder: Path, watch: Watch) -> Iterator[None]:
    """Hold a folder of runs, after another process that fills it, and verify the runs.

    Three points of a single run are evaluated anew, one of each of several, in one batch. Raises StoreMismatchError
    where the objective gives other numbers than they hold.
    """
    with holding(folder, watch.note) as waited:
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
