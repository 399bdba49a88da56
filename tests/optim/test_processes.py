"""Methods compute in processes of their own what they would compute here, and these do not outlive the first."""

import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from gradscape.optim.lockstep import Asking, Compute, Lockstep
from gradscape.optim.methods.surrogate import Surrogate, SurrogateOptions
from gradscape.optim.processes import WorkerProcesses

from .test_race import Bowl

pytestmark = pytest.mark.e2e

KNOWN = 30


def informed() -> Surrogate:
    surrogate = Surrogate(2, SurrogateOptions())
    z = np.random.default_rng(1).uniform(-1.0, 1.0, (KNOWN, 2))
    surrogate.add(z, np.sin(5.0 * z).sum(axis=1))
    return surrogate


def proposals(surrogate: Surrogate, random: np.random.Generator) -> Asking[list[np.ndarray]]:
    found = []
    for _ in range(2):
        found.append((yield from surrogate.minimise(random)))
    return found


def computed(function: Callable[[], Any], *, workers: int = 2) -> list[Any]:
    """Return what a function returns for three searches."""

    def asking() -> Asking[Any]:
        value, _ = yield Compute(function, ())
        return value

    return Lockstep(Bowl(), workers=workers).run([asking() for _ in range(3)])


@pytest.mark.parametrize("cores", [1, 2])
def test_a_process_computes_the_same_bits_and_what_it_has_learnt_comes_back(cores: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(cores)
    found, states = [], []
    for workers in (1, 2):
        surrogates, random = [informed() for _ in range(2)], [np.random.default_rng(seed) for seed in (3, 4)]
        asking = [proposals(*one) for one in zip(surrogates, random, strict=True)]
        found.append(Lockstep(Bowl(), workers=workers).run(asking))
        states.append([(one.state(), drawn.bit_generator.state) for one, drawn in zip(surrogates, random, strict=True)])
    np.testing.assert_array_equal(*found)
    for (one, drawn), (other, redrawn) in zip(*states, strict=True):
        assert one["_fitted"] == other["_fitted"] == KNOWN
        assert all(np.array_equal(one["_hyper"][name], other["_hyper"][name]) for name in one["_hyper"])
        assert drawn == redrawn
    assert torch.get_num_threads() == cores
    torch.set_num_threads(before)


def test_a_computation_begins_as_soon_as_a_search_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, seen, submit = list[int](), list[list[int]](), WorkerProcesses.submit

    def begin(processes: WorkerProcesses, search: int, function: Callable[[], Any]) -> Callable[[], Any]:
        begun.append(search)
        return submit(processes, search, function)

    def asking() -> Asking[None]:
        seen.append(list(begun))
        yield Compute(os.getpid, ())

    monkeypatch.setattr(WorkerProcesses, "submit", begin)
    Lockstep(Bowl()).run([asking() for _ in range(3)])
    assert seen == [[], [0], [0, 1]]


def test_searches_keep_their_processes() -> None:
    assert set(computed(os.getpid, workers=1)) == {os.getpid()}
    first, second, third = computed(os.getpid)
    assert os.getpid() not in (first, second)
    assert first == third != second


def threads() -> set[int]:
    """Return how many threads the libraries use that searches for the least bound call."""
    import botorch.optim.batched_lbfgs_b  # noqa: F401 -- which has scipy's loaded
    import threadpoolctl

    return {int(one["num_threads"]) for one in threadpoolctl.threadpool_info()}


def test_a_process_has_one_thread() -> None:
    assert computed(threads) == 3 * [{1}]


def test_processes_end_with_the_first() -> None:
    script = """
        import os, signal
        from gradscape.optim.processes import WorkerProcesses
        if __name__ == "__main__":
            with WorkerProcesses(2) as processes:
                print(processes.submit(0, os.getpid)(), flush=True)
                os.kill(os.getpid(), signal.SIGKILL)
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        process = int(first.stdout.readline())
        assert first.stdout.read() == ""  # the end of what both write to: the process is gone, too
    assert process != first.pid
