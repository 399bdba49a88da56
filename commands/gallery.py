"""`landscape gallery`: make what its figures lack, list them, build and serve the site."""

from __future__ import annotations

from typing import Annotated

import typer

from ..landscapes.plain import printable
from .arguments import Data, Device, Fidelity, Json, Scheduler

Site = Annotated[str, typer.Option(help="Folder of the site.")]


def compute(
    only: Annotated[
        list[str] | None,
        typer.Option(help="A figure's id or an environment. It may be repeated; the default is all figures."),
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="Part to compute: slices, companions (the same slice through other points), sweeps, "
            "episodes, searches, reports, tradeoffs, league or league-slices. It may be repeated; the"
            " default is all but the league, which takes longest."
        ),
    ] = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    resolution: Annotated[
        int | None, typer.Option(min=2, help="Number of points along each axis, for all figures.")
    ] = None,
    scheduler: Scheduler = None,
    data: Data = None,
) -> None:
    """Compute what is missing of the figures, after an estimate of its cost.

    The data folder then holds a folder per figure: slice.zarr at the fidelity of the figure, companions.json (the same
    slice through other points), episode-*.mp4 at some of its points, sweep.mp4 at draft fidelity, report.json and
    measures.json. runs/ holds searches at the fidelity of the figures, tradeoff/ the accuracy and time of each
    environment, league/ races of nine methods. Stop at any time: the same command goes on from there. A figure that
    fails does not stop the others.

    Example: landscape gallery compute --only fluid --part slices --device cuda
    """
    from ..gallery.figures import choose_figures, read_figures

    chosen = choose_figures(read_figures(), only or [])
    from ..gallery.compute import change_figures, compute_parts
    from ..gallery.files import data_folder
    from .terminal import Bars

    bars, root = Bars(), data_folder(data)
    figures = change_figures(chosen, fidelity, resolution, root)
    failed = compute_parts(figures, root, bars, parts=part or [], device=device, scheduler=scheduler)
    if failed:
        bars.note(
            f"{len(failed)} of {len(figures)} figures failed: {', '.join(failed)}\n"
            f"to sample one anew where other settings or another model began it, delete its folder in {root}"
        )
        raise typer.Exit(1)


def list_(data: Data = None, json_: Json = False) -> None:
    """List the figures, and how much of each is computed.

    It writes no file.

    Example: landscape gallery list
    """
    import json
    from dataclasses import asdict

    from ..gallery.figures import read_figures
    from ..gallery.files import data_folder
    from ..gallery.parts import SlicePart
    from .terminal import Console, table

    root = data_folder(data)
    states = [(figure, SlicePart(figure, root, "cpu").state()) for figure in read_figures()]
    if json_:
        print(json.dumps([{"id": figure.id, **asdict(state)} for figure, state in states]))
        return
    listed = table("figure", "paper", "environment", "dims", "through", "data", title=f"figures in {root}")
    for figure, state in states:
        dims, number = " ".join(map(str, figure.dims)), str(figure.caption.number or "ours")
        listed.add_row(figure.id, number, figure.env, dims, figure.through, str(state))
    Console().print(listed)
    missing = sum(not state.finished for _, state in states)
    Console(soft_wrap=True).print(
        f"{len(states) - missing} there, {missing} missing; `landscape gallery compute` samples what is missing"
    )
    if older := sum(bool(state.changed) for _, state in states):
        Console(soft_wrap=True).print(
            f"{older} are older: they were sampled with other settings than their fidelity has now; "
            f"to sample one anew, delete its folder in {root}"
        )


def build(data: Data = None, out: Site = "out/gallery") -> None:
    """Build the site from the computed data, without simulating.

    The folder then holds the whole site: index.html opens it without a network, manifest.json lists it for programs.

    Example: landscape gallery build --out site
    """
    import shlex
    import time
    from pathlib import Path

    from ..gallery.figures import read_figures
    from ..gallery.files import data_folder
    from ..gallery.site import build as site
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration
    from ..landscapes.storage.disk import until_full
    from .terminal import Bars

    bars, start = Bars(), time.perf_counter()
    with until_full(lambda: f"{out} is as it was before"):
        manifest = site.build_site(
            read_figures(), data_folder(data), Path(out), lambda count: bars.note(f"{out}: {count} figures to draw")
        )
    weight = sum(file.stat().st_size for file in Path(out).rglob("*") if file.is_file())
    missing = f", {len(manifest.missing)} not sampled yet" if manifest.missing else ""
    bars.note(
        f"{len(manifest.figures)} figures{missing}; {size(weight)} in {duration(time.perf_counter() - start)}\n"
        f"open {Path(out) / 'index.html'}, or: landscape gallery serve --out {shlex.quote(out)}"
    )


def serve(
    out: Site = "out/gallery",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine. 0 picks a free one.")] = 8000,
) -> None:
    """Serve the site to a browser on this machine, until Ctrl-C.

    It writes no file.

    Example: landscape gallery serve --out site --port 0
    """
    import contextlib

    from ..gallery.site.server import open_server

    with open_server(out, port) as server, contextlib.suppress(KeyboardInterrupt):
        print(f"{printable(str(out))} is at {server.address}/ until Ctrl-C", flush=True)
        server.serve_forever()
