"""What every verb says of itself: a sentence, an example that names it, and a word on each argument and option."""

from __future__ import annotations

from typing import Any

import pytest
import typer

from gradscape.cli import app


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
    assert f"Example: landscape {name}" in " ".join(text.split())


@pytest.mark.parametrize("name", VERBS)
def test_every_argument_and_option_is_explained(name: str) -> None:
    unsaid = [param.name for param in VERBS[name].params if not param.hidden and not (param.help or "").strip()]
    assert unsaid == []
