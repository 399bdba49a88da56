"""What the gallery measures: the report of a figure's slice, the trade-off of its environment."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..envs.registry import environment_class
from ..jobs.scene import SceneSpec
from ..jobs.variants import LADDERS
from ..jobs.watch import Watch
from ..landscapes.storage.records import read_json
from .files import DEVICES, MEASURES, QUALITY, QUALITY_ARRAYS, REPORT, STORE, TRADEOFF_PICTURE, TradeoffFiles
from .parts import Part, console_of
from .records import read_if_sound

if TYPE_CHECKING:
    from ..commands.tradeoff_report import Study

SEED = 0
REPORT_POINTS, TRADEOFF_POINTS = 6, 64  # those of `landscape report` and `landscape tradeoff`
TURNED = [ladder for ladder in LADDERS if ladder not in ("engine", "device")]  # those take hours on another device


class ReportPart(Part):
    """What the slice is like, beside it."""

    def label(self) -> str:
        """Return the command that measures it elsewhere."""
        return f"landscape report {self.folder} --device {self.device}"

    def left(self) -> int:
        """Return 1 where there is no report of this slice."""
        from ..landscapes.storage.store import is_slice, open_slice

        record, store = read_if_sound(read_json, self.folder / REPORT), self.folder / STORE
        if record is None or read_if_sound(read_json, self.folder / MEASURES) is None or not is_slice(store):
            return 1
        key = record.get("key")
        return int(not isinstance(key, dict) or key.get("slice") != _digest(open_slice(store)))

    def seconds_each(self) -> float:
        """Estimate a report by the first episodes."""
        from ..commands.measure_report import seconds_of
        from ..landscapes.measures.profile import effort

        return seconds_of(self._scene().make(), *effort(len(self.figure.dims), REPORT_POINTS))

    def make(self, watch: Watch) -> str:
        """Measure the slice, in the place of a report of another one."""
        from ..landscapes.draw.film import lighten

        for name in (REPORT, MEASURES, QUALITY, QUALITY_ARRAYS):
            (self.folder / name).unlink(missing_ok=True)
        words = self._measure(watch)
        lighten(self.folder / QUALITY)
        return ", ".join(words)

    def _measure(self, watch: Watch) -> list[str]:
        """Report on the slice into its own folder, and return the words for it."""
        from ..commands.measure_report import Subject, measured
        from .paper import read_paper

        settings, subject = {"points": REPORT_POINTS, "seed": SEED}, Subject(self.figure.id, self.folder / STORE)
        words = read_paper().words
        record = measured(console_of(watch), subject, self.folder, settings, self.device, words)
        return list(record["verdict"]["words"])


def _digest(dataset: Any) -> str:
    """Return what a report knows its slice by."""
    from ..commands.measure_report import digest

    return digest(dataset)


class TradeoffPart(Part):
    """Accuracy against time of the figure's environment, which its other figures share."""

    def label(self) -> str:
        """Return the command that measures it elsewhere."""
        turned = ",".join(TURNED)
        return f"landscape tradeoff {self.figure.env} --device {self.device} --ladder {turned}"

    def left(self) -> int:
        """Return 1 where there is none, of an environment that has fidelities to trade."""
        some = len(environment_class(self.figure.env).fidelities) > 1
        devices = DEVICES if self.device == "auto" else (self.device,)
        return int(some and not any(map(self._sound, devices)))

    def seconds_each(self) -> float:
        """Estimate all rungs by the work of their episodes."""
        return sum(self._open().estimate().values())

    def make(self, watch: Watch) -> str:
        """Measure every rung; those that are measured stay in the study's own folder under out/ until the last is."""
        from ..landscapes.draw.film import lighten
        from ..landscapes.storage.files import make_folder
        from ..landscapes.storage.records import write_record

        record, folder, device = self._measure(watch)
        files = TradeoffFiles.of(self.root, self.figure.env, device)
        make_folder(files.record.parent)
        shutil.copyfile(folder / TRADEOFF_PICTURE, files.picture)
        lighten(files.picture)
        write_record(files.record, record)
        return f"{len(record['rungs'])} rungs at {record['points']} points"

    def _sound(self, device: str) -> bool:
        """Whether there is one of a device."""
        files = TradeoffFiles.of(self.root, self.figure.env, device)
        return bool(read_if_sound(read_json, files.record)) and files.picture.is_file()

    def _measure(self, watch: Watch) -> tuple[dict[str, Any], Path, str]:
        """Measure what is left; return the record, the study's own folder, and the device."""
        study = self._open()
        return study.run(console_of(watch)), study.pieces.folder, study.env.device

    def _open(self) -> Study:
        from ..commands.tradeoff_report import Study

        reference = list(environment_class(self.figure.env).fidelities)[-1]
        env = SceneSpec(self.figure.env, reference, device=self.device).make()
        return Study.open(env, points=TRADEOFF_POINTS, seed=SEED, ladders=TURNED, out=None, force=False)
