"""A page for each verb of the command, of what `--help` says of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer

from gradscape.cli import app

from .text import cell, code, contents, page, prose, table


def pages() -> dict[str, str]:
    """Return the pages of all verbs, and one that lists them, in the order of the command's own help."""
    found = list(verbs())
    rows = [(f"[`landscape {name}`]({_file(name)})", cell(first_paragraph(verb.help))) for name, verb in found]
    listed = page(
        "The command",
        "Each page has what `landscape VERB --help` prints. [The verbs](../../verbs.md) says what they are for.",
        table(("verb", "what it does"), rows),
        contents([_file(name) for name, _ in found], options=[":hidden:"]),
    )
    return {"commands/index.md": listed, **{f"commands/{_file(name)}": _page(name, verb) for name, verb in found}}


def verbs() -> Iterator[tuple[str, Any]]:
    """Yield each verb by what is typed after `landscape`, those of groups with the group's name."""
    yield from _verbs(typer.main.get_command(app), ())


def first_paragraph(text: str) -> str:
    """Return the first paragraph of a help text in one line."""
    return " ".join(text.split("\n\n")[0].split())


def _verbs(group: Any, names: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _verbs(command, (*names, name))
        else:
            yield " ".join((*names, name)), command


def _file(name: str) -> str:
    return f"{name.replace(' ', '-')}.md"


def _page(name: str, verb: Any) -> str:
    context = typer.Context(verb, info_name=f"landscape {name}")
    records = [(param, param.get_help_record(context)) for param in verb.params if not param.hidden]
    arguments = [record for param, record in records if param.param_type_name == "argument"]
    options = [record for param, record in records if param.param_type_name == "option"]
    about, _, example = verb.help.rpartition("Example: ")
    return page(
        f"landscape {name}",
        _block(verb.get_usage(context).removeprefix("Usage: ")),
        prose(about),
        f"For example:\n\n{_block(example)}",
        _section("Arguments", arguments),
        _section("Options", options),
    )


def _block(command: str) -> str:
    return f"```console\n$ {' '.join(command.split())}\n```"


def _section(title: str, records: list[tuple[str, str]]) -> str:
    rows = [(f"`{code(said)}`", cell(re.sub(r"(?<=\S) {2,}(?=\[)", " ", text))) for said, text in records]
    return f"## {title}\n\n{table(('', 'what it says'), rows)}" if rows else ""
