"""`landscape bench`: episodes per second, and what they are spent on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from ..jobs.scene import SceneSpec
from .arguments import Json, refuse_words, takes_scene

if TYPE_CHECKING:
    from rich.table import Table

    from ..jobs.bench import BatchRate, Bench
    from ..jobs.kernel_times import KernelTable
    from ..jobs.roofline import Roof
    from .terminal import Console


@takes_scene("tolerance")
def bench(
    scene: SceneSpec,
    against: Annotated[str | None, typer.Option(help="A second engine, timed in turn with the first.")] = None,
    batch: Annotated[
        list[int] | None,
        typer.Option(
            min=1,
            help="Batch size in episodes. It may be repeated; the default is 1 and the preferred batch of "
            "the environment.",
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="Approximate time to spend on each batch size [s].")] = 10.0,
    roofline: Annotated[
        bool,
        typer.Option(help="Compare each kernel with the measured memory bandwidth and arithmetic peak of the device."),
    ] = False,
    json_: Json = False,
) -> None:
    """Measure episodes per second, with and without gradients, and where the time goes.

    Rates are the best of alternating repetitions. With --against the engines alternate too, so that ratios come from
    one run. It writes no file.

    Example: landscape bench fluid --against taichi
    """
    if against is not None:
        refuse_words(replace(scene, engine=against))
    from ..jobs.bench import BenchJob
    from .terminal import Bars, Console, command_line, print_json

    how = {"against": against, "batches": sorted(set(batch or [])), "seconds": seconds, "roofline": roofline}
    job = BenchJob.of(scene, **how)
    found = job.run(Bars())
    if json_:
        print_json(found.record(), command=command_line())
    else:
        show(found, Console())


def show(found: Bench, console: Console) -> None:
    """Print what was measured as compact tables."""
    console.print(_subject(found), highlight=False)
    console.print(_rates(found.rates))
    for rate in found.rates:
        if rate.ratio_forward is not None:
            ratios = f"{rate.ratio_forward:.2f} forward, {rate.ratio_with_gradient:.2f} with gradient"
            console.print(f"batch {rate.batch}, {rate.engine} : {found.against} = {ratios}", highlight=False)
        if rate.failed:
            console.print(f"batch {rate.batch}, {rate.engine}: {rate.failed} episodes failed", highlight=False)
    if found.kernels and found.kernels["forward"].kernels:
        console.print(_kernels(*found.kernels.values()))
        if found.roof is not None:
            console.print(_roofline(found.kernels["with_gradient"], found.roof))
            console.print(_against(found.kernels["with_gradient"], found.roof), highlight=False)
    if one := found.adapter:
        console.print(
            f"a batch of {one.batch}: {one.forward:.1%} of the time is not the engine's own program, "
            f"{one.with_gradient:.1%} with gradient",
            highlight=False,
        )
    said = f"sampling {found.sampler.points} points: {found.sampler.share:.1%} of the time is the sampler's own"
    console.print(said, highlight=False)


def _subject(found: Bench) -> str:
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration

    work, memory = found.work, found.memory
    unit = work.unit + "s" * (work.count != 1)
    lines = [
        f"{found.env} · {found.fidelity} · {found.device} ({found.hardware}) · {found.engine}",
        f"an episode: {work.count:,} {unit}, about {size(memory.estimated)}"
        + (f"; {size(memory.measured)} of the GPU" if memory.measured is not None else ""),
    ]
    for engine, start in found.start.items():
        modules = {None: "", 0: ", kernels from the cache"}.get(
            start.compiled, f", {start.compiled} modules of kernels compiled"
        )
        lines.append(f"{engine} was ready in {duration(start.seconds)}{modules}")
    return "\n".join(lines)


def _rates(rates: Sequence[BatchRate]) -> Table:
    from .terminal import table

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
    from .terminal import table

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


def _roofline(sloped: KernelTable, roof: Roof) -> Table:
    """Return what kernels had to move and to calculate as a table, slowest first, and what that is of the roof."""
    from .terminal import table

    shown = table("kernel, with gradient", "GB/s", "Gflop/s", "of the roof", "limit")
    for row in sloped.kernels:
        moved, flops, of_roof = row.bytes or 0, row.flops or 0.0, row.of_roof or 0.0
        memory = moved / roof.bytes_per_second >= flops / roof.flops_per_second
        rates = [f"{amount / row.seconds / 1e9:,.3g}" for amount in (moved, flops)]
        shown.add_row(row.name, *rates, f"{of_roof:.1%}", "memory" if memory else "flops")
    return shown


def _against(sloped: KernelTable, roof: Roof) -> str:
    """Return in a line what the roof is, and what share of their time all kernels would take there."""
    spent = sum(row.seconds for row in sloped.kernels)
    least = sum(row.seconds * (row.of_roof or 0.0) for row in sloped.kernels)
    return (
        f"the roof, measured: {roof.bytes_per_second / 1e9:,.3g} GB/s, {roof.flops_per_second / 1e9:,.3g} Gflop/s; "
        f"at it all kernels would take {least / spent:.1%} of their time"
    )


def _format_time(seconds: float, share: float) -> tuple[str, str]:
    return f"{1e3 * seconds:,.1f} ms", f"{share:.1%}"
