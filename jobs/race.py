"""A race of methods to run in a folder: what it will cost, its picture, its figures; here or by workers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cloudpickle

from ..landscapes.cost import EpisodeCost, duration, episode_cost, seconds_per_episode
from ..landscapes.sampling.distribution import make_objective as objective_of
from ..landscapes.sampling.distribution import run_tasks, workers_of
from ..landscapes.space import as_whole
from ..landscapes.storage.files import check_free, clear, refuse_others, tidy, visible_files, write_json
from ..landscapes.threads import one_torch_thread
from ..optim.claims import Claims, check_claims
from ..optim.memory import run_need
from ..optim.processes import workers_worth
from ..optim.race import Competitor, Race, name_seeds, race
from ..optim.registry import optimizer_class
from ..optim.runs.store import RunStore
from ..optim.search import SearchProgress
from .folder import RACE, RACE_FIGURES, ROOT, RUN_STORE, folder_named
from .job import filling
from .methods import able_methods, check_methods, require_room
from .race_summary import RaceSummary
from .scene import provenance
from .search import make_optimizer, open_run_store
from .watch import PREPARING, Watch, Work, resumable
from .workers import recipe

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..envs.base import Environment
    from ..optim.base import Optimizer

PICTURE = RACE.picture
Options = Mapping[str, Mapping[str, Any]]  # method -> name -> value, which may be text


@dataclass(frozen=True)
class RaceJob:
    """A race to run in `folder`, and to hold claims against; methods compute in so many processes, `workers`.

    Its runs go on in lockstep, their proposals evaluated in one batch. With an `executor` its workers search instead,
    a share of the runs each. `best_known` is the least loss that is known from elsewhere, down to which targets go.
    """

    env: Environment
    competitors: Sequence[Competitor]
    folder: Path
    budget: int
    command: str
    claims: Claims = Claims()  # noqa: RUF009 -- it is frozen
    workers: int = 1
    executor: Executor | None = None
    prints: Sequence[float] = ()
    best_known: float | None = None

    @classmethod
    def of(
        cls,
        env: Environment,
        methods: Sequence[str],
        *,
        budget: int,
        seeds: int,
        command: str,
        options: Options | None = None,
        claims: Claims | None = None,
        workers: int = 1,
        out: Path | None = None,
        force: bool = False,
        prints: Sequence[float] = (),
        best_known: float | None = None,
        watch: Watch | None = None,
    ) -> RaceJob:
        """Go on with the race in `out`, by default a folder named after it, or begin it there; `force` begins anew.

        `methods` are by default all that can search the environment here. Raises ValueError where the folder holds
        something else, and for methods and options that are not there, StoreMismatchError where it holds a run of other
        settings, StoreError where another process fills the race that is to be begun anew, and TooLargeError where the
        race would not fit this machine.
        """
        watch, options = watch or Watch(), options or {}
        budget, seeds = as_whole(budget, "a budget", least=1), as_whole(seeds, "a number of seeds", least=1)
        workers = as_whole(workers, "a number of workers", least=1)
        methods = check_methods(methods) or able_methods(env, watch)
        folder = out or race_folder(env, options)
        if not any(folder.glob(f"*-*/{RUN_STORE}")):
            refuse_others(
                folder, (one for one in visible_files(folder) if not one.is_dir() or visible_files(one)), RACE.kind
            )
        if force:
            check_free(folder)
        require_room(env, methods, options, seeds=seeds, budget=budget, folder=folder)
        how: dict[str, Any] = {"budget": budget, "command": command, "force": force}
        with watch.busy(f"opening {len(methods) * seeds} runs"):
            competitors = [
                _open_competitor(env, method, seed, options.get(method, {}), folder, **how)
                for seed in range(seeds)
                for method in methods
            ]
        if force:
            clear(folder, (PICTURE, RACE_FIGURES), PICTURE)
        known = _check_loss(best_known)
        return cls(env, competitors, folder, budget, command, claims or Claims(), workers, None, prints, known)

    @property
    def methods(self) -> list[str]:
        """The methods that compete."""
        return list(dict.fromkeys(one.method for one in self.competitors))

    @property
    def seeds(self) -> int:
        """How many seeds each of them has."""
        return len(self.competitors) // len(self.methods)

    def run(self, watch: Watch | None = None) -> RaceSummary:
        """Compute what is missing, draw the race, write and return its figures.

        Raises StoreMismatchError where the scene gives other numbers than are stored, Stopped where it is interrupted,
        and DiskFullError; the same job goes on from what is kept then.
        """
        watch = watch or Watch()
        watch.plan(self.work())
        runs = [one.run for one in self.competitors]
        with resumable(self.say_kept), one_torch_thread(), filling(self.env, runs, self.folder, watch):
            self._search(watch)
            with watch.busy("resampling seeds"):
                return self._save()

    def result(self) -> Race:
        """Return the race as one works with it."""
        runs = {method: [one.run.read() for one in self.competitors if one.method == method] for method in self.methods}
        return Race(runs, self.budget, self.folder, provenance(self.env, self.command), self.best_known)

    def say_kept(self) -> str:
        """Say how much of it is on disk."""
        stores = (RunStore.open(one.run.path) for one in self.competitors if one.run.path)
        done = sum(min(store.count, self.budget) for store in stores)
        return f"{done} of {self.budget * len(self.competitors)} episodes are kept in {self.folder}"

    def _search(self, watch: Watch) -> None:
        ratio, lines = self._announce(watch), Lines(self)
        with watch.progress_of(dict.fromkeys(self.methods, self.budget * self.seeds)) as advance:
            for method in self.methods:
                advance(method, lines.done(method), lines.text(method))

            def follow(one: Competitor, now: SearchProgress) -> None:
                lines.take(one, now)
                advance(one.method, lines.done(one.method), lines.text(one.method))

            if self.executor:
                self._distribute(self.executor, ratio, follow)
                return
            workers = workers_worth(self.workers, max(map(self._count_left, self.competitors)))
            race(self.env, self.competitors, budget=self.budget, gradient_cost=ratio, workers=workers, progress=follow)

    def _distribute(
        self, executor: Executor, ratio: float | None, follow: Callable[[Competitor, SearchProgress], None]
    ) -> None:
        """Let workers search, a share of the runs each, and read what they wrote."""
        left = [one for one in self.competitors if self._count_left(one)]
        there, many = cloudpickle.dumps(recipe(self.env)), min(workers_of(executor), len(left))
        shares = [list(range(start, len(left), many)) for start in range(many)]
        tasks = [(there, share, [_recipe_of(left[number]) for number in share], self.budget, ratio) for share in shares]
        for found in run_tasks(executor, _race_there, tasks):
            for number, now in found.items():
                with left[number].run.lock():  # reads it
                    follow(left[number], now)

    def _save(self) -> RaceSummary:
        from ..landscapes.draw.figures.page import save, save_prints

        result, path = self.result(), self.folder / PICTURE
        save(result.plot(), path)
        printed = save_prints(lambda width: result.plot(width=width), path, self.prints)
        summary = self._summary(result, [RACE_FIGURES, PICTURE, *printed])
        write_json(self.folder / RACE_FIGURES, summary.record())
        tidy(self.folder)
        return summary

    def _summary(self, result: Race, files: list[str]) -> RaceSummary:
        figures = result.statistics
        return RaceSummary(
            env=self.env.name,
            fidelity=self.env.fidelity.name,
            device=self.env.device,
            engine=self.env.engine,
            options=asdict(self.env.options),
            loss_unit=self.env.loss_unit,
            methods=self.methods,
            method_options={one.method: one.run.identity["method_options"] for one in self.competitors},
            budget=self.budget,
            seeds=self.seeds,
            race=result,
            claims=check_claims(self.claims.claims, figures.differences, figures.superiorities),
            silence=self.claims.silence,
            command=self.command,
            files=files,
        )

    def _announce(self, watch: Watch) -> float | None:
        """Say what is left to compute, and return what an episode with gradient costs if any method asks for it."""
        env = self.env
        watch.note(f"{env.name} · {env.fidelity.name} · {env.device} · {self.folder}")
        needs = {method: optimizer_class(method).needs_grad for method in self.methods}
        left = {
            way: sum(self._count_left(one) for one in self.competitors if needs[one.method] == way) for way in (0, 1)
        }
        whole = self.budget * len(self.competitors)
        racers = f"{', '.join(self.methods)}, {name_seeds(self.seeds)} each"
        if not any(left.values()):
            watch.note(f"{racers}: all {whole} episodes are there already")
            return None
        with watch.busy(f"{env.name}: {PREPARING}"):
            cost, seconds = self._cost(left)
        known = [one.run.gradient_cost for one in self.competitors if one.run.gradient_cost]
        kept = f", {whole - sum(left.values())} are there already" if sum(left.values()) < whole else ""
        watch.note(f"{racers}: {sum(left.values())} episodes to compute{kept}: {seconds}")
        return (known[0] if known else cost.ratio) if any(needs.values()) else None

    def _cost(self, left: Mapping[int, int]) -> tuple[EpisodeCost, str]:
        """Measure an episode alone, and say what the race takes: in lockstep, or by workers.

        Of workers, all episodes of a method that asks for gradients are counted with.
        """
        grad = left[1] > 0
        if self.executor is not None:
            (alone,) = run_tasks(self.executor, _cost_there, [(cloudpickle.dumps(recipe(self.env)), grad)])
            whole = left[0] * alone.forward + (left[1] * alone.gradient if grad else 0.0)
            by = workers_of(self.executor)
            return alone, f"{duration(whole)} one by one, by {by} workers, and what the methods take"
        abreast = sum(self._count_left(one) > 0 for one in self.competitors)
        seconds = lockstep_seconds(self.env, left, abreast)
        return episode_cost(self.env, grad=grad), f"{duration(seconds)} to simulate, and what the methods take"

    def work(self) -> list[Work]:
        """Return the budget of every run, with gradients where its method asks for them."""
        losses, gradients = (
            sum(self.budget for one in self.competitors if optimizer_class(one.method).needs_grad == way)
            for way in (False, True)
        )
        need = run_need(self.env.space.dim, self.budget).times(len(self.competitors))
        return [Work(self.env, losses, gradients, need.disk, need.memory)]

    def _count_left(self, one: Competitor) -> int:
        return max(0, self.budget - one.run.count)


class Lines:
    """Say of each method how many episodes are done and the best loss so far, over its seeds."""

    def __init__(self, job: RaceJob) -> None:
        self._runs: dict[tuple[str, int], tuple[int, int, float]] = {}
        for one in job.competitors:
            loss = one.run.dataset()["loss"].to_numpy()[: job.budget].tolist()
            self._runs[one.method, one.seed] = (len(loss), sum(map(math.isnan, loss)), _least(loss))

    def take(self, one: Competitor, now: SearchProgress) -> None:
        """Take in how far a run is."""
        self._runs[one.method, one.seed] = (min(now.done, now.total), now.failed, now.best)

    def done(self, method: str) -> int:
        """Return the episodes a method has done."""
        return sum(done for (name, _), (done, _, _) in self._runs.items() if name == method)

    def text(self, method: str) -> str:
        """Return a method's line."""
        mine = [run for (name, _), run in self._runs.items() if name == method]
        least = _least([best for _, _, best in mine])
        failed = sum(count for _, count, _ in mine)
        best = "no loss yet" if math.isnan(least) else f"best loss {least:.4g}"
        return f"{method}: {best}{f', {failed} failed' if failed else ''}"


def lockstep_seconds(env: Environment, left: Mapping[int, int], abreast: int) -> float:
    """Measure what so many episodes take to simulate, without gradients (0) and with (1), so many in a batch [s]."""
    x = env.space.uniform(max(1, min(abreast, env.preferred_batch)), seed=0)
    return sum(count * seconds_per_episode(env, x, grad=bool(way)) for way, count in left.items() if count)


def race_folder(env: Environment, options: Options, root: Path = ROOT) -> Path:
    """Return a folder of its own for every different race; more methods, seeds or episodes go on in the same one."""
    texts = {method: {name: str(value) for name, value in chosen.items()} for method, chosen in options.items()}
    return folder_named(["race", env.name, env.fidelity.name], [env.identity(), texts], root)


def _recipe_of(one: Competitor) -> tuple[str, str, dict[str, Any]]:
    """Return the path of a run, its method, and how the optimiser is made."""
    how = one.make.keywords  # type: ignore[attr-defined] # of the partial that `_open_competitor` makes
    return str(one.run.path), one.method, {"seed": one.seed, "options": dict(how["options"])}


def _race_there(
    there: bytes,
    numbers: Sequence[int],
    recipes: Sequence[tuple[str, str, dict[str, Any]]],
    budget: int,
    gradient_cost: float | None,
) -> dict[int, SearchProgress]:
    """Fill a worker's share of the runs in lockstep, and return how far each came, by its number."""
    env: Any = objective_of(there).objective
    share = [
        Competitor(method, how["seed"], RunStore.open(path), partial(make_optimizer, method, env, **how))
        for path, method, how in recipes
    ]
    number_of, seen = dict(zip(map(id, share), numbers, strict=True)), {}

    def follow(one: Competitor, now: SearchProgress) -> None:
        seen[number_of[id(one)]] = now

    with one_torch_thread():
        race(env, share, budget=budget, gradient_cost=gradient_cost, progress=follow)
    return seen


def _cost_there(there: bytes, grad: bool) -> EpisodeCost:
    return episode_cost(objective_of(there).objective, grad=grad)


def _open_competitor(
    env: Environment,
    method: str,
    seed: int,
    options: Mapping[str, Any],
    folder: Path,
    *,
    budget: int,
    command: str,
    force: bool,
) -> Competitor:
    make: Callable[[], Optimizer] = partial(make_optimizer, method, env, seed=seed, options=options)
    path = folder / f"{method}-{seed}" / RUN_STORE
    store = open_run_store(env, make(), path, budget=budget, command=command, force=force)
    return Competitor(method, seed, store, make)


def _check_loss(best_known: float | None) -> float | None:
    """Refuse a best known loss that is not finite."""
    if best_known is not None and not math.isfinite(best_known):
        raise ValueError(f"the best known loss is a finite number; got {best_known}")
    return best_known


def _least(losses: Sequence[float]) -> float:
    return min((loss for loss in losses if not math.isnan(loss)), default=math.nan)
