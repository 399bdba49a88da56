"""Two commands on the same result, started together: one fills it, the other waits and continues with the rest."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gradscape.landscapes.storage.files import holding
from gradscape.optim.runs.store import RunStore

from .command import Run

pytestmark = pytest.mark.e2e

SEARCHES = {
    "race": "race branin --methods random,cma-es --seeds 2 --budget 12 --out made",
    "league": "league branin beale --methods random,cma-es --seeds 2 --budget 12 --device cpu --out made",
    "optimize": "optimize branin --method random --budget 12 --out made",
    "pairs": "pairs branin --samples 2 --out made",
}
WAITING = "another process is filling"


def begin(command: str, folder: Path) -> subprocess.Popen[str]:
    """Start a command in a process of its own."""
    words = [sys.executable, "-m", "gradscape", *command.split()]
    return subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def until_it_waits(process: subprocess.Popen[str]) -> str:
    """Read what a process says until it waits for another."""
    assert process.stderr is not None
    said = ""
    for line in process.stderr:
        said += line
        if WAITING in line:
            return said
    raise AssertionError(f"it never waited: {said}")


@pytest.mark.parametrize("kind", ["race", "optimize"])
def test_two_of_the_same_end_well(tmp_path: Path, kind: str) -> None:
    both = [begin(SEARCHES[kind], tmp_path) for _ in range(2)]
    for process in both:
        said = process.communicate()[1]
        assert process.returncode == 0, said
        assert "Traceback" not in said
    for run in tmp_path.rglob("run.zarr"):
        assert RunStore.open(run).count == 12


@pytest.mark.parametrize(("kind", "held"), [("race", "made"), ("league", "made/branin-exact"), ("pairs", "made")])
def test_the_second_one_says_that_it_waits_and_goes_on_with_the_rest(tmp_path: Path, kind: str, held: str) -> None:
    with holding(tmp_path / held):
        second = begin(SEARCHES[kind], tmp_path)
        said = until_it_waits(second)
        assert f"{held}; waiting for it" in said
    assert second.communicate()[1] is not None
    assert second.returncode == 0


def test_one_that_waits_is_ended_by_ctrl_c(tmp_path: Path) -> None:
    with holding(tmp_path / "made"):
        second = begin(SEARCHES["race"], tmp_path)
        until_it_waits(second)
        second.send_signal(signal.SIGINT)
        said = second.communicate()[1]
    assert second.returncode == 130
    assert "0 of 48 episodes are kept in made" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    "command",
    [
        "census branin --slices 1 --resolution 6 --out made",
        "race branin --methods random --seeds 1 --budget 4 --out made",
        "optimize branin --method random --budget 4 --out made",
    ],
)
def test_what_another_process_fills_is_not_begun_anew(run: Run, tmp_path: Path, command: str) -> None:
    run.ok(command)
    with holding(tmp_path / "made"):  # a lock of this process's, too, is of another file that is open
        done = run.refuse(
            f"{command} --force", said="made is being filled by another process, so it is not started again"
        )
    assert len(done.stderr.splitlines()) == 1
