"""The league of the gallery: a race of nine methods in every scene, kept small, scene by scene."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..jobs.folder import RACE
from ..jobs.league import Fixture, LeagueJob
from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch
from ..landscapes.storage.files import make_folder
from ..landscapes.storage.records import read_json, reading, write_record
from ..optim.league import League, SceneStandings
from .files import LEAGUE, LEAGUE_PICTURE, LEAGUE_RECORD, REMAKE, LeagueFiles
from .league_runs import KeptRuns
from .parts import FigurePart
from .records import read_if_sound

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
        return f"landscape league {self._fixture} {how}"

    def count_left(self) -> int:
        """Return 1 where no race of these methods, seeds and episodes at this fidelity is kept."""
        kept = read_if_sound(read_standings, self._files.record)
        if kept is None or read_if_sound(KeptRuns.read, self._files.runs) is None or not self._files.picture.is_file():
            return 1
        known = {*kept.methods, *kept.left_out}
        whole = known >= set(METHODS) and kept.budget >= BUDGET and kept.seeds >= SEEDS
        return int(not whole or kept.fidelity != self._fixture.fidelity)

    def seconds_each(self) -> float:
        """Estimate what is left of the race to simulate; what methods take themselves comes on top."""
        return self._job.forecast(self._fixture, Watch())

    def make(self, watch: Watch) -> str:
        """Race, or go on with it, keep what is needed of it, and write the league of all scenes that are kept."""
        from ..landscapes.draw.film import lighten

        race, left_out = self._job.run_race(self._fixture, watch)
        found = SceneStandings.of(race, left_out=left_out, command=self.label())
        files = self._files
        make_folder(files.record.parent)
        files.record.unlink(missing_ok=True)  # which says that the others are whole
        shutil.copyfile(self._fixture.folder / RACE.picture, files.picture)
        lighten(files.picture)
        KeptRuns.of(race).write(files.runs)
        write_record(files.record, found.record())
        write_league(self.root)
        return (
            f"{len(found.methods)} methods, {found.seeds} seeds, {found.budget} episodes: {found.methods[0]} is first"
        )

    @property
    def _files(self) -> LeagueFiles:
        return LeagueFiles.of(self.root, self.figure.env)

    @property
    def _fixture(self) -> Fixture:
        return self._job.fixtures[0]

    @property
    def _job(self) -> LeagueJob:
        scene = SceneSpec(self.figure.env, self._scene().fidelity, device=self.device)
        return LeagueJob.of(
            [scene], METHODS, budget=BUDGET, seeds=SEEDS, command=f"landscape league --device {self.device}",
            workers=_cores(), executor=self.executor,
        )  # fmt: skip


def read_standings(path: Path) -> SceneStandings:
    """Read what is kept of a scene. Raises ValueError, naming the file, where it is not what was written."""
    with reading(path, REMAKE.format("league")):
        return SceneStandings.of_record(read_json(path))


def read_league(root: Path) -> League | None:
    """Return the league of the scenes that are kept in the gallery's data, None where there is none.

    Raises ValueError, naming the file, where one is not what was written.
    """
    folder = root / LEAGUE
    scenes = [read_standings(path) for path in sorted(folder.glob("*.json")) if path.name != LEAGUE_RECORD]
    if not scenes:
        return None
    return League(scenes, {}, "landscape gallery compute --part league")


def write_league(root: Path) -> None:
    """Write and draw the league of the scenes that are kept."""
    from ..landscapes.draw.figures.page import save
    from ..landscapes.draw.film import lighten

    league = read_league(root)
    if league is not None:
        write_record(root / LEAGUE / LEAGUE_RECORD, league.record())
        save(league.plot(), root / LEAGUE / LEAGUE_PICTURE)
        lighten(root / LEAGUE / LEAGUE_PICTURE)


def _cores() -> int:
    from ..envs.engines.runtime import cores

    return cores()
