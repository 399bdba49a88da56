"""Refine a slice: sample its grid only where gradients do not explain the losses between neighbours.

The coarsest lattice of the quadtree comes first. Then, round after round, cells with a suspected error are split, and
those next to much smaller ones. When none is left, points are drawn at random to test the interpolation; they are
samples as well. The grid is done when at least nineteen of twenty such points reach the requested accuracy; the cells
of the others are split. Each round depends only on earlier samples, so a stopped run continues as it would have.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from ..identity import DamagedError
from ..objective import Objective, Status, evaluate
from ..plane import Plane
from ..storage.arrays import POINTS
from ..storage.checkpoint import Checkpoint
from ..storage.store import SliceStore
from .distribution import evaluator, workers_of
from .fill import Progress, check_store, resumable
from .quadtree import Places, Quadtree, Values, coarsest_lattice

REFINED = "refinement"  # the attribute of a slice that says how it was refined
FIRST, FINEST = 0.16, 1e-6  # shares of the range that a budget alone begins with, and ends at
PROBES = 32  # points not sampled that are drawn in a round of tests
OFF = 1 / 20  # of them that may be off by more than was asked for
LEAST_BATCH = 16
GRAIN = 1 << 16  # of the random numbers that tell rounds apart


@dataclass(frozen=True)
class Refinement:
    """The required accuracy of a slice: a `share` of the range of its losses, with at most `budget` points.

    A budget alone takes ever smaller shares until it is spent. Raises ValueError where neither is given, or a share is
    invalid.
    """

    share: float | None = None
    budget: int | None = None

    def __post_init__(self) -> None:
        if self.share is None and self.budget is None:
            raise ValueError("refining takes a share of the range, or a budget; got neither")
        if self.share is not None and not 0 < self.share < 1:
            raise ValueError(f"refining takes a share of the range between 0 and 1; got {self.share:g}")

    @classmethod
    def of(cls, share: float | None, budget: int | None) -> Refinement | None:
        """Return the required accuracy of a slice, None where neither is given."""
        return None if share is None and budget is None else cls(share, budget)

    def check(self, plane: Plane) -> None:
        """Raise ValueError where the budget does not cover the coarsest lattice of a slice."""
        _, axes = coarsest_lattice(plane.resolution)
        least = math.prod(map(len, axes))
        if self.budget is not None and self.budget < least:
            raise ValueError(
                f"a slice of this resolution begins with {least} points; got a budget of {self.budget}: use at least "
                f"{least}, or a finer resolution, which begins with a smaller share of its points"
            )

    def shares(self) -> Iterator[float]:
        """Yield the shares of the range, ever smaller."""
        if self.share is not None:
            yield self.share
            return
        share = FIRST
        while share > FINEST:
            yield share
            share /= 2


@dataclass(frozen=True)
class Refined:
    """The result of a refinement, as stored in the attribute of its slice.

    Of `points` in the grid `sampled` were evaluated. `error` is the accuracy of nineteen of twenty others, as a share
    of the range, from `tested` random points, None where there are none or a loss is infinitely far off.
    """

    share: float | None
    budget: int | None
    points: int
    sampled: int
    tested: int
    error: float | None

    def attribute(self) -> dict[str, str]:
        """Return the text of the attribute in which a slice stores it."""
        return {REFINED: json.dumps(asdict(self))}

    @classmethod
    def of(cls, dataset: xr.Dataset) -> Refined | None:
        """Read it from a slice, None where the slice was not refined."""
        with suppress(KeyError, TypeError, ValueError):
            return cls(**json.loads(dataset.attrs[REFINED]))
        return None

    def say(self) -> str:
        """Describe it in a line."""
        others = f", 95 % of the others to {100 * self.error:.2g} % of the range" if self.error is not None else ""
        return f"{self.sampled} of {self.points} points sampled{others}"


def refine(
    objective: Objective,
    plane: Plane,
    store: SliceStore,
    refinement: Refinement,
    *,
    progress: Callable[[Progress], None] | None = None,
    executor: Executor | None = None,
    made: Callable[[], Objective] | None = None,
    conclude: Callable[[xr.Dataset], Mapping[str, Any]] | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Evaluate an objective where a slice needs it, and return the slice; the other points are INTERPOLATED.

    Their losses are NaN; the interpolated values are in the separate variable `interpolated`. Samples have the same
    bits as in a fully sampled slice. Points already in `store` are not evaluated again. `progress`, `executor`, `made`
    and `conclude` are those of `sample`. Raises StoreMismatchError where the store has other settings, ValueError for a
    budget that does not cover the coarsest lattice, DamagedError where a finished one is damaged, and any error of
    `sample`.
    """
    check_store(store, objective, plane)
    refinement.check(plane)
    if store.ascending:
        if store.path is not None and store.pending():
            raise DamagedError.of(store.path, "samples are lost", "restore it, or start again with --force")
        dataset = store.dataset()
    else:
        batch = max(LEAST_BATCH, objective.preferred_batch)
        batch *= workers_of(executor) if executor else 1
        run = Refining(evaluator(objective, executor, made), batch, plane, store, refinement, progress, seed)
        with resumable(store, run.counts):
            run.go()
        dataset = run.dataset()
        if conclude is not None:
            dataset = dataset.assign_attrs(conclude(dataset))
        store.finish(dataset)
    return dataset


def partly_refined(store: SliceStore) -> xr.Dataset:
    """Return the present samples of a slice."""
    samples, empty = _Samples(store.shape, store.plane.dim), store.dataset()
    if store.parts is None:
        return empty
    samples.load(store.parts)
    return samples.put_into(empty)


class _Samples:
    """The evaluations of a grid, in the order of its axes, as in its parts."""

    def __init__(self, shape: tuple[int, ...], dim: int) -> None:
        self.loss, self.grad = np.full(shape, np.nan), np.full((*shape, dim), np.nan)
        self.status = np.zeros(shape, np.int8)

    @property
    def sampled(self) -> NDArray[np.bool_]:
        """Whether each point was evaluated."""
        found: NDArray[np.bool_] = self.status != Status.MISSING
        return found

    def load(self, checkpoint: Checkpoint) -> None:
        """Load the content of the checkpoint."""
        for name in checkpoint.names():
            if piece := checkpoint.load(name):
                self.take(piece["at"], piece["loss"], piece["status"], piece.get("grad"))

    def take(self, at: Places, loss: Values, status: NDArray[np.int8], grad: Values | None) -> None:
        """Add evaluations of points."""
        index = tuple(at.T)
        self.loss[index], self.status[index] = loss, status
        if grad is not None:
            self.grad[index] = grad

    def put_into(self, empty: xr.Dataset) -> xr.Dataset:
        """Return a slice with the samples, MISSING where there are none."""
        values = {"loss": self.loss, "status": self.status, "grad": self.grad}
        return empty.assign({name: empty[name].copy(data=values[str(name)]) for name in empty.data_vars})


@dataclass(eq=False)
class Refining:
    """A refinement in progress: `tree` contains the samples, and interpolates the rest."""

    objective: Objective
    batch: int
    plane: Plane
    store: SliceStore
    refinement: Refinement
    progress: Callable[[Progress], None] | None
    seed: int

    def __post_init__(self) -> None:
        self.counts, self.axes = Counter[Status](), self.plane.axes()
        self.tree, self.samples = Quadtree(self.store.shape), _Samples(self.store.shape, self.plane.dim)
        self.errors, self.tests, self.resumed = np.zeros(0), 0, 0
        if self.store.parts is not None:
            self.samples.load(self.store.parts)
            self.resumed = int(self.samples.sampled.sum())

    def go(self) -> None:
        """Sample until the requested accuracy is reached, or the budget is spent."""
        self._report()
        self._evaluate(self.tree.lattice())
        for share in self.refinement.shares():
            if not self._refine_to(share):
                return

    def dataset(self) -> xr.Dataset:
        """Return the slice."""
        samples = self.samples
        inside = np.where(samples.sampled, np.nan, self.tree.fill())
        dataset = samples.put_into(self.store.dataset())
        status = np.where(samples.sampled, samples.status, np.int8(Status.INTERPOLATED))
        known = np.sort(self.errors)
        at = math.ceil((1 - OFF) * len(known)) - 1
        others = len(known) and not samples.sampled.all() and self.tree.range > 0
        error = float(known[at] / self.tree.range) if others else None
        about = Refined(
            share=self.refinement.share,
            budget=self.refinement.budget,
            points=samples.status.size,
            sampled=int(samples.sampled.sum()),
            tested=len(known),
            error=error if error is not None and math.isfinite(error) else None,
        )
        said = {**dataset["loss"].attrs, "long_name": "loss as interpolated where it was not sampled"}
        dataset = dataset.assign(status=dataset["status"].copy(data=status.astype(np.int8)))
        return dataset.assign(interpolated=(dataset["loss"].dims, inside, said)).assign_attrs(about.attribute())

    def _refine_to(self, share: float) -> bool:
        """Split and test until the error is below a share of the range; return whether budget is left."""
        passed = False
        while True:
            least = share * self.tree.range
            suspects = self.tree.suspects()
            suspects = np.where(self.tree.unbalanced(), np.maximum(suspects, np.nextafter(least, np.inf)), suspects)
            if (suspects > least).any():
                if not self._split(suspects, least):
                    return False
            elif passed or self.tree.sampled.all():
                return True
            else:
                off = self._test()
                if off is None:
                    return False
                passed = float((off > least).mean()) <= OFF

    def _split(self, suspects: Values, least: float) -> bool:
        """Split the suspected cells, the worst first where the budget ends; return whether it covered all."""
        order = np.argsort(-suspects, kind="stable")
        which = suspects > least
        new = self.tree.split_points(which)
        if enough := len(new) <= self._left():
            chosen = which
        else:
            chosen = np.zeros_like(which)
            chosen[order[: self._affordable(order[: int(which.sum())])]] = True
            new = self.tree.split_points(chosen)
        if len(new):
            self._evaluate(new)
        if chosen.any():
            self.tree.split(chosen)
        return bool(enough)

    def _affordable(self, order: NDArray[np.intp]) -> int:
        """Return how many of the cells, in order, can be split with the remaining budget."""
        low, high = 0, len(order)
        while low < high:
            middle = (low + high + 1) // 2
            some = np.zeros(len(self.tree.cells), bool)
            some[order[:middle]] = True
            low, high = (middle, high) if len(self.tree.split_points(some)) <= self._left() else (low, middle - 1)
        return low

    def _test(self) -> Values | None:
        """Sample some points at random, and return the errors of the interpolation; None without budget."""
        unknown = np.argwhere(np.logical_not(self.tree.sampled))
        count = min(len(unknown), PROBES)
        if count > self._left():
            return None
        generator = np.random.default_rng(self.seed * GRAIN + self.tests)
        drawn = unknown[np.sort(generator.permutation(len(unknown))[:count])]
        said = self.tree.predict(drawn.astype(float))
        self._evaluate(drawn)
        self.tests += 1
        self.errors = self.tree.probe(drawn, said)
        return self.errors

    def _left(self) -> float:
        budget = self.refinement.budget
        return math.inf if budget is None else budget - int(self.tree.sampled.sum())

    def _evaluate(self, at: Places) -> None:
        """Evaluate points that are not stored, a batch at a time, and pass all of them to the tree."""
        new = at[np.logical_not(self.samples.sampled[tuple(at.T)])]
        for start in range(0, len(new), self.batch):
            self._ask(new[start : start + self.batch])
        index = tuple(at.T)
        steps = np.array([float(axis[-1] - axis[0]) / (len(axis) - 1) for axis in self.axes])
        slope = self.plane.slope(torch.from_numpy(self.samples.grad[index])).numpy() * steps
        self.tree.add(at, self.samples.loss[index], slope[:, ::-1])
        self._report()

    def _ask(self, at: Places) -> None:
        u = torch.stack([axis[torch.from_numpy(at[:, -1 - number])] for number, axis in enumerate(self.axes)], dim=-1)
        found = evaluate(self.objective, self.plane.lift(u), grad=self.store.grad)
        arrays = {"loss": found.loss.numpy(), "status": found.status.numpy().astype(np.int8)}
        if found.grad is not None and self.store.grad:
            arrays["grad"] = found.grad.numpy()
        self.samples.take(at, arrays["loss"], arrays["status"], arrays.get("grad"))
        self.store.keep_error(found.error)
        if self.store.parts is not None:
            self.store.parts.save("-".join(map(str, [POINTS, len(at), *at[0]])), at=at, **arrays)
        self._report()

    def _report(self) -> None:
        self.counts.clear()
        self.counts.update(map(Status, self.samples.status[self.samples.sampled].tolist()))
        total = int(min(self.samples.status.size, self.refinement.budget or math.inf))
        if self.progress is not None:
            self.progress(Progress(self.counts.total(), total, self.resumed, dict(self.counts), 0, False))
