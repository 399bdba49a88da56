"""Descents with every remedy and without: each remedy is kept as soon as it is tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..envs.remedies import remedied
from ..landscapes.capacity import Need, require
from ..landscapes.cost import PICTURE_SECONDS, duration, episode_cost
from ..landscapes.measures.verdict import judge_samples
from ..landscapes.sampling.fill import sample
from ..landscapes.storage.checkpoint import Checkpoint
from ..landscapes.storage.files import replacing
from ..studies.remedies import WITHOUT, Ends, RemedyStudy, candidates, conclude, descend, treat
from .folder import REMEDY, folder_named
from .job import CheckpointedJob
from .plan import simulation_seconds
from .scene import SceneSpec, first_line, plane_through, provenance
from .search import points_within
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.objective import Objective

MAPS = REMEDY.files[1]
STARTS, BUDGET, RESOLUTION = 32, 320, 16
TIMED = "gradient-cost"  # the part with what a gradient costs: a continued study has the same


@dataclass(frozen=True, kw_only=True)
class RemedyJob(CheckpointedJob[RemedyStudy]):
    """Descents of `env` from so many `starts`, each at the cost of `budget` episodes with gradient, with `remedies`."""

    results = REMEDY
    env: Environment
    remedies: tuple[str, ...]
    dims: tuple[int, ...]
    starts: int
    budget: int
    seed: int
    identity: dict[str, Any]

    @classmethod
    def open(
        cls,
        scene: SceneSpec,
        remedies: Sequence[str] = (),
        *,
        dims: Sequence[int | str] = (),
        starts: int = STARTS,
        budget: int = BUDGET,
        seed: int = 0,
        out: Path | None = None,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
    ) -> RemedyJob:
        """Continue the study in its folder, by default one named after it, or begin it there.

        Without `remedies` it tries all that the scene can take. `dims` are the parameters of the plane that pictures
        and words are of, by default the first two. Raises ValueError for what the scene does not have, TooLargeError
        for more starts than there is memory for, StoreMismatchError where the folder holds another study.
        """
        env = scene.make()
        for text in remedies:
            points_within(remedied(env, text), budget)
        require("starts", starts, lambda count: Need(64.0 * env.space.dim * count))
        require("budget", budget, lambda count: Need(24.0 * env.space.dim * starts * count))
        plane = tuple(map(env.space.index, dims)) or tuple(range(min(2, env.space.dim)))
        identity = {
            **env.identity(), "remedies": list(remedies), "starts": starts, "budget": budget, "seed": seed,
            "dims": list(plane),
        }  # fmt: skip
        folder = out or folder_named(["remedy", env.name, env.fidelity.name], identity)
        return cls(
            env=env, remedies=tuple(remedies), dims=plane, starts=starts, budget=budget, seed=seed, identity=identity,
            folder=folder, checkpoint=Checkpoint.open(folder, identity, what="study of remedies", force=force),
            prints=prints, command=command,
        )  # fmt: skip

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The rows: without a remedy, and with each."""
        return WITHOUT, *(self.remedies or candidates(self.env))

    def work(self) -> list[Work]:
        """Return the most that each remedy takes: its descents, and the samples of the plane."""
        return [Work(self.env, 0, len(self.names) * (self.starts * self.budget + RESOLUTION ** len(self.dims) * 16))]

    def compute(self, watch: Watch) -> RemedyStudy:
        """Try the remedies that are missing, and return what all of them did."""
        cost = float(self.checkpoint.load_or_compute(TIMED, lambda: {"ratio": episode_cost(self.env).ratio})["ratio"])
        self._announce(watch)
        lowest: Tensor | None = None
        ends, maps = list[tuple[str, Ends, tuple[str, ...]]](), dict[str, NDArray[np.float64]]()
        for number, name in enumerate(self.names):
            part = self.checkpoint.load_or_compute(f"remedy-{number}", partial(self._try, name, cost, lowest, watch))
            ends.append((name, _ends_of(part), tuple(map(str, part["words"]))))
            lowest = ends[0][1].lowest(self.env.space)
            maps[name] = part["map"]
        rows = conclude(ends)
        return RemedyStudy(
            env=self.env.name, fidelity=self.env.fidelity.name, device=self.env.device, loss_unit=self.env.loss_unit,
            starts=self.starts, budget=self.budget, gradient_cost=cost,
            dims=tuple(self.env.space.labels[dim] for dim in self.dims), rows=tuple(rows), maps=maps,
            identity=self.identity, provenance=provenance(self.env, self.command), command=self.command,
        )  # fmt: skip

    def write(self, found: RemedyStudy) -> list[str]:
        """Draw and write the study, the losses on the plane in a file of their own."""
        maps: dict[str, Any] = {f"map_{number}": one for number, one in enumerate(found.maps.values())}
        with replacing(self.folder / MAPS) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **maps)
        return super().write(found)

    def outcome(self, found: RemedyStudy) -> str:
        """Say in a line what came out."""
        return found.sentence

    def verified(self) -> Objective:
        """Return the environment without a remedy."""
        return self.env

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{max(0, self.checkpoint.count() - 1)} remedies are kept in {self.folder}"

    def _try(self, name: str, cost: float, lowest: Tensor | None, watch: Watch) -> dict[str, Any]:
        """Return what a remedy does, as arrays for a file."""
        starts = self.env.space.to_unit(self.env.space.uniform(self.starts, seed=self.seed))
        treated = treat(self.env, name)
        with watch.progress(self.starts * self.budget) as advance:
            found = descend(
                self.env, treated, starts, budget=self.budget, gradient_cost=cost, lowest=lowest,
                follow=lambda done: advance(min(done, self.starts * self.budget), name),
            )  # fmt: skip
        plane = plane_through(treated, self.dims, through="center", window=None, resolution=RESOLUTION)
        with watch.busy(f"{name}: sampling a plane"):
            dataset = sample(treated, plane)
        words = np.array(judge_samples(dataset).words, dtype=str)
        return {
            "x": found.x.numpy(), "loss": found.loss.numpy(), "falls": found.falls, "points": found.points,
            "episodes_per_point": found.episodes_per_point, "moved": found.moved, "words": words,
            "map": dataset["loss"].to_numpy(),
        }  # fmt: skip

    def _announce(self, watch: Watch) -> None:
        env = self.env
        watch.note(first_line(env.identity(), self.folder))
        with watch.busy(f"{env.name}: {PREPARING}"):
            (work,) = self.work()
            each = simulation_seconds(env, work.losses, work.gradients, env.preferred_batch)
        seconds = each + PICTURE_SECONDS
        watch.announce(
            f"{len(self.names) - 1} remedies and no remedy, {self.starts} descents each at the cost of {self.budget} "
            f"gradients: at most {duration(seconds)}; --starts and --budget lower this",
            seconds,
        )


def _ends_of(part: Mapping[str, NDArray[Any]]) -> Ends:
    x, loss = torch.from_numpy(part["x"]), torch.from_numpy(part["loss"])
    return Ends(x, loss, int(part["points"]), int(part["episodes_per_point"]), part["falls"], float(part["moved"]))
