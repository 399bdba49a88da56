"""`gs.optimize`, `gs.race` and `gs.open_run`: search a scene by one method or by several, and open what was found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch
from .progress import default_watch
from .scene import SceneKeywords, environment

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.race import RaceSummary
    from ..jobs.search import SearchSummary
    from ..optim.claims import Claims
    from ..optim.race import Race
    from ..optim.runs.run import Run


def optimize(
    scene: str | type[Environment] | Environment | SceneSpec,
    method: str,
    *,
    budget: int = 1000,
    seed: int = 0,
    method_options: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Run:
    """Search a scene's parameters for the least loss by a method, and return the run.

    `budget` episodes are evaluated, not one more; `seed` decides the method's random numbers, and `method_options` are
    its own. The run lies in the folder `out`, by default one under out/ named after it: the same call goes on there
    where it stopped, and a larger budget goes on from its end.

    Raises ValueError for what the scene or the method does not have, and where the folder holds something else or
    another run, which `force` replaces; Stopped where it is interrupted.
    """
    return search_scene(
        scene, method, budget=budget, seed=seed, method_options=method_options, out=Path(out) if out else None,
        force=force, command=f"gradscape.optimize({scene!r}, {method!r}, budget={budget}, seed={seed})",
        watch=default_watch(), keywords=keywords,
    )[0]  # fmt: skip


def race(
    scene: str | type[Environment] | Environment | SceneSpec,
    methods: str | Sequence[str] = (),
    *,
    budget: int = 1000,
    seeds: int = 10,
    method_options: Mapping[str, Mapping[str, Any]] | None = None,
    workers: int = 1,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Race:
    """Let methods compete on a scene with the same budget of episodes, with several seeds each, and return the race.

    `methods` are by default all that can search the scene here, `method_options` are given by method. `workers` runs
    are filled at a time, each in a thread. The race lies in the folder `out`, by default one under out/ named after it:
    the same call goes on there where it stopped, and so do more methods, seeds or episodes.

    Raises ValueError for what the scene or a method does not have, and where the folder holds something else or other
    runs, which `force` replaces; Stopped where it is interrupted.
    """
    named = [methods] if isinstance(methods, str) else list(methods)
    return race_scene(
        scene, named, budget=budget, seeds=seeds, method_options=method_options or {}, workers=workers,
        out=Path(out) if out else None, force=force, watch=default_watch(), keywords=keywords,
        command=f"gradscape.race({scene!r}, {named}, budget={budget}, seeds={seeds})",
    ).race  # fmt: skip


def open_run(path: str | Path) -> Run:
    """Open a run from its folder, with the episodes that are there, finished or not.

    Raises ValueError where there is no run, and where it is damaged.
    """
    from ..jobs.folder import RUN_STORE, store_in
    from ..optim.runs.store import RunStore

    return RunStore.open(store_in(Path(path), RUN_STORE)).read()


def search_scene(
    scene: str | type[Environment] | Environment | SceneSpec,
    method: str,
    *,
    budget: int,
    seed: int,
    method_options: Mapping[str, Any] | None,
    out: Path | None,
    force: bool,
    command: str,
    watch: Watch,
    prints: Sequence[float] = (),
    keywords: SceneKeywords | None = None,
) -> tuple[Run, SearchSummary]:
    """Search as `optimize` does, and return the run with its summary; what more there is belongs to the command."""
    from ..landscapes.space import whole

    budget = whole(budget, "a budget", least=1)
    env = environment(scene, keywords or {}, watch)
    from ..jobs.search import SearchJob, make_optimizer

    optimizer = make_optimizer(method, env, seed=seed, options=method_options)
    job = SearchJob.of(env, optimizer, budget=budget, command=command, out=out, force=force, prints=prints)
    summary = job.run(watch)
    return job.result(), summary


def race_scene(
    scene: str | type[Environment] | Environment | SceneSpec,
    methods: Sequence[str],
    *,
    budget: int,
    seeds: int,
    method_options: Mapping[str, Mapping[str, Any]],
    workers: int,
    out: Path | None,
    force: bool,
    command: str,
    watch: Watch,
    scheduler: str | None = None,
    claims_about: Callable[[str], Claims] | None = None,
    prints: Sequence[float] = (),
    keywords: SceneKeywords | None = None,
) -> RaceSummary:
    """Race as `race` does, and return what came out; what more there is belongs to the command.

    `claims_about` returns what is claimed of an environment, by its name, to be held against the race.
    """
    from ..jobs.race import RaceJob, able_methods, check_methods, check_threads
    from ..jobs.workers import workers as cluster
    from ..landscapes.space import whole

    chosen, seeds = check_methods(methods), whole(seeds, "a number of seeds", least=1)
    budget, workers = whole(budget, "a budget", least=1), whole(workers, "a number of workers", least=1)
    env = environment(scene, keywords or {}, watch)
    check_threads(env, workers)
    if workers > 1 and scheduler:
        raise ValueError(f"--scheduler has workers of its own, so --workers is 1; got {workers}")
    chosen = chosen or able_methods(env, watch)
    with watch.busy(f"opening {len(chosen) * seeds} runs"):
        job = RaceJob.of(
            env, chosen, budget=budget, seeds=seeds, command=command, options=method_options, workers=workers, out=out,
            claims=claims_about(env.name) if claims_about else None, force=force, prints=prints,
        )  # fmt: skip
    with cluster(scheduler, env.device) as executor:
        return replace(job, executor=executor).run(watch)
