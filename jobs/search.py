"""A run of an optimiser to fill in a folder: what it will cost, its picture, its summary."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.cost import duration, episode_cost
from ..landscapes.identity import METHOD_VERSION
from ..landscapes.objective import FAILED, Objective, Status, describe_errors
from ..landscapes.space import as_whole
from ..landscapes.storage.files import check_free, clear
from ..landscapes.threads import one_torch_thread
from ..optim.base import Kind
from ..optim.memory import SearchSize, require_runs, run_need
from ..optim.registry import methods, optimizer_class
from ..optim.runs.run import Run
from ..optim.runs.store import RunStore
from ..optim.search import SearchProgress, search
from .folder import RUN, SUMMARY, folder_named
from .job import SummaryJob, filling
from .scene import first_line, provenance
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..optim.base import Optimizer

STORE, PICTURE = RUN.store, RUN.picture


@dataclass(frozen=True)
class BestRecord:
    """The best episode of a run, as its summary has it."""

    loss: float
    episode: int
    x: list[float]


@dataclass(frozen=True)
class SearchSummary:
    """Record the cost and the result of a run, as in its `summary.json`; `best` is None if no episode succeeded.

    `forwards` is the cost in episodes without gradient. `error` is the message of the first episode that raised.
    """

    env: str
    method: str
    seed: int
    budget: int
    fidelity: str
    device: str
    options: dict[str, Any]
    method_options: dict[str, Any]
    episodes: int
    resumed: int
    seconds: float
    forwards: float
    gradient_cost: float | None
    status: dict[str, int]
    kinds: dict[str, int]
    best: BestRecord | None
    command: str
    files: list[str]
    error: str = ""
    remark: str = ""

    def outcome(self) -> str:
        """Say in a line what the run cost and found."""
        best = self.best
        found = f"best loss {best.loss:.6g} at episode {best.episode}" if best else "no episode succeeded"
        counts = {kind: self.status.get(kind.name.lower(), 0) for kind in Status}
        lost, lacking = sum(counts[kind] for kind in FAILED), counts[Status.NO_GRADIENT]
        parts = [
            f"{lost} failed" if lost else "",
            f"{lacking} without a gradient" if lacking else "",
            describe_errors(counts[Status.ERROR], self.error),
        ]
        said = "; ".join([f"{self.episodes} episodes in {duration(self.seconds)}", found, *filter(None, parts)])
        return f"{said}\n{self.remark}".rstrip()


@dataclass(frozen=True, kw_only=True)
class SearchJob(SummaryJob[SearchSummary]):
    """A run to fill up to a budget."""

    results = RUN
    env: Environment
    optimizer: Optimizer
    store: RunStore
    budget: int

    @classmethod
    def of(
        cls,
        env: Environment,
        optimizer: Optimizer,
        *,
        budget: int,
        command: str,
        out: Path | None = None,
        force: bool = False,
        prints: Sequence[float] = (),
    ) -> SearchJob:
        """Continue the run in `out`, by default a folder named after it, or begin it there; `force` replaces it.

        Raises ValueError where the folder holds something else or another run, and where the run would not fit here.
        """
        budget, identity = points_within(env, budget), run_identity(env, optimizer)
        parts = [identity["objective"], identity["method"], identity["fidelity"], f"s{identity['seed']}"]
        folder = out or folder_named(parts, identity)
        require_runs(env.space.dim, budget, 1, folder)
        optimizer.require_memory(optimizer.options, SearchSize(env.space.dim, env.decisions, budget))
        optimizer.require_budget(optimizer.options, budget)
        RUN.check(folder)
        if replaced := force and (folder / STORE).exists():
            check_free(folder)
        store = open_run_store(env, optimizer, folder / STORE, budget=budget, command=command, force=force)
        if replaced:
            clear(folder, (PICTURE, SUMMARY), PICTURE)
        return cls(
            env=env, optimizer=optimizer, store=store, budget=budget, folder=folder, command=command, prints=prints
        )

    def compute(self, watch: Watch) -> SearchSummary:
        """Search until the budget is spent, draw the run and return the summary."""
        start, resumed = time.monotonic(), self.store.count
        if resumed < self.budget:
            resumed = self._search(watch)
        else:
            watch.note(f"{self._place()}\nall {self.budget} episodes are done already")
        printed = self.draw(self.result().plot)
        return self._summary(resumed, time.monotonic() - start, [STORE, PICTURE, *printed, SUMMARY])

    def work(self) -> list[Work]:
        """Return the budget, with gradients if the method asks for them."""
        counts = (0, self.budget) if self.optimizer.needs_grad else (self.budget, 0)
        need = run_need(self.env.space.dim, self.budget)
        return [Work(self.env, *counts, need.disk, need.memory)]

    def holding(self, watch: Watch) -> AbstractContextManager[None]:
        """Hold the folder, and verify the scene against the run; one that is stopped leaves a picture."""
        return filling(self.env, [self.store], self.folder, self.kept, watch, self._draw_kept)

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{RunStore.open(self.folder / STORE).count} of {self.budget} episodes are kept in {self.folder}"

    def result(self) -> Run:
        """Return the run as one works with it."""
        return replace(self.store.read(), folder=self.folder)

    def _draw_kept(self) -> None:
        """Draw what is on disk, if there is anything to draw."""
        kept = replace(self, store=RunStore.open(self.folder / STORE), prints=())
        if kept.store.count:
            kept.draw(kept.result().plot)

    def _search(self, watch: Watch) -> int:
        """Search, and return how many episodes were there before."""
        ratio, resumed = self._announce(watch), 0
        with watch.progress(self.budget) as advance:

            def follow(now: SearchProgress) -> None:
                nonlocal resumed
                resumed = now.resumed
                failed = f", {now.failed} failed" if now.failed else ""
                advance(now.done, f"best loss {now.best:.4g}{failed}")

            search(self.env, self.optimizer, self.store, budget=self.budget, gradient_cost=ratio, progress=follow)
        return resumed

    def _announce(self, watch: Watch) -> float | None:
        """Say what is left to compute, and return what a gradient costs, as far as the method asks for any."""
        store, grad = self.store, self.optimizer.needs_grad
        with watch.busy(f"{self.env.name}: {PREPARING}"):
            cost = episode_cost(self.env, grad=grad and store.gradient_cost is None)
        ratio, left = store.gradient_cost or cost.ratio, self.budget - store.told
        kept = f", {store.told} are done already" if store.told else ""
        forward = duration(left * cost.forward)
        costs = f"{forward} without gradients, {duration(left * cost.forward * ratio)} with" if grad else forward
        watch.note(
            f"{self._place()}\n{left} episodes to compute{kept}: {costs}, one by one, plus the time of the method"
        )
        return ratio if grad else None

    def _place(self) -> str:
        return first_line(self.env.identity(), self.optimizer.name, self.folder)

    def _summary(self, resumed: int, seconds: float, files: list[str]) -> SearchSummary:
        run, identity = self.store.read(), self.store.identity
        data, best = run.data, None
        if self.store.count > self.store.failed:
            best = BestRecord(run.best.loss, run.best.episode, run.best.x.tolist())
        return SearchSummary(
            env=identity["objective"],
            method=identity["method"],
            seed=identity["seed"],
            budget=self.store.budget,
            fidelity=identity["fidelity"],
            device=identity["device"],
            options=identity["options"],
            method_options=identity["method_options"],
            episodes=self.store.count - resumed,
            resumed=resumed,
            seconds=round(seconds, 3),
            forwards=float(data["forwards"][-1]),
            gradient_cost=self.store.gradient_cost,
            status={kind.name.lower(): int((data["status"] == kind).sum()) for kind in Status if kind},
            kinds={kind.name.lower(): int((data["kind"] == kind).sum()) for kind in Kind},
            best=best,
            command=self.command,
            files=files,
            error=self.store.error,
            remark=run.remark,
        )


def points_within(env: Environment, budget: int) -> int:
    """Return how many points a budget of episodes allows: one takes several where a remedy averages.

    Raises ValueError where that is none.
    """
    budget, cost = as_whole(budget, "a budget", least=1), env.episodes_per_point
    if budget < cost:
        raise ValueError(
            f"a point of {env.name} takes {cost} episodes with its remedy; got a budget of {budget}, so raise it"
        )
    return budget // cost


@one_torch_thread()
def make_optimizer(
    method: str, objective: Objective, *, seed: int = 0, options: Mapping[str, Any] | None = None
) -> Optimizer:
    """Make a method for an objective; values of its options may be text.

    Raises ValueError for a method, an option or a value that is not there, and TooLargeError for one that would not fit
    this machine.
    """
    from ..landscapes.options import read_options

    kind = optimizer_class(method)
    chosen = read_options(method, kind.Options, options or {})
    kind.require_memory(chosen, SearchSize(objective.space.dim, objective.decisions))
    return kind.on(objective, seed=seed, options=chosen)


def divide_methods(env: Environment, names: Sequence[str] = (), *, budget: int = 0) -> tuple[list[str], dict[str, str]]:
    """Return which methods, by default all but `auto`, can search an environment here, and why the others cannot.

    `auto` takes one of the others, so that it races where it is named.
    """
    able, unable = list[str](), dict[str, str]()
    for method in names or [name for name in methods() if name != "auto"]:
        try:
            made = make_optimizer(method, env)
            made.require_memory(made.options, SearchSize(env.space.dim, env.decisions, budget))
            if budget:
                made.require_budget(made.options, budget)
        except ValueError as error:
            unable[method] = " ".join(str(error).split())
        else:
            able.append(method)
    return able, unable


def open_run_store(
    env: Environment, optimizer: Optimizer, path: Path, *, budget: int, command: str, force: bool
) -> RunStore:
    """Open the run of an optimiser at `path`, or make it; `force` replaces one that is there.

    Raises StoreMismatchError where another run is there.
    """
    identity, about = run_identity(env, optimizer), provenance(env, command)
    replaced = force and path.exists()
    return RunStore.open_or_create(
        path, env.space, identity=identity, provenance=about, budget=budget, overwrite=replaced
    )


def run_identity(env: Environment, optimizer: Optimizer) -> dict[str, Any]:
    """Return what decides a run's numbers; the budget does not, so that a run can be continued to a larger one."""
    return {
        **env.identity(),
        "method": optimizer.name,
        "method_options": asdict(optimizer.options),
        METHOD_VERSION: optimizer.method_version,
        "seed": optimizer.seed,
    }
