"""Measure the start-up time of a command, and the effect of a change on it.

    python -m benchmarks.start [pinball-2] [--repetitions 5] [--against OTHER/src]

`landscape slice ENV --dims 0 1` runs repeatedly on warm caches, each time in its own process and folder. It prints the
share of importing in its time, and the share of each package in that. With `--against` the same command of another
checkout runs in turn with it, so that other load on the machine affects both; the ratio is that of the medians. Do not
compare times of different runs.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import median

HERE = Path(__file__).resolve().parent.parent / "src"
LINE = re.compile(r"import time:\s*(\d+) \|\s*\d+ \|\s*(\S+)")  # of `python -X importtime` [µs]
MAX_PACKAGES = 8


@dataclass(frozen=True)
class Spent:
    """Seconds of a command: wall clock, processor time, and imports by package if requested."""

    clock: float
    processor: float
    importing: Counter[str]


def run(words: list[str], source: Path, *how: str) -> Spent:
    """Run a command of a checkout in an empty folder. Raises RuntimeError where that fails."""
    command = [sys.executable, *how, "-m", "gradscape", *words]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"PYTHONPATH": str(source)}
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    clock, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(f"the command failed with {source}: {done.stderr[-2000:]}")
    importing = Counter[str]()
    for own, name in LINE.findall(done.stderr):
        importing[name.partition(".")[0]] += int(own) / 1e6
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Spent(clock, processor, importing)


def main() -> None:
    """Run the command, and print the shares of its parts, and the ratio to another checkout's."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", nargs="?", default="pinball-2")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--against", type=Path, help="the folder src of another checkout")
    given = parser.parse_args()
    words = ["slice", given.env, "--dims", "0", "1"]
    sources = [HERE] + ([given.against.resolve()] if given.against else [])
    for source in sources:
        run(words, source)  # fills the caches
    found = [run(words, HERE, "-X", "importtime") for _ in range(given.repetitions)]
    print(f"importing: {median(one.importing.total() / one.clock for one in found):.0%} of the command, of which")
    packages = [f"{name} {one / found[-1].importing.total():.0%}" for name, one in
                found[-1].importing.most_common(MAX_PACKAGES)]  # fmt: skip
    print("  " + ", ".join(packages))
    if given.against:
        turns = [[run(words, source) for source in sources] for _ in range(given.repetitions)]
        for kind in ("clock", "processor"):
            here, there = (median(getattr(turn[k], kind) for turn in turns) for k in range(2))
            print(f"{kind}: {here / there:.2f} of the other checkout's, {len(turns)} times in turn")


if __name__ == "__main__":
    main()
