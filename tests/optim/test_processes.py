"""Methods compute in processes of their own what they would compute here, and these do not outlive the first."""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import torch

from gradscape.optim.methods.surrogate import Surrogate, SurrogateOptions
from gradscape.optim.processes import compute, processes

KNOWN = 30


def informed() -> Surrogate:
    surrogate = Surrogate(2, SurrogateOptions())
    z = np.random.default_rng(1).uniform(-1.0, 1.0, (KNOWN, 2))
    surrogate.add(z, np.sin(5.0 * z).sum(axis=1))
    return surrogate


@pytest.mark.parametrize("cores", [1, 2])
def test_a_process_computes_the_same_bits_and_what_it_has_learnt_comes_back(cores: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(cores)
    here, there = informed(), informed()
    random = [np.random.default_rng(3) for _ in range(2)]
    wanted = [here.minimise(random[0]) for _ in range(2)]
    with processes(2):
        assert compute(os.getpid) != os.getpid()
        found = [there.minimise(random[1]) for _ in range(2)]
    np.testing.assert_array_equal(found, wanted)
    one, other = (surrogate.state() for surrogate in (here, there))
    assert one["fitted"] == other["fitted"] == KNOWN
    assert all(np.array_equal(one["hyper"][name], other["hyper"][name]) for name in one["hyper"])
    assert random[0].bit_generator.state == random[1].bit_generator.state
    assert compute(os.getpid) == os.getpid()
    assert torch.get_num_threads() == cores
    torch.set_num_threads(before)


def threads() -> set[int]:
    """Return how many threads the libraries use that searches for the least bound call."""
    import botorch.optim.batched_lbfgs_b  # noqa: F401 -- which has scipy's loaded
    import threadpoolctl

    return {int(one["num_threads"]) for one in threadpoolctl.threadpool_info()}


def test_a_process_has_one_thread() -> None:
    with processes(2):
        assert compute(threads) == {1}


def test_processes_end_with_the_first() -> None:
    script = """
        import os, signal
        from gradscape.optim.processes import compute, processes
        if __name__ == "__main__":
            with processes(2):
                print(compute(os.getpid), flush=True)
                os.kill(os.getpid(), signal.SIGKILL)
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        process = int(first.stdout.readline())
        assert first.stdout.read() == ""  # the end of what both write to: the process is gone, too
    assert process != first.pid
