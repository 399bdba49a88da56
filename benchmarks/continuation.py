"""Race `continuation` against the nine methods of the league, at equal episodes and at equal forward equivalents.

    python -m benchmarks.continuation bounce@standard flip rastrigin [--budget 1000] [--seeds 10] [--order zeroth]

In a scene of the league the nine methods use their stored runs, truncated to the budget, and only continuation searches
here; a gradient has the same cost. Elsewhere all ten search here. Each scene prints two rows of the table in
docs/races.md.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from gradscape.envs.adapters import from_torch
from gradscape.envs.base import Environment
from gradscape.gallery.files import DATA, LeagueFiles
from gradscape.gallery.league import METHODS, KeptRun, KeptRuns
from gradscape.jobs.scene import SceneSpec
from gradscape.jobs.search import make_optimizer, run_identity
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.threads import one_torch_thread
from gradscape.optim.methods.continuation import ORDERS
from gradscape.optim.race import Competitor, race
from gradscape.optim.runs.store import RunStore
from gradscape.optim.statistics import EqualCost, seen_from

OURS, PLAIN = "continuation", "l-bfgs-b"
GRADIENT_COST = 2.0  # of a function, whose episodes take no time worth measuring
Losses = dict[str, NDArray[np.float64]]  # method -> the least loss of each seed


def _rastrigin(x: torch.Tensor) -> torch.Tensor:
    return (x**2 - 10 * torch.cos(2 * math.pi * x) + 10).sum(dim=1)


def _salomon(x: torch.Tensor) -> torch.Tensor:
    radius = (x.square().sum(dim=1) + 1e-24).sqrt()
    return 1 - torch.cos(2 * math.pi * radius) + radius / 10


def _schwefel(x: torch.Tensor) -> torch.Tensor:
    return 418.9829 * x.shape[1] - (x * torch.sin((x.abs() + 1e-12).sqrt())).sum(dim=1)


FUNCTIONS = {  # formula, half a side of the box, parameters, whether the minimum is moved out of the middle
    "rastrigin": (_rastrigin, 5.12, 10, True),
    "salomon": (_salomon, 100.0, 10, True),
    "schwefel": (_schwefel, 500.0, 5, False),
}


def function(name: str) -> Environment:
    """Return a rugged function whose minimum is not in the middle of its box."""
    formula, side, dim, moved = FUNCTIONS[name]
    shift = (
        (torch.rand(dim, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5) * 1.2 * side * moved
    )
    space = ParameterSpace.box([f"x{number}" for number in range(dim)], -side, side)
    return from_torch(lambda x: formula(x - shift), space, name=name)


def runs(env: Environment, methods: tuple[str, ...], budget: int, seeds: int, cost: float, order: str) -> list[KeptRun]:
    """Return the stored part of runs of methods that search here."""
    competitors = []
    for method in methods:
        for seed in range(seeds):
            options = {"order": order} if method == OURS else {}
            make = partial(make_optimizer, method, env, seed=seed, options=options)
            store = RunStore.in_memory(env.space, identity=run_identity(env, make()), budget=budget)
            competitors.append(Competitor(method, seed, store, make))
    with one_torch_thread():
        race(env, competitors, budget=budget, gradient_cost=cost)
    return [KeptRun.of(one.run.read(), budget) for one in competitors]


def least(found: list[KeptRun], seeds: int, *, episodes: float, forwards: float) -> Losses:
    """Return the lowest losses within a number of episodes and a cost."""
    losses: dict[str, list[float]] = {}
    for run in found:
        if run.seed < seeds:
            within = run.loss[(run.episode <= episodes) & (run.forwards <= forwards)]
            losses.setdefault(run.method, []).append(float(within[-1]) if len(within) else math.nan)
    return {method: np.array(values) for method, values in losses.items()}


def row(losses: Mapping[str, NDArray[np.float64]]) -> list[str]:
    """Compare continuation with L-BFGS-B and all others by lowest losses."""
    found = EqualCost.within(math.nan, list(losses), np.stack(list(losses.values())))
    ranks, pairs = {one.method: one for one in found.ranks}, {one.second: one for one in seen_from(OURS, found.pairs)}
    ahead = [name for name, one in pairs.items() if one.better == OURS]
    behind = [name for name, one in pairs.items() if one.better not in (OURS, None)]
    mine, plain = ranks[OURS], pairs[PLAIN]
    best = found.ranks[0] if found.ranks[0].method != OURS else found.ranks[1]
    return [
        f"{mine.rank:.1f} ({mine.low:.1f} to {mine.high:.1f})",
        f"`{best.method}` {best.rank:.1f}",
        f"{np.median(losses[OURS]):.2g} / {np.median(losses[PLAIN]):.2g}",
        f"{plain.probability:.0%} (p = {plain.corrected:.2g})",
        str(len(ahead)),
        ", ".join(f"`{name}`" for name in behind) or "none",
    ]


def main() -> None:
    """Print two rows for each scene and function that is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--budget", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--order", choices=ORDERS, default=ORDERS[0])
    given = parser.parse_args()
    budget, seeds = given.budget, given.seeds
    for scene in given.scenes:
        name, _, fidelity = scene.partition("@")
        files = LeagueFiles.of(DATA, name)
        if files.runs.exists():
            kept = list(KeptRuns.read(files.runs).runs)
            cost = next(run.spent / run.episodes for run in kept if run.method == PLAIN)
            env = SceneSpec(name, fidelity or "draft", device="cpu").make()
            found = [*kept, *runs(env, (OURS,), budget, seeds, cost, given.order)]
        else:
            env = function(name) if name in FUNCTIONS else SceneSpec(name, fidelity or None, device="cpu").make()
            found = runs(env, (*METHODS, OURS), budget, seeds, GRADIENT_COST, given.order)
        for what, forwards in (("episodes", math.inf), ("forward equivalents", budget)):
            cells = row(least(found, seeds, episodes=budget, forwards=forwards))
            print("|", " | ".join([f"`{name}`", f"{budget} {what}", *cells]), "|", flush=True)


if __name__ == "__main__":
    main()
