"""`landscape plan`: episodes, time, memory and disk of a slice, a sweep or the gallery, before anyone starts."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import (
    Along,
    Extent,
    Gradients,
    Json,
    MethodOption,
    NoGradients,
    SomeDims,
    Through,
    read_extent,
    refuse_words,
    takes_scene,
)
from .plan_race import print_race_plan

if TYPE_CHECKING:
    from ..gallery.figures import Figure
    from ..jobs.plan import Forecast, Plan, PlanJob
    from .terminal import Bars

RESOLUTION = 16  # that of `landscape slice`


@takes_scene("env", "tolerance", "deterministic", env="")
def plan(
    scene: SceneSpec,
    what: Annotated[str, typer.Argument(metavar="ENV|FIGURES.toml", help="An environment, or a list of figures.")],
    dims: SomeDims = None,
    along: Along = None,
    over: Annotated[str | None, typer.Option(help="Plan a sweep over this, as for `landscape sweep`.")] = None,
    frames: Annotated[int, typer.Option(min=2, help="Number of frames of the sweep.")] = 24,
    resolution: Annotated[
        int | None,
        typer.Option(min=2, help="Number of points along each axis. The default is 16, or that of the figures."),
    ] = None,
    through: Through = "center",
    extent: Extent = None,
    gradients: Gradients = 1,
    no_gradients: NoGradients = False,
    methods: Annotated[
        list[str] | None,
        typer.Option(help="Plan a race of these methods, a,b or repeated, or of all methods with all."),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Number of seeds per method of a race. The default is 10.")
    ] = None,
    budget: Annotated[
        int | None, typer.Option(min=1, help="Number of episodes per run of a race. The default is 1000.")
    ] = None,
    option: MethodOption = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of workers, each with a device such as this one, 1 by default. For a race, number"
            " of processes that fit Gaussian processes, one per core by default.",
        ),
    ] = None,
    json_: Json = False,
) -> None:
    """Predict the episodes, time, memory and disk of a slice, sweep, race or gallery before computing it.

    The default plane is that of parameters 0 and 1. A dry run makes a few episodes, tiles and pictures in a temporary
    folder. For a CUDA device that is not here, it uses rates that `landscape tradeoff` stored. With --methods it plans
    a race, to which --seeds and --budget apply; each method then searches a cheap synthetic landscape for a moment.

    Example: landscape plan fluid --dims 6 8 --resolution 48 --fidelity standard
    """
    began = time.perf_counter() - time.process_time()  # about when this process did
    from ..jobs.cut import refuse_cut
    from .terminal import Bars, command_line, print_json

    bars, scene = Bars(), replace(scene, name=what)
    if not what.endswith(".toml"):
        refuse_words(scene, dims)
    refuse_cut(dims, along)
    wanted = 0 if no_gradients else gradients
    cut = bool(dims or along or over or extent or resolution or wanted != 1 or through != "center")
    if methods or seeds or budget or option:
        print_race_plan(scene, methods or [], option or [], seeds, budget, workers, began=began, cut=cut, as_json=json_)
        return
    workers = workers or 1
    if what.endswith(".toml"):
        _refuse_more(bool(over or extent or scene.options or along or wanted > 1 or through != "center"))
        jobs = _figure_jobs(what, resolution, scene, grad=not no_gradients)
        _print_figures(list(_figures(jobs, bars, began, workers)), as_json=json_)
        return
    where: dict[str, Any] = {"through": through, "extent": read_extent(extent), "gradients": wanted}
    first = dims if dims or along else ["0", "1"]
    from ..jobs.plan import PlanJob

    job = PlanJob(scene, first, resolution or RESOLUTION, **where, over=over, frames=frames, along=along)
    found = job.run(bars, began=began)
    if json_:
        print_json(found.record(workers), command=command_line())
    else:
        _print(found, workers)


def _refuse_more(said: bool) -> None:
    """Raise ValueError where more is said of figures than they say themselves."""
    if said:
        raise ValueError(
            "figures say what they are; leave out --over, --along, --extent, --through, --gradients and --set"
        )


def _figure_jobs(path: str, resolution: int | None, scene: SceneSpec, *, grad: bool) -> list[tuple[Figure, PlanJob]]:
    """Return what there is to plan of a list of figures. Raises ValueError where there is no such list."""
    if not Path(path).is_file():
        raise ValueError(f"there is no list of figures at {path}; the gallery's own is gallery/figures.toml")
    from ..envs.registry import environment_class
    from ..gallery.figures import read_figures
    from ..jobs.plan import PlanJob

    jobs = []
    for figure in read_figures(Path(path)):
        wanted = scene.fidelity or figure.fidelity
        known = wanted if wanted in environment_class(figure.env).fidelities else None
        of = SceneSpec(figure.env, known, device=scene.device, options=figure.options)
        points, gradients = resolution or figure.resolution, figure.gradients if grad else 0
        jobs.append((figure, PlanJob(of, figure.dims, points, figure.through, gradients=gradients)))
    return jobs


def _figures(
    jobs: Sequence[tuple[Figure, PlanJob]], bars: Bars, began: float, workers: int
) -> Iterator[dict[str, Any]]:
    """Plan every figure's slice, each kind of them by a rehearsal of its first."""
    import gc

    kinds = dict.fromkeys(_kind(job) for _, job in jobs)
    bars.note(f"{len(jobs)} slices of {len(kinds)} kinds; the first of each kind is rehearsed")
    known: dict[str, Forecast] = {}
    for figure, job in jobs:
        if (kind := _kind(job)) not in known:
            known[kind] = job.run(bars, began=began)
            gc.collect()  # an environment may hold gigabytes of the GPU
            began = time.perf_counter()  # one process makes them all
        found = known[kind]
        yield {**found.subject(), "dims": list(figure.dims), "figure": figure.id, **found.plan.record(workers)}
        known[kind] = replace(found, plan=replace(found.plan, start=0.0))


def _kind(job: PlanJob) -> str:
    import json

    scene = [job.scene.name, job.scene.options, job.scene.fidelity]
    return json.dumps([*scene, job.resolution, job.gradients, len(job.dims or ())])


def _print(found: Forecast, workers: int) -> None:
    """Print one plan."""
    from .terminal import Console, table

    console = Console(soft_wrap=True, highlight=False)
    points = " x ".join(map(str, found.resolution))
    moving = f", {found.frames} frames over {found.over}" if found.over else ""
    subject = f"{found.env} · {found.fidelity} · {found.device}"
    console.print(f"{subject} · {points} points of {', '.join(found.dims)}{moving}")
    rows = table("what", "how much", "", show_header=False)
    for name, amount, note in _rows(found.plan, workers):
        rows.add_row(name, amount, note)
    console.print(rows)
    console.print(f"{found.plan.simulating / found.plan.episodes:.3g} s an episode, {found.plan.rate}")
    if found.too_large:
        console.print(f"too large for this machine: {found.too_large}")


def _rows(plan: Plan, workers: int) -> Iterator[tuple[str, str, str]]:
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration

    some = f", {plan.gradients} of them with gradients" if 0 < plan.gradients < plan.episodes else ""
    yield "episodes", str(plan.episodes), f"in {plan.batches} batches{some}"
    parts = [f"{name} {duration(seconds)}" for name, seconds in plan.seconds().items()]
    yield "time", duration(plan.wall(workers)), ", ".join(parts)
    if workers > 1:
        yield "", "", f"{workers} workers share simulating and writing"
    yield "devices", f"{plan.device_hours:.3g} h", "of simulating"
    gpu = f", {size(plan.gpu)} of the device" if plan.gpu else ""
    yield "memory", size(plan.memory), f"of each worker{gpu}"
    yield "disk", size(plan.disk.bytes), f"{plan.disk.files} files and folders"
    yield "", size(plan.filling.bytes), f"more until a slice is finished, {plan.filling.files} files and folders"


def _rooms(disks: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Add up the room of slices that are sampled one after another."""
    tiles = [disk["filling"] for disk in disks]
    whole = {name: sum(disk[name] for disk in disks) for name in ("bytes", "files")}
    return {**whole, "filling": {name: max((one[name] for one in tiles), default=0) for name in ("bytes", "files")}}


def _print_figures(records: Sequence[dict[str, Any]], *, as_json: bool) -> None:
    """Print the plans of figures, and all of them together."""
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration
    from .terminal import Console, command_line, print_json, table

    total = {
        "slices": len(records),
        "episodes": sum(record["episodes"] for record in records),
        "device_hours": sum(record["device_hours"] for record in records),
        "wall": sum(record["wall"] for record in records),
        "disk": _rooms([record["disk"] for record in records]),
        "memory": {name: max((record["memory"][name] for record in records), default=0) for name in ("host", "device")},
    }
    if as_json:
        print_json({"total": total, "figures": records}, command=command_line())
        return
    found = table("figure", "episodes", "device hours", "time", "memory", "disk", "rate")
    for record in records:
        hours, memory = f"{record['device_hours']:.3g}", size(record["memory"]["host"])
        room = size(record["disk"]["bytes"])
        row = (str(record["episodes"]), hours, duration(record["wall"]), memory, room, record["rate"])
        found.add_row(record["figure"], *row)
    Console().print(found)
    Console(soft_wrap=True, highlight=False).print(
        f"{total['slices']} slices: {total['episodes']} episodes, {total['device_hours']:.3g} device hours, "
        f"{duration(total['wall'])}, {size(total['disk']['bytes'])} on disk"
    )
