"""What a page says of the parts of an environment's model: what each is for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import cast

from ...studies.kept import read_study
from ...studies.model import Effect, MeasuredPart, ModelRecord
from ..files import DEVICES, STUDIES, StudyFiles
from .downloads import save_table
from .manifest import Interval, ModelEntry, PartRow, as_json
from .measured import place_study
from .studio import Studio


def place_models(data: Path, out: Path, envs: Sequence[str], studio: Studio) -> dict[str, list[ModelEntry]]:
    """Copy what was measured of the parts of these environments' models into the site; return it by environment."""
    placed: dict[str, list[ModelEntry]] = {}
    for env, device in ((env, device) for env in dict.fromkeys(envs) for device in DEVICES):
        source, target = (StudyFiles.of(root, env, device, "model") for root in (data, out))
        if not source.there():
            continue
        study = cast("ModelRecord", read_study(source.record, "model"))
        placed.setdefault(env, []).append(_entry(study, device, target))
        place_study(source, target, studio)
        save_table(as_json(placed[env][-1].parts), target.table)
    return placed


def _entry(study: ModelRecord, device: str, files: StudyFiles) -> ModelEntry:
    own = study.noise.comparison.loss_error
    return ModelEntry(
        env=study.env,
        fidelity=study.fidelity,
        loss_unit=study.loss_unit,
        command=study.command,
        points=study.points,
        spread=study.spread,
        device=device,
        noise=(own.p95_relative if study.spread else own.p95).value,
        refused=[asdict(one) for one in study.refused],
        picture=f"{STUDIES}/{files.picture.name}",
        file=f"{STUDIES}/{files.record.name}",
        alt=_describe(study),
        parts=[_row(part, study) for part in (*study.present, *study.missing)],
    )


def _row(part: MeasuredPart, study: ModelRecord) -> PartRow:
    found = part.comparison
    error = found.loss_error.p95_relative if study.spread else found.loss_error.p95
    return PartRow(
        name=part.name,
        change=part.change,
        missing=part.missing,
        error=Interval(**asdict(error)),
        spearman=found.spearman.value,
        cosine=found.gradient.cosine.value,
        diverged=found.diverged,
        cost=Interval(**asdict(part.cost)),
        verdict=part.verdict,
    )


def _describe(study: ModelRecord) -> str:
    """Say what the picture of a model's parts shows."""
    said = [
        f"{', '.join(names)}: {effect}"
        for effect in Effect
        if (names := [part.name for part in study.parts if part.effect == effect])
    ]
    return f"How far changing each part of {study.env} moves losses over the time it saves: " + "; ".join(said)
