"""Hold what `landscape plan` predicts against what jobs then take, everything in a process of its own.

    python benchmarks/plan.py [--tries 5] [--json]

Prints predicted / taken, the medians of some tries, plan and job in turn: `wall` from start to end, `work` without the
start, `memory` of the host at its peak, `bytes` and `files` on the disk.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from subprocess import Popen
from typing import Any

JOBS = {
    "slice of bounce": "slice bounce --dims 0 1 --resolution 64 --fidelity standard",
    "slice of flip": "slice flip --dims 0 1 --resolution 14 --fidelity draft",
    "slice of cartpole": "slice cartpole --dims 0 1 --resolution 128",  # a third of its memory is gradients
    "sweep of bounce": "sweep bounce --dims 0 1 --over 2 --frames 6 --resolution 16",
}
WORK = ("simulating", "writing", "drawing", "between")


@dataclass(frozen=True)
class Taken:
    """What a command printed, how long its process was there [s], and the most memory it held [bytes]."""

    said: dict[str, Any]
    wall: float
    memory: int


def run(command: str, folder: Path) -> Taken:
    """Run a command in a folder and in a process of its own."""
    said, began = folder / "said.json", time.perf_counter()
    arguments = [sys.executable, "-m", "gradscape", *command.split(), "--json", "--device", "cpu"]
    with said.open("w") as out, Popen(arguments, stdout=out, stderr=sys.stderr, cwd=folder) as process:
        _, code, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(code)
    if process.returncode:
        raise RuntimeError(f"{command} left with exit code {process.returncode}")
    wall = time.perf_counter() - began
    return Taken(json.loads(said.read_text()), wall, used.ru_maxrss * (1 if sys.platform == "darwin" else 1024))


def ratios(job: str, folder: Path) -> dict[str, float]:
    """Plan a job, do it, and return what was predicted by what it took."""
    _, _, what = job.partition(" ")
    planned, taken = run(f"plan {what}", folder).said, run(f"{job} --out made", folder)
    from gradscape.jobs.rehearsal import room_of

    room = room_of(folder / "made")
    return {
        "wall": planned["wall"] / taken.wall,
        "work": sum(planned["seconds"][part] for part in WORK) / taken.said["seconds"],
        "memory": planned["memory"]["host"] / taken.memory,
        "bytes": planned["disk"]["bytes"] / room.bytes,
        "files": planned["disk"]["files"] / (room.files - 1),  # all that is in the folder
    }


def tried(job: str, tries: int) -> dict[str, float]:
    """Return the median of each ratio."""
    found = []
    for _ in range(tries):
        with tempfile.TemporaryDirectory() as folder:
            found.append(ratios(job, Path(folder)))
    return {name: median(one[name] for one in found) for name in found[0]}


def main() -> None:
    """Print the ratios of every job."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    found = {name: tried(job, given.tries) for name, job in JOBS.items()}
    if given.json:
        print(json.dumps(found))
        return
    columns = list(next(iter(found.values())))
    print(f"| predicted / taken | {' | '.join(columns)} |\n|---{'|---' * len(columns)}|")
    for name, one in found.items():
        print(f"| {name} | {' | '.join(f'{one[column]:.2f}' for column in columns)} |")


if __name__ == "__main__":
    main()
