"""What the start of a command costs beside what it simulates, and whether a change made it shorter.

    python benchmarks/start.py [pinball-2] [--repetitions 5] [--against OTHER/src]

One command, `landscape slice ENV --dims 0 1`, is run again and again, each time in a process and a folder of its own on
caches that a first time has filled. Its parts are shares of the command's own time: what Python spends on importing, by
package; making kernels ready; simulating; drawing. Drawing and the rest are without what they import.

With `--against` the same command of another checkout is run in turn with it, so that what else the machine does falls
on both: the ratio is that of the medians. Times of different runs are not to be divided by each other.
"""

from __future__ import annotations

import argparse
import json
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
LINE = re.compile(r"import time:\s*(\d+) \|\s*\d+ \|\s*(\S+)")
MOST = 8  # packages that are named
# Run in the process of the command: it times what a part calls, by the clock, less what is imported meanwhile.
PROGRAM = """
import atexit, importlib, json, sys, time
began, inside, parts = time.perf_counter(), [0.0], dict.fromkeys(("kernels", "simulating", "drawing"), 0.0)
find = importlib._bootstrap._find_and_load
depth = [0]
def importing(*given):
    depth[0] += 1
    start = time.perf_counter()
    try:
        return find(*given)
    finally:
        depth[0] -= 1
        if not depth[0]:
            inside[0] += time.perf_counter() - start
importlib._bootstrap._find_and_load = importing
def watch(owner, name, part):
    plain = getattr(owner, name)
    def timed(*given, **named):
        start, before = time.perf_counter(), inside[0]
        try:
            return plain(*given, **named)
        finally:
            parts[part] += time.perf_counter() - start - (inside[0] - before)
    setattr(owner, name, timed)
def say():
    whole = {"whole": time.perf_counter() - began, "importing": inside[0], **parts}
    print("PARTS" + json.dumps(whole), file=sys.stderr)
atexit.register(say)
from gradscape import __main__ as command
from gradscape.envs.base import Environment
from gradscape.jobs.slice import SliceJob
watch(Environment, "prepare", "kernels")
watch(Environment, "evaluate", "simulating")
watch(SliceJob, "_save", "drawing")
command.main()
"""


@dataclass(frozen=True)
class Spent:
    """Hold the seconds of a command by the clock and of processors, and what it wrote to standard error."""

    clock: float
    processor: float
    said: str


def run(words: list[str], source: Path, *how: str) -> Spent:
    """Run Python on words with one checkout in an empty folder. Raises RuntimeError where that fails."""
    environment = os.environ | {"PYTHONPATH": str(source)}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, *how, *words], cwd=folder, env=environment, capture_output=True, text=True
        )
    clock, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(f"the command failed with {source}: {done.stderr[-2000:]}")
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Spent(clock, processor, done.stderr)


def parts(words: list[str], source: Path) -> dict[str, float]:
    """Return the shares of a command's time that its parts take."""
    said = run(["-c", PROGRAM, *words], source).said
    seconds: dict[str, float] = json.loads(said.rpartition("PARTS")[2])
    whole = seconds.pop("whole")
    shares = {name: one / whole for name, one in seconds.items()}
    return shares | {"rest": 1 - sum(shares.values())}


def packages(words: list[str], source: Path) -> dict[str, float]:
    """Return the shares of packages in the time that a command imports for, the largest first."""
    seconds: Counter[str] = Counter()
    for own, name in LINE.findall(run(["-m", "gradscape", *words], source, "-X", "importtime").said):
        seconds[name.partition(".")[0]] += int(own)
    return {name: one / seconds.total() for name, one in seconds.most_common(MOST)}


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
        run(["-m", "gradscape", *words], source)  # fills the caches
    found = [parts(words, HERE) for _ in range(given.repetitions)]
    print("of the whole:", ", ".join(f"{name} {median(one[name] for one in found):.0%}" for name in found[0]))
    print("of importing:", ", ".join(f"{name} {one:.0%}" for name, one in packages(words, HERE).items()))
    if given.against:
        turns = [[run(["-m", "gradscape", *words], source) for source in sources] for _ in range(given.repetitions)]
        for kind in ("clock", "processor"):
            here, there = (median(getattr(turn[k], kind) for turn in turns) for k in range(2))
            print(f"{kind}: {here / there:.2f} of the other checkout's, {len(turns)} times in turn")


if __name__ == "__main__":
    main()
