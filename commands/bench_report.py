"""What `landscape bench` does and prints: progress while it measures, then rates, kernels, memory."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

from rich.table import Table

from ..envs.registry import environment_class, make
from ..landscapes.capacity import size
from ..landscapes.cost import duration
from .arguments import read_settings
from .terminal import Console, table

if TYPE_CHECKING:
    from ..envs.base import Environment

WAYS = ("forward", "with_gradient")


def bench(
    name: str,
    *,
    fidelity: str | None,
    device: str,
    engine: str,
    deterministic: bool,
    against: str | None,
    batches: Sequence[int],
    seconds: float,
    settings: Sequence[str],
    as_json: bool,
) -> None:
    """Measure an environment and print what was found."""
    options = read_settings(settings)
    environment_class(name)  # a name that does not exist is refused before what measures is loaded
    from ..jobs.bench import bench as measure

    def made(engine: str) -> Environment:
        exact = deterministic and engine != against  # the other engine, Taichi, cannot
        return make(name, fidelity=fidelity, device=device, engine=engine, deterministic=exact, **options)

    console = Console(stderr=True, soft_wrap=True, highlight=False)
    announced = count()
    with console.status("preparing") as status:

        def follow(said: str) -> None:
            if said.startswith("timing") and next(announced) == 0:  # what cannot be measured has been refused by then
                console.print(f"{name}: each rate is timed for {duration(seconds)} or more, without and with gradients")
            status.update(said)

        found = measure(made, engine, against=against, batches=sorted(set(batches)), seconds=seconds, follow=follow)
    report = {**found, "command": shlex.join(["landscape", *sys.argv[1:]])}
    if as_json:
        print(json.dumps(report))
    else:
        show(report, Console())


def show(report: dict[str, Any], console: Console) -> None:
    """Print a report as compact tables."""
    console.print(_subject(report), markup=False, highlight=False)
    console.print(_rates(report))
    for row in report["rates"]:
        if "ratio_forward" in row:
            ratios = f"{row['ratio_forward']:.2f} forward, {row['ratio_with_gradient']:.2f} with gradient"
            console.print(f"batch {row['batch']}, {row['engine']} : {report['against']} = {ratios}", highlight=False)
        if row["failed"]:
            console.print(f"batch {row['batch']}, {row['engine']}: {row['failed']} episodes failed", highlight=False)
    if report["kernels"] and report["kernels"]["forward"]["kernels"]:
        console.print(_kernels(report["kernels"]))
    sampler = report["sampler"]
    said = f"sampling {sampler['points']} points: {sampler['share']:.1%} of the time is the sampler's own"
    console.print(said, highlight=False)


def _subject(report: dict[str, Any]) -> str:
    work, memory = report["work"], report["memory"]
    unit = work["unit"] + "s" * (work["count"] != 1)
    lines = [
        f"{report['env']} · {report['fidelity']} · {report['device']} ({report['hardware']}) · {report['engine']}",
        f"an episode: {work['count']:,} {unit}, about {size(memory['estimated'])}"
        + (f"; {size(memory['measured'])} of the GPU" if memory["measured"] is not None else ""),
    ]
    for engine, start in report["start"].items():
        modules = {None: "", 0: ", kernels from the cache"}.get(
            start["compiled"], f", {start['compiled']} modules of kernels compiled"
        )
        lines.append(f"{engine} was ready in {duration(start['seconds'])}{modules}")
    return "\n".join(lines)


def _rates(report: dict[str, Any]) -> Table:
    found = table("batch", "engine", "episodes/s", "with gradient", "work/s", "with gradient", "gradient / forward")
    for row in report["rates"]:
        rates = [row[way] for way in WAYS]
        cells = [str(row["batch"]), row["engine"]]
        cells += [f"{rate['episodes_per_second']:.3g}" for rate in rates]
        cells += [f"{rate['work_per_second']:.3g}" for rate in rates]
        found.add_row(*cells, f"{row['gradient_costs']:.2f}")
    return found


def _kernels(kernels: dict[str, Any]) -> Table:
    """Return the kernels as a table, slowest with gradient first, and what is spent outside them."""
    shown = table(f"kernel, batch {kernels['forward']['batch']}", "forward", "", "with gradient", "")
    found = [{row["name"]: row for row in kernels[way]["kernels"]} for way in WAYS]
    for name in dict.fromkeys([*found[1], *found[0]]):
        cells = [_spent(rows[name]["seconds"], rows[name]["share"]) if name in rows else ("", "") for rows in found]
        shown.add_row(name, *cells[0], *cells[1])
    shown.add_section()
    rest = [kernels[way]["seconds"] - sum(row["seconds"] for row in kernels[way]["kernels"]) for way in WAYS]
    cells = [_spent(seconds, seconds / kernels[way]["seconds"]) for way, seconds in zip(WAYS, rest, strict=True)]
    shown.add_row("outside kernels", *cells[0], *cells[1])
    return shown


def _spent(seconds: float, share: float) -> tuple[str, str]:
    return f"{1e3 * seconds:,.1f} ms", f"{share:.1%}"
