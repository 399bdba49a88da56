"""Work in a process of its own, which may be stopped at an exact instant: as it changes its folder for the n-th time.

What a stopped job leaves behind differs only by what it has made, renamed and removed, so instants are numbered by that
and not by seconds: stopped at the same one, a process has done the same on any machine. What else a job does when a
while has passed, it does always or never.
"""

import math
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from pkgutil import walk_packages
from signal import SIGKILL, Signals
from typing import Any

import zarr

from gradscape.cli import main
from gradscape.jobs import slice as job
from gradscape.landscapes import cost
from gradscape.optim.runs import store

from .clock import Clock
from .command import Said, leave_blank

CHANGES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir"}  # events of PEP 578

# Processes are forked from one that has loaded what they need, and has used nothing of it.
FORK = get_context("forkserver")
LOADED = [
    *(f"gradscape.envs.{name}" for name in ("bounce", "engines.balls.rigid", "functions", "points")),
    *("pytest", "hypothesis", "dask.array", "jinja2", "imageio_ffmpeg", "pyvista", "rerun", "cma"),
    *("pydantic.type_adapter", "pydantic.json_schema", "pydantic.functional_validators", "pydantic.fields"),
]
for part in ("commands", "jobs", "gallery", "landscapes", "optim"):
    package = import_module(f"gradscape.{part}")
    LOADED += [one.name for one in walk_packages(package.__path__, f"{package.__name__}.")]
FORK.set_forkserver_preload(LOADED)


@dataclass(frozen=True)
class Instant:
    """The moment before a process makes, renames or removes something whose path holds `of` for the `number`-th time.

    It gets the signal `by` then; never if the number is 0.
    """

    number: int = 0
    of: str = ""
    by: Signals = SIGKILL


@dataclass(frozen=True)
class Ended(Said):
    """What a process said, and how many changes of its folder it has made of those that its instant counts."""

    changes: int


def alone(work: Callable[[], object], folder: Path, stop: Instant | None = None) -> Ended:
    """Do work in a process of its own and in a folder, and wait for its end."""
    changes = FORK.Value("i", 0, lock=False)
    with tempfile.TemporaryDirectory() as said:
        process = FORK.Process(target=_work, args=(work, folder, Path(said), changes, stop or Instant()))
        process.start()
        process.join()
        out, err = ((Path(said) / name).read_text() for name in ("out", "err"))
    assert process.exitcode is not None
    return Ended(process.exitcode, out, err, changes.value)


def landscape(*arguments: str) -> None:
    """Run the command."""
    sys.argv = ["landscape", *arguments]
    main(list(arguments))


def _work(work: Callable[[], object], folder: Path, said: Path, changes: Any, stop: Instant) -> None:
    os.chdir(folder)
    for stream, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(said / name, os.O_WRONLY | os.O_CREAT), stream)
    numbers, within = count(1), os.getcwd() + os.sep

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event in CHANGES or (event == "open" and _makes(*arguments)):
            path = os.path.abspath(os.fsdecode(arguments[0]))
            if path.startswith(within) and stop.of in path:
                changes.value = number = next(numbers)
                if number == stop.number:
                    os.kill(os.getpid(), stop.by)

    store.PAUSE, store.SHARE, cost.MOMENT = 0.0, math.inf, 0.0  # writes after every proposal, times two episodes
    job.MIN_PAUSE_SECONDS, cost.ENOUGH, cost.WARM_UP = math.inf, 0.0, 0.0  # draws no coarse picture
    cost.time = Clock(tick=2**-10)  # type: ignore[assignment] # a gradient costs the same: ranks at equal cost are of it
    zarr.config.set({"threading.max_workers": 1})  # so that its threads never take turns
    leave_blank(setattr)
    sys.addaudithook(watch)
    work()


def _makes(path: object, mode: str | None, flags: int) -> bool:
    return not isinstance(path, int) and bool(flags & os.O_CREAT)
