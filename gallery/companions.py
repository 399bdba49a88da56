"""The same cut elsewhere: a figure's dimensions through the centre and through an example, beside the figure's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..envs.registry import environment_class
from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch
from ..landscapes.objective import Evaluation, evaluate
from ..landscapes.plain import number, optional, text
from ..landscapes.storage.records import read_json, reading, write_record
from .figures import Figure
from .files import COMPANION_PICTURE, COMPANIONS, REMAKE, STORE
from .parts import FigurePart, seconds_of_one
from .records import read_if_sound

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.plane import Plane

RESOLUTION = 24  # points along each axis of a plane; a line has the figure's own


@dataclass(frozen=True)
class Companion:
    """A slice beside a figure's: the point it goes through, the ends of its losses, the share of episodes that failed.

    The ends are None where all failed.
    """

    through: str
    lowest: float | None
    highest: float | None
    failed: float

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Companion:
        """Read it. Raises ValueError, TypeError or LookupError where it is not of this form."""
        low, high = (optional(number, record[name]) for name in ("lowest", "highest"))
        return cls(text(record["through"]), low, high, number(record["failed"]))


def read_companions(folder: Path) -> list[Companion]:
    """Return the slices beside a figure's, none where none are made."""
    path = folder / COMPANIONS
    if not path.exists() or not (folder / COMPANION_PICTURE).exists():
        return []
    with reading(path, REMAKE.format("companions")):
        return [Companion.of_record(one) for one in read_json(path)["slices"]]


def points_beside(figure: Figure) -> list[str]:
    """Return the points that a figure's dimensions are also cut through: the centre and the scene's first example.

    A figure that varies all parameters has the same slice everywhere, so there are none.
    """
    kind = environment_class(figure.env)
    space = getattr(kind, "space", None) or SceneSpec(figure.env, device="cpu", options=figure.options).make().space
    if space.dim == len(figure.dims):
        return []
    examples = [f"example:{name}" for name in kind.examples][:1]
    return [name for name in ("center", *examples) if name != figure.through]


class CompanionPart(FigurePart):
    """The losses of the same cut through other points, at the figure's fidelity, and a picture on one scale."""

    def label(self) -> str:
        """Say what is sampled."""
        return f"the same dims through {' and '.join(points_beside(self.figure))}, losses"

    def count_left(self) -> int:
        """Count the episodes where there are no such slices of these settings, of this slice."""
        names = points_beside(self.figure)
        if not names or self._key() is None:
            return 0
        record = read_if_sound(read_json, self.folder / COMPANIONS)
        there = record is not None and record.get("key") == self._key() and (self.folder / COMPANION_PICTURE).exists()
        return 0 if there else len(names) * self._resolution ** len(self.figure.dims)

    def seconds_each(self) -> float:
        """Time an episode."""
        return seconds_of_one(self.scene().make())

    def make(self, watch: Watch) -> str:
        """Sample them, draw them beside the slice, and keep what they are."""
        from ..landscapes.draw.figures.multiples import CompanionSlice, companions_figure
        from ..landscapes.draw.figures.page import save
        from ..landscapes.draw.film import lighten
        from ..landscapes.storage.store import open_slice

        dataset, env = open_slice(self.folder / STORE), self.scene().make()
        names, cuts = points_beside(self.figure), [CompanionSlice(self.figure.through, dataset["loss"].to_numpy())]
        found = list[Companion]()
        with watch.progress(self.count_left(), "episodes") as advance:
            for name in names:
                loss = sample(env, replace(self.figure, through=name).plane(env, self._resolution))
                cuts.append(CompanionSlice(name, loss))
                found.append(_companion(name, loss))
                advance(len(found) * loss.size, "")
        save(companions_figure(cuts, dataset), self.folder / COMPANION_PICTURE)
        lighten(self.folder / COMPANION_PICTURE)
        known = {"key": self._key(), "device": env.device, "slices": [asdict(one) for one in found]}
        write_record(self.folder / COMPANIONS, known)
        return "; ".join(f"through {one.through}: {_say(one)}" for one in found)

    @property
    def _resolution(self) -> int:
        return RESOLUTION if len(self.figure.dims) == 2 else self.figure.resolution

    def _key(self) -> dict[str, Any] | None:
        """Return what decides these slices and their picture; None where the figure has no slice yet."""
        from ..jobs.report import digest_of
        from ..landscapes.storage.paths import is_slice
        from ..landscapes.storage.store import open_slice

        store = self.folder / STORE
        if not is_slice(store):
            return None
        settings = {"fidelity": self.figure.fidelity, "resolution": self._resolution}
        return {"slice": digest_of(open_slice(store)), **settings, "through": points_beside(self.figure)}


def sample(env: Environment, plane: Plane) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return the losses on a plane or a line, indexed (v, u) or (u), NaN where an episode failed."""
    grid = plane.grid()
    batches = torch.split(grid.reshape(-1, plane.dim), env.preferred_batch)
    found = Evaluation.join((evaluate(env, x, grad=False) for x in batches), dim=plane.dim, grad=False)
    return found.loss.reshape(grid.shape[:-1]).to(torch.float32).numpy()


def _companion(name: str, loss: np.ndarray[Any, Any]) -> Companion:
    finite = loss[np.isfinite(loss)]
    if not finite.size:
        return Companion(name, None, None, 1.0)
    return Companion(name, float(finite.min()), float(finite.max()), 1 - finite.size / loss.size)


def _say(one: Companion) -> str:
    return "all failed" if one.lowest is None else f"losses from {one.lowest:.4g} to {one.highest:.4g}"
