"""The files of the gallery: its figures, the paper's statements, and all computed data. Only this module names them.

In the data, a figure's folder contains `slice.zarr.zip`, `sweep.mp4` with `sweep.json`, `episodes.json` with a film and
a picture of each episode, `companions.json` and `companions.png` of the same parameters through other points, and the
files of `landscape report`. Figures share the searches in `runs/ENVIRONMENT-OPTIONS/`, the studies in `studies/`, the
censuses in `census/`, and the races of the league in `league/`. The report card of gradients is in `card/`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ..jobs.folder import CARD as CARD_FILES
from ..jobs.folder import LEAGUE as LEAGUE_FILES
from ..jobs.folder import REPORT as REPORT_FILES
from ..jobs.folder import SLICE as SLICE_FILES
from ..studies.kept import file_name
from ..studies.own_folder import STUDIES as STUDIES

HERE = Path(__file__).parent
FIGURES, PAPER = HERE / "figures.toml", HERE / "paper.toml"
DATA = HERE / "data"  # of a checkout; what is installed from a wheel has studies there and no figures
ELSEWHERE = Path("out") / "gallery-data"

STORE, PICTURE = SLICE_FILES.store, SLICE_FILES.picture
SWEEP_FILM, SWEEP_RECORD = "sweep.mp4", "sweep.json"
EPISODES = "episodes.json"
EPISODE_KINDS = ("mp4", "webp")  # a film, and its last frame
REPORT, MEASURES, QUALITY, QUALITY_ARRAYS = REPORT_FILES.files[:4]
COMPANIONS, COMPANION_PICTURE = "companions.json", "companions.png"
SURFACES = ("surface.png", "surface.html", "surface.gltf", "surface.glb")
RUNS, RUN_SUFFIX = "runs", ".zarr.zip"
CARD = "card"  # the folder of the report card of gradients
CARD_RECORD = CARD_FILES.files[0]
LEAGUE = "league"  # the folder of the league
LEAGUE_RECORD, LEAGUE_PICTURE = LEAGUE_FILES.files
CENSUSES = "census"  # the folder of what many slices of an environment are like
WALL_PICTURE, WALL_TABLE = "wall.png", "wall.csv"  # of a slice of every environment, in a site
THUMBNAIL = "thumbnail.png"  # of a slice, in a site
COMPANION_TABLE, QUALITY_TABLE = "companions.csv", "gradient-quality.csv"  # of those pictures, in a site
CSV, ZARR = "slice.csv", "slice.zarr.zip"  # a slice's data in a site
DEVICES = ("cuda", "cpu")  # that studies are shown of
REMAKE = "delete it, and `landscape gallery compute --part {}` makes it again"

_EPISODE = re.compile(r"episode-\d+-\d+\.(?:mp4|webp)")


def data_folder(named: str | Path | None) -> Path:
    """Return the folder of the data: as named, else the checkout's own, else one under the working directory."""
    if named:
        return Path(named)
    return DATA if any(DATA.glob(f"*/{STORE}*")) else ELSEWHERE


def dark_name(picture: str) -> str:
    """Return the name of a picture's variant for dark pages."""
    return picture.removesuffix(".png") + "-dark.png"


def episode_name(row: int, column: int) -> str:
    """Return the file name of an episode at a node, without its ending."""
    return f"episode-{row}-{column}"


def is_of_episode(file: Path) -> bool:
    """Say whether a file is the film or the picture of an episode."""
    return bool(_EPISODE.fullmatch(file.name))


@dataclass(frozen=True)
class RecordFiles:
    """A record, and the files of the same name next to it."""

    record: Path

    @property
    def picture(self) -> Path:
        """The picture of the record."""
        return self.record.with_suffix(".png")

    @property
    def dark(self) -> Path:
        """The same picture for dark pages."""
        return self.picture.with_name(dark_name(self.picture.name))

    @property
    def table(self) -> Path:
        """The record as a table, which only the site has."""
        return self.record.with_suffix(".csv")

    def there(self) -> bool:
        """Say whether both record and picture exist."""
        return self.record.is_file() and self.picture.is_file()

    @classmethod
    def of_census(cls, root: Path, env: str, device: str) -> RecordFiles:
        """Return the files of an environment's census on a device, in the gallery's data or in its site."""
        return cls(root / CENSUSES / f"{env}-{device}.json")


class StudyFiles(RecordFiles):
    """The files of a study."""

    @classmethod
    def of(cls, root: Path, env: str, device: str, kind: str) -> StudyFiles:
        """Return the files of an environment's study on a device, in the gallery's data or in its site."""
        return cls(root / STUDIES / file_name(env, device, kind))


class LeagueFiles(RecordFiles):
    """The files of an environment's race in the league."""

    @classmethod
    def of(cls, root: Path, env: str) -> LeagueFiles:
        """Return the files of the race in an environment, in the gallery's data or in its site."""
        return cls(root / LEAGUE / f"{env}.json")

    @property
    def runs(self) -> Path:
        """The reduced runs of the race."""
        return self.record.with_suffix(".npz")

    @property
    def slice(self) -> RecordFiles:
        """The files of the slice through the best point of the race."""
        return RecordFiles(self.record.with_suffix("") / "medians.json")
