"""`landscape envs`: which environments there are, and all there is to know about one."""

from __future__ import annotations

from typing import Annotated

import typer


def envs(
    name: Annotated[str | None, typer.Argument(help="Name of the environment to describe in full.")] = None,
) -> None:
    """List the environments, or describe one in full.

    With NAME it shows what the environment models, its bounds, fidelities, engines, options and examples, and how
    close its time step is to the stability limit, if `landscape extremes` measured that. It writes no file.

    Example: landscape envs fluid
    """
    _describe(name) if name else _list()


def _list() -> None:
    """Print every registered environment as a row of a table; none of ours is imported for that.

    One whose engine is not installed is grey, and below is what installs it.
    """
    from ..envs.registry import complete_entry, entries, installs
    from .terminal import Console, table

    found = table("name", "dim", "parameters", "model", "fidelities", title="environments")
    for entry in map(complete_entry, entries().values()):
        style = "dim" if installs(entry) else None
        found.add_row(entry.name, entry.dim, entry.parameters, entry.model, ", ".join(entry.fidelities), style=style)
    console = Console()
    console.print(found)
    for line in sorted({installs(entry) for entry in entries().values()} - {""}):
        names = ", ".join(entry.name for entry in entries().values() if installs(entry) == line)
        console.print(f"not installed: {names}; {line}", markup=False, soft_wrap=True)
    console.print("`landscape envs NAME` shows one in full: bounds, options, examples, fidelities, what it models.")


def _describe(name: str) -> None:
    """Print all there is to know about one environment."""
    from ..envs.registry import make, refuse_unknown

    refuse_unknown(name)
    from ..gallery.paper import read_paper
    from ..jobs.margins import say_margins
    from ..landscapes.options import in_full
    from ..landscapes.space import LOG10
    from .terminal import Console, table

    env, console = make(name, device="cpu"), Console(soft_wrap=True, highlight=False)
    about = env.about() or "It says nothing of itself: its class has no docstring."
    console.print(f"{env.name}: {env.space.dim} parameter{'s' if env.space.dim > 1 else ''}\n\n{about}\n")
    bounded = table("no.", "parameter", "lower", "upper", "unit")
    space = env.space
    lower, upper = (space.to_values(end).tolist() for end in (space.lower, space.upper))
    rows = zip(space.names, space.scales, lower, upper, space.units, strict=True)
    for number, (one, scale, low, high, unit) in enumerate(rows):
        label = f"{one} (logarithmic)" if scale == LOG10 else one
        bounded.add_row(str(number), label, f"{low:g}", f"{high:g}", unit)
    console.print(bounded)
    for fidelity in env.fidelities.values():
        console.print(f"fidelity {fidelity.record()}")
    console.print(f"engines: {', '.join(env.engines)}")
    for said in say_margins(env) if any(one.dt for one in env.fidelities.values()) else ():
        console.print(said)
    console.print(in_full(env.Options))
    console.print(f"examples: {', '.join(env.examples) or 'none'}")
    if words := read_paper().words.get(env.name):
        console.print(f"the paper says: {words}")
