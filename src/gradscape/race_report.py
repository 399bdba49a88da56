"""What `landscape race` does: costs, a line of progress per method, its files."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import cluster, race_workers
from .console import duration, provenance_of, read_settings
from .envs.registry import make
from .landscapes.disk import until_full
from .landscapes.files import clear, tidy, visible, write_json
from .optim.registry import METHODS
from .race_tables import seeds_said, show
from .search_report import STORE, give_torch_one_thread, made, run_identity, search_progress
from .terminal import Console

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from .envs.base import Environment
    from .optim import race as racing
    from .optim.search import Cost, Progress

PICTURE, FIGURES = "race.png", "race.json"


def race(
    name: str,
    methods: Sequence[str],
    *,
    budget: int,
    seeds: int,
    workers: int,
    fidelity: str | None,
    device: str,
    engine: str,
    deterministic: bool,
    settings: Sequence[str],
    method_settings: Sequence[str],
    out: str | None,
    as_json: bool,
    report: bool,
    force: bool,
    scheduler: str | None = None,
    prints: Sequence[float] = (),
) -> None:
    """Let methods compete on an environment; say what it costs, how far it is and what came out."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    chosen = _chosen(methods)
    options = _options(method_settings, chosen)
    how: dict[str, Any] = {"fidelity": fidelity, "device": device, "engine": engine, "deterministic": deterministic}
    env = make(name, **how, **read_settings(settings))
    if workers > 1 and not env.capabilities.concurrent:
        raise ValueError(f"engine {env.engine} runs in one thread only, so --workers is 1; got {workers}")
    if workers > 1 and scheduler:
        raise ValueError(f"--scheduler has workers of its own, so --workers is 1; got {workers}")
    give_torch_one_thread()
    if not methods:
        chosen = _able(console, env, chosen)
    with console.status(f"opening {len(chosen) * seeds} runs"):
        job = Job.open(env, chosen, options, seeds=seeds, budget=budget, workers=workers, out=out, force=force)
    try:
        with until_full(job.kept):
            with cluster.workers(scheduler, env.device) as executor:
                job.run(console, executor)
            with console.status("resampling seeds"):
                figures = job.save(prints)
    except KeyboardInterrupt:
        job.farewell(console)
        sys.exit(130)
    if as_json:
        short = {key: value for key, value in figures.items() if key not in ("curves", "ecdf")}
        print(json.dumps({**short, "folder": str(job.folder)}))
    else:
        show(figures, Console(soft_wrap=True, highlight=False), claims=report)
    console.print(f"{job.folder}: {', '.join(figures['files'])}", markup=False)


def _chosen(methods: Sequence[str]) -> list[str]:
    """Return the methods named, apart or with commas between them; all where none is."""
    named = [name.strip() for text in methods for name in text.split(",") if name.strip()]
    for name in named:
        if name not in METHODS:
            raise ValueError(f"no method is called {name!r}; there are {', '.join(METHODS)}")
    return list(dict.fromkeys(named)) or list(METHODS)


def _able(console: Console, env: Environment, methods: Sequence[str]) -> list[str]:
    """Return the methods that can run here, and say what becomes of the others."""
    able = []
    for method in methods:
        try:
            made(method, env, seed=0, options={})
        except ValueError as error:
            console.print(f"without {method}: {error}", markup=False)
        else:
            able.append(method)
    return able


def _options(settings: Sequence[str], methods: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return options given as method.name=value, method -> name -> value."""
    found: dict[str, dict[str, str]] = {}
    for setting, value in read_settings(settings, "--option").items():
        method, dot, name = setting.partition(".")
        if not dot or method not in methods:
            raise ValueError(
                f"--option takes METHOD.NAME=VALUE for one of {', '.join(methods)}; got {setting + '=' + value!r}"
            )
        found.setdefault(method, {})[name] = value
    return found


@dataclass(frozen=True)
class Job:
    """A race to run in `folder`."""

    env: Environment
    entries: Sequence[racing.Entry]
    folder: Path
    budget: int
    workers: int
    command: str

    @classmethod
    def open(
        cls,
        env: Environment,
        methods: Sequence[str],
        options: Mapping[str, dict[str, str]],
        *,
        seeds: int,
        budget: int,
        workers: int,
        out: str | None,
        force: bool,
    ) -> Job:
        """Go on with the race in its folder, or begin it there; seeds go by turns, so that methods stay level."""
        folder, command = Path(out) if out else _folder(env, options), shlex.join(["landscape", *sys.argv[1:]])
        if any(not file.is_dir() or visible(file) for file in visible(folder)) and not any(folder.glob(f"*-*/{STORE}")):
            raise ValueError(f"{folder} holds other files and no race; give --out a new or an empty folder")
        _require(env, methods, options, seeds=seeds, budget=budget, folder=folder)
        makers = {
            (method, seed): partial(made, method, env, seed=seed, options=options.get(method, {}))
            for seed in range(seeds)
            for method in methods
        }
        entries = [_entry(env, maker, folder, budget=budget, command=command, force=force) for maker in makers.values()]
        if force:
            clear(folder, (PICTURE, FIGURES), PICTURE)
        return cls(env, entries, folder, budget, workers, command)

    @property
    def methods(self) -> list[str]:
        """The methods that compete."""
        return list(dict.fromkeys(entry.method for entry in self.entries))

    @property
    def seeds(self) -> int:
        """How many seeds each of them has."""
        return len(self.entries) // len(self.methods)

    def run(self, console: Console, executor: Executor | None = None) -> None:
        """Compute what is missing, here or by an executor's workers, a run each."""
        from .optim.race import race as run

        ratio = self._announce(console, executor)
        with search_progress(console) as bar:
            lines = Lines(self)
            tasks = {
                method: bar.add_task(lines.text(method), total=self.budget * self.seeds, completed=lines.done(method))
                for method in self.methods
            }

            def follow(entry: racing.Entry, now: Progress) -> None:
                lines.take(entry, now)
                method = entry.method
                bar.update(tasks[method], completed=lines.done(method), description=lines.text(method))

            if executor:
                self._spread(executor, ratio, follow)
                return
            run(
                self.env,
                self.entries,
                budget=self.budget,
                workers=self.workers,
                gradient_cost=ratio,
                progress=follow,
            )

    def _spread(
        self, executor: Executor, ratio: float | None, follow: Callable[[racing.Entry, Progress], None]
    ) -> None:
        """Let workers search, and read what they wrote."""
        left = [entry for entry in self.entries if self._left(entry)]
        for entry, now in race_workers.search_all(executor, self.env, left, budget=self.budget, ratio=ratio):
            with entry.run.filling():  # reads it
                follow(entry, now)

    def save(self, prints: Sequence[float] = ()) -> dict[str, Any]:
        """Draw the race, also for pages so wide [mm], write its figures and return them."""
        from .landscapes.draw.page import save, save_prints
        from .landscapes.draw.race import race_figure
        from .optim.race import judged, picture, tables
        from .optim.standings import targets

        runs = tables(self.entries, self.budget)
        goals = targets(runs)
        figures: dict[str, Any] = _plain(
            {
                "env": self.env.name,
                "fidelity": self.env.fidelity.name,
                "device": self.env.device,
                "engine": self.env.engine,
                "options": asdict(self.env.options),
                "loss_unit": self.env.loss_unit,
                "methods": self.methods,
                "method_options": {entry.method: entry.run.identity["method_options"] for entry in self.entries},
                "budget": self.budget,
                "seeds": self.seeds,
                **judged(self.env.name, runs, goals),
                "command": self.command,
            }
        )
        dataset = picture(runs, goals).assign_attrs(
            title=f"{self.env.name} · {self.env.fidelity.name} · {self.budget} episodes · {seeds_said(self.seeds)}",
            budget=self.budget,
            seeds=self.seeds,
            loss_unit=self.env.loss_unit,
            spacing=goals.spacing,
            targets=(len(goals.loss), *(goals.loss[[0, -1]] if len(goals.loss) else (math.nan, math.nan))),
            identity=json.dumps(self.entries[0].run.identity),
            provenance=json.dumps(provenance_of(self.env, self.command)),
        )
        save(race_figure(dataset), self.folder / PICTURE)
        printed = save_prints(lambda width: race_figure(dataset, width=width), self.folder / PICTURE, prints)
        figures["files"] = [FIGURES, PICTURE, *printed]
        write_json(self.folder / FIGURES, figures)
        tidy(self.folder)
        return figures

    def farewell(self, console: Console) -> None:
        """Say what is kept of a race that was stopped, and how to go on."""
        said = f"stopped: {self.kept()}; the same command goes on from there: {self.command}"
        console.print(said, markup=False)

    def kept(self) -> str:
        """Say how much of it is on disk."""
        from .optim.run import Run

        done = sum(min(Run.open(entry.run.path).count, self.budget) for entry in self.entries if entry.run.path)
        return f"{done} of {self.budget * len(self.entries)} episodes are kept in {self.folder}"

    def _announce(self, console: Console, executor: Executor | None) -> float | None:
        """Say what is left to compute, and return what an episode with gradient costs if any method asks for it."""
        from .landscapes.spread import workers_of
        from .optim.registry import optimizer_class

        env = self.env
        console.print(f"{env.name} · {env.fidelity.name} · {env.device} · {self.folder}", markup=False)
        needs = {method: optimizer_class(method).needs_grad for method in self.methods}
        left = {way: sum(self._left(entry) for entry in self.entries if needs[entry.method] == way) for way in (0, 1)}
        whole = self.budget * len(self.entries)
        racers = f"{', '.join(self.methods)}, {seeds_said(self.seeds)} each"
        if not any(left.values()):
            console.print(f"{racers}: all {whole} episodes are there already", markup=False)
            return None
        with console.status(f"{env.name}: preparing (kernels are compiled once, then kept)"):
            cost = self._cost(executor, grad=any(needs.values()))
        known = [entry.run.gradient_cost for entry in self.entries if entry.run.gradient_cost]
        seconds = cost.forward * left[0] + (cost.gradient * left[1] if left[1] else 0.0)
        there = f", {whole - sum(left.values())} are there already" if sum(left.values()) < whole else ""
        many = workers_of(executor) if executor else self.workers
        at_once = f", {many} runs at a time" if many > 1 else ""
        console.print(
            f"{racers}: {sum(left.values())} episodes to compute{there}: {duration(seconds)} one by one, "
            f"and what the methods take themselves{at_once}",
            markup=False,
        )
        return (known[0] if known else cost.ratio) if any(needs.values()) else None

    def _cost(self, executor: Executor | None, *, grad: bool) -> Cost:
        from .optim.search import episode_cost

        return race_workers.cost(executor, self.env, grad=grad) if executor else episode_cost(self.env, grad=grad)

    def _left(self, entry: racing.Entry) -> int:
        return max(0, self.budget - entry.run.count)


class Lines:
    """What the display says of each method: episodes done and the best loss so far, over its seeds."""

    def __init__(self, job: Job) -> None:
        self._runs: dict[tuple[str, int], tuple[int, int, float]] = {}
        for entry in job.entries:
            loss = entry.run.table()["loss"].to_numpy()[: job.budget].tolist()
            self._runs[entry.method, entry.seed] = (len(loss), sum(map(math.isnan, loss)), _least(loss))

    def take(self, entry: racing.Entry, now: Progress) -> None:
        """Take in how far a run is."""
        self._runs[entry.method, entry.seed] = (min(now.done, now.total), now.failed, now.best)

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


def _least(losses: Sequence[float]) -> float:
    return min((loss for loss in losses if not math.isnan(loss)), default=math.nan)


def _require(
    env: Environment,
    methods: Sequence[str],
    options: Mapping[str, dict[str, str]],
    *,
    seeds: int,
    budget: int,
    folder: Path,
) -> None:
    """Refuse a race that is larger than this machine."""
    from .optim.memory import Search, require_method, require_runs

    require_runs(env.space.dim, budget, seeds, folder, abreast=len(methods))
    for method in methods:
        optimizer = made(method, env, seed=0, options=options.get(method, {}))
        require_method(method, optimizer.options, Search(env.space.dim, env.decisions, budget))


def _entry(env: Environment, maker: Any, folder: Path, *, budget: int, command: str, force: bool) -> racing.Entry:
    from .optim.race import Entry
    from .optim.run import Run

    optimizer = maker()
    method, seed = optimizer.name, optimizer.seed
    path = folder / f"{method}-{seed}" / STORE
    wanted: dict[str, Any] = {
        "identity": run_identity(env, optimizer),
        "provenance": provenance_of(env, command),
        "budget": budget,
    }
    if force and path.exists():
        run = Run.create(path, env.space, overwrite=True, **wanted)
    else:
        run = Run.open_or_create(path, env.space, **wanted)
    return Entry(method, seed, run, maker)


def _folder(env: Environment, options: Mapping[str, dict[str, str]]) -> Path:
    """Return a folder of its own for every different race; more methods, seeds or episodes go on in the same one."""
    settings = json.dumps([env.identity(), options], sort_keys=True)
    digest = hashlib.sha256(settings.encode()).hexdigest()[:6]
    return Path("out") / f"race-{env.name}-{env.fidelity.name}-{digest}"


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: what is not finite is null."""
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
