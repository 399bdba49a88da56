"""Measure how BO-Leap's results depend on its options, one option at a time, and write the table of docs/races.md.

    python -m benchmarks.bo_leap [SCENE ...] [--seeds 10] [--budget 1000] [--check]

In each scene named (by default none) its defaults race other values of one option each, and random search, all with the
same seeds, at standard; results are kept in benchmarks/data/bo_leap-SCENE.json. Then the table is written of all that
are kept: the mean of the best losses over seeds, and how often a run with the option ends below one with the defaults,
with the p of the rank test against the defaults, corrected by Holm's rule for all other values in that scene. With
--check nothing is written: exit code 1 says that the page differs from what is kept.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import gradscape as gs
from gradscape.jobs.report_tables import markdown
from gradscape.optim.comparison import LEVEL, holm, rank_test, win_probability
from gradscape.optim.race import Competitor, race
from gradscape.optim.registry import optimizer_class
from gradscape.optim.runs.store import RunStore

from .pages import DOCS, settle

DATA, PAGE, NAME = Path(__file__).parent / "data", DOCS / "races.md", "bo-leap"
DEFAULTS, RANDOM = "defaults", "random search"
VARIANTS: dict[str, dict[str, Any]] = {
    DEFAULTS: {},
    "sigma 0.3": {"sigma": 0.3},
    "sigma 0.1": {"sigma": 0.1},
    "population 5, best 2": {"population": 5, "best": 2},
    "population 20, best 10": {"population": 20, "best": 10},
    "population 40, best 20": {"population": 40, "best": 20},
    "step 0.1": {"step": 0.1},
    "step 10": {"step": 10.0},
    "max_step 0.05": {"max_step": 0.05},
    "max_step 0.5": {"max_step": 0.5},
}


def measure(scene: str, seeds: int, budget: int) -> dict[str, Any]:
    """Return the best loss of each run, by variant."""
    env = gs.make(scene, fidelity="standard", device="cpu")
    competitors = [_competitor(env, name, seed, budget) for name in (*VARIANTS, RANDOM) for seed in range(seeds)]
    race(env, competitors, budget=budget, workers=2)
    best: dict[str, list[float]] = {}
    for one in competitors:
        best.setdefault(one.method, []).append(float(one.run.best_loss))
    about = {"scene": scene, "fidelity": "standard", "seeds": seeds, "budget": budget, "unit": env.loss_unit}
    return {**about, "model_version": env.version_on(env.engine), "best": best}


def _competitor(env: gs.Environment, name: str, seed: int, budget: int) -> Competitor:
    kind = optimizer_class("random" if name == RANDOM else "bo-leap")
    options = kind.Options(**VARIANTS.get(name, {}))
    identity = {"objective": env.name, "method": kind.name, "seed": seed, "options": VARIANTS.get(name, {})}
    run = RunStore.in_memory(env.space, identity=identity, budget=budget)
    return Competitor(name, seed, run, partial(kind.on, env, seed=seed, options=options))


def rows(records: Sequence[dict[str, Any]]) -> Iterator[list[str]]:
    """Return a row for each variant: of each scene its mean best loss, and how it stands to the defaults."""
    standings = [_standings(record) for record in records]
    for name in (*VARIANTS, RANDOM):
        yield [name, *(one[name] for one in standings)]


def _standings(record: dict[str, Any]) -> dict[str, str]:
    best = {name: np.array(losses) for name, losses in record["best"].items()}
    others = [name for name in best if name != DEFAULTS]
    ps = dict(zip(others, holm([rank_test(best[name], best[DEFAULTS]) for name in others]), strict=True))
    found = {DEFAULTS: f"{best[DEFAULTS].mean():.3g}"}
    for name in others:
        chance = win_probability(best[name], best[DEFAULTS])
        sign = ", undecided" if ps[name] >= LEVEL else f", p = {ps[name]:.1g}"
        found[name] = f"{best[name].mean():.3g} ({100 * chance:.0f} %{sign})"
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the scenes asked for, and write the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--budget", type=int, default=1000)
    parser.add_argument("--check", action="store_true", help="write nothing, say what is not so")
    asked = parser.parse_args(arguments)
    for scene in asked.scenes:
        record = measure(scene, asked.seeds, asked.budget)
        (DATA / f"bo_leap-{scene}.json").write_text(json.dumps(record, indent=1) + "\n")
    records = [json.loads(file.read_text()) for file in sorted(DATA.glob("bo_leap-*.json"))]
    head = ["BO-Leap with", *(f"`{one['scene']}` [{one['unit']}]" for one in records)]
    return settle(markdown(head, list(rows(records))), PAGE, NAME, [], check=asked.check, fine=f"{len(records)} scenes")


if __name__ == "__main__":
    raise SystemExit(main())
