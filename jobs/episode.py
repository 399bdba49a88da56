"""An episode to simulate, to draw and to film into a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import __version__
from ..landscapes.convert import to_json
from ..landscapes.objective import Status, failed, has_loss
from ..landscapes.storage.files import tidy, write_json
from .folder import EPISODE, folder_named
from .job import Job
from .scene import named_point, provenance
from .watch import Watch, Work

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Environment, Episode
    from ..landscapes.draw.figures.contact import Caption

SHEET, FILM, LOOP, STREAM, RECORD = EPISODE.files
SMALL_LOSS = 28  # of a small film: x264's constant rate factor


@dataclass(frozen=True)
class EpisodeRecord:
    """Record the drawn episode and its origin, as in `episode.json`; `loss` is None if the episode failed."""

    identity: dict[str, Any]
    provenance: dict[str, Any]
    parameters: dict[str, float]
    loss: float | None
    status: str


@dataclass(frozen=True)
class EpisodeSummary:
    """Record the drawn episode, its outcome, and the files."""

    title: str
    outcome: str
    record: EpisodeRecord
    files: list[str]


@dataclass(frozen=True, eq=False, kw_only=True)
class EpisodeJob(Job[EpisodeSummary]):
    """An episode of `env` at `x` to draw; `source` says where its parameters are from."""

    results = EPISODE
    env: Environment
    x: Float[Tensor, " dim"]
    source: str
    film: bool = True

    @classmethod
    def of(
        cls,
        env: Environment,
        params: str | Float[Tensor, " dim"],
        *,
        command: str,
        out: Path | None = None,
        film: bool = True,
        prints: Sequence[float] = (),
    ) -> EpisodeJob:
        """Read which episode `params` names; results go to `out`, by default to a folder named after the episode.

        Raises ValueError where there is no such point, and where `out` holds something else.
        """
        x = named_point(env, params) if isinstance(params, str) else params
        folder = out or folder_named(["replay", env.name], [env.identity(), x.tolist()])
        EPISODE.check(folder)
        return cls(
            env=env, x=x, source=params if isinstance(params, str) else "a point", folder=folder, command=command,
            film=film, prints=prints,
        )  # fmt: skip

    def work(self) -> list[Work]:
        """Return the episode, simulated once to draw it and once for its loss."""
        return [Work(self.env, 2)]

    def compute(self, watch: Watch) -> EpisodeSummary:
        """Simulate the episode, draw it and return what came out.

        Raises ValueError where the environment has no episodes to draw.
        """
        with watch.busy(f"{self.env.name}: simulating (kernels are compiled once, then cached)"):
            episode = self.env.episode(self.x)
            result = self.env.evaluate(self.x[None], grad=False)
        loss, status = float(result.loss[0]), Status(int(result.status[0]))
        caption = self._caption(loss, status)
        watch.note(f"{caption.title}: {len(episode.time)} frames to draw{' and film' if self.film else ''}")
        with watch.busy(f"{self.env.name}: drawing"):
            files = self._draw_episode(episode, caption)
        return EpisodeSummary(caption.title, caption.outcome, self._describe(loss, status), [*files, RECORD])

    def write(self, found: EpisodeSummary) -> list[str]:
        """Write the record."""
        write_json(self.folder / RECORD, to_json(found.record))
        tidy(self.folder)
        return found.files

    def outcome(self, found: EpisodeSummary) -> str:
        """Say in a line what came out."""
        return f"{found.title} · {self.env.device} · {found.outcome}"

    def _draw_episode(self, episode: Episode, caption: Caption) -> list[str]:
        """Draw key frames, a recording and perhaps films; return the names of the files."""
        from ..landscapes.draw.figures.contact import episode_figure, save_sheet
        from ..landscapes.draw.figures.page import save_prints
        from ..landscapes.draw.recordings.episode import save_episode
        from ..landscapes.draw.render.replay import save_replay

        folder, said = self.folder, f"{caption.title} · {caption.outcome}"
        save_sheet(episode, folder / SHEET, caption=caption)
        save_episode(episode, folder / STREAM, title=said)
        if self.film:
            save_replay(episode, folder / FILM, folder / LOOP, title=said)
        draw = partial(episode_figure, episode, caption=caption)
        printed = save_prints(lambda width: draw(width=width), folder / SHEET, self.prints)
        return [SHEET, STREAM, *([FILM, LOOP] if self.film else []), *printed]

    def _caption(self, loss: float, status: Status) -> Caption:
        """Say what the episode is."""
        from ..landscapes.draw.figures.contact import Caption
        from ..landscapes.draw.style import FAILURES, number

        env = self.env
        outcome = f"no loss: {FAILURES[status]}" if failed(status) else f"loss {number(loss)} {env.loss_unit}".rstrip()
        values = {
            name: f"{number(value)} {unit}".rstrip()
            for name, value, unit in zip(env.space.names, self._values(), env.space.units, strict=True)
        }
        about = provenance(env, self.command)
        said = [f"gradscape {__version__}", env.device, str(about["created"]), str(about["command"])]
        return Caption(f"{env.name} · {env.fidelity.name}", outcome, self.source, values, RECORD, " · ".join(said))

    def _values(self) -> list[float]:
        """Return the parameters' values."""
        values: list[float] = self.env.space.to_values(self.x).tolist()
        return values

    def _describe(self, loss: float, status: Status) -> EpisodeRecord:
        return EpisodeRecord(
            identity=self.env.identity(),
            provenance=provenance(self.env, self.command),
            parameters=dict(zip(self.env.space.names, self._values(), strict=True)),
            loss=loss if has_loss(status) else None,
            status=status.name,
        )


def film_episode(episode: Episode, stem: Path, *, height: int, frames: int) -> tuple[Path, Path]:
    """Write a small film of an episode and a picture of its end, `stem` with .mp4 and .webp; return their paths.

    `height` is that of both [pixels], and the film has so many `frames` at most.
    """
    from ..landscapes.draw.film import save_film, save_still
    from ..landscapes.draw.render import replay

    count = min(frames, len(episode.time))
    shown = np.linspace(0, len(episode.time) - 1, count).round().astype(int).tolist()
    pictures = list(replay.frames(episode, shown, height=height))
    film, still = (stem.with_name(f"{stem.name}.{kind}") for kind in ("mp4", "webp"))
    save_still(pictures[-1], still)
    save_film(pictures, film, None, count=count, rate=replay.RATE, loss=SMALL_LOSS)
    return film, still
