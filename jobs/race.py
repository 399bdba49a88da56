"""A race of methods to run in a folder: what it will cost, its picture, its figures; here or by workers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.convert import to_json
from ..landscapes.cost import EpisodeCost, duration, episode_cost
from ..landscapes.options import record_options
from ..landscapes.sampling.distribution import PortableObjective, run_tasks, workers_of
from ..landscapes.space import as_whole
from ..landscapes.storage.files import check_free, clear, refuse_others, visible_files
from ..landscapes.threads import one_torch_thread
from ..optim.claims import Claims, check_claims
from ..optim.memory import SearchSize, require_runs, run_need
from ..optim.processes import workers_worth
from ..optim.race import Competitor, Race, name_seeds, race
from ..optim.registry import check_methods
from ..optim.runs.store import RunStore
from ..optim.search import SearchProgress
from .folder import RACE, RUN_STORE, folder_named
from .job import Job, filling
from .plan import simulation_seconds
from .scene import first_line, provenance
from .search import divide_methods, make_optimizer, open_run_store, points_within
from .watch import PREPARING, Watch, Work
from .workers import recipe

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..envs.base import Environment

Options = Mapping[str, Mapping[str, Any]]  # method -> name -> value, which may be text


@dataclass(frozen=True, kw_only=True)
class RaceJob(Job[Race]):
    """A race to run and to compare with `claims`; methods compute in so many processes, `workers`.

    Its runs advance in lockstep, their proposals evaluated in one batch. With an `executor` its workers search instead,
    a share of the runs each. `best_known` is the least loss that is known from elsewhere, down to which targets go.
    """

    results = RACE
    env: Environment
    competitors: Sequence[Competitor]
    budget: int
    options: Options
    claims: Claims = Claims()  # noqa: RUF009 -- it is frozen
    workers: int = 1
    executor: Executor | None = None
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
        """Continue the race in `out`, by default a folder named after it, or begin it there; `force` replaces it.

        `methods` are by default all that can search the environment here. Raises ValueError for methods and options
        that are not there, where the folder holds something else or other runs, and where the race would not fit here.
        """
        watch, options = watch or Watch(), options or {}
        budget, seeds = points_within(env, budget), as_whole(seeds, "a number of seeds", least=1)
        workers = as_whole(workers, "a number of workers", least=1)
        if not (methods := check_methods(methods)):
            methods, unable = divide_methods(env, budget=budget)
            for method, why in unable.items():
                watch.note(f"{method} cannot run here: {why}")
        # More methods, seeds or episodes continue in the same folder.
        texts = {method: {name: str(value) for name, value in chosen.items()} for method, chosen in options.items()}
        folder = out or folder_named(["race", env.name, env.fidelity.name], [env.identity(), texts])
        refuse_other_folder(folder, RACE.kind, f"*-*/{RUN_STORE}")
        if force:
            check_free(folder)
        require_runs(env.space.dim, budget, seeds, folder, abreast=len(methods))
        for method in methods:
            optimizer = make_optimizer(method, env, options=options.get(method))
            optimizer.require_memory(optimizer.options, SearchSize(env.space.dim, env.decisions, budget))
            optimizer.require_budget(optimizer.options, budget)
        competitors = []
        with watch.busy(f"opening {len(methods) * seeds} runs"):
            for seed in range(seeds):
                for method in methods:
                    path, chosen = folder / f"{method}-{seed}" / RUN_STORE, options.get(method, {})
                    optimizer = make_optimizer(method, env, seed=seed, options=chosen)
                    run = open_run_store(env, optimizer, path, budget=budget, command=command, force=force)
                    competitors.append(_competitor(env, method, seed, chosen, run))
        if force:
            clear(folder, RACE.files, RACE.picture)
        if best_known is not None and not math.isfinite(best_known):
            raise ValueError(f"--best-known takes a finite number; got {best_known}")
        return cls(
            env=env, competitors=competitors, budget=budget, options=options, claims=claims or Claims(),
            workers=workers, best_known=best_known, folder=folder, command=command, prints=prints,
        )  # fmt: skip

    @property
    def methods(self) -> list[str]:
        """The methods that compete."""
        return list(dict.fromkeys(one.method for one in self.competitors))

    @property
    def seeds(self) -> int:
        """How many seeds each of them has."""
        return len(self.competitors) // len(self.methods)

    def compute(self, watch: Watch) -> Race:
        """Search until every run has its budget, and return the race with its figures."""
        self._search(watch)
        runs = {method: [one.run.read() for one in self.competitors if one.method == method] for method in self.methods}
        found = Race(runs, self.budget, self.folder, provenance(self.env, self.command), self.best_known)
        with watch.busy("resampling seeds"):
            found.statistics  # noqa: B018 -- computed once, then kept
        return found

    def holding(self, watch: Watch) -> AbstractContextManager[None]:
        """Hold the folder, and verify the scene against the runs."""
        return filling(self.env, [one.run for one in self.competitors], self.folder, self.kept, watch)

    def kept(self) -> str:
        """Say how much of it is on disk."""
        stores = (RunStore.open(one.run.path) for one in self.competitors if one.run.path)
        done = sum(min(store.count, self.budget) for store in stores)
        return f"{done} of {self.budget * len(self.competitors)} episodes are kept in {self.folder}"

    def record(self, found: Race) -> dict[str, Any]:
        """Return the race as its file has it; `silence` says why there is no claim."""
        figures, env = found.statistics, self.env
        return {
            "env": env.name,
            "fidelity": env.fidelity.name,
            "device": env.device,
            "engine": env.engine,
            "options": record_options(env.options),
            "loss_unit": env.loss_unit,
            "methods": self.methods,
            "method_options": {one.method: one.run.identity["method_options"] for one in self.competitors},
            "budget": self.budget,
            "seeds": self.seeds,
            **to_json(figures),
            "claims": to_json(check_claims(self.claims.claims, figures.differences, figures.superiorities)),
            "silence": self.claims.silence,
            "command": self.command,
        }

    def work(self) -> list[Work]:
        """Return the budget of every run, with gradients where its method asks for them."""
        losses, gradients = (
            sum(self.budget for one in self.competitors if self._needs_grad[one.method] == way) for way in (False, True)
        )
        need = run_need(self.env.space.dim, self.budget).times(len(self.competitors))
        return [Work(self.env, losses, gradients, need.disk, need.memory)]

    def _search(self, watch: Watch) -> None:
        ratio, runs = self._announce(watch), dict[tuple[str, int], tuple[int, int, float]]()  # done, failed, best
        for one in self.competitors:
            loss = one.run.dataset()["loss"].to_numpy()[: self.budget].tolist()
            runs[one.method, one.seed] = (len(loss), sum(map(math.isnan, loss)), _least(loss))
        with watch.progress_of(dict.fromkeys(self.methods, self.budget * self.seeds)) as advance:

            def show(method: str) -> None:
                mine = [run for (name, _), run in runs.items() if name == method]
                least, lost = _least([best for _, _, best in mine]), sum(count for _, count, _ in mine)
                best = "no loss yet" if math.isnan(least) else f"best loss {least:.4g}"
                failed = f", {lost} failed" if lost else ""
                advance(method, sum(done for done, _, _ in mine), f"{method}: {best}{failed}")

            def follow(one: Competitor, now: SearchProgress) -> None:
                runs[one.method, one.seed] = (min(now.done, now.total), now.failed, now.best)
                show(one.method)

            for method in self.methods:
                show(method)
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
        many = min(workers_of(executor), len(left))
        numbered = [(number, one.method, one.seed, str(one.run.path)) for number, one in enumerate(left)]
        tasks = [(self._sent, numbered[start::many], dict(self.options), self.budget, ratio) for start in range(many)]
        for found in run_tasks(executor, _race_there, tasks):
            for number, now in found.items():
                with left[number].run.lock():  # reads it
                    follow(left[number], now)

    def _announce(self, watch: Watch) -> float | None:
        """Say what is left to compute, and return what an episode with gradient costs if any method asks for it."""
        env = self.env
        watch.note(first_line(env.identity(), self.folder))
        needs = self._needs_grad
        left = {
            way: sum(self._count_left(one) for one in self.competitors if needs[one.method] == way) for way in (0, 1)
        }
        whole = self.budget * len(self.competitors)
        racers = f"{', '.join(self.methods)}, {name_seeds(self.seeds)} each"
        if not any(left.values()):
            watch.note(f"{racers}: all {whole} episodes are done already")
            return None
        with watch.busy(f"{env.name}: {PREPARING}"):
            cost, seconds = self._cost(left)
        known = [one.run.gradient_cost for one in self.competitors if one.run.gradient_cost]
        kept = f", {whole - sum(left.values())} are done already" if sum(left.values()) < whole else ""
        watch.note(f"{racers}: {sum(left.values())} episodes to compute{kept}: {seconds}")
        return (known[0] if known else cost.ratio) if any(needs.values()) else None

    def _cost(self, left: Mapping[int, int]) -> tuple[EpisodeCost, str]:
        """Measure an episode alone, and say what the race takes: in lockstep, or by workers.

        Of workers, all episodes of a method that asks for gradients are counted with.
        """
        grad = left[1] > 0
        if self.executor is not None:
            (alone,) = run_tasks(self.executor, _cost_there, [(self._sent, grad)])
            whole = left[0] * alone.forward + (left[1] * alone.gradient if grad else 0.0)
            by = workers_of(self.executor)
            return alone, f"{duration(whole)} one by one, shared by {by} workers, plus the time of the methods"
        concurrent = sum(self._count_left(one) > 0 for one in self.competitors)
        seconds = simulation_seconds(self.env, left[0], left[1], concurrent)
        return episode_cost(self.env, grad=grad), f"{duration(seconds)} to simulate, plus the time of the methods"

    @cached_property
    def _needs_grad(self) -> dict[str, bool]:
        """Whether each method asks for gradients, with its options."""
        return {one.method: one.make().needs_grad for one in self.competitors if one.seed == 0}

    @property
    def _sent(self) -> PortableObjective:
        return PortableObjective.of(self.env, recipe(self.env))

    def _count_left(self, one: Competitor) -> int:
        return max(0, self.budget - one.run.count)


def refuse_other_folder(folder: Path, kind: str, *marks: str) -> None:
    """Raise ValueError for a folder with files, none of which matches the `marks` of such a `kind` of results."""
    if not any(any(folder.glob(mark)) for mark in marks):
        refuse_others(folder, (one for one in visible_files(folder) if not one.is_dir() or visible_files(one)), kind)


def _competitor(env: Environment, method: str, seed: int, options: Mapping[str, Any], run: RunStore) -> Competitor:
    return Competitor(method, seed, run, partial(make_optimizer, method, env, seed=seed, options=options))


def _race_there(
    sent: PortableObjective,
    numbered: Sequence[tuple[int, str, int, str]],
    options: Options,
    budget: int,
    gradient_cost: float | None,
) -> dict[int, SearchProgress]:
    """Fill a worker's share of the runs (number, method, seed, path); return how far each came, by its number."""
    env: Any = sent.objective.objective
    share = {
        number: _competitor(env, method, seed, options.get(method, {}), RunStore.open(path))
        for number, method, seed, path in numbered
    }
    number_of = {(one.method, one.seed): number for number, one in share.items()}
    seen = dict[int, SearchProgress]()

    def follow(one: Competitor, now: SearchProgress) -> None:
        seen[number_of[one.method, one.seed]] = now

    with one_torch_thread():
        race(env, list(share.values()), budget=budget, gradient_cost=gradient_cost, progress=follow)
    return seen


def _cost_there(sent: PortableObjective, grad: bool) -> EpisodeCost:
    return episode_cost(sent.objective.objective, grad=grad)


def _least(losses: Sequence[float]) -> float:
    return min((loss for loss in losses if not math.isnan(loss)), default=math.nan)
