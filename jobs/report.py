"""Reports of slices in numbers and in words: a folder for each, measured once and read again."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from ..landscapes.capacity import Need, require, size
from ..landscapes.convert import NOT_JSON, from_json, to_json
from ..landscapes.cost import duration
from ..landscapes.identity import MODEL_VERSION, digest_of, plane_of, stored_identity
from ..landscapes.measures.features import Features
from ..landscapes.measures.following import CHIEF, SCALES
from ..landscapes.measures.profile import Profile
from ..landscapes.measures.verdict import QuotedWord, Verdict
from ..landscapes.objective import BoxedObjective, Evaluation, ObjectiveWrapper, evaluate
from ..landscapes.plain import digest
from ..landscapes.storage.files import is_full, make_folder, other_files, replacing, tidy, write_json
from ..landscapes.storage.records import read_json, reading, write_record
from ..landscapes.verification import LAST_PLACE, RESAMPLE, verify_dataset
from .features import features_of, features_work
from .folder import REPORT, REPORTS, ROOT, SLICE_FILE, SLICE_STORE, folder_named, store_in
from .plan import simulation_seconds
from .scene import environment_of, first_line
from .watch import PREPARING, Watch, Work, resumable

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from ..envs.base import Environment
    from ..landscapes.draw.figure import Picture
    from ..landscapes.measures.lyapunov import GradientGrowth
    from ..landscapes.objective import Objective
    from ..landscapes.statistics import Estimate

RECORD, MEASURES, PICTURE, ARRAYS, PAGE = REPORT.files  # of the arrays, and the slice, the picture is drawn
TABLE = REPORTS.files[1]
POINTS = 6  # along each axis where gradients are tested by new evaluations
HORIZONS, GROWTH_POINTS = (0.2, 0.4, 0.6, 0.8, 1.0), 16  # shares of the episode, and where gradients are compared
RESOLUTION = 24  # points per axis of a slice that is sampled for its report
HEADINGS = ("slice", "minima", "turns", "jumps", "cosine", "measured", "the paper's words", "measured too")
ENVIRONMENTS = (
    "environment", "slices", "minima", "turns", "largest jump", "cosine over 1 %", "cosine over 5 %", "measured",
    "the paper's words", "agree",
)  # fmt: skip


@dataclass(frozen=True)
class ReportedSlice:
    """A slice to report on: what it is called, and where its store is."""

    name: str
    store: Path

    @classmethod
    def of(cls, path: Path) -> ReportedSlice:
        """Return the slice in a folder, or at the path itself."""
        folder = path.parent if path.name in (SLICE_STORE, SLICE_FILE) else path
        return cls(folder.name or folder.resolve().name, store_in(path, SLICE_STORE))


def sample_subject(
    env: Environment, points: int, command: str, watch: Watch, *, features: bool = False
) -> ReportedSlice:
    """Sample the slice that a scene without any is reported on by: its first two parameters, through the centre.

    Raises TooLargeError for more points than a report has memory for, and as `SliceJob.run` does.
    """
    from .scene import plane_through
    from .slice import SliceJob, slice_work

    dims = list(range(min(2, env.space.dim)))
    refuse_too_many(points, len(dims), env.space.dim)
    plane = plane_through(env, dims, through="center", window=None, resolution=RESOLUTION)
    works = [slice_work(env, plane.resolution, 1), report_work(env, plane.resolution, points)]
    watch.plan([*works, features_work(env)] if features else works)
    job = SliceJob.of(env, plane, command=command)
    job.run(watch)
    return ReportedSlice.of(job.folder)


@dataclass(frozen=True)
class ReportJob:
    """Slices to measure: a `single` one into `folder`, several into folders of their own there.

    `points` along each axis are where gradients are tested by new evaluations; `paper` holds the paper's words by
    environment, and `prints` the widths of pages [mm] that a report is also drawn for.
    """

    subjects: Sequence[ReportedSlice]
    folder: Path
    single: bool
    points: int = POINTS
    seed: int = 0
    device: str = "auto"
    paper: Mapping[str, Quoted] = field(default_factory=dict)
    prints: Sequence[float] = ()
    command: str = ""
    env: Any = None  # of the slices, where it is not registered by their name for it
    features: bool = False  # whether features over all parameters are measured, too
    html: bool = False  # whether each report gets a page
    include: Sequence[str] = ()  # folders of runs and checks that a page shows

    @classmethod
    def open(
        cls,
        subjects: Sequence[ReportedSlice],
        *,
        what: str,
        single: bool,
        out: Path | None = None,
        root: Path = ROOT,
        points: int = POINTS,
        seed: int = 0,
        **how: Any,
    ) -> ReportJob:
        """Continue the reports in a folder, by default one under `root` named after `what`, or begin them there.

        Raises ValueError where the folder holds something else.
        """
        settings = {"points": points, "seed": seed}
        name = subjects[0].name if len(subjects) == 1 else what
        folder = out or folder_named(["report", name], [[str(one.store) for one in subjects], settings], root)
        _check(folder, single)
        return cls(subjects, folder, single, points, seed, **how)

    def run(self, watch: Watch | None = None) -> Reports:
        """Measure what is missing, write and return the reports: those on disk as they are, the others measured now.

        One that fails among several is left out, and named with what was wrong. Raises Stopped where it is interrupted,
        and DiskFullError; the same job then continues with the next slice. Raises ValueError where a single slice
        cannot be reported on, or where another report is there.
        """
        watch, done, failed = watch or Watch(), list[Report](), dict[str, str]()
        known = dict[str, Features]()
        watch.plan(self.work())

        def say_kept() -> str:
            return f"{len(done)} of {len(self.subjects)} reports are kept in {self._place(self.subjects[0]).parent}"

        with resumable(say_kept):
            for number, subject in enumerate(self.subjects):
                if len(self.subjects) > 1:
                    watch.note(f"slice {number + 1} of {len(self.subjects)}: {subject.name}")
                try:
                    report = self.report(subject, watch)
                    done.append(self._add_features(report, subject, known, watch) if self.features else report)
                except Exception as error:  # whatever one slice meets, the others are not lost by it
                    if is_full(error) or len(self.subjects) == 1:
                        raise
                    failed[subject.name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
                    watch.note(f"{subject.name} failed: {failed[subject.name]}")
            found = Reports(tuple(done), failed)
            if not self.single:
                write_json(self.folder / RECORD, to_json(found))
                with replacing(self.folder / TABLE) as partial:
                    partial.write_text(slices_markdown(found.reports))
        return found

    def work(self) -> Iterator[Work]:
        """Yield what measuring each slice takes that has no report yet."""
        known: dict[str, Environment] = {}
        bare: dict[str, Environment] = {}
        for subject in self.subjects:
            dataset, env, key = self._open(subject)
            env = known.setdefault(digest(env.identity()), env)
            held = [one for one in (self._place(subject), self._beside(subject)) if one and _holds(one, key)]
            if not held:
                yield report_work(env, dataset["loss"].shape, self.points)
            if self.features and not any(Report.read(one).features for one in held):
                bare[digest(env.identity())] = env
        yield from map(features_work, bare.values())

    def report(self, subject: ReportedSlice, watch: Watch) -> Report:
        """Return the report of a slice that is there, or else measure it now and leave it there."""
        folder = self._place(subject)
        report = replace(self._find(subject, folder, watch), folder=folder, store=subject.store)
        self._print(report, watch)
        if self.html:
            report.save(folder / PAGE, include=self.include, env=self._open(subject)[1], watch=watch)
        tidy(folder)
        return report

    def _add_features(self, report: Report, subject: ReportedSlice, known: dict[str, Features], watch: Watch) -> Report:
        """Return a report with the features of its environment, measured once for all of its slices."""
        folder = report.folder
        if report.features is not None or folder is None:
            return report
        _, env, _ = self._open(subject)
        name = digest(env.identity())
        if name not in known:
            known[name] = features_of(env, self.seed, watch)
        report = replace(report, features=known[name])
        write_record(folder / RECORD, to_json(report))
        return report

    def _open(self, subject: ReportedSlice) -> tuple[xr.Dataset, Environment, ReportKey]:
        """Return a slice, its environment, and what decides its report."""
        dataset = _open(subject)
        env = environment_of(dataset, self.device, self.env)
        return dataset, env, ReportKey(self.points, self.seed, digest_of(dataset), env.version_on(env.engine))

    def _place(self, subject: ReportedSlice) -> Path:
        return self.folder if self.single else self.folder / subject.name

    def _beside(self, subject: ReportedSlice) -> Path | None:
        """Return the folder of a slice, whose report may be copied; not without what it is drawn from for print."""
        folder = subject.store.parent
        return folder if not self.prints or (folder / ARRAYS).exists() else None

    def _find(self, subject: ReportedSlice, folder: Path, watch: Watch) -> Report:
        """Return a report that is there, or next to its slice, or else measure it."""
        dataset, env, key = self._open(subject)
        if (beside := self._beside(subject)) is not None:
            _fetch(beside, folder, key, watch)
        if (folder / RECORD).exists():
            return _keep(folder, key, env.device, watch)
        refuse_too_many(self.points, dataset["loss"].ndim, env.space.dim)
        _warn(subject, dataset, env, watch)
        return self._measure(subject, dataset, env, key, folder, watch)

    def _measure(
        self, subject: ReportedSlice, dataset: xr.Dataset, env: Environment, key: ReportKey, folder: Path, watch: Watch
    ) -> Report:
        from ..landscapes.measures.profile import own_cost

        require("number of samples", dataset["loss"].size, lambda count: Need(own_cost(count)[1]))
        verify_dataset(env, dataset, subject.store, todo=RESAMPLE)
        start = time.monotonic()
        profile = measure(env, dataset, self.points, self.seed, watch)
        profile = replace(profile, growth=measure_growth_of(env, dataset, watch))
        report = Report(
            name=subject.name,
            env=env.name,
            options=stored_identity(dataset)["options"],
            fidelity=env.fidelity.name,
            device=env.device,
            profile=profile,
            paper=_compare_words(profile, self.paper.get(env.name)),
            seconds=round(time.monotonic() - start, 3),
            command=self.command,
            key=key,
        )
        _leave(dataset, report, folder, watch)
        return report

    def _print(self, report: Report, watch: Watch) -> None:
        """Draw a report that is there for pages."""
        if not self.prints or report.folder is None:
            return
        from ..landscapes.draw.figures.page import save_prints

        draw = report.picture()
        printed = save_prints(lambda width: draw(width=width), report.folder / PICTURE, self.prints)
        watch.note(f"{report.folder}: {', '.join(printed)}")


def report_work(env: Environment, shape: tuple[int, ...], points: int) -> Work:
    """Return what measuring a slice evaluates at most, its growth with the horizon included, of shorter episodes."""
    from ..landscapes.measures.profile import effort

    losses, gradients = effort(len(shape), points, shape, len(env.replicas()))
    return Work(env, losses, gradients + growth_effort(env))


def measure(env: Environment, dataset: xr.Dataset, points: int, seed: int, watch: Watch) -> Profile:
    """Announce what measuring a slice of an environment costs, and measure it."""
    from ..landscapes.measures.profile import effort, measure_profile

    total = sum(effort(dataset["loss"].ndim, points, dataset["loss"].shape))
    _announce(env, dataset, points, watch)
    objective = BoxedObjective(env) if stored_identity(dataset).get("boxed") else env
    with watch.progress(total) as advance:
        counted = _Counted(objective, env.preferred_batch, advance)
        rounding = LAST_PLACE[env.fidelity.precision]
        found = measure_profile(counted, dataset, rounding=rounding, points=points, seed=seed, events=env.events)
        advance(total)
    return found


class _Counted(ObjectiveWrapper):
    """Evaluate an objective a batch at a time, and say how many rows are done."""

    def __init__(self, objective: Objective, batch: int, advance: Callable[[int], None]) -> None:
        super().__init__(objective)
        self.batch, self.advance, self.done = batch, advance, 0

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""
        parts = []
        for rows in torch.split(x, self.batch):
            parts.append(self.objective.evaluate(rows, grad=grad))
            self.done += len(rows)
            self.advance(self.done)
        return Evaluation.join(parts, dim=self.space.dim, grad=grad)


def refuse_too_many(points: int, rank: int, dim: int) -> None:
    """Raise TooLargeError for more points along each axis than this machine has memory for."""
    from ..landscapes.measures.profile import need_of

    require("points", points, lambda count: need_of(rank, dim, count))


def _announce(env: Environment, dataset: xr.Dataset, points: int, watch: Watch) -> None:
    """Say what a report takes: its episodes, and what is measured of the slice itself."""
    from ..landscapes.capacity import peak_memory
    from ..landscapes.measures.profile import need_of, own_cost

    rank = dataset["loss"].ndim
    work = report_work(env, dataset["loss"].shape, points)
    losses, gradients = work.losses, work.gradients
    own_seconds, own_bytes = own_cost(dataset["loss"].size)
    with watch.busy(f"{env.name}: {PREPARING}"):
        seconds = simulation_seconds(env, losses, gradients, losses + gradients)
    episodes = env.memory() * env.preferred_batch
    device = f", {size(episodes)} of GPU memory" if env.device == "cuda" else ""
    memory = peak_memory() + own_bytes + need_of(rank, env.space.dim, points).memory + (0 if device else episodes)
    watch.announce(
        f"{first_line(env.identity())}: up to {losses} episodes and {gradients} with gradients: "
        f"about {duration(seconds)}, plus {duration(own_seconds)} to measure {dataset['loss'].size} samples; "
        f"{size(memory)} of memory{device}",
        seconds + own_seconds,
    )


def _open(subject: ReportedSlice) -> xr.Dataset:
    """Read a slice that can be reported on; raise ValueError for one that cannot."""
    from ..landscapes.lattice import sampled_lattice
    from ..landscapes.storage.floor_map import open_floor_map, with_map
    from ..landscapes.storage.paths import is_finished
    from ..landscapes.storage.store import open_slice

    dataset = open_slice(subject.store)
    dataset = with_map(dataset, open_floor_map(subject.store, dataset))
    if "grad" not in dataset or min(dataset["loss"].shape) < 3:
        got = " x ".join(map(str, dataset["loss"].shape)) + " samples" + " without gradients" * ("grad" not in dataset)
        raise ValueError(
            f"report takes a slice with gradients and at least three samples per axis; {subject.name} has {got}"
        )
    missing = int((dataset["status"] == 0).sum())
    if missing or not is_finished(subject.store):
        raise ValueError(
            f"{subject.store} is not finished: {missing} of {dataset['status'].size} samples are missing or damaged; "
            "first run the command again that samples the slice"
        )
    return sampled_lattice(dataset)


def _warn(subject: ReportedSlice, dataset: xr.Dataset, env: Environment, watch: Watch) -> None:
    theirs, ours = stored_identity(dataset), env.identity()
    differ = [name for name in (MODEL_VERSION, "device") if theirs.get(name) != ours[name]]
    if differ:
        said = "; ".join(f"{name} {theirs.get(name)} then, {ours[name]} now" for name in differ)
        watch.note(f"warning: {subject.name} was sampled differently ({said}), so losses may differ")


def growth_effort(env: Environment) -> int:
    """Return how many gradients of shorter and whole episodes `measure_growth_of` evaluates."""
    return len(HORIZONS) * GROWTH_POINTS if env.horizon else 0


def measure_growth_of(env: Environment, dataset: xr.Dataset, watch: Watch) -> GradientGrowth | None:
    """Measure how gradients grow with the length of episodes at points of a slice.

    None where no setting says how long episodes are. Where a scene draws none, time is in the unit of that setting.
    """
    from ..landscapes.measures.gradient_quality import subgrid
    from ..landscapes.measures.lyapunov import measure_growth

    if not env.horizon:
        return None
    time = env.horizon
    with contextlib.suppress(ValueError):  # nothing to draw
        time = float(env.episode(env.space.center).time[-1])
    plane = plane_of(dataset)
    x = plane.lift(subgrid(plane, math.isqrt(GROWTH_POINTS) if plane.rank == 2 else GROWTH_POINTS))
    boxed = bool(stored_identity(dataset).get("boxed"))
    width, norms = env.space.upper - env.space.lower, list[Tensor]()
    with watch.progress(growth_effort(env), "gradients of shorter episodes") as advance:
        for share in HORIZONS:
            other = env.with_horizon(share * env.horizon)
            found = evaluate(BoxedObjective(other) if boxed else other, x, grad=True)
            assert found.grad is not None
            norms.append((found.grad * width).norm(dim=1))
            advance(len(norms) * len(x))
    return measure_growth(time * np.array(HORIZONS), torch.stack(norms).numpy())


def _compare_words(profile: Profile, said: Quoted | None) -> PaperWords | None:
    return None if said is None else PaperWords(profile.verdict.compare_words(said.words), said.where)


def _leave(dataset: xr.Dataset, report: Report, folder: Path, watch: Watch) -> None:
    """Write a report's files."""
    import xarray as xr

    from ..landscapes.draw.figures.page import save
    from ..landscapes.draw.figures.quality import quality_figure
    from ..landscapes.storage.records import save_bundle

    fuzz, quality = report.profile.noise, report.profile.quality
    assert fuzz is not None  # measured just now
    assert quality is not None
    noise = xr.Dataset({"deviation": fuzz.deviation})
    save_bundle(folder / ARRAYS, steps=quality.steps, smooth=quality.smooth, noise=noise)
    save(quality_figure(dataset, quality), folder / PICTURE)
    _leave_measures(folder, report)
    write_record(folder / RECORD, to_json(report))


def _leave_measures(folder: Path, report: Report) -> None:
    """Write the report's numbers by their names, unless the same are there."""
    with contextlib.suppress(OSError, TypeError, ValueError):  # not there, or damaged
        if read_json(folder / MEASURES) == report.measures:
            return
    write_record(folder / MEASURES, report.measures)


def _holds(folder: Path, key: ReportKey) -> bool:
    """Whether a folder holds this report."""
    files = (folder / name for name in (PICTURE, MEASURES, RECORD))
    return all(file.exists() for file in files) and not _differences(Report.read(folder / RECORD).key, key)


def _fetch(source: Path, folder: Path, key: ReportKey, watch: Watch) -> None:
    """Copy the same report from next to its slice, where the gallery has it, rather than measure again."""
    files = [source / name for name in (PICTURE, MEASURES, RECORD)]
    if not (folder / RECORD).exists() and _holds(source, key):
        make_folder(folder)
        for file in [*files, *source.glob(ARRAYS)]:
            with replacing(folder / file.name) as partial:
                shutil.copyfile(file, partial)
        watch.note(f"{folder}: the report is copied from {source}")


def _keep(folder: Path, key: ReportKey, device: str, watch: Watch) -> Report:
    """Return the report that is there, on whatever device it was measured; raise ValueError where it is another."""
    kept = Report.read(folder / RECORD)
    if differences := _differences(kept.key, key):
        raise ValueError(f"{folder} contains another report ({differences}); write elsewhere with --out, or delete it")
    _leave_measures(folder, kept)
    elsewhere = f", measured on {kept.device}" if kept.device != device else ""
    watch.note(f"{folder}: the report exists already{elsewhere}")
    if (theirs := kept.key.model_version) != (ours := key.model_version):
        said = f"{kept.env} model {theirs}; this is model {ours}"
        watch.note(f"warning: the report was measured by {said}. Delete the folder to measure it again")
    return kept


def _differences(theirs: ReportKey, ours: ReportKey) -> str:
    """Say in what two reports differ, nothing where slice and settings are the same, whatever the model's version."""
    differ = {name: (getattr(theirs, name), one) for name, one in vars(ours).items() if getattr(theirs, name) != one}
    if set(differ) <= {MODEL_VERSION}:
        return ""
    return ", ".join(f"{name} {there} there, {here} now" for name, (there, here) in differ.items())


def _check(folder: Path, single: bool) -> None:
    """Raise ValueError where a folder holds anything but reports."""
    if single:
        REPORT.check(folder)
        return
    _check_summary(folder)
    REPORTS.check(folder, (file for file in other_files(folder, REPORTS.files, "") if (file / PICTURE).exists()))


def _check_summary(folder: Path) -> None:
    """Raise ValueError for a summary of several reports that is none of ours, as a table without one is not either."""
    path = folder / RECORD
    if not path.exists() and not (folder / TABLE).exists():
        return
    try:
        ours = {"reports", "environments"} <= json.loads(path.read_text()).keys()
    except (OSError, ValueError, AttributeError):
        ours = False
    if not ours:
        raise ValueError(
            f"{path} is missing, damaged or not a summary of several slices, so report does not replace it or {TABLE}; "
            "move both away, or give --out a new or an empty folder"
        )


class Quoted(Protocol):
    """The paper's words for an environment's landscape, from `verdict.WORDS`, and where the paper uses them."""

    @property
    def words(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def where(self) -> str: ...  # noqa: D102


@dataclass(frozen=True)
class PaperWords:
    """The paper's words for a landscape, and where the paper uses them."""

    words: tuple[QuotedWord, ...]
    where: str


@dataclass(frozen=True)
class ReportKey:
    """What decides a report: its settings, the digest of the slice, and the version of the scene's model."""

    points: int
    seed: int
    slice: str
    model_version: int


@dataclass(frozen=True)
class Report:
    """Record the measures of a slice, as in `report.json`.

    `paper` contains the paper's words for the scene, None if it has none. `seconds` is the time of the measurement.
    `features` are those over all parameters, None unless requested. `folder` contains the report's files, and `store`
    is the slice's store.
    """

    name: str
    env: str
    options: dict[str, Any]
    fidelity: str
    device: str
    profile: Profile
    paper: PaperWords | None
    seconds: float
    command: str
    key: ReportKey
    features: Features | None = None
    folder: Path | None = field(default=None, metadata=NOT_JSON, compare=False, repr=False)
    store: Path | None = field(default=None, metadata=NOT_JSON, compare=False, repr=False)

    @classmethod
    def read(cls, path: Path) -> Report:
        """Read `report.json`, by its path or its folder.

        Raises DamagedError, which names the file and says what to do, if it cannot be read completely, and
        FileNotFoundError if there is none.
        """
        path = path / RECORD if path.is_dir() else path
        with reading(path, "delete it, and the same command measures the slice again"):
            return replace(from_json(cls, read_json(path)), folder=path.parent)

    @property
    def words(self) -> tuple[str, ...]:
        """The words for the landscape."""
        return self.profile.words

    @property
    def measures(self) -> dict[str, str]:
        """The main numbers by short names, with 95 % intervals, as a page shows them."""
        return self.profile.measures

    def verdict_lines(self) -> list[str]:
        """Return each word with its reason, what is not resolved, and which of the paper's words were measured."""
        verdict = self.profile.verdict
        lines = [f"{word}: {verdict.reasons[word]}" for word in self.words]
        lines += [*verdict.open, *verdict.lines]
        if self.paper:
            said = "; ".join(f"{one.word}: {one.answer}" for one in self.paper.words)
            lines.append(f"the paper's words ({self.paper.where}), measured too? {said}")
        return lines

    def table(self) -> pd.DataFrame:
        """Return a table of the main numbers, indexed by `measure`, with the column `value` as text."""
        import pandas as pd

        return pd.DataFrame({"value": self.measures}).rename_axis("measure")

    def plot(self, width: float | None = None) -> Picture:
        """Draw gradient quality over the slice, for a screen, or for print with this `width` [mm].

        Raises ValueError if its files do not contain the data of the picture.
        """
        return self.picture()(width=width)

    def picture(self) -> Callable[..., Picture]:
        """Read the data of the picture, and return a function that draws it. Raises ValueError as `plot` does."""
        from ..landscapes.draw.figures.quality import quality_figure
        from ..landscapes.lattice import sampled_lattice
        from ..landscapes.measures.gradient_quality import GradientQuality, compare_samples
        from ..landscapes.storage.records import open_bundle
        from ..landscapes.storage.store import open_slice

        if self.folder is None or self.store is None or not (self.folder / ARRAYS).exists():
            raise ValueError(
                f"{self.folder} is an older report without {ARRAYS}, which the picture needs; delete it to measure it "
                "again"
            )
        dataset, kept = sampled_lattice(open_slice(self.store)), open_bundle(self.folder / ARRAYS)
        samples = compare_samples(dataset, deviation=float(np.nan_to_num(kept["noise"]["deviation"])))
        return partial(quality_figure, dataset, GradientQuality(kept["steps"], samples, kept["smooth"]))

    def save(
        self, path: str | Path, *, include: Sequence[str | Path] = (), env: Environment | None = None,
        watch: Watch | None = None,
    ) -> Path:  # fmt: skip
        """Write a page about the landscape, one file that needs no network, and return its path.

        `include` are folders of runs, races and checks that the page also shows. With the environment, `env`, it shows
        the episodes at the lowest and the highest loss, if there are episodes to draw.

        Raises ValueError if the slice is not on disk, if a folder contains none of these, or if a run searched other
        parameters.
        """
        from .report_page import save_page

        save_page(self, Path(path), include=include, env=env, watch=watch)
        return Path(path)

    def _repr_html_(self) -> str:
        """Show words and numbers in a notebook."""
        from html import escape

        lines = "".join(f"<li>{escape(line)}</li>" for line in self.verdict_lines())
        return f"<p>{escape(self.name)} ({escape(self.env)})</p><ul>{lines}</ul>{self.table().to_html()}"


@dataclass(frozen=True)
class Reports:
    """Record the reports of several slices, in order, and the reasons why others failed, by name."""

    derived: ClassVar = ("environments",)

    reports: tuple[Report, ...]
    failed: dict[str, str]

    @property
    def environments(self) -> dict[str, EnvironmentCounts]:
        """The words of the slices of each environment, counted."""
        return by_environment(self.reports)


@dataclass
class EnvironmentCounts:
    """The number of `slices` of an environment in which each word was `measured`, and each word of the `paper`.

    `unresolved` counts the slices in which a word of the paper is not resolved.
    """

    slices: int = 0
    measured: dict[str, int] = field(default_factory=dict)
    paper: dict[str, int] = field(default_factory=dict)
    unresolved: dict[str, int] = field(default_factory=dict)

    def quoted(self) -> str:
        """Return the paper's words, and in how many of the slices that tell they were measured."""
        return ", ".join(_of(word, hits, self.slices, self.unresolved[word]) for word, hits in self.paper.items())

    def agreement(self) -> str:
        """Say whether all of the paper's words were measured in all slices, none in any, or some."""
        told = [(hits, self.slices - self.unresolved[word]) for word, hits in self.paper.items()]
        if not told or not any(of for _, of in told):
            return "not resolved" if told else ""
        if not any(hits for hits, _ in told):
            return "no"
        return "yes" if all(hits == self.slices for hits, _ in told) else "in part"


def by_environment(reports: Sequence[Report]) -> dict[str, EnvironmentCounts]:
    """Count by environment in how many of its slices each word was measured, and each of the paper's."""
    found: dict[str, EnvironmentCounts] = {}
    for report in reports:
        entry = found.setdefault(report.env, EnvironmentCounts())
        entry.slices += 1
        for word in report.words:
            entry.measured[word] = entry.measured.get(word, 0) + 1
        for one in report.paper.words if report.paper else ():
            entry.paper[one.word] = entry.paper.get(one.word, 0) + bool(one.measured)
            entry.unresolved[one.word] = entry.unresolved.get(one.word, 0) + (one.measured is None)
    return found


def slice_rows(reports: Sequence[Report]) -> list[tuple[str, ...]]:
    """Return a row for each slice, under `HEADINGS`."""
    return [_slice(report) for report in reports]


def slices_markdown(reports: Sequence[Report]) -> str:
    """Return a row for each slice, as Markdown."""
    return markdown(HEADINGS, slice_rows(reports))


def environments_markdown(reports: Sequence[Report]) -> str:
    """Return a row for each environment, as Markdown: the least and the most of its slices, and the words."""
    groups = groupby(reports, key=lambda report: report.env)
    return markdown(ENVIRONMENTS, (_environment(env, list(group)) for env, group in groups))


def _environment(env: str, reports: Sequence[Report]) -> tuple[str, ...]:
    from ..landscapes.measures.verdict import WORDS

    words, count = by_environment(reports)[env], len(reports)
    measured = [_of(word, words.measured[word], count) for word in WORDS if word in words.measured]
    verdicts = [report.profile.verdict for report in reports]
    return (
        f"`{env}`",
        str(count),
        _span([_value(one.surface.minima) for one in verdicts], "{:.0f}"),
        _span([_turns(one) for one in verdicts], "{:.1f}"),
        _span([None if one.jumps is None else 100 * one.jumps.largest for one in verdicts], "{:.2g} %"),
        *(_span([_cosine(one, scale) for one in verdicts], "{:z.2f}") for scale in SCALES[1:]),
        ", ".join(measured),
        words.quoted(),
        words.agreement(),
    )


def _turns(verdict: Verdict) -> float | None:
    """Return how often lines along an axis turn back, of the axis along which they do most."""
    known = [one.value for one in verdict.surface.turns if math.isfinite(one.value)]
    return max(known, default=None)


def _cosine(verdict: Verdict, scale: float) -> float | None:
    at = None if verdict.following is None else verdict.following.at(scale)
    return None if at is None else _value(at.cosine)


def _value(estimate: Estimate) -> float | None:
    return estimate.value if math.isfinite(estimate.value) else None


def _span(values: Iterable[float | None], form: str) -> str:
    """Write the least and the most of what is known."""
    known = sorted(value for value in values if value is not None)
    if not known:
        return ""
    low, high = (form.format(end).replace("-", "\N{MINUS SIGN}") for end in (known[0], known[-1]))
    return high if low == high else f"{low.removesuffix(' %')} to {high}"


def _of(word: str, hits: int, count: int, unresolved: int = 0) -> str:
    """Write a word, and of how many slices it is true where these are not all."""
    if hits == count:
        return word
    if unresolved == count:
        return f"{word} (not resolved)"
    return f"{word} ({hits} of {count}{f', {unresolved} not resolved' if unresolved else ''})"


def _slice(report: Report) -> tuple[str, ...]:
    verdict = report.profile.verdict
    words = report.paper.words if report.paper else ()
    hits = sum(one.measured is True for one in words)
    return (
        report.name,
        _span([_value(verdict.surface.minima)], "{:.0f}"),
        _span([_turns(verdict)], "{:.1f}"),
        "" if verdict.jumps is None else _span([100 * verdict.jumps.largest], "{:.2g} %"),
        _span([_cosine(verdict, CHIEF)], "{:z.2f}"),
        ", ".join(report.words),
        ", ".join(one.word for one in words),
        f"{hits} of {len(words)}" if words else "",
    )


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [headings, ("---",) * len(headings), *rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in lines)
