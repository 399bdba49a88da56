"""Hold a checkout against an older one on a GPU, whose sums came in another order every time.

    git worktree add OLD COMMIT
    python -m benchmarks.gpu_numbers OLD --out GPU.json [--scene fluid]       # on a machine with a GPU
    python -m benchmarks.same_numbers OLD --gpu GPU.json --write              # anywhere

A GPU that adds up atomically gives other last digits each time, which a scene with contacts multiplies. So where its
sums get another order, no bit can be asked for. What can be asked for: that the new losses and gradients are no farther
from the old ones than the old ones are from themselves. A scene is evaluated three times by the old checkout and once
by the new one, at draft and standard; the distance of two is taken for each point, relative to the batch's largest loss
or to the point's gradient. The same numbers are those whose median and mean distance, between new and old, are at most
FACTOR times those among the old: of one new result and three old ones, medians of eight points differ by two by chance.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

FACTOR, REPEATS = 3.0, 3
LEAST = 1e-7  # a distance below which all are the same
POINTS = {"draft": 32, "standard": 8}


def main() -> None:
    """Compare two checkouts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, help="the older checkout")
    parser.add_argument("--scene", action="append", help="by default every scene of soft bodies")
    parser.add_argument("--out", type=Path, default=Path("gpu.json"), help="what to write")
    parser.add_argument("--measure", type=Path, help="only measure the checkout that is imported, into this folder")
    asked = parser.parse_args()
    if asked.measure:
        print(json.dumps(measure(asked.scene, asked.measure)))
        return
    from benchmarks.same_numbers import ask

    scenes = asked.scene or soft_scenes()
    with tempfile.TemporaryDirectory() as folder:
        roots = {"old": asked.old.resolve(), "new": Path.cwd()}
        codes = {
            which: ask(root, scenes, script=Path(__file__), measure=[str(Path(folder) / which)])
            for which, root in roots.items()
        }
        found = {
            scene: {"old": codes["old"][scene], "new": code, "distances": compare(scene, Path(folder))}
            for scene, code in codes["new"].items()
        }
    asked.out.write_text(json.dumps(found, indent=1) + "\n")
    same = {scene: is_same(one["distances"]) for scene, one in found.items()}
    for scene, one in found.items():
        print(f"{scene}: {'the same' if same[scene] else 'differs'}, {one['distances']}", flush=True)
    sys.exit(int(not all(same.values())))


def is_same(distances: Mapping[str, Sequence[float]]) -> bool:
    """Say whether new results are no farther from old ones than these are from each other, by `compare`."""
    return all(off <= max(LEAST, FACTOR * apart) for off, apart in distances.values())


def soft_scenes() -> list[str]:
    """Return the scenes that MLS-MPM simulates."""
    from gradscape.envs.registry import entries, environment_class

    return [name for name in entries() if ".envs.mpm." in environment_class(name).__module__]


def measure(scenes: Sequence[str], folder: Path) -> dict[str, str]:
    """Write the losses and gradients of scenes, REPEATS times, and return which code computed them."""
    from gradscape.envs import code
    from gradscape.envs.registry import environment_class, make

    folder.mkdir(parents=True)
    codes = {}
    for scene in scenes:
        kind = environment_class(scene)
        codes[scene] = code.own_digest(kind, kind.engines[0])
        for fidelity, count in POINTS.items():
            env = make(scene, fidelity=fidelity, device="cuda")
            x = env.space.sobol(count, seed=0)
            results = [env.evaluate(x) for _ in range(REPEATS)]
            arrays = {f"loss{i}": one.loss.detach().cpu().numpy() for i, one in enumerate(results)}
            grads = [one.grad.detach().cpu().numpy() for one in results if one.grad is not None]
            arrays |= {f"grad{i}": grad for i, grad in enumerate(grads)}
            np.savez(folder / f"{scene}-{fidelity}.npz", **arrays)
            del env
    return codes


def compare(scene: str, folder: Path) -> dict[str, tuple[float, float]]:
    """Return a scene's distances, of new results from old ones and among the old."""
    distances = {}
    for fidelity in POINTS:
        old, new = (np.load(folder / which / f"{scene}-{fidelity}.npz") for which in ("old", "new"))
        for what in ("loss", "grad"):
            theirs = [old[f"{what}{i}"] for i in range(REPEATS)]
            apart = np.concatenate([distance(a, b) for a, b in combinations(theirs, 2)])
            off = np.concatenate([distance(new[f"{what}0"], one) for one in theirs])
            for how in (np.median, np.mean):
                distances[f"{fidelity} {what} {how.__name__}"] = float(how(off)), float(how(apart))
    return distances


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how far two results of the same points are apart, relative, shape (point,); 0 for failed ones."""
    if a.ndim == 1:
        apart = np.abs(a - b) / np.nanmax(np.abs(b))
    else:
        apart = np.linalg.norm(a - b, axis=1) / np.maximum(np.linalg.norm(b, axis=1), np.finfo(float).tiny)
    return np.where(np.isfinite(apart), apart, 0.0)


if __name__ == "__main__":
    main()
