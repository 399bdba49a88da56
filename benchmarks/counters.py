"""What the kernels of a scene really move on a GPU, by its hardware counters, beside what they have to move at least.

    python -m benchmarks.counters fluid [--batch 1] [--set horizon=0.08] [--launches 300]

Needs NVIDIA's Nsight Compute (`ncu`) and the right to read counters. It profiles the launches around the turn from
forward to backward of episodes at standard, in batches as large as the scene likes unless told. A kernel is run again
for each of its counters, and what it wrote put back, which takes minutes where a scene fills the memory: shorten it.
`landscape bench SCENE --roofline` has the times of whole episodes.
"""

from __future__ import annotations

import argparse
import csv
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from gradscape.envs.engines.launches import one_by_one
from gradscape.envs.engines.profiling import count_demands, kernel_name, time_kernels
from gradscape.envs.registry import make

TIME = "gpu__time_duration.sum"
MEMORY = ("dram__bytes_read.sum", "dram__bytes_write.sum")
CACHE = "lts__t_bytes.sum"
SHARES = {
    "dram": "dram__throughput.avg.pct_of_peak_sustained_elapsed",
    "L2": "lts__throughput.avg.pct_of_peak_sustained_elapsed",
    "L1": "l1tex__throughput.avg.pct_of_peak_sustained_elapsed",
    "SM": "sm__throughput.avg.pct_of_peak_sustained_elapsed",
    "warps": "sm__warps_active.avg.pct_of_peak_sustained_active",
}
REGISTERS = "launch__registers_per_thread"
METRICS = (TIME, *MEMORY, CACHE, *SHARES.values(), REGISTERS)
WARP = re.compile(r"(?P<key>\w+)_cuda_kernel_(?P<way>forward|backward)")


@dataclass
class Counted:
    """What was counted of a kernel, summed over its launches."""

    launches: int
    totals: dict[str, float]

    def each(self, metric: str) -> float:
        """Return the mean of a metric over launches."""
        return self.totals[metric] / self.launches


def read_counters(lines: Iterable[str]) -> dict[str, Counted]:
    """Return what Nsight Compute printed as CSV, by the kernels' names as `time_kernels` has them."""
    launches: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    for row in csv.DictReader(line for line in lines if line.startswith('"')):
        found = WARP.fullmatch(row["Kernel Name"])
        if found:
            name = kernel_name(found["key"], backward=found["way"] == "backward")
            launches[name, row["ID"]][row["Metric Name"]] = float(row["Metric Value"].replace(",", ""))
    counted: dict[str, Counted] = {}
    for (name, _), metrics in launches.items():
        one = counted.setdefault(name, Counted(0, defaultdict(float)))
        one.launches += 1
        for metric, value in metrics.items():
            one.totals[metric] += value
    return counted


def simulate(scene: str, options: list[str], batch: int | None) -> None:
    """Simulate a batch with gradient, twice: the first compiles, and fills what is filled once."""
    env, points = prepare(scene, options, batch)
    with one_by_one():
        for _ in range(2):
            env._simulate(points, grad=True)


def prepare(scene: str, options: list[str], batch: int | None) -> tuple:
    """Return the environment and the points of a batch, at most what one solver takes."""
    env = make(scene, fidelity="standard", device="cuda", **dict(one.split("=", 1) for one in options))
    return env, env.space.sobol(env._rows_per_part(batch or env.preferred_batch), seed=0)


def profile(scene: str, options: list[str], batch: int, skip: int, launches: int) -> dict[str, Counted]:
    """Run a batch under Nsight Compute, and return what it counted of some launches."""
    command = ["ncu", "--target-processes", "all", "--metrics", ",".join(METRICS), "--csv"]
    command += ["--graph-profiling", "node", "--kernel-name", "regex:.*_cuda_kernel_(for|back)ward"]
    command += ["--launch-skip", str(skip), "--launch-count", str(launches)]
    command += [sys.executable, "-m", "benchmarks.counters", scene, "--simulate", "--batch", str(batch)]
    for option in options:
        command += ["--set", option]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return read_counters(done.stdout.splitlines())


def main() -> None:
    """Print a table of kernels."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--batch", type=int, help="how many episodes at once, at most as many as one solver takes")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="an option of the scene")
    parser.add_argument("--launches", type=int, default=300, help="how many to profile")
    parser.add_argument("--simulate", action="store_true", help="only simulate, to be profiled")
    asked = parser.parse_args()
    if asked.simulate:
        return simulate(asked.scene, asked.set, asked.batch)
    if shutil.which("ncu") is None:
        sys.exit("ncu (NVIDIA Nsight Compute) was not found; install it, or read `landscape bench --roofline` alone")
    env, points = prepare(asked.scene, asked.set, asked.batch)
    env._simulate(points, grad=True)
    with time_kernels("cuda") as there:
        env._simulate(points, grad=False)
    with time_kernels("cuda") as times:
        env._simulate(points, grad=True)
    with count_demands() as demands:
        env._simulate(points, grad=True)
    forward, all_ = (sum(one.calls for one in found.values()) for found in (there, times))
    counted = profile(asked.scene, asked.set, len(points), max(0, all_ + forward - asked.launches // 2), asked.launches)
    print(f"{asked.scene}, standard, batch {len(points)}, {' '.join(asked.set)}")
    heads = ("kernel", "launches", "µs", "has to move [MB]", "memory [MB]", "L2 [MB]", *SHARES, "registers")
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for name, one in sorted(counted.items(), key=lambda item: -item[1].totals[TIME]):
        least = demands[name].bytes / times[name].calls
        moved = sum(one.each(metric) for metric in MEMORY)
        shares = " | ".join(f"{one.each(metric):.0f} %" for metric in SHARES.values())
        sizes = " | ".join(f"{amount / 1e6:.3g}" for amount in (least, moved, one.each(CACHE)))
        time = f"{one.each(TIME) / 1e3:.1f}"
        print(f"| `{name}` | {one.launches} | {time} | {sizes} | {shares} | {one.each(REGISTERS):.0f} |")


if __name__ == "__main__":
    main()
