"""What `landscape optimize` and `landscape methods` do and print: methods, costs, progress, summaries."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..envs.registry import make
from ..jobs.scene import provenance as provenance_of
from ..landscapes.cost import duration
from ..landscapes.storage.disk import until_full
from ..landscapes.storage.files import clear, tidy, visible_files, write_json
from ..optim.registry import METHODS, code_digest, optimizer_class
from .arguments import read_settings
from .console import chosen_fidelity
from .terminal import Console, Described, table

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..optim import search as loop
    from ..optim.base import Optimizer
    from ..optim.run import Run

STORE, PICTURE, SUMMARY = "run.zarr", "progress.png", "summary.json"


def list_methods() -> None:
    """Print every method as a table, without importing any."""
    found = table("name", "what it does", "needs", title="methods")
    for method in METHODS.values():
        found.add_row(method.name, method.summary, f"extra {method.extra}" if method.extra else "")
    console = Console()
    console.print(found)
    console.print("`landscape methods NAME` shows one in full: what it does, its options and their defaults.")


def describe_method(name: str) -> None:
    """Print all there is to know about one method."""
    import inspect

    from ..envs.options import in_full

    kind, console = optimizer_class(name), Console(soft_wrap=True, highlight=False)
    said = [METHODS[name].summary, inspect.getdoc(kind) or "", f"gradients: {'yes' if kind.needs_grad else 'no'}"]
    said += [in_full(kind.Options)]
    console.print(f"{name}: " + "\n\n".join(said), markup=False)


def made(name: str, env: Environment, *, seed: int, options: dict[str, str]) -> Optimizer:
    """Make a method for an environment, with options given as text."""
    kind = optimizer_class(name)
    from ..envs.options import read_options
    from ..optim.memory import Search, require_method

    chosen = read_options(name, kind.Options, options)
    require_method(name, chosen, Search(env.space.dim, env.decisions))
    return kind.on(env, seed=seed, options=chosen)


def give_torch_one_thread() -> None:
    """Let a method's numbers depend on its seed alone: how a model rounds depends on how many threads share its sums.

    Models of a thousand points gain little by a second one, and wait long for it where other work runs.
    """
    import torch

    torch.set_num_threads(1)


def run_identity(env: Environment, optimizer: Optimizer) -> dict[str, Any]:
    """Return what decides a run's numbers; the budget does not, so that a run can be continued to a larger one."""
    return {
        **env.identity(),
        "method": optimizer.name,
        "method_options": asdict(optimizer.options),
        "method_code": code_digest(type(optimizer)),
        "seed": optimizer.seed,
    }


def optimize(
    name: str,
    method: str,
    *,
    budget: int,
    seed: int,
    fidelity: str | None,
    tolerance: str | None,
    device: str,
    engine: str,
    deterministic: bool,
    settings: Sequence[str],
    method_settings: Sequence[str],
    out: str | None,
    as_json: bool,
    force: bool,
    prints: Sequence[float] = (),
) -> None:
    """Run a method into its folder and say what it costs, how far it is and what came out."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    options = read_settings(method_settings, "--option")
    how: dict[str, Any] = {"device": device, "engine": engine}
    scene = read_settings(settings)
    accuracy = chosen_fidelity(console, name, tolerance, fidelity=fidelity, **how, options=scene)
    env = make(name, fidelity=accuracy, deterministic=deterministic, **how, **scene)
    give_torch_one_thread()
    optimizer, command = made(method, env, seed=seed, options=options), shlex.join(["landscape", *sys.argv[1:]])
    job = Job.open(env, optimizer, budget=budget, command=command, out=out, force=force, prints=prints)
    try:
        with until_full(job.kept):
            summary = job.run(console)
    except KeyboardInterrupt:
        job.farewell(console)
        sys.exit(130)
    if as_json:
        print(json.dumps({**summary, "folder": str(job.folder)}))
    console.print(_outcome(summary) + f"\n{job.folder}: {', '.join(summary['files'])}", markup=False)


@dataclass(frozen=True)
class Job:
    """A run to fill in `folder`, and to draw for pages of the widths of `prints` [mm], too."""

    env: Environment
    optimizer: Optimizer
    folder: Path
    filled: Run
    budget: int
    command: str
    prints: Sequence[float] = ()

    @classmethod
    def open(
        cls,
        env: Environment,
        optimizer: Optimizer,
        *,
        budget: int,
        command: str,
        out: str | None = None,
        force: bool = False,
        prints: Sequence[float] = (),
    ) -> Job:
        """Go on with the run in its folder, or begin it there; `force` begins anew where another run is."""
        from ..optim.memory import Search, require_method, require_runs
        from ..optim.run import Run

        identity = run_identity(env, optimizer)
        folder = Path(out) if out else run_folder(identity)
        require_runs(env.space.dim, budget, 1, folder)
        require_method(optimizer.name, optimizer.options, Search(env.space.dim, env.decisions, budget))
        path = folder / STORE
        if not path.exists() and visible_files(folder):
            raise ValueError(f"{folder} holds other files and no run; give --out a new or an empty folder")
        wanted: dict[str, Any] = {"identity": identity, "provenance": provenance_of(env, command), "budget": budget}
        if force and path.exists():
            run = Run.create(path, env.space, overwrite=True, **wanted)
            clear(folder, (PICTURE, SUMMARY), PICTURE)
        else:
            run = Run.open_or_create(path, env.space, **wanted)
        return cls(env, optimizer, folder, run, budget, command, prints)

    def run(self, console: Console) -> dict[str, Any]:
        """Compute what is missing, draw it, write and return the summary."""
        start, resumed = time.monotonic(), self.filled.count
        if resumed < self.budget:
            resumed = self._fill(console)
        else:
            console.print(f"{self._where()}\nall {self.budget} episodes are there already", markup=False)
        self.picture()
        return self._summarise(resumed, time.monotonic() - start, self._print())

    def _fill(self, console: Console) -> int:
        """Search, following it on a progress bar, and return how many episodes were there before."""
        from ..optim.search import search

        ratio, resumed = self._announce(console), 0
        with search_progress(console) as bar:
            task = bar.add_task("episodes", total=self.budget, completed=self.filled.count)

            def follow(now: loop.Progress) -> None:
                nonlocal resumed
                resumed = now.resumed
                failed = f", {now.failed} failed" if now.failed else ""
                bar.update(task, completed=now.done, description=f"best loss {now.best:.4g}{failed}")

            search(self.env, self.optimizer, self.filled, budget=self.budget, gradient_cost=ratio, progress=follow)
        return resumed

    def picture(self) -> None:
        """Draw the run as it is on disk, if there is anything to draw."""
        from ..landscapes.draw.figures.curve import run_figure
        from ..landscapes.draw.figures.page import save

        if self.filled.count:
            save(run_figure(self.filled.table()), self.folder / PICTURE)

    def _print(self) -> list[str]:
        from ..landscapes.draw.figures.curve import run_figure
        from ..landscapes.draw.figures.page import save_prints

        path = self.folder / PICTURE  # the table is read only where it is printed
        return save_prints(lambda width: run_figure(self.filled.table(), width=width), path, self.prints)

    def farewell(self, console: Console) -> None:
        """Say what is kept of a run that was stopped, and how to go on."""
        kept = self._on_disk()
        kept.picture()
        said = f"stopped: {kept.kept()}; the same command goes on from there: {self.command}"
        console.print(said, markup=False)

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self._on_disk().filled.count} of {self.budget} episodes are kept in {self.folder}"

    def _on_disk(self) -> Job:
        from ..optim.run import Run

        return replace(self, filled=Run.open(self.folder / STORE), prints=())

    def _announce(self, console: Console) -> float | None:
        """Say what is left to compute and return what a gradient costs, as far as the method asks for any."""
        from ..landscapes.cost import episode_cost

        run, grad = self.filled, self.optimizer.needs_grad
        with console.status(f"{self.env.name}: preparing (kernels are compiled once, then kept)"):
            cost = episode_cost(self.env, grad=grad and run.gradient_cost is None)
        ratio, left = run.gradient_cost or cost.ratio, self.budget - run.told
        kept = f", {run.told} are there already" if run.told else ""
        most = duration(left * cost.forward)
        said = f"{most} without gradients, {duration(left * cost.forward * ratio)} with" if grad else most
        console.print(
            f"{self._where()}\n{left} episodes to compute{kept}: one by one {said}, and what the method takes itself",
            markup=False,
        )
        return ratio if grad else None

    def _where(self) -> str:
        return f"{self.env.name} · {self.env.fidelity.name} · {self.env.device} · {self.optimizer.name} · {self.folder}"

    def _summarise(self, resumed: int, seconds: float, printed: Sequence[str]) -> dict[str, Any]:
        files = [STORE, PICTURE, *printed, SUMMARY]
        summary = {**_summary(self.filled, resumed, seconds, self.command), "files": files}
        write_json(self.folder / SUMMARY, summary)
        tidy(self.folder)
        return summary


def run_folder(identity: dict[str, Any]) -> Path:
    """Return a folder of its own for every different run, the same for the same one."""
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:6]
    parts = [identity["objective"], identity["method"], identity["fidelity"], f"s{identity['seed']}", digest]
    return Path("out") / "-".join(parts)


def search_progress(console: Console) -> Progress:
    """Return a progress display for one run or several."""
    columns = (Described(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=console)


def _summary(run: Run, resumed: int, seconds: float, command: str) -> dict[str, Any]:
    from ..landscapes.objective import Status
    from ..optim.base import Kind

    table, identity = run.table(), run.identity
    best = None
    if run.count > run.failed:
        row = int(table["loss"].argmin("evaluation"))
        best = {"loss": float(table["loss"][row]), "episode": row + 1, "x": table["x"][row].to_numpy().tolist()}
    return {
        "env": identity["objective"],
        "method": identity["method"],
        "seed": identity["seed"],
        "budget": run.budget,
        "fidelity": identity["fidelity"],
        "device": identity["device"],
        "options": identity["options"],
        "method_options": identity["method_options"],
        "episodes": run.count - resumed,
        "resumed": resumed,
        "seconds": round(seconds, 3),
        "forwards": float(table["forwards"][-1]),
        "gradient_cost": run.gradient_cost,
        "status": {kind.name.lower(): int((table["status"] == kind).sum()) for kind in Status if kind},
        "kinds": {kind.name.lower(): int((table["kind"] == kind).sum()) for kind in Kind},
        "best": best,
        "command": command,
    }


def _outcome(summary: dict[str, Any]) -> str:
    best = summary["best"]
    said = f"best loss {best['loss']:.6g} at episode {best['episode']}" if best else "no episode succeeded"
    failed = sum(count for status, count in summary["status"].items() if status != "ok")
    failures = f"; {failed} failed" if failed else ""
    return f"{summary['episodes']} episodes in {duration(summary['seconds'])}; {said}{failures}"
