"""What a page says of a slice's report, and of its environment's accuracy against time."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...jobs.report import Report
from ...landscapes.convert import from_json, to_json
from ...landscapes.identity import MODEL_VERSION, current_identity
from ...landscapes.measures.classify import WORDS
from ...landscapes.measures.convergence_record import Convergence
from ...landscapes.measures.fidelity import cheapest, p95, pareto_front
from ...landscapes.measures.gradient_quality import ScaleRow
from ...landscapes.measures.profile import Profile
from ...landscapes.plain import number, optional, text
from ...landscapes.storage.records import read_json, reading
from ..files import DEVICES, REMAKE, REPORT, TRADEOFFS, TradeoffFiles
from .downloads import save_table
from .manifest import ConvergenceEntry, Interval, ReportEntry, Rung, SecondsEntry, TradeoffEntry, Word
from .studio import Studio

Record = Mapping[str, Any]
TOLERANCE = 0.05  # of the loss error that a picture's description names the quickest rung for


def read_report(folder: Path) -> ReportEntry | None:
    """Return what `landscape report` found of a slice, None where there is no report."""
    if not (folder / REPORT).exists():
        return None
    report = _report_in(folder)
    return ReportEntry(
        words=_words(report),
        where=report.paper.where if report.paper else "",
        device=report.device,
        fidelity=report.fidelity,
        picture=_describe_quality(report.profile),
        file=REPORT,
    )


def _report_in(folder: Path) -> Report:
    with reading(folder / REPORT, REMAKE.format("reports")):
        return from_json(Report, read_json(folder / REPORT))


def _words(report: Report) -> list[Word]:
    """Return every word that was measured or that the paper says."""
    reasons = report.profile.verdict.reasons
    paper = [one.word for one in report.paper.words] if report.paper else []
    return [
        Word(word, word in reasons, reasons.get(word, ""), word in reasons if word in paper else None)
        for word in WORDS
        if word in reasons or word in paper
    ]


def _describe_quality(profile: Profile) -> str:
    """Say what the picture of gradient quality shows."""
    parts = [
        f"mean cosine of gradient and difference {_format_signed(row.cosine.value)} over {row.scale:.2g} of the box"
        for row in [_small(profile.differences), *profile.differences_of_samples]
        if row and math.isfinite(row.cosine.value)
    ]
    for row in profile.smoothing:
        if math.isfinite(row.biased.value):
            biased = round(row.biased.value * row.points)
            parts.append(f"smoothed over {row.width:.0%} of it, first order is biased at {biased} of {row.points}")
    return "Gradient quality over the slice: " + ("; ".join(parts) or "no slope above the noise")


def quality_rows(folder: Path) -> list[Record]:
    """Return what the picture of gradient quality shows by scale, a row for each scale of each of its three parts."""
    profile = _report_in(folder).profile
    parts = ("differences", "differences_of_samples", "smoothing")
    return [{"part": part.replace("_", " "), **to_json(row)} for part in parts for row in getattr(profile, part)]


def _small(rows: Sequence[ScaleRow]) -> ScaleRow | None:
    return next((row for row in rows if row.points >= row.of / 2), None)


def _format_signed(value: float) -> str:
    return f"{value:z.2f}".replace("-", "\N{MINUS SIGN}")


def place_tradeoffs(data: Path, out: Path, envs: Sequence[str], studio: Studio) -> dict[str, list[TradeoffEntry]]:
    """Copy what was measured of these environments' accuracy into the site, and return it by environment."""
    placed: dict[str, list[TradeoffEntry]] = {}
    for env, device in ((env, device) for env in dict.fromkeys(envs) for device in DEVICES):
        source, target = (TradeoffFiles.of(root, env, device) for root in (data, out))
        if not source.there():
            continue
        target.record.parent.mkdir(exist_ok=True)
        with reading(source.record, REMAKE.format("tradeoffs")):
            record = read_json(source.record)
            study = _read_convergence(source.convergence, record, target.convergence.table)
            placed.setdefault(env, []).append(_tradeoff(record, target, study))
        for one, there in ((source, target), (source.convergence, target.convergence)):
            if one.there():
                shutil.copyfile(one.record, there.record)
                shutil.copyfile(one.picture, there.picture)
                studio.develop(one.picture, there.picture)
        save_table(record["rungs"], target.table)
    return placed


def _read_convergence(files: TradeoffFiles, record: Record, table: Path) -> ConvergenceEntry | None:
    """Return what a study of convergence says, None where there is none of the model that the trade-off is of."""
    if not files.there():
        return None
    todo = f"delete it, and `landscape tradeoff {record['env']} --ladder convergence` measures it anew"
    with reading(files.record, todo):
        found = Convergence.of_record(read_json(files.record))
    moves = [{"knob": one.knob, **asdict(move)} for one in found.knobs for move in one.moves]
    save_table([*moves, *({"left of": one.name, **asdict(one)} for one in found.remainders)], table)
    if found.identity[MODEL_VERSION] != current_identity(record["identity"]).get(MODEL_VERSION):
        return None
    knobs = ", ".join(knob.knob for knob in found.knobs)
    return ConvergenceEntry(
        says=found.sentences(),
        converged=found.rule.met,
        command=found.command,
        picture=f"{TRADEOFFS}/{files.picture.name}",
        file=f"{TRADEOFFS}/{files.record.name}",
        alt=f"How far losses of {found.env} move as {knobs} are refined: {found.rule.say()}",
    )


def _tradeoff(record: Record, files: TradeoffFiles, study: ConvergenceEntry | None) -> TradeoffEntry:
    rows = sorted(record["rungs"], key=_time)
    reference = next(row for row in rows if row["name"] == record["reference"])
    quicker = [row for row in rows if _time(row) < _time(reference)]
    errors = [math.inf if (off := _error(row, record)) is None else off for row in quicker]
    best = {quicker[place]["name"] for place in pareto_front([_time(row) for row in quicker], errors)}
    return TradeoffEntry(
        **{name: text(record[name]) for name in ("env", "reference", "loss_unit", "command")},
        points=number(record["points"]),
        spread=optional(number, record["spread"]),
        refused=record["refused"],
        options=dict(record["identity"]["options"]),
        device=text(record["identity"]["device"]),
        picture=f"{TRADEOFFS}/{files.picture.name}",
        file=f"{TRADEOFFS}/{files.record.name}",
        alt=_describe_accuracy(record, reference),
        rungs=[_rung(row, record, best) for row in rows],
        convergence=study,
    )


def _rung(row: Record, record: Record, best: set[str]) -> Rung:
    error = row["loss_error"]["p95_relative" if record["spread"] else "p95"]
    return Rung(
        name=text(row["name"]),
        front=row["name"] in best,
        error=Interval(**{end: optional(number, error[end]) for end in ("value", "low", "high")}),
        spearman=optional(number, row["spearman"]["value"]),
        cosine=optional(number, row["gradient"]["cosine"]["value"]),
        diverged=optional(number, row["diverged"]),
        seconds=SecondsEntry(**{way: number(row["seconds"][way]) for way in ("forward", "with_gradient")}),
        memory=number(row["memory"]),
    )


def _describe_accuracy(record: Record, reference: Record) -> str:
    """Say what the picture of accuracy against time shows."""
    named = [row for row in record["rungs"] if row["ladder"] == "named" and row is not reference]
    parts = [
        f"{row['name']} takes {_milliseconds(row)} and is off by {_share(_error(row, record), record)}" for row in named
    ]
    others = [row for row in record["rungs"] if row is not reference]
    if quickest := cheapest(others, TOLERANCE, relative=True):
        parts.append(f"the quickest within {TOLERANCE:.0%} is {quickest['name']} with {_milliseconds(quickest)}")
    count = len(record["rungs"])
    return f"Loss error of {count} ways to simulate {record['env']} over the time of an episode: " + "; ".join(
        [*parts, f"the reference takes {_milliseconds(reference)}"]
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
