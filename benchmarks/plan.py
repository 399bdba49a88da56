"""Compare the predictions of `landscape plan`, and the announcements of jobs, with the actual cost.

    python -m benchmarks.plan [--tries 3] [--only "slice of bounce"]

Prints predicted / actual cost, the medians of some tries, plan and job in turn: `planned` seconds of the whole command
after its start, including everything that a plan leaves out; `announced` seconds, of the time after the announcement;
and `bytes` on the disk.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

JOBS = {
    "slice of bounce": "slice bounce --dims 0 1 --resolution 64 --fidelity standard",
    "slice of branin": "slice branin --resolution 128",
    "slice of flip": "slice flip --dims 0 1 --resolution 14 --fidelity draft",
    "slice of swing": "slice swing-velocity --dims 0 1 --resolution 8 --fidelity draft",
    "slice of cartpole": "slice cartpole --dims 0 1 --resolution 128",
    "sweep of bounce": "sweep bounce --dims 0 1 --over 2 --frames 6 --resolution 16",
    "census of bounce": "census bounce --slices 8",
    "run of bounce": "optimize bounce --method random --budget 3000",
    "race of bounce": "race bounce --methods random,cma-es,bo-leap --budget 100 --seeds 3",
    "check of bounce": "check bounce",
    "check of branin": "check branin",
    "check of cartpole": "check cartpole",
    "study of bounce": "study fidelity bounce --points 8",
    "convergence of bounce": "study convergence bounce --points 8",
}
SAID = re.compile(r"about ([\d.]+) (s|min|h)\b")
UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}


def run(command: str, folder: Path) -> tuple[dict[str, float], float, float | None]:
    """Run a command in a folder; return its JSON output, its seconds, and announced / actual seconds after that."""
    began, said, at = time.perf_counter(), 0.0, 0.0
    words = [sys.executable, "-m", "gradscape", *command.split(), "--json"]
    with subprocess.Popen(words, stdout=(folder / "printed").open("w"), stderr=subprocess.PIPE, cwd=folder) as job:
        for line in job.stderr or ():
            if found := SAID.search(line.decode()):
                said, at = float(found[1]) * UNITS[found[2]], time.perf_counter()
    ended = time.perf_counter()
    if job.returncode > 1:  # a check that fails ends with 1
        raise RuntimeError(f"{command} ended with {job.returncode}")
    return json.loads((folder / "printed").read_text()), ended - began, said / (ended - at) if at else None


def ratios(job: str, folder: Path) -> dict[str, float]:
    """Plan a job, run it, and return the predicted cost over the actual one."""
    _, start, _ = run("info", folder)
    planned, _, _ = run(f"plan {job} --device cpu", folder)
    _, taken, announced = run(f"{job} --device cpu --out made", folder)
    there = sum(file.stat().st_size for file in (folder / "made").rglob("*") if file.is_file())
    found = {"planned": planned["seconds"] / (taken - start), "bytes": planned["disk"] / there, "seconds": taken}
    return found if announced is None else {**found, "announced": announced}


def main() -> None:
    """Print the ratios of every job."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=3)
    parser.add_argument("--only", choices=list(JOBS), nargs="+", help="the names of some jobs")
    given = parser.parse_args()
    print("| predicted / taken | planned | announced | bytes | taken [s] |\n|---|---|---|---|---|")
    for name in given.only or JOBS:
        found = []
        for _ in range(given.tries):
            with tempfile.TemporaryDirectory() as folder:
                found.append(ratios(JOBS[name], Path(folder)))
        middle = {key: median(one[key] for one in found if key in one) for one in found for key in one}
        cells = [f"{middle[key]:.2f}" if key in middle else "" for key in ("planned", "announced", "bytes", "seconds")]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
