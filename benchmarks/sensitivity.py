"""How much a method's options matter: a race of one method against itself, one option changed at a time.

    python -m benchmarks.sensitivity ENV ... [--method bo-leap] [--vary sigma=0.25,0.5,2 --vary step=0.1,10 ...]
        [--budget 1000] [--seeds 10] [--fidelity draft] [--workers 2] [--out out/sensitivity]

All settings and seeds go on in lockstep. Of each scene it prints the mean of the best loss with each setting, its 95 %
interval over seeds, and whether it differs from that of the defaults: the interval of the difference of seeds' losses
excludes zero. ENV.json in the folder --out has the best loss of every seed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from gradscape.envs.base import Environment
from gradscape.envs.registry import make
from gradscape.jobs.search import make_optimizer
from gradscape.landscapes.storage.records import write_record
from gradscape.landscapes.threads import one_torch_thread
from gradscape.optim.bootstrap import interval
from gradscape.optim.comparison import difference
from gradscape.optim.race import Competitor, race
from gradscape.optim.runs.store import RunStore

VARIED = ("sigma=0.125,0.25,0.5,2", "step=0.01,0.1,10", "population=6,20,40")
DEFAULTS = "defaults"


def settings_of(varied: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the options of each setting by its name, the defaults first; raises ValueError for other texts."""
    found: dict[str, dict[str, str]] = {DEFAULTS: {}}
    for text in varied:
        name, equals, values = text.partition("=")
        if not name or not equals or not values:
            raise ValueError(f"--vary takes NAME=VALUE,VALUE; got {text!r}")
        found |= {f"{name}={value}": {name: value} for value in values.split(",")}
    return found


def best_losses(
    env: Environment, method: str, settings: dict[str, dict[str, str]], budget: int, seeds: int, workers: int
) -> dict[str, list[float]]:
    """Return the best loss of every seed with each setting, NaN where none succeeded."""
    identity = {"objective": env.name, "method": method}
    field = [
        Competitor(
            name,
            seed,
            RunStore.in_memory(env.space, identity=identity | {"seed": seed}, budget=budget),
            partial(make_optimizer, method, env, seed=seed, options=options),
        )
        for seed in range(seeds)
        for name, options in settings.items()
    ]
    with one_torch_thread():
        race(env, field, budget=budget, workers=workers)
    return {name: [one.run.best_loss for one in field if one.method == name] for name in settings}


def show(env: Environment, found: dict[str, list[float]]) -> None:
    """Print a row for each setting."""
    unit = f" [{env.loss_unit}]" if env.loss_unit else ""
    table = Table(
        "setting", f"best loss{unit}", "median", "against the defaults", title=f"{env.name} · {env.fidelity.name}"
    )
    usual = np.array(found[DEFAULTS])
    for name, losses in found.items():
        low, high = interval(np.array(losses))
        apart = difference(name, np.array(losses), DEFAULTS, usual)
        said = "" if name == DEFAULTS or apart.better is None else "better" if apart.better == name else "worse"
        table.add_row(name, f"{np.mean(losses):.3g} [{low:.3g}, {high:.3g}]", f"{np.median(losses):.3g}", said)
    Console().print(table)


def main(arguments: Sequence[str] | None = None) -> int:
    """Race, print and keep what was found of each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", nargs="+")
    parser.add_argument("--method", default="bo-leap")
    parser.add_argument(
        "--vary", action="append", metavar="NAME=VALUE,VALUE", help="by default what BO-Leap leaves open"
    )
    parser.add_argument("--budget", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--fidelity", default="draft")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/sensitivity"))
    asked = parser.parse_args(arguments)
    settings = settings_of(asked.vary or VARIED)
    for name in asked.env:
        env = make(name, fidelity=asked.fidelity, device=asked.device)
        found = best_losses(env, asked.method, settings, asked.budget, asked.seeds, asked.workers)
        record: dict[str, Any] = {**vars(asked), "out": str(asked.out), "env": name, "best": found}
        asked.out.mkdir(parents=True, exist_ok=True)
        write_record(asked.out / f"{name}.json", record)
        show(env, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
