"""A plan, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console, table

if TYPE_CHECKING:
    from ..jobs.plan import Plan


def show(found: Plan, console: Console) -> None:
    """Print a row for each environment, and the sum of them."""
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration

    rows = table("environment", "losses", "gradients", "s a loss", "s a gradient", "simulating", "memory", "disk")
    for part in found.parts:
        each = (f"{seconds:.3g}" if seconds else "" for seconds in (part.seconds_per_loss, part.seconds_per_gradient))
        name = " · ".join(filter(None, (part.env, part.fidelity, part.device)))
        memory = size(part.memory) + (f", {size(part.gpu_memory)} of the GPU" if part.gpu_memory else "")
        counts = (str(part.losses), str(part.gradients))
        rows.add_row(name, *counts, *each, duration(part.seconds), memory, size(part.disk))
    console.print(rows)
    console.print(
        f"{found.episodes} episodes, {duration(found.seconds)} of simulation, {size(found.disk)} on disk; "
        f"rates {'; '.join(dict.fromkeys(part.rate for part in found.parts))}",
        soft_wrap=True,
    )
