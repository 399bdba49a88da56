"""What a ladder of `landscape tradeoff` is asked for, in one record, and the words of its cells."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...jobs.scene import SceneSpec

if TYPE_CHECKING:
    from ...landscapes.measures.fidelity import Bootstrap, Comparison


@dataclass(frozen=True)
class Study:
    """Say what to measure of which scene, where to keep it, and how to tell it.

    `variants` are settings that the ladder `fidelity` changes; the others take none. `prints` are widths of pages [mm],
    `json` prints the record on standard output, `command` is how it is made again. `limits` are those of a search that
    were given, which the ladder `mixed` takes.
    """

    scene: SceneSpec
    points: int
    seed: int
    variants: Sequence[str]
    out: Path | None
    prints: Sequence[float]
    json: bool
    force: bool
    command: str
    limits: Mapping[str, Any] = field(default_factory=dict)


def say_missing(rows: Iterable[tuple[str, Comparison]]) -> str:
    """Say which variants lack gradients where the reference has them, and at what share; nothing where none does."""
    lacking = [f"{name} at {found.missing:.0%}" for name, found in rows if found.missing]
    return f"no gradient, of the points that have a loss: {', '.join(lacking)}" if lacking else ""


def percent(value: float | None) -> str:
    """Return a share in per cent, without the sign."""
    return "?" if value is None else f"{100 * value:.2g}"


def share(found: Bootstrap) -> str:
    """Return a share in per cent, with its interval."""
    if found.value is None:
        return "not finite"
    return f"{percent(found.value)}% ({percent(found.low)}-{percent(found.high)})"


def number(found: Bootstrap) -> str:
    """Return a number with three digits, nothing where there is none."""
    return "" if found.value is None else f"{found.value:z.3f}"
