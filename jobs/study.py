"""A study of a scene in its folder: opened or continued, announced, measured, drawn and written."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.cost import PICTURE_SECONDS, duration, seconds_per_episode, start_seconds
from ..studies import study_class
from ..studies.variants import NamedPoint, Study, StudyOptions, StudyRecord, expected_work
from .folder import STUDIES, Results, folder_named
from .job import CheckpointedJob
from .scene import SceneSpec, first_line, given_point, provenance
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from ..envs.base import Environment


@dataclass(frozen=True, kw_only=True)
class StudyJob(CheckpointedJob[StudyRecord]):
    """A study of a scene; a part of the checkpoint for each variant."""

    study: Study

    @classmethod
    def open(
        cls,
        kind: str,
        scene: SceneSpec,
        options: StudyOptions | None = None,
        *,
        through: Any = None,
        out: Path | None = None,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
    ) -> StudyJob:
        """Continue the study in its folder, by default one named after it, or begin it there.

        `through` names the point that it is about, or is one, of a kind that is about one. Raises ValueError for a
        kind, options, a point and a fidelity that are not to be had, where the scene has nothing to compare, and where
        the folder holds another study.
        """
        found = study_class(kind)
        fidelity = found.choose_fidelity(scene.kind, scene.fidelity)
        env, options = replace(scene, fidelity=fidelity, tolerance=None).make(), options or StudyOptions()
        if through is not None:
            name = through if isinstance(through, str) else "a point"
            options = replace(options, through=NamedPoint(name, given_point(env, through, f"study {kind}")))
        study = found(env, options)
        folder = out or folder_named(study.folder_parts(), study.identity())
        study.open(folder, force=force)
        return cls(study=study, checkpoint=study.checkpoint, folder=folder, prints=prints, command=command)

    @property
    def results(self) -> Results:  # type: ignore[override] # of the kind of study
        """What it leaves in its folder."""
        return STUDIES[self.study.kind]

    def work(self) -> Iterator[Work]:
        """Yield the variants that are left."""
        for one in self.study.expected():
            yield Work(one.env, 0, round(one.episodes), repeats=one.repeats)

    def compute(self, watch: Watch) -> StudyRecord:
        """Measure what is missing, and return the record."""
        self._announce(watch)
        return self.study.run(watch, provenance(self.study.env, self.command), self.command)

    def verified(self) -> Environment:
        """Return the reference."""
        return self.study.env.remake()

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return self.study.describe_kept()

    def seconds(self) -> dict[str, float]:
        """Estimate the seconds of each variant that is left, by the work of an episode and what is to be compiled."""
        env = self.study.env
        left = [(one, expected_work(one.env)) for one in self.study.expected()]
        if not left:
            return {}
        base, began = env.remake(fidelity=next(iter(env.fidelities))), time.perf_counter()
        base.prepare()
        prepared = time.perf_counter() - began if base.own_programs else 0.0
        part = base.device == "cuda" or base.whole_batches  # of which a part takes as long as all of it
        rows = min(len(self.study.x), base.preferred_batch) if part else base.preferred_batch
        x = base.space.sobol(rows, seed=0)
        start = prepared + start_seconds(base, x)
        rate = seconds_per_episode(base, x, grad=True) / expected_work(base)
        return {one.name: start + one.episodes * rate * work + one.repeats(rate * work) for one, work in left}

    def _announce(self, watch: Watch) -> None:
        """Say what is left to measure and about how long that takes."""
        study, env = self.study, self.study.env
        watch.note(first_line(env.identity(), env.engine, self.folder))
        watch.note(f"{study.describe_left()} at {len(study.x)} points")
        with watch.busy(f"{env.name}: {PREPARING}"):
            seconds = self.seconds()
        if seconds:
            dearest = max(seconds, key=lambda name: seconds[name])
            most = f", {duration(seconds[dearest])} of it for {dearest}" if len(seconds) > 1 else ""
            whole = sum(seconds.values()) + PICTURE_SECONDS
            watch.announce(f"about {duration(whole)} (from the work per episode){most}; {study.advice}", whole)
