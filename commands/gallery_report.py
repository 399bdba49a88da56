"""What `landscape gallery` does and prints: making the figures, what is there, building and serving the site."""

from __future__ import annotations

import contextlib
import gc
import json
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler
from pathlib import Path
from typing import Any, TypeVar

from ..gallery.episodes import Episodes
from ..gallery.figures import Figure, chosen, data_folder, read_figures
from ..gallery.measures import Reports, Tradeoffs
from ..gallery.parts import Part, Searches, Slice, State, Sweep
from ..jobs.workers import workers
from ..landscapes.capacity import require, size
from ..landscapes.cost import duration
from ..landscapes.draw.loopback import LoopbackHandler, LoopbackServer
from ..landscapes.storage.disk import full, is_full, until_full
from ..landscapes.storage.files import tidy
from .terminal import Console, table

T = TypeVar("T")
PARTS: dict[str, type[Part]] = {
    "slices": Slice,
    "sweeps": Sweep,
    "episodes": Episodes,
    "searches": Searches,
    "reports": Reports,
    "tradeoffs": Tradeoffs,
}


def compute(
    *,
    only: Sequence[str],
    parts: Sequence[str],
    fidelity: str | None,
    device: str,
    resolution: int | None,
    data: str | None,
    scheduler: str | None = None,
) -> None:
    """Make what is missing of the figures, say first what it should cost, and leave with 1 where something failed."""
    if unknown := set(parts) - set(PARTS):
        raise ValueError(f"--part takes {', '.join(PARTS)}; got {', '.join(sorted(unknown))}")
    _refuse_missing(device)
    from ..landscapes.storage.arrays import need_of

    console, root = Console(stderr=True, soft_wrap=True, highlight=False), data_folder(data)
    figures = [_changed(figure, fidelity, resolution) for figure in chosen(read_figures(), only)]
    if resolution:
        rank = max(len(figure.dims) for figure in figures)
        require("resolution", resolution, lambda points: need_of((points,) * rank, rank, grad=True), root)
    failed: set[str] = set()
    with workers(scheduler, device) as executor:
        for name, kind in PARTS.items():  # slices first: the others are made of them
            if name in parts or not parts:
                sound = [figure for figure in figures if figure.id not in failed]
                _make(console, name, [kind(figure, root, device, executor) for figure in sound], failed)
    tidy(root)
    if failed:
        console.print(
            f"{len(failed)} of {len(figures)} figures failed: {', '.join(sorted(failed))}\n"
            f"to sample one anew where other settings or other code began it, delete its folder in {root}",
            markup=False,
        )
        sys.exit(1)


def _refuse_missing(device: str) -> None:
    from ..envs.engines.runtime import cuda_available

    if device == "cuda" and not cuda_available():
        raise ValueError("no CUDA device was found here, so nothing is computed on one; use --device cpu or auto")


def _make(console: Console, name: str, parts: Sequence[Part], failed: set[str]) -> None:
    """Make what is missing of one kind of part, adding to `failed` the figures where that was not possible."""
    wanted = [part for part in parts if not _try(console, part, part.there, failed)]
    wanted = [part for part in wanted if part.figure.id not in failed]
    console.print(f"{name}: {len(parts) - len(wanted)} of {len(parts)} are there already", markup=False)
    _estimate(console, name, wanted, failed)
    for part in wanted:
        if part.figure.id not in failed and not part.there():  # figures may share what one of them made
            console.print(f"{part.figure.id}: {part.label()}", markup=False)
            if said := _try(console, part, partial(part.make, console), failed):
                console.print(said, markup=False)


def _estimate(console: Console, name: str, parts: Sequence[Part], failed: set[str]) -> None:
    """Say what all of it should take, from the first figure of each scene."""
    rates: dict[str, float] = {}
    total = 0.0
    for part in parts:
        kind = json.dumps([part.figure.env, part.figure.options])
        if kind not in rates:
            rate = _try(console, part, part.seconds_each, failed)
            if rate is None:
                continue
            rates[kind] = rate
        total += rates[kind] * part.left()
    left = [part for part in parts if part.figure.id not in failed]
    if left:
        console.print(f"{name}: {len(left)} to make, about {duration(total)} in all", markup=False)


def _try(console: Console, part: Part, work: Callable[[], T], failed: set[str]) -> T | None:
    """Return what a part's work returns, or say why it failed."""
    try:
        return work()
    except KeyboardInterrupt:
        console.print(f"stopped in {part.figure.id}; the same command goes on from there", markup=False)
        sys.exit(130)
    except Exception as error:  # one figure that fails, by whatever cause, leaves the others to be computed
        if is_full(error):
            raise full(error, f"all that is finished is kept in {part.root}") from error
        said = " ".join(str(error).split())
        console.print(f"{part.figure.id} failed: {type(error).__name__}: {said}", markup=False)
        failed.add(part.figure.id)
        return None
    finally:
        gc.collect()  # an environment may hold gigabytes of the GPU


def list_figures(*, data: str | None, as_json: bool) -> None:
    """Print every figure with how much of it is there."""
    root = data_folder(data)
    found = [(figure, Slice(figure, root, "cpu").state()) for figure in read_figures()]
    if as_json:
        print(json.dumps([{"id": figure.id, "points": of.points, "done": of.done} for figure, of in found]))
        return
    listed = table("figure", "paper", "environment", "dims", "through", "data", title=f"figures in {root}")
    for figure, of in found:
        dims = " ".join(map(str, figure.dims))
        row = (figure.id, str(figure.number or "ours"), figure.env, dims, figure.through, _said(of))
        listed.add_row(*row)
    Console().print(listed)
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


def build(*, data: str | None, out: str) -> None:
    """Build the site and say what it holds."""
    from ..gallery.site.build import build_site

    console = Console(stderr=True, soft_wrap=True, highlight=False)
    root, start = data_folder(data), time.perf_counter()
    with until_full(lambda: f"{out} is as it was before"):
        manifest = build_site(
            read_figures(), root, Path(out), lambda count: console.print(f"{out}: {count} figures to draw")
        )
    weight = sum(file.stat().st_size for file in Path(out).rglob("*") if file.is_file())
    missing = f", {len(manifest['missing'])} not sampled yet" if manifest["missing"] else ""
    console.print(
        f"{len(manifest['figures'])} figures{missing}; {size(weight)} in {duration(time.perf_counter() - start)}\n"
        f"open {Path(out) / 'index.html'}, or: landscape gallery serve --out {shlex.quote(out)}",
        markup=False,
    )


def serve(*, out: str, port: int) -> None:
    """Serve the site to this machine only, until Ctrl-C."""
    if not (Path(out) / "index.html").exists():
        raise ValueError(f"{out} holds no gallery; build it with `landscape gallery build --out {shlex.quote(out)}`")
    with LoopbackServer(port, partial(Site, directory=out)) as server, contextlib.suppress(KeyboardInterrupt):
        print(f"{out} is at {server.address}/ until Ctrl-C", flush=True)
        server.serve_forever()


class Site(LoopbackHandler, SimpleHTTPRequestHandler):
    """Serve the files that lie in a folder, and none to which a link leads out of it; folders are not listed."""

    def send_head(self) -> Any:
        """Open what is asked for, where it is there."""
        asked = Path(self.translate_path(self.path))
        with contextlib.suppress(OSError, RuntimeError, ValueError):  # no name of a file, a loop of links
            file = (asked / "index.html" if asked.is_dir() else asked).resolve(strict=True)
            if file.is_file() and file.is_relative_to(Path(self.directory).resolve()):
                return super().send_head()
        self.send_error(HTTPStatus.NOT_FOUND)
        return None
