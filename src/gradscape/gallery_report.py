"""What `landscape gallery` does and prints: sampling the figures, what is there, building and serving the site."""

from __future__ import annotations

import contextlib
import gc
import json
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .console import duration, follow, identity_of, outcome, picture_of, provenance_of, size
from .envs.registry import make
from .gallery.figures import DATA, Figure, chosen, read_figures

if TYPE_CHECKING:
    from .landscapes.job import Job
    from .landscapes.plane import Plane

T = TypeVar("T")


@dataclass(frozen=True)
class State:
    """How much of a figure is sampled: `done` of `points`, or None where the data is another slice's."""

    points: int
    done: int | None

    @property
    def finished(self) -> bool:
        """Whether nothing is left to compute."""
        return self.done == self.points


def compute(
    *, only: Sequence[str], fidelity: str | None, device: str, resolution: int | None, data: str | None
) -> None:
    """Sample what is missing of the figures, say first what it should cost, and leave with 1 where one failed."""
    console, root = Console(stderr=True, soft_wrap=True, highlight=False), Path(data) if data else DATA
    figures = [_changed(figure, fidelity, resolution) for figure in chosen(read_figures(), only)]
    wanted = [figure for figure in figures if not _state(figure, root).finished]
    console.print(f"{len(figures) - len(wanted)} of {len(figures)} figures are in {root} already", markup=False)
    failed = _estimate(console, wanted, root, device)
    for figure in wanted:
        if figure.id not in failed:
            console.print(f"{figure.id}: {figure.command(device)}", markup=False)
            if (summary := _try(console, figure, partial(_sample, console, figure, root, device))) is None:
                failed.add(figure.id)
            else:
                console.print(outcome(summary), markup=False)
    if failed:
        console.print(
            f"{len(failed)} of {len(figures)} figures failed: {', '.join(sorted(failed))}\n"
            f"to sample one anew where other settings or other code began it, delete its folder in {root}",
            markup=False,
        )
        sys.exit(1)


def list_figures(*, data: str | None, as_json: bool) -> None:
    """Print every figure with how much of it is there."""
    root = Path(data) if data else DATA
    found = [(figure, _state(figure, root)) for figure in read_figures()]
    if as_json:
        print(json.dumps([{"id": figure.id, "points": of.points, "done": of.done} for figure, of in found]))
        return
    table = Table(title=f"figures in {root}", title_justify="left")
    for heading in ("figure", "paper", "environment", "dims", "through", "data"):
        table.add_column(heading, overflow="fold")
    for figure, of in found:
        dims = " ".join(map(str, figure.dims))
        row = (figure.id, str(figure.number or "ours"), figure.env, dims, figure.through, _said(of))
        table.add_row(*map(escape, row))
    Console().print(table)
    missing = sum(not of.finished for _, of in found)
    Console(soft_wrap=True).print(
        f"{len(found) - missing} there, {missing} missing; `landscape gallery compute` samples what is missing"
    )


def _changed(figure: Figure, fidelity: str | None, resolution: int | None) -> Figure:
    return replace(figure, fidelity=fidelity or figure.fidelity, resolution=resolution or figure.resolution)


def _said(state: State) -> str:
    if state.finished:
        return "there"
    if state.done is None:
        return "other settings"
    return f"{state.done} of {state.points} points" if state.done else "missing"


def _state(figure: Figure, root: Path) -> State:
    """Look at a figure's data without making its environment; who sampled it, and on what device, does not matter."""
    from .landscapes.job import STORE
    from .landscapes.store import SliceStore, is_slice

    points = figure.resolution ** len(figure.dims)
    if not is_slice(root / figure.id / STORE):
        return State(points, 0)
    store = SliceStore.open(root / figure.id / STORE)
    return State(points, int((store.status() > 0).sum()) if _same(figure, store.identity) else None)


def _same(figure: Figure, identity: dict[str, Any]) -> bool:
    """Whether a slice has the figure's environment, fidelity, options, resolution and dimensions."""
    plane = identity["plane"]
    dims = tuple(row.index(1.0) for row in plane["basis"] if row.count(1.0) == 1)
    same = identity["objective"] == figure.env and identity["fidelity"] == figure.fidelity and dims == figure.dims
    options = {name: identity["options"].get(name) for name in figure.options}
    return bool(same and options == figure.options and plane["resolution"] == [figure.resolution] * len(dims))


def _open(figure: Figure, root: Path, device: str) -> Job:
    from .landscapes.job import Job

    env = make(figure.env, fidelity=figure.fidelity, device=device, **figure.options)
    return Job.open(
        env, _plane(figure, env), root / figure.id, picture_of(env, _plane(figure, env)),
        identity=identity_of(env), provenance=provenance_of(env, figure.command(device)),
        force=_state(figure, root).done == 0,  # nothing is lost of a store made by other code or for another device
    )  # fmt: skip


def _plane(figure: Figure, env: Any) -> Plane:
    from .envs.points import point
    from .landscapes.plane import Plane

    return Plane.through(env.space, point(env, figure.through), figure.dims, resolution=figure.resolution)


def _estimate(console: Console, figures: Sequence[Figure], root: Path, device: str) -> set[str]:
    """Say what all of it should take, from the first points of one figure of each kind; return those that failed."""
    rates: dict[str, float] = {}
    failed: set[str] = set()
    total = 0.0
    for figure in figures:
        kind = json.dumps([figure.env, figure.options])
        state = _state(figure, root)
        if kind not in rates:
            rate = _try(console, figure, partial(_rate, figure, root, device))
            if rate is None:
                failed.add(figure.id)
                continue
            rates[kind] = rate
        total += rates[kind] * (state.points - (state.done or 0))
    if figures:
        console.print(f"{len(figures) - len(failed)} figures to compute: about {duration(total)} in all", markup=False)
    return failed


def _rate(figure: Figure, root: Path, device: str) -> float:
    """Return the measured seconds per episode."""
    cost = _open(figure, root, device).cost()
    gc.collect()  # an environment may hold gigabytes of the GPU
    return cost.seconds / max(cost.episodes, 1)


def _sample(console: Console, figure: Figure, root: Path, device: str) -> dict[str, Any]:
    job = _open(figure, root, device)
    try:
        return follow(console, job, figure.command(device))
    except KeyboardInterrupt:
        console.print(f"stopped in {figure.id}; the same command goes on from there", markup=False)
        sys.exit(130)
    finally:
        del job
        gc.collect()


def _try(console: Console, figure: Figure, work: Callable[[], T]) -> T | None:
    """Return what a figure's work returns, or say why it failed."""
    try:
        return work()
    except Exception as error:  # one figure that fails, by whatever cause, leaves the others to be computed
        console.print(f"{figure.id} failed: {type(error).__name__}: {' '.join(str(error).split())}", markup=False)
        return None


def build(*, data: str | None, out: str) -> None:
    """Build the site and say what it holds."""
    from .gallery.build import build_site

    root, start = Path(data) if data else DATA, time.perf_counter()
    manifest = build_site(read_figures(), root, Path(out))
    weight = sum(file.stat().st_size for file in Path(out).rglob("*") if file.is_file())
    missing = f", {len(manifest['missing'])} not sampled yet" if manifest["missing"] else ""
    Console(stderr=True, soft_wrap=True, highlight=False).print(
        f"{len(manifest['figures'])} figures{missing}; {size(weight)} in {duration(time.perf_counter() - start)}\n"
        f"open {Path(out) / 'index.html'}, or: landscape gallery serve --out {shlex.quote(out)}",
        markup=False,
    )


def serve(*, out: str, port: int) -> None:
    """Serve the site to this machine only, until Ctrl-C."""
    if not (Path(out) / "index.html").exists():
        raise ValueError(f"{out} holds no gallery; build it with `landscape gallery build --out {out}`")
    handler = partial(_Quiet, directory=out)
    with ThreadingHTTPServer(("127.0.0.1", port), handler) as server:
        print(f"{out} is at http://127.0.0.1:{server.server_address[1]}/ until Ctrl-C", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


class _Quiet(SimpleHTTPRequestHandler):
    """Serve files without a line per request."""

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""
