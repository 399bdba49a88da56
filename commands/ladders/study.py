"""What a ladder of `landscape tradeoff` is asked for, in one record, and the words of its cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ...jobs.scene import SceneSpec

if TYPE_CHECKING:
    from ...landscapes.measures.fidelity import Bootstrap


@dataclass(frozen=True)
class Study:
    """Say what to measure of which scene, where to keep it, and how to tell it.

    `variants` are settings that the ladder `fidelity` changes; the others take none. `prints` are widths of pages [mm],
    `json` prints the record on standard output, `command` is how it is made again.
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
