"""The next command for each kind of result, which a verb prints last."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any


def next_command(kind: str, result: Any, given: Sequence[Any], folder: Path | None) -> str:
    """Return the command that a user would go on with after a result of a kind, empty where none is plain.

    `given` are the arguments of the verb, `folder` is where its results are.
    """
    subject = str(given[0]) if given and isinstance(given[0], str | Path) else ""
    words = NEXT[kind](result, subject, str(folder or "")) if kind in NEXT else []
    return shlex.join(["landscape", *words]) if words and all(words) else ""


def _after_check(found: Any, subject: str, folder: str) -> list[str]:
    """Go on to a slice; a check that fails says itself what to try."""
    return ["slice", subject] if found.passed else []


def _after_report(found: Any, subject: str, folder: str) -> list[str]:
    """Look for a remedy where gradients do not follow, else for the method that gets anywhere."""
    from ..landscapes.measures.following import FOLLOW, WORD_OF

    if Path(subject).exists():  # a slice, whose simulator the command may not find
        return []
    return ["race" if WORD_OF[FOLLOW] in found.words else "remedy", subject]


NEXT: dict[str, Callable[[Any, str, str], list[str]]] = {
    "Slice": lambda found, subject, folder: ["report", folder, "--html"],
    "Run": lambda found, subject, folder: ["overlay", "SLICE", folder],
    "Race": lambda found, subject, folder: ["report", subject, "--html", "--include", folder],
    "Census": lambda found, subject, folder: ["race", subject],
    "RemedyStudy": lambda found, subject, folder: ["race", subject],
    "CheckReport": _after_check,
    "Report": _after_report,
}
