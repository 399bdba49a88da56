"""Films of the episodes at a few nodes of a figure's slice."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..envs.registry import environment_class, make
from ..jobs.watch import Watch
from .files import EPISODE_KINDS, EPISODES, STORE, is_of_episode
from .parts import LOSS, FigurePart, seconds_of_one
from .records import Node, read_if_sound, read_nodes, write_nodes

if TYPE_CHECKING:
    import xarray as xr
    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.plane import Plane

HEIGHT, LONGEST = 480, 60  # of a film: pixels and most frames
DRAWING = 0.15  # seconds per frame, about


class EpisodePart(FigurePart):
    """Films of the episodes at a few nodes, at the figure's fidelity."""

    def label(self) -> str:
        """Count the nodes."""
        return f"the episodes at {len(self._nodes)} nodes"

    def count_left(self) -> int:
        """Count the nodes without a film, none in an environment that has no episodes to draw."""
        from ..envs.base import Environment

        drawn = environment_class(self.figure.env).episode is not Environment.episode
        return len(self._nodes) - len(self._find_films()) if drawn else 0

    def seconds_each(self) -> float:
        """Time an episode, and assume what drawing it takes."""
        return seconds_of_one(self.scene().make()) + LONGEST * DRAWING

    def make(self, watch: Watch) -> str:
        """Film every episode that is not there, and clear away those of other nodes."""
        from ..landscapes.identity import plane_of

        env, plane, filmed = self.scene().make(), plane_of(self._dataset), self._find_films()
        for node in self._nodes:
            if node not in filmed:
                with watch.busy(f"{self.figure.id}: the episode of {node.why}"):
                    self._film(env, plane, node)
                filmed.append(node)
                write_nodes(self.folder / EPISODES, filmed)
        for file in self.folder.glob("episode-*"):
            if is_of_episode(file) and file.stem not in {node.name for node in self._nodes}:
                file.unlink()
        write_nodes(self.folder / EPISODES, self._nodes)
        return f"{len(self._nodes)} episodes"

    def _film(self, env: Environment, plane: Plane, node: Node) -> None:
        import torch

        from ..landscapes.draw.film import save_film, save_still
        from ..landscapes.draw.render import replay

        axes = [axis.tolist() for axis in plane.axes()]
        place = [axis[at] for axis, at in zip(axes, (node.column, node.row), strict=False)]
        episode = env.episode(plane.lift(torch.tensor([place], dtype=torch.float64))[0])
        count = min(LONGEST, len(episode.time))
        shown = np.linspace(0, len(episode.time) - 1, count).round().astype(int).tolist()
        pictures = list(replay.frames(episode, shown, height=HEIGHT))
        save_still(pictures[-1], self.folder / f"{node.name}.webp")
        save_film(pictures, self.folder / f"{node.name}.mp4", None, count=count, rate=replay.RATE, loss=LOSS)

    @cached_property
    def _dataset(self) -> xr.Dataset:
        from ..landscapes.storage.store import open_slice

        return open_slice(self.folder / STORE)

    @cached_property
    def _nodes(self) -> list[Node]:
        from ..envs.points import point

        return choose_nodes(self._dataset, point(make(self.figure.env, device="cpu"), self.figure.through))

    def _find_films(self) -> list[Node]:
        """Return the nodes whose films are there."""
        listed = read_if_sound(read_nodes, self.folder / EPISODES) or []
        return [
            node for node in self._nodes
            if node in listed and all((self.folder / f"{node.name}.{kind}").exists() for kind in EPISODE_KINDS)
        ]  # fmt: skip


def choose_nodes(dataset: xr.Dataset, through: Float[Tensor, " dim"]) -> list[Node]:
    """Choose the nodes of least, median and largest loss, and the one nearest the point the slice goes through.

    Of a node that is chosen twice the first reason counts; the nodes of a line are in row 0.
    """
    from ..landscapes.objective import Status

    loss, status = np.atleast_2d(dataset["loss"].to_numpy()), np.atleast_2d(dataset["status"].to_numpy())
    finite = np.argsort(loss, axis=None, kind="stable")[: int(np.isfinite(loss).sum())]
    ranked = {"lowest loss": finite[:1], "median loss": finite[len(finite) // 2 :][:1], "highest loss": finite[-1:]}
    places = {why: int(at[0]) for why, at in ranked.items() if len(at)}
    places["through the slice's point"] = int(np.ravel_multi_index(_nearest(dataset, through), loss.shape))
    nodes: dict[int, Node] = {}
    for why, place in places.items():
        row, column = divmod(place, loss.shape[1])
        value = float(loss[row, column])
        name = Status(int(status[row, column])).name
        nodes.setdefault(place, Node(row, column, why, value if np.isfinite(value) else None, name))
    return list(nodes.values())


def _nearest(dataset: xr.Dataset, through: Float[Tensor, " dim"]) -> tuple[int, int]:
    """Return row and column of the node nearest a point."""
    from ..landscapes.identity import plane_of

    plane = plane_of(dataset)
    here = plane.project(through[None])[0].tolist()
    column, *row = [int(abs(axis - at).argmin()) for axis, at in zip(plane.axes(), here, strict=True)]
    return (row[0] if row else 0), column
