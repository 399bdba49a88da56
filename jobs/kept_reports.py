"""Reports that are on disk: read again whole or refused by name, and whose the files are."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..commands.measure_tables import by_environment, slices_markdown
from ..landscapes.storage.files import make_folder, replacing
from ..landscapes.storage.records import read_json, reading, text, write_record

if TYPE_CHECKING:
    from ..commands.terminal import Console

REPORT, TABLE, MEASURES = "report.json", "report.md", "measures.json"
PICTURE = "gradient-quality.png"
ARRAYS = "gradient-quality.npz"  # what the picture is drawn from, but for the slice


def read_report(path: Path) -> dict[str, Any]:
    """Return the report of a slice, all of which can be shown; raise ValueError, naming the file, where it cannot."""
    from ..landscapes.measures.profile import named_measures

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


def fetch(console: Console, source: Path, folder: Path, key: dict[str, Any]) -> None:
    """Copy the same report from beside its slice, where the gallery has it, rather than measure again."""
    files = [source / name for name in (PICTURE, MEASURES, REPORT)]
    if (folder / REPORT).exists() or not all(file.exists() for file in files):
        return
    if _same(read_report(source / REPORT), key):
        make_folder(folder)
        for file in [*files, *source.glob(ARRAYS)]:
            with replacing(folder / file.name) as partial:
                shutil.copyfile(file, partial)
        console.print(f"{folder} is copied from {source}", markup=False)


def _same(record: dict[str, Any], key: dict[str, Any]) -> bool:
    """Say whether a report is of the slice and the settings; its code may be an older one, which is said."""
    return all(record["key"].get(name) == key[name] for name in key if name != "code")


def kept_report(console: Console, folder: Path, key: dict[str, Any], device: str) -> dict[str, Any]:
    """Return the report that is there, on whatever device it was measured."""
    kept = read_report(folder / REPORT)
    if not _same(kept, key):
        theirs = kept["key"]
        said = ", ".join(
            f"{name} {theirs.get(name)} there, {key[name]} here" for name in key if theirs.get(name) != key[name]
        )
        raise ValueError(f"{folder} holds another report ({said}); write elsewhere with --out, or delete it")
    leave_measures(folder, kept)
    elsewhere = f", measured on {kept['device']}" if kept["device"] != device else ""
    console.print(f"{folder} is there already{elsewhere}", markup=False)
    if kept["key"]["code"] != key["code"]:
        said = f"by other code of the scenes, {kept['key']['code']}; this is {key['code']}"
        console.print(f"warning: it was measured {said}. Delete the folder to measure it anew", markup=False)
    return kept


def leave_measures(folder: Path, record: dict[str, Any]) -> None:
    """Write the report's numbers by their names, unless the same are there."""
    from ..landscapes.measures.profile import named_measures

    with contextlib.suppress(OSError, TypeError, ValueError):  # not there, or damaged
        if read_json(folder / MEASURES) == named_measures(record):
            return
    write_record(folder / MEASURES, named_measures(record))
