"""Who asks together is answered together, and nobody waits for a process that need not."""

import os
from functools import partial
from pathlib import Path

import pytest
import torch

from gradscape import ParameterSpace
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.optim.meeting import Meeting, work_abreast
from gradscape.optim.processes import compute, processes

X = torch.zeros(3, 1, dtype=torch.float64)


class Counted:
    """An objective on a device, which counts the rows of its batches."""

    space = ParameterSpace.box(("x",), -1.0, 1.0)

    def __init__(self, device: str) -> None:
        self.device, self.batches = device, list[int]()

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        self.batches.append(len(x))
        return Evaluation(x[:, 0], torch.ones_like(x), torch.full((len(x),), Status.OK, dtype=torch.int8))


def read(pipe: Path) -> str:
    """Return what is written into a pipe, for which it waits."""
    return pipe.read_text()


def work(meeting: Meeting, first: bool, pipe: Path | None) -> str:
    """Ask at once, or once a process has computed; with a pipe that process waits for the answer of the first."""
    if first:
        meeting.evaluate(X)
        if pipe is not None:
            pipe.write_text("answered")
        return ""
    said = compute(read, pipe) if pipe is not None else compute(os.getcwd)
    meeting.evaluate(X)
    return said


def test_on_a_cpu_nobody_waits_for_those_whose_process_computes(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    objective = Counted("cpu")
    tasks = [partial(work, first=first, pipe=tmp_path / "pipe") for first in (True, False)]
    with processes(2):
        assert work_abreast(objective, tasks) == ["", "answered"]
    assert objective.batches == [3, 3]


def test_on_a_gpu_all_are_waited_for_since_a_full_batch_takes_no_longer() -> None:
    objective = Counted("cuda")
    with processes(2):
        work_abreast(objective, [partial(work, first=first, pipe=None) for first in (True, False)])
    assert objective.batches == [6]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_an_error_of_the_objective_ends_all(device: str) -> None:
    objective = Counted(device)
    objective.evaluate = lambda x, *, grad=True: 1 / 0  # type: ignore[method-assign]
    with processes(2), pytest.raises(ZeroDivisionError):
        work_abreast(objective, [partial(work, first=first, pipe=None) for first in (True, False)])
