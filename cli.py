"""The command `landscape`: one function per verb, nothing heavy imported before it is used."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from . import __version__

app = typer.Typer(
    name="landscape",
    help="See, measure and search the loss landscapes of differentiable simulators.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Fidelity = Annotated[str | None, typer.Option(help="How accurately to simulate: draft, standard or reference.")]
Tolerance = Annotated[
    str | None,
    typer.Option(
        help="Instead of --fidelity: the quickest that `landscape tradeoff` found within this loss error, 5% of the "
        "losses' spread or a number in their unit."
    ),
]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda; auto takes CUDA where it is.")]
Deterministic = Annotated[
    bool, typer.Option("--deterministic", help="Add up in the same order every time on a GPU, some ten times slower.")
]
Engine = Annotated[str, typer.Option(help="warp, or taichi where a scene has it: the reference, to hold Warp against.")]
Set = Annotated[list[str] | None, typer.Option("--set", help="A scene option, name=value; may be repeated.")]
Out = Annotated[
    str | None, typer.Option(help="Folder for the results; by default one under out/ named after the slice.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object on standard output.")]
Force = Annotated[bool, typer.Option("--force", help="Begin anew where a slice exists already.")]
Budget = Annotated[int, typer.Option(min=1, help="Episodes to evaluate, not one more.")]
OutOfRun = Annotated[
    str | None, typer.Option("--out", help="Folder for the results; by default one under out/ named after the run.")
]
ForceRun = Annotated[bool, typer.Option("--force", help="Begin anew where a run exists already.")]
Extent = Annotated[
    str | None,
    typer.Option(help="What to cover: a fraction of the box around the point, or LOW:HIGH; the whole box by default."),
]
Through = Annotated[
    str, typer.Option(help="The point it goes through: center, random:SEED, example:NAME or a file of parameters.")
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Dask workers to compute on: the address of a scheduler, or local:N for N of them here; local alone has "
        "one per GPU, or per core."
    ),
]
NoGradients = Annotated[bool, typer.Option("--no-gradients", help="Sample losses only.")]


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False) -> None:
    if version:
        typer.echo(f"gradscape {__version__}")
        raise typer.Exit()


@app.command()
def envs(name: Annotated[str | None, typer.Argument(help="One environment, to see all of it.")] = None) -> None:
    """List the environments: name, dimension, parameters, model, fidelities."""
    from .console import describe_environment, list_environments

    describe_environment(name) if name else list_environments()


@app.command()
def info() -> None:
    """Show versions and devices."""
    from .console import show_info

    show_info()


@app.command("slice")
def slice_(
    env: Annotated[str, typer.Argument(help="The environment; `landscape envs` lists them.")],
    dims: Annotated[tuple[str, str], typer.Option(help="The two parameters to vary, by number or by name.")],
    resolution: Annotated[int, typer.Option(min=2, help="Points along each axis.")] = 16,
    fidelity: Fidelity = None,
    tolerance: Tolerance = None,
    device: Device = "auto",
    engine: Engine = "warp",
    deterministic: Deterministic = False,
    through: Through = "center",
    extent: Extent = None,
    set_: Set = None,
    no_gradients: NoGradients = False,
    scheduler: Scheduler = None,
    out: Out = None,
    json_: Json = False,
    force: Force = False,
) -> None:
    """Sample losses and gradients over a plane through parameter space, and draw them.

    Stop it at any moment: the same command goes on where it stopped.
    """
    from .console import cut

    cut(
        env,
        dims,
        resolution=resolution,
        fidelity=fidelity,
        tolerance=tolerance,
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


@app.command()
def sweep(
    env: Annotated[str, typer.Argument(help="The environment; `landscape envs` lists them.")],
    dims: Annotated[tuple[str, str], typer.Option(help="The two parameters to vary, by number or by name.")],
    over: Annotated[
        str,
        typer.Option(help="What moves from frame to frame: a third parameter over its bounds, horizon, or smoothing."),
    ],
    frames: Annotated[int, typer.Option(min=2, help="Values of it, both ends included.")] = 24,
    resolution: Annotated[int, typer.Option(min=2, help="Points along each axis.")] = 16,
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


@app.command()
def methods(name: Annotated[str | None, typer.Argument(help="One method, to see all of it.")] = None) -> None:
    """List the optimisation methods: what each does, its options and their defaults."""
    from .search_report import describe_method, list_methods

    describe_method(name) if name else list_methods()


@app.command()
def optimize(
    env: Annotated[str, typer.Argument(help="The environment; `landscape envs` lists them.")],
    method: Annotated[str, typer.Option(help="The method; `landscape methods` lists them.")],
    budget: Budget = 1000,
    seed: Annotated[int, typer.Option(min=0, help="What the method's random numbers begin with.")] = 0,
    fidelity: Fidelity = None,
    tolerance: Tolerance = None,
    device: Device = "auto",
    engine: Engine = "warp",
    deterministic: Deterministic = False,
    set_: Set = None,
    option: Annotated[list[str] | None, typer.Option(help="A method's option, name=value; may be repeated.")] = None,
    out: OutOfRun = None,
    json_: Json = False,
    force: ForceRun = False,
) -> None:
    """Search an environment's parameters for the least loss, and keep every point that was evaluated.

    Stop it at any moment: the same command goes on where it stopped. With a larger budget it goes on from the end, to
    the run that had this budget from the beginning.
    """
    from .search_report import optimize as report

    report(
        env,
        method,
        budget=budget,
        seed=seed,
        fidelity=fidelity,
        tolerance=tolerance,
        device=device,
        engine=engine,
        deterministic=deterministic,
        settings=set_ or [],
        method_settings=option or [],
        out=out,
        as_json=json_,
        force=force,
    )


@app.command()
def race(
    env: Annotated[str, typer.Argument(help="The environment; `landscape envs` lists them.")],
    methods: Annotated[
        list[str] | None,
        typer.Option(help="Methods, a,b or repeated; by default all that can run here (`landscape methods`)."),
    ] = None,
    budget: Budget = 1000,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each method, with seeds 0, 1, ...")] = 10,
    workers: Annotated[
        int, typer.Option(min=1, help="Runs at a time, each in a thread; losses do not depend on it, seconds do.")
    ] = 1,
    scheduler: Scheduler = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    deterministic: Deterministic = False,
    set_: Set = None,
    option: Annotated[
        list[str] | None, typer.Option(help="A method's option, METHOD.NAME=VALUE; may be repeated.")
    ] = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the race.")
    ] = None,
    json_: Json = False,
    report: Annotated[bool, typer.Option("--report", help="Say which of the paper's orderings hold.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Begin anew where these runs exist already.")] = False,
) -> None:
    """Let methods compete on the same budget, with several seeds each: best loss, targets reached, ranks.

    Stop it at any moment: the same command goes on where it stopped. More methods, seeds or episodes go on from there
    too; runs that are finished are not repeated.
    """
    from .race_report import race as report_race

    report_race(
        env,
        methods or [],
        budget=budget,
        seeds=seeds,
        workers=workers,
        fidelity=fidelity,
        device=device,
        engine=engine,
        deterministic=deterministic,
        settings=set_ or [],
        method_settings=option or [],
        out=out,
        as_json=json_,
        report=report,
        force=force,
        scheduler=scheduler,
    )


@app.command()
def overlay(
    slice_: Annotated[str, typer.Argument(metavar="SLICE", help="A slice's folder.")],
    runs: Annotated[list[str], typer.Argument(metavar="RUN", help="Folders of runs; a race's for all of it.")],
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the overlay.")
    ] = None,
    through: Annotated[
        str | None, typer.Option(help="Cut anew through the best point of all runs (best) or of one run's folder.")
    ] = None,
    plane: Annotated[str | None, typer.Option(help="Cut anew along the runs' two principal directions: pca.")] = None,
    resolution: Annotated[
        int | None, typer.Option(min=2, help="Points along each axis of a new slice; by default as in SLICE.")
    ] = None,
    device: Device = "auto",
    spawn: Annotated[bool, typer.Option("--spawn", help="Open it in rerun's viewer.")] = False,
    serve: Annotated[bool, typer.Option("--serve", help="Serve it to a browser here, until Ctrl-C.")] = False,
) -> None:
    """Draw runs over a slice: where they went, how far off its plane, and what it does not show of what they found.

    Writes overlay.png, and overlay.rrd to walk around in and to play back.
    """
    from .overlay_report import overlay as report

    report(
        slice_,
        runs,
        out=out,
        through=through,
        plane=plane,
        resolution=resolution,
        device=device,
        spawn=spawn,
        serve=serve,
    )


@app.command()
def surface(
    slice_: Annotated[str, typer.Argument(metavar="SLICE", help="A slice's folder.")],
    runs: Annotated[
        list[str] | None, typer.Argument(metavar="[RUN]...", help="Folders of runs; a race's for all of it.")
    ] = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the surface.")
    ] = None,
) -> None:
    """Draw a slice as a lit surface, its height and colour the loss, with runs draped on it.

    Writes surface.png, and surface.gltf to turn around in any viewer of 3-D models. A sample that failed is a hole.
    """
    from .surface_report import surface as report

    report(slice_, runs or [], out=out)


@app.command()
def replay(
    env: Annotated[str, typer.Argument(help="The environment; `landscape envs` lists them.")],
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
    film: Annotated[bool, typer.Option(help="Film it, too; that takes about a minute.")] = True,
) -> None:
    """Draw an episode: key frames side by side in episode.png, all of it in episode.mp4, episode.gif and episode.rrd.

    The last is a scene to walk around in: `landscape view FOLDER/episode.rrd`, or `landscape view FOLDER --serve`.
    """
    from .replay_report import replay as report

    report(env, params=params, fidelity=fidelity, device=device, engine=engine, settings=set_ or [], out=out, film=film)


@app.command()
def view(
    file: Annotated[str, typer.Argument(help="A picture, a film, a page, a recording (.rrd), or a results folder.")],
    serve: Annotated[bool, typer.Option("--serve", help="Serve a recording to a browser, until Ctrl-C.")] = False,
) -> None:
    """Open what the other verbs leave, with the viewer it is made for."""
    from .overlay_report import view as show

    show(file, serve=serve)


@app.command()
def bounce(
    axis: Annotated[str, typer.Option(help="The initial velocity to vary: x, y or z.")],
    resolution: Annotated[int, typer.Option(min=2, help="Number of velocities.")] = 512,
    fidelity: Fidelity = "standard",
    device: Device = "auto",
    through: Through = "example:aim",
    extent: Extent = None,
    set_: Set = None,
    out: Out = None,
    json_: Json = False,
    force: Force = False,
) -> None:
    """Draw loss and gradient of the bouncing ball over one velocity, and mark where the number of bounces changes."""
    from .console import cut

    if axis not in ("x", "y", "z"):
        raise ValueError(f"bounce varies the velocity along axis x, y or z; got {axis!r}")
    cut(
        "bounce",
        (f"velocity {axis}",),
        resolution=resolution,
        fidelity=fidelity,
        device=device,
        engine="warp",
        deterministic=False,
        through=through,
        extent=extent,
        settings=set_ or [],
        grad=True,
        out=out,
        as_json=json_,
        force=force,
    )


@app.command()
def plan(
    what: Annotated[str, typer.Argument(metavar="ENV|FIGURES.toml", help="An environment, or a list of figures.")],
    dims: Annotated[tuple[str, str], typer.Option(help="The two parameters to vary, by number or by name.")] = (
        "0",
        "1",
    ),
    over: Annotated[
        str | None, typer.Option(help="Plan a sweep: what moves from frame to frame, as for `landscape sweep`.")
    ] = None,
    frames: Annotated[int, typer.Option(min=2, help="Frames of the sweep.")] = 24,
    resolution: Annotated[
        int | None, typer.Option(min=2, help="Points along each axis; 16, or what the figures say.")
    ] = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    through: Through = "center",
    extent: Extent = None,
    set_: Set = None,
    no_gradients: NoGradients = False,
    workers: Annotated[int, typer.Option(min=1, help="Workers, each with a device such as this one.")] = 1,
    json_: Json = False,
) -> None:
    """Predict episodes, time, memory and disk of a slice, a sweep or the gallery's slices, without making them.

    A few episodes, tiles and pictures are made and thrown away. For a CUDA device that is not here, what
    `landscape tradeoff` kept of one counts.
    """
    from .plan_report import plan as report

    report(
        what,
        dims=dims,
        over=over,
        frames=frames,
        resolution=resolution,
        fidelity=fidelity,
        device=device,
        engine=engine,
        through=through,
        extent=extent,
        settings=set_ or [],
        grad=not no_gradients,
        workers=workers,
        as_json=json_,
    )


@app.command()
def bench(
    env: Annotated[str, typer.Argument(help="The environment; `landscape envs` lists them.")],
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    deterministic: Deterministic = False,
    against: Annotated[str | None, typer.Option(help="Another engine, to run in turn with the first.")] = None,
    batch: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Episodes at once; may be repeated. By default 1 and what the environment prefers."),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="How long to time each batch size, about.")] = 10.0,
    set_: Set = None,
    json_: Json = False,
) -> None:
    """Measure episodes per second, forward and with gradient, and what they are spent on.

    Rates are the best of repetitions that alternate; with --against, engines alternate too, and ratios are of one run.
    """
    from .bench_report import bench as report

    report(
        env,
        fidelity=fidelity,
        device=device,
        engine=engine,
        deterministic=deterministic,
        against=against,
        batches=batch or [],
        seconds=seconds,
        settings=set_ or [],
        as_json=json_,
    )


@app.command()
def check(
    env: Annotated[str, typer.Argument(help="The environment, ours or one that another package registers.")],
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    set_: Set = None,
    points: Annotated[int, typer.Option(min=2, help="Random points of the box to check at.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="What the points begin with.")] = 0,
    json_: Json = False,
) -> None:
    """Check that an environment keeps what every environment promises, and what it says at the extremes.

    Shapes, refusals, batches, determinism, gradients against differences over a ladder of steps, corners of the box and
    beyond, long time steps, materials, horizons, precision. Exit code 0 says that it passes, 1 that it fails.
    """
    from .check_report import check as report

    report(
        env,
        fidelity=fidelity,
        device=device,
        engine=engine,
        settings=set_ or [],
        points=points,
        seed=seed,
        as_json=json_,
    )


@app.command()
def tradeoff(
    env: Annotated[str, typer.Argument(help="The environment; `landscape envs` lists them.")],
    points: Annotated[int, typer.Option(min=2, help="Sobol points at which every fidelity is measured.")] = 64,
    seed: Annotated[int, typer.Option(min=0, help="What the points and the bootstrap begin with.")] = 0,
    ladder: Annotated[
        list[str] | None,
        typer.Option(
            help="What to turn beside the named fidelities, a,b or repeated: dt, resolution, particles, precision, "
            "stiffness, engine, device; by default all that the scene has."
        ),
    ] = None,
    device: Device = "auto",
    engine: Engine = "warp",
    set_: Set = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the study.")
    ] = None,
    json_: Json = False,
    force: Annotated[bool, typer.Option("--force", help="Begin anew where a study exists already.")] = False,
) -> None:
    """Measure accuracy against speed: the same points at a ladder of fidelities, each against the reference.

    Writes tradeoff.png and tradeoff.json, and keeps the latter for --tolerance. Stop it at any moment: the same command
    goes on with the next rung.
    """
    from .tradeoff_report import tradeoff as report

    report(
        env,
        points=points,
        seed=seed,
        device=device,
        engine=engine,
        ladders=ladder or [],
        settings=set_ or [],
        out=out,
        as_json=json_,
        force=force,
    )


@app.command()
def pairs(
    env: Annotated[str, typer.Argument(help="The environment; `landscape envs` lists them.")],
    samples: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Base points, each of 1 + 5 x dim + 28 episodes (fewer below 8 parameters); by default 16, from some "
            "20 parameters on fewer, down to 4.",
        ),
    ] = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    seed: Annotated[int, typer.Option(min=0, help="What the points begin with.")] = 0,
    top: Annotated[int, typer.Option(min=1, help="Pairs to show.")] = 10,
    set_: Set = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the study.")
    ] = None,
    json_: Json = False,
    force: Annotated[bool, typer.Option("--force", help="Begin anew where a study exists already.")] = False,
) -> None:
    """Rank pairs of parameters by sensitivity, ruggedness and misleading gradients: which slices to look at.

    Stop it at any moment: the same command goes on where it stopped.
    """
    from .pairs_report import pairs as report

    report(
        env,
        samples=samples,
        fidelity=fidelity,
        device=device,
        engine=engine,
        seed=seed,
        top=top,
        settings=set_ or [],
        out=out,
        as_json=json_,
        force=force,
    )


@app.command("report")
def report_(
    what: Annotated[
        str | None,
        typer.Argument(metavar="[SLICE|ENV]", help="A slice's folder, or an environment: its figures, else one slice."),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Every figure of the gallery that is sampled.")] = False,
    fidelity: Fidelity = None,
    device: Device = "auto",
    points: Annotated[
        int, typer.Option(min=2, help="Points along each axis where gradients are tested by new evaluations.")
    ] = 6,
    seed: Annotated[int, typer.Option(min=0, help="What random numbers begin with.")] = 0,
    data: Annotated[
        str | None, typer.Option(help="Folder of the figures' slices; by default the gallery's own.")
    ] = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the report.")
    ] = None,
    json_: Json = False,
) -> None:
    """Say what a landscape is like: minima, flatness, jumps, correlation, gradient quality, and the verdict.

    Writes report.json, measures.json and gradient-quality.png. Stop it at any moment: finished slices are kept. With
    --all a slice that fails is named at the end, and exit code is 1. docs/measures.md says what each number means.
    """
    from .measure_report import report

    report(
        what,
        everything=everything,
        fidelity=fidelity,
        device=device,
        points=points,
        seed=seed,
        data=data,
        out=out,
        as_json=json_,
    )


gallery = typer.Typer(help="Sample the paper's figures and ours, and build a site that shows them offline.")
app.add_typer(gallery, name="gallery", no_args_is_help=True)
Data = Annotated[str | None, typer.Option(help="Folder of the figures' slices; by default the gallery's own.")]


@gallery.command("compute")
def gallery_compute(
    only: Annotated[
        list[str] | None, typer.Option(help="A figure's id or an environment; may be repeated. By default all.")
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="slices, sweeps, episodes, searches, reports or tradeoffs; may be repeated. By default all of them."
        ),
    ] = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    resolution: Annotated[int | None, typer.Option(min=2, help="Points along each axis, for all figures.")] = None,
    scheduler: Scheduler = None,
    data: Data = None,
) -> None:
    """Make what is missing of the figures: an estimate first, then one after the other.

    Slices have the figures' fidelity, and so have episodes at some of their nodes; sweeps and searches are drafts.

    Stop it at any moment: the same command goes on where it stopped. A figure that fails does not stop the others.
    """
    from .gallery_report import compute

    compute(
        only=only or [],
        parts=part or [],
        fidelity=fidelity,
        device=device,
        resolution=resolution,
        data=data,
        scheduler=scheduler,
    )


@gallery.command("list")
def gallery_list(data: Data = None, json_: Json = False) -> None:
    """List the figures, and how much of each is there."""
    from .gallery_report import list_figures

    list_figures(data=data, as_json=json_)


@gallery.command("build")
def gallery_build(
    data: Data = None, out: Annotated[str, typer.Option(help="Folder of the site.")] = "out/gallery"
) -> None:
    """Build the site from what is there, without simulating; it opens from its index.html, offline."""
    from .gallery_report import build

    build(data=data, out=out)


@gallery.command("serve")
def gallery_serve(
    out: Annotated[str, typer.Option(help="Folder of the site.")] = "out/gallery",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of this machine; 0 takes a free one.")] = 8000,
) -> None:
    """Serve the site to a browser of this machine, until Ctrl-C."""
    from .gallery_report import serve

    serve(out=out, port=port)


def main(arguments: list[str] | None = None) -> Any:
    """Run the command; bad input ends with one line on standard error and exit code 2."""
    from typer.exceptions import TyperException

    try:
        code = app(args=arguments, standalone_mode=False)
        if code == 130:  # what typer makes of Ctrl-C where a verb has not said what is kept
            raise KeyboardInterrupt
    except TyperException as error:
        code = _fail(error.format_message(), 2)
    except ValueError as error:
        code = _fail(str(error), 2)
    except OSError as error:
        code = _fail(str(error), 1)
    except (KeyboardInterrupt, typer.Abort):
        code = _fail("stopped before anything was computed; the same command begins again", 130)
    sys.exit(code)


def _fail(message: str, code: int) -> int:
    typer.echo(f"landscape: {' '.join(message.split())}", err=True)
    return code
