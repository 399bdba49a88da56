"""What `landscape gallery compute` measures: the report of a figure's slice, the trade-off of its environment."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from ..commands import measure_report, tradeoff_report
from ..commands.measure_report import Subject
from ..commands.terminal import Console
from ..envs.registry import environment_class, make
from ..jobs.folder import SLICE_STORE as SLICE
from ..jobs.kept_reports import ARRAYS, MEASURES, PICTURE, REPORT
from ..jobs.variants import LADDERS
from .parts import Part, read_record
from .site.measured import DEVICES, TRADEOFF

if TYPE_CHECKING:
    from ..commands.tradeoff_report import Study

SEED = 0
REPORT_POINTS, TRADEOFF_POINTS = 6, 64  # those of `landscape report` and `landscape tradeoff`
TURNED = [ladder for ladder in LADDERS if ladder not in ("engine", "device")]  # those take hours on another device


class Reports(Part):
    """What the slice is like, beside it."""

    def label(self) -> str:
        """Return the command that measures it elsewhere."""
        return f"landscape report {self.folder} --device {self.device}"

    def left(self) -> int:
        """Return 1 where there is no report of this slice."""
        from ..landscapes.storage.paths import is_slice
        from ..landscapes.storage.store import open_slice

        kept, store = read_record(self.folder / REPORT), self.folder / SLICE
        if not isinstance(kept, dict) or read_record(self.folder / MEASURES) is None or not is_slice(store):
            return 1
        key = kept.get("key")
        return int(not isinstance(key, dict) or key.get("slice") != measure_report.digest(open_slice(store)))

    def seconds_each(self) -> float:
        """Estimate a report by the first episodes."""
        from ..landscapes.measures.profile import effort

        return measure_report.seconds_of(self._env(self.figure.fidelity), *effort(len(self.figure.dims), REPORT_POINTS))

    def make(self, console: Console) -> str:
        """Measure the slice, in the place of a report of another one."""
        from ..landscapes.draw.film import lighten
        from .words import paper_words

        files = [self.folder / name for name in (REPORT, MEASURES, PICTURE, ARRAYS)]
        for file in files:
            file.unlink(missing_ok=True)
        settings = {"points": REPORT_POINTS, "seed": SEED}
        subject = Subject(self.figure.id, self.folder / SLICE)
        record = measure_report.measured(console, subject, self.folder, settings, self.device, paper_words())
        lighten(self.folder / PICTURE)
        return ", ".join(record["verdict"]["words"])


class Tradeoffs(Part):
    """Accuracy against time of the figure's environment, which its other figures share."""

    def label(self) -> str:
        """Return the command that measures it elsewhere."""
        turned = ",".join(TURNED)
        return f"landscape tradeoff {self.figure.env} --device {self.device} --ladder {turned}"

    def left(self) -> int:
        """Return 1 where there is none, of an environment that has fidelities to trade."""
        some = len(environment_class(self.figure.env).fidelities) > 1
        return int(some and not any(read_record(record) and picture.is_file() for record, picture in self._places()))

    def seconds_each(self) -> float:
        """Estimate all rungs by the work of their episodes."""
        return sum(self._study().estimate().values())

    def make(self, console: Console) -> str:
        """Measure every rung; those that are measured stay in the study's own folder under out/ until the last is."""
        from ..landscapes.draw.film import lighten
        from ..landscapes.storage.files import make_folder
        from ..landscapes.storage.records import write_record

        study = self._study()
        report = study.run(console)
        record, picture = self._files(study.env.device)
        make_folder(record.parent)
        shutil.copyfile(study.pieces.folder / tradeoff_report.PICTURE, picture)
        lighten(picture)
        write_record(record, report)
        return f"{len(report['rungs'])} rungs at {report['points']} points"

    def _places(self) -> list[tuple[Path, Path]]:
        """Return where a record may be: of the device asked for, of any where none is."""
        return [self._files(device) for device in (DEVICES if self.device == "auto" else (self.device,))]

    def _files(self, device: str) -> tuple[Path, Path]:
        name = f"{self.figure.env}-{device}"
        return self.root / TRADEOFF / f"{name}.json", self.root / TRADEOFF / f"{name}.png"

    def _study(self) -> Study:
        reference = list(environment_class(self.figure.env).fidelities)[-1]
        env = make(self.figure.env, fidelity=reference, device=self.device)
        return tradeoff_report.Study.open(env, points=TRADEOFF_POINTS, seed=SEED, ladders=TURNED, out=None, force=False)
