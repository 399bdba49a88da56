"""The command `landscape`: its verbs in the groups and the order of its help, and how it ends."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable
from inspect import signature
from io import TextIOWrapper
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from . import __version__
from .commands import gallery
from .commands.bench import bench
from .commands.card import card
from .commands.census import census
from .commands.check import check
from .commands.compare import compare
from .commands.dims import TakesDims
from .commands.envs import envs
from .commands.export import export
from .commands.extremes import extremes
from .commands.info import info
from .commands.league import league
from .commands.optimize import methods, optimize
from .commands.overlay import overlay
from .commands.pairs import pairs
from .commands.plan import plan
from .commands.race import race
from .commands.replay import replay
from .commands.report import report_
from .commands.slice import bounce, slice_
from .commands.surface import surface
from .commands.sweep import sweep
from .commands.tradeoff import tradeoff
from .commands.view import view


class Listed(TyperGroup):
    """Verbs that help lists with their first sentences in full, those of the command in groups."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the verbs of each group under its heading."""
        groups = GROUPS if ctx.parent is None else {"Commands": tuple(self.commands)}
        for heading, verbs in groups.items():
            with formatter.section(heading):
                formatter.write_dl([(name, _first_sentence(self.commands[name])) for name in map(_name, verbs)])


class Verbs(Listed):
    """The verbs of the command, of which Ctrl-C ends as it is raised: the library would make an exit code of it."""

    def invoke(self, ctx: Any) -> Any:
        """Run a verb; return what Ctrl-C has raised, for `main` to raise it again."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stop:
            return stop


app = typer.Typer(
    name="landscape",
    cls=Verbs,
    help="See, measure and search the loss landscapes of differentiable simulators.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

STOPPED = 130  # the exit code of what Ctrl-C has ended
LONG = 200  # characters of a path that an error shows
_GALLERY = "gallery"
GROUPS: dict[str, tuple[Callable[..., None] | str, ...]] = {  # of the help: heading -> verbs
    "Look": (slice_, bounce, sweep, replay, surface, overlay, compare, view, envs, info),
    "Measure": (check, report_, census, pairs, tradeoff, extremes, card, bench, plan),
    "Search": (methods, optimize, race, league),
    "Publish": (export, _GALLERY),
}


def _name(verb: Callable[..., None] | str) -> str:
    """Return what is typed for a verb."""
    return verb if isinstance(verb, str) else verb.__name__.rstrip("_")


def _first_sentence(command: Any) -> str:
    return " ".join(str(command.help).partition("\n\n")[0].split())


for _verb in (one for verbs in GROUPS.values() for one in verbs):
    if not isinstance(_verb, str):
        app.command(_name(_verb), cls=TakesDims if "dims" in signature(_verb).parameters else None)(_verb)
_gallery = typer.Typer(cls=Listed, help="Compute the figures of the paper, and build a site that shows them offline.")
for _verb in (gallery.compute, gallery.list_, gallery.build, gallery.serve):
    _gallery.command(_name(_verb))(_verb)
app.add_typer(_gallery, name=_GALLERY)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(f"gradscape {__version__}")
        raise typer.Exit()
    _help_without_verb(context)


@_gallery.callback(invoke_without_command=True)
def _help_without_verb(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit()


def main(arguments: list[str] | None = None) -> Any:
    """Run the command; bad input ends with one line on standard error and exit code 2."""
    from typer.exceptions import TyperException

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file's name need not be text
    try:
        code = _run(arguments)
    except TyperException as error:
        code = _fail(_usage(error), 2)
    except ValueError as error:
        code = _fail(str(error), 2)
    except OSError as error:
        code = _fail(_system(error), 1)
    except (MemoryError, RuntimeError) as error:
        code = _fail(_memory(error), 1)
    except (KeyboardInterrupt, typer.Abort) as stop:
        code = _stop(stop) or _fail("stopped before anything was computed; the same command begins again", 130)
    sys.exit(code)


def _run(arguments: list[str] | None) -> Any:
    """Run the command, and raise what Ctrl-C has raised in a verb again."""
    code = app(args=arguments, prog_name="landscape", standalone_mode=False)
    if isinstance(code, KeyboardInterrupt):
        raise code
    if code == STOPPED:  # what the library makes of Ctrl-C where no verb has begun
        raise KeyboardInterrupt
    return code


def _stop(stop: BaseException) -> int:
    """Say what is kept of a job that was stopped; return 0 where nothing was begun."""
    from .jobs.watch import Stopped

    if not isinstance(stop, Stopped):
        return 0
    again = shlex.join(["landscape", *sys.argv[1:]])
    then = "goes on from there" if stop.kept else "begins again"
    _say(f"stopped: {stop}; the same command {then}: {again}")
    return STOPPED


def _usage(error: Any) -> str:
    """Return what is wrong with a command's words, and where it is said what the command takes."""
    context = getattr(error, "ctx", None)
    said = error.format_message().rstrip(".")
    return f"{said} (`{context.command_path} --help` says what it takes)" if context else said


def _system(error: OSError) -> str:
    """Return what to say where the system refused: of a full disk how to go on, of a file which, why and what to do."""
    from .landscapes.storage.disk import DiskFullError, is_full

    if not isinstance(error, DiskFullError) and is_full(error):
        return (
            f"the disk is full ({error}); each file that is there is whole: make room, and give the same command again"
        )
    if error.filename is None or error.strerror is None:
        return str(error)
    name = os.fsdecode(error.filename2 or error.filename)
    return f"{name if len(name) < LONG else name[:LONG] + '...'}: {error.strerror.lower()}; give another path"


def _memory(error: Exception) -> str:
    """Return what to say where the host or a GPU ran out of memory; raise any other error again."""
    from .landscapes.sampling.memory import ADVICE, is_out_of_memory

    if not is_out_of_memory(error):
        raise error
    said = str(error) or "the host has no more"
    return said if ADVICE in said else f"out of memory: {said}; {ADVICE}"


def _fail(message: str, code: int) -> int:
    _say(f"landscape: {' '.join(message.split())}")
    return code


def _say(line: str) -> None:
    """Print a line on standard error; what others have put into it cannot steer the terminal."""
    from .landscapes.plain import printable

    typer.echo(printable(line), err=True)
