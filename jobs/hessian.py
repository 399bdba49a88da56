"""The Hessian of a scene at a point: its differences are kept as they are computed, and the spectrum is of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ..landscapes.capacity import Need, require
from ..landscapes.cost import PICTURE_SECONDS, duration
from ..landscapes.curvature import (
    LANCZOS,
    MATRIX,
    NOISE,
    RESTARTS,
    STEPS,
    TRIED,
    VECTORS,
    Curvature,
    measure_spectrum,
)
from ..landscapes.measures.hessian import BOX_UNITS, Hessian, conclude
from ..landscapes.objective import LossesOnly, Objective, evaluate
from ..landscapes.storage.checkpoint import Checkpoint
from ..landscapes.storage.files import replacing
from .folder import HESSIAN, folder_named
from .job import CheckpointedJob
from .plan import simulation_seconds
from .scene import SceneSpec, first_line, given_point, provenance
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from ..envs.base import Environment

RECORD, ARRAYS, PICTURE = HESSIAN.files
KEPT = ("values", "errors", "vectors", "nodes", "weights")  # the record's arrays
PAIRS, PROBES = 5, 8
COPIES = 6  # of the vectors and products that are held


@dataclass(frozen=True, kw_only=True)
class HessianJob(CheckpointedJob[Hessian]):
    """The Hessian of `env` at a point `x`, which is called `through`: `pairs` eigenvalues at both ends are examined.

    With many parameters the spectrum is sampled by `probes` random directions.
    """

    results = HESSIAN
    env: Environment
    x: Float[Tensor, " dim"]
    through: str
    pairs: int
    probes: int
    seed: int
    identity: dict[str, Any]

    @classmethod
    def open(
        cls,
        scene: SceneSpec,
        through: Any = "center",
        *,
        pairs: int = PAIRS,
        probes: int = PROBES,
        seed: int = 0,
        out: Path | None = None,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
    ) -> HessianJob:
        """Continue the Hessian in its folder, by default one named after it, or begin it there.

        `through` names a point, or is one. Raises ValueError for what the scene does not have or memory does not hold,
        and where the folder holds another Hessian.
        """
        env = scene.make()
        x, dim = given_point(env, through, "hessian"), env.space.dim
        require("eigenpairs", pairs, lambda count: Need(8.0 * COPIES * dim * 2 * count))
        require("probes", probes, lambda count: Need(8.0 * COPIES * dim * (LANCZOS + 2) * count))
        identity = {**env.identity(), "point": x.tolist(), "eigenpairs": pairs, "probes": probes, "seed": seed}
        folder = out or folder_named(["hessian", env.name, env.fidelity.name], identity)
        checkpoint = Checkpoint.open(folder, identity, what="Hessian", force=force)
        said = through if isinstance(through, str) else "a point"
        return cls(
            env=env, x=x, through=said, pairs=pairs, probes=probes, seed=seed, identity=identity, folder=folder,
            checkpoint=checkpoint, prints=prints, command=command,
        )  # fmt: skip

    @cached_property
    def has_gradients(self) -> bool:
        """Whether the scene has gradients."""
        try:
            return evaluate(self.env, self.x[None], grad=True).grad is not None
        except ValueError:
            return False

    def work(self) -> list[Work]:
        """Return the differences of gradients, or of losses where there are none, at most."""
        dim, most = self.env.space.dim, self._episodes()
        counts = (NOISE, most - NOISE) if self.has_gradients else (most, 0)
        return [Work(self.env, *counts, 8.0 * most * (1 + dim))]

    def compute(self, watch: Watch) -> Hessian:
        """Take the differences that are missing, and return what they say."""
        self._announce(watch)
        curvature = Curvature(self.env, self.x, keep=self.checkpoint.load_or_compute)
        with watch.progress(most := self._episodes()) as advance:
            curvature.follow = lambda done: advance(min(done, most))
            found = measure_spectrum(curvature, pairs=self.pairs, probes=self.probes, seed=self.seed)
        values = self.env.space.to_values(self.x)
        return conclude(
            curvature,
            found,
            pairs=self.pairs,
            identity=self.identity,
            env=self.env.name,
            fidelity=self.env.fidelity.name,
            through=self.through,
            point=dict(zip(self.env.space.labels, values.tolist(), strict=True)),
            loss_unit=self.env.loss_unit,
            provenance=provenance(self.env, self.command),
            command=self.command,
        )

    def write(self, found: Hessian) -> list[str]:
        """Draw and write the spectrum, the arrays in a file of their own."""
        with replacing(self.folder / ARRAYS) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **{name: getattr(found, name) for name in KEPT})
        return super().write(found)

    def outcome(self, found: Hessian) -> str:
        """Say in a line what came out."""
        return f"{found.env} at {found.through}: {found.kind}, in {BOX_UNITS}"

    def verified(self) -> Objective:
        """Return the environment, without the gradients that it does not have."""
        return self.env if self.has_gradients else LossesOnly(self.env)

    def _episodes(self) -> int:
        """Return how many episodes it takes at most."""
        dim = self.env.space.dim
        pairs = 4 * min(dim, 2 * self.pairs)
        tried = 2 * len(STEPS) * min(dim, TRIED["gradients" if self.has_gradients else "losses"])
        if not self.has_gradients:
            return 1 + tried + 4 * dim**2 + pairs + NOISE
        if dim <= MATRIX:
            return 1 + tried + 4 * dim + pairs + NOISE
        kept = min(dim, max(VECTORS, 4 * self.pairs + 1))
        restarted = kept + RESTARTS * max(1, kept - 2 * self.pairs)
        return 1 + tried + 2 * self.probes * (LANCZOS + 1) + 2 * restarted + pairs + NOISE

    def _announce(self, watch: Watch) -> None:
        env, (work,) = self.env, self.work()
        watch.note(first_line(env.identity(), self.folder))
        with watch.busy(f"{env.name}: {PREPARING}"):
            each = simulation_seconds(env, work.losses, work.gradients, env.preferred_batch)
        dim, seconds = env.space.dim, each + PICTURE_SECONDS
        how = "the whole matrix" if not self.has_gradients or dim <= MATRIX else "products with the matrix"
        lower = "" if dim <= MATRIX else "; --probes and --eigenpairs lower this"
        watch.announce(
            f"{how} of {dim} parameters: at most {work.losses + work.gradients} episodes, {work.gradients} with "
            f"gradients, about {duration(seconds)}{lower}",
            seconds,
        )
