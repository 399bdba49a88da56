"""Say of which scenes this checkout computes the same numbers as an older one, to the last bit, and keep that.

    git worktree add OLD COMMIT
    python -m benchmarks.same_numbers OLD [--scene fluid] [--gpu GPU.json] [--write]

A change of an engine changes the digest of its scenes' code (`envs.code`), and every record of theirs then counts as of
other code. Where the change makes them quicker and nothing else, `--write` says so in `envs/same_numbers.json`, and the
records stay what they are. A scene's numbers are the same where

- losses, gradients and what failed are, bit for bit, at some points on a CPU: at draft in two batches, at standard one;
- what runs on CUDA is compiled to the same PTX, kernel by kernel, which needs no GPU, or
- `--gpu` says of both codes that what they compute on a GPU is the same but for last digits (`gpu_numbers`), or of
  other scenes' codes that are compiled to the same before and now wherever something has changed.

A scene that differs in either is left out, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ARCHITECTURE = 90  # of the GPU that is compiled for
POINTS = {"draft": 4, "standard": 1}
KEPT = Path(__file__).resolve().parent.parent / "envs" / "same_numbers.json"


def main() -> None:
    """Compare two checkouts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, help="the older checkout")
    parser.add_argument("--scene", action="append", help="by default every scene whose digest has changed")
    parser.add_argument("--gpu", type=Path, help="what benchmarks.gpu_numbers has found")
    parser.add_argument("--write", action="store_true", help="keep what is the same")
    parser.add_argument("--measure", action="store_true", help="only measure the checkout that is imported")
    asked = parser.parse_args()
    if asked.measure:
        print(json.dumps(measure(asked.scene or [])))
        return
    before, now = (ask(root, []) for root in (asked.old, Path.cwd()))
    changed = [name for name, one in now.items() if name in before and one["code"] != before[name]["code"]]
    scenes = asked.scene or changed
    gpu = json.loads(asked.gpu.read_text()) if asked.gpu else {}
    held: set[tuple[str, str | None, str]] = set()
    found = {
        scene: is_same(scene, asked.old, gpu.get(scene, {}), held)
        for scene in sorted(scenes, key=lambda s: s not in gpu)
    }
    same = [scene for scene in scenes if found[scene]]
    if asked.write:
        keep(changed, {name: (now[name]["code"], before[name]["known"]) for name in changed if name in same})
    sys.exit(int(same != scenes))


def is_same(scene: str, old: Path, gpu: dict[str, Any], held: set[tuple[str, str | None, str]]) -> bool:
    """Say whether both checkouts compute the same numbers, and print what was compared.

    `held` are modules and what they were and are compiled to where a GPU has shown that it computes the same: those of
    a scene of which `gpu` says so are added.
    """
    from benchmarks import gpu_numbers

    theirs, ours = (ask(root, [scene])[scene] for root in (old, Path.cwd()))
    compiled = {part: (part, theirs.get(part), ours[part]) for part in ours if part not in (*POINTS, "code", "known")}
    if (gpu.get("old"), gpu.get("new")) == (theirs["code"], ours["code"]) and gpu_numbers.is_same(gpu["distances"]):
        held |= set(compiled.values())
    excused = {part for part, change in compiled.items() if change in held}
    compared = [part for part in (*POINTS, *compiled) if part in ours and part not in excused]
    differ = [part for part in compared if ours[part] != theirs.get(part)]
    said = f"differs in {', '.join(differ)}" if differ else f"the same in {', '.join(compared)}"
    where = f"on a GPU but for last digits{'' if gpu else ', as other scenes are whose kernels change likewise'}"
    print(f"{scene}: {said}{f', and {where}' if excused else ''}", flush=True)
    return not differ


def ask(
    root: Path, scenes: Sequence[str], *, script: Path = Path(__file__), measure: Sequence[str] = ()
) -> dict[str, Any]:
    """Return what a script prints that measures scenes of a checkout, in a process of its own, which imports that.

    `measure` is what its option of this name takes.
    """
    command = [sys.executable, str(script), str(root), "--measure", *measure]
    for scene in scenes:
        command += ["--scene", scene]
    paths = os.pathsep.join(filter(None, [str(root.resolve() / "src"), os.environ.get("PYTHONPATH")]))
    where = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run(command, env=where, cwd=root, check=True, stdout=subprocess.PIPE, text=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def measure(scenes: list[str]) -> dict[str, dict[str, str]]:
    """Return digests of the code, the numbers and the compiled kernels of scenes; without any, of the code of all."""
    from gradscape.envs import code
    from gradscape.envs.registry import entries, environment_class

    found = {}
    for scene in scenes or entries():
        kind = environment_class(scene)
        own = getattr(code, "own_digest", code.code_digest)
        found[scene] = {"code": own(kind, kind.engines[0]), "known": code.code_digest(kind, kind.engines[0])}
        if scenes:
            found[scene] |= numbers(scene) | compiled(scene)
    return found


def numbers(scene: str) -> dict[str, str]:
    """Return a digest of what a scene computes on a CPU at some points, by fidelity."""
    from gradscape.envs.registry import environment_class, make

    found = {}
    for fidelity, count in POINTS.items():
        if fidelity in environment_class(scene).fidelities:
            env = make(scene, fidelity=fidelity, device="cpu")
            x = env.space.sobol(count, seed=0)
            batches = [x, x[:1]] if count > 1 else [x]
            results = [env.evaluate(batch) for batch in batches]
            tensors = [tensor for one in results for tensor in (one.loss, one.grad, one.status)]
            found[fidelity] = hash_of(tensor.detach().cpu().contiguous().numpy().tobytes() for tensor in tensors)
    return found


def compiled(scene: str) -> dict[str, str]:
    """Return a digest of what each module of a scene's kernels is compiled to for CUDA."""
    import warp as wp

    from gradscape.envs.engines.mpm.kernels import kernels
    from gradscape.envs.registry import make

    model = getattr(make(scene, fidelity="standard", device="cpu"), "model", None)
    if model is None:
        return {}
    try:
        launched = list(kernels(model, "cuda"))
    except TypeError:  # of a checkout in which all devices have the same
        launched = list(kernels(model))  # type: ignore[call-arg]
    modules = {kernel.module.name: kernel.module for kernel in launched}
    with tempfile.TemporaryDirectory() as folder:
        return {
            re.sub(r"_[0-9a-f]{8}$", "", name): hash_of(
                re.sub(rb"_[0-9a-f]{8}\b|_[0-9a-f]{8}(?=_)|//.*", b"", path.read_bytes())
                for path in wp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=folder, use_ptx=True)
                if path.suffix == ".ptx"
            )
            for name, module in modules.items()
        }


def hash_of(pieces: Iterable[bytes]) -> str:
    """Return a digest of bytes."""
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return digest.hexdigest()[:16]


def keep(changed: Iterable[str], same: dict[str, tuple[str, str]]) -> None:
    """Write down of scenes that have changed their code, and the oldest code that computes the same numbers."""
    kept = json.loads(KEPT.read_text())
    for scene in changed:
        kept.pop(scene, None)
    kept |= {scene: {"code": code, "numbers_of": known} for scene, (code, known) in same.items()}
    KEPT.write_text(json.dumps(dict(sorted(kept.items())), indent=1) + "\n")


if __name__ == "__main__":
    main()
