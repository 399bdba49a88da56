"""`gs.advise`, `gs.optimize`, `gs.race`, `gs.league`, `gs.open_run`: search scenes by one method or by several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, Unpack

from cyclopts import Parameter

from .call import current, verb
from .options import (
    ARGUMENT,
    Count,
    FigureWidth,
    Force,
    MethodSettings,
    Names,
    Out,
    Scene,
    SceneKeywords,
    Scheduler,
    Seed,
    Settings,
    at_least,
)
from .scene import environment, is_in_memory, spec_of
from .values import as_method_settings, as_names, as_path, as_settings, as_widths

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.advise import Advice
    from ..jobs.scene import SceneSpec
    from ..optim.base import Optimizer
    from ..optim.league import League
    from ..optim.race import Race
    from ..optim.runs.run import Run

    Scenes: TypeAlias = Scene | Sequence[Scene]
else:
    Scenes = list[str]

Methods = Annotated[
    Names,
    Parameter(
        help="Methods to race, as a,b or repeated. `landscape methods` lists them. The default is all that can run."
    ),
]
RunBudget = Annotated[Count, Parameter(help="Number of episodes of each run. It is never exceeded.")]
Seeds = Annotated[Count, Parameter(help="Number of runs per method, with seeds 0, 1, ...")]
Workers = Annotated[
    int | None,
    Parameter(
        name="--workers",
        help="Number of processes that fit Gaussian processes. The default is one per core for the command, and 1 in "
        "Python, where more require a script whose code is under `if __name__ == '__main__':`. Results do not depend "
        "on it.",
    ),
]


@verb
def advise(
    scene: Scene,
    *,
    budget: Annotated[int, at_least(200)] = 1000,
    seed: Seed = 0,
    out: Annotated[str | Path | None, Parameter(help="Folder for the advice. Without it nothing is saved.")] = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> Advice:
    """Advise on the method, remedy and fidelity to start a search with, by evidence from similar landscapes.

    It evaluates 50 points, or a tenth of the budget if that is less, a quarter of them with gradients. It measures over
    which steps gradients are accurate, what fails, and how losses are distributed. It compares this with cases in which
    nine methods were raced: the 24 functions of BBOB, functions of known character, and our scenes. docs/advice.md says
    how often this advice is right. If it has not proved better than one method for everything, it says so and advises
    that method. With --out the folder then contains advice.json.

    Raises ValueError if the environment does not support a keyword, TooLargeError if the budget does not fit this
    machine, and StoreMismatchError if the folder contains other advice. Raises Stopped when it is interrupted.

    Example: landscape advise branin

    Parameters
    ----------
    budget
        Number of episodes planned for the search. The advice uses at most a tenth of them.
    """
    call, folder = current(), as_path(out)
    env = environment(scene, keywords)
    from ..jobs.advise import AdviseJob

    job = AdviseJob.of(env, budget=budget, seed=seed, out=folder, force=force, command=call.command)
    if folder is not None:
        return job.run(call.watch)
    call.watch.plan(job.work())
    return job.compute(call.watch)


@verb
def optimize(
    scene: Scene,
    method: str = "bo-leap",
    *,
    budget: Count = 1000,
    seed: Seed = 0,
    method_options: Annotated[Settings, Parameter(name="--option")] = (),
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> Run:
    """Search for the lowest loss with one method, and save every evaluated point.

    The folder then contains run.zarr (every episode), progress.png and summary.json. Stop at any time: the same command
    continues from there. A larger budget continues the run, and the result is the same as with that budget from the
    start. In Python, your own function is searched in memory unless you give a folder.

    Raises ValueError if the environment or the method does not support a keyword, or if the folder contains something
    else or another run. Raises Stopped when it is interrupted.

    Example: landscape optimize fluid --method bo-leap --budget 300

    Parameters
    ----------
    method
        Method to search with. `landscape methods` lists them. `auto` first measures the landscape with at most a tenth
        of the budget, and then uses the method that `landscape advise` would advise.
    budget
        Number of episodes to evaluate. It is never exceeded.
    method_options
        An option of the method, as name=value. It can be repeated.
    """
    from ..optim.registry import find_method

    find_method(method)  # a name that does not exist is refused before what searches is imported
    options, call = as_settings(method_options, "--option"), current()
    env = environment(scene, keywords)
    from ..jobs.search import SearchJob, make_optimizer

    optimizer = make_optimizer(method, env, seed=seed, options=options)
    if is_in_memory(env, out):
        return _search_in_memory(env, optimizer, budget)
    job = SearchJob.of(
        env, optimizer, budget=budget, command=call.command, out=as_path(out), force=force,
        prints=as_widths(figure_width_mm),
    )  # fmt: skip
    job.run(call.watch)
    return job.result()


@verb
def race(
    scene: Scene,
    methods: Methods = (),
    *,
    budget: RunBudget = 1000,
    seeds: Seeds = 10,
    method_options: Annotated[MethodSettings, Parameter(name="--option")] = (),
    workers: Workers = None,
    scheduler: Scheduler = None,
    best_known: float | None = None,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> Race:
    """Compare methods on the same budget over several seeds: best losses, targets reached and ranks.

    All runs advance in lockstep, and one batch evaluates all their proposals. The folder then contains race.png,
    race.json (ranks, pairwise comparisons, running times, curves) and a folder per run. Stop at any time: the same
    command continues from there. More methods, seeds or episodes also continue from there, and finished runs are not
    repeated. Use either --workers or --scheduler.

    Raises ValueError if the environment or a method does not support a keyword, or if the folder contains something
    else or other runs. Raises Stopped when it is interrupted.

    Example: landscape race fluid --methods random,bo-leap --budget 200 --seeds 3

    Parameters
    ----------
    method_options
        An option of a method, as METHOD.NAME=VALUE. It can be repeated.
    best_known
        Lowest loss known from elsewhere. The targets extend down to it.
    """
    from ..optim.registry import check_methods
    from ..optim.registry import methods as registered

    _check_workers(workers, scheduler)
    call = current()
    chosen = check_methods(as_names(methods))
    options = as_method_settings(method_options, chosen or list(registered()))
    env = environment(scene, keywords)
    from ..gallery.paper import read_paper
    from ..jobs.race import RaceJob
    from ..jobs.workers import workers as cluster

    job = RaceJob.of(
        env, chosen, budget=budget, seeds=seeds, command=call.command, options=options, workers=_processes(workers),
        best_known=best_known, claims=read_paper().claims_about(env.name), out=as_path(out), force=force,
        prints=as_widths(figure_width_mm), watch=call.watch,
    )  # fmt: skip
    with cluster(scheduler, env.device) as executor:
        return replace(job, executor=executor).run(call.watch)


@verb
def league(
    scenes: Annotated[Scenes, ARGUMENT, Parameter(name="env")] = (),
    methods: Methods = (),
    *,
    budget: RunBudget = 1000,
    seeds: Seeds = 10,
    workers: Workers = None,
    scheduler: Scheduler = None,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> League:
    """Race the same methods in many environments, and rank them in each and overall.

    It first says how many episodes of each environment are done and how long the rest will take. The folder then
    contains a race per environment, as from `landscape race`, league.png (mean ranks) and league.json (a row per
    environment and method, and the best points). Stop at any time: the same command continues from there. More
    environments, methods, seeds or episodes also continue from there. If an environment fails, it gives the reason and
    races the others. The exit code is then 1.

    Raises ValueError if a scene, a fidelity or a method does not exist, if the folder contains something else, or if no
    scene could be raced. Raises Stopped when it is interrupted.

    Example: landscape league bounce fluid@standard --methods random,cma-es,bo-leap --budget 200 --seeds 3

    Parameters
    ----------
    scenes
        Environments to race in, as ENV or ENV@FIDELITY. The default is the sixteen scenes of gradscape.
    """
    from ..optim.registry import check_methods

    _check_workers(workers, scheduler)
    call, named = current(), as_names(methods)
    check_methods(named)
    given = list(scenes) if isinstance(scenes, list | tuple) else [scenes]
    specs = [_league_spec(one, keywords) for one in given]
    from ..gallery.paper import read_paper
    from ..jobs.league import LeagueJob, simulated_scenes
    from ..jobs.workers import workers as cluster

    specs = specs or [_league_spec(one, keywords) for one in simulated_scenes()]
    job = LeagueJob.of(
        specs, named, budget=budget, seeds=seeds, command=call.command, out=as_path(out), force=force,
        prints=as_widths(figure_width_mm),
    )  # fmt: skip
    claims = {scene.name: read_paper().claims_about(scene.name) for scene in job.scenes}
    with cluster(scheduler, keywords.get("device", "auto")) as executor:
        return replace(job, claims=claims, workers=_processes(workers), executor=executor).run(call.watch)


def open_run(path: str | Path) -> Run:
    """Open a run from its folder, finished or not, with the episodes so far.

    Raises ValueError if there is no run, or if it is damaged.
    """
    from ..jobs.folder import RUN_STORE, store_in
    from ..optim.runs.store import RunStore

    return RunStore.open(store_in(Path(path), RUN_STORE)).read()


def _league_spec(scene: Any, keywords: SceneKeywords) -> SceneSpec:
    from ..jobs.scene import read_scene

    if not isinstance(scene, str):
        return spec_of(scene, keywords)
    spec = read_scene(scene, spec_of("", keywords))
    return spec_of(spec.name, {**keywords, **({"fidelity": spec.fidelity} if spec.fidelity else {})})


def _check_workers(workers: int | None, scheduler: str | None) -> None:
    """Raise ValueError for workers and a scheduler, and for less than one worker."""
    if workers and scheduler:
        raise ValueError(f"--scheduler brings its own workers; leave out --workers (got {workers})")
    if workers is not None and workers < 1:
        raise ValueError(f"--workers takes a whole number of at least 1; got {workers}")


def _processes(workers: int | None) -> int:
    """Return how many processes fit models: by default one per core of the command, which starts no script again."""
    if workers is not None or not current().on_disk:
        return workers or 1
    from ..envs.engines.runtime import cores

    return cores()


def _search_in_memory(env: Environment, optimizer: Optimizer, budget: int) -> Run:
    """Search without keeping the run on disk."""
    from ..jobs.search import points_within
    from ..landscapes.threads import one_torch_thread
    from ..optim.search import search

    points = points_within(env, budget)
    optimizer.require_budget(optimizer.options, points)
    with one_torch_thread(), current().watch.progress(budget) as advance:
        store = search(env, optimizer, budget=points, progress=lambda now: advance(now.done))
    if store.read().remark:
        current().watch.note(store.read().remark)
    return store.read()
