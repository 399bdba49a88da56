"""Hold what `landscape plan` predicts against what jobs then take, each in a process of its own.

    python -m benchmarks.plan [--tries 5] [--json] [--only "race of bounce"]

Prints predicted / taken, the medians of some tries, plan and job in turn: `wall` from start to end, `work` without the
start, `memory` of the host at its peak, `bytes` and `files` on the disk. Of a race, planned and run in this process:
`work`, its parts `simulating` and `methods`, and `bytes`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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
RACERS, SEEDS, BUDGET = ("random", "cma-es", "descents", "bo", "bo-leap"), 3, 200  # of a race of bounce
WORK = ("simulating", "writing", "drawing", "between")


@dataclass(frozen=True)
class Taken:
    """What a command printed, how long its process was there [s], and the most memory it held [bytes]."""

    said: dict[str, Any]
    wall: float
    memory: int


def run(command: str, folder: Path) -> Taken:
    """Run a command in a folder and in a process of its own. Raises RuntimeError where it fails."""
    said, began = folder / "said.json", time.perf_counter()
    arguments = [sys.executable, "-m", "gradscape", *command.split(), "--json", "--device", "cpu"]
    with said.open("w") as out, Popen(arguments, stdout=out, cwd=folder) as process:
        _, code, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(code)
    if process.returncode:
        raise RuntimeError(f"{command} left with exit code {process.returncode}")
    wall = time.perf_counter() - began
    return Taken(json.loads(said.read_text()), wall, used.ru_maxrss * (1 if sys.platform == "darwin" else 1024))


def ratios(job: str, folder: Path) -> dict[str, float]:
    """Plan a job, do it, and return what was predicted by what it took."""
    from gradscape.jobs.rehearsal import room_of

    planned, taken = run(f"plan {job.partition(' ')[2]}", folder).said, run(f"{job} --out made", folder)
    room = room_of(folder / "made")
    return {
        "wall": planned["wall"] / taken.wall,
        "work": sum(planned["seconds"][part] for part in WORK) / taken.said["seconds"],
        "memory": planned["memory"]["host"] / taken.memory,
        "bytes": planned["disk"]["bytes"] / room.bytes,
        "files": planned["disk"]["files"] / (room.files - 1),  # all that is in the folder
    }


def race_ratios(folder: Path) -> dict[str, float]:
    """Plan a race, let it run, and return what was predicted by what it took."""
    from gradscape.envs.engines.runtime import cores
    from gradscape.jobs.plan_race import RacePlanJob
    from gradscape.jobs.race import RaceJob
    from gradscape.jobs.scene import SceneSpec
    from gradscape.landscapes.threads import one_torch_thread
    from gradscape.optim.processes import processes
    from gradscape.optim.race import race

    scene, workers = SceneSpec("bounce", "draft", device="cpu"), cores()
    plan = RacePlanJob(scene, RACERS, SEEDS, BUDGET, workers).run().plan
    env = scene.make()
    job = RaceJob.of(env, RACERS, budget=BUDGET, seeds=SEEDS, command="", out=folder / "race")
    evaluate, simulating = env.evaluate, 0.0

    def timed(*given: Any, **options: Any) -> Any:
        nonlocal simulating
        began = time.perf_counter()
        found = evaluate(*given, **options)
        simulating += time.perf_counter() - began
        return found

    env.evaluate = timed  # type: ignore[method-assign]
    began = time.perf_counter()
    with one_torch_thread(), processes(workers):
        race(env, job.competitors, budget=BUDGET, gradient_cost=1.0)
    wall = time.perf_counter() - began
    return {
        "work": (plan.simulating + plan.searching) / wall,
        "simulating": plan.simulating / simulating,
        "methods": plan.searching / (wall - simulating),
        "bytes": plan.disk / sum(512 * one.stat().st_blocks for one in (folder / "race").rglob("*")),
    }


def tried(find: Callable[[Path], dict[str, float]], tries: int) -> dict[str, float]:
    """Return the median of each ratio."""
    found = []
    for _ in range(tries):
        with tempfile.TemporaryDirectory() as folder:
            found.append(find(Path(folder)))
    return {name: median(one[name] for one in found) for name in found[0]}


def main() -> None:
    """Print the ratios of every job."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", help="the name of one job")
    given = parser.parse_args()
    finders = {**{name: partial(ratios, job) for name, job in JOBS.items()}, "race of bounce": race_ratios}
    chosen = finders if given.only is None else {given.only: finders[given.only]}
    found = {name: tried(find, given.tries) for name, find in chosen.items()}
    if given.json:
        print(json.dumps(found))
        return
    columns = list(dict.fromkeys(column for one in found.values() for column in one))
    print(f"| predicted / taken | {' | '.join(columns)} |\n|---{'|---' * len(columns)}|")
    for name, one in found.items():
        print(f"| {name} | {' | '.join(f'{one[column]:.2f}' if column in one else '' for column in columns)} |")


if __name__ == "__main__":
    main()
