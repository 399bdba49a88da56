"""A plan, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console, table

if TYPE_CHECKING:
    from ..jobs.plan import Plan


SHOWN_SECONDS = 0.5  # of compiling, from which it is worth a word


def show(found: Plan, console: Console) -> None:
    """Print a row for each environment, and the sum of them."""
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration

    rows = table("environment", "episodes", "with gradients", "time", "memory", "disk")
    for part in found.parts:
        name = " · ".join(filter(None, (part.env, part.fidelity, part.device)))
        memory = size(part.memory) + (f", {size(part.gpu_memory)} on the GPU" if part.gpu_memory else "")
        counts = (str(part.losses + part.gradients), str(part.gradients))
        rows.add_row(name, *counts, duration(part.seconds), memory, size(part.disk))
    console.print(rows)
    for part in found.parts:
        each = {"per loss": part.seconds_per_loss, "per gradient": part.seconds_per_gradient}
        each |= {"to compile": part.compiling if part.compiling > SHOWN_SECONDS else 0.0}
        said = ", ".join(f"{seconds:.3g} s {what}" for what, seconds in each.items() if seconds)
        console.print(f"{part.env}: {said}, {part.rate}")
    console.print(
        f"{found.episodes} episodes, {duration(found.seconds)} to compile and simulate, {size(found.disk)} on disk; "
        "the time of pictures and search methods is not included",
        soft_wrap=True,
    )
