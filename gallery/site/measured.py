"""What a page says of a slice's report, and of its environment's accuracy against time."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...landscapes.measures.classify import WORDS
from ...landscapes.measures.fidelity import cheapest, front, p95
from ...landscapes.storage.records import number, optional, read_json, reading, text
from .page_data import REMAKE

Record = Mapping[str, Any]
REPORT, QUALITY, MEASURES = "report.json", "gradient-quality.png", "measures.json"
TRADEOFF = "tradeoff"  # folder of ENV-DEVICE.json and .png, as `landscape tradeoff` leaves them
DEVICES = ("cuda", "cpu")
TOLERANCE = 0.05  # of the loss error that a picture's description names the quickest rung for


def read_report(folder: Path) -> dict[str, Any] | None:
    """Return what `landscape report` found of a slice, None where there is no report."""
    path = folder / REPORT
    if not path.exists():
        return None
    with reading(path, REMAKE.format("reports")):
        record = read_json(path)
        return {
            "words": _words(record),
            "where": text(record["paper"]["where"]) if record["paper"] else "",
            "device": text(record["device"]),
            "fidelity": text(record["fidelity"]),
            "picture": _quality(record),
            "file": REPORT,
        }


def _words(record: Record) -> list[dict[str, Any]]:
    """Return every word that was measured or that the paper says: `agree` is None where the paper is silent."""
    reasons = record["verdict"]["reasons"]
    said = [one["word"] for one in (record["paper"] or {"words": []})["words"]]
    return [
        {
            "word": word,
            "measured": word in reasons,
            "reason": text(reasons.get(word, "")),
            "agree": word in reasons if word in said else None,
        }
        for word in WORDS
        if word in reasons or word in said
    ]


def _quality(record: Record) -> str:
    """Say what the picture of gradient quality shows."""
    said = [
        f"mean cosine of gradient and difference {_signed(row['cosine']['value'])} over {row['scale']:.2g} of the box"
        for row in [_small(record["differences"]), *record["differences_of_samples"]]
        if row and row["cosine"]["value"] is not None
    ]
    for row in record["smoothing"]:
        if row["biased"]["value"] is not None:
            biased = round(row["biased"]["value"] * row["points"])
            said.append(f"smoothed over {row['width']:.0%} of it, first order is biased at {biased} of {row['points']}")
    return "Gradient quality over the slice: " + ("; ".join(said) or "no slope above the noise")


def _small(rows: list[Record]) -> Record | None:
    return next((row for row in rows if row["points"] >= row["of"] / 2), None)


def _signed(value: float) -> str:
    return f"{value:z.2f}".replace("-", "\N{MINUS SIGN}")


def dark_name(picture: str) -> str:
    """Return the name of a picture for pages that are dark."""
    return picture.removesuffix(".png") + "-dark.png"


def place_tradeoffs(data: Path, out: Path, envs: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Copy what was measured of these environments' accuracy into the site, and return it by environment."""
    from ...landscapes.draw.figures.dark import save_dark

    found: dict[str, list[dict[str, Any]]] = {}
    for env in dict.fromkeys(envs):
        for file in (data / TRADEOFF / f"{env}-{device}.json" for device in DEVICES):
            picture = file.with_suffix(".png")
            if not (file.exists() and picture.exists()):
                continue
            with reading(file, REMAKE.format("tradeoffs")):
                found.setdefault(env, []).append(_tradeoff(read_json(file), file.stem))
            (out / TRADEOFF).mkdir(exist_ok=True)
            for one in (file, picture):
                shutil.copyfile(one, out / TRADEOFF / one.name)
            save_dark(picture, out / TRADEOFF / dark_name(picture.name))
    return found


def _tradeoff(record: Record, name: str) -> dict[str, Any]:
    rows = sorted(record["rungs"], key=_time)
    reference = next(row for row in rows if row["name"] == record["reference"])
    quicker = [row for row in rows if _time(row) < _time(reference)]
    errors = [math.inf if (off := _error(row, record)) is None else off for row in quicker]
    best = {quicker[number]["name"] for number in front([_time(row) for row in quicker], errors)}
    return {
        **{name: text(record[name]) for name in ("env", "reference", "loss_unit", "command")},
        **{
            "points": number(record["points"]),
            "spread": optional(number, record["spread"]),
            "refused": record["refused"],
        },
        "options": dict(record["identity"]["options"]),
        "device": text(record["identity"]["device"]),
        "picture": f"{TRADEOFF}/{name}.png",
        "file": f"{TRADEOFF}/{name}.json",
        "alt": _accuracy(record, reference),
        "rungs": [_rung(row, record, best) for row in rows],
    }


def _rung(row: Record, record: Record, best: set[str]) -> dict[str, Any]:
    error = row["loss_error"]["p95_relative" if record["spread"] else "p95"]
    return {
        "name": text(row["name"]),
        "front": row["name"] in best,
        "error": {end: optional(number, error[end]) for end in ("value", "low", "high")},
        "spearman": optional(number, row["spearman"]["value"]),
        "cosine": optional(number, row["gradient"]["cosine"]["value"]),
        "diverged": optional(number, row["diverged"]),
        "seconds": {way: number(row["seconds"][way]) for way in ("forward", "with_gradient")},
        "memory": number(row["memory"]),
    }


def _accuracy(record: Record, reference: Record) -> str:
    """Say what the picture of accuracy against time shows."""
    named = [row for row in record["rungs"] if row["ladder"] == "named" and row is not reference]
    said = [
        f"{row['name']} takes {_milliseconds(row)} and is off by {_share(_error(row, record), record)}" for row in named
    ]
    others = [row for row in record["rungs"] if row is not reference]
    if quickest := cheapest(others, TOLERANCE, relative=True):
        said.append(f"the quickest within {TOLERANCE:.0%} is {quickest['name']} with {_milliseconds(quickest)}")
    count = len(record["rungs"])
    return f"Loss error of {count} ways to simulate {record['env']} over the time of an episode: " + "; ".join(
        [*said, f"the reference takes {_milliseconds(reference)}"]
    )


def _time(row: Record) -> float:
    return number(row["seconds"]["with_gradient"])


def _error(row: Record, record: Record) -> float | None:
    return p95(row, relative=record["spread"] is not None)


def _milliseconds(row: Record) -> str:
    return f"{1e3 * _time(row):.3g} ms"


def _share(error: float | None, record: Record) -> str:
    if error is None:
        return "more than a number can say (it failed too often)"
    return f"{error:.2g} {record['loss_unit']}".rstrip() if record["spread"] is None else f"{100 * error:.2g} %"
