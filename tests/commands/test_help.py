"""What every verb says of itself: a sentence, an example that names it, and a word on each argument and option."""

from __future__ import annotations

import re
from typing import Any

import pytest
import typer

from gradscape.cli import app, main


def verbs() -> dict[str, Any]:
    """Return every verb of the command by its name."""
    top = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    found = {name: command for name, command in top.items() if name != "gallery"}
    return found | {f"gallery {name}": command for name, command in top["gallery"].commands.items()}


VERBS = verbs()


@pytest.mark.parametrize("name", VERBS)
def test_a_verb_has_a_sentence_and_an_example(name: str) -> None:
    text = str(VERBS[name].help)
    first = text.split("\n\n")[0].strip()
    assert first[0].isupper()
    assert first.endswith(".")
    assert len(first.split()) <= 25
    assert f"Example: landscape {name}" in " ".join(text.split())


def test_help_lists_every_verb_once_in_four_groups_with_its_whole_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert re.findall(r"^(\w+):$", text, re.MULTILINE) == ["Options", "Look", "Measure", "Search", "Publish"]
    top = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    listed = re.findall(r"^  (\w+) +([A-Z].+(?:\n {4,}.+)*)$", text.partition("Look:")[2], re.MULTILINE)
    assert len(listed) == len(top)
    assert {name: " ".join(said.split()) for name, said in listed} == {
        name: " ".join(verb.help.partition("\n\n")[0].split()) for name, verb in top.items()
    }


@pytest.mark.parametrize("name", VERBS)
def test_every_argument_and_option_is_explained_in_sentences(name: str) -> None:
    said = {param.name: str(param.help) for param in VERBS[name].params if not param.hidden}
    assert {one: text for one, text in said.items() if not re.match(r"[A-Z][^;]*(;[^;]*)?\.$", text, re.DOTALL)} == {}
