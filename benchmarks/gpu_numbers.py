"""Hold a checkout against an older one on a GPU, where their last digits differ.

    git worktree add OLD COMMIT
    python -m benchmarks.gpu_numbers OLD --out GPU.json [--scene fluid] [--device cuda:1]    # on a machine with a GPU
    python -m benchmarks.same_numbers OLD --gpu GPU.json --write                             # anywhere

A compiler fuses other multiplications with additions once code is written otherwise, and sums may get another order:
both give other last digits, which a scene with contacts multiplies. So no bit can be asked for. What can be asked for:
that the new losses and gradients are no farther from what the old code computes in float64 than its own in float32 are.
A scene is evaluated at draft and standard, by the old checkout in both precisions and by the new one in float32, each
time judged by the target that float32 has; the distance of two is taken for each point, relative to the batch's largest
loss or to the point's gradient. The same numbers are those whose median and mean distances are at most FACTOR times the
old ones: medians of eight points differ by two by chance.

Without a GPU, `--device cpu` runs what a GPU would, sums by columns of cells among it, compiled for a CPU.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

FACTOR = 3.0
LEAST = 1e-7  # a distance below which all are the same
POINTS = {"draft": 32, "standard": 8}


def main() -> None:
    """Compare two checkouts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, help="the older checkout")
    parser.add_argument("--scene", action="append", help="by default every scene of soft bodies")
    parser.add_argument("--out", type=Path, default=Path("gpu.json"), help="what to write")
    parser.add_argument("--device", default="cuda", help="the GPU, or cpu")
    parser.add_argument("--measure", type=Path, help="only measure the checkout that is imported, into this folder")
    parser.add_argument("--precision", action="append", help="in which it is measured then")
    asked = parser.parse_args()
    if asked.measure:
        print(json.dumps(measure(asked.scene, asked.measure, asked.precision, asked.device)))
        return
    from benchmarks.same_numbers import ask

    scenes = asked.scene or soft_scenes()
    with tempfile.TemporaryDirectory() as folder:
        codes = {}
        for which, root, precisions in (
            ("old", asked.old.resolve(), ("float32", "float64")),
            ("new", Path.cwd(), ("float32",)),
        ):
            how = [str(Path(folder) / which), "--device", asked.device]
            how += [part for precision in precisions for part in ("--precision", precision)]
            codes[which] = ask(root, scenes, script=Path(__file__), measure=how)
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
    """Say whether new results are no farther from the exact ones than the old results are, by `compare`."""
    return all(new <= max(LEAST, FACTOR * old) for new, old in distances.values())


def soft_scenes() -> list[str]:
    """Return the scenes that MLS-MPM simulates."""
    from gradscape.envs.registry import entries, environment_class

    return [name for name in entries() if ".envs.mpm." in environment_class(name).__module__]


def measure(scenes: Sequence[str], folder: Path, precisions: Sequence[str], device: str) -> dict[str, str]:
    """Write the losses and gradients of scenes in some precisions, and return which code computed them."""
    from gradscape.envs import code
    from gradscape.envs.engines.mpm import solver
    from gradscape.envs.registry import environment_class, make

    folder.mkdir(parents=True)
    codes = {}
    if device == "cpu":
        solver.Solver = partial(solver.Solver, columns=True)  # type: ignore[misc, assignment]
    for scene in scenes:
        kind = environment_class(scene)
        codes[scene] = code.own_digest(kind, kind.engines[0])
        for name, count in POINTS.items():
            target = None
            for precision in precisions:
                fidelity = replace(kind.fidelities[name], precision=precision)
                env = make(scene, fidelity=fidelity, device=device)
                target = judge_by(env, target)
                result = env.evaluate(env.space.sobol(count, seed=0))
                assert result.grad is not None
                arrays = {"loss": result.loss.detach().cpu().numpy(), "grad": result.grad.detach().cpu().numpy()}
                np.savez(folder / f"{scene}-{name}-{precision}.npz", **arrays)
                del env
    return codes


def judge_by(env: Any, target: Any) -> Any:
    """Judge a scene by a target, if there is one, and return what it is judged by: float32's own is a demonstration's.

    That of float64 differs by the errors of float32, and a loss in float32 would be as far away as its target is.
    """
    if not hasattr(type(env), "_target"):
        return None
    if target is not None:
        mass = target.mass.to(env._target.mass)
        vars(env)["_target"] = replace(target, mass=mass)
    return env._target


def compare(scene: str, folder: Path) -> dict[str, tuple[float, float]]:
    """Return the distances of a scene's new and old results in float32 from the old ones in float64."""
    distances = {}
    for fidelity in POINTS:
        exact = np.load(folder / "old" / f"{scene}-{fidelity}-float64.npz")
        new, old = (np.load(folder / which / f"{scene}-{fidelity}-float32.npz") for which in ("new", "old"))
        for what in ("loss", "grad"):
            for how in (np.median, np.mean):
                off = tuple(float(how(distance(one[what], exact[what]))) for one in (new, old))
                distances[f"{fidelity} {what} {how.__name__}"] = off
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
