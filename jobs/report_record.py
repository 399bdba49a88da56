"""The report of a slice, as `report.json` has it: what was measured, what that comes to, and what the paper says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from ..landscapes.convert import NOT_JSON, from_json
from ..landscapes.measures.classify import QuotedWord
from ..landscapes.measures.doubled_resolution import DoubledResolution
from ..landscapes.measures.profile import Profile
from ..landscapes.storage.records import read_json, reading
from .folder import REPORT
from .report_tables import EnvironmentCounts, by_environment

if TYPE_CHECKING:
    import pandas as pd

    from ..landscapes.draw.figure import Picture

RECORD, MEASURES, PICTURE, ARRAYS = REPORT.files  # the arrays are what the picture is drawn from, but for the slice


class Quoted(Protocol):
    """What the paper says of an environment's landscape: words of `classify.WORDS`, and where it says them."""

    @property
    def words(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def where(self) -> str: ...  # noqa: D102


@dataclass(frozen=True)
class PaperWords:
    """The paper's words for a landscape, and where it says them."""

    words: tuple[QuotedWord, ...]
    where: str


@dataclass(frozen=True)
class ReportKey:
    """What decides a report: its settings, the digest of the slice, and the version of the scene's model."""

    points: int
    seed: int
    slice: str
    model_version: int


@dataclass(frozen=True)
class Report:
    """Hold what was measured of a slice, as `report.json` has it.

    `paper` has the words that the paper has for the scene, None where it has none, and `seconds` is what the measuring
    took. `folder` is where its files are, and `store` the slice's.
    """

    name: str
    env: str
    options: dict[str, Any]
    fidelity: str
    device: str
    profile: Profile
    paper: PaperWords | None
    seconds: float
    command: str
    key: ReportKey
    folder: Path | None = field(default=None, metadata=NOT_JSON, compare=False, repr=False)
    store: Path | None = field(default=None, metadata=NOT_JSON, compare=False, repr=False)

    @classmethod
    def read(cls, path: Path) -> Report:
        """Read `report.json`, or that of a folder.

        Raises DamagedError, which names the file and says what to do, where not all of it can be shown, and
        FileNotFoundError.
        """
        path = path / RECORD if path.is_dir() else path
        with reading(path, "delete it, and the same command measures the slice anew"):
            return replace(from_json(cls, read_json(path)), folder=path.parent)

    @property
    def words(self) -> tuple[str, ...]:
        """The words for the landscape."""
        return self.profile.words

    @property
    def measures(self) -> dict[str, str]:
        """The chief numbers by short names, with 95 % intervals, as a page shows them."""
        return self.profile.measures

    def verdict_lines(self) -> list[str]:
        """Return the words, each with its reason, and whether the paper has them, a line each."""
        lines = [f"{word}: {self.profile.verdict.reasons[word]}" for word in self.words]
        if self.profile.doubled:
            lines.append(_describe_changes(self.profile.doubled))
        if self.paper:
            said = "; ".join(f"{one.word}: {'yes' if one.measured else 'no'}" for one in self.paper.words)
            lines.append(f"the paper's words ({self.paper.where}), measured too? {said}")
        return lines

    def table(self) -> pd.DataFrame:
        """Return the chief numbers, a row each, indexed by `measure`, with the column `value` as text."""
        import pandas as pd

        return pd.DataFrame({"value": self.measures}).rename_axis("measure")

    def plot(self, width: float | None = None) -> Picture:
        """Draw gradient quality over the slice, for a screen, or for a page so wide [mm].

        Raises ValueError where its files do not hold what it is drawn from.
        """
        return self.picture()(width=width)

    def picture(self) -> Callable[..., Picture]:
        """Read what it is drawn from, and return what draws it, for any width. Raises ValueError as `plot` does."""
        import numpy as np

        from ..landscapes.draw.figures.quality import quality_figure
        from ..landscapes.lattice import sampled_lattice
        from ..landscapes.measures.gradient_quality import GradientQuality, compare_samples
        from ..landscapes.storage.bundle import open_bundle
        from ..landscapes.storage.store import open_slice

        if self.folder is None or self.store is None or not (self.folder / ARRAYS).exists():
            raise ValueError(
                f"{self.folder} is a report from before {ARRAYS} was kept to draw from; delete it to measure it anew"
            )
        dataset, kept = sampled_lattice(open_slice(self.store)), open_bundle(self.folder / ARRAYS)
        samples = compare_samples(dataset, deviation=float(np.nan_to_num(kept["noise"]["deviation"])))
        return partial(quality_figure, dataset, GradientQuality(kept["steps"], samples, kept["smooth"]))

    def _repr_html_(self) -> str:
        """Show words and numbers in a notebook."""
        from html import escape

        lines = "".join(f"<li>{escape(line)}</li>" for line in self.verdict_lines())
        return f"<p>{escape(self.name)} ({escape(self.env)})</p><ul>{lines}</ul>{self.table().to_html()}"


def _describe_changes(doubled: DoubledResolution) -> str:
    """Say which words would change at twice the resolution."""
    said = [f"{word} would appear" for word in doubled.appear] + [f"{word} would go" for word in doubled.go]
    return f"at twice the resolution: {', '.join(said) or 'the verdict is the same'}"


@dataclass(frozen=True)
class Reports:
    """Hold the reports of several slices, in their order, and by name what was wrong with those that failed."""

    derived: ClassVar = ("environments",)

    reports: tuple[Report, ...]
    failed: dict[str, str]

    @property
    def environments(self) -> dict[str, EnvironmentCounts]:
        """What the slices of each environment have in common."""
        return by_environment(self.reports)
