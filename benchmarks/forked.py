"""Run `landscape` in processes forked from one that has loaded everything, each within limits of time and memory.

A process that uses up its time gets Ctrl-C, as from a user whose patience is over, and is killed if it goes on. It may
change nothing beyond its folder, so that no command line can do harm; what it starts is looked for when it has ended.
"""

from __future__ import annotations

import errno
import os
import re
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

FORK = get_context("forkserver")
PACKAGES = ("commands", "jobs", "gallery", "landscapes", "optim")  # of which the process that forks loads all modules
LOADED = (
    *(
        one.name
        for part in PACKAGES
        for one in walk_packages(import_module(f"gradscape.{part}").__path__, f"gradscape.{part}.")
    ),
    *(
        "gradscape.envs.bounce",
        "gradscape.envs.engines.balls.rigid",
        "gradscape.envs.functions",
        "gradscape.envs.points",
    ),
    *("dask.array", "jinja2", "imageio_ffmpeg", "pyvista", "rerun", "cma", "pydantic.type_adapter"),
    *("pydantic.json_schema", "pydantic.functional_validators", "pydantic.fields"),
)
GRACE = 10.0  # seconds that what a process started has to end after it
CACHES = (Path.home() / ".cache", Path("/dev"), Path("/proc"), Path("/sys"))  # where every process may write


def load() -> None:
    """Let the process that others are forked from load what the verbs need; it uses none of it."""
    os.environ["PYTHONWARNINGS"] = "ignore::RuntimeWarning:runpy"  # that a program is imported by its parts, too
    FORK.set_forkserver_preload([*LOADED, "benchmarks.commands", "benchmarks.results"])


@dataclass(frozen=True)
class Limits:
    """What a process gets: seconds of CPU and of the clock before Ctrl-C, and bytes on top of what it has loaded."""

    cpu: float = 20.0
    clock: float = 60.0
    memory: float = 4e9


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit code (minus the signal that killed it) and what it said.

    `stopped` says whether its time was over before; `left` names processes of its that still lived then.
    """

    code: int
    out: str
    err: str
    stopped: bool = False
    left: tuple[str, ...] = ()


def landscape(
    command: Sequence[str],
    folder: Path,
    *,
    limits: Limits | None = None,
    before: Callable[[], object] | None = None,
) -> Ended:
    """Run a command line in a folder, after `before`; data and temporary files that are a user's are under it, too."""
    return alone(say, list(command), folder=folder, limits=limits, before=before)


def alone(
    work: Callable[..., object],
    *given: Any,
    folder: Path,
    limits: Limits | None = None,
    before: Callable[[], object] | None = None,
) -> Ended:
    """Call a function in a process of its own and in a folder, and wait for its end."""
    limits = limits or Limits()
    with tempfile.TemporaryDirectory() as said:
        process = FORK.Process(target=_begin, args=(work, given, folder, Path(said), limits, before))
        process.start()
        assert process.pid is not None
        process.join(limits.clock + 20)
        if process.is_alive():
            (Path(said) / "stopped").touch()
            process.kill()
        process.join()
        left = ended(process.pid)
        out, err = ((Path(said) / name).read_text(errors="replace") for name in ("out", "err"))
        stopped = (Path(said) / "stopped").exists()
    assert process.exitcode is not None
    return Ended(process.exitcode, out, err, stopped, left)


def failure(ended: Ended) -> str:
    """Say how an end is none that a command may have, nothing where it is one: by itself or by Ctrl-C, with a line."""
    said = ended.out + ended.err
    if re.search(r"MemoryError|can't allocate memory|bad_alloc|Unable to allocate|Cannot allocate memory", said):
        return "limit: memory"
    if ended.stopped and (ended.code < 0 or "Traceback (most recent call last)" in said):
        return "limit: time"
    if ended.code < 0:
        return f"signal {-ended.code}"
    if "Traceback (most recent call last)" in said:
        return "traceback"
    if ended.left:
        return f"left running: {', '.join(ended.left)}"
    if ended.code not in (0, 1, 2, 130):
        return f"exit code {ended.code}"
    return "" if ended.err.strip() or not ended.code else "silent"


def last_words(said: str, most: int = 700) -> str:
    """Return the end of what was said; of a traceback where in this package it began, and what it was."""
    if "Traceback (most recent call last)" not in said:
        return said.strip()[-most:]
    ours = re.findall(
        r'File "[^"]*?/((?:landscapes|envs|optim|gallery|gradscape)/(?!.*site-packages)[^"]*)", line (\d+), in (.*)',
        said,
    )
    errors = re.findall(r"^[A-Za-z_][\w.]*(?:: .*|$)", said[said.index("Traceback") :], re.MULTILINE)
    where = " < ".join(f"{name}:{line} {function}" for name, line, function in reversed(ours[-3:]))
    return f"{errors[-1][:most] if errors else said.strip()[-200:]} ({where})"


def _begin(
    work: Callable[..., object],
    given: Sequence[Any],
    folder: Path,
    said: Path,
    limits: Limits,
    before: Callable[[], object] | None,
) -> None:
    os.setsid()  # a group of its own, so that what it leaves running is found
    os.chdir(folder)
    for stream, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(said / name, os.O_WRONLY | os.O_CREAT), stream)
    at_home(folder.resolve())
    _limit(limits, said / "stopped")
    _keep_within(folder.resolve(), said)
    if before:
        before()
    work(*given)


def at_home(folder: Path) -> None:
    """Let a user's data and temporary files be under a folder, and no display be there."""
    for name, place in (("XDG_DATA_HOME", "home"), ("TMPDIR", "tmp")):
        (folder / place).mkdir(exist_ok=True)
        os.environ[name] = str(folder / place)
    tempfile.tempdir = None
    os.environ |= {"COLUMNS": "160"}
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        os.environ.pop(name, None)


def say(command: Sequence[str]) -> None:
    """Run a command line in this process, which it ends."""
    import torch

    from gradscape.cli import main

    torch.set_num_threads(1)
    sys.argv = ["landscape", *command]
    main(list(command))


def _limit(limits: Limits, stopped: Path) -> None:
    """Send Ctrl-C when the time is over, and end the process fifteen seconds of CPU later."""

    def patience_is_over(*_: object) -> None:
        stopped.touch()
        raise KeyboardInterrupt

    signal.signal(signal.SIGXCPU, patience_is_over)
    signal.signal(signal.SIGALRM, patience_is_over)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, limits.clock)
    seconds = max(1, round(limits.cpu))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 15))  # what torch has built takes some to take down
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    room = pages * resource.getpagesize() + int(limits.memory)
    resource.setrlimit(resource.RLIMIT_AS, (room, room))


def _keep_within(*folders: Path) -> None:
    """Refuse every change of files elsewhere, as a system does where a user may not write."""
    allowed = tuple(str(folder) + os.sep for folder in (*folders, *CACHES))

    def watch(event: str, given: tuple[Any, ...]) -> None:
        if event == "open":
            path, _, flags = given
            changes = not isinstance(path, int) and flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR | os.O_TRUNC)
            paths = [path] if changes else []
        elif event in ("os.mkdir", "os.remove", "os.rmdir", "shutil.rmtree", "os.symlink"):
            paths = [given[1] if event == "os.symlink" else given[0]]
        else:
            paths = list(given[:2]) if event == "os.rename" else []
        for path in paths:
            if isinstance(path, str | bytes | os.PathLike):
                name = os.fsdecode(path)
                place = os.path.join(os.path.realpath(os.path.dirname(name) or "."), os.path.basename(name))
                if not place.startswith(allowed):
                    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), name)

    sys.addaudithook(watch)


def ended(group: int) -> tuple[str, ...]:
    """Return what lives of a process's group some time after its end, and end it."""
    deadline = time.monotonic() + GRACE
    while found := tuple(name for _, name in living(group)):
        if time.monotonic() > deadline:
            break
        time.sleep(0.1)
    else:
        return ()
    with suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)
    return found


def living(group: int) -> list[tuple[int, str]]:
    """Return the number and the name of every living process of a group."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError):
            name, _, fields = status.read_text().partition(") ")
            state, _, own_group = fields.split()[:3]
            if int(own_group) == group and state not in "ZX":
                found.append((int(status.parent.name), name.partition("(")[2]))
    return found
