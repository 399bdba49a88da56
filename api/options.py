"""The arguments and options that several verbs share, each declared once: its type, its limits and its help.

Types are those of Python. The command line passes text, which the functions of `values` convert.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypedDict

from cyclopts import Parameter
from cyclopts.validators import Number

ARGUMENT = "argument"  # marks what stands on the command line without the name of an option


def at_least(value: float, *, lte: float | None = None) -> Parameter:
    """Limit a number from below, and from above by `lte`."""
    return Parameter(validator=Number(gte=value, lte=lte))


if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Fidelity

    Point: TypeAlias = str | Float[Tensor, " dim"]
    Window: TypeAlias = float | str | tuple[float, float]
    Share: TypeAlias = float | str
    Settings: TypeAlias = Mapping[str, Any] | Sequence[str]
    MethodSettings: TypeAlias = Mapping[str, Mapping[str, Any]] | Sequence[str]
    Names: TypeAlias = str | Sequence[str]
    Dims: TypeAlias = Sequence[int | str]
    Stride: TypeAlias = bool | int | None
    Widths: TypeAlias = float | Sequence[float]
    FidelityName: TypeAlias = str | Fidelity
    Resolution: TypeAlias = int | Sequence[int]
    Parameter_: TypeAlias = int | str
else:
    Point = Share = FidelityName = Parameter_ = str
    Window = Annotated[str, Parameter(allow_leading_hyphen=True)]  # -0.4:0.9
    Names = Settings = MethodSettings = list[str]
    Dims = Annotated[list[str], Parameter(consume_multiple=(1, 2))]
    Stride = int
    Widths = list[float]
    Resolution = int

Scene = Annotated[
    Any,
    ARGUMENT,
    Parameter(
        name="env",
        help="The environment: a name that `landscape envs` lists, or FILE.py:NAME for a simulator in your own file.",
    ),
]
"""A simulator, as every function takes it: the name of a scene, FILE.py:NAME, an environment (`gs.from_torch` and
similar functions make one from a function) or its class, a `SceneSpec`, or any object with `space` and `evaluate`."""

Count = Annotated[int, at_least(1)]
Side = Annotated[Resolution, at_least(2)]
Seed = Annotated[int, at_least(0), Parameter(help="Random seed.")]
Out = Annotated[
    str | Path | None, Parameter(help="Folder for the results. The default is in out/, named after the settings.")
]
Force = Annotated[bool, Parameter(help="Replace the results that are already in the folder.")]
FigureWidth = Annotated[
    Widths,
    Parameter(
        validator=Number(gte=80, lte=400),
        help="Also write the figure for print, as PDF and SVG of this width [mm]: 85 for a column, 170 for a page. "
        "It can be repeated.",
    ),
]
Scheduler = Annotated[
    str | None,
    Parameter(
        help="Compute on Dask workers: the address of a scheduler, or local:N for N workers on this machine. "
        "Without :N, local starts one per GPU, or one per core."
    ),
]
Device = Annotated[str, Parameter(help="Device to compute on: auto, cpu or cuda. auto uses CUDA if there is a GPU.")]
Gradients = Annotated[
    Stride | None,
    Parameter(
        negative_none="no-",
        show_default=False,
        help="Compute gradients only at every N-th sample per axis. --no-gradients computes none.",
    ),
]
Of = Annotated[
    Any,
    Parameter(
        name="--env",
        help="The simulator that the slice was sampled from, as FILE.py:NAME, if it is not a registered environment.",
    ),
]
Data = Annotated[
    str | Path | None,
    Parameter(help="Folder with the data of the figures. The default is the checkout's, or else out/gallery-data."),
]


SceneOptions = Annotated[
    Settings, Parameter(name="--set", help="An option of the environment, as name=value. It can be repeated.")
]


class MadeKeywords(TypedDict, total=False):
    """The keywords by which a scene is made, with the defaults of `SceneSpec`."""

    fidelity: Annotated[
        FidelityName | None,
        Parameter(help="Accuracy of the simulation: draft, standard or reference. The default is the cheapest."),
    ]
    device: Device
    engine: Annotated[
        str | None,
        Parameter(
            help="Simulation engine. The default is the environment's first, usually warp. Some environments also have "
            "taichi, as an independent reference."
        ),
    ]
    preset: Annotated[
        str | None,
        Parameter(
            help="Set several options at once, such as paper for the settings of the paper. `landscape envs NAME` "
            "lists the presets. --set changes single options."
        ),
    ]
    options: SceneOptions
    policy: Annotated[
        str | None,
        Parameter(
            help="Control the environment by a neural policy, whose weights are then the parameters. mlp:32x32 has two "
            "hidden layers of 32. Gradients exist if the environment differentiates its observations, as cartpole does."
        ),
    ]
    remedy: Annotated[
        str | None,
        Parameter(
            help="Remedies to apply to the landscape in this order, such as smooth:2% or smooth:1%:zeroth:32,clip:0.5. "
            "They are smooth, clip, average, rescale, shorten and soften. docs/remedies.md explains them."
        ),
    ]


class SceneKeywords(MadeKeywords, total=False):
    """The keywords of every function that simulates a scene: those of `SceneSpec`, with its defaults."""

    tolerance: Annotated[
        Share | None,
        Parameter(
            help="Pick the fastest fidelity whose measured loss error is below this share of the spread of losses, "
            "such as 5%. `landscape study fidelity` measures the errors."
        ),
    ]
    deterministic: Annotated[bool, Parameter(help="Fail if the engine is not reproducible on a GPU.")]
