"""Environments, methods, versions and devices, on the terminal."""

from __future__ import annotations

import re
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from .terminal import Console, Table, table

if TYPE_CHECKING:
    from ..api.info import Info
    from ..envs.base import Environment
    from ..envs.registry import Entry
    from ..optim.base import Optimizer
    from ..optim.registry import Method


def show_entries(found: list[Entry], console: Console) -> None:
    """Print every registered environment as a row of a table.

    An environment whose engine is not installed is grey, and a line below says how to install it.
    """
    from ..envs.registry import installs

    shown = table("name", "dim", "parameters", "model", "fidelities", title="environments")
    shown.columns[0].no_wrap = True  # what one types
    for entry in found:
        style = "dim" if installs(entry) else None
        shown.add_row(entry.name, entry.dim, entry.parameters, entry.model, ", ".join(entry.fidelities), style=style)
    console.print(shown)
    for line in sorted({installs(entry) for entry in found} - {""}):
        names = ", ".join(entry.name for entry in found if installs(entry) == line)
        console.print(f"not installed: {names}; {line}", soft_wrap=True)
    console.print("`landscape envs NAME` describes one in full: its model, bounds, options, examples and fidelities.")


def show_environment(env: Environment, console: Console) -> None:
    """Print all there is to know about one environment."""
    from ..envs.base import describe_settings
    from ..gallery.paper import read_paper
    from ..landscapes.options import in_full
    from ..landscapes.space import LOG10
    from ..studies.kept import describe_margins

    about = env.about() or "No description: its class has no docstring."
    console.print(f"{env.name}: {env.space.dim} parameter{'s' if env.space.dim > 1 else ''}\n")
    console.print(f"{_flowing(about)}\n")
    bounded = table("no.", "parameter", "lower", "upper", "unit")
    space = env.space
    lower, upper = (space.to_values(end).tolist() for end in (space.lower, space.upper))
    rows = zip(space.names, space.scales, lower, upper, space.units, strict=True)
    for number, (one, scale, low, high, unit) in enumerate(rows):
        label = f"{one} (logarithmic)" if scale == LOG10 else one
        bounded.add_row(str(number), label, f"{low:g}", f"{high:g}", unit)
    console.print(bounded)
    console.print(_fidelities(env))
    console.print(f"engines: {', '.join(env.engines)}")
    for said in describe_margins(env) if any(one.dt for one in env.fidelities.values()) else ():
        console.print(said)
    console.print(_flowing(in_full(env.Options)))
    console.print(f"examples: {', '.join(env.examples) or 'none'}")
    presets = (f"{name} ({describe_settings(options)})" for name, options in env.presets.items())
    console.print(f"presets: {', '.join(presets) or 'none'}")
    if words := read_paper().words.get(env.name):
        console.print(f"the paper says: {words}")


def _fidelities(env: Environment) -> Table:
    """Return the fidelities of an environment, a column each."""
    records = {one.name: one.record() for one in env.fidelities.values()}
    names = list(dict.fromkeys(setting for record in records.values() for setting in record if setting != "name"))
    shown = table("fidelity", *records)
    for name in names:
        label = "step dt [s]" if name == "dt" else name
        shown.add_row(label, *(_setting(record.get(name, "")) for record in records.values()))
    return shown


def _setting(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _flowing(text: str) -> str:
    """Return a docstring whose paragraphs are a line each, to be wrapped where the terminal ends.

    A paragraph begins after an empty line, where a line is indented, and where one begins with a word and a colon.
    """
    found: list[str] = []
    for line in text.splitlines():
        apart = not line or line.startswith(" ") or bool(re.match(r"[A-Z][a-z ]*:", line))
        if found and found[-1] and not apart and not found[-1].startswith(" "):
            found[-1] = f"{found[-1]} {line}"
        else:
            found.append(line)
    return "\n".join(found)


def describe_environment(env: Environment) -> dict[str, Any]:
    """Return an environment as plain JSON: its parameters with bounds, and what it can be simulated with."""
    space = env.space
    lower, upper = (space.to_values(end).tolist() for end in (space.lower, space.upper))
    columns = (space.names, space.scales, lower, upper, space.units)
    return {
        "name": env.name,
        "about": env.about(),
        "parameters": [
            dict(zip(("name", "scale", "lower", "upper", "unit"), row, strict=True))
            for row in zip(*columns, strict=True)
        ],
        "fidelities": [fidelity.record() for fidelity in env.fidelities.values()],
        "engines": list(env.engines),
        "options": asdict(env.options),
        "presets": {name: dict(options) for name, options in env.presets.items()},
        "examples": list(env.examples),
    }


def describe_method(kind: type[Optimizer]) -> dict[str, Any]:
    """Return a method as plain JSON: what it does, and its options with their defaults."""
    from ..optim.registry import find_method

    about = {"name": kind.name, "summary": find_method(kind.name).summary, "gradients": kind.needs_grad}
    return {**about, "options": asdict(kind.Options())}


def show_methods(found: list[Method], console: Console) -> None:
    """Print every method as a row of a table."""
    shown = table("name", "what it does", "needs", title="methods")
    for method in found:
        shown.add_row(method.name, method.summary, f"extra {method.extra}" if method.extra else "")
    console.print(shown)
    console.print("`landscape methods NAME` describes one in full: what it does, its options and their defaults.")


def show_method(kind: type[Optimizer], console: Console) -> None:
    """Print all there is to know about one method."""
    import inspect

    from ..landscapes.options import in_full
    from ..optim.options import defaults
    from ..optim.registry import find_method

    texts = [find_method(kind.name).summary, inspect.getdoc(kind) or ""]
    texts += [f"gradients: {'yes' if kind.needs_grad else 'no'}", in_full(kind.Options)]
    if sources := defaults(kind.Options):
        texts.append("sources of defaults: " + ", ".join(f"{one.option} {one.source}" for one in sources))
    console.print(_flowing(f"{kind.name}: " + "\n\n".join(texts)))


def show_info(found: Info, console: Console) -> None:
    """Print versions and devices as a table."""
    shown = table("what", "version or name", title=f"gradscape {found.gradscape}")
    shown.add_row("python", found.python)
    for package, version in found.packages.items():
        shown.add_row(package, version)
    shown.add_row("cpu", f"{found.cores} cores for this process")
    for name in found.gpus or ("none found",):
        shown.add_row("cuda", name)
    console.print(shown)
