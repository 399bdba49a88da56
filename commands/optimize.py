"""`landscape optimize` and `landscape methods`: search by one method, and what the methods are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import Budget, ForceRun, Json, OutOfRun, Print, read_settings, takes_scene


def methods(name: Annotated[str | None, typer.Argument(help="Name of the method to describe in full.")] = None) -> None:
    """List the optimisation methods, or describe one with its options.

    It writes no file.

    Example: landscape methods bo-leap
    """
    _describe(name) if name else _list()


@takes_scene()
def optimize(
    scene: SceneSpec,
    method: Annotated[str, typer.Option(help="Method to search with. `landscape methods` lists them.")],
    budget: Budget = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    option: Annotated[
        list[str] | None, typer.Option(help="An option of the method, as name=value. It may be repeated.")
    ] = None,
    out: OutOfRun = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceRun = False,
) -> None:
    """Search for the lowest loss with one method, and keep every evaluated point.

    The folder then holds run.zarr (every episode), progress.png and summary.json. Stop at any time: the same command
    goes on from there. A larger budget continues the run, which is then the same as one that had this budget from the
    start.

    Example: landscape optimize fluid --method bo-leap --budget 300
    """
    from ..optim.registry import find_method
    from .terminal import Bars, command_line, print_json

    find_method(method)  # a name that does not exist is refused before what searches is imported
    bars, options = Bars(), read_settings(option or [], "--option")
    env = scene.make(bars)
    from ..jobs.search import SearchJob, make_optimizer

    how: dict[str, Any] = {"out": Path(out) if out else None, "force": force, "prints": print_ or []}
    optimizer = make_optimizer(method, env, seed=seed, options=options)
    job = SearchJob.of(env, optimizer, budget=budget, command=command_line(), **how)
    summary = job.run(bars)
    if json_:
        print_json(summary.record(), folder=str(job.folder))
    bars.note(f"{summary.outcome()}\n{job.folder}: {', '.join(summary.files)}")


def _list() -> None:
    """Print every method as a table; of ours none is imported for that."""
    from ..optim.registry import methods as registered
    from .terminal import Console, table

    shown = table("name", "what it does", "needs", title="methods")
    for method in registered().values():
        shown.add_row(method.name, method.summary, f"extra {method.extra}" if method.extra else "")
    console = Console()
    console.print(shown)
    console.print("`landscape methods NAME` shows one in full: what it does, its options and their defaults.")


def _describe(name: str) -> None:
    """Print all there is to know about one method."""
    import inspect

    from ..landscapes.options import in_full
    from ..optim.registry import find_method, optimizer_class
    from .terminal import Console

    kind = optimizer_class(name)
    texts = [find_method(name).summary, inspect.getdoc(kind) or "", f"gradients: {'yes' if kind.needs_grad else 'no'}"]
    Console(soft_wrap=True, highlight=False).print(f"{name}: " + "\n\n".join([*texts, in_full(kind.Options)]))
