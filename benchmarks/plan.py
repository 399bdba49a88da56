"""Hold what `landscape plan` predicts against what jobs then take, each in a process of its own.

    python -m benchmarks.plan [--tries 3] [--only "slice of bounce"]

Prints predicted / taken, the medians of some tries, plan and job in turn: `seconds` of the whole command after its
start, so what a plan leaves out counts against it, and `bytes` on the disk.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

JOBS = {
    "slice of bounce": "slice bounce --dims 0 1 --resolution 64 --fidelity standard",
    "slice of flip": "slice flip --dims 0 1 --resolution 14 --fidelity draft",
    "slice of cartpole": "slice cartpole --dims 0 1 --resolution 128",
    "sweep of bounce": "sweep bounce --dims 0 1 --over 2 --frames 6 --resolution 16",
    "census of bounce": "census bounce --slices 8",
    "run of bounce": "optimize bounce --method random --budget 300",
    "race of bounce": "race bounce --methods random,cma-es,bo-leap --budget 100 --seeds 3",
}


def run(command: str, folder: Path) -> tuple[dict[str, float], float]:
    """Run a command in a folder; return what it printed as JSON, and how long it took [s]."""
    began = time.perf_counter()
    words = [sys.executable, "-m", "gradscape", *command.split(), "--json", "--device", "cpu"]
    done = subprocess.run(words, stdout=subprocess.PIPE, cwd=folder, check=True)
    return json.loads(done.stdout), time.perf_counter() - began


def ratios(job: str, folder: Path) -> dict[str, float]:
    """Plan a job, do it, and return what was predicted by what it took."""
    _, start = run("info", folder)
    planned, _ = run(f"plan {job}", folder)
    _, taken = run(f"{job} --out made", folder)
    there = sum(file.stat().st_size for file in (folder / "made").rglob("*") if file.is_file())
    return {"seconds": planned["seconds"] / (taken - start), "bytes": planned["disk"] / there}


def main() -> None:
    """Print the ratios of every job."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=3)
    parser.add_argument("--only", choices=list(JOBS), help="the name of one job")
    given = parser.parse_args()
    print("| predicted / taken | seconds | bytes |\n|---|---|---|")
    for name in [given.only] if given.only else JOBS:
        found = []
        for _ in range(given.tries):
            with tempfile.TemporaryDirectory() as folder:
                found.append(ratios(JOBS[name], Path(folder)))
        middle = {key: median(one[key] for one in found) for key in found[0]}
        print(f"| {name} | {middle['seconds']:.2f} | {middle['bytes']:.2f} |", flush=True)


if __name__ == "__main__":
    main()
