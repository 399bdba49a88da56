"""Which simulator a public function is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from ..envs.records import hidden_layers
from ..envs.registry import refuse_unknown
from ..jobs.scene import SceneSpec
from .call import current
from .options import Scene, SceneKeywords
from .values import as_settings

if TYPE_CHECKING:
    from ..envs.base import Environment

OWN = {*SceneSpec.__dataclass_fields__, "preset", "self", "what"}  # names that no option of a scene may have


def spec_of(scene: Scene, keywords: SceneKeywords, *, dims: Sequence[int | str] | None = None) -> SceneSpec:
    """Return the spec of whatever names or is a simulator.

    Raises ValueError for what is none, and for words that it cannot have, before what simulates is imported. The
    parameters `dims` are numbered as the scene's class has them; its options may change that.
    """
    named = cast("dict[str, Any]", dict(keywords))
    preset = named.pop("preset", None)
    if "options" in named:
        named["options"] = as_settings(named["options"])
        if taken := OWN & set(named["options"]):
            name = min(taken)
            raise ValueError(
                f"--set takes options of the environment; {name} is not one, so use --{name} if the verb has it"
            )
    if policy := named.get("policy"):
        hidden_layers(policy)
    if isinstance(scene, SceneSpec):
        return _with_preset(replace(scene, **named), preset)
    if not isinstance(scene, str):
        from ..envs.registry import find_environment

        return _with_preset(SceneSpec(find_environment(scene), **named), preset)
    spec = SceneSpec(scene, **named)
    if scene:
        words = [str(dim) for dim in dims or ()] if not (spec.options or preset or spec.policy) else []
        refuse_unknown(scene, fidelity=spec.fidelity, device=spec.device, engine=spec.engine, dims=words)
        if spec.tolerance is not None:
            from ..jobs.scene import tolerance_of

            tolerance_of(spec)
        spec = _with_preset(spec, preset)
    return spec


def _with_preset(spec: SceneSpec, preset: str | None) -> SceneSpec:
    """Return the spec with the options of a preset, too. Raises ValueError where the scene has none of that name."""
    if preset is None:
        return spec
    return replace(spec, options={**spec.kind.preset_options(preset), **spec.options})


def environment(scene: Scene, keywords: SceneKeywords, *, dims: Sequence[int | str] | None = None) -> Environment:
    """Return the environment that is meant, with these keywords. Raises ValueError for what it does not have."""
    return spec_of(scene, keywords, dims=dims).make(current().watch)


def is_in_memory(env: Environment, out: object) -> bool:
    """Say whether a slice or a run is kept only in memory: for your own function, without a folder.

    In a notebook such functions change from one call to the next, and the folder of the earlier function would refuse
    the new one.
    """
    return out is None and not env.model_version and not current().on_disk
