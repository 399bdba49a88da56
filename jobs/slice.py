"""A slice to sample into a folder: what it will cost, its pictures on the way, its summary."""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor

from ..landscapes.capacity import peak_memory, size
from ..landscapes.cost import PICTURE_SECONDS, duration, seconds_per_episode
from ..landscapes.directions import barrier
from ..landscapes.identity import BOXED, plane_of, record_cut, stored_identity, with_stride
from ..landscapes.lattice import check_gradients, count_gradients
from ..landscapes.measures.floor import Floor
from ..landscapes.measures.slice_floor import (
    counted_from,
    find_floor,
    floor_attribute,
    floor_of,
    map_floor,
    refuse_without_replicas,
    split_effort,
)
from ..landscapes.measures.undersampled import Undersampled, find_undersampled, probes
from ..landscapes.objective import BoxedObjective, Objective, Status, describe_errors, failed
from ..landscapes.plain import plain_name
from ..landscapes.plane import Plane
from ..landscapes.sampling.distribution import PortableObjective, evaluator, run_tasks, workers_of
from ..landscapes.sampling.fill import Progress, sample
from ..landscapes.sampling.refine import Refined, Refinement, partly_refined, refine
from ..landscapes.storage.arrays import Tile, count_statuses, need_of
from ..landscapes.storage.files import clear
from ..landscapes.storage.floor_map import (
    FLOOR,
    discard_floor_map,
    open_floor_map,
    replica_paths,
    save_floor_map,
    with_map,
)
from ..landscapes.storage.paths import is_slice, slice_exists
from ..landscapes.storage.store import SliceStore
from ..landscapes.training import Training, TrainingPath
from ..landscapes.verification import verify_dataset
from .folder import ROOT, SLICE, SUMMARY, folder_named
from .job import SummaryJob
from .scene import first_line, provenance
from .watch import PREPARING, Watch, Work, resumable
from .workers import recipe

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..landscapes.space import ParameterSpace

STORE, PICTURE = SLICE.store, SLICE.picture
MIN_PAUSE_SECONDS = 10.0  # between pictures of an unfinished slice
MAX_DRAWING_SHARE = 0.1  # of the time, for pictures of an unfinished slice
FIRST_PICTURE_SECONDS = 3.0  # no intermediate picture of slices that are faster than this
MAX_NAME_LETTERS = 40  # letters of a folder's name that say along what a slice was cut
JOINED = "joined"  # in the identity of a slice that was cut between points: their names
# draw(dataset, width=None, floor=None): a slice with its map of the numerical floor, for a screen or a page [mm]
Draw = Callable[..., "Figure"]


@dataclass(frozen=True)
class SliceSummary:
    """Record the cost and the content of a slice, as in its `summary.json`.

    `status` counts points by status, and `flat` those with a gradient of exactly zero. Gradients are at every
    `gradients_every` samples along each axis. `episodes` counts the evaluated samples. `undersampled` contains the
    checks between samples and their result, None if unknown. `barrier` [loss unit] is the barrier between the ends of a
    line. `error` is the message of the first point that raised. `floor` is the numerical floor from replicas of the
    objective, None if it has none. `training` is the path of a training that the slice was cut along.
    """

    env: str | None
    dims: list[str]
    fidelity: str | None
    device: str | None
    options: dict[str, Any] | None
    resolution: list[int]
    gradients: bool
    gradients_every: int
    episodes: int
    resumed: int
    seconds: float
    status: dict[str, int]
    loss: dict[str, float | None]
    flat: int | None
    undersampled: Undersampled | None
    refinement: Refined | None
    command: str
    files: list[str]
    barrier: float | None = None
    error: str = ""
    floor: Floor | None = None
    training: TrainingPath | None = None

    def outcome(self) -> str:
        """Say in a line what the slice cost and what came out."""
        counts = {kind: count for kind, count in self.status.items() if count}
        ends = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in counts.items())
        raised = f"; {said}" if (said := describe_errors(counts.get("error", 0), self.error)) else ""
        refined = f"; {self.refinement.say()}" if self.refinement else ""
        losses = say_range(self.loss)
        sloped = math.prod(-(-points // self.gradients_every) for points in self.resolution)
        asked = min(sloped, sum(counts.values()) - counts.get("interpolated", 0))
        share = (self.flat or 0) / asked if asked else 0.0
        flat = f"; gradient exactly zero at {share:.1%} of points" if share else ""
        barred = "" if self.barrier is None else f"; barrier of {self.barrier:.4g} above the line between the ends"
        hidden = f"; {said}" if self.undersampled and (said := self.undersampled.describe()) else ""
        numerics = f"; {self.floor.sentence()}" if self.floor else ""
        trained = f"; {self.training.sentence()}" if self.training else ""
        spent = f"{self.episodes} episodes in {duration(self.seconds)}"
        return f"{spent}; {ends}{raised}; {losses}{flat}{barred}{refined}{hidden}{numerics}{trained}"


@dataclass(frozen=True)
class SliceCost:
    """Say what is left of a slice to compute: episodes, seconds they should take, bytes of memory."""

    episodes: int
    seconds: float
    memory: int

    def less(self, done: int) -> SliceCost:
        """Return what is left where so many of the episodes are done."""
        return replace(self, episodes=self.episodes - done, seconds=self.seconds * (1 - done / self.episodes))


def slice_work(objective: Objective, shape: tuple[int, ...], every: int, *, between: bool = True) -> Work:
    """Return what a slice evaluates: gradients at every so many samples along each axis, `every`, 0 for none.

    A single slice looks `between` its samples, and how far its replicas are apart: at most so many times.
    """
    points, having = math.prod(shape), count_gradients(shape, every)
    need = need_of(shape, objective.space.dim, grad=every > 0)
    losses = points - having
    if between:
        losses += probes(points, grad=every == 1)
        again = floor_episodes(objective, points)
        losses, having = (losses, having + again) if every else (losses + again, having)
    return Work(objective, losses, having, need.disk, need.memory)


def floor_episodes(objective: Objective, samples: int) -> int:
    """Return how many episodes of its replicas tell the numerical floor of a slice of so many samples."""
    replicas = len(objective.replicas())
    return math.prod(split_effort(samples, replicas)) if replicas else 0


@dataclass(frozen=True, kw_only=True)
class SliceJob(SummaryJob[SliceSummary]):
    """A slice to sample, and how to draw it, here or by the workers of an `executor`, each with what `remake` returns.

    With a `refinement` it is sampled only where it has to be. With `floor` its replicas are evaluated at every sample.
    Checkpoints of a `training` that it was cut along are evaluated, too.
    """

    results = SLICE
    objective: Objective
    plane: Plane
    store: SliceStore
    plot: Draw
    executor: Executor | None = None
    remake: Callable[[], Objective] | None = None
    refinement: Refinement | None = None
    floor: bool = False
    drawn: bool = True
    training: Training | None = None

    @classmethod
    def of(
        cls,
        objective: Objective,
        plane: Plane,
        *,
        command: str,
        out: Path | None = None,
        root: Path = ROOT,
        gradients: int = 1,
        force: bool = False,
        boxed: bool = False,
        cut: Mapping[str, Any] | None = None,
        executor: Executor | None = None,
        prints: Sequence[float] = (),
        refinement: Refinement | None = None,
        floor: bool = False,
        picture: bool = True,
        training: Training | None = None,
    ) -> SliceJob:
        """Continue the slice in `out`, by default a folder under `root` named after it, or begin it there.

        Gradients are at every so many samples along each axis, `gradients`, 0 for none. `boxed` leaves out what lies
        beyond the bounds; so does a `cut`, how it was cut along directions, but for those of weights. `floor` is no
        setting of the slice.
        Raises ValueError for what cannot be, and where the folder holds something else or another slice.
        """
        if floor:
            refuse_without_replicas(objective, refined=refinement is not None)
        gradients = check_gradients(gradients, plane, refined=refinement is not None)
        identity = _identity(objective, gradients, cut, boxed=boxed)
        folder = out or default_folder(identity, plane.resolution, plane, gradients > 0, root, refinement)
        if refinement is not None:
            refinement.check(plane)
            identity["refinement"] = asdict(refinement)
        store = _open_store(
            folder, plane, objective.space, force=force,
            identity=identity, provenance=provenance(objective, command), grad=gradients > 0,
        )  # fmt: skip
        boxed = BOXED in identity
        return cls(
            objective=BoxedObjective(objective) if boxed else objective, remake=None if boxed else recipe(objective),
            plane=plane, store=store, plot=picture_of(objective, plane), folder=folder, command=command,
            executor=executor, prints=prints, refinement=refinement, floor=floor, drawn=picture or bool(prints),
            training=training,
        )  # fmt: skip

    def work(self) -> list[Work]:
        """Return its samples and what looks between them, and the replicas' slices where those are mapped."""
        every = self.store.every if self.store.grad else 0
        whole = [slice_work(self.objective, self.plane.resolution, every)]
        if self.training is not None:
            whole.append(Work(self.objective, len(self.training.x)))
        replicas = self.objective.replicas().values() if self.floor else []
        return whole + [slice_work(one, self.plane.resolution, every, between=False) for one in replicas]

    def cost(self) -> SliceCost:
        """Estimate what is left; workers that compute it do, which warms them, and leaves a GPU of theirs alone."""
        return estimate_cost(self.objective, self.store, self.executor, self.remake)

    def compute(self, watch: Watch) -> SliceSummary:
        """Sample what is missing, draw each finer picture as it completes, and return the summary.

        Raises StoreMismatchError where the objective gives other numbers than are stored.
        """
        self._verify(watch)
        self._announce(watch)
        start = time.monotonic()
        dataset, computed = self._sample(watch)
        mapped = open_floor_map(self.folder, dataset)
        if mapped is None and self.floor:
            mapped = self._map_floor(dataset, watch)
        dataset = with_map(dataset, mapped)
        pictures = [PICTURE, *self.draw(partial(self.plot, dataset, floor=mapped))] if self.drawn else []
        files = [SLICE.files[0], *([] if mapped is None else [FLOOR]), *pictures, SUMMARY]
        return self._summary(dataset, computed, time.monotonic() - start, files)

    def holding(self, watch: Watch) -> AbstractContextManager[None]:
        """Leave the finest complete picture where it is stopped."""
        return resumable(self.kept, self.picture)

    def kept(self) -> str:
        """Say how much of it is on disk."""
        status = partly_refined(self.store)["status"] if self.refinement else self.store.status()
        return f"{int((status > 0).sum())} of {status.size} points are kept in {self.folder}"

    def picture(self) -> None:
        """Draw the finest complete picture of the whole so far, if there is one."""
        if not self.drawn:
            return
        coarse = partly_refined(self.store) if self.refinement else self.store.coarse()
        if coarse is not None and bool((coarse["status"] != Status.MISSING).any()):
            from ..landscapes.draw.figures.page import save

            save(self.plot(coarse), self.folder / PICTURE)

    def _verify(self, watch: Watch) -> None:
        """Evaluate a few stored points again, before anything is added to them."""
        with watch.busy(f"{self.store.identity.get('objective')}: {PREPARING}"):
            if self.refinement and not self.store.ascending:
                verify_dataset(self.objective, partly_refined(self.store), self.folder)
            else:
                self.store.verify(self.objective)

    def _announce(self, watch: Watch) -> None:
        """Say what is left to compute and what that costs."""
        about = self.store.identity
        env = str(about.get("objective"))
        with watch.busy(f"{env}: {PREPARING}"):
            cost = self.cost()
            if self.refinement and cost.episodes:
                cost = cost.less(int((partly_refined(self.store)["status"] > 0).sum()))
        total, whole = math.prod(self.plane.resolution), self.store.grad and self.store.every == 1
        kind = kind_of(self.store)
        watch.note(first_line(about, self.folder))
        if not cost.episodes:
            watch.note(f"all {total} {kind} are done already")
            return
        kept = f", {total - cost.episodes} are done already" if cost.episodes < total else ""
        most, losses = "up to " if self.refinement else "", probes(total, grad=whole)
        again = floor_episodes(self.objective, total)
        more = [f"{losses} between samples"] * (losses > 0) + [f"{again} of replicas"] * (again > 0)
        between = f"; plus at most {' and '.join(more)}" if more else ""
        floors = len(self.objective.replicas()) * total if self.floor else 0
        seconds = cost.seconds * (1 + (losses + again + floors) / cost.episodes) + PICTURE_SECONDS
        watch.announce(
            f"{most}{cost.episodes} {kind} to compute{kept}: about {duration(seconds)} in all, "
            f"{size(cost.memory)} of memory{_gpu_memory(self.objective)}{between}",
            seconds,
        )

    def _sample(self, watch: Watch) -> tuple[xr.Dataset, int]:
        """Sample what is missing; return the slice, and how many episodes were computed."""
        drawn, pause, computed = time.monotonic(), FIRST_PICTURE_SECONDS, 0
        with watch.progress(math.prod(self.plane.resolution)) as advance:

            def follow(now: Progress) -> None:
                nonlocal drawn, pause, computed
                computed = now.done - now.resumed
                lost = sum(count for status, count in now.statuses.items() if failed(status))
                advance(now.done, f"episodes, {lost} failed" if lost else "")
                if now.level_complete and now.done < now.total and (began := time.monotonic()) - drawn > pause:
                    self.picture()
                    drawn = time.monotonic()
                    pause = max(MIN_PAUSE_SECONDS, (drawn - began) / MAX_DRAWING_SHARE)

            def conclude(dataset: xr.Dataset) -> dict[str, Any]:
                advance(dataset["status"].size, "checks between samples")
                return conclude_slice(self.objective, dataset, self.executor, self.remake, training=self.training)

            how: dict[str, Any] = {"executor": self.executor, "made": self.remake}
            how |= {"progress": follow, "conclude": conclude}
            if self.refinement is None:
                return sample(self.objective, self.plane, self.store, gradients=int(self.store.grad), **how), computed
            return refine(self.objective, self.plane, self.store, self.refinement, **how), computed

    def _map_floor(self, dataset: xr.Dataset, watch: Watch) -> xr.Dataset:
        """Sample the slices of the replicas, as far as they are missing, and leave the map of how far all are apart."""
        replicas, whole = self.objective.replicas(), math.prod(self.plane.resolution)
        watch.note(f"numerical floor: {len(replicas)} x {whole} episodes of replicas, {', '.join(replicas)}")
        self.objective.release()
        gradients, found = self.store.every if self.store.grad else 0, dict[str, xr.Dataset]()
        with watch.progress(len(replicas) * whole) as advance:
            for path, (name, replica) in zip(replica_paths(self.folder, list(replicas)), replicas.items(), strict=True):

                def follow(now: Progress, before: int = len(found) * whole) -> None:
                    advance(before + now.done)

                store = SliceStore.open_or_create(
                    path, self.plane, replica.space, identity=with_stride(replica.identity(), gradients),
                    grad=gradients > 0,
                )  # fmt: skip
                found[name] = sample(
                    replica, self.plane, store, gradients=gradients, executor=self.executor, made=recipe(replica),
                    progress=follow,
                )  # fmt: skip
                replica.release()
        mapped = map_floor(self.objective, dataset, found)
        save_floor_map(self.folder, mapped)
        return mapped

    def _summary(self, dataset: xr.Dataset, computed: int, seconds: float, files: list[str]) -> SliceSummary:
        identity, status = self.store.identity, dataset["status"].to_numpy()
        return SliceSummary(
            env=identity.get("objective"),
            dims=list(self.plane.names),
            fidelity=identity.get("fidelity"),
            device=identity.get("device"),
            options=identity.get("options"),
            resolution=list(self.plane.resolution),
            gradients=self.store.grad,
            gradients_every=self.store.every,
            episodes=computed,
            resumed=int((status != Status.INTERPOLATED).sum()) - computed,
            seconds=round(seconds, 3),
            status=count_statuses(dataset),
            loss=range_of(dataset),
            flat=flat_points(dataset),
            undersampled=Undersampled.of(dataset),
            refinement=Refined.of(dataset),
            command=self.command,
            files=files,
            barrier=barrier_of(dataset),
            error=self.store.error,
            floor=floor_of(dataset),
            training=TrainingPath.of(dataset),
        )


def _identity(
    objective: Objective, gradients: int, cut: Mapping[str, Any] | None, *, boxed: bool = False
) -> dict[str, Any]:
    """Return what decides a slice's numbers, but for its plane."""
    return with_stride(objective.identity(), gradients) | record_cut(cut, boxed=boxed)


def _open_store(folder: Path, plane: Plane, space: ParameterSpace, *, force: bool, **settings: Any) -> SliceStore:
    """Continue the slice in a folder, or begin it there; `force` begins again where another one is."""
    SLICE.check(folder)
    if not (force and slice_exists(folder / STORE)):
        return SliceStore.open_or_create(folder / STORE, plane, space, **settings)
    store = SliceStore.create(folder / STORE, plane, space, overwrite=True, **settings)
    clear(folder, (PICTURE, SUMMARY), PICTURE)
    discard_floor_map(folder)
    return store


def kind_of(store: SliceStore) -> str:
    """Say what is computed for a slice: episodes, and at which samples with gradients."""
    if store.every > 1:
        return f"episodes (gradients at every {store.every} samples along each axis)"
    return "episodes with gradients" if store.grad else "episodes"


def picture_of(objective: Objective, plane: Plane) -> Draw:
    """Return how a slice is drawn: a map, or a profile over a line with the events of an environment's episodes."""

    def surface(dataset: xr.Dataset, width: float | None = None, floor: xr.Dataset | None = None) -> Figure:
        from ..landscapes.draw.figures.contour import landscape_figure

        return landscape_figure(dataset, floor=floor, width=width)

    def profile(dataset: xr.Dataset, width: float | None = None, floor: xr.Dataset | None = None) -> Figure:
        from ..landscapes.draw.figures.profile import profile_figure

        u = torch.tensor(dataset["u"].to_numpy())
        return profile_figure(dataset, events=objective.events(plane.lift(u[:, None])), floor=floor, width=width)

    return surface if plane.rank == 2 else profile


def _gpu_memory(objective: Objective) -> str:
    if objective.device != "cuda":
        return ""
    return f", {size(objective.memory() * objective.preferred_batch)} of it on the GPU at a time"


def estimate_cost(
    objective: Objective,
    store: SliceStore,
    executor: Executor | None = None,
    remake: Callable[[], Objective] | None = None,
) -> SliceCost:
    """Estimate what is left of a slice from its own first points, evaluated as they will be; that takes seconds.

    With an `executor` its workers evaluate them.
    """
    tiling, pending = store.tiling, store.pending()
    left = sum(map(tiling.count, pending))
    if not left:
        return SliceCost(0, 0.0, peak_memory())
    batch = first_points(store, pending, objective.preferred_batch)
    sloped = sum(int(tiling.sloped(tile).sum()) for tile in pending)
    counts = {grad: count for grad, count in ((True, sloped), (False, left - sloped)) if count}
    sent = PortableObjective.of(objective, None if executor is None else remake)
    if executor is None:
        timed = [_time(sent, batch, counts)]
    else:
        timed = list(run_tasks(executor, _time, [(sent, batch, counts)] * workers_of(executor)))
    shares = [1 / seconds for seconds, _ in timed if seconds]
    arrays = need_of(store.shape, store.plane.dim, grad=store.grad)
    return SliceCost(left, 1 / sum(shares) if shares else 0.0, timed[0][1] + round(arrays.memory))


def _time(sent: PortableObjective, batch: Float[Tensor, "point dim"], counts: Mapping[bool, int]) -> tuple[float, int]:
    """Return what so many episodes with a gradient, True, and without take [s], and this process's memory [bytes]."""
    objective = sent.objective.objective
    objective.prepare()
    each = {grad: seconds_per_episode(objective, batch, grad=grad, count=n) for grad, n in counts.items()}
    return sum(counts[grad] * one for grad, one in each.items()), peak_memory()


def first_points(store: SliceStore, tiles: Sequence[Tile], count: int) -> Float[Tensor, "point dim"]:
    """Return the first points of tiles, or all there are where they are fewer."""
    parts, size = list[Tensor](), 0
    for tile in tiles:
        if size < count:
            parts.append(store.points(tile))
            size += len(parts[-1])
    return torch.cat(parts)[:count]


def default_folder(
    identity: dict[str, Any],
    resolution: tuple[int, ...],
    plane: Plane | None,
    grad: bool,
    root: Path,
    refinement: Refinement | None,
) -> Path:
    """Return the default folder of a slice, unique for its settings and always the same for them.

    That of a cut along directions, which may differ by rounding, does not depend on the `plane`.
    """
    where: Any = resolution
    if "cut" in identity or plane is None:
        axes = [plain_name(identity["cut"]["along"])[:MAX_NAME_LETTERS]]
    else:
        aligned = all(len(row.nonzero()) == 1 for row in plane.basis)
        axes = [str(int(row.nonzero()[0])) for row in plane.basis] if aligned else ["plane"]
        where = plane.record()
    points = "x".join(map(str, resolution))
    fidelity = [identity["fidelity"]] if "fidelity" in identity else []
    parts = [identity["objective"], *axes, *fidelity, points]
    refined = [asdict(refinement)] if refinement else []
    return folder_named([*parts, *["refined" for _ in refined]], [identity, where, grad, *refined], root)


def kept_plane(
    objective: Objective,
    cut: Mapping[str, Any],
    resolution: tuple[int, ...],
    *,
    out: Path | None = None,
    root: Path = ROOT,
    gradients: int = 1,
    refinement: Refinement | None = None,
) -> Plane | None:
    """Return the plane of a slice that was begun with the same cut along directions, None where there is none.

    It continues along these: others may come out a little different each time, on a GPU, and some take many episodes.
    """
    identity = _identity(objective, gradients, cut)
    path = (out or default_folder(identity, resolution, None, gradients > 0, root, refinement)) / STORE
    if not is_slice(path):
        return None
    kept = SliceStore.open(path).identity
    same = all(kept.get(name) == json.loads(json.dumps(value)) for name, value in identity.items())
    found = Plane.from_record(kept["plane"])
    return found if same and found.resolution == resolution else None


def conclude_slice(
    objective: Objective,
    dataset: xr.Dataset,
    executor: Executor | None = None,
    remake: Callable[[], Objective] | None = None,
    *,
    training: Training | None = None,
) -> dict[str, Any]:
    """Return the attributes of a slice that say what is real of it: its numerical floor, and what its samples hide.

    With an `executor` its workers evaluate. Where it was cut along a `training`, they say its path, too.
    """
    floor = None
    with _sampled_all_the_same(f"replicas of {objective.name} raised an error, so the numerical floor is not known"):
        floor = find_floor(objective, dataset, through=lambda one: evaluator(one, executor, recipe(one)))
    hidden = look_between(evaluator(objective, executor, remake), dataset, floor=counted_from(floor))
    path = {} if training is None else training.over(plane_of(dataset), objective).attribute()
    return {**(floor_attribute(floor) if floor else {}), **hidden, **path}


def look_between(objective: Objective, dataset: xr.Dataset, *, floor: float = 0.0) -> dict[str, Any]:
    """Return the attribute of a slice that says which share of its cells is undersampled.

    `floor` [loss unit] is the least difference that counts. An objective that raises between them has been sampled all
    the same: that is warned of, and nothing is said.
    """
    with _sampled_all_the_same(f"{objective.name} raised an error between samples, so undersampling is not known"):
        found = find_undersampled(objective, dataset, floor=floor)
        return found.attribute() if found else {}
    return {}


@contextmanager
def _sampled_all_the_same(said: str) -> Iterator[None]:
    """Warn of what is raised after a slice was sampled, and go on; lost workers and a full disk pass.

    Once they are there again, the slice is finished.
    """
    try:
        yield
    except (OSError, MemoryError):
        raise
    except Exception as error:
        warnings.warn(f"{said}: {error}", RuntimeWarning, stacklevel=4)


def barrier_of(dataset: xr.Dataset) -> float | None:
    """Return the height of the barrier on a line between two points, None for other slices and where samples failed."""
    if dataset["loss"].ndim != 1 or JOINED not in stored_identity(dataset).get("cut", {}):
        return None
    height = barrier(dataset["u"].to_numpy(), dataset["loss"].to_numpy())
    return height if math.isfinite(height) else None


def range_of(dataset: xr.Dataset) -> dict[str, float | None]:
    """Return the lowest and the highest finite loss of a slice, None where there is none."""
    loss = dataset["loss"].to_numpy()
    if not np.isfinite(loss).any():
        return {"lowest": None, "highest": None}
    return {"lowest": float(np.nanmin(loss)), "highest": float(np.nanmax(loss))}


def say_range(loss: Mapping[str, float | None]) -> str:
    """Say in words what `range_of` returns."""
    low, high = loss["lowest"], loss["highest"]
    return "no finite loss" if low is None else f"losses from {low:.4g} to {high:.4g}"


def flat_points(dataset: xr.Dataset) -> int | None:
    """Count the points whose gradient along the plane is exactly zero, none if gradients are not there."""
    if "grad" not in dataset:
        return None
    slope = plane_of(dataset).slope(torch.from_numpy(dataset["grad"].to_numpy()))
    return int((slope == 0).all(dim=-1).sum())
