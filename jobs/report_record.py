"""The report of a slice, as `report.json` has it: what was measured, what that comes to, and what the paper says."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, Protocol, TypedDict, cast

from ..landscapes.identity import current_identity
from ..landscapes.measures.records import ProfileRecord, WordRecord
from ..landscapes.plain import number, text
from ..landscapes.storage.records import read_json, reading
from .folder import REPORT
from .report_tables import EnvironmentRecord, by_environment, slices_markdown

if TYPE_CHECKING:
    import pandas as pd

    from ..landscapes.draw.figures.page import Picture

RECORD, MEASURES, PICTURE, ARRAYS = REPORT.files  # the arrays are what the picture is drawn from, but for the slice


class Quoted(Protocol):
    """What the paper says of an environment's landscape: words of `classify.WORDS`, and where it says them."""

    @property
    def words(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def where(self) -> str: ...  # noqa: D102


class PaperRecord(TypedDict):
    """The paper's words for a landscape, and where it says them."""

    words: list[WordRecord]
    where: str


class ReportKey(TypedDict):
    """What decides a report: its settings, the digest of the slice, and the version of the scene's model."""

    points: int
    seed: int
    slice: str
    model_version: int
    device: NotRequired[str]  # of early versions


@dataclass(frozen=True)
class Report:
    """Hold what was measured of a slice, as `report.json` has it.

    `profile` is what `Profile.record` returns, `paper` the words that the paper has for the scene, None where it has
    none, and `seconds` what the measuring took. `folder` is where its files are, and `store` the slice's.
    """

    name: str
    env: str
    options: dict[str, Any]
    fidelity: str
    device: str
    profile: ProfileRecord
    paper: PaperRecord | None
    seconds: float
    command: str
    key: ReportKey
    folder: Path | None = field(default=None, compare=False, repr=False)
    store: Path | None = field(default=None, compare=False, repr=False)

    @classmethod
    def read(cls, path: Path) -> Report:
        """Read `report.json`, or that of a folder.

        Raises DamagedError, which names the file and says what to do, where not all of it can be shown, and
        FileNotFoundError.
        """
        path = path / RECORD if path.is_dir() else path
        with reading(path, "delete it, and the same command measures the slice anew"):
            report = replace(cls.of_record(read_json(path)), folder=path.parent)
            report.measures, slices_markdown([report]), by_environment([report])
            number(report.key["model_version"])
            own = report.name, report.env, report.device, report.profile.get("errors", "")
            for said in (*own, *report.verdict_lines()):
                text(said)
        return report

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Report:
        """Take a report from plain JSON, by the keys of the file; raises KeyError where one is missing."""
        own = [name for name in cls.__dataclass_fields__ if name not in ("profile", "key", "folder", "store")]
        profile = {name: record[name] for name in ProfileRecord.__annotations__ if name in record}
        key = cast("ReportKey", current_identity(record["key"]))
        return cls(**{name: record[name] for name in own}, profile=cast("ProfileRecord", profile), key=key)

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON, by the keys of the file."""
        return {
            "name": self.name,
            "env": self.env,
            "options": self.options,
            "fidelity": self.fidelity,
            "device": self.device,
            **self.profile,
            "paper": self.paper,
            "seconds": self.seconds,
            "command": self.command,
            "key": self.key,
        }

    @property
    def words(self) -> tuple[str, ...]:
        """The words for the landscape."""
        return tuple(self.profile["verdict"]["words"])

    @property
    def measures(self) -> dict[str, str]:
        """The chief numbers by short names, with 95 % intervals, as a page shows them."""
        from ..landscapes.measures.profile import named_measures

        return named_measures(self.profile)

    def verdict_lines(self) -> list[str]:
        """Return the words, each with its reason, and whether the paper has them, a line each."""
        verdict = self.profile["verdict"]
        lines = [f"{word}: {verdict['reasons'][word]}" for word in verdict["words"]]
        if finer := self.profile.get("at_twice"):
            lines.append(_say_changes(finer["appear"], finer["go"]))
        if self.paper:
            said = "; ".join(f"{one['word']}: {'yes' if one['measured'] else 'no'}" for one in self.paper["words"])
            lines.append(f"the paper's words ({self.paper['where']}), measured too? {said}")
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
        from ..landscapes.measures.gradient_quality import compare_samples
        from ..landscapes.storage.bundle import open_bundle
        from ..landscapes.storage.store import open_slice

        if self.folder is None or self.store is None or not (self.folder / ARRAYS).exists():
            raise ValueError(
                f"{self.folder} is a report from before {ARRAYS} was kept to draw from; delete it to measure it anew"
            )
        dataset, kept = sampled_lattice(open_slice(self.store)), open_bundle(self.folder / ARRAYS)
        samples = compare_samples(dataset, deviation=float(np.nan_to_num(kept["noise"]["deviation"])))
        return partial(quality_figure, dataset, kept["steps"], samples, kept["smooth"])

    def _repr_html_(self) -> str:
        """Show words and numbers in a notebook."""
        from html import escape

        lines = "".join(f"<li>{escape(line)}</li>" for line in self.verdict_lines())
        return f"<p>{escape(self.name)} ({escape(self.env)})</p><ul>{lines}</ul>{self.table().to_html()}"


def _say_changes(appear: Sequence[str], go: Sequence[str]) -> str:
    """Say which words would change at twice the resolution."""
    said = [f"{word} would appear" for word in appear] + [f"{word} would go" for word in go]
    return f"at twice the resolution: {', '.join(said) or 'no word is seen to change'}"


@dataclass(frozen=True)
class Reports:
    """Hold the reports of several slices, in their order, and by name what was wrong with those that failed."""

    reports: tuple[Report, ...]
    failed: dict[str, str]

    def record(self) -> dict[str, Any]:
        """Return them as plain JSON, with what the environments have in common."""
        environments: dict[str, EnvironmentRecord] = by_environment(self.reports)
        reports = [report.record() for report in self.reports]
        return {"reports": reports, "environments": environments, "failed": self.failed}
