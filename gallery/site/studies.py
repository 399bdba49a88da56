"""Studies on the pages of an environment: accuracy against time, convergence, parts of the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ...landscapes.convert import to_json
from ...landscapes.identity import MODEL_VERSION
from ...studies.convergence import ConvergenceRecord
from ...studies.fidelity import FidelityRecord, MeasuredVariant
from ...studies.kept import read_study
from ...studies.model import Effect, ModelRecord
from ...studies.variants import StudyRecord
from ..files import DEVICES, STUDIES, StudyFiles
from .downloads import save_table
from .studio import Studio

KINDS = ("fidelity", "convergence", "model")
TOLERANCE = 0.05  # of the loss error that a picture's description names the quickest variant for


@dataclass(frozen=True)
class StudyEntry:
    """A study of an environment on a device: its record, its files in the site, and `alt`, which describes its picture.

    `front` names the variants of a fidelity study that no other one beats in both time and error.
    """

    kind: str
    device: str
    picture: str
    file: str
    alt: str
    says: Sequence[str]
    found: StudyRecord
    front: Sequence[str] = ()


def place_studies(data: Path, out: Path, envs: Sequence[str], studio: Studio) -> dict[str, list[StudyEntry]]:
    """Copy the studies of these environments into the site, and return them by environment.

    A convergence study of another model version than the fidelity study is copied, but not shown with it.
    """
    placed: dict[str, list[StudyEntry]] = {env: [] for env in envs}
    for env, device in ((env, device) for env in placed for device in DEVICES):
        version: Any = None
        for kind in KINDS:
            source, target = (StudyFiles.of(root, env, device, kind) for root in (data, out))
            if not source.there():
                continue
            record = read_study(source.record, kind)
            studio.place(source, target)
            save_table(_rows(record), target.table)
            version = record.identity[MODEL_VERSION] if kind == "fidelity" else version
            if kind != "convergence" or record.identity[MODEL_VERSION] == version:
                placed[env].append(_entry(record, device, target))
    return placed


def _entry(record: StudyRecord, device: str, files: StudyFiles) -> StudyEntry:
    paths = (f"{STUDIES}/{files.picture.name}", f"{STUDIES}/{files.record.name}")
    front = record.front if isinstance(record, FidelityRecord) else ()
    return StudyEntry(record.kind, device, *paths, _describe(record), record.sentences(), record, front)


def _rows(record: StudyRecord) -> list[Mapping[str, Any]]:
    """Return the measurements of a study as rows of a table."""
    if isinstance(record, ConvergenceRecord):
        moves = [{"setting": one.setting, **asdict(move)} for one in record.settings for move in one.moves]
        return [*moves, *({"left of": one.name, **asdict(one)} for one in record.remainders)]
    if isinstance(record, ModelRecord):
        return [{**to_json(part), "verdict": part.verdict} for part in (*record.present, *record.missing)]
    return to_json(record.variants) if isinstance(record, FidelityRecord) else []


def _describe(record: StudyRecord) -> str:
    """Describe the picture of a study."""
    if isinstance(record, FidelityRecord):
        return _describe_accuracy(record)
    if isinstance(record, ConvergenceRecord):
        settings = ", ".join(one.setting for one in record.settings)
        return f"Change of the losses of {record.env} under refinement of {settings}: {record.rule.sentence()}"
    assert isinstance(record, ModelRecord)
    effects = {effect: [part.name for part in record.parts if part.effect == effect] for effect in Effect}
    said = [f"{', '.join(names)}: {effect}" for effect, names in effects.items() if names]
    return f"Change of the loss against time saved, for each part of {record.env}: " + "; ".join(said)


def _describe_accuracy(record: FidelityRecord) -> str:
    named = [one for one in record.by_time if one.changed == "named" and one.name != record.reference]
    parts = [f"{one.name} takes {_milliseconds(one)} and is off by {_share(one, record)}" for one in named]
    if quickest := record.cheapest(TOLERANCE):
        parts.append(f"the fastest within {TOLERANCE:.0%} is {quickest.name} with {_milliseconds(quickest)}")
    parts.append(f"the reference takes {_milliseconds(record.variant(record.reference))}")
    count = len(record.variants)
    return f"Loss error of {count} variants of {record.env} against the time of an episode: {'; '.join(parts)}"


def _milliseconds(one: MeasuredVariant) -> str:
    return f"{1e3 * one.seconds:.3g} ms"


def _share(one: MeasuredVariant, record: FidelityRecord) -> str:
    error = one.p95(relative=record.spread is not None)
    if error is None:
        return "an unknown amount (it failed too often)"
    return f"{error:.2g} {record.loss_unit}".rstrip() if record.spread is None else f"{100 * error:.2g} %"
