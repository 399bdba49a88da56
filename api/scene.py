"""How a function of the front door is told which scene to simulate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypedDict

from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch

if TYPE_CHECKING:
    from ..envs.base import Environment, Fidelity


class SceneKeywords(TypedDict, total=False):
    """The keywords that every function takes which simulates a scene: those of `SceneSpec`, with its defaults."""

    fidelity: str | Fidelity | None
    tolerance: str | None
    device: str
    engine: str
    deterministic: bool
    options: Mapping[str, Any]


def spec_of(scene: str | type[Environment] | Environment | SceneSpec, keywords: SceneKeywords) -> SceneSpec:
    """Return the spec of a name, a class, an environment, or of itself; raises ValueError as `environment` does."""
    from ..envs.base import Environment

    if isinstance(scene, Environment):
        return SceneSpec.of(_refuse_keywords(scene, keywords))
    return replace(scene if isinstance(scene, SceneSpec) else SceneSpec(scene), **keywords)


def environment(
    scene: str | type[Environment] | Environment | SceneSpec, keywords: SceneKeywords, watch: Watch
) -> Environment:
    """Return the environment of a name, a class, a spec, or of itself.

    Raises ValueError for a name that is not registered, for what the scene does not have, and for keywords beside an
    environment, which is made already.
    """
    from ..envs.base import Environment

    if isinstance(scene, Environment):
        return _refuse_keywords(scene, keywords)
    return spec_of(scene, keywords).make(watch)


def _refuse_keywords(env: Environment, keywords: SceneKeywords) -> Environment:
    if keywords:
        raise ValueError(f"{env.name} is made already; got {', '.join(keywords)} too, so make it with them")
    return env
