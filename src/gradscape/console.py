"""What the verbs of `landscape` do and print: tables, costs, progress, summaries."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from . import __version__
from .envs.registry import complete_entry, entries, make
from .landscapes.capacity import size as size
from .tables import table
from .terminal import Console, Described

if TYPE_CHECKING:
    from concurrent.futures import Executor

    import xarray as xr
    from matplotlib.figure import Figure

    from .envs.base import Environment, Fidelity
    from .landscapes import sampling
    from .landscapes.job import Job
    from .landscapes.plane import Plane

PACKAGES = (
    *("numpy", "torch", "warp-lang", "taichi", "xarray", "zarr", "matplotlib"),
    *("pyvista", "rerun-sdk", "botorch", "gpytorch", "cma", "typer", "rich"),
)


TAKEN = {one.name for one in signature(make).parameters.values() if one.kind is one.KEYWORD_ONLY}  # not by options


def list_environments() -> None:
    """Print every registered environment as a table; of ours none is imported for that."""
    found = table("name", "dim", "parameters", "model", "fidelities", title="environments")
    for entry in map(complete_entry, entries().values()):
        row = (entry.name, entry.dim, entry.parameters, entry.model, ", ".join(entry.fidelities))
        found.add_row(*row)
    console = Console()
    console.print(found)
    console.print("`landscape envs NAME` shows one in full: bounds, options, examples, fidelities, what it models.")


def describe_environment(name: str) -> None:
    """Print all there is to know about one environment."""
    from .envs.options import in_full

    env, console = make(name, device="cpu"), Console(soft_wrap=True, highlight=False)
    about = env.about() or "It says nothing of itself: its class has no docstring."
    said = f"{env.name}: {env.space.dim} parameter{'s' if env.space.dim > 1 else ''}\n\n{about}\n"
    console.print(said, markup=False)
    bounded = table("no.", "parameter", "lower", "upper", "unit")
    bounds = zip(env.space.lower.tolist(), env.space.upper.tolist(), strict=True)
    for number, (label, unit, (lower, upper)) in enumerate(zip(env.space.names, env.space.units, bounds, strict=True)):
        bounded.add_row(str(number), label, f"{lower:g}", f"{upper:g}", unit)
    console.print(bounded)
    for fidelity in env.fidelities.values():
        console.print(f"fidelity {asdict(fidelity)}", markup=False)
    console.print(f"engines: {', '.join(env.engines)}", markup=False)
    console.print(in_full(env.Options), markup=False)
    console.print(f"examples: {', '.join(env.examples) or 'none'}", markup=False)


def show_info() -> None:
    """Print versions and devices."""
    from .envs.engines.runtime import cores, device_names

    found = table("what", "version or name", title=f"gradscape {__version__}")
    found.add_row("python", sys.version.split()[0])
    for package in PACKAGES:
        found.add_row(package, _installed(package))
    found.add_row("cpu", f"{cores()} cores for this process")
    for name in device_names() or ["none found"]:
        found.add_row("cuda", name)
    Console().print(found)


def cut(
    name: str,
    dims: Sequence[str],
    *,
    resolution: int,
    fidelity: str | None,
    tolerance: str | None = None,
    device: str,
    engine: str,
    deterministic: bool,
    through: str,
    extent: str | None,
    settings: Sequence[str],
    grad: bool,
    out: str | None,
    as_json: bool,
    force: bool,
    scheduler: str | None = None,
    prints: Sequence[float] = (),
) -> None:
    """Sample a slice into its folder and say what it costs, how far it is and what came out."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    how: dict[str, Any] = {"device": device, "engine": engine}
    options = read_settings(settings)
    accuracy = chosen_fidelity(console, name, tolerance, fidelity=fidelity, **how, options=options)
    env = make(name, fidelity=accuracy, deterministic=deterministic, **how, **options)
    from .landscapes.plane import Plane  # after make: a name that does not exist is refused before torch is loaded
    from .results import point_of

    window = read_extent(extent)
    plane = Plane.through(env.space, point_of(env, through), dims, resolution=resolution, extent=window)
    from .cluster import workers

    with workers(scheduler, env.device) as executor:
        kept: dict[str, Any] = {"out": Path(out) if out else None, "force": force, "prints": prints}
        folder, summary = fill(console, env, plane, grad=grad, executor=executor, **kept)
    if as_json:
        print(json.dumps({**summary, "folder": str(folder)}))


def fill(
    console: Console,
    env: Environment,
    plane: Plane,
    *,
    out: Path | None = None,
    root: Path = Path("out"),
    grad: bool = True,
    force: bool = False,
    boxed: bool = False,
    executor: Executor | None = None,
    prints: Sequence[float] = (),
) -> tuple[Path, dict[str, Any]]:
    """Sample a slice into `out`, by default a folder named after it under `root`; stopping it ends the process.

    `boxed` leaves out what lies beyond the parameters' bounds. With an `executor` its workers compute.
    """
    from .cluster import recipe
    from .landscapes.adapters import within_box
    from .landscapes.disk import until_full
    from .landscapes.job import Job

    command = shlex.join(["landscape", *sys.argv[1:]])
    identity, provenance = env.identity() | ({"boxed": True} if boxed else {}), provenance_of(env, command)
    job = Job.open(
        within_box(env) if boxed else env, plane, out or root / _folder(identity, plane, grad), picture_of(env, plane),
        identity=identity, provenance=provenance, grad=grad, force=force, executor=executor,
        made=None if boxed else recipe(env), prints=prints,
    )  # fmt: skip
    try:
        with until_full(job.kept):
            _announce(console, job, env)
            summary = follow(console, job, command)
    except KeyboardInterrupt:
        _farewell(console, job, command)
        sys.exit(130)
    console.print(outcome(summary) + f"\n{job.folder}: {', '.join(summary['files'])}", markup=False)
    return job.folder, summary


def chosen_fidelity(
    console: Console, name: str, tolerance: str | None, *, fidelity: str | None, **how: Any
) -> str | Fidelity | None:
    """Return the fidelity that was named, or the one that a tolerance chooses."""
    if tolerance is None:
        return fidelity
    from .tolerance import chosen

    return chosen(console, name, tolerance, fidelity=fidelity, **how)


def provenance_of(env: Environment, command: str) -> dict[str, Any]:
    """Return what else is worth keeping with results."""
    return {
        "command": command,
        "created": datetime.now(UTC).strftime("%Y-%m-%d"),
        "versions": {package: _installed(package) for package in PACKAGES},
        "loss_unit": env.loss_unit,
    }


def _folder(identity: dict[str, Any], plane: Plane, grad: bool) -> str:
    """Return a name of its own for every different slice, the same for the same one."""
    settings = json.dumps([identity, plane.record(), grad], sort_keys=True)
    aligned = all(len(row.nonzero()) == 1 for row in plane.basis)
    axes = [str(int(row.nonzero()[0])) for row in plane.basis] if aligned else ["plane"]
    points = "x".join(map(str, plane.resolution))
    parts = [identity["objective"], *axes, identity["fidelity"], points]
    return "-".join([*parts, hashlib.sha256(settings.encode()).hexdigest()[:6]])


def picture_of(env: Environment, plane: Plane) -> Any:
    """Return how a slice of an environment is drawn: a map, or a profile over a line."""

    def surface(dataset: xr.Dataset, width: float | None = None) -> Figure:
        from .landscapes.draw.contour import landscape_figure

        return landscape_figure(dataset, width=width)

    def profile(dataset: xr.Dataset, width: float | None = None) -> Figure:
        import torch

        from .landscapes.draw.profile import profile_figure

        u = torch.tensor(dataset["u"].to_numpy())
        return profile_figure(dataset, events=env.events(plane.lift(u[:, None])), width=width)

    return surface if plane.rank == 2 else profile


def _announce(console: Console, job: Job, env: Environment) -> None:
    with console.status(f"{env.name}: preparing (kernels are compiled once, then kept)"):
        cost = job.cost()
    total = math.prod(job.plane.resolution)
    kind = "episodes with gradients" if job.store.grad else "episodes"
    console.print(f"{env.name} · {env.fidelity.name} · {env.device} · {job.folder}", markup=False)
    if not cost.episodes:
        console.print(f"all {total} {kind} are there already")
        return
    kept = f", {total - cost.episodes} are there already" if cost.episodes < total else ""
    device = f", {size(env.memory() * env.preferred_batch)} of it on the GPU at a time"
    console.print(
        f"{cost.episodes} {kind} to compute{kept}: about {duration(cost.seconds)}, "
        f"{size(cost.memory)} of memory{device if env.device == 'cuda' else ''}"
    )


def follow(console: Console, job: Job, command: str) -> dict[str, Any]:
    """Run a job under a progress bar and return its summary."""
    columns = (Described(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=console) as bar:
        task: TaskID | None = None

        def advance(now: sampling.Progress) -> None:
            nonlocal task
            if task is None:
                task = bar.add_task("episodes", total=now.total, completed=now.done)
            failed = sum(count for status, count in now.statuses.items() if status.name != "OK")
            bar.update(task, completed=now.done, description=f"episodes, {failed} failed" if failed else "episodes")

        return job.run(advance, command=command)


def _farewell(console: Console, job: Job, command: str) -> None:
    kept = job.kept()
    job.picture()
    console.print(f"stopped: {kept}; the same command goes on from there: {command}", markup=False)


def outcome(summary: dict[str, Any]) -> str:
    """Say in a line what a slice cost and what came out."""
    counts = {kind: count for kind, count in summary["status"].items() if count}
    said = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    low, high = summary["loss"]["lowest"], summary["loss"]["highest"]
    losses = "no finite loss" if low is None else f"losses from {low:.4g} to {high:.4g}"
    share = (summary["flat"] or 0) / sum(counts.values())
    flat = f"; gradient exactly zero at {share:.1%} of points" if share else ""
    return f"{summary['episodes']} episodes in {duration(summary['seconds'])}; {said}; {losses}{flat}"


def read_settings(settings: Sequence[str], flag: str = "--set") -> dict[str, Any]:
    """Return options given as name=value; of a scene, none may be called as something else that a scene is made of."""
    pairs = [setting.partition("=") for setting in settings]
    for setting, (name, equals, _) in zip(settings, pairs, strict=True):
        if not equals or not name:
            raise ValueError(f"{flag} takes name=value; got {setting!r}")
        if flag == "--set" and name in TAKEN:
            raise ValueError(f"--set takes a scene's own options; {name} is none, and chosen by --{name} if at all")
    return {name: value for name, _, value in pairs}


def read_extent(text: str | None) -> float | tuple[float, float] | None:
    """Return an extent given as a fraction or as LOW:HIGH."""
    if text is None:
        return None
    low, colon, high = text.partition(":")
    try:
        return (float(low), float(high)) if colon else float(low)
    except ValueError:
        raise ValueError(f"--extent takes a fraction or LOW:HIGH in the parameters' unit; got {text!r}") from None


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def duration(seconds: float) -> str:
    """Return a time in words, to about two digits."""
    if seconds < 90:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
