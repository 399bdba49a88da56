"""The stored data of the gallery's figures: slices, reports, and the version of the scene that made them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from gradscape.envs.registry import environment_class
from gradscape.gallery.figures import Figure, read_figures
from gradscape.gallery.files import DATA, STORE
from gradscape.gallery.league import read_league
from gradscape.gallery.paper import Paper, PaperFinding, read_paper
from gradscape.jobs.folder import REPORT
from gradscape.jobs.report import Report
from gradscape.landscapes.slice import Slice
from gradscape.landscapes.storage.paths import is_slice
from gradscape.landscapes.storage.store import open_slice
from gradscape.optim.league import League

NOT_MEASURED = "not measured yet"


class KeptFigure:
    """A figure of the gallery with its slice and its report under `root`, each None if it is missing."""

    def __init__(self, figure: Figure, root: Path = DATA) -> None:
        self.figure, self.root = figure, root
        self.folder = root / figure.id
        store = self.folder / STORE
        self.slice = Slice(open_slice(store), self.folder) if is_slice(store) else None
        self.report = Report.read(self.folder) if (self.folder / REPORT.files[0]).exists() else None

    @property
    def current(self) -> bool:
        """Whether its samples are from the present version of the scene's model."""
        known = self.slice.identity if self.slice else None
        return bool(known and known["model_version"] == environment_class(self.figure.env).version_on(known["engine"]))

    @property
    def losses(self) -> tuple[float, float] | None:
        """The lowest and the highest loss of its samples, or None without losses [loss unit]."""
        if self.slice is None or not bool(self.slice.data["loss"].notnull().any()):
            return None
        return float(self.slice.data["loss"].min()), float(self.slice.data["loss"].max())

    @property
    def axes(self) -> str:
        """The parameters that its slice varies."""
        return " and ".join(self.slice.plane.labels) if self.slice else ""

    @property
    def paper_words(self) -> tuple[str, ...]:
        """The paper's words for this slice, or else those for its scene."""
        said = read_paper().words.get(self.figure.env)
        return self.figure.caption.words or (said.words if said else ())

    @property
    def findings(self) -> tuple[PaperFinding, ...]:
        """Other measurements that concern the paper's words for this slice."""
        return read_paper().findings.get(self.figure.id, ())

    @property
    def as_the_paper(self) -> bool:
        """Whether its scene had the paper's settings, by the preset."""
        wanted = environment_class(self.figure.env).presets.get("paper")
        known = self.report.options if self.report else {}
        return wanted is not None and all(known.get(name) == value for name, value in wanted.items())

    @property
    def words(self) -> str:
        """The measured verdict as text."""
        return ", ".join(self.report.words) if self.report else NOT_MEASURED


@dataclass(frozen=True)
class Kept:
    """The data of all pages: the stored figures, the paper's statements, and the league if there is one."""

    figures: Sequence[KeptFigure]
    paper: Paper
    league: League | None
    gallery: Path | None = None

    @classmethod
    def read(cls, root: Path = DATA, *, gallery: Path | None = None) -> Kept:
        """Read a folder of the gallery's data. Raises ValueError, naming the file, for a damaged one."""
        return cls([KeptFigure(one, root) for one in read_figures()], read_paper(), read_league(root), gallery)

    @cached_property
    def by_env(self) -> Mapping[str, Sequence[KeptFigure]]:
        """The figures of each environment."""
        names = dict.fromkeys(one.figure.env for one in self.figures)
        return {env: [one for one in self.figures if one.figure.env == env] for env in names}

    def link(self, figure: Figure, up: str) -> str:
        """Return a figure's name, as a link to its page if the gallery is built; `up` leads to the root."""
        shown = self.gallery and (self.gallery / figure.id / "index.html").exists()
        return f'<a href="{up}gallery/{figure.id}/index.html">{figure.id}</a>' if shown else f"`{figure.id}`"
