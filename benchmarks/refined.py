"""How many episodes a refined slice saves against full grids, at equal error at points that neither has seen.

    python -m benchmarks.refined [--share 0.02] [--resolution 129] [--points 2000] [--device cpu] [NAME ...]

Each subject is sampled on its finest grid once. A refined slice of it takes its samples from there, and so do the
grids of every second, fourth ... sample. Errors are at random points between samples, which are evaluated for it: the
root of the mean square, in ranges of the losses, of the refined slice and of all of the finest grid. Then comes how
many times as many episodes are taken by that grid, and by the coarsest full grid with the error of the refined slice:
interpolated linearly, and by its gradients, too, as the refined slice is. That is interpolated between grids.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator

from gradscape import ParameterSpace, Plane, from_torch
from gradscape.envs.registry import make
from gradscape.jobs.report_tables import markdown
from gradscape.landscapes.objective import Evaluation, Objective, evaluate
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.sampling.quadtree import Quadtree
from gradscape.landscapes.sampling.refine import Refinement, Refining
from gradscape.landscapes.storage.store import SliceStore

from .pages import scenes

BOX = ParameterSpace.box(("x", "y"), -1.0, 1.0)
FUNCTIONS = {
    "bowl": lambda x: x.square().sum(dim=1) + x[:, 0] * x[:, 1],
    "rosenbrock": lambda x: 100 * (2 * x[:, 1] + 0.5 - (2 * x[:, 0]) ** 2) ** 2 + (1 - 2 * x[:, 0]) ** 2,
    "waves": lambda x: torch.sin(6 * x[:, 0]) * torch.cos(4 * x[:, 1]),
    "rastrigin": lambda x: ((5 * x) ** 2 - 10 * torch.cos(10.24 * math.pi * x)).sum(dim=1),
    "jump": lambda x: x.square().sum(dim=1) + (x[:, 0] + 0.3 * x[:, 1] > 0.11),
    "thin ridge": lambda x: x.square().sum(dim=1) + 2 * torch.exp(-(((x[:, 0] + 0.37 * x[:, 1] - 0.1) / 0.01) ** 2)),
    "noise": lambda x: torch.sin(1e4 * torch.sin(x[:, 0] * 12.9898 + x[:, 1] * 78.233)),
}
DIMS = (0, 1)  # of a scene's parameters
QUICK = ("bounce", "cartpole", "pinball-2", "pinball-16")  # scenes whose finest grid a CPU samples in minutes
COARSER = 4  # times coarser are the other scenes' on a CPU


@dataclass(frozen=True)
class Row:
    """What was measured of a subject."""

    name: str
    points: int
    sampled: int
    error: float
    finest: float
    by_gradients: float
    by_losses: float

    def cells(self) -> tuple[str, ...]:
        """Return the row of the table."""
        shares = [f"{100 * one:.2g} %" for one in (self.error, self.finest)]
        times = [self._times(full) for full in (self.points, self.by_losses, self.by_gradients)]
        return self.name, str(self.points), str(self.sampled), *shares, *times

    def _times(self, full: float) -> str:
        """Say how many times as many episodes as the refined slice a grid takes."""
        return f"> {self.points / self.sampled:.1f}" if math.isinf(full) else f"{full / self.sampled:.2g}"


class Known(Objective):
    """Answer from a slice that was sampled everywhere."""

    def __init__(self, objective: Objective, plane: Plane, dataset: Any) -> None:
        self.space, self.name, self._plane, self._data = objective.space, "known", plane, dataset

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        """Return what the slice has at its samples."""
        steps = (self._plane.upper - self._plane.lower) / (torch.tensor(self._plane.resolution) - 1)
        at = ((self._plane.project(x) - self._plane.lower) / steps).round().long().numpy()
        index = (at[:, 1], at[:, 0])
        parts = (torch.from_numpy(self._data[name].to_numpy()[index]) for name in ("loss", "grad", "status"))
        return Evaluation(*parts)


def subjects(names: list[str], resolution: int, device: str) -> Iterator[tuple[str, Objective, Plane]]:
    """Yield the functions and scenes that are named, all of them if none is, each with its plane."""
    for name, function in FUNCTIONS.items():
        if not names or name in names:
            yield name, from_torch(function, BOX), Plane.through(BOX, BOX.center, (0, 1), resolution=resolution)
    for name in scenes():
        if not names or name in names:
            env = make(name, fidelity="draft", device="cpu" if name in QUICK else device)
            part = COARSER if name not in QUICK and device == "cpu" else 1
            points = (resolution - 1) // part + 1
            yield name, env, Plane.through(env.space, env.space.center, DIMS, resolution=points)


def full_grid(known: Quadtree, stride: int) -> Quadtree:
    """Return every so many samples of a grid as one of its own, whose cells are all as small as they can be."""
    at = tuple(slice(None, None, stride) for _ in known.shape)
    tree = Quadtree(known.loss[at].shape)
    places = np.stack(np.indices(tree.shape), axis=-1).reshape(-1, tree.rank)
    index = tuple(places.T)
    tree.add(places, known.loss[at][index], stride * known.slope[at][index])
    while (large := (tree.cells.high - tree.cells.low > 1).any(axis=1)).any():
        tree.split(large)
    return tree


def linear_error(tree: Quadtree, places: np.ndarray, loss: np.ndarray) -> float:
    """Return what `error_of` does for a grid of losses alone, interpolated linearly."""
    off = RegularGridInterpolator([np.linspace(0, 1, count) for count in tree.shape], tree.loss)(places) - loss
    return float(np.sqrt(np.nanmean(off**2)) / np.ptp(loss[np.isfinite(loss)]))


def error_of(tree: Quadtree, places: np.ndarray, loss: np.ndarray) -> float:
    """Return the root mean square of the error at places, from 0 to 1 along each axis, in ranges of the losses."""
    off = tree.predict(places * (np.array(tree.shape) - 1)) - loss
    return float(np.sqrt(np.nanmean(off**2)) / np.ptp(loss[np.isfinite(loss)]))


def measure(name: str, objective: Objective, plane: Plane, share: float, points: int) -> Row:
    """Hold a refined slice against full grids."""
    whole = sample(objective, plane)
    generator = np.random.default_rng(0)
    places = generator.random((points, plane.rank))  # in array order
    u = plane.lower + torch.from_numpy(places[:, ::-1].copy()) * (plane.upper - plane.lower)
    loss = evaluate(objective, plane.lift(u), grad=False).loss.numpy()
    store = SliceStore.in_memory(plane, objective.space)
    known = Known(objective, plane, whole)
    run = Refining(known, whole["loss"].size, plane, store, Refinement(share), None, None, 0)
    run.go()
    everything = Refining(known, whole["loss"].size, plane, store, Refinement(share), None, None, 0)
    everything.take_all()
    grids = []
    stride = 1
    while (max(plane.resolution) - 1) // stride >= 4:
        tree = full_grid(everything.tree, stride)
        count = tree.loss.size
        grids.append((count, error_of(tree, places, loss), linear_error(tree, places, loss)))
        stride *= 2
    error, sampled = error_of(run.tree, places, loss), int(run.tree.sampled.sum())
    by_gradients = episodes_for(error, [(count, reached) for count, reached, _ in grids[::-1]])
    by_losses = episodes_for(error, [(count, reached) for count, _, reached in grids[::-1]])
    return Row(name, whole["loss"].size, sampled, error, grids[0][1], by_gradients, by_losses)


def episodes_for(error: float, grids: list[tuple[int, float]]) -> float:
    """Return how many episodes a full grid takes for an error, infinitely many where the finest is not enough."""
    before = None
    for count, reached in grids:
        if reached <= error:
            if before is None or before[1] <= reached:
                return float(count)
            part = math.log(before[1] / error) / math.log(before[1] / max(reached, 1e-300))
            return float(math.exp(math.log(before[0]) + part * math.log(count / before[0])))
        before = count, reached
    return math.inf


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="functions and scenes; all by default")
    parser.add_argument("--share", type=float, default=0.02)
    parser.add_argument("--resolution", type=int, default=129)
    parser.add_argument("--points", type=int, default=2000)
    parser.add_argument("--device", default="cpu", help="of the soft bodies: cuda for their whole resolution")
    given = parser.parse_args()
    headings = ("", "points", "sampled", "error", "error of all", "saved of all", "saved, linear", "saved, cubic")
    rows = []
    for name, objective, plane in subjects(given.names, given.resolution, given.device):
        rows.append(measure(name, objective, plane, given.share, given.points).cells())
        print(markdown(headings, rows[-1:]).splitlines()[-1], flush=True)
    print(markdown(headings, rows))


if __name__ == "__main__":
    main()
