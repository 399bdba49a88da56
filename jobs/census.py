"""The census of a scene: many slices of it, each sampled and measured by itself, here or by workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..landscapes.capacity import Need, require
from ..landscapes.cost import PICTURE_SECONDS, duration
from ..landscapes.objective import Evaluation, evaluate
from ..landscapes.sampling.distribution import PortableObjective, run_tasks, workers_of
from ..landscapes.sampling.memory import MemoryBound
from ..landscapes.storage.files import replacing
from ..landscapes.verification import LAST_PLACE
from .folder import CENSUS, ROOT, folder_named
from .job import CheckpointedJob
from .plan import simulation_seconds
from .scene import SceneSpec, first_line, provenance
from .watch import PREPARING, Watch, Work
from .workers import recipe

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.measures.census import Census, CensusDesign, SurveyedSlice
    from ..landscapes.measures.floor import Floor
    from ..landscapes.plane import Plane

RECORD, LOSSES, PICTURE = CENSUS.files
SLICES, RESOLUTION = 64, 24
NOISE_POINTS, REPEATS = 16, 4
OWN, SAMPLES = "original", ("loss", "grad", "status")  # of what replicas are held against
MEASURING_SECONDS = 0.05  # of a slice, next to what it simulates
OTHERS = 4  # one slice of so many is surveyed at the other fidelity, too
COPIES = 4  # of the losses and gradients of a slice


@dataclass(frozen=True)
class Task:
    """Record a slice to survey: the name of its piece, its number in the design, and its environment."""

    piece: str
    number: int
    other: bool


@dataclass(frozen=True, kw_only=True)
class CensusJob(CheckpointedJob["Census"]):
    """The slices of `design` to survey for `env`; a part of the checkpoint for each.

    Every fourth is surveyed for `other`, too: the scene at another fidelity, None for none. With an `executor` its
    workers survey, a slice each.
    """

    results = CENSUS
    env: Environment
    other: Environment | None
    design: CensusDesign
    seed: int
    executor: Executor | None = None

    @classmethod
    def open(
        cls,
        scene: SceneSpec,
        *,
        slices: int = SLICES,
        resolution: int = RESOLUTION,
        gradients: int = 1,
        along: str = "pairs",
        also: str | None = None,
        seed: int = 0,
        out: Path | None = None,
        root: Path = ROOT,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
    ) -> CensusJob:
        """Continue the census in its folder, by default one named after it under `root`, or begin it there.

        Raises ValueError for what the scene does not have, for fewer than six samples along an axis or three of them
        with gradients, and where the scene has one parameter; TooLargeError for more slices than there is memory for;
        StoreMismatchError where the folder holds another census.
        """
        from ..landscapes.measures.census import CUTS, CensusDesign
        from ..landscapes.measures.verdict import WORDS
        from ..landscapes.storage.checkpoint import Checkpoint

        env = scene.make()
        if resolution < 6:
            raise ValueError(
                f"census also measures every second sample, so it takes --resolution of at least 6; got {resolution}"
            )
        if gradients < 1 or gradients > resolution // 3:
            raise ValueError(
                f"census takes --gradients from 1 (every sample) to a third of the resolution, {resolution // 3}; got "
                f"{gradients}"
            )
        require("resolution", resolution, lambda side: Need(8.0 * COPIES * (1 + env.space.dim) * side**2))
        require("slices", slices, lambda count: Need(8.0 * count * resolution**2, 8.0 * count * resolution**2))
        cut: dict[str, Any] = {"along": along, "resolution": resolution, "gradients": gradients, "seed": seed}
        design = CensusDesign.draw(env.space, slices, **cut)
        other = replace(scene, fidelity=also, tolerance=None).make() if also else None
        identity = {**env.identity(), "slices": slices, "resolution": resolution, "along": along, "seed": seed}
        identity["cuts"] = CUTS
        if gradients > 1:  # a census that was begun when all had them continues
            identity["gradients"] = gradients
        identity["other"] = other.identity()["settings"] if other else None
        identity["words"] = WORDS  # slices that were judged by others are not mixed with these
        folder = out or folder_named(["census", env.name, env.fidelity.name, slices], identity, root)
        checkpoint = Checkpoint.open(folder, identity, what="census", force=force)
        return cls(
            env=env, other=other, design=design, seed=seed, checkpoint=checkpoint, folder=folder, command=command,
            prints=prints,
        )  # fmt: skip

    @property
    def tasks(self) -> list[Task]:
        """What is to be surveyed: every slice, then those of the other fidelity."""
        whole = [Task(f"slice-{number}", number, False) for number in range(len(self.design.places))]
        again = [Task(f"other-{n}", n, True) for n in range(0, len(self.design.places), OTHERS)]
        return whole + (again if self.other else [])

    def work(self) -> list[Work]:
        """Return the samples of all slices, and what their noise and their numerical floor are measured by."""
        from ..landscapes.measures.verdict import RANGE_POINTS

        without, having = self._effort()
        again = sum(task.other for task in self.tasks)
        noise, others = NOISE_POINTS * (1 + REPEATS) + RANGE_POINTS, len(self.env.replicas())
        replicas = NOISE_POINTS * (1 + others) if others else 0
        counts = [(self.env, len(self.tasks) - again, noise, replicas), (self.other, again, 0, 0)]
        return [
            Work(
                env,
                count * without + fuzz,
                count * having + apart,
                8.0 * count * (without + having * (1 + env.space.dim)),
            )
            for env, count, fuzz, apart in counts
            if env is not None
        ]

    def _effort(self) -> tuple[int, int]:
        """Return how many losses, and how many gradients, a slice takes at most: its samples and what judges them."""
        from ..landscapes.measures.census import judging_effort

        (losses, gradients), (more_losses, more_gradients) = self.design.samples, judging_effort()
        return losses + more_losses, gradients + more_gradients

    def compute(self, watch: Watch) -> Census:
        """Survey what is missing, and return the census."""
        from ..landscapes.measures.census import survey

        (deviation, own_range), replicas = self._scales(watch), self._replicas(watch)
        self._announce(watch)
        floor = self._floor(replicas, None) if replicas else None
        judge = partial(
            survey, deviation=deviation, own_range=own_range, floor=floor, seed=self.seed,
            gradients=self.design.gradients,
        )  # fmt: skip
        return self._conclude(self._survey(judge, watch), replicas)

    def write(self, found: Census) -> list[str]:
        """Draw and write the census, the losses in a file of their own."""
        from ..landscapes.measures.census import scale

        with replacing(self.folder / LOSSES) as partial, partial.open("wb") as file:
            scaled: Any = scale(found.losses)
            np.savez_compressed(file, **scaled)
        return super().write(found)

    def verified(self) -> Environment:
        """Return the environment."""
        return self.env

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{len(self.tasks) - len(self.left())} of {len(self.tasks)} slices are kept in {self.folder}"

    def left(self) -> list[Task]:
        """Return what is not surveyed yet."""
        return [task for task in self.tasks if self.checkpoint.load(task.piece) is None]

    def _scales(self, watch: Watch) -> tuple[float, float]:
        """Return the deviation of the losses' noise and their range, at random points of the box [loss unit]."""
        from ..landscapes.measures.noise import noise
        from ..landscapes.measures.verdict import measure_range

        def measure() -> dict[str, float]:
            with watch.busy(f"{self.env.name}: {PREPARING}, then measuring noise"):
                self.env.prepare()
                x = self.env.space.uniform(NOISE_POINTS, seed=self.seed)
                rounding = LAST_PLACE[self.env.fidelity.precision]
                found = noise(self.env, x, rounding=rounding, repeats=REPEATS, seed=self.seed)
                return {"deviation": found.deviation, "range": measure_range(self.env, seed=self.seed)}

        kept = self.checkpoint.load_or_compute("noise", measure)
        return float(np.nan_to_num(kept["deviation"])), float(kept["range"])

    def _replicas(self, watch: Watch) -> dict[str, Evaluation]:
        """Return what the environment and its replicas are at random points, by name; nothing where it has none."""
        from ..landscapes.measures.floor import evaluate_replicas

        if not (replicas := self.env.replicas()):
            return {}
        names = [OWN, *replicas]
        if (kept := self.checkpoint.load("floor")) is None or kept["names"].tolist() != names:
            with watch.busy(f"{self.env.name}: measuring the numerical floor"):
                x = self.env.space.uniform(NOISE_POINTS, seed=self.seed)
                own = evaluate(self.env, x, grad=True)
                found = [own, *evaluate_replicas(self.env, x, replicas, grad=True).values()]
            parts = {part: torch.stack([getattr(one, part) for one in found]).numpy() for part in SAMPLES}
            kept = {"names": np.array(names), **parts}
            self.checkpoint.save("floor", **kept)
        each = zip(*(torch.from_numpy(kept[part]) for part in SAMPLES), strict=True)
        return {name: Evaluation(*one) for name, one in zip(names, each, strict=True)}

    def _floor(self, replicas: Mapping[str, Evaluation], whole: float | None) -> Floor:
        """Return the numerical floor, of a range of losses; by default that at the points."""
        from ..landscapes.measures.floor import floor_between

        others = {name: one for name, one in replicas.items() if name != OWN}
        sides = self.env.space.upper - self.env.space.lower
        return floor_between(replicas[OWN], others, sides=sides, range=whole, seed=self.seed)

    def _announce(self, watch: Watch) -> None:
        left, samples = self.left(), self.design.resolution**2
        bases, cuts = len(self.design.bases), len(self.design.cuts)
        watch.note(first_line(self.env.identity(), self.folder))
        without, having = self.design.samples
        what = (
            f"{len(self.design.places)} slices through {bases} base points along {cuts} cuts, {samples} samples each"
            f"{f', {having} of them with gradients' if without else ''}"
        )
        kept = f"; {len(self.tasks) - len(left)} are done already" if len(left) < len(self.tasks) else ""
        watch.note(f"{what}{kept}")
        if left:
            losses, slopes = self._effort()
            each = simulation_seconds(self.env, losses, slopes, losses + slopes)
            lower = "--slices, --resolution and --gradients"
            seconds = len(left) * (each + MEASURING_SECONDS) + PICTURE_SECONDS
            watch.announce(f"about {duration(seconds)} here; {lower} change this", seconds)

    def _survey(self, judge: Survey, watch: Watch) -> dict[str, SurveyedSlice]:
        from ..landscapes.measures.census import SurveyedSlice

        left = self.left()
        with watch.progress(len(self.tasks), "slices") as advance:
            done = len(self.tasks) - len(left)
            advance(done)
            for piece, arrays in self._do(left, judge):
                self.checkpoint.save(piece, **arrays)
                advance(done := done + 1)
        pieces = {task.piece: self.checkpoint.load(task.piece) for task in self.tasks}
        return {name: SurveyedSlice.of_arrays(arrays) for name, arrays in pieces.items() if arrays is not None}

    def _do(self, tasks: Sequence[Task], judge: Survey) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Survey slices, here or by workers, enough at once to fill a batch, and yield the arrays of each piece."""
        workers = workers_of(self.executor) if self.executor else 1
        for other in (False, True):
            env = self.other if other else self.env
            chosen = [task for task in tasks if task.other == other]
            todo = [(task.piece, self.design.plane(*self.design.places[task.number])) for task in chosen]
            if env is None or not todo:
                continue
            size = min(_abreast(env), -(-len(todo) // workers))
            groups = [todo[start : start + size] for start in range(0, len(todo), size)]
            if self.executor is None:
                for group in groups:
                    yield from _survey(env, group, judge)
                continue
            sent = PortableObjective.of(env, recipe(env))
            for found in run_tasks(self.executor, _survey_there, [(sent, group, judge) for group in groups]):
                yield from found

    def _conclude(self, found: Mapping[str, SurveyedSlice], replicas: Mapping[str, Evaluation]) -> Census:
        from ..landscapes.measures.census import conclude
        from ..landscapes.measures.ruggedness import span

        whole = [found[task.piece] for task in self.tasks if not task.other]
        others = {task.number: found[task.piece] for task in self.tasks if task.other}
        ranges = [span(one.loss) for one in whole if np.isfinite(one.loss).any()]
        median_range = float(np.median(ranges)) if ranges else None
        return conclude(
            self.design,
            whole,
            others,
            seed=self.seed,
            env=self.env.name,
            fidelity=self.env.fidelity.name,
            other=self.other.fidelity.name if self.other else "",
            loss_unit=self.env.loss_unit,
            identity=self.env.identity(),
            provenance=provenance(self.env, self.command),
            command=self.command,
            floor=self._floor(replicas, median_range) if replicas else None,
        )


Piece = tuple[str, dict[str, Any]]  # its name, and what it holds
Survey = Callable[[Any, Sequence[Any]], Sequence[Any]]  # `measures.census.survey` with all that it judges by


def _abreast(env: Environment) -> int:
    """Return how many slices are surveyed at once, so that looking for jumps in all of them fills a batch."""
    from ..landscapes.measures.census import STEEP

    return -(-env.preferred_batch // STEEP)


def _survey(env: Any, group: Sequence[tuple[str, Plane]], judge: Survey) -> list[Piece]:
    """Survey slices, their points simulated in one batch, and return what their pieces hold."""
    found = judge(MemoryBound(env), [plane for _, plane in group])
    return [(piece, one.arrays()) for (piece, _), one in zip(group, found, strict=True)]


def _survey_there(sent: PortableObjective, group: Sequence[tuple[str, Plane]], judge: Survey) -> list[Piece]:
    """Survey slices on a worker, which keeps the environment that it has made."""
    return _survey(sent.objective.objective, group, judge)
