"""`gs.league`: the same methods raced in many scenes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from .progress import default_watch
from .scene import Scene, SceneKeywords, spec_of

if TYPE_CHECKING:
    from ..jobs.scene import SceneSpec
    from ..optim.league import League


def league(
    scenes: Scene | Sequence[Scene] = (),
    methods: str | Sequence[str] = (),
    *,
    budget: int = 1000,
    seeds: int = 10,
    workers: int = 1,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> League:
    """Race the same methods in many scenes, one after another, and return how they came off in each and over all.

    `scenes` are by default all that this package simulates itself; a name may say its fidelity ("fluid@standard").
    `methods` are by default all; those that cannot search a scene are left out there. The league lies in the folder
    `out`, by default one under out/ for all leagues on a device, with a race for each scene: the same call goes on
    there where it stopped, and so do more scenes, methods, seeds or episodes. It has `scenes`, `overall`, a `table()`
    and `plot()`; `failed` says why scenes could not be raced.

    Raises ValueError for scenes, fidelities and methods that there are not, where the folder holds something else, and
    where no scene could be raced; Stopped where it is interrupted.
    """
    from ..jobs.league import LeagueJob, simulated_scenes

    given = [scenes] if not isinstance(scenes, list | tuple) else list(scenes)
    named = [methods] if isinstance(methods, str) else list(methods)
    specs = [_spec(one, keywords) for one in given or simulated_scenes()]
    job = LeagueJob.of(
        specs,
        named,
        budget=budget,
        seeds=seeds,
        command=_say(given, named, budget=budget, seeds=seeds, **keywords),
        out=Path(out) if out is not None else None,
        workers=workers,
        force=force,
    )
    return job.run(default_watch())


def _spec(scene: Any, keywords: SceneKeywords) -> SceneSpec:
    from ..jobs.scene import read_scene

    return read_scene(scene, spec_of("", keywords)) if isinstance(scene, str) else spec_of(scene, keywords)


def _say(scenes: Sequence[Any], methods: Sequence[str], **named: Any) -> str:
    """Return the call as one writes it, of scenes that are no names their names."""
    names = [one if isinstance(one, str) else str(getattr(one, "name", one)) for one in scenes]
    words = [repr(names), repr(list(methods)), *(f"{key}={value!r}" for key, value in named.items())]
    return f"gradscape.league({', '.join(words)})"
