"""`gs.tradeoff`: accuracy against speed, by one of several ladders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack, overload

from ..jobs.scene import SceneSpec
from .progress import default_watch
from .scene import SceneKeywords, say_call, spec_of

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.measures.convergence_record import Convergence
    from ..landscapes.measures.tradeoff import Tradeoff

    Scene = str | type[Environment] | Environment | SceneSpec


@overload
def tradeoff(
    scene: Scene,
    *,
    ladder: Literal["fidelity"] = "fidelity",
    points: int = 64,
    seed: int = 0,
    variants: Sequence[str] = (),
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Tradeoff: ...


@overload
def tradeoff(
    scene: Scene,
    *,
    ladder: Literal["convergence"],
    points: int = 64,
    seed: int = 0,
    variants: Sequence[str] = (),
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Convergence: ...


@overload
def tradeoff(
    scene: Scene,
    *,
    ladder: str,
    points: int = 64,
    seed: int = 0,
    variants: Sequence[str] = (),
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Any: ...


def tradeoff(
    scene: Scene,
    *,
    ladder: str = "fidelity",
    points: int = 64,
    seed: int = 0,
    variants: Sequence[str] = (),
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Any:
    """Measure accuracy against speed: the same points in several variants of a scene, each against the reference.

    `ladder` says what varies. "fidelity": the scene's fidelities, and what `variants` names of dt, resolution,
    particles, precision, stiffness, engine, device, by default all that the scene has; its own fidelity does not
    matter, its last one is the reference, and what is found is also kept for `tolerance`.

    "convergence": every knob of the reference refined, or those that `variants` names of dt, resolution, particles,
    joint, precision, to see whether the reference is one; 16 points are enough.

    The study lies in `out`, by default a folder under out/ named after it: the same call goes on there. The record has
    a `table()` and a `plot()`, a trade-off of fidelities also its `front`.

    Raises ValueError for another ladder, for variants of one that has none, and where there is nothing to hold against
    the reference; StoreMismatchError where the folder holds another study, which `force` replaces; Stopped where it is
    interrupted.
    """
    from ..jobs.variants import refuse_ladder

    refuse_ladder(ladder, LADDERS, variants)
    chosen: dict[str, Any] = {"ladder": ladder} if ladder != "fidelity" else {}
    chosen |= {"variants": tuple(variants)} if variants or not chosen else {}
    command = say_call("tradeoff", scene, points=points, seed=seed, **chosen, **keywords)
    how = {"points": points, "seed": seed, "out": Path(out) if out else None, "force": force, "command": command}
    return LADDERS[ladder](spec_of(scene, keywords), variants, how)


def _fidelity(spec: SceneSpec, variants: Sequence[str], how: dict[str, Any]) -> Tradeoff:
    from ..jobs.tolerance import keep
    from ..jobs.tradeoff import TradeoffJob

    found = TradeoffJob.open(spec, settings=variants, **how).run(default_watch())
    keep(found)
    return found


def _convergence(spec: SceneSpec, variants: Sequence[str], how: dict[str, Any]) -> Convergence:
    from ..jobs.convergence import ConvergenceJob
    from ..jobs.tolerance import keep_convergence

    found = ConvergenceJob.open(spec, settings=variants, **how).run(default_watch())
    keep_convergence(found)
    return found


LADDERS: dict[str, Callable[[SceneSpec, Sequence[str], dict[str, Any]], Any]] = {
    "fidelity": _fidelity,
    "convergence": _convergence,
}
