"""A measurement of speed, on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from .terminal import Console, Table, table

if TYPE_CHECKING:
    from ..jobs.bench import BatchRate, Bench, KernelTable


def show(found: Bench, console: Console) -> None:
    """Print what was measured as compact tables."""
    console.print(_subject(found))
    console.print(_rates(found.rates))
    for rate in found.rates:
        if rate.ratio_forward is not None:
            ratios = f"{rate.ratio_forward:.2f} forward, {rate.ratio_with_gradient:.2f} with gradient"
            console.print(f"batch {rate.batch}, speed of {rate.engine} relative to {found.against}: {ratios}")
        if rate.failed:
            console.print(f"batch {rate.batch}, {rate.engine}: {rate.failed} episodes failed")
    if found.kernels and found.kernels["forward"].kernels:
        console.print(_kernels(*found.kernels.values()))
    if one := found.adapter:
        console.print(
            f"a batch of {one.batch}: {one.forward:.1%} of the time is spent outside the engine's own program, "
            f"{one.with_gradient:.1%} with gradient",
        )
    said = f"sampling {found.sampler.points} points: the sampler itself takes {found.sampler.share:.1%} of the time"
    console.print(said)


def _subject(found: Bench) -> str:
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration

    work, memory = found.work, found.memory
    unit = work.unit + "s" * (work.count != 1)
    lines = [
        f"{found.env} · {found.fidelity} · {found.device} ({found.hardware}) · {found.engine}",
        f"points: {'the same' if found.same_points else 'different'} in each repetition",
        f"an episode: {work.count:,} {unit}, about {size(memory.estimated)}"
        + (f"; {size(memory.measured)} on the GPU" if memory.measured is not None else ""),
    ]
    for engine, start in found.start.items():
        modules = {None: "", 0: ", kernels from the cache"}.get(
            start.compiled, f", {start.compiled} kernel modules compiled"
        )
        lines.append(f"{engine} was ready in {duration(start.seconds)}{modules}")
    return "\n".join(lines)


def _rates(rates: Sequence[BatchRate]) -> Table:
    found = table("batch", "engine", "episodes/s", "with gradient", "work/s", "with gradient", "gradient / forward")
    for rate in rates:
        ways = (rate.forward, rate.with_gradient)
        cells = [str(rate.batch), rate.engine]
        cells += [f"{way.episodes_per_second:.3g}" for way in ways]
        cells += [f"{way.work_per_second:.3g}" for way in ways]
        found.add_row(*cells, f"{rate.gradient_costs:.2f}")
    return found


def _kernels(forward: KernelTable, sloped: KernelTable) -> Table:
    """Return the kernels as a table, slowest with gradient first, and what is spent outside them."""
    shown = table(f"kernel, batch {forward.batch}", "forward", "", "with gradient", "")
    found = [{row.name: row for row in way.kernels} for way in (forward, sloped)]
    for name in dict.fromkeys([*found[1], *found[0]]):
        cells = [_format_time(rows[name].seconds, rows[name].share) if name in rows else ("", "") for rows in found]
        shown.add_row(name, *cells[0], *cells[1])
    shown.add_section()
    rest = [way.seconds - sum(row.seconds for row in way.kernels) for way in (forward, sloped)]
    cells = [_format_time(left, left / way.seconds) for left, way in zip(rest, (forward, sloped), strict=True)]
    shown.add_row("outside kernels", *cells[0], *cells[1])
    return shown


def _format_time(seconds: float, share: float) -> tuple[str, str]:
    return f"{1e3 * seconds:,.1f} ms", f"{share:.1%}"
