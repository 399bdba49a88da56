"""The table of peers: what each needs for the work that we do, as ratios of one run, and what differs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

HEAD = (
    "peer",
    "what it was",
    "million work/s",
    "with gradient",
    "ours is faster",
    "with gradient",
    "MB, theirs : ours",
    "with gradient",
    "gradient off by",
    "ours off by",
)
WRONG = 0.05  # a gradient that is farther off than that at every step of the differences is called wrong


@dataclass(frozen=True)
class Pair:
    """Hold what a peer and ours printed of the same scene in the same run."""

    peer: str
    theirs: Mapping[str, Any]
    ours: Mapping[str, Any]


def best(records: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return one record of several rounds: the first that failed, or the last with the least seconds of all."""
    failed = next((record for record in records if "failed" in record), None)
    if failed is not None:
        return failed
    last = dict(records[-1])
    for key in ("forward", "gradient"):
        if last[key] is not None:
            last[key] = min(record[key] for record in records)
    return last


def row(pair: Pair) -> list[str]:
    """Return the cells of a peer; of one that failed, what went wrong."""
    theirs, ours = pair.theirs, pair.ours
    if "failed" in theirs or "failed" in ours:
        side = "" if "failed" in theirs else "ours: "
        return [f"`{pair.peer}`", side + str(theirs.get("failed", ours.get("failed"))).replace("|", "/"), *[""] * 8]
    size = f"{theirs['particles']} x {theirs['substeps']}"
    what = f"{theirs['version']}; {theirs['precision']}, {theirs['material']}, grid {theirs['grid']}, {size}"
    rates = [_rate(theirs, key) for key in ("forward", "gradient")]
    ratios = [_ratio(theirs[key], ours[key]) for key in ("forward", "gradient")]
    memory = [_megabytes(theirs[f"memory_{key}"], ours[f"memory_{key}"]) for key in ("forward", "gradient")]
    return [f"`{pair.peer}`", what, *rates, *ratios, *memory, _error(theirs), _error(ours)]


def markdown(pairs: Sequence[Pair]) -> str:
    """Return the table, and below it where losses disagree, what differs, and why a gradient is missing."""
    lines = [HEAD, ("---",) * len(HEAD), *(row(pair) for pair in pairs)]
    text = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return "\n\n".join([text, *("\n".join(notes(pair)) for pair in pairs)]) + "\n"


def notes(pair: Pair) -> list[str]:
    """Return what has to be said of a peer beside its numbers, a line each."""
    theirs, ours = pair.theirs, pair.ours
    if "failed" in theirs or "failed" in ours:
        return [f"- `{pair.peer}` did not run."]
    apart = abs(theirs["loss"] - ours["loss"]) / max(abs(ours["loss"]), 1e-300)
    found = [f"- `{pair.peer}`: its loss is {theirs['loss']:.7g}, ours {ours['loss']:.7g} ({apart:.1g} apart)."]
    if theirs["why"]:
        found.append(f"  - No gradient: {theirs['why']}")
    check = theirs["check"]
    if check is not None and not check["error"] <= WRONG:
        found.append(f"  - Its gradient is wrong: {check['error']:.2g} off at the best of the steps of differences.")
    return found + [f"  - {sentence}" for sentence in theirs["differs"]]


def _rate(record: Mapping[str, Any], key: str) -> str:
    return "none" if record[key] is None else f"{record['work'] / record[key] / 1e6:.3g}"


def _ratio(theirs: float | None, ours: float | None) -> str:
    return "" if theirs is None or ours is None else f"{theirs / ours:.3g} x"


def _megabytes(theirs: int | None, ours: int | None) -> str:
    return "" if theirs is None or ours is None else f"{theirs / 1e6:.0f} : {ours / 1e6:.0f}"


def _error(record: Mapping[str, Any]) -> str:
    check = record["check"]
    return "" if check is None else f"{check['error']:.1e} (step {check['step']:g})"
