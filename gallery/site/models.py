"""What a page says of the parts of an environment's model: what each is for."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from ...landscapes.measures.model import Effect, MeasuredPart, ModelStudy
from ...landscapes.storage.records import read_json, reading
from ..files import DEVICES, TRADEOFFS, TradeoffFiles
from .downloads import save_table
from .manifest import Interval, ModelEntry, PartRow, as_json
from .studio import Studio

REMAKE = "delete it, and `landscape tradeoff {} --ladder model` measures it anew"


def place_models(data: Path, out: Path, envs: Sequence[str], studio: Studio) -> dict[str, list[ModelEntry]]:
    """Copy what was measured of the parts of these environments' models into the site; return it by environment."""
    placed: dict[str, list[ModelEntry]] = {}
    for env, device in ((env, device) for env in dict.fromkeys(envs) for device in DEVICES):
        source, target = (TradeoffFiles.of_model(root, env, device) for root in (data, out))
        if not source.there():
            continue
        with reading(source.record, REMAKE.format(env)):
            placed.setdefault(env, []).append(_entry(ModelStudy.of_record(read_json(source.record)), device, target))
        target.record.parent.mkdir(exist_ok=True)
        shutil.copyfile(source.record, target.record)
        shutil.copyfile(source.picture, target.picture)
        studio.develop(source.picture, target.picture)
        save_table(as_json(placed[env][-1].parts), target.table)
    return placed


def _entry(study: ModelStudy, device: str, files: TradeoffFiles) -> ModelEntry:
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
        picture=f"{TRADEOFFS}/{files.picture.name}",
        file=f"{TRADEOFFS}/{files.record.name}",
        alt=_describe(study),
        parts=[_row(part, study) for part in (*study.present, *study.missing)],
    )


def _row(part: MeasuredPart, study: ModelStudy) -> PartRow:
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


def _describe(study: ModelStudy) -> str:
    """Say what the picture of a model's parts shows."""
    said = [
        f"{', '.join(names)}: {effect}"
        for effect in Effect
        if (names := [part.name for part in study.parts if part.effect == effect])
    ]
    return f"How far changing each part of {study.env} moves losses over the time it saves: " + "; ".join(said)
