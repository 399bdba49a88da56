"""What the verbs of `landscape` do and print: tables, costs, progress, summaries."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..envs.registry import completed, entries, make
from ..landscapes.capacity import size as size
from ..landscapes.cost import duration as duration
from .terminal import Console, table

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..envs.base import Environment, Fidelity
    from ..landscapes.plane import Plane

PACKAGES = (
    *("numpy", "torch", "warp-lang", "taichi", "xarray", "zarr", "matplotlib"),
    *("pyvista", "rerun-sdk", "botorch", "gpytorch", "cma", "typer", "rich"),
)


TAKEN = {one.name for one in signature(make).parameters.values() if one.kind is one.KEYWORD_ONLY}  # not by options


def list_environments() -> None:
    """Print every registered environment as a table; of ours none is imported for that."""
    found = table("name", "dim", "parameters", "model", "fidelities", title="environments")
    for entry in map(completed, entries().values()):
        row = (entry.name, entry.dim, entry.parameters, entry.model, ", ".join(entry.fidelities))
        found.add_row(*row)
    console = Console()
    console.print(found)
    console.print("`landscape envs NAME` shows one in full: bounds, options, examples, fidelities, what it models.")


def describe_environment(name: str) -> None:
    """Print all there is to know about one environment."""
    from ..envs.options import in_full

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
    from ..envs.engines.runtime import cores, device_names

    found = table("what", "version or name", title=f"gradscape {__version__}")
    found.add_row("python", sys.version.split()[0])
    for package in PACKAGES:
        found.add_row(package, _installed(package))
    found.add_row("cpu", f"{cores()} cores for this process")
    for name in device_names() or ["none found"]:
        found.add_row("cuda", name)
    Console().print(found)


def fill(
    console: Console,
    env: Environment,
    plane: Plane,
    *,
    out: Path | None = None,
    root: Path = Path("out"),
    boxed: bool = False,
    grad: bool = True,
    force: bool = False,
    prints: Sequence[float] = (),
    executor: Executor | None = None,
) -> tuple[Path, dict[str, Any]]:
    """Sample a slice into `out`, by default a folder named after it under `root`."""
    from ..api.progress import Bars
    from ..jobs.slice import SliceJob

    command = shlex.join(["landscape", *sys.argv[1:]])
    how: dict[str, Any] = {"grad": grad, "force": force, "executor": executor, "prints": prints, "boxed": boxed}
    job = SliceJob.of(env, plane, command=command, out=out, root=root, **how)
    summary = job.run(Bars(console))
    console.print(summary.outcome() + f"\n{job.folder}: {', '.join(summary.files)}", markup=False)
    return job.folder, asdict(summary)


def chosen_fidelity(
    console: Console, name: str, tolerance: str | None, *, fidelity: str | None, **how: Any
) -> str | Fidelity | None:
    """Return the fidelity that was named, or the one that a tolerance chooses."""
    from ..api.progress import Bars
    from ..jobs.scene import SceneSpec

    return SceneSpec(name, fidelity, tolerance, **how).resolve(Bars(console)).fidelity


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
