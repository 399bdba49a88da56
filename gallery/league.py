"""The league of the gallery: a race of nine methods in every scene, kept small, scene by scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..envs.batching import cores
from ..jobs.league import LeagueJob, LeagueScene
from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch
from ..landscapes.convert import from_json, to_json
from ..landscapes.storage.files import make_folder
from ..landscapes.storage.records import read_json, reading, write_record
from ..optim.league import League, SceneStandings
from .files import LEAGUE, REMAKE, LeagueFiles, dark_name
from .league_runs import KeptRuns
from .parts import FigurePart
from .records import read_if_sound

if TYPE_CHECKING:
    from ..landscapes.draw.figures.page import Picture

METHODS = (
    *("random", "cma-es", "descents", "bo-descents", "bo-leap"),  # the paper's
    *("l-bfgs-b", "adam", "cma-es-gradient", "turbo"),
)
BUDGET, SEEDS = 1000, 10  # the paper's


class LeaguePart(FigurePart):
    """The race in the figure's environment, which its other figures share, with the options that it has by default.

    Its runs stay in the folder of `landscape league` on this device, under out/: either goes on with the other's.
    """

    @property
    def shared(self) -> str:
        """The environment."""
        return self.figure.env

    def label(self) -> str:
        """Return the command that runs it elsewhere."""
        how = f"--methods {','.join(METHODS)} --budget {BUDGET} --seeds {SEEDS} --device {self.device}"
        return f"landscape league {LeagueScene.of(self._own_scene, self.root)} {how}"

    def count_left(self) -> int:
        """Return 1 where no race of these methods, seeds and episodes at this fidelity is kept."""
        kept = read_if_sound(read_standings, self._files.record)
        if kept is None or read_if_sound(KeptRuns.read, self._files.runs) is None or not self._files.there():
            return 1
        known = {*kept.methods, *kept.left_out}
        whole = known >= set(METHODS) and kept.budget >= BUDGET and kept.seeds >= SEEDS
        return int(not whole or kept.fidelity != self._raced.fidelity)

    def seconds_each(self) -> float:
        """Estimate what is left of the race to simulate; what methods take themselves comes on top."""
        return self._job.forecast(self._raced, Watch())

    def make(self, watch: Watch) -> str:
        """Race, or go on with it, and keep what is needed of it."""
        race, left_out = self._job.run_race(self._raced, watch)
        found = SceneStandings.of(race, left_out=left_out, command=self.label())
        files = self._files
        make_folder(files.record.parent)
        files.record.unlink(missing_ok=True)  # which says that the others are whole
        keep_both(race.plot(), files.picture)
        KeptRuns.of(race).write(files.runs)
        write_record(files.record, to_json(found))
        return (
            f"{len(found.methods)} methods, {found.seeds} seeds, {found.budget} episodes: {found.methods[0]} is first"
        )

    @property
    def _files(self) -> LeagueFiles:
        return LeagueFiles.of(self.root, self.figure.env)

    @property
    def _raced(self) -> LeagueScene:
        return self._job.scenes[0]

    @property
    def _job(self) -> LeagueJob:
        return LeagueJob.of(
            [self._own_scene], METHODS, budget=BUDGET, seeds=SEEDS, command=self.label(), workers=cores(),
            executor=self.executor,
        )  # fmt: skip

    @property
    def _own_scene(self) -> SceneSpec:
        """The figure's scene with the options that it has by default."""
        return replace(self.scene(), options={})


def read_standings(path: Path) -> SceneStandings:
    """Read what is kept of a scene. Raises ValueError, naming the file, where it is not what was written."""
    with reading(path, REMAKE.format("league")):
        return from_json(SceneStandings, read_json(path))


def read_league(root: Path) -> League | None:
    """Return the league of the scenes that are kept in the gallery's data, None where there is none.

    Raises ValueError, naming the file, where one is not what was written.
    """
    scenes = [read_standings(path) for path in sorted((root / LEAGUE).glob("*.json"))]
    if not scenes:
        return None
    return League(scenes, {}, "landscape gallery compute --part league")


def keep_both(picture: Picture, path: Path) -> None:
    """Do what `save_both` does, in as few bytes as show no less: they go into the repository."""
    from ..landscapes.draw.film import lighten

    save_both(picture, path)
    for file in (path, path.with_name(dark_name(path.name))):
        lighten(file)


def save_both(picture: Picture, path: Path) -> None:
    """Write a picture, and the same for a dark page beside it."""
    from ..landscapes.draw.figures.dark import darken
    from ..landscapes.draw.figures.page import save

    dark = path.with_name(dark_name(path.name))
    save(picture, path)
    darken(picture)
    save(picture, dark)
