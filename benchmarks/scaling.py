"""How the cost of the fluid scene grows with particles, substeps and grid points.

    python benchmarks/scaling.py [--device cuda] [--batch 8] [--out docs/scaling.png]

Prints the fitted exponents, 1 being linear, and draws what they were fitted to. Particles and grid points are varied
alone, and timed by one launch of every kernel that runs over them, forward and backward; substeps by whole episodes.
Grid points begin with those of standard: nodes at the ladle's surface cost more than others, and grow with the power
2/3, which on smaller grids shows.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from gradscape.envs.base import Environment, Fidelity
from gradscape.envs.engines.profiling import time_kernels
from gradscape.envs.mpm.fluid import SPAN
from gradscape.envs.registry import make
from gradscape.landscapes.objective import Status

ON_GRID = ("velocity_", "cell_kernels.place_segments")
UNIT = {"substeps": "episode"}
SERIES: dict[str, list[Fidelity]] = {
    "particles": [Fidelity("", SPAN / 8, resolution=16, sampling=1.25 * 2 ** (k / 3)) for k in range(5)],
    "substeps": [Fidelity("", SPAN / n, resolution=12, sampling=1.4) for n in (4, 8, 16, 32)],
    "grid points": [Fidelity("", SPAN / 32, resolution=n, sampling=16 / n) for n in (32, 40, 50, 63)],
}


def measured(what: str, fidelity: Fidelity, device: str, batch: int) -> tuple[float, float]:
    """Return size and cost of an environment, which is gone afterwards: on a GPU it takes what memory there is."""
    env = make("fluid", fidelity=fidelity, device=device)
    spent = cost(what, env, batch)
    return size(what, env), spent


def size(what: str, env: Environment) -> float:
    """Return how much of `what` an episode has: grid points are those in grids, which on a GPU particles touch."""
    model = env.model  # type: ignore[attr-defined]
    if what == "grid points":
        with env._solvers.lend() as stage:  # type: ignore[union-attr]
            return float(np.mean([stage.solver.room(step).nodes for step in range(model.steps)]))
    return {"particles": model.particles, "substeps": model.steps * model.substeps}[what]


def cost(what: str, env: Environment, batch: int) -> float:
    """Return the seconds of an episode, or of one launch of each kernel, that depend on it: the best of three."""
    rows = min(batch, env.preferred_batch)
    x = env.space.uniform(rows, seed=0)
    if (env.evaluate(x).status != Status.OK).any():
        raise ValueError(f"episodes of {env.fidelity} fail, so that their cost says nothing")
    return min(once(what, env, lambda: env.evaluate(x)) for _ in range(3)) / rows


def once(what: str, env: Environment, work: Callable[[], object]) -> float:
    """Return the seconds of one repetition."""
    start = time.perf_counter()
    if what == "substeps":
        work()
        return time.perf_counter() - start
    with time_kernels(env.device) as times:
        work()
    return sum(t.seconds / t.calls for name, t in times.items() if name.startswith(ON_GRID) == (what == "grid points"))


def draw(found: dict[str, tuple[list[float], list[float], float]], path: Path) -> None:
    """Draw cost over size, one panel each."""
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    for ax, (what, (sizes, costs, exponent)) in zip(figure.subplots(1, len(found)), found.items(), strict=True):
        ax.loglog(sizes, costs, "o", color="#3b528b")
        line = costs[0] * np.divide(sizes, sizes[0])
        ax.loglog(sizes, line, "-", color="0.6", zorder=0, label="linear")
        ax.set(xlabel=what, ylabel=f"seconds per {UNIT.get(what, 'substep')}", title=f"exponent {exponent:.2f}")
        ax.legend(frameon=False)
        ax.set_xticks(sizes, [f"{one:,.0f}" for one in sizes], rotation=30)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_minor_formatter(NullFormatter())
    figure.savefig(path, dpi=150)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    found = {}
    for what, fidelities in SERIES.items():
        pairs = [measured(what, fidelity, given.device, given.batch) for fidelity in fidelities]
        sizes, costs = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        exponent = float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])
        found[what] = sizes, costs, exponent
        print(f"{what}: {', '.join(f'{s:.0f}: {c:.3g} s' for s, c in zip(sizes, costs, strict=True))}; {exponent:.2f}")
    if given.out:
        draw(found, given.out)


if __name__ == "__main__":
    main()
