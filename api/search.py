"""`gs.optimize`, `gs.race` and `gs.open_run`: search a scene by one method or by several, and open what was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from ..jobs.watch import Watch
from .progress import default_watch
from .scene import Scene, SceneKeywords, environment, is_in_memory, say_call

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..optim.base import Optimizer
    from ..optim.race import Race
    from ..optim.runs.run import Run


def optimize(
    scene: Scene,
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
    where it stopped, and a larger budget goes on from its end. A function is searched in memory without `out`.

    Raises ValueError for what the scene or the method does not have, and where the folder holds something else or
    another run, which `force` replaces; Stopped where it is interrupted.
    """
    watch = default_watch()
    env = environment(scene, keywords, watch)
    from ..jobs.search import SearchJob, make_optimizer

    optimizer = make_optimizer(method, env, seed=seed, options=method_options)
    if is_in_memory(env, out):
        return _search_in_memory(env, optimizer, budget, watch)
    command = say_call("optimize", scene, method, budget=budget, seed=seed, **keywords)
    job = SearchJob.of(
        env, optimizer, budget=budget, command=command, out=Path(out) if out is not None else None, force=force
    )
    job.run(watch)
    return job.result()


def race(
    scene: Scene,
    methods: str | Sequence[str] = (),
    *,
    budget: int = 1000,
    seeds: int = 10,
    method_options: Mapping[str, Mapping[str, Any]] | None = None,
    workers: int = 1,
    best_known: float | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Race:
    """Let methods compete on an environment, with the same budget and several seeds each, and return the race.

    `methods` are by default all that can search it here, `method_options` are given by method. Targets go down to the
    least loss of the race, or to `best_known`, where less is known from elsewhere. All runs go on in lockstep: what
    they propose is simulated in one batch. Gaussian processes are computed by as many processes as
    `workers` says; more than one needs a script whose own work stands under `if __name__ == "__main__":`. The race lies
    in the folder `out`, by default one under out/ named after it: the same call goes on there where it stopped, and so
    do more methods, seeds or episodes.

    Raises ValueError for what the scene or a method does not have, and where the folder holds something else or other
    runs, which `force` replaces; Stopped where it is interrupted.
    """
    watch, named = default_watch(), [methods] if isinstance(methods, str) else list(methods)
    env = environment(scene, keywords, watch)
    from ..jobs.race import RaceJob

    return RaceJob.of(
        env,
        named,
        budget=budget,
        seeds=seeds,
        command=say_call("race", scene, named, budget=budget, seeds=seeds, **keywords),
        options=method_options,
        workers=workers,
        best_known=best_known,
        out=Path(out) if out is not None else None,
        force=force,
        watch=watch,
    ).run(watch).race  # fmt: skip


def open_run(path: str | Path) -> Run:
    """Open a run from its folder, with the episodes that are there, finished or not.

    Raises ValueError where there is no run, and where it is damaged.
    """
    from ..jobs.folder import RUN_STORE, store_in
    from ..optim.runs.store import RunStore

    return RunStore.open(store_in(Path(path), RUN_STORE)).read()


def _search_in_memory(env: Environment, optimizer: Optimizer, budget: int, watch: Watch) -> Run:
    """Search without keeping the run on disk."""
    from ..landscapes.threads import one_torch_thread
    from ..optim.search import search

    with one_torch_thread(), watch.progress(budget) as advance:
        store = search(env, optimizer, budget=budget, progress=lambda now: advance(now.done))
    return store.read()
