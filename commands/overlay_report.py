"""What `landscape overlay` does and prints."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..envs.registry import environment_class
from ..jobs.folder import SLICE_STORE as SLICE
from ..jobs.folder import run_tables
from ..jobs.folder import store_in as inside
from ..jobs.scene import environment_of
from ..landscapes.identity import stored_identity
from ..landscapes.storage.files import others, tidy
from ..landscapes.storage.paths import there
from .console import fill
from .terminal import Bars, Console
from .view import check_display, show_recording

if TYPE_CHECKING:
    import xarray as xr

    from ..envs.base import Environment
    from ..landscapes.plane import Plane

PICTURE, STREAM = "overlay.png", "overlay.rrd"
MUST, SHOULD = ("objective", "options"), ("fidelity", "settings", "engine", "code")  # agree between slice and runs


def overlay(
    slice_: str,
    runs: Sequence[str],
    *,
    source: str | None,
    out: str | None,
    through: str | None,
    plane: str | None,
    resolution: int | None,
    device: str,
    spawn: bool,
    serve: bool,
    prints: Sequence[float] = (),
) -> None:
    """Draw runs over a slice, or over one cut anew for them, and say what came out."""
    if source:
        environment_class(source)  # which registers it
    if plane not in (None, "pca"):
        raise ValueError(f"--plane takes pca, the runs' principal plane; got {plane!r}")
    if resolution and not (through or plane):
        raise ValueError("--resolution is that of a new slice; give --through or --plane too")
    from ..landscapes.overlay import overlay as laid
    from ..landscapes.storage.store import open_slice

    console = Console(stderr=True, soft_wrap=True, highlight=False)
    dataset, tables = open_slice(inside(Path(slice_), SLICE)), run_tables(runs)
    for table in tables:
        _check(console, dataset, table)
    laid(dataset, tables)  # refuses what cannot be laid over it before anything is computed
    folder = _folder(out, dataset, tables, [through, plane, resolution])
    if spawn and not serve:
        check_display(folder / STREAM, "give --serve in the place of --spawn, and look at it in a browser")
    if through or plane:
        env = environment_of(dataset, device)
        cut = _plane(env, dataset, tables, through=through, principal=plane is not None, resolution=resolution)
        gradients = "grad" in dataset
        sampled, _ = fill(console, env, cut, root=folder, grad=gradients, boxed=plane is not None)
        dataset = open_slice(sampled / SLICE)
    placed = laid(dataset, tables)
    files = _write(dataset, placed, folder, prints)
    tidy(folder)
    console.print(f"{_outcome(placed)}\n{folder}: {', '.join(files)}", markup=False)
    if spawn or serve:
        show_recording(folder / STREAM, Bars(console), serve=serve)


def _check(console: Console, dataset: xr.Dataset, table: xr.Dataset) -> None:
    """Refuse a run of another landscape; warn where it is simulated otherwise."""
    ours, theirs = stored_identity(dataset), stored_identity(table)
    name = f"{theirs.get('objective')}, {theirs.get('method')}, seed {theirs.get('seed')}"
    for setting in MUST:
        if ours.get(setting) != theirs.get(setting):
            raise ValueError(
                f"the slice and the run ({name}) are of different landscapes: {setting} is {ours.get(setting)!r} there "
                f"and {theirs.get(setting)!r} here; lay runs over a slice of their own"
            )
    differ = [one for one in SHOULD if ours.get(one) != theirs.get(one)]
    if differ:
        said = (f"{one} {ours.get(one)!r} there, {theirs.get(one)!r} here" for one in differ if one != "settings")
        console.print(
            f"warning: slice and run ({name}) are simulated differently ({'; '.join(said)}), so losses differ",
            markup=False,
        )


def _folder(out: str | None, dataset: xr.Dataset, tables: Sequence[xr.Dataset], how: list[Any]) -> Path:
    """Return the folder to write to: a new one, an empty one, or that of an overlay."""
    if out is None:
        ours = stored_identity(dataset)
        settings = [ours, [stored_identity(table) for table in tables], how]
        digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:6]
        return Path("out") / f"overlay-{ours['objective']}-{digest}"
    folder = Path(out)
    if any(not there(file / SLICE) for file in others(folder, (PICTURE, STREAM), PICTURE)):
        raise ValueError(f"{folder} holds other files; give --out a new or an empty folder")
    return folder


def _plane(
    env: Environment,
    dataset: xr.Dataset,
    tables: Sequence[xr.Dataset],
    *,
    through: str | None,
    principal: bool,
    resolution: int | None,
) -> Plane:
    """Return the plane of a new slice: parallel to the one there is, or the runs' principal one."""
    from ..landscapes.overlay import best_point, principal_plane
    from ..landscapes.storage.store import plane_of

    present = plane_of(dataset)
    shape = (resolution,) * present.rank if resolution else present.resolution
    point = None
    if through:
        point, _ = best_point(tables if through == "best" else run_tables([through]))
        if len(point) != env.space.dim:
            raise ValueError(f"{through} searched {len(point)} parameters; {env.name} has {env.space.dim}")
    if principal:
        return principal_plane(tables, resolution=shape, through=point)
    assert point is not None  # as --through is given where --plane is not
    return replace(present.moved(point), resolution=shape)


def _write(dataset: xr.Dataset, placed: Sequence[xr.Dataset], folder: Path, prints: Sequence[float]) -> list[str]:
    from ..landscapes.draw.figures.overlay import overlay_figure
    from ..landscapes.draw.figures.page import save, save_prints
    from ..landscapes.draw.recordings.runs import save_stream

    save(overlay_figure(dataset, placed), folder / PICTURE)
    save_stream(dataset, placed, folder / STREAM)
    printed = save_prints(lambda width: overlay_figure(dataset, placed, width=width), folder / PICTURE, prints)
    return [PICTURE, STREAM, *printed]


def _outcome(placed: Sequence[xr.Dataset]) -> str:
    from ..landscapes.objective import Status

    points = sum(run.sizes["evaluation"] for run in placed)
    outside = sum(int(run["outside"].sum()) for run in placed)
    failed = sum(int((run["status"] != Status.OK).sum()) for run in placed)
    away = max(float(run["distance"].max().round(9)) for run in placed)
    said = (
        f"{len(placed)} run{'s' if len(placed) > 1 else ''}, {points} points: {outside} beyond the map, {failed} failed"
    )
    return f"{said}; the farthest is {away:.2g} half-widths of the box off the plane"
