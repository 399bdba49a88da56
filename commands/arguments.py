"""Options that several verbs have."""

from __future__ import annotations

from typing import Annotated

import typer

Env = Annotated[
    str,
    typer.Argument(
        metavar="ENV", help="The environment: one that `landscape envs` lists, or a class in a file, FILE.py:Class."
    ),
]
Of = Annotated[
    str | None,
    typer.Option("--env", help="Where the slice's environment is, if it is a class in a file: FILE.py:Class."),
]
Dims = Annotated[
    list[str],
    typer.Option("--dims", metavar="DIM [DIM]", help="The one or two parameters to vary, by number or by name."),
]
Resolution = Annotated[int, typer.Option(min=2, help="Points along each axis.")]
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
OutOfStudy = Annotated[
    str | None, typer.Option("--out", help="Folder for the results; by default one under out/ named after the study.")
]
ForceStudy = Annotated[bool, typer.Option("--force", help="Begin anew where a study exists already.")]
Extent = Annotated[
    str | None,
    typer.Option(help="What to cover: a fraction of the box around the point, or LOW:HIGH; the whole box by default."),
]
Through = Annotated[
    str,
    typer.Option(help="The point it goes through: center, random:SEED, example:NAME, best:RUN or a file of numbers."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Dask workers to compute on: the address of a scheduler, or local:N for N of them here; local alone has "
        "one per GPU, or per core."
    ),
]
NoGradients = Annotated[bool, typer.Option("--no-gradients", help="Sample losses only.")]
Print = Annotated[
    list[float] | None,
    typer.Option(
        "--print",
        metavar="MM",
        min=80,
        max=400,
        help="Also write the picture for print, as PDF and SVG, this wide [mm]: 85 for a column, 170 for a page; may "
        "be repeated.",
    ),
]
Data = Annotated[
    str | None,
    typer.Option(help="Folder of the figures' data; by default a checkout's own, or else out/gallery-data."),
]
