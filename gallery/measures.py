"""What `landscape gallery compute` measures: the report of a figure's slice, the trade-off of its environment."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from ..api.progress import Bars, Console
from ..envs.registry import environment_class
from ..jobs.folder import REPORT as FILES
from ..jobs.folder import SLICE_STORE as SLICE
from ..jobs.folder import TRADEOFF as STUDY
from ..jobs.variants import SETTINGS
from .parts import Part, read_record
from .site.measured import DEVICES, TRADEOFF

if TYPE_CHECKING:
    from ..jobs.tradeoff import TradeoffJob

REPORT, MEASURES, PICTURE, ARRAYS = FILES.files
SEED = 0
REPORT_POINTS, TRADEOFF_POINTS = 6, 64  # those of `landscape report` and `landscape tradeoff`
TURNED = [one for one in SETTINGS if one not in ("engine", "device")]  # those take hours on another device


class Reports(Part):
    """What the slice is like, beside it."""

    def label(self) -> str:
        """Return the command that measures it elsewhere."""
        return f"landscape report {self.folder} --device {self.device}"

    def left(self) -> int:
        """Return 1 where there is no report of this slice."""
        from ..jobs.report import digest_of
        from ..landscapes.storage.store import is_slice, open_slice

        kept, store = read_record(self.folder / REPORT), self.folder / SLICE
        if not isinstance(kept, dict) or read_record(self.folder / MEASURES) is None or not is_slice(store):
            return 1
        key = kept.get("key")
        return int(not isinstance(key, dict) or key.get("slice") != digest_of(open_slice(store)))

    def seconds_each(self) -> float:
        """Estimate a report by the first episodes."""
        from ..jobs.report import estimate_seconds
        from ..landscapes.measures.profile import effort

        return estimate_seconds(self._env(self.figure.fidelity), *effort(len(self.figure.dims), REPORT_POINTS))

    def make(self, console: Console) -> str:
        """Measure the slice, in the place of a report of another one."""
        from ..jobs.report import ReportJob, Subject
        from ..landscapes.draw.film import lighten
        from .words import paper_words

        files = [self.folder / name for name in (REPORT, MEASURES, PICTURE, ARRAYS)]
        for file in files:
            file.unlink(missing_ok=True)
        subject = Subject(self.figure.id, self.folder / SLICE)
        job = ReportJob(
            [subject], self.folder, True, REPORT_POINTS, SEED, self.device, paper_words(), command=self.label()
        )
        report = job.report(subject, Bars(console))
        lighten(self.folder / PICTURE)
        return ", ".join(report.words)


class Tradeoffs(Part):
    """Accuracy against time of the figure's environment, which its other figures share."""

    def label(self) -> str:
        """Return the command that measures it elsewhere."""
        turned = ",".join(TURNED)
        return f"landscape tradeoff {self.figure.env} --device {self.device} --variants {turned}"

    def left(self) -> int:
        """Return 1 where there is none, of an environment that has fidelities to trade."""
        some = len(environment_class(self.figure.env).fidelities) > 1
        return int(some and not any(read_record(record) and picture.is_file() for record, picture in self._places()))

    def seconds_each(self) -> float:
        """Estimate all variants by the work of their episodes."""
        return sum(self._job().estimate().values())

    def make(self, console: Console) -> str:
        """Measure every variant; those that are measured stay in a folder of their own under out/ until the last is."""
        from ..landscapes.draw.film import lighten
        from ..landscapes.storage.files import make_folder
        from ..landscapes.storage.records import write_record

        job = self._job()
        found = job.run(Bars(console))
        record, picture = self._files(job.env.device)
        make_folder(record.parent)
        shutil.copyfile(job.folder / STUDY.picture, picture)
        lighten(picture)
        write_record(record, found.record())
        return f"{len(found.variants)} variants at {found.points} points"

    def _places(self) -> list[tuple[Path, Path]]:
        """Return where a record may be: of the device asked for, of any where none is."""
        return [self._files(device) for device in (DEVICES if self.device == "auto" else (self.device,))]

    def _files(self, device: str) -> tuple[Path, Path]:
        name = f"{self.figure.env}-{device}"
        return self.root / TRADEOFF / f"{name}.json", self.root / TRADEOFF / f"{name}.png"

    def _job(self) -> TradeoffJob:
        from ..jobs.scene import SceneSpec
        from ..jobs.tradeoff import TradeoffJob

        scene = SceneSpec(self.figure.env, device=self.device)
        return TradeoffJob.open(scene, points=TRADEOFF_POINTS, seed=SEED, settings=TURNED, command=self.label())
