"""How the plasticine scenes behave: draft against standard, demonstrations, failures, memory, cost per core.

    python benchmarks/plasticine.py [--device cuda] [--points 64] [--scenes writer,rope]

Prints one line per scene and writes them to --out as JSON. On two cores take fewer points (a standard episode costs
about ten seconds of one core); on a GPU all of it takes some minutes.
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

from gradscape.envs.plasticine import DEMONSTRATION
from gradscape.envs.registry import make
from gradscape.landscapes.objective import Status

SCENES = "assembly,pinch,rolling-pin,rope,table,torus,triple-move,writer"


def compare(name: str, device: str, count: int) -> dict[str, Any]:
    """Return what one scene's draft and standard say of the same points."""
    draft, standard = (make(name, fidelity=fidelity, device=device) for fidelity in ("draft", "standard"))
    sobol = torch.quasirandom.SobolEngine(draft.space.dim, scramble=True, seed=0)
    points = draft.space.from_unit(sobol.draw(count, dtype=torch.float64))
    known = torch.stack([draft.example(DEMONSTRATION), torch.zeros_like(points[0])])
    ours, theirs = draft.evaluate(points), standard.evaluate(points)
    ok = (ours.status == Status.OK) & (theirs.status == Status.OK)
    return {
        "scene": name,
        "spearman": float(spearmanr(ours.loss[ok], theirs.loss[ok]).statistic),
        "cosine": float(torch.cosine_similarity(ours.grad[ok], theirs.grad[ok]).median()),
        "failed": {"draft": int((ours.status != Status.OK).sum()), "standard": int((theirs.status != Status.OK).sum())},
        "steepest": {"draft": steepest(ours.grad), "standard": steepest(theirs.grad)},
        "range": [float(theirs.loss[ok].min()), float(theirs.loss[ok].max())],
        "demonstration and zero": {
            env.fidelity.name: env.evaluate(known, grad=False).loss.tolist() for env in (draft, standard)
        },
        "megabytes": {env.fidelity.name: env.memory() / 1e6 for env in (draft, standard)},
        "seconds per core, draft": seconds(draft, points[:8]) if device == "cpu" else None,
        "M particle-substeps per s, standard": rate(standard, points),
    }


def steepest(grad: Tensor) -> float:
    """Return the length of the longest gradient."""
    return float(grad.norm(dim=1).nan_to_num(torch.inf).max())


def seconds(env: Any, points: Tensor) -> float:
    """Return the core seconds of one episode with its gradient."""
    env.evaluate(points[:2])
    start = time.process_time()
    env.evaluate(points)
    return (time.process_time() - start) / len(points)


def rate(env: Any, points: Tensor) -> float:
    """Return how fast a batch is simulated and differentiated."""
    start = time.perf_counter()
    env.evaluate(points)
    work = len(points) * env.model.particles * env.model.steps * env.model.substeps
    return work / (time.perf_counter() - start) / 1e6


def main() -> None:
    """Print and write what `compare` finds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--points", type=int, default=64)
    parser.add_argument("--scenes", default=SCENES)
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
