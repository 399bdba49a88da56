"""`gs.tradeoff`: accuracy against speed, by one of several ladders."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack, overload

from .progress import default_watch
from .scene import Scene, SceneKeywords, say_call, spec_of

if TYPE_CHECKING:
    from ..jobs.scene import SceneSpec
    from ..landscapes.measures.convergence_record import Convergence
    from ..landscapes.measures.mixed import MixedTradeoff
    from ..landscapes.measures.model import ModelStudy
    from ..landscapes.measures.tradeoff import Tradeoff


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
    ladder: Literal["model"],
    points: int = 64,
    seed: int = 0,
    variants: Sequence[str] = (),
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> ModelStudy: ...


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
    ladder: Literal["mixed"],
    points: int = 64,
    seed: int = 0,
    variants: Sequence[str] = (),
    limits: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> MixedTradeoff: ...


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
    limits: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Any:
    """Measure accuracy against speed: the same points in several variants of a scene, each against the reference.

    `ladder` says what varies. "fidelity": the scene's fidelities, and what `variants` names of dt, resolution,
    particles, precision, stiffness, engine, device, by default all that the scene has; its own fidelity does not
    matter, its last one is the reference, and what is found is also kept for `tolerance`. "model": the parts of the
    scene's model, each left out, or put in where it is missing; the reference is the full model at the scene's own
    fidelity.

    "convergence": every knob of the reference refined, or those that `variants` names of dt, resolution, particles,
    joint, precision, to see whether the reference is one; 16 points are enough.

    "mixed": all settings together, in a search for what draft and standard should be; `limits` are its `at_most`, how
    many times today's cost a variant may cost (4), its `budget`, how long it may measure [s] (600), and `chaotic`,
    whether gradients are no criterion; what is found is kept for `tolerance`, too, and the record has `choices` and the
    `lines` of Python that write them down.

    The study lies in `out`, by default a folder under out/ named after it: the same call goes on there. The record has
    a `table()` and a `plot()`, a trade-off of fidelities also its `front`.

    Raises ValueError for another ladder, for variants of one that has none, and where there is nothing to hold against
    the reference; StoreMismatchError where the folder holds another study, which `force` replaces; Stopped where it is
    interrupted.
    """
    from ..jobs.variants import refuse_ladder

    refuse_ladder(ladder, LADDERS, variants)
    if limits and ladder != "mixed":
        raise ValueError(f"limits go with the ladder mixed; got them with {ladder}, leave them out")
    chosen: dict[str, Any] = {"ladder": ladder} if ladder != "fidelity" else {}
    chosen |= {"variants": tuple(variants)} if variants or not chosen else {}
    chosen |= {"limits": dict(limits)} if limits else {}
    command = say_call("tradeoff", scene, points=points, seed=seed, **chosen, **keywords)
    how = {
        "points": points,
        "seed": seed,
        "out": Path(out) if out else None,
        "force": force,
        "command": command,
        **(limits or {}),
    }
    return LADDERS[ladder](spec_of(scene, keywords), variants, how)


def _fidelity(spec: SceneSpec, variants: Sequence[str], how: dict[str, Any]) -> Tradeoff:
    from ..jobs.tolerance import keep
    from ..jobs.tradeoff import TradeoffJob

    found = TradeoffJob.open(spec, settings=variants, **how).run(default_watch())
    keep(found)
    return found


def _model(spec: SceneSpec, variants: Sequence[str], how: dict[str, Any]) -> ModelStudy:
    from ..jobs.model import ModelJob

    return ModelJob.open(spec, **how).run(default_watch())


def _convergence(spec: SceneSpec, variants: Sequence[str], how: dict[str, Any]) -> Convergence:
    from ..jobs.convergence import ConvergenceJob
    from ..jobs.tolerance import keep_convergence

    found = ConvergenceJob.open(spec, settings=variants, **how).run(default_watch())
    keep_convergence(found)
    return found


def _mixed(spec: SceneSpec, variants: Sequence[str], how: dict[str, Any]) -> MixedTradeoff:
    from ..jobs.mixed import MixedJob
    from ..jobs.tolerance import keep

    found = MixedJob.open(spec, **how).run(default_watch())
    keep(found.tradeoff)
    return found


LADDERS: dict[str, Callable[[SceneSpec, Sequence[str], dict[str, Any]], Any]] = {
    "fidelity": _fidelity,
    "model": _model,
    "convergence": _convergence,
    "mixed": _mixed,
}
