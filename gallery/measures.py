"""What the gallery measures: the report of a figure's slice, the study of its environment's fidelities."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from ..envs.registry import environment_class
from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch
from ..landscapes.convert import to_json
from ..landscapes.storage.records import read_json
from ..studies.fidelity import SETTINGS
from .files import DEVICES, MEASURES, QUALITY, QUALITY_ARRAYS, REPORT, STORE, StudyFiles
from .parts import FigurePart
from .records import read_if_sound

if TYPE_CHECKING:
    from ..jobs.study import StudyJob

SEED = 0
REPORT_POINTS, STUDY_POINTS = 6, 64  # those of `landscape report` and `landscape study fidelity`
CHANGED = tuple(one for one in SETTINGS if one not in ("engine", "device"))  # those take hours on another device


class ReportPart(FigurePart):
    """What the slice is like, beside it."""

    def label(self) -> str:
        """Return the command that measures it elsewhere, which names no folder above this one: its record is kept."""
        folder, here = self.folder.resolve(), Path.cwd()
        said = folder.relative_to(here) if folder.is_relative_to(here) else self.folder
        return f"landscape report {said} --device {self.device}"

    def count_left(self) -> int:
        """Return 1 where there is no report of this slice."""
        from ..jobs.report import digest_of
        from ..landscapes.storage.paths import is_slice
        from ..landscapes.storage.store import open_slice

        record, store = read_if_sound(read_json, self.folder / REPORT), self.folder / STORE
        if record is None or read_if_sound(read_json, self.folder / MEASURES) is None or not is_slice(store):
            return 1
        key = record.get("key")
        return int(not isinstance(key, dict) or key.get("slice") != digest_of(open_slice(store)))

    def seconds_each(self) -> float:
        """Estimate a report by the first episodes."""
        from ..jobs.report import estimate_seconds
        from ..landscapes.measures.profile import effort

        rank = len(self.figure.dims)
        shape = (self.figure.resolution,) * rank
        return estimate_seconds(self.scene().make(), *effort(rank, REPORT_POINTS, shape))

    def make(self, watch: Watch) -> str:
        """Measure the slice, in the place of a report of another one."""
        from ..jobs.report import ReportedSlice, ReportJob
        from ..landscapes.draw.film import lighten
        from .paper import read_paper

        for name in (REPORT, MEASURES, QUALITY, QUALITY_ARRAYS):
            (self.folder / name).unlink(missing_ok=True)
        subject, words = ReportedSlice(self.figure.id, self.folder / STORE), read_paper().words
        job = ReportJob([subject], self.folder, True, REPORT_POINTS, SEED, self.device, words, command=self.label())
        report = job.report(subject, watch)
        lighten(self.folder / QUALITY)
        return ", ".join(report.words)


class FidelityPart(FigurePart):
    """Accuracy against time of the figure's environment, which its other figures share."""

    @property
    def shared(self) -> str:
        """The environment."""
        return self.figure.env

    def label(self) -> str:
        """Return the command that measures it elsewhere."""
        return f"landscape study fidelity {self.figure.env} --device {self.device} --settings {','.join(CHANGED)}"

    def count_left(self) -> int:
        """Return 1 where there is none, of an environment that has fidelities to compare."""
        some = len(environment_class(self.figure.env).fidelities) > 1
        devices = DEVICES if self.device == "auto" else (self.device,)
        return int(some and not any(map(self._sound, devices)))

    def seconds_each(self) -> float:
        """Estimate all variants by the work of their episodes."""
        return sum(self._open().seconds().values())

    def make(self, watch: Watch) -> str:
        """Measure every variant; those that are measured stay in a folder of their own under out/ until the last is."""
        from ..landscapes.draw.film import lighten
        from ..landscapes.storage.files import make_folder
        from ..landscapes.storage.records import write_record

        job = self._open()
        found = job.run(watch)
        files = StudyFiles.of(self.root, self.figure.env, found.device, found.kind)
        make_folder(files.record.parent)
        shutil.copyfile(job.folder / job.results.picture, files.picture)
        lighten(files.picture)
        write_record(files.record, to_json(found))
        return f"{len(found.table())} variants at {found.points} points"

    def _sound(self, device: str) -> bool:
        """Whether there is one of a device."""
        files = StudyFiles.of(self.root, self.figure.env, device, "fidelity")
        return bool(read_if_sound(read_json, files.record)) and files.picture.is_file()

    def _open(self) -> StudyJob:
        from ..jobs.study import StudyJob
        from ..studies.variants import StudyOptions

        scene = SceneSpec(self.figure.env, device=self.device)
        options = StudyOptions(points=STUDY_POINTS, seed=SEED, settings=CHANGED)
        return StudyJob.open("fidelity", scene, options, command=self.label())
