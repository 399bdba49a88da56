"""What `landscape plan` does and prints: episodes, time, memory and disk of a job before anyone starts it."""

from __future__ import annotations

import gc
import json
import shlex
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..envs.registry import environment_class, make
from ..gallery.figures import Figure, read_figures
from ..jobs.motion import refuse_too_large as refuse_sweep
from ..jobs.planned import Plan, of_slice, of_sweep
from ..jobs.tolerance import kept_rung
from ..landscapes.capacity import TooLargeError, size
from ..landscapes.cost import duration
from .arguments import read_extent, read_settings
from .terminal import Console, table

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.plane import Plane

RESOLUTION = 16  # that of `landscape slice`
DEVICES = ("auto", "cpu", "cuda")


def plan(
    what: str,
    *,
    dims: Sequence[str],
    over: str | None,
    frames: int,
    resolution: int | None,
    fidelity: str | None,
    device: str,
    engine: str,
    through: str,
    extent: str | None,
    settings: Sequence[str],
    grad: bool,
    workers: int,
    as_json: bool,
) -> None:
    """Predict what a slice, a sweep or a list of figures takes, and print it."""
    began = time.perf_counter() - time.process_time()  # about when this process did
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    if device not in DEVICES:
        raise ValueError(f"--device takes {', '.join(DEVICES)}; got {device!r}")
    options: dict[str, Any] = {"fidelity": fidelity, "engine": engine, **read_settings(settings)}
    if what.endswith(".toml"):
        if over or extent or settings or through != "center":
            raise ValueError("figures say what they are; leave out --over, --extent, --through and --set")
        records = list(_figures(console, what, resolution, fidelity, device, grad=grad, began=began, workers=workers))
        _print_figures(records, as_json)
        return
    environment_class(what)  # a name that does not exist is refused before what measures is loaded
    env, where = _made(what, device, options)
    from ..jobs.scene import point_of
    from ..landscapes.plane import Plane

    window, side = read_extent(extent), resolution or RESOLUTION
    plane = Plane.through(env.space, point_of(env, through), dims, resolution=side, extent=window)
    with _rehearsing(console, env), tempfile.TemporaryDirectory() as folder:
        if over is None:
            found = of_slice(env, plane, Path(folder), grad=grad, began=began)
        else:
            found = of_sweep(env, plane, Path(folder), over, frames, grad=grad, began=began)
    found = _there(found, env, where, grad=grad)
    about = {"over": over, "frames": frames if over else 1, "too_large": _too_large(plane, over, frames, grad=grad)}
    record = {**_subject(env, plane, where), **about, **found.record(workers)}
    if as_json:
        print(json.dumps(record | {"command": shlex.join(["landscape", *sys.argv[1:]])}))
    else:
        _print(record)


def _made(name: str, device: str, options: dict[str, Any]) -> tuple[Environment, str]:
    """Make an environment, on the CPU where the device that is asked for is not here; return that device too."""
    from ..envs.engines.runtime import cuda_available

    if device == "cuda" and "cuda" in environment_class(name).devices and not cuda_available():
        return make(name, device="cpu", **options), device
    env = make(name, device=device, **options)
    return env, env.device


def _too_large(plane: Plane, over: str | None, frames: int, *, grad: bool) -> str | None:
    """Return why this machine would refuse what is planned, None where it would not."""
    from ..landscapes.storage.arrays import refuse_too_large as refuse_slice

    try:
        if over is None:
            refuse_slice(plane, Path(), grad=grad)
        else:
            refuse_sweep(plane, frames, Path(), grad=grad, over=over)
    except TooLargeError as error:
        return str(error)
    return None


def _there(found: Plan, env: Environment, device: str, *, grad: bool) -> Plan:
    """Return a plan with the rate of a device that is not here, as `landscape tradeoff` measured it there."""
    if device == env.device:
        return found
    rung, path = kept_rung(env, device)
    each = rung["seconds"]["with_gradient" if grad else "forward"]
    rate = f"kept by `landscape tradeoff` in {path}; writing and drawing {found.rate}"
    batches = -(-found.episodes // max(1, int(rung.get("batch") or 1)))
    return replace(found, simulating=found.episodes * each, batches=batches, gpu=int(rung["memory"] or 0), rate=rate)


def _rehearsing(console: Console, env: Environment) -> Any:
    return console.status(f"{env.name}: rehearsing {env.fidelity.name} episodes, tiles and pictures")


def _figures(
    console: Console,
    path: str,
    resolution: int | None,
    fidelity: str | None,
    device: str,
    *,
    grad: bool,
    began: float,
    workers: int,
) -> Iterator[dict[str, Any]]:
    """Plan every figure's slice, each kind of them by a rehearsal of its first."""
    if not Path(path).is_file():
        raise ValueError(f"there is no list of figures at {path}; the gallery's own is gallery/figures.toml")
    figures = [
        replace(figure, fidelity=fidelity or figure.fidelity, resolution=resolution or figure.resolution)
        for figure in read_figures(Path(path))
    ]
    kinds = dict.fromkeys(map(_kind, figures))
    console.print(f"{len(figures)} slices of {len(kinds)} kinds; the first of each kind is rehearsed", markup=False)
    known: dict[str, tuple[Plan, dict[str, Any]]] = {}
    for figure in figures:
        if (kind := _kind(figure)) not in known:
            known[kind] = _figure(console, figure, device, grad=grad, began=began)
            gc.collect()  # an environment may hold gigabytes of the GPU
            began = time.perf_counter()  # one process makes them all
        found, about = known[kind]
        dims = {"dims": list(figure.dims), "figure": figure.id}
        yield {**about, **dims, **found.record(workers)}
        known[kind] = replace(found, start=0.0), about


def _figure(console: Console, figure: Figure, device: str, *, grad: bool, began: float) -> tuple[Plan, dict[str, Any]]:
    from ..gallery.parts import plane_of_figure

    known = figure.fidelity if figure.fidelity in environment_class(figure.env).fidelities else None
    env, where = _made(figure.env, device, {"fidelity": known, **figure.options})
    plane = plane_of_figure(figure, env, figure.resolution)
    with _rehearsing(console, env), tempfile.TemporaryDirectory() as folder:
        found = of_slice(env, plane, Path(folder), grad=grad, began=began)
    return _there(found, env, where, grad=grad), _subject(env, plane, where)


def _kind(figure: Figure) -> str:
    return json.dumps([figure.env, figure.options, figure.fidelity, figure.resolution, len(figure.dims)])


def _subject(env: Environment, plane: Plane, device: str) -> dict[str, Any]:
    how = {"fidelity": env.fidelity.name, "device": device, "engine": env.engine}
    return {"env": env.name, "dims": list(plane.names), "resolution": list(plane.resolution), **how}


def _print(record: dict[str, Any]) -> None:
    """Print one plan."""
    console = Console(soft_wrap=True, highlight=False)
    points, what = " x ".join(map(str, record["resolution"])), ", ".join(record["dims"])
    moving = f", {record['frames']} frames over {record['over']}" if record["over"] else ""
    console.print(
        f"{record['env']} · {record['fidelity']} · {record['device']} · {points} points of {what}{moving}", markup=False
    )
    found = table("what", "how much", "", show_header=False)
    for name, amount, note in _rows(record):
        found.add_row(name, amount, note)
    console.print(found)
    each = record["seconds"]["simulating"] / record["episodes"]
    console.print(f"{each:.3g} s an episode, {record['rate']}", markup=False)
    if record["too_large"]:
        console.print(f"too large for this machine: {record['too_large']}", markup=False)


def _rows(record: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    seconds, disk = record["seconds"], record["disk"]
    yield "episodes", str(record["episodes"]), f"in {record['batches']} batches"
    parts = [f"{name} {duration(value)}" for name, value in seconds.items()]
    yield "time", duration(record["wall"]), ", ".join(parts)
    if record["workers"] > 1:
        yield "", "", f"{record['workers']} workers share simulating and writing"
    yield "devices", f"{record['device_hours']:.3g} h", "of simulating"
    gpu = f", {size(record['memory']['device'])} of the device" if record["memory"]["device"] else ""
    yield "memory", size(record["memory"]["host"]), f"of each worker{gpu}"
    yield "disk", size(disk["bytes"]), f"{disk['files']} files and folders"
    tiles = disk["filling"]
    yield "", size(tiles["bytes"]), f"more until a slice is finished, {tiles['files']} files and folders"


def _rooms(disks: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Add up the room of slices that are sampled one after another."""
    tiles = [disk["filling"] for disk in disks]
    whole = {name: sum(disk[name] for disk in disks) for name in ("bytes", "files")}
    return {**whole, "filling": {name: max((one[name] for one in tiles), default=0) for name in ("bytes", "files")}}


def _print_figures(records: Sequence[dict[str, Any]], as_json: bool) -> None:
    """Print the plans of figures, and all of them together."""
    total = {
        "slices": len(records),
        "episodes": sum(record["episodes"] for record in records),
        "device_hours": sum(record["device_hours"] for record in records),
        "wall": sum(record["wall"] for record in records),
        "disk": _rooms([record["disk"] for record in records]),
        "memory": {name: max((record["memory"][name] for record in records), default=0) for name in ("host", "device")},
    }
    if as_json:
        command = shlex.join(["landscape", *sys.argv[1:]])
        print(json.dumps({"total": total, "figures": records, "command": command}))
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
