"""How simulated scenes behave: draft against standard, examples, failures, memory, cost.

    python benchmarks/scenes.py [--device cuda] [--points 64] [--scenes writer,rope]

Prints one line per scene and writes them to --out as JSON. On two cores take few points for the scenes of particles (a
standard episode costs about ten seconds of one core); on a GPU all of it takes some minutes.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from scipy.stats import spearmanr
from torch import Tensor

from gradscape.envs.registry import SCENE, entries, make
from gradscape.landscapes.objective import Evaluation, Status

WARM = 8  # rows evaluated before a clock starts


def compare(name: str, device: str, count: int) -> dict[str, Any]:
    """Return what one scene's draft and standard say of the same points, and what they cost."""
    both = {fidelity: make(name, fidelity=fidelity, device=device) for fidelity in ("draft", "standard")}
    draft = both["draft"]
    points = draft.space.sobol(count, seed=0)
    said, cost = {}, {}
    for fidelity, env in both.items():
        said[fidelity], cost[fidelity] = timed(env, points)
    ours, theirs = said.values()
    ok = (ours.status == Status.OK) & (theirs.status == Status.OK)
    return {
        "scene": name,
        "points": count,
        "spearman": float(spearmanr(ours.loss[ok], theirs.loss[ok]).statistic),
        "cosine": float(torch.cosine_similarity(ours.grad[ok], theirs.grad[ok]).median()),
        "failed": {key: int((result.status != Status.OK).sum()) for key, result in said.items()},
        "steepest": {key: steepest(result.grad) for key, result in said.items()},
        "flat": {key: int((result.grad == 0).all(dim=1).sum()) for key, result in said.items()},
        "range": [float(theirs.loss[ok].min()), float(theirs.loss[ok].max())],
        "examples": {key: known(env) for key, env in both.items()},
        "megabytes": {key: env.memory() / 1e6 for key, env in both.items()},
        "cost": cost,
    }


def known(env: Any) -> dict[str, float]:
    """Return the loss of each example."""
    return {name: float(env.evaluate(env.example(name)[None], grad=False).loss) for name in env.examples}


def steepest(grad: Tensor) -> float:
    """Return the length of the longest gradient."""
    return float(grad.norm(dim=1).nan_to_num(torch.inf).max())


def timed(env: Any, points: Tensor) -> tuple[Evaluation, dict[str, float]]:
    """Evaluate points with gradients; return what came out, and the seconds all and the core seconds each took."""
    env.evaluate(points[:WARM])
    wall, core = time.perf_counter(), time.process_time()
    result: Evaluation = env.evaluate(points)
    core = (time.process_time() - core) / len(points)
    return result, {"seconds": time.perf_counter() - wall, "core seconds each": core}


def main() -> None:
    """Print and write what `compare` finds."""
    scenes = [name for name, entry in entries().items() if entry.fidelities == SCENE]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--points", type=int, default=64)
    parser.add_argument("--scenes", default=",".join(scenes))
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    found = []
    for name in given.scenes.split(","):
        found.append(compare(name, given.device, given.points))
        print(json.dumps(found[-1]), flush=True)
        if given.out:
            given.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
