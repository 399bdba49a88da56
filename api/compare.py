"""`gs.compare`: compare two slices of one plane."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from .call import current, verb
from .options import ARGUMENT, FigureWidth, Force, Out, Scene, SceneKeywords
from .scene import environment, spec_of
from .slice import as_slice
from .values import as_path, as_widths

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.measures.slice_comparison import SliceComparison
    from ..landscapes.slice import Slice


@verb
def compare(
    a: Annotated[Any, ARGUMENT],
    b: Annotated[Any, ARGUMENT],
    *,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> SliceComparison:
    """Compare two slices of the same plane: losses, their order, gradients and the largest differences.

    The slices can differ in fidelity, engine, options, version or environment. Environments must have the same
    parameters and the same unit of the loss. The folder then contains compare.json and compare.png, and slice B if it
    was sampled here. Stop at any time: the same command continues from there.

    Raises ValueError if the slices cannot be compared, if the environment does not support a keyword, or if the folder
    contains something else or another comparison. Raises Stopped when it is interrupted.

    Example: landscape compare out/my-slice bounce --fidelity standard

    Parameters
    ----------
    a
        Folder of slice A, or the slice itself.
    b
        Folder of slice B on the same plane, the slice itself, or an environment to sample on that plane with the
        options below.
    """
    if _is_scene(b):
        spec_of(b, keywords)
    first = as_slice(a)
    from ..jobs.compare import CompareJob

    call = current()
    job = CompareJob.of(
        first, _second(b, keywords), command=call.command, out=as_path(out), force=force,
        prints=as_widths(figure_width_mm),
    )  # fmt: skip
    return job.run(call.watch)


def _is_scene(given: str | Path | Slice | Scene) -> bool:
    """Say whether it is something to sample, rather than an existing slice."""
    if isinstance(given, str):
        return not Path(given).exists()
    from ..landscapes.slice import Slice

    return not isinstance(given, Slice | Path)


def _second(given: str | Path | Slice | Scene, keywords: SceneKeywords) -> Slice | Environment:
    """Return a slice that is there, or else the objective to sample; raise ValueError for a slice with keywords."""
    if _is_scene(given):
        return environment(given, keywords)
    if keywords:
        name = given if isinstance(given, str | Path) else "b"
        raise ValueError(
            f"compare takes {', '.join(keywords)} only if B is an environment to sample; {name} is a slice, so leave "
            "them out"
        )
    return as_slice(given)
