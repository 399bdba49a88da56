"""How the rate of a slice grows with the workers of one machine.

    python benchmarks/workers.py fluid --device cuda --fidelity draft --workers 1 2 4 [--json FILE]

For each number of workers a cluster of them is started and warmed by a slice of its own; then the same slice is sampled
some times into a store of its own, and the best counts. Ratios are of one run, to its first number of workers. By
default the slice is of four whole batches for each of the most workers, and of 8 x 8 equal tiles, so that fewer workers
do the same batches.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # workers import this file, and must choose their GPU before an engine starts
    from gradscape.envs.base import Environment


def rate(env: Environment, resolution: int, executor: Executor | None) -> float:
    """Return the episodes with gradient per second of a slice through the box."""
    from gradscape.cluster import recipe
    from gradscape.landscapes.plane import Plane
    from gradscape.landscapes.sampling import sample
    from gradscape.landscapes.store import SliceStore

    plane = Plane.through(env.space, env.space.center, (0, 1), resolution=resolution)
    with tempfile.TemporaryDirectory() as folder:
        store = SliceStore.create(Path(folder) / "slice.zarr", plane, env.space, identity={"objective": env.name})
        start = time.perf_counter()
        sample(env, plane, store, executor=executor, made=recipe(env))
        return resolution**2 / (time.perf_counter() - start)


def measured(env: Environment, count: int, resolution: int, repetitions: int) -> dict[str, Any]:
    """Return the rates of so many workers, once they are warm."""
    from gradscape.cluster import workers

    start = time.perf_counter()
    with workers(f"local:{count}", env.device) as executor:
        for _ in range(2):  # a solver keeps more in memory from its second run on
            rate(env, resolution, executor)
        warm = time.perf_counter() - start
        rates = [rate(env, resolution, executor) for _ in range(repetitions)]
    return {"workers": count, "seconds_until_warm": warm, "episodes_per_second": max(rates), "all": rates}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--fidelity")
    parser.add_argument("--resolution", type=int)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    from gradscape.envs.registry import make

    env = make(given.env, fidelity=given.fidelity, device=given.device)
    resolution = given.resolution or max(8, math.isqrt(4 * max(given.workers) * env.preferred_batch) // 8 * 8)
    print(f"{env.name} · {env.fidelity.name} · {env.device} · {resolution}² points · batch {env.preferred_batch}")
    print("workers  episodes/s  ratio  of linear")
    rows: list[dict[str, Any]] = []
    for count in given.workers:
        row = measured(env, count, resolution, given.repetitions)
        rows.append(row)
        row["ratio"] = row["episodes_per_second"] / rows[0]["episodes_per_second"]
        row["of_linear"] = row["ratio"] / count * given.workers[0]
        print(
            f"{count:7d}  {row['episodes_per_second']:10.1f}  {row['ratio']:5.2f}  {row['of_linear']:9.1%}", flush=True
        )
    if given.json:
        about = {"env": env.name, "fidelity": env.fidelity.name, "device": env.device, "batch": env.preferred_batch}
        given.json.write_text(json.dumps({**about, "resolution": resolution, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
