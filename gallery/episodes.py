"""Films of the episodes at a few nodes of a figure's slice."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..commands.terminal import Console
from ..envs.registry import environment_class, make
from .parts import LOSS, Part, read_record, seconds_of_one
from .site.page_data import EPISODES

if TYPE_CHECKING:
    import xarray as xr
    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.plane import Plane

HEIGHT, LONGEST = 480, 60  # of a film: pixels and most frames
DRAWING = 0.15  # seconds per frame, about
FILM = re.compile(r"episode-\d+-\d+\.(?:mp4|webp)")


@dataclass(frozen=True)
class Node:
    """A node whose episode is shown, and why."""

    row: int
    column: int
    why: str
    loss: float | None
    status: str

    @property
    def name(self) -> str:
        """The name of its files, without their ending."""
        return f"episode-{self.row}-{self.column}"


class Episodes(Part):
    """Films of the episodes at a few nodes, at the figure's fidelity."""

    def label(self) -> str:
        """Count the nodes."""
        return f"the episodes at {len(self._nodes)} nodes"

    def left(self) -> int:
        """Count the nodes without a film, none in an environment that has no episodes to draw."""
        from ..envs.base import Environment

        drawn = environment_class(self.figure.env).episode is not Environment.episode
        return len(self._nodes) - len(self._kept()) if drawn else 0

    def seconds_each(self) -> float:
        """Time an episode, and assume what drawing it takes."""
        return seconds_of_one(self._env(self.figure.fidelity)) + LONGEST * DRAWING

    def make(self, console: Console) -> str:
        """Film every episode that is not there, and clear away those of other nodes."""
        from ..landscapes.identity import plane_of
        from ..landscapes.storage.files import write_json
        from ..landscapes.storage.records import sign

        dataset, env = self._dataset, self._env(self.figure.fidelity)
        plane, kept = plane_of(dataset), self._kept()
        for node in self._nodes:
            if node not in kept:
                with console.status(f"{self.figure.id}: the episode of {node.why}"):
                    self._draw(env, plane, node)
                write_json(self.folder / EPISODES, [sign(asdict(one)) for one in [*kept, node]])
                kept.append(node)
        for file in self.folder.glob("episode-*"):
            if FILM.fullmatch(file.name) and file.stem not in {node.name for node in self._nodes}:
                file.unlink()
        write_json(self.folder / EPISODES, [sign(asdict(node)) for node in self._nodes])
        return f"{len(self._nodes)} episodes"

    def _draw(self, env: Environment, plane: Plane, node: Node) -> None:
        import torch

        from ..landscapes.draw.film import save_film, save_still
        from ..landscapes.draw.render import replay

        axes = [axis.tolist() for axis in plane.axes()]
        place = [axis[at] for axis, at in zip(axes, (node.column, node.row), strict=False)]
        episode = env.episode(plane.lift(torch.tensor([place], dtype=torch.float64))[0])
        count = min(LONGEST, len(episode.time))
        chosen = np.linspace(0, len(episode.time) - 1, count).round().astype(int).tolist()
        pictures = list(replay.frames(episode, chosen, height=HEIGHT))
        save_still(pictures[-1], self.folder / f"{node.name}.webp")
        save_film(pictures, self.folder / f"{node.name}.mp4", None, count=count, rate=replay.RATE, loss=LOSS)

    @cached_property
    def _dataset(self) -> xr.Dataset:
        from ..jobs.slice import STORE
        from ..landscapes.storage.store import open_slice

        return open_slice(self.folder / STORE)

    @cached_property
    def _nodes(self) -> list[Node]:
        from ..envs.points import point

        return nodes_shown(self._dataset, point(make(self.figure.env, device="cpu"), self.figure.through))

    def _kept(self) -> list[Node]:
        """Return the nodes whose films are there."""
        kept = read_record(self.folder / EPISODES)
        return [
            node for node in self._nodes
            if isinstance(kept, list) and asdict(node) in kept
            and all((self.folder / f"{node.name}.{kind}").exists() for kind in ("mp4", "webp"))
        ]  # fmt: skip


def nodes_shown(dataset: xr.Dataset, through: Float[Tensor, " dim"]) -> list[Node]:
    """Choose the nodes of least, median and largest loss, and the one nearest the point the slice goes through."""
    from ..landscapes.identity import plane_of
    from ..landscapes.objective import Status

    loss, status = np.atleast_2d(dataset["loss"].to_numpy()), np.atleast_2d(dataset["status"].to_numpy())
    plane = plane_of(dataset)
    here = plane.project(through[None])[0].tolist()
    nearest = [int(abs(axis - at).argmin()) for axis, at in zip(plane.axes(), here, strict=True)]
    ranked = np.argsort(loss, axis=None, kind="stable")[: int(np.isfinite(loss).sum())]
    wanted = [
        ("lowest loss", ranked[:1]),
        ("median loss", ranked[len(ranked) // 2 :][:1]),
        ("highest loss", ranked[-1:]),
    ]
    places = {why: np.unravel_index(int(at[0]), loss.shape) for why, at in wanted if len(at)}
    places["through the slice's point"] = tuple(
        np.intp(at) for at in ([0, *nearest] if len(nearest) == 1 else nearest[::-1])
    )
    found: dict[tuple[int, int], Node] = {}
    for why, (row, column) in places.items():
        value = float(loss[row, column])
        said = value if np.isfinite(value) else None
        node = Node(int(row), int(column), why, said, Status(int(status[row, column])).name)
        found.setdefault((node.row, node.column), node)
    return list(found.values())
