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
SomeDims = Annotated[
    list[str] | None,
    typer.Option(
        "--dims",
        metavar="DIM [DIM]",
        help="The one or two parameters to vary, by number or by name; all where there are no more.",
    ),
]
Along = Annotated[
    str | None,
    typer.Option(
        help="Instead of --dims: random:SEED, gradient, hessian, pca:RUN, a line between two points A:B, or the plane "
        "through three, A:B:C."
    ),
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
    bool, typer.Option("--deterministic", help="Refuse an engine whose results on a GPU are not the same every time.")
]
Seed = Annotated[int, typer.Option(min=0, help="Random seed.")]
Engine = Annotated[
    str | None,
    typer.Option(
        help="One of the scene's engines, by default its first: warp, or taichi where a scene has it, the reference to "
        "hold Warp against."
    ),
]
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
    typer.Option(
        help="What to cover: a fraction of the box around the point, or the values LOW:HIGH; the whole box by default."
    ),
]
Through = Annotated[
    str,
    typer.Option(
        help="The point it goes through: center, random:SEED, example:NAME, best, best:RUN, a file of numbers, or a "
        "row of a table, TABLE.csv:ROW (row 1 is its heading), by default the one of the least loss; slice and "
        "sweep take several, "
        "A,B."
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Dask workers to compute on: the address of a scheduler, or local:N for N of them here; local alone has "
        "one per GPU, or per core."
    ),
]
Policy = Annotated[
    str | None,
    typer.Option(
        help="Sample over the weights of a policy instead of the environment's own parameters: mlp:32x32, a perceptron "
        "with two hidden layers of 32 that decides by what it sees. Losses only."
    ),
]
Gradients = Annotated[
    int,
    typer.Option(
        "--gradients", min=1, help="Have gradients at every so many samples along each axis, losses at all of them."
    ),
]
NoGradients = Annotated[bool, typer.Option("--no-gradients", help="Sample losses only.")]
Refine = Annotated[
    str | None,
    typer.Option(
        metavar="SHARE",
        help="Sample only where neighbours and their gradients do not explain what is between them, until 95 % of the "
        "other points are exact to this share of the range of the losses: 1%.",
    ),
]
RefineBudget = Annotated[
    int | None,
    typer.Option("--budget", min=1, help="The same with this many points at most, alone or with --refine."),
]
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

SCENE: dict[str, tuple[Any, Any]] = {
    "env": (Env, Parameter.empty),
    "fidelity": (Fidelity, None),
    "tolerance": (Tolerance, None),
    "device": (Device, "auto"),
    "engine": (Engine, None),
    "deterministic": (Deterministic, False),
    "set_": (Set, None),
}  # the options that make a SceneSpec, with their defaults
OWN = set(SceneSpec.__dataclass_fields__)  # names that no option of a scene may have


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
