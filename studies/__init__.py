"""Studies: the same points in several variants of a scene, each compared with a reference."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .variants import Study, StudyRecord

KINDS = ("fidelity", "convergence", "model", "mixed", "extremes", "symmetry", "updates")


def study_class(kind: str) -> type[Study]:
    """Return the class of a kind of study. Raises ValueError for an unknown kind."""
    return _find(kind, "Study")  # type: ignore[no-any-return]


def record_class(kind: str) -> type[StudyRecord]:
    """Return the class of the record of a kind of study. Raises ValueError for an unknown kind."""
    return _find(kind, "Record")  # type: ignore[no-any-return]


def _find(kind: str, what: str) -> Any:
    if kind not in KINDS:
        raise ValueError(f"study takes {', '.join(KINDS)}; got {kind!r}")
    return getattr(import_module(f".{kind}", __name__), kind.capitalize() + what)
