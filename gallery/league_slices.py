"""Where the searches of the league went: the median run of each method, over a slice through the best point found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from ..jobs.folder import SUMMARY
from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch
from ..landscapes.identity import MODEL_VERSION
from ..landscapes.overlay import overlay
from ..landscapes.storage.records import read_json, write_record
from ..optim.league import SceneStandings
from .figures import read_figures
from .files import PICTURE, STORE, LeagueFiles, LeagueSliceFiles
from .league import keep_both, read_standings
from .league_runs import KeptRuns
from .parts import FigurePart, seconds_of_one
from .records import read_if_sound

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.plane import Plane

RESOLUTION = 48  # points along each axis


class LeagueSlicePart(FigurePart):
    """Losses around the best point of the league in the figure's environment, and median runs over them.

    Of the runs their improvements are laid. Losses are at the league's own fidelity, along the dims of the first of the
    environment's figures, which share it. There is none where no league is kept.
    """

    @property
    def shared(self) -> str:
        """The environment."""
        return self.figure.env

    def label(self) -> str:
        """Return the command that samples the slice."""
        standings = self._standings()
        fidelity = standings.fidelity if standings else self.figure.fidelity
        dims = " ".join(map(str, self._dims))
        how = f"--resolution {RESOLUTION} --fidelity {fidelity} --through best --no-gradients --device {self.device}"
        return f"landscape slice {self.figure.env} --dims {dims} {how}"

    def count_left(self) -> int:
        """Count the episodes where there is no such slice of the best point that is kept."""
        standings = self._standings()
        if standings is None or standings.best is None:
            return 0
        record = read_if_sound(read_json, self._files.record)
        there = record is not None and record.get("key") == self._key(standings) and self._files.there()
        return 0 if there else RESOLUTION**2

    def seconds_each(self) -> float:
        """Time an episode."""
        return seconds_of_one(self.scene().make())

    def make(self, watch: Watch) -> str:
        """Sample the slice, lay the median runs over it, and draw both."""
        from ..jobs.slice import SliceJob
        from ..landscapes.draw.figures.overlay import overlay_figure
        from ..landscapes.storage.store import open_slice

        standings, files = self._standings(), self._files
        assert standings is not None  # or nothing is left to make
        env = SceneSpec(self.figure.env, standings.fidelity, device=self.device).make()
        files.record.unlink(missing_ok=True)  # which says that the others are whole
        how: dict[str, Any] = {"command": self.label(), "out": files.folder, "force": True}
        outcome = SliceJob.of(env, self._plane(env, standings), gradients=0, executor=self.executor, **how).run(watch)
        for left in (PICTURE, SUMMARY):  # the map is drawn with the runs, and its page says the rest
            (files.folder / left).unlink()
        runs = list(KeptRuns.read(LeagueFiles.of(self.root, env.name).runs).medians.values())
        dataset = open_slice(files.folder / STORE)
        keep_both(overlay_figure(dataset, overlay(dataset, runs)), files.picture)
        write_record(files.record, {"key": self._key(standings), "command": self.label(), "device": env.device})
        return outcome.outcome()

    @property
    def _files(self) -> LeagueSliceFiles:
        return LeagueSliceFiles.of(self.root, self.figure.env)

    @property
    def _dims(self) -> tuple[int, ...]:
        """Return those of the first plane that is shown of the environment, which figures may not have."""
        planes = [one.dims for one in read_figures() if one.env == self.figure.env and len(one.dims) == 2]
        return planes[0] if planes else (0, 1)

    def _plane(self, env: Environment, standings: SceneStandings) -> Plane:
        from ..landscapes.plane import Plane

        assert standings.best is not None  # or nothing is left to make
        best = torch.tensor(standings.best.x, dtype=torch.float64)
        return Plane.through(env.space, best, self._dims, resolution=RESOLUTION)

    def _key(self, standings: SceneStandings) -> dict[str, Any]:
        """Return what decides the slice and its picture."""
        assert standings.best is not None
        about = {MODEL_VERSION: standings.identity[MODEL_VERSION], "fidelity": standings.fidelity}
        about |= {"methods": list(standings.methods), "best": list(standings.best.x)}
        return about | {"dims": list(self._dims), "resolution": RESOLUTION}

    def _standings(self) -> SceneStandings | None:
        return read_if_sound(read_standings, LeagueFiles.of(self.root, self.figure.env).record)
