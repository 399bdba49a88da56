"""What reports say, as tables: a row for each slice, and a row for each environment."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..landscapes.measures.gradient_quality import ScaleRow
    from ..landscapes.statistics import Estimate
    from .report_record import Report

HEADINGS = ("slice", "minima", "flat", "jumps", "cosine", "measured", "the paper's words", "measured too")
ENVIRONMENTS = (
    "environment", "slices", "minima", "flat", "jumps", "cosine, small step", "cosine, two samples", "measured",
    "the paper's words", "agree",
)  # fmt: skip
SEEN = 0.5  # of the points that any step sees, for a smaller one to be worth showing


@dataclass
class EnvironmentCounts:
    """In how many `slices` of an environment each word was measured, and each of the paper's."""

    slices: int = 0
    measured: dict[str, int] = field(default_factory=dict)
    paper: dict[str, int] = field(default_factory=dict)


def by_environment(reports: Sequence[Report]) -> dict[str, EnvironmentCounts]:
    """Count by environment in how many of its slices each word was measured, and each of the paper's."""
    found: dict[str, EnvironmentCounts] = {}
    for report in reports:
        entry = found.setdefault(report.env, EnvironmentCounts())
        entry.slices += 1
        for word in report.words:
            entry.measured[word] = entry.measured.get(word, 0) + 1
        for one in report.paper.words if report.paper else ():
            entry.paper[one.word] = entry.paper.get(one.word, 0) + one.measured
    return found


def slice_rows(reports: Sequence[Report]) -> list[tuple[str, ...]]:
    """Return a row for each slice, under `HEADINGS`."""
    return [_slice(report) for report in reports]


def slices_markdown(reports: Sequence[Report]) -> str:
    """Return a row for each slice, as Markdown."""
    return markdown(HEADINGS, slice_rows(reports))


def environments_markdown(reports: Sequence[Report]) -> str:
    """Return a row for each environment, as Markdown: the least and the most of its slices, and the words.

    The small step is the smallest that sees a slope above the noise at half as many points as any step does.
    """
    groups = groupby(reports, key=lambda report: report.env)
    return markdown(ENVIRONMENTS, (_environment(env, list(group)) for env, group in groups))


def _environment(env: str, reports: Sequence[Report]) -> tuple[str, ...]:
    from ..landscapes.measures.classify import WORDS

    words, count = by_environment(reports)[env], len(reports)
    measured = [_of(word, words.measured[word], count) for word in WORDS if word in words.measured]
    profiles = [report.profile for report in reports]
    samples = [profile.differences_of_samples[0] for profile in profiles if profile.differences_of_samples]
    return (
        f"`{env}`",
        str(count),
        _span([profile.losses.notable for profile in profiles], "{:.0f}"),
        _span([_value(profile.losses.flat, 100) for profile in profiles], "{:.0f} %"),
        _span([_value(profile.jumps.share, 100) for profile in profiles], "{:.1f} %"),
        _span([_value(_small(profile.differences).cosine) for profile in profiles], "{:z.2f}"),
        _span([_value(row.cosine) for row in samples], "{:z.2f}"),
        ", ".join(measured),
        ", ".join(_of(word, hits, count) for word, hits in words.paper.items()),
        _agreement(list(words.paper.values()), count),
    )


def _small(rows: Sequence[ScaleRow]) -> ScaleRow:
    most = max(row.points for row in rows)
    return next(row for row in rows if row.points >= SEEN * most)


def _value(estimate: Estimate | None, scale: float = 1.0) -> float | None:
    return None if estimate is None or not math.isfinite(estimate.value) else scale * estimate.value


def _span(values: Iterable[float | None], form: str) -> str:
    """Write the least and the most of what is known."""
    known = sorted(value for value in values if value is not None)
    if not known:
        return ""
    low, high = (form.format(end).replace("-", "\N{MINUS SIGN}") for end in (known[0], known[-1]))
    return high if low == high else f"{low.removesuffix(' %')} to {high}"


def _of(word: str, hits: int, count: int) -> str:
    return word if hits == count else f"{word} ({hits} of {count})"


def _agreement(hits: Sequence[int], count: int) -> str:
    """Say whether all of the paper's words were measured in all slices, none in any, or some."""
    if not hits:
        return ""
    return "yes" if min(hits) == count else "in part" if max(hits) else "no"


def _slice(report: Report) -> tuple[str, ...]:
    losses, samples = report.profile.losses, report.profile.differences_of_samples
    words = report.paper.words if report.paper else ()
    hits = sum(one.measured for one in words)
    return (
        report.name,
        str(losses.notable),
        _span([_value(losses.flat, 100)], "{:.1f} %"),
        _span([_value(report.profile.jumps.share, 100)], "{:.1f} %"),
        _span([_value(samples[0].cosine) if samples else None], "{:z.2f}"),
        ", ".join(report.words),
        ", ".join(one.word for one in words),
        f"{hits} of {len(words)}" if words else "",
    )


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [headings, ("---",) * len(headings), *rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in lines)
