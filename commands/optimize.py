"""`landscape optimize` and `landscape methods`: search by one method, and what the methods are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import Budget, ForceRun, Json, OutOfRun, Print, read_settings, takes_scene


def methods(name: Annotated[str | None, typer.Argument(help="One method, to see all of it.")] = None) -> None:
    """List the optimisation methods: what each does, its options and their defaults. Writes nothing.

    Example: landscape methods bo-leap
    """
    _describe(name) if name else _list()


@takes_scene()
def optimize(
    scene: SceneSpec,
    method: Annotated[str, typer.Option(help="The method; `landscape methods` lists them.")],
    budget: Budget = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    option: Annotated[list[str] | None, typer.Option(help="A method's option, name=value; may be repeated.")] = None,
    out: OutOfRun = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceRun = False,
) -> None:
    """Search an environment's parameters for the least loss, and keep every point that was evaluated.

    The folder then holds run.zarr (every episode), progress.png and summary.json. Stop it at any moment: the same
    command goes on where it stopped. With a larger budget it goes on from the end, to the run that had this budget from
    the beginning.

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
