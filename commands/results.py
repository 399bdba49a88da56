"""The output of a command for each type of result, as text and as JSON."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

# Type -> "module:function", imported once such a result is there. A function's own keyword-only parameters are options
# of the verbs that return the type; what it returns is the exit code, 0 for None.
SHOWN = {
    "Advice": "advise:show",
    "Bench": "bench:show",
    "Card": "card:show",
    "Census": "census:show",
    "CheckReport": "check:show",
    "CheckReports": "checks:show",
    "Computed": "gallery:show_computed",
    "Environment": "environments:show_environment",
    "Explorer": "explore:show",
    "FigureList": "gallery:show_figures",
    "Hessian": "hessian:show",
    "Info": "environments:show_info",
    "League": "league:show",
    "list[Entry]": "environments:show_entries",
    "list[Method]": "environments:show_methods",
    "PairRanking": "pairs:show",
    "Plan": "plan:show",
    "Race": "race:show",
    "RemedyStudy": "remedy:show",
    "Report": "report:show",
    "Reports": "report:show_several",
    "SliceComparison": "compare:show",
    "SliceTable": "gallery:show_slices",
    "StudyRecord": "study:show",
    "type[Optimizer]": "environments:show_method",
}

LIVE = {"Explorer"}  # types that are no JSON: shown until Ctrl-C

RECORDED = {  # the same of types that are no records: what makes plain JSON of them
    "Environment": "environments:describe_environment",
    "type[Optimizer]": "environments:describe_method",
}


def shower(kind: str) -> Callable[..., int | None] | None:
    """Return what shows results of a type, None where its files say it all."""
    return _find(SHOWN[kind]) if kind in SHOWN else None


def _find(place: str) -> Callable[..., Any]:
    module, _, name = place.partition(":")
    found: Callable[..., Any] = getattr(import_module(f".{module}", __package__), name)
    return found


def kind_of(result: object) -> str:
    """Return the name of a result's type in `SHOWN`, that of the nearest base that is there."""
    if isinstance(result, list):
        return f"list[{type(result[0]).__name__}]" if result else "list"
    if isinstance(result, type):
        return "type[Optimizer]"
    names = [base.__name__ for base in type(result).__mro__]
    return next((name for name in names if name in SHOWN), names[0])


def as_json(result: Any, folder: Path | None) -> Any:
    """Return a result as plain JSON, with its folder: of a slice, a sweep, a run and a race the summary in there."""
    from ..jobs.folder import RACE_FIGURES, SUMMARY
    from ..landscapes.convert import to_json
    from ..landscapes.storage.records import read_json

    summary = {"Slice": SUMMARY, "Sweep": SUMMARY, "Run": SUMMARY, "Race": RACE_FIGURES}.get(type(result).__name__)
    if folder is not None and summary is not None:
        found = read_json(folder / summary)
        return {key: value for key, value in found.items() if key not in ("curves", "ecdf")} | {"folder": str(folder)}
    if isinstance(result, Path):
        return {"path": str(result)}
    if (kind := kind_of(result)) in RECORDED:
        return _find(RECORDED[kind])(result)
    found = to_json(getattr(result, "summary", result))
    if not isinstance(found, dict):
        return found
    return found | ({} if folder is None else {"folder": str(folder)})
