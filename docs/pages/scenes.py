"""A page for each environment that is registered: what it says of itself, its picture, and what was measured."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from gradscape.envs.base import Environment
from gradscape.envs.registry import BUILTIN, EXTRAS, Entry, installs, make
from gradscape.landscapes.options import in_full
from gradscape.studies.kept import describe_margins

from .kept import NOT_MEASURED, Kept, KeptFigure
from .pictures import draw_function, draw_slice, shown
from .text import cell, contents, page, prose, table

PARTS = re.compile(r"(?:\A|(?<=\.\n))(?=(?:Model|Parameters|Loss|Gradients?|Simplifications|Targets|Source)\b)")
FEW = 32  # parameters that are listed one by one


def pages(kept: Kept, pictures: Path) -> dict[str, str]:
    """Return the pages of all environments of this package, and one that lists them; pictures are drawn beside."""
    rows = [(f"[`{one.name}`]({one.name}.md)", one.dim, cell(one.parameters), cell(one.model)) for one in BUILTIN]
    listed = page(
        "Scenes",
        "What each environment says of itself, and what was measured of it. [The environments](../../environments.md) "
        "shows some of them and says how they belong together.",
        table(("name", "dim", "parameters", "model"), rows),
        contents([one.name for one in BUILTIN], options=[":hidden:"]),
    )
    return {"scenes/index.md": listed, **{f"scenes/{one.name}.md": _page(one, kept, pictures) for one in BUILTIN}}


def _page(entry: Entry, kept: Kept, pictures: Path) -> str:
    if missing := installs(entry):
        needed = ", ".join(EXTRAS[entry.extra])
        return page(entry.name, prose(f"{entry.model}. It needs {needed}: {missing}."))
    env = make(entry.name, device="cpu")
    return page(
        entry.name,
        _picture(entry, kept, pictures),
        *_about(env),
        "## Parameters",
        _parameters(env),
        "## Settings",
        *_settings(env),
        "## What was measured",
        *_measured(entry, kept),
        "## Commands",
        _commands(entry, kept),
    )


def _about(env: Environment) -> Iterator[str]:
    """Yield the paragraphs of what a scene says of itself, with what each is about in bold; what is said twice once."""
    for block in dict.fromkeys(env.about().split("\n\n")):
        for part in PARTS.split(block):
            yield re.sub(r"^(\w+)", r"**\1**", prose(part)) if PARTS.match(part) else prose(part)


def _picture(entry: Entry, kept: Kept, pictures: Path) -> str:
    """Show the first of its figures that there is, or, of a function, its first two parameters."""
    there = [one for one in kept.by_env.get(entry.name, ()) if one.slice is not None]
    if there:
        alt = f"Losses and gradients of {entry.name} over {' and '.join(there[0].slice.plane.labels)}"
        return shown(draw_slice(there[0], pictures), alt, "../")
    if str(entry.target).startswith("gradscape.envs.functions:"):
        return shown(draw_function(entry.name, pictures), f"Values and gradients of {entry.name}", "../")
    return ""


def _parameters(env: Environment) -> str:
    space = env.space
    bounds = zip(space.names, space.lower.tolist(), space.upper.tolist(), space.units, strict=True)
    rows = [(str(at), cell(name), f"{low:g}", f"{high:g}", cell(unit)) for at, (name, low, high, unit) in
            enumerate(bounds)]  # fmt: skip
    rest = f"\n\nand so on, {space.dim} in all." if space.dim > FEW else ""
    return table(("no.", "parameter", "lower", "upper", "unit"), rows[:FEW]) + rest


def _settings(env: Environment) -> Iterator[str]:
    """Yield fidelities, engines, examples, options, and how far the step is from what is stable."""
    settings = [one.record() for one in env.fidelities.values()]
    yield table([*settings[0]], [[f"{value:.4g}" if isinstance(value, float) else str(value) for value in one.values()]
                                 for one in settings])  # fmt: skip
    yield (
        f"Engines: {', '.join(f'`{name}`' for name in env.engines)}. Examples: "
        + (", ".join(f"`{name}`" for name in env.examples) or "none")
        + ". Unit of the loss: "
        + (prose(env.loss_unit) or "none")
        + "."
    )
    named, _, explained = in_full(env.Options).removeprefix("options:").strip("\n").partition("\n\n")
    options = [line.strip() for line in named.splitlines() if "=" in line]
    yield "Options: none." if not options else "Options:\n\n" + "\n".join(f"- `{one}`" for one in options)
    yield prose(explained)
    if any(one.dt for one in env.fidelities.values()):
        yield "\n".join(f"- {prose(line)}" for line in describe_margins(env))


def _measured(entry: Entry, kept: Kept) -> Iterator[str]:
    """Yield what the paper says, a row for each of its figures, and why its words are its words."""
    figures = kept.by_env.get(entry.name, ())
    if said := kept.paper.words.get(entry.name):
        yield f"The paper says: {prose(str(said))}."
    if not any(one.report for one in figures):
        yield f"Its landscape is {NOT_MEASURED}: `landscape report {entry.name}` measures it."
        return
    yield table(("slice", "parameters", "measured", "of this version"), [_row(one, kept) for one in figures])
    for one in (one for one in figures if one.report):
        yield f"{kept.link(one.figure, '../../')}:\n\n" + "\n".join(
            f"- {prose(line)}" for line in one.report.verdict_lines()
        )


def _row(one: KeptFigure, kept: Kept) -> tuple[str, ...]:
    labels = ", ".join(one.slice.plane.labels) if one.slice else ", ".join(map(str, one.figure.dims))
    words = ", ".join(one.report.words) if one.report else NOT_MEASURED
    return kept.link(one.figure, "../../"), cell(labels), words, "yes" if one.current else "no"


def _commands(entry: Entry, kept: Kept) -> str:
    figures = kept.by_env.get(entry.name, ())
    first = [one.figure.command("auto") for one in figures] or [f"landscape slice {entry.name} --dims 0 1"]
    lines = [*first, f"landscape report {entry.name}", f"landscape check {entry.name}"]
    return "```console\n" + "\n".join(f"$ {line}" for line in dict.fromkeys(lines)) + "\n```"
