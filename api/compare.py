"""`gs.compare`: hold two slices of one plane against each other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from .progress import default_watch
from .scene import Scene, SceneKeywords, environment, say_call
from .slice import open_slice

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from ..landscapes.measures.slice_comparison_record import SliceComparison
    from ..landscapes.slice import Slice


def compare(
    a: str | Path | Slice,
    b: str | Path | Slice | Scene,
    *,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> SliceComparison:
    """Hold the slice `b` against the slice `a`: losses, their order, gradients, and where they part.

    Slices are folders, or what `gradscape.slice` returns, that lie on one plane: of any two fidelities, engines,
    options, versions or environments that have the same parameters and unit of the loss. In the place of `b` there may
    be an environment, by its name or itself, or anyone's objective: it is sampled where `a` is, as the `keywords` say,
    in a folder of the comparison's; the same call goes on there. The files lie in the folder `out`, by default one
    under out/ named after both.

    Raises ValueError for slices that cannot be compared, for what the scene does not have, and where the folder holds
    something else or another comparison, which `force` replaces; Stopped where it is interrupted.
    """
    from ..jobs.compare import CompareJob

    watch = default_watch()
    first = _slice(a)
    job = CompareJob.of(
        first,
        _second(b, keywords, watch),
        command=say_call("compare", _said(a), _said(b), **keywords),
        out=Path(out) if out is not None else None,
        force=force,
    )
    return job.run(watch)


def _said(given: str | Path | Slice | Scene) -> str:
    """Return what stands for a slice or a scene in a call."""
    from ..jobs.scene import SceneSpec
    from ..landscapes.slice import Slice

    named = given.name if isinstance(given, SceneSpec) else given
    if isinstance(named, Slice):
        return str(named.folder or named.identity["objective"])
    if isinstance(named, type):
        return named.__name__
    return str(named) if isinstance(named, str | Path) else str(getattr(named, "name", type(named).__name__))


def _slice(given: str | Path | Slice) -> Slice:
    return open_slice(given) if isinstance(given, str | Path) else given


def _second(given: str | Path | Slice | Scene, keywords: SceneKeywords, watch: Watch) -> Slice | Environment:
    """Return a slice that is there, and else the objective to sample. Raises ValueError for keywords beside a slice."""
    from ..landscapes.slice import Slice

    if not (isinstance(given, Slice | Path) or (isinstance(given, str) and Path(given).exists())):
        return environment(given, keywords, watch)
    if keywords:
        raise ValueError(f"{', '.join(keywords)} are of an environment to sample; b is a slice that is there already")
    return _slice(given)
