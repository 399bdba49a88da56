"""How a function of the front door is told which scene to simulate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypedDict

from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment, Fidelity

Scene = Any
"""What every function takes for a simulator: the name of a scene, FILE.py:NAME, an environment (`gs.from_torch` and
its like make one of a function) or its class, a `SceneSpec`, or an object of one's own with `space` and `evaluate`."""


class SceneKeywords(TypedDict, total=False):
    """The keywords that every function takes which simulates a scene: those of `SceneSpec`, with its defaults."""

    fidelity: str | Fidelity | None
    tolerance: str | None
    device: str
    engine: str
    deterministic: bool
    options: Mapping[str, Any]


def spec_of(scene: Scene, keywords: SceneKeywords) -> SceneSpec:
    """Return the spec of whatever names or is a simulator. Raises ValueError for what is none."""
    if isinstance(scene, SceneSpec):
        return replace(scene, **keywords)
    if not isinstance(scene, str):
        from ..envs.registry import find_environment

        scene = find_environment(scene)
    return SceneSpec(scene, **keywords)


def environment(scene: Scene, keywords: SceneKeywords, watch: Watch) -> Environment:
    """Return the environment that is meant, with these keywords. Raises ValueError for what it does not have."""
    return spec_of(scene, keywords).make(watch)


def is_in_memory(env: Environment, out: object) -> bool:
    """Say whether a slice or a run is kept in memory alone: that of a function which is given no folder.

    Functions change from one call to the next, as in a notebook; a folder of results that do not fit would be refused.
    """
    return out is None and not env.model_version


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
