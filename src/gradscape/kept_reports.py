"""Reports that are on disk: read again whole or refused by name, and whose the files are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .measure_tables import by_environment, slices_markdown

REPORT, TABLE = "report.json", "report.md"


def read_report(path: Path) -> dict[str, Any]:
    """Return the report of a slice, all of which can be shown; raise ValueError, naming the file, where it cannot."""
    from .landscapes.character import named_measures
    from .landscapes.records import read_json, reading, text

    with reading(path, "delete it, and the same command measures the slice anew"):
        record = read_json(path)
        named_measures(record), slices_markdown([record]), by_environment([record])
        for said in (record["name"], record["env"], record["device"], record["key"]["code"], *verdict_lines(record)):
            text(said)
    return record


def verdict_lines(record: dict[str, Any]) -> list[str]:
    """Return the words of a report, each with its reason, and whether the paper has them, a line each."""
    verdict, paper = record["verdict"], record["paper"]
    lines = [f"{word}: {verdict['reasons'][word]}" for word in verdict["words"]]
    if paper:
        said = "; ".join(f"{one['word']}: {'yes' if one['measured'] else 'no'}" for one in paper["words"])
        lines.append(f"the paper's words ({paper['where']}), measured too? {said}")
    return lines


def check_summary(folder: Path) -> None:
    """Refuse a folder with a summary of several reports that is none of ours, as a table without one is not either."""
    path = folder / REPORT
    if not path.exists() and not (folder / TABLE).exists():
        return
    try:
        ours = {"reports", "environments"} <= json.loads(path.read_text()).keys()
    except (OSError, ValueError, AttributeError):
        ours = False
    if not ours:
        raise ValueError(
            f"{path} is not there, damaged or of something else than several slices, so that it and {TABLE} are not "
            "replaced; move both away, or give --out a new or an empty folder"
        )
