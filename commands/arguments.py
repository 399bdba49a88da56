"""The arguments and options that verbs share, each declared once.

A verb that takes a `scene: SceneSpec` and is decorated with `takes_scene` has the options that make one in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Annotated, Any

import typer

from ..envs.registry import refuse_unknown
from ..jobs.scene import SceneSpec

Env = Annotated[
    str,
    typer.Argument(
        metavar="ENV",
        help="The environment: a name that `landscape envs` lists, or FILE.py:NAME for a simulator in "
        "a file of your own.",
    ),
]
Of = Annotated[
    str | None,
    typer.Option(
        "--env",
        help="The simulator that the slice was sampled from, as FILE.py:NAME, if it is not a registered environment.",
    ),
]
Dims = Annotated[
    list[str],
    typer.Option("--dims", metavar="DIM [DIM]", help="One or two parameters to vary, by number or by name."),
]
SomeDims = Annotated[
    list[str] | None,
    typer.Option(
        "--dims",
        metavar="DIM [DIM]",
        help="One or two parameters to vary, by number or by name. An environment with at most two needs none.",
    ),
]
Along = Annotated[
    str | None,
    typer.Option(
        help="Directions to vary instead of --dims: random:SEED, gradient, hessian, pca:RUN, the line "
        "A:B through two points, or the plane A:B:C through three."
    ),
]
Resolution = Annotated[int, typer.Option(min=2, help="Number of points along each axis.")]
Fidelity = Annotated[
    str | None,
    typer.Option(help="Accuracy of the simulation: draft, standard or reference. The default is the cheapest."),
]
Tolerance = Annotated[
    str | None,
    typer.Option(
        help="Pick the fastest fidelity whose measured loss error is below this: 5% of the spread of "
        "losses, or a number in their unit. `landscape tradeoff` measures the errors."
    ),
]
Device = Annotated[
    str, typer.Option(help="Device to compute on: auto, cpu or cuda. auto takes CUDA if there is a GPU.")
]
Deterministic = Annotated[
    bool, typer.Option("--deterministic", help="Fail if the engine is not reproducible on a GPU.")
]
Seed = Annotated[int, typer.Option(min=0, help="Random seed.")]
Engine = Annotated[
    str | None,
    typer.Option(
        help="Engine that simulates. The default is the first of the environment, usually warp; some "
        "also have taichi, as an independent reference."
    ),
]
Set = Annotated[
    list[str] | None, typer.Option("--set", help="An option of the environment, as name=value. It may be repeated.")
]
Out = Annotated[
    str | None, typer.Option(help="Folder for the results. The default is named after the slice, under out/.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object on standard output.")]
Force = Annotated[bool, typer.Option("--force", help="Replace a slice that exists already.")]
Budget = Annotated[int, typer.Option(min=1, help="Number of episodes to evaluate. It is never exceeded.")]
OutOfRun = Annotated[
    str | None, typer.Option("--out", help="Folder for the results. The default is named after the run, under out/.")
]
ForceRun = Annotated[bool, typer.Option("--force", help="Replace a run that exists already.")]
OutOfStudy = Annotated[
    str | None, typer.Option("--out", help="Folder for the results. The default is named after the study, under out/.")
]
ForceStudy = Annotated[bool, typer.Option("--force", help="Replace a study that exists already.")]
Extent = Annotated[
    str | None,
    typer.Option(
        help="Range to cover: a fraction of the box around the point, or the values LOW:HIGH. The "
        "default is the whole box."
    ),
]
Through = Annotated[
    str,
    typer.Option(
        help="Point that the slice passes through: center, random:SEED, example:NAME, best, best:RUN, "
        "a file of numbers, or a row of a table, TABLE.csv:ROW. Row 1 of a table is its heading; "
        "without ROW it is the row with the lowest loss. slice and sweep take several points, "
        "A,B."
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Compute on Dask workers: the address of a scheduler, or local:N for N workers on this "
        "machine. local alone starts one per GPU, or per core."
    ),
]
Policy = Annotated[
    str | None,
    typer.Option(
        help="Sample over the weights of a neural policy instead of the parameters of the environment:"
        " mlp:32x32 has two hidden layers of 32. It has losses only."
    ),
]
Gradients = Annotated[
    int,
    typer.Option("--gradients", min=1, help="Compute gradients only at every N-th sample per axis."),
]
NoGradients = Annotated[bool, typer.Option("--no-gradients", help="Compute losses without gradients.")]
Refine = Annotated[
    str | None,
    typer.Option(
        metavar="SHARE",
        help="Adaptive sampling: refine until 95 % of the interpolated points are within this fraction"
        " of the loss range, such as 1%.",
    ),
]
RefineBudget = Annotated[
    int | None,
    typer.Option(
        "--budget", min=1, help="Adaptive sampling with at most this many points, alone or together with --refine."
    ),
]
Methods = Annotated[
    list[str] | None,
    typer.Option(
        help="Methods to race, a,b or repeated. The default is all that can run here; `landscape methods` lists them."
    ),
]
Seeds = Annotated[int, typer.Option(min=1, help="Number of runs per method, with seeds 0, 1, ...")]
Processes = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of processes that fit Gaussian processes. The default is one per core; results do not "
        "depend on it.",
    ),
]
MethodOption = Annotated[
    list[str] | None, typer.Option(help="An option of a method, as METHOD.NAME=VALUE. It may be repeated.")
]
Claims = Annotated[bool, typer.Option("--report", help="Check the paper's claims about which method wins.")]
ForceRuns = Annotated[bool, typer.Option("--force", help="Replace runs that exist already.")]
Print = Annotated[
    list[float] | None,
    typer.Option(
        "--print",
        metavar="MM",
        min=80,
        max=400,
        help="Also write the figure for print, as PDF and SVG of this width [mm]: 85 for a column, 170"
        " for a page. It may be repeated.",
    ),
]
Data = Annotated[
    str | None,
    typer.Option(help="Folder with the data of the figures. The default is that of a checkout, else out/gallery-data."),
]

SCENE: dict[str, tuple[Any, Any]] = {
    "env": (Env, Parameter.empty),
    "fidelity": (Fidelity, None),
    "tolerance": (Tolerance, None),
    "device": (Device, "auto"),
    "engine": (Engine, None),
    "deterministic": (Deterministic, False),
    "set_": (Set, None),
}  # the options that make a SceneSpec, with their defaults
OWN = {*SceneSpec.__dataclass_fields__, "self", "what"}  # names that no option of a scene may have


def takes_scene(*without: str, **fixed: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a verb the options of a scene in the place of its parameter `scene`.

    Those it goes `without` have no option; of those that are `fixed` the value is given, as a default where the verb
    has the option.
    """

    def decorate(verb: Callable[..., None]) -> Callable[..., None]:
        options = {
            name: Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind, default=fixed.get(name, default))
            for name, (kind, default) in SCENE.items()
            if name not in without
        }

        @wraps(verb)
        def with_scene(**given: Any) -> None:
            chosen = {name: given.pop(name) for name in options}
            verb(scene=_scene(**{**fixed, **chosen}), **given)

        own = [
            one.replace(kind=Parameter.KEYWORD_ONLY)
            for one in signature(verb, eval_str=True).parameters.values()
            if one.name != "scene"
        ]
        first = [one for name, one in options.items() if name == "env"]
        whole = [*first, *own, *(one for name, one in options.items() if name != "env")]
        with_scene.__signature__ = Signature(whole)  # type: ignore[attr-defined]
        with_scene.__annotations__ = {one.name: one.annotation for one in whole}
        return with_scene

    return decorate


def _scene(*, env: str, set_: Sequence[str] | None = None, **how: Any) -> SceneSpec:
    scene = SceneSpec(env, **how, options=read_settings(set_ or []))
    refuse_words(scene)
    return scene


def refuse_words(scene: SceneSpec, dims: Sequence[str] | None = None, policy: str | None = None) -> None:
    """Raise ValueError for what a scene cannot have, as far as that is known before what simulates is imported.

    Parameters are numbered as its class has them; options of the scene and a `policy` may change that.
    """
    if not isinstance(scene.name, str) or not scene.name:
        return
    numbered = () if scene.options or policy else dims or ()
    refuse_unknown(scene.name, fidelity=scene.fidelity, device=scene.device, engine=scene.engine, dims=numbered)
    if scene.tolerance is not None:
        from ..jobs.tolerance import tolerance_of

        tolerance_of(scene)


def read_settings(settings: Sequence[str], flag: str = "--set") -> dict[str, Any]:
    """Return options given as name=value.

    Raises ValueError where one is not so written, and for names of a scene that are options of the verb's own.
    """
    pairs = [setting.partition("=") for setting in settings]
    for setting, (name, equals, _) in zip(settings, pairs, strict=True):
        if not equals or not name:
            raise ValueError(f"{flag} takes name=value; got {setting!r}")
        if flag == "--set" and name in OWN:
            raise ValueError(f"{flag} takes a scene's own options; {name} is none, and chosen by --{name} if at all")
    return {name: value for name, _, value in pairs}


def read_names(texts: Sequence[str] | None) -> list[str]:
    """Return names given as a,b or repeated."""
    return [name.strip() for text in texts or () for name in text.split(",") if name.strip()]


def read_share(text: str | None, flag: str) -> float | None:
    """Return a share given as 1% or 0.01. Raises ValueError where it is neither."""
    if text is None:
        return None
    try:
        return float(text.strip().removesuffix("%")) / (100 if text.strip().endswith("%") else 1)
    except ValueError:
        raise ValueError(f"{flag} takes a share such as 1% or 0.01; got {text!r}") from None


def read_extent(text: str | None) -> float | tuple[float, float] | None:
    """Return an extent given as a fraction or as LOW:HIGH. Raises ValueError where it is neither."""
    if text is None:
        return None
    low, colon, high = text.partition(":")
    try:
        return (float(low), float(high)) if colon else float(low)
    except ValueError:
        raise ValueError(
            f"--extent takes a fraction or values LOW:HIGH in the parameters' unit; got {text!r}"
        ) from None
