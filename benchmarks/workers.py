"""How the rate of a slice grows with the workers of one machine.

    python benchmarks/workers.py fluid --device cuda --fidelity draft --workers 1 2 4 [--json FILE]
    python benchmarks/workers.py fluid --pretend 46.4 --batch 25 --resolution 64 --workers 1 2 4

For each number of workers a cluster of them is started and warmed by a slice of its own; then the same slice is sampled
some times into a store of its own, and the best counts. Ratios are of one run, to its first number of workers. By
default the slice is of four whole batches for each of the most workers, and of 8 x 8 equal tiles, so that fewer workers
do the same batches.

`--pretend` measures what handing out, writing and reading cost where there are no GPUs: an evaluation takes as long as
on one that does so many episodes a second, asleep, in batches of `--batch`; its numbers mean nothing.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import torch

from gradscape.landscapes.objective import Evaluation, Objective, Status

# Workers import this file, and must choose their GPU before an engine starts: what starts one is imported in functions.


class Pretended(Objective):
    """Take as long for an evaluation as a GPU that does `rate` episodes a second, and no core."""

    def __init__(self, env: str, fidelity: str, rate: float, batch: int) -> None:
        from gradscape.envs.registry import make

        self.name, self.space = env, make(env, fidelity=fidelity, device="cpu").space
        self.rate, self.preferred_batch = rate, batch

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        """Return any numbers, after as long as that takes."""
        time.sleep(len(x) / self.rate)
        status = torch.full((len(x),), int(Status.OK), dtype=torch.int8)
        return Evaluation(x.square().sum(dim=1), 2 * x if grad else None, status)


def rate(made: Callable[[], Objective], resolution: int, executor: Executor | None) -> float:
    """Return the episodes with gradient per second of a slice through the box."""
    from gradscape.landscapes.plane import Plane
    from gradscape.landscapes.sampling.fill import sample
    from gradscape.landscapes.storage.store import SliceStore

    objective = made()
    plane = Plane.through(objective.space, objective.space.center, (0, 1), resolution=resolution)
    with tempfile.TemporaryDirectory() as folder:
        store = SliceStore.create(Path(folder) / "slice.zarr", plane, objective.space, identity={"objective": "any"})
        start = time.perf_counter()
        sample(objective, plane, store, executor=executor, made=made)
        return resolution**2 / (time.perf_counter() - start)


def measured(made: Callable[[], Objective], device: str, count: int, resolution: int, times: int) -> dict[str, Any]:
    """Return the rates of so many workers, once they are warm."""
    from gradscape.jobs.workers import workers

    start = time.perf_counter()
    with workers(f"local:{count}", device) as executor:
        for _ in range(2):  # a solver keeps more in memory from its second run on
            rate(made, resolution, executor)
        warm = time.perf_counter() - start
        rates = [rate(made, resolution, executor) for _ in range(times)]
    return {"workers": count, "seconds_until_warm": warm, "episodes_per_second": max(rates), "all": rates}


def chosen(given: argparse.Namespace) -> tuple[Callable[[], Objective], dict[str, Any]]:
    """Return what makes the objective, and what it is."""
    from gradscape.envs.registry import make
    from gradscape.jobs.workers import recipe

    env = make(given.env, fidelity=given.fidelity, device="cpu" if given.pretend else given.device)
    about = {"env": env.name, "fidelity": env.fidelity.name}
    if given.pretend:
        made = partial(Pretended, env.name, env.fidelity.name, given.pretend, given.batch)
        return made, {**about, "device": "cpu", "pretended": given.pretend, "batch": given.batch}
    return recipe(env), {**about, "device": env.device, "batch": env.preferred_batch}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--fidelity")
    parser.add_argument("--resolution", type=int)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--pretend", type=float, metavar="RATE", help="episodes/s of a GPU to pretend")
    parser.add_argument("--batch", type=int, default=32, help="of a pretended GPU")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    made, about = chosen(given)
    resolution = given.resolution or max(8, math.isqrt(4 * max(given.workers) * about["batch"]) // 8 * 8)
    print(" · ".join(f"{name} {value}" for name, value in about.items()), f"· {resolution}² points")
    print("workers  episodes/s  ratio  of linear")
    rows: list[dict[str, Any]] = []
    for count in given.workers:
        row = measured(made, about["device"], count, resolution, given.repetitions)
        rows.append(row)
        row["ratio"] = row["episodes_per_second"] / rows[0]["episodes_per_second"]
        row["of_linear"] = row["ratio"] / count * given.workers[0]
        print(
            f"{count:7d}  {row['episodes_per_second']:10.1f}  {row['ratio']:5.2f}  {row['of_linear']:9.1%}", flush=True
        )
    if given.json:
        given.json.write_text(json.dumps({**about, "resolution": resolution, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
