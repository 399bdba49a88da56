"""A page for each registered environment: its description, its picture, and its measurements."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from gradscape.envs.base import Environment, describe_settings
from gradscape.envs.registry import BUILTIN, EXTRAS, Entry, installs, make
from gradscape.landscapes.options import in_full
from gradscape.studies.kept import describe_margins

from .kept import Kept
from .pictures import draw_function, draw_slice
from .text import prose, render

PARTS = re.compile(r"(?:\A|(?<=\.\n))(?=(?:Model|Parameters|Loss|Gradients?|Simplifications|Targets|Source)\b)")
FEW = 32  # parameters that are listed one by one


def pages(kept: Kept, pictures: Path) -> dict[str, str]:
    """Return a page for each environment of this package and one that lists them; draw pictures into a folder."""
    listed = {"scenes/index.md": render("scenes.md", scenes=BUILTIN)}
    return listed | {f"scenes/{one.name}.md": _page(one, kept, pictures) for one in BUILTIN}


def _page(entry: Entry, kept: Kept, pictures: Path) -> str:
    if missing := installs(entry):
        return render("scene.md", entry=entry, missing=missing, needed=EXTRAS[entry.extra])
    env = make(entry.name, device="cpu")
    figures = kept.by_env.get(entry.name, ())
    there = [one for one in figures if one.slice is not None]
    if there:
        picture, alt = draw_slice(there[0], pictures), f"Losses and gradients of {entry.name} over {there[0].axes}"
    elif str(entry.target).startswith("gradscape.envs.functions:"):
        picture, alt = draw_function(entry.name, pictures), f"Values and gradients of {entry.name}"
    else:
        picture, alt = {}, ""
    named, _, explained = in_full(env.Options).removeprefix("options:").strip("\n").partition("\n\n")
    space = env.space
    return render(
        "scene.md", entry=entry, env=env, kept=kept, missing="", figures=figures, picture=picture, alt=alt, few=FEW,
        about=_about(env),
        parameters=list(zip(space.names, space.lower.tolist(), space.upper.tolist(), space.units, strict=True)),
        options=[line.strip() for line in named.splitlines() if "=" in line], explained=explained,
        margins=describe_margins(env) if any(one.dt for one in env.fidelities.values()) else (),
        paper=kept.paper.words.get(entry.name), settings_of=describe_settings,
    )  # fmt: skip


def _about(env: Environment) -> Iterator[str]:
    """Yield the paragraphs of a scene's description, each once and with its subject in bold."""
    for block in dict.fromkeys(env.about().split("\n\n")):
        for part in PARTS.split(block):
            yield re.sub(r"^(\w+)", r"**\1**", prose(part)) if PARTS.match(part) else prose(part)
