"""Explore a landscape: a plane that is sampled while the user looks at it, with episodes and descents at its points."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Condition, Thread
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch

from ..landscapes.draw.pages.nodes import Trajectory, lay_runs, read_off_nodes
from ..landscapes.objective import Status, describe_errors, evaluate
from ..landscapes.overlay import best_point
from ..landscapes.plane import Plane
from ..landscapes.sampling.fill import Progress, describe, sample
from ..landscapes.storage.store import SliceStore

if TYPE_CHECKING:
    import xarray as xr
    from jaxtyping import Float
    from numpy.typing import NDArray
    from torch import Tensor

    from ..envs.base import Environment

Result = TypeVar("Result")

SIDE = 48  # samples along each axis of a plane that is complete
DESCENT = 60  # points of a descent at most
PATIENCE = 20.0  # seconds that somebody waits for a newer picture before asking again
POINTS, FILE = "explored", "point-{number}.txt"  # where the points lie that kept slices go through


TAKING = {"--dims": 2, "--port": 1}  # options of the command that a slice does not have, and their values
FLAGS = ("--browser", "--no-browser")  # and those without a value


class _MovedError(Exception):
    """Somebody looks elsewhere."""


class _SpentError(Exception):
    """A descent has spent its points, or is where there is no loss or no gradient."""


@dataclass(frozen=True)
class Look:
    """Record what the user looks at: the parameters that vary, by number, and the point in the unit cube."""

    dims: tuple[int, int]
    at: tuple[float, ...]


@dataclass(frozen=True)
class Seen:
    """Record the state of a `look`: the picture so far, by its number, and how many points are sampled.

    `slice` is None before the first picture. A `complete` picture is the finest. `error` is the message of an error.
    """

    look: Look
    number: int
    done: int
    total: int
    slice: xr.Dataset | None = None
    complete: bool = False
    error: str = ""


@dataclass(frozen=True)
class Film:
    """Record an episode: its loss and status, and data links with a film and a picture of its end.

    Without episodes to draw, the links are None, and `said` says so.
    """

    loss: float
    status: str
    mp4: str | None
    webp: str | None
    said: str


@dataclass(frozen=True)
class Descent:
    """Record a descent as the map draws it, its end in the unit cube, and the loss there, None if it has none."""

    run: Trajectory
    end: list[float] | None
    best: float | None


@dataclass(frozen=True)
class KeptSlice:
    """Record the folder and the files of a saved slice, and the command that makes it again."""

    folder: str
    files: list[str]
    command: str


class Exploration:
    """Sample the current plane, coarse to fine, in a separate thread, which does other tasks between tiles.

    `command` made it; `root` is the folder in which slices are kept.
    """

    def __init__(self, env: Environment, dims: Sequence[int | str], command: str, root: Path) -> None:
        """Begin to look along two parameters through the centre of the box. Raises ValueError where there are none."""
        if env.space.dim < 2:
            raise ValueError(f"explore takes an environment with at least two parameters; {env.name} has one")
        numbers = tuple(env.space.index(one) for one in dims)
        if len(numbers) != 2 or numbers[0] == numbers[1]:
            raise ValueError(f"explore varies two different parameters; got {', '.join(map(str, dims))}")
        self.env, self.command, self.root = env, command, root
        self.look = Look(numbers, tuple([0.5] * env.space.dim))
        self.seen = Seen(self.look, 0, 0, SIDE**2)
        self._tasks = SimpleQueue[tuple[Callable[[], Any], Future[Any]]]()
        self._changed, self._closed, self._descents = Condition(), False, 0
        self._sampled: Look | None = None  # or being sampled
        self._thread = Thread(target=self._work, name="exploration", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Sample nothing more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(PATIENCE)

    def turn(self, look: Look) -> None:
        """Look elsewhere. Raises ValueError where that is no point of the unit cube, or no two parameters."""
        numbers = range(self.env.space.dim)
        if len(look.at) != len(numbers) or not all(0 <= one <= 1 for one in look.at):
            raise ValueError(f"a point has {len(numbers)} numbers from 0 to 1; got {list(look.at)[:8]}")
        if not all(one in numbers for one in look.dims) or look.dims[0] == look.dims[1]:
            raise ValueError(f"explore varies two different parameters of {len(numbers)}; got {list(look.dims)}")
        with self._changed:
            if look != self.look:
                self.look = look
                self.seen = Seen(look, self.seen.number + 1, 0, SIDE**2)
                self._changed.notify_all()

    def wait(self, number: int) -> Seen:
        """Return what is to be seen, as soon as that is something else than picture `number`, or after a while."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self.seen.number != number, PATIENCE)
            return self.seen

    def film(self, at: Sequence[float]) -> Film:
        """Film the episode at a point of the unit cube."""
        return self._do(lambda: self._film(at))

    def descend(self, at: Sequence[float], *, everywhere: bool) -> Descent:
        """Descend by L-BFGS-B over the two parameters shown, or over all.

        Raises ValueError where there is no gradient.
        """
        if not self.env.has_gradient:
            raise ValueError(f"{self.env.name} has no gradient to descend along")
        return self._do(lambda: self._descend(np.array(at), everywhere))

    def keep(self) -> KeptSlice:
        """Keep the plane as a slice on disk."""
        return self._do(self._keep)

    def _do(self, task: Callable[[], Result]) -> Result:
        """Let the thread do something between two tiles, and return what comes of it."""
        promised = Future[Result]()
        self._tasks.put((task, promised))
        with self._changed:
            self._changed.notify_all()
        return promised.result()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._is_asked)
                if self._closed:
                    return
                look = self.look
            try:
                self._answer()
                if look != self._sampled:
                    self._sampled = look
                    self._sample(look)
            except _MovedError:
                pass
            except Exception as error:  # of a simulator, which may raise anything: the page says it
                self._show(look, self.seen.done, None, complete=True, error=f"{type(error).__name__}: {error}")

    def _is_asked(self) -> bool:
        """Whether there is anything to do."""
        return self._closed or self.look != self._sampled or not self._tasks.empty()

    def _answer(self) -> None:
        """Do what was asked for meanwhile."""
        while True:
            try:
                task, promised = self._tasks.get_nowait()
            except Empty:
                return
            try:
                promised.set_result(task())
            except Exception as error:  # whoever asked is told
                promised.set_exception(error)

    def _sample(self, look: Look) -> None:
        store = self._store(look, grad=self.env.has_gradient)

        def follow(progress: Progress) -> None:
            finer = progress.level_complete and progress.done < progress.total
            picture = store.dataset() if finer else None
            self._show(look, progress.done, picture)
            self._answer()
            if self._closed or self.look != look:
                raise _MovedError

        whole = sample(self.env, store.plane, store, gradients=int(store.grad), progress=follow)
        raised = int((whole["status"] == Status.ERROR).sum())
        self._show(look, SIDE**2, whole, complete=True, error=describe_errors(raised, store.error))

    def _show(
        self, look: Look, done: int, picture: xr.Dataset | None, *, complete: bool = False, error: str = ""
    ) -> None:
        with self._changed:
            if self.look != look:
                return
            number = self.seen.number + (picture is not None or complete)
            shown = self.seen.slice if picture is None else picture
            self.seen = Seen(look, number, done, SIDE**2, shown, complete, error)
            self._changed.notify_all()

    def plane(self, look: Look) -> Plane:
        """Return the plane that is looked at, over the whole box."""
        return Plane.through(self.env.space, self._point(look.at), look.dims, resolution=SIDE)

    def nodes(self, seen: Seen) -> dict[str, Any]:
        """Return what the map draws of a picture, or of a plane of which nothing is known yet."""
        return read_off_nodes(self._empty() if seen.slice is None else seen.slice, growing=True)

    def _store(self, look: Look, *, grad: bool) -> SliceStore:
        return SliceStore.in_memory(self.plane(look), self.env.space, **describe(self.env), grad=grad)

    def _empty(self) -> xr.Dataset:
        return self._store(self.look, grad=False).dataset()

    def _point(self, at: Sequence[float]) -> Float[Tensor, " dim"]:
        return self.env.space.from_unit(torch.tensor(at, dtype=torch.float64))

    def _film(self, at: Sequence[float]) -> Film:
        from .report_page import film_links

        x = self._point(at)
        found = evaluate(self.env, x[None], grad=False)
        links = film_links(self.env, x)
        mp4, webp = links or (None, None)
        said = "" if links else f"{self.env.name} has no episodes to draw"
        return Film(float(found.loss[0]), Status(int(found.status[0])).name, mp4, webp, said)

    def _descend(self, at: NDArray[np.float64], everywhere: bool) -> Descent:
        from scipy.optimize import minimize

        from ..optim.base import Kind
        from ..optim.runs.store import RunStore

        free = list(range(len(at))) if everywhere else list(self.look.dims)
        run = RunStore.in_memory(self.env.space, identity={**self.env.identity(), "seed": 0}, budget=DESCENT)
        sides = (self.env.space.upper - self.env.space.lower).numpy()

        def loss_of(z: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
            if run.count == DESCENT:
                raise _SpentError
            place = at.copy()
            place[free] = np.clip(z, 0.0, 1.0)
            x = self._point(place.tolist())[None]
            found = evaluate(self.env, x, grad=True)
            run.append(x, found, Kind.DESCENT, 0.0)
            assert found.grad is not None  # as it was asked for
            slope = found.grad[0].numpy() * sides
            if not (bool(found.loss.isfinite().all()) and np.isfinite(slope).all()):
                raise _SpentError
            return float(found.loss[0]), slope[free]

        with contextlib.suppress(_SpentError):
            minimize(loss_of, at[free], jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(free))
        return self._laid(run.dataset(), everywhere)

    def _laid(self, run: xr.Dataset, everywhere: bool) -> Descent:
        """Return a descent as the map draws it, and where it ends."""
        self._descents += 1
        over = "all parameters" if everywhere else "the two shown"
        named = run.assign_attrs(method="l-bfgs-b", seed=self._descents, fidelity=self.env.fidelity.name)
        (laid,) = lay_runs(self._empty(), [named])
        laid = replace(laid, label=f"descent {self._descents} over {over}")
        if laid.best is None:
            return Descent(laid, None, None)
        x, _ = best_point([run])
        return Descent(laid, self.env.space.to_unit(x).clamp(0, 1).tolist(), laid.best)

    def _keep(self) -> KeptSlice:
        from .slice import SliceJob
        from .watch import Watch

        look = self.look
        through = self._name_point(look)
        command = self._slice_command(look, through)
        job = SliceJob.of(
            self.env, self.plane(look), command=command, root=self.root, gradients=int(self.env.has_gradient)
        )
        summary = job.run(Watch())
        return KeptSlice(str(job.folder), summary.files, command)

    def _name_point(self, look: Look) -> str:
        """Return what the command line calls the point: center, or a file of numbers, which is written here."""
        if all(one == 0.5 for number, one in enumerate(look.at) if number not in look.dims):
            return "center"
        folder = self.root / POINTS
        folder.mkdir(parents=True, exist_ok=True)
        values = self.env.space.to_values(self._point(look.at)).tolist()
        text = "".join(f"{value!r}\n" for value in values)
        number = 1
        while (path := folder / FILE.format(number=number)).exists() and path.read_text() != text:
            number += 1
        path.write_text(text)
        return str(path)

    def _slice_command(self, look: Look, through: str) -> str:
        """Return the command that makes the slice again, of the words of the one that explores."""
        first, second = (self.env.space.names[one] for one in look.dims)
        if not self.command.startswith("landscape explore "):
            return f"gradscape.slice(f, dims=({first!r}, {second!r}), through={through!r}, resolution={SIDE})"
        words, kept = shlex.split(self.command)[2:], list[str]()
        while words:
            word = words.pop(0)
            if word in TAKING:
                del words[: TAKING[word]]
            elif word.partition("=")[0] not in (*TAKING, *FLAGS):
                kept.append(word)
        return shlex.join(
            ["landscape", "slice", *kept, "--dims", first, second, "--through", through, "--resolution", str(SIDE)]
        )
