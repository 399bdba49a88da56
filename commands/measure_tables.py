"""What reports say, as tables: a row for each slice, and a row for each environment."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any

from rich.table import Table

from .terminal import table

Record = dict[str, Any]
HEADINGS = ("slice", "minima", "flat", "jumps", "cosine", "measured", "the paper's words", "measured too")
ENVIRONMENTS = (
    "environment", "slices", "minima", "flat", "jumps", "cosine, small step", "cosine, two samples", "measured",
    "the paper's words", "agree",
)  # fmt: skip
SEEN = 0.5  # of the points that any step sees, for a smaller one to be worth showing


def by_environment(records: Sequence[Record]) -> dict[str, Record]:
    """Return by environment in how many of its slices each word was measured, and each of the paper's."""
    found: dict[str, Record] = {}
    for record in records:
        entry = found.setdefault(record["env"], {"slices": 0, "measured": {}, "paper": {}})
        entry["slices"] += 1
        for word in record["verdict"]["words"]:
            entry["measured"][word] = entry["measured"].get(word, 0) + 1
        for one in (record["paper"] or {"words": []})["words"]:
            entry["paper"][one["word"]] = entry["paper"].get(one["word"], 0) + one["measured"]
    return found


def slices_table(records: Sequence[Record]) -> Table:
    """Return a row for each slice, for a terminal."""
    found = table(*HEADINGS, title="what landscapes are like")
    for record in records:
        found.add_row(*_row(record))
    return found


def slices_markdown(records: Sequence[Record]) -> str:
    """Return a row for each slice, as Markdown."""
    return _markdown(HEADINGS, map(_row, records))


def environments_table(records: Sequence[Record]) -> str:
    """Return a row for each environment, as Markdown: the least and the most of its slices, and the words.

    The small step is the smallest that sees a slope above the noise at half as many points as any step does.
    """
    groups = groupby(records, key=lambda record: str(record["env"]))
    return _markdown(ENVIRONMENTS, (_environment(env, list(group)) for env, group in groups))


def _environment(env: str, records: Sequence[Record]) -> tuple[str, ...]:
    from ..landscapes.measures.classify import WORDS

    words, count = by_environment(records)[env], len(records)
    measured = [_of(word, words["measured"][word], count) for word in WORDS if word in words["measured"]]
    samples = [(record["differences_of_samples"] or [None])[0] for record in records]
    return (
        f"`{env}`",
        str(count),
        _span([record["losses"]["notable"] for record in records], "{:.0f}"),
        _span([_value(record["losses"]["flat"], 100) for record in records], "{:.0f} %"),
        _span([_value(record["jumps"]["share"], 100) for record in records], "{:.1f} %"),
        _span([_value(_small(record["differences"])["cosine"]) for record in records], "{:z.2f}"),
        _span([_value(row["cosine"]) for row in samples if row], "{:z.2f}"),
        ", ".join(measured),
        ", ".join(_of(word, hits, count) for word, hits in words["paper"].items()),
        _agreement(list(words["paper"].values()), count),
    )


def _small(rows: Sequence[Record]) -> Record:
    most = max(row["points"] for row in rows)
    return next(row for row in rows if row["points"] >= SEEN * most)


def _value(estimate: Record | None, scale: float = 1.0) -> float | None:
    return None if estimate is None or estimate["value"] is None else scale * float(estimate["value"])


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


def _row(record: Record) -> tuple[str, ...]:
    losses = record["losses"]
    near = (record["differences_of_samples"] or [{"cosine": None}])[0]["cosine"]
    words = (record["paper"] or {"words": []})["words"]
    hits = sum(one["measured"] for one in words)
    return (
        record["name"],
        str(losses["notable"]),
        _span([_value(losses["flat"], 100)], "{:.1f} %"),
        _span([_value(record["jumps"]["share"], 100)], "{:.1f} %"),
        _span([_value(near)], "{:z.2f}"),
        ", ".join(record["verdict"]["words"]),
        ", ".join(one["word"] for one in words),
        f"{hits} of {len(words)}" if words else "",
    )


def _markdown(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [headings, ("---",) * len(headings), *rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in lines)
