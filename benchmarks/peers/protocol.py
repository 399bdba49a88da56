"""What every peer does alike: take a scene, be timed and checked, and print one JSON object. Only NumPy is needed."""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .scenes import CHAIN, CUBE, Array, Chain, Cube

STEPS = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4)  # of central differences, about as large for every parameter
DIRECTIONS = 4
SCENES = {CUBE: Cube, CHAIN: Chain}


@dataclass(frozen=True)
class Simulation:
    """What a peer offers: a `loss` of parameters, and its `gradient` by a run forward and backward.

    Both take parameters of float64 and return when the device has finished. `gradient` is None where the peer has none,
    and `why` says why not. `differs` are sentences on what is not as in the scene.
    """

    version: str
    material: str
    grid: str
    loss: Callable[[Array], float]
    gradient: Callable[[Array], Array] | None
    differs: tuple[str, ...] = ()
    why: str | None = None
    precision: str = "float32"


@dataclass(frozen=True)
class Check:
    """How far a gradient is from central differences: `error`, relative, over directions, at the best `step`."""

    error: float
    step: float


def gradient_error(loss: Callable[[Array], float], gradient: Array, at: Array) -> Check:
    """Return how far a gradient is from central differences along a few random directions, at the best of the steps.

    The error is |slopes - differences| / |differences|, both vectors having one number for each direction.
    """
    lines = np.random.default_rng(0).standard_normal((DIRECTIONS, at.size))
    slopes, found = lines @ gradient, []
    for step in STEPS:
        differences = np.array([(loss(at + step * line) - loss(at - step * line)) / (2 * step) for line in lines])
        error = np.linalg.norm(slopes - differences) / max(float(np.linalg.norm(differences)), 1e-300)
        found.append(Check(float(error), step))
    return min(found, key=lambda one: one.error if np.isfinite(one.error) else np.inf)


def time_calls(call: Callable[[], object], repeat: int) -> float:
    """Return the least seconds of some calls."""
    seconds = []
    for _ in range(repeat):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return min(seconds)


class Memory:
    """Say how much memory was taken at most: on a CPU by this process, on CUDA of the device since this began."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.before = self._used() if device == "cuda" else 0

    def read(self) -> int:
        """Return it in bytes."""
        if self.device == "cuda":
            return self._used() - self.before
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

    def _used(self) -> int:
        first = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")[0] or "0"
        asked = ["nvidia-smi", f"--id={first}", "--query-gpu=memory.used", "--format=csv,noheader,nounits"]
        return int(subprocess.run(asked, capture_output=True, text=True, check=True).stdout) << 20


def measure(simulation: Simulation, scene: Cube | Chain, repeat: int, memory: Memory) -> dict[str, Any]:
    """Time a simulation forward and with gradient, check its gradient, and return all of it as plain JSON."""
    at = scene.start
    value = simulation.loss(at)  # warms up too
    found: dict[str, Any] = {
        key: getattr(simulation, key) for key in ("version", "precision", "material", "grid", "why", "differs")
    }
    found |= {"particles": scene.particles, "substeps": scene.substeps, "work": scene.work, "loss": value}
    found["forward"] = time_calls(lambda: simulation.loss(at), repeat)
    found["memory_forward"] = memory.read()
    found |= {"gradient": None, "memory_gradient": None, "check": None}
    if (gradient := simulation.gradient) is not None:
        slope = gradient(at)
        found["gradient"] = time_calls(lambda: gradient(at), repeat)
        found["memory_gradient"] = memory.read()
        found["check"] = asdict(gradient_error(simulation.loss, slope, at))
    return found


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what the driver is asked for and hands on to peers."""
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--particles", type=int, default=1000, help="n^3 of a cube, or how many chains")
    parser.add_argument("--substeps", type=int, default=64)
    parser.add_argument("--repeat", type=int, default=3, help="calls of which the best is taken, in each round")


def run(kind: str, build: Callable[[Any, argparse.Namespace], Simulation]) -> None:
    """Measure the simulation that `build` makes of a scene, and print what was found; or what went wrong."""
    parser = argparse.ArgumentParser(description="Measure one simulator; the last line is a JSON object.")
    add_options(parser)
    parser.add_argument("--source", default=None, help="a file of the peer's that is not in a package")
    asked = parser.parse_args()
    try:
        scene = SCENES[kind](asked.particles, asked.substeps)
        memory = Memory(asked.device)
        found = measure(build(scene, asked), scene, asked.repeat, memory)
    except Exception as error:
        traceback.print_exc()
        found = {"failed": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
    sys.stdout.flush()
    print("\n" + json.dumps({"device": asked.device, **found}), flush=True)
