"""How a function of the front door is told which scene to simulate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypedDict, TypeGuard

from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch
from ..landscapes.objective import name_of

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment, Fidelity
    from ..landscapes.objective import Objective


class SceneKeywords(TypedDict, total=False):
    """The keywords that every function takes which simulates a scene: those of `SceneSpec`, with its defaults."""

    fidelity: str | Fidelity | None
    tolerance: str | None
    device: str
    engine: str
    deterministic: bool
    options: Mapping[str, Any]


def spec_of(scene: str | type[Environment] | Environment | SceneSpec, keywords: SceneKeywords) -> SceneSpec:
    """Return the spec of a name, a class, an environment, or of itself; raises ValueError as `objective_of` does."""
    if isinstance(scene, str | type | SceneSpec):
        return replace(scene if isinstance(scene, SceneSpec) else SceneSpec(scene), **keywords)
    return SceneSpec.of(environment(scene, keywords, Watch()))


def objective_of(
    scene: str | type[Environment] | Objective | SceneSpec, keywords: SceneKeywords, watch: Watch
) -> Objective:
    """Return the environment of a name, a class or a spec; any objective is itself.

    Raises ValueError for a name that is not registered, for what the scene does not have, and for keywords beside an
    objective, which is made already.
    """
    if isinstance(scene, str | type | SceneSpec):
        return spec_of(scene, keywords).make(watch)
    if keywords:
        raise ValueError(f"{name_of(scene)} is made already; got {', '.join(keywords)} too, so make it with them")
    return scene


def environment(
    scene: str | type[Environment] | Environment | SceneSpec, keywords: SceneKeywords, watch: Watch
) -> Environment:
    """Return the environment of a name, a class, a spec, or of itself; raises ValueError as `objective_of` does."""
    found = objective_of(scene, keywords, watch)
    if not is_environment(found):
        raise ValueError(
            f"an environment is wanted; got the objective {name_of(found)}, so derive one from Environment"
        )
    return found


def is_environment(objective: Objective) -> TypeGuard[Environment]:
    """Whether an objective is an environment: it knows its fidelity, its options and its version."""
    from ..envs.base import Environment

    return isinstance(objective, Environment)


def say_cut(
    along: str | None, through: str | Tensor, extent: float | tuple[float, float] | None, *, gradients: bool | int
) -> dict[str, Any]:
    """Return what `say_call` is told of where a slice goes and whether it has gradients; None where it need not be."""
    point = through if isinstance(through, str) else through.tolist()
    where = {"along": along, "through": None if point == "center" else point, "extent": extent}
    return {**where, "gradients": None if gradients is True or gradients == 1 else gradients or False}


def say_call(function: str, scene: object, *given: object, **named: object) -> str:
    """Return a call of the front door as one writes it, to be kept with what it makes; of the scene its name."""
    name = scene.name if isinstance(scene, SceneSpec) else scene
    said = repr(name) if isinstance(name, str) else str(getattr(name, "name", name))
    words = [said, *map(repr, given), *(f"{key}={value!r}" for key, value in named.items() if value is not None)]
    return f"gradscape.{function}({', '.join(words)})"
