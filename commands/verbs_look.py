"""Verbs that look: what there is, slices and sweeps of it, surfaces, episodes."""

from __future__ import annotations

from typing import Annotated

import typer

from .arguments import (
    Deterministic,
    Device,
    Dims,
    Engine,
    Env,
    Extent,
    Fidelity,
    Json,
    NoGradients,
    Print,
    Resolution,
    Scheduler,
    Set,
    Through,
)


def envs(name: Annotated[str | None, typer.Argument(help="One environment, to see all of it.")] = None) -> None:
    """List the environments: name, dimension, parameters, model, fidelities."""
    from .console import describe_environment, list_environments

    describe_environment(name) if name else list_environments()


def info() -> None:
    """Show versions and devices."""
    from .console import show_info

    show_info()


def sweep(
    env: Env,
    dims: Dims,
    over: Annotated[
        str,
        typer.Option(help="What moves from frame to frame: a third parameter over its bounds, horizon, or smoothing."),
    ],
    frames: Annotated[int, typer.Option(min=2, help="Values of it, both ends included.")] = 24,
    resolution: Resolution = 16,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    deterministic: Deterministic = False,
    through: Through = "center",
    extent: Extent = None,
    set_: Set = None,
    no_gradients: NoGradients = False,
    scheduler: Scheduler = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the sweep.")
    ] = None,
    json_: Json = False,
    force: Annotated[bool, typer.Option("--force", help="Begin anew where a sweep exists already.")] = False,
) -> None:
    """Sample slices as a third parameter moves, and film them on one colour scale.

    Writes sweep.mp4, sweep.gif, and sweep.rrd to walk around in. Stop it at any moment: the same command goes on where
    it stopped.
    """
    from .sweep_report import sweep as report

    report(
        env,
        dims,
        over,
        frames=frames,
        resolution=resolution,
        fidelity=fidelity,
        device=device,
        engine=engine,
        deterministic=deterministic,
        through=through,
        extent=extent,
        settings=set_ or [],
        grad=not no_gradients,
        out=out,
        as_json=json_,
        force=force,
        scheduler=scheduler,
    )


def surface(
    slice_: Annotated[str, typer.Argument(metavar="SLICE", help="A slice's folder.")],
    runs: Annotated[
        list[str] | None, typer.Argument(metavar="[RUN]...", help="Folders of runs; a race's for all of it.")
    ] = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the surface.")
    ] = None,
    print_: Print = None,
) -> None:
    """Draw a slice as a lit surface, its height and colour the loss, with runs draped on it.

    Writes surface.png, and surface.gltf to turn around in any viewer of 3-D models. A sample that failed is a hole.
    """
    from .surface_report import surface as report

    report(slice_, runs or [], out=out, prints=print_ or [])


def replay(
    env: Env,
    params: Annotated[
        str,
        typer.Option(help="The episode: center, random:SEED, example:NAME, best:RUN or a file of parameters."),
    ] = "center",
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    set_: Set = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the episode.")
    ] = None,
    print_: Print = None,
    film: Annotated[bool, typer.Option(help="Film it, too; that takes about a minute.")] = True,
) -> None:
    """Draw an episode: key frames side by side in episode.png, all of it in episode.mp4, episode.gif and episode.rrd.

    The last is a scene to walk around in: `landscape view FOLDER/episode.rrd`, or `landscape view FOLDER --serve`.
    """
    from .replay_report import replay as report

    report(
        env,
        params=params,
        fidelity=fidelity,
        device=device,
        engine=engine,
        settings=set_ or [],
        out=out,
        film=film,
        prints=print_ or [],
    )


def export(
    what: Annotated[str, typer.Argument(metavar="SLICE|RUN", help="The folder of a slice or of a run.")],
    to: Annotated[str, typer.Option(help="csv, parquet or netcdf.")] = "csv",
    out: Annotated[str | None, typer.Option(help="The file to write; by default one beside the slice or run.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file where it exists already.")] = False,
) -> None:
    """Write a slice or a run as a table for other programs: a row for each sample or episode, columns with units.

    netCDF holds the arrays themselves, with their names, units and how they were made.
    """
    from .export_report import export as report

    report(what, to=to, out=out, force=force)


def view(
    file: Annotated[str, typer.Argument(help="A picture, a film, a page, a recording (.rrd), or a results folder.")],
    serve: Annotated[bool, typer.Option("--serve", help="Serve a recording to a browser, until Ctrl-C.")] = False,
) -> None:
    """Open what the other verbs leave, with the viewer it is made for."""
    from .overlay_report import view as show

    show(file, serve=serve)
