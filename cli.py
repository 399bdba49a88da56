"""The command `landscape`: verbs made from the functions of `api`, in the groups of its help, and exit codes."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import import_module
from inspect import Parameter as Slot
from inspect import Signature, getdoc, signature
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, get_args

from cyclopts import App, CycloptsError, Group, MissingArgumentError, Parameter, UnusedCliTokensError, convert

from . import __version__
from .commands.results import LIVE, as_json, kind_of, shower

GROUPS = {  # of the help: heading -> verbs, each with the module of `api` that declares it
    "Look": {
        "explore": "explore",
        "slice": "slice",
        "bounce": "slice",
        "sweep": "sweep",
        "replay": "replay",
        "surface": "surface",
        "overlay": "overlay",
        "compare": "compare",
        "view": "view",
        "envs": "environments",
        "info": "info",
    },
    "Measure": {
        "check": "measure",
        "report": "report",
        "census": "measure",
        "pairs": "measure",
        "hessian": "measure",
        "remedy": "measure",
        "study": "study",
        "card": "measure",
        "bench": "measure",
        "plan": "plan",
    },
    "Search": {
        "advise": "search",
        "methods": "environments",
        "optimize": "search",
        "race": "search",
        "league": "search",
    },
    "Publish": {
        "export": "export",
        "gallery compute": "gallery",
        "gallery list": "gallery",
        "gallery build": "gallery",
        "gallery serve": "gallery",
    },
}
ABOUT = "See, measure and search the loss landscapes of differentiable simulators."
GALLERY = "Compute the figures of the paper, and build a site that shows them offline."
RENAMED = {  # verbs and options of earlier versions, and today's
    "tradeoff": "landscape study fidelity, model, convergence or mixed",
    "extremes": "landscape study extremes",
    "--against": "--second-engine",
    "--also": "--second-fidelity",
    "--extent": "--window",
    "--print": "--figure-width-mm",
    "--report": "--claims",
}
SEVERAL = (Slot.VAR_POSITIONAL, Slot.VAR_KEYWORD)
ALL_KINDS = (Slot.POSITIONAL_ONLY, Slot.POSITIONAL_OR_KEYWORD, Slot.KEYWORD_ONLY, *SEVERAL)
STOPPED = 130  # the exit code of what Ctrl-C has ended
LONG_PATH = 200  # characters of a path that an error shows
DIMS = "--dims"
JSON = Annotated[bool, Parameter(show_default=False, help="Print the result as one JSON object on standard output.")]


def _read(hint: Any, words: Sequence[Any]) -> Any:
    """Return the value of an option; a count such as 8.5 is refused, where Cyclopts would round it."""
    for word in words if int in (hint, *get_args(hint)) else ():
        try:
            int(word.value)
        except ValueError:
            raise ValueError(f"not a whole number: {word.value}") from None
    return convert(hint, words)


WORDS = Parameter(negative_bool=(), negative_iterable=(), allow_repeating=True, converter=_read)


@dataclass(frozen=True)
class Option:
    """An argument or an option of a verb: its names on the command line, its help, its type and its default."""

    names: tuple[str, ...]
    help: str
    type: Any
    required: bool
    default: str
    """The default as help shows it, empty where help shows none."""


@dataclass(frozen=True)
class Verb:
    """A verb of the command: the public function that declares it, under the words that are typed for it."""

    words: str
    function: Callable[..., Any]
    planned: bool = False

    @cached_property
    def displayed(self) -> dict[str, Slot]:
        """The options of what shows its result, by name."""
        slots = (slot for kind in _returned(self.function) for slot in _slots(shower(kind), (Slot.KEYWORD_ONLY,)))
        return {slot.name: slot for slot in slots}

    @property
    def parameters(self) -> list[Slot]:
        """Its arguments and options: those of the function, of what shows its result, and --json where there is one."""
        own = _slots(self.function)
        if set(_returned(self.function)) <= LIVE:
            return own
        last = own.pop() if own and own[-1].kind is Slot.VAR_KEYWORD else None
        whole = [*own, *self.displayed.values(), Slot("json", Slot.KEYWORD_ONLY, default=False, annotation=JSON)]
        return [*whole, last] if last else whole

    def command(self) -> Callable[..., int]:
        """Return what the command line calls."""

        def call(*given: Any, **named: Any) -> int:
            return self.run(given, named)

        call.__doc__ = self.help()
        slots = self.parameters
        call.__signature__ = Signature(slots)  # type: ignore[attr-defined]
        call.__annotations__ = {slot.name: slot.annotation for slot in slots}
        return call

    @property
    def options(self) -> list[Option]:
        """Its arguments and options as they are typed, arguments first."""
        app = App(name="verb", default_command=self.command(), help_flags=(), version_flags=())
        listed = app.assemble_argument_collection(default_parameter=WORDS, parse_docstring=True)
        return [
            Option(
                tuple(one.names),
                one.parameter.help or "",
                one.hint,
                bool(one.required),
                "" if one.required or not one.show_default else str(one.field_info.default),
            )
            for one in listed
            if one.names
        ]

    def help(self) -> str:
        """Return its docstring without what is for Python alone, and with the options of what shows its result."""
        said, options = _docstring(self.function)
        for kind in _returned(self.function):
            options |= _docstring(shower(kind))[1]
        paragraphs = [" ".join(one.split()) for one in said.split("\n\n") if not one.startswith("Raises ")]
        words = "\n".join(f"{name}\n    {text}" for name, text in options.items())
        return "\n\n".join(paragraphs) + (f"\n\nParameters\n----------\n{words}" if words else "")

    def run(self, given: Sequence[Any], named: dict[str, Any]) -> int:
        """Call the function, show what it returns, and return the exit code."""
        from .api.call import Call, calling
        from .api.plan import plan
        from .commands.next import next_command
        from .commands.terminal import Bars, Console, command_line

        shown = {name: named.pop(name) for name in self.displayed.keys() & named.keys()}
        as_object, results, code = named.pop("json", False), [], 0
        calls = _for_each_point(named)
        for one in calls if len(calls) > 1 else ():
            _refuse(self.function, given, one)
        for one in calls:
            bars = Bars()
            with calling(Call(command_line(), bars, on_disk=True)):
                words = (self.function, *given) if self.planned else given
                result = (plan if self.planned else self.function)(*words, **one)
                show = shower(kind_of(result))
                if show is not None:
                    code = max(code, show(result, Console(stderr=as_object), **shown) or 0)
                if not as_object and (then := next_command(kind_of(result), result, given, bars.folder)):
                    bars.note(f"next: {then}")
            results.append(as_json(result, bars.folder) if as_object else None)
        if as_object:
            import json

            whole = results[0] if len(results) == 1 else {f"{self.words}s": results}
            print(json.dumps({"command": command_line(), **whole} if isinstance(whole, dict) else whole))
        return code


def _refuse(function: Callable[..., Any], given: Sequence[Any], named: dict[str, Any]) -> None:
    """Raise what one of several calls would be refused with, before any of them is begun."""
    from .api.call import Call, calling
    from .api.plan import work_of
    from .jobs.watch import Watch

    with calling(Call("", Watch(), on_disk=True)):
        work_of(function, given, named)


def _slots(function: Callable[..., Any] | None, kinds: Sequence[Any] = ALL_KINDS) -> list[Slot]:
    """Return a function's parameters for the command line: arguments are those that are marked, all else is options."""
    from .api.call import hint_of
    from .api.options import ARGUMENT

    slots = []
    for slot in signature(function).parameters.values() if function else ():
        hint, kind = hint_of(function, slot.annotation), slot.kind
        if kind not in kinds or (kind in SEVERAL and hint is Any):
            continue  # of a plan: the words of another verb
        if slot.default is None or slot.default is False or slot.default == ():
            hint = Annotated[hint, Parameter(show_default=False)]
        if ARGUMENT in getattr(hint, "__metadata__", ()) and kind is not Slot.VAR_POSITIONAL:
            kind = Slot.POSITIONAL_ONLY
        elif kind is Slot.POSITIONAL_OR_KEYWORD:
            kind = Slot.KEYWORD_ONLY
        slots.append(slot.replace(kind=kind, annotation=hint))
    return slots


def _returned(function: Callable[..., Any]) -> list[str]:
    """Return the names of the types that a function returns, none where it returns nothing."""
    written = str(signature(function).return_annotation)
    return [] if written == "None" else written.split(" | ")


def _docstring(function: Callable[..., Any] | None) -> tuple[str, dict[str, str]]:
    """Return the text of a docstring, and the help of each parameter by name."""
    said, _, listed = ((getdoc(function) or "") if function else "").partition("\n\nParameters\n----------\n")
    options, name = dict[str, str](), ""
    for line in listed.splitlines():
        if line.startswith(" "):
            options[name] = f"{options[name]} {line.strip()}".strip()
        elif line:
            options[name := line.strip()] = ""
    return said, options


def _for_each_point(named: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the options of each slice or sweep where --through names several points, A,B, with a folder for each."""
    if "," not in str(named.get("through", "")):
        return [named]
    from .jobs.cut import folder_for, split_points

    points = split_points(named["through"])
    out = named.get("out")
    return [
        named | {"through": point} | ({"out": folder_for(Path(out), point, points)} if out else {}) for point in points
    ]


@cache
def verbs() -> dict[str, Verb]:
    """Return every verb by what is typed after `landscape`; what simulates is not imported for that."""
    return {words: find_verb(words) for group in GROUPS.values() for words in group}


@cache
def find_verb(words: str) -> Verb:
    """Return a verb, importing the module of `api` that declares it."""
    module = next(group[words] for group in GROUPS.values() if words in group)
    found = import_module(f".api.{module}", __package__)
    name = words.split()[-1]
    return Verb(words, getattr(found, name, None) or getattr(found, f"{name}_"))


def make_app(only: Sequence[str] = (), *, planned: bool = False) -> App:
    """Make the command with all verbs, or with those of `only` these words, which may be `planned` and not done."""
    panels = {heading: Group(heading, sort_key=number) for number, heading in enumerate(GROUPS, 1)}
    look: Any = {"default_parameter": WORDS, "help_format": "plaintext"}
    app = App(
        name="landscape", help=ABOUT, version=f"gradscape {__version__}", suppress_keyboard_interrupt=False, **look
    )
    gallery = App(name="gallery", help=GALLERY, group=panels["Publish"], **look)
    for heading, group in GROUPS.items():
        for words in group:
            if only and words not in only:
                continue
            *of, name = words.split()
            verb = replace(find_verb(words), planned=planned)
            place: Any = {} if of else {"group": panels[heading], "sort_key": len(app._commands)}
            (gallery if of else app).command(verb.command(), name=name, **place)
    if not only or any(words.startswith("gallery ") for words in only):
        app.command(gallery)
    return app


def main(arguments: list[str] | None = None) -> Any:
    """Run the command; bad input ends with one line on standard error and exit code 2."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file's name need not be text
    try:
        code = _run(sys.argv[1:] if arguments is None else arguments)
    except CycloptsError as error:
        code = _fail(_usage(error), 2)
    except ValueError as error:
        code = _fail(str(error), 2)
    except OSError as error:
        code = _fail(_system(error), 1)
    except (MemoryError, RuntimeError) as error:
        code = _fail(_memory(error), 1)
    except KeyboardInterrupt as stop:
        code = _stop(stop) or _fail("stopped before anything was computed; the same command starts again", STOPPED)
    sys.exit(code)


def _run(words: list[str]) -> Any:
    """Run the command with these words."""
    written = [words[:1], *([word.partition("=")[0]] for word in words[1:] if word.startswith("--"))]
    for (word,) in filter(None, written):
        if word in RENAMED:
            raise ValueError(f"{word} is now {RENAMED[word]}")
    planned = words[:1] == ["plan"] and not set(words[1:2]) <= {"-h", "--help"}
    words = words[planned:]
    named = next(
        (name for group in GROUPS.values() for name in group if words[: len(name.split())] == name.split()), ""
    )
    if planned and not named:
        raise ValueError(f"plan takes a verb with its arguments, such as: landscape plan slice {' '.join(words)}")
    app = make_app([named] if named else (), planned=planned)
    how: Any = {"exit_on_error": False, "print_error": False, "result_action": "return_value"}
    if DIMS not in words:
        return app(words, **how)
    try:
        return app(_dims_last(words, 2), **how)
    except MissingArgumentError:
        return app(_dims_last(words, 1), **how)


def _dims_last(words: Sequence[str], most: int) -> list[str]:
    """Return a command's words with at most so many behind --dims; the arguments that follow it are put before it."""
    found, left = list[str](), list(words)
    while left:
        found.append(left.pop(0))
        if found[-1] == DIMS:
            values = list[str]()
            while left and not left[0].startswith("-"):
                values.append(left.pop(0))
            found[-1:] = [*values[most:], DIMS, *values[:most]]
    return found


def _stop(stop: BaseException) -> int:
    """Say what is kept of a job that was stopped; return 0 where nothing was begun."""
    from .jobs.watch import Stopped

    if not isinstance(stop, Stopped):
        return 0
    again = shlex.join(["landscape", *sys.argv[1:]])
    then = "continues from there" if stop.kept else "starts again"
    _say(f"stopped: {stop}; the same command {then}: {again}")
    return STOPPED


def _usage(error: CycloptsError) -> str:
    """Return what is wrong with a command's words, and the help that lists what it takes."""
    chain = " ".join(["landscape", *(error.command_chain or ())])
    said = " ".join(str(error).split()).rstrip(".")
    if isinstance(error, UnusedCliTokensError):
        said = f"unexpected words: {shlex.join(error.unused_tokens or ())}"
    return f"{said} (see `{chain} --help`)"


def _system(error: OSError) -> str:
    """Return what to say where the system refused: of a full disk how to continue, of a file which, why and what."""
    from .landscapes.storage.files import DiskFullError, is_full

    if not isinstance(error, DiskFullError) and is_full(error):
        return (
            f"the disk is full ({error}), but every finished file is complete: free some space and run the same "
            "command again"
        )
    if error.filename is None or error.strerror is None:
        return str(error)
    name = os.fsdecode(error.filename2 or error.filename)
    return f"{name if len(name) < LONG_PATH else name[:LONG_PATH] + '...'}: {error.strerror.lower()}; use another path"


def _memory(error: Exception) -> str:
    """Return what to say where the host or a GPU ran out of memory; raise any other error again."""
    from .landscapes.sampling.memory import ADVICE, is_out_of_memory

    if not is_out_of_memory(error):
        raise error
    said = str(error) or "the host has none left"
    return said if ADVICE in said else f"out of memory: {said}; {ADVICE}"


def _fail(message: str, code: int) -> int:
    _say(f"landscape: {' '.join(message.split())}")
    return code


def _say(line: str) -> None:
    """Print a line on standard error; what others have put into it cannot steer the terminal."""
    from .landscapes.plain import printable

    print(printable(line), file=sys.stderr)
