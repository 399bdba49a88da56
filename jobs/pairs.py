"""The pairs of a scene's parameters, ranked by how much a slice over them would show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.capacity import Need, require
from ..landscapes.cost import duration, seconds_per_episode
from ..landscapes.measures.sensitivity import Design, Pair, default_samples, explore, rank
from ..landscapes.storage.checkpoint import Checkpoint
from .folder import PAIRS, folder_named
from .job import CheckpointedJob
from .scene import SceneSpec, first_line, provenance
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    import pandas as pd

    from ..envs.base import Environment

NUMBERS = 60  # that are held for each parameter of a base point, copies included


@dataclass(frozen=True)
class PairRanking:
    """Record the pairs of a scene's parameters, with the largest score first.

    `identity` contains everything that decides the numbers, and `options` are those that were given. `spread` is the
    standard deviation of the losses, `total` the total sensitivity index of each parameter, and `failed` the number of
    `episodes` that failed.
    """

    identity: dict[str, Any]
    options: dict[str, Any]
    env: str
    episodes: int
    failed: int
    spread: float
    parameters: tuple[str, ...]
    total: tuple[float, ...]
    pairs: tuple[Pair, ...]
    provenance: dict[str, Any]

    @property
    def fidelity(self) -> str:
        """The fidelity it was measured at."""
        return str(self.identity["fidelity"])

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON, by the keys of the file: the identity's own first, `options` as `set`."""
        return {
            **self.identity,
            "set": self.options,
            "env": self.env,
            "episodes": self.episodes,
            "failed": self.failed,
            "spread": self.spread,
            "parameters": list(self.parameters),
            "total": list(self.total),
            "pairs": [asdict(pair) | {"dims": list(pair.dims)} for pair in self.pairs],
            "provenance": self.provenance,
        }

    def name(self, pair: Pair) -> str:
        """Return the names of a pair's parameters."""
        return " \N{MULTIPLICATION SIGN} ".join(self.parameters[axis] for axis in pair.dims)

    def table(self) -> pd.DataFrame:
        """Return a table of all pairs, the largest score first, with their names and measures."""
        import pandas as pd

        return pd.DataFrame([{"pair": self.name(pair), **asdict(pair)} for pair in self.pairs])

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


@dataclass(frozen=True, kw_only=True)
class PairsJob(CheckpointedJob[PairRanking]):
    """A design of points to evaluate for an environment; a part of the checkpoint for each batch."""

    results = PAIRS
    env: Environment
    design: Design
    identity: dict[str, Any]
    options: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def open(
        cls,
        scene: SceneSpec,
        *,
        samples: int | None = None,
        seed: int = 0,
        out: Path | None = None,
        force: bool = False,
        command: str = "",
    ) -> PairsJob:
        """Continue the study in its folder, by default one named after it, or begin it there.

        `samples` base points are taken, by default as many as their episodes are worth. Raises ValueError where the
        scene has one parameter or there is no room, and where the folder holds another study.
        """
        env = scene.make()
        dim = env.space.dim
        if dim < 2:
            raise ValueError(f"pairs takes an environment with at least two parameters; {env.name} has one")
        samples = samples or default_samples(dim)
        require("samples", samples, lambda count: Need(8.0 * NUMBERS * dim * count))
        identity = {**env.identity(), "samples": samples, "seed": seed}
        folder = out or folder_named(["pairs", identity["objective"], identity["fidelity"], samples], identity)
        checkpoint = Checkpoint.open(folder, identity, what="pairs", force=force)
        return cls(
            env=env, design=Design.sobol(env.space, samples, seed=seed), identity=identity, checkpoint=checkpoint,
            folder=folder, options=scene.options, command=command,
        )  # fmt: skip

    def work(self) -> list[Work]:
        """Return its design, which has gradients at the base points."""
        base, episodes = len(self.design.base), self.design.episodes
        return [Work(self.env, episodes - base, base, 8.0 * episodes * (2 + self.env.space.dim))]

    def compute(self, watch: Watch) -> PairRanking:
        """Evaluate what is missing, and return the ranking."""
        self._announce(watch)
        with watch.progress(self.design.episodes) as advance:
            found = explore(self.env, self.design, self.checkpoint, follow=advance)
        return PairRanking(
            identity=self.identity,
            options=dict(self.options),
            env=self.env.name,
            episodes=self.design.episodes,
            failed=found.failed,
            spread=found.spread,
            parameters=tuple(self.env.space.names),
            total=tuple(found.total().tolist()),
            pairs=tuple(rank(found)),
            provenance=provenance(self.env, self.command),
        )

    def verified(self) -> Environment:
        """Return the environment."""
        return self.env

    def _announce(self, watch: Watch) -> None:
        env, design = self.env, self.design
        with watch.busy(f"{env.name}: {PREPARING}"):
            env.prepare()
            each = seconds_per_episode(env, design.move_one(range(1))[: env.preferred_batch], grad=False)
        samples, dim = len(design.base), env.space.dim
        watch.note(first_line(env.identity(), self.folder))
        seconds = design.episodes * each
        watch.announce(
            f"{design.episodes} episodes, {samples} with gradients, for {dim} parameters and {dim * (dim - 1) // 2} "
            f"pairs: at most about {duration(seconds)}; --samples lowers this",
            seconds,
        )
