"""A page for each verb of the command, from its `--help`."""

from __future__ import annotations

from gradscape.cli import Verb, verbs

from .text import render


def pages() -> dict[str, str]:
    """Return a page for each verb, and one that lists them in the order of the command's help."""
    files = {f"{name.replace(' ', '-')}.md": verb for name, verb in verbs().items()}
    listed = {"commands/index.md": render("commands.md", files=files)}
    return listed | {f"commands/{file}": _page(verb) for file, verb in files.items()}


def _page(verb: Verb) -> str:
    about, _, example = verb.help().partition("\n\nParameters\n")[0].partition("\n\nExample: ")
    options = verb.options
    arguments = [one for one in options if not one.names[0].startswith("-")]
    typed = [one.names[0] if one.required else f"[{one.names[0]}]" for one in arguments]
    typed += [
        f"{one.names[0]} {one.names[0].strip('-').upper()}" for one in options if one.required and one not in arguments
    ]
    sections = {"Arguments": arguments, "Options": [one for one in options if one not in arguments]}
    return render("command.md", verb=verb, about=about, example=example, typed=typed, sections=sections)
