"""What a page says of a slice's report, and of its environment's accuracy against time."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from ...jobs.report import Report
from ...landscapes.convert import from_json, to_json
from ...landscapes.identity import MODEL_VERSION
from ...landscapes.measures.classify import WORDS
from ...landscapes.measures.gradient_quality import ScaleRow
from ...landscapes.measures.profile import Profile
from ...landscapes.plain import number
from ...landscapes.storage.records import read_json, reading
from ...studies.kept import read_study
from ..files import DEVICES, REMAKE, REPORT, STUDIES, StudyFiles
from .downloads import save_table
from .manifest import ConvergenceEntry, FidelityEntry, Interval, ReportEntry, SecondsEntry, VariantRow, Word, as_json
from .studio import Studio

if TYPE_CHECKING:
    from ...studies.convergence import ConvergenceRecord
    from ...studies.fidelity import FidelityRecord, MeasuredVariant

Record = Mapping[str, Any]
TOLERANCE = 0.05  # of the loss error that a picture's description names the quickest variant for


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


def place_fidelities(data: Path, out: Path, envs: Sequence[str], studio: Studio) -> dict[str, list[FidelityEntry]]:
    """Copy what was measured of these environments' accuracy into the site, and return it by environment."""
    placed: dict[str, list[FidelityEntry]] = {}
    for env, device in ((env, device) for env in dict.fromkeys(envs) for device in DEVICES):
        source, target = (StudyFiles.of(root, env, device, "fidelity") for root in (data, out))
        if not source.there():
            continue
        record = cast("FidelityRecord", read_study(source.record, "fidelity"))
        place_study(source, target, studio)
        placed.setdefault(env, []).append(_fidelity(record, target, _place_convergence(data, out, record, studio)))
        save_table(as_json(record.variants), target.table)
    return placed


def place_study(source: StudyFiles, target: StudyFiles, studio: Studio) -> None:
    """Copy a study and its picture into the site."""
    target.record.parent.mkdir(exist_ok=True)
    shutil.copyfile(source.record, target.record)
    shutil.copyfile(source.picture, target.picture)
    studio.develop(source.picture, target.picture)


def _place_convergence(data: Path, out: Path, of: FidelityRecord, studio: Studio) -> ConvergenceEntry | None:
    """Copy a study of convergence, and return what it says; None where there is none of the same model."""
    source, target = (StudyFiles.of(root, of.env, of.device, "convergence") for root in (data, out))
    if not source.there():
        return None
    found = cast("ConvergenceRecord", read_study(source.record, "convergence"))
    place_study(source, target, studio)
    moves = [{"setting": one.setting, **asdict(move)} for one in found.settings for move in one.moves]
    save_table([*moves, *({"left of": one.name, **asdict(one)} for one in found.remainders)], target.table)
    if found.identity[MODEL_VERSION] != of.identity[MODEL_VERSION]:
        return None
    settings = ", ".join(one.setting for one in found.settings)
    return ConvergenceEntry(
        says=found.sentences(),
        converged=found.rule.met,
        command=found.command,
        picture=f"{STUDIES}/{target.picture.name}",
        file=f"{STUDIES}/{target.record.name}",
        alt=f"How far losses of {found.env} move as {settings} are refined: {found.rule.sentence()}",
    )


def _fidelity(record: FidelityRecord, files: StudyFiles, study: ConvergenceEntry | None) -> FidelityEntry:
    front = set(record.front)
    return FidelityEntry(
        env=record.env,
        reference=record.reference,
        loss_unit=record.loss_unit,
        command=record.command,
        points=record.points,
        spread=record.spread,
        refused=[asdict(one) for one in record.refused],
        options=dict(record.identity["options"]),
        device=record.device,
        picture=f"{STUDIES}/{files.picture.name}",
        file=f"{STUDIES}/{files.record.name}",
        alt=_describe_accuracy(record),
        variants=[_row(one, record, one.name in front) for one in record.by_time],
        convergence=study,
    )


def _row(one: MeasuredVariant, record: FidelityRecord, front: bool) -> VariantRow:
    found = one.comparison
    error = found.loss_error.p95_relative if record.spread else found.loss_error.p95
    return VariantRow(
        name=one.name,
        front=front,
        error=Interval(**asdict(error)),
        spearman=found.spearman.value,
        cosine=found.gradient.cosine.value,
        diverged=found.diverged,
        seconds=SecondsEntry(**asdict(found.seconds)),
        memory=number(one.memory),
    )


def _describe_accuracy(record: FidelityRecord) -> str:
    """Say what the picture of accuracy against time shows."""
    named = [one for one in record.by_time if one.changed == "named" and one.name != record.reference]
    parts = [f"{one.name} takes {_milliseconds(one)} and is off by {_share(one, record)}" for one in named]
    if quickest := record.cheapest(TOLERANCE):
        parts.append(f"the quickest within {TOLERANCE:.0%} is {quickest.name} with {_milliseconds(quickest)}")
    parts.append(f"the reference takes {_milliseconds(record.variant(record.reference))}")
    count = len(record.variants)
    return f"Loss error of {count} ways to simulate {record.env} over the time of an episode: {'; '.join(parts)}"


def _milliseconds(one: MeasuredVariant) -> str:
    return f"{1e3 * one.seconds:.3g} ms"


def _share(one: MeasuredVariant, record: FidelityRecord) -> str:
    error = one.p95(relative=record.spread is not None)
    if error is None:
        return "more than a number can say (it failed too often)"
    return f"{error:.2g} {record.loss_unit}".rstrip() if record.spread is None else f"{100 * error:.2g} %"
