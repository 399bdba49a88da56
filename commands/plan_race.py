"""`landscape plan ENV --methods ...`: what a race takes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from ..jobs.scene import SceneSpec

if TYPE_CHECKING:
    from ..jobs.plan_race import RaceForecast

SEEDS, BUDGET = 10, 1000  # those of `landscape race`


def print_race_plan(
    scene: SceneSpec,
    methods: Sequence[str],
    options: Sequence[str],
    seeds: int | None,
    budget: int | None,
    workers: int | None,
    *,
    began: float,
    cut: bool,
    as_json: bool,
) -> None:
    """Plan a race and print it. Raises ValueError where no methods are named, and for what is said of a slice."""
    from ..jobs.methods import check_methods
    from .arguments import read_names
    from .race import read_method_options
    from .terminal import Bars, command_line, print_json

    if not (names := read_names(methods)):
        raise ValueError("--seeds, --budget and --option are of a race; name its methods with --methods, or all")
    if cut:
        raise ValueError(
            "a race has no plane; leave out --dims, --along, --over, --resolution, --through, --extent, --gradients, "
            "--no-gradients"
        )
    if str(scene.name).endswith(".toml"):
        raise ValueError(f"a race is of one environment; got the list of figures {scene.name} and --methods")
    given = read_method_options(options, check_methods(names))
    from ..envs.engines.runtime import cores
    from ..jobs.plan_race import RacePlanJob

    job = RacePlanJob(scene, names, seeds or SEEDS, budget or BUDGET, workers or cores(), given)
    found = job.run(Bars(), began=began)
    if as_json:
        print_json(found.record(), command=command_line())
    else:
        _print(found)


def _print(found: RaceForecast) -> None:
    from ..optim.race import name_seeds
    from .terminal import Console, table

    console = Console(soft_wrap=True, highlight=False)
    console.print(
        f"{found.env} · {found.fidelity} · {found.device} · {found.budget} episodes · {name_seeds(found.seeds)} of "
        f"{', '.join(found.plan.own)}"
    )
    rows = table("what", "how much", "", show_header=False)
    for name, amount, note in _rows(found):
        rows.add_row(name, amount, note)
    console.print(rows)
    rate = found.plan.rate
    console.print(f"{rate.forward:.3g} s an episode, {rate.gradient:.3g} s with gradient, {rate.said}")


def _rows(found: RaceForecast) -> Iterator[tuple[str, str, str]]:
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration

    plan, load = found.plan, found.plan.load
    yield "episodes", str(plan.episodes), f"{load.gradient} with gradient, in {load.batches} batches"
    parts = {"start": plan.start, "simulating": plan.simulating, "methods": plan.searching}
    yield "time", duration(plan.wall), ", ".join(f"{name} {duration(seconds)}" for name, seconds in parts.items())
    dear = sorted(plan.own.items(), key=lambda pair: -pair[1].wall)
    yield "methods", f"{plan.share:.0%}", ", ".join(f"{name} {duration(one.wall)}" for name, one in dear)
    yield "devices", f"{plan.simulating / 3600:.3g} h", "of simulating"
    gpu = f", {size(plan.gpu)} of the device" if plan.gpu else ""
    yield "memory", size(plan.memory), f"with {found.workers} processes that compute Gaussian processes{gpu}"
    yield "disk", size(plan.disk), ""
