"""What `landscape report` does and prints: what landscapes are like, in numbers and in words, beside the paper's."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..envs.registry import environment_class, make
from ..gallery.figures import data_folder, read_figures
from ..jobs.folder import SLICE_STORE as SLICE
from ..jobs.folder import store_in as inside
from ..jobs.kept_reports import (
    ARRAYS,
    MEASURES,
    PICTURE,
    REPORT,
    TABLE,
    check_summary,
    fetch,
    kept_report,
    leave_measures,
    verdict_lines,
)
from ..jobs.scene import environment_of
from ..landscapes.capacity import Need, require, size
from ..landscapes.cost import duration
from ..landscapes.identity import stored_identity
from ..landscapes.storage.disk import full, is_full
from ..landscapes.storage.files import other_files, replacing, tidy, write_json
from ..landscapes.storage.records import write_record
from .console import fill
from .measure_tables import by_environment, slices_markdown, slices_table
from .terminal import Console, Described, table

if TYPE_CHECKING:
    import xarray as xr
    from torch import Tensor

    from ..envs.base import Environment
    from ..gallery.words import Said
    from ..landscapes.measures.profile import Character
    from ..landscapes.objective import Evaluation, Objective

PRECISION = {"float32": 2.0**-23, "float64": 2.0**-52}
RESOLUTION = 24  # points per axis of a slice that is sampled for its report
TRIAL = 32  # most episodes that are timed beforehand


@dataclass(frozen=True)
class Subject:
    """A slice to report on: what it is called, and where its store is."""

    name: str
    store: Path


def report(
    what: str | None,
    *,
    source: str | None,
    everything: bool,
    fidelity: str | None,
    device: str,
    points: int,
    seed: int,
    data: str | None,
    out: str | None,
    as_json: bool,
    prints: Sequence[float] = (),
) -> None:
    """Measure slices, say what it costs, print the numbers and leave them in files."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    if source:
        environment_class(source)  # which registers it
    if (what is None) != everything:
        raise ValueError("report takes a slice's folder, an environment, or --all for every figure of the gallery")
    root = data_folder(data)
    subjects = _all(root) if what is None else _subjects(console, what, root, fidelity, device, points)
    settings = {"points": points, "seed": seed}
    folder = Path(out) if out else Path("out") / _folder_name(what or "all", subjects, settings)
    single = len(subjects) == 1 and what is not None
    _check(folder, single)
    places = [folder if single else folder / subject.name for subject in subjects]
    records, failed = _measured(console, subjects, places, settings, device, prints)
    if single:
        _show(records[0], as_json, folder)
        return
    summary = {"reports": records, "environments": by_environment(records), "failed": failed}
    write_json(folder / REPORT, summary)
    with replacing(folder / TABLE) as partial:
        partial.write_text(slices_markdown(records))
    console.print(f"{folder}: {REPORT}, {TABLE}, and a folder of each slice", markup=False)
    if as_json:
        print(json.dumps({**summary, "folder": str(folder)}))
    else:
        Console().print(slices_table(records))
    for name, why in failed.items():
        console.print(f"not reported: {name}: {why}", markup=False)
    if failed:
        sys.exit(1)


def _all(root: Path) -> list[Subject]:
    found = [Subject(figure.id, root / figure.id / SLICE) for figure in read_figures()]
    there = [subject for subject in found if _finished(subject.store)]
    if not there:
        raise ValueError(f"{root} holds no figures yet; `landscape gallery compute` samples them")
    return there


def _subjects(console: Console, what: str, root: Path, fidelity: str | None, device: str, points: int) -> list[Subject]:
    """Return a slice, or an environment's figures, or a slice sampled now for want of any."""
    path = Path(what)
    if path.exists():
        return [Subject(path.parent.name if path.name == SLICE else path.name, inside(path, SLICE))]
    environment_class(what)  # refuses a name that does not exist, with those that come close
    figures = [figure for figure in read_figures() if figure.env == what and fidelity in (None, figure.fidelity)]
    there = [Subject(figure.id, root / figure.id / SLICE) for figure in figures]
    if found := [subject for subject in there if _finished(subject.store)]:
        return found
    env = make(what, fidelity=fidelity, device=device)
    from ..landscapes.plane import Plane

    plane = Plane.through(env.space, env.space.center, list(range(min(2, env.space.dim))), resolution=RESOLUTION)
    refuse_too_many(points, plane.rank, env.space.dim)
    sampled, _ = fill(console, env, plane)
    return [Subject(sampled.name, sampled / SLICE)]


def _finished(store: Path) -> bool:
    from ..landscapes.storage.paths import is_slice
    from ..landscapes.storage.store import SliceStore

    return is_slice(store) and not SliceStore.open(store).pending()


def _measured(
    console: Console,
    subjects: Sequence[Subject],
    places: Sequence[Path],
    settings: dict[str, Any],
    device: str,
    prints: Sequence[float],
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return a record of each slice, in the order given: those on disk as they are, the others measured now.

    One that fails among several is left out, and returned by name with what was wrong.
    """
    from ..gallery.words import paper_words

    records: list[dict[str, Any]] = []
    failed: dict[str, str] = {}

    def kept() -> str:
        return f"{len(records)} of {len(subjects)} reports are kept in {places[0].parent}"

    for number, (subject, folder) in enumerate(zip(subjects, places, strict=True)):
        if len(subjects) > 1:
            console.print(f"slice {number + 1} of {len(subjects)}: {subject.name}", markup=False)
        try:
            records.append(measured(console, subject, folder, settings, device, paper_words(), drawn=bool(prints)))
            _print(console, subject, folder, prints)
            tidy(folder)
        except KeyboardInterrupt:
            again = shlex.join(["landscape", *sys.argv[1:]])
            console.print(f"stopped: {kept()}; the same command goes on with the next: {again}", markup=False)
            sys.exit(130)
        except Exception as error:  # whatever one slice meets, the others are not lost by it
            if is_full(error):
                raise full(error, kept()) from error
            if len(subjects) == 1:
                raise
            failed[subject.name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
            console.print(f"{subject.name} failed: {failed[subject.name]}", markup=False)
    return records, failed


def measured(
    console: Console,
    subject: Subject,
    folder: Path,
    settings: dict[str, Any],
    device: str,
    said: dict[str, Said],
    *,
    drawn: bool = False,
) -> dict[str, Any]:
    """Return the record of a slice that is in `folder`, or else is measured now and left there.

    One that is to be `drawn` is not taken from beside the slice without what it is drawn from.
    """
    from ..landscapes.measures.profile import own_cost
    from ..landscapes.storage.store import open_slice

    dataset = open_slice(subject.store)
    if "grad" not in dataset or min(dataset["loss"].shape) < 3:
        raise ValueError(f"{subject.name}: report needs a slice with gradients and three samples per axis; got another")
    if missing := int((dataset["status"] == 0).sum()):
        raise ValueError(
            f"{subject.store}: {missing} of {dataset['status'].size} samples are missing or damaged; let the command "
            "that samples the slice go on first"
        )
    env = environment_of(dataset, device)
    key = {**settings, "slice": digest(dataset), "code": env.code}
    if not drawn or (subject.store.parent / ARRAYS).exists():
        fetch(console, subject.store.parent, folder, key)
    if (folder / REPORT).exists():
        return kept_report(console, folder, key, env.device)
    refuse_too_many(settings["points"], dataset["loss"].ndim, env.space.dim)
    require("number of samples", dataset["loss"].size, lambda count: Need(own_cost(count)[1]))
    _warn(console, subject, dataset, env)
    start = time.monotonic()
    character = _character(console, env, dataset, settings)
    record = {
        "name": subject.name,
        "env": env.name,
        "options": stored_identity(dataset)["options"],
        "fidelity": env.fidelity.name,
        "device": env.device,
        **character.record(),
        "paper": _beside(character, said.get(env.name)),
        "seconds": round(time.monotonic() - start, 3),
        "command": shlex.join(["landscape", *sys.argv[1:]]),
        "key": key,
    }
    _leave(console, dataset, character, record, folder)
    return record


def _character(console: Console, env: Environment, dataset: xr.Dataset, settings: dict[str, Any]) -> Character:
    """Measure a slice under a progress bar, its cost announced."""
    from ..landscapes.adapters import within_box
    from ..landscapes.measures.profile import characterise, effort

    total = sum(effort(dataset["loss"].ndim, settings["points"]))
    _announce(console, env, dataset, settings["points"])
    columns = (Described(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    objective = within_box(env) if stored_identity(dataset).get("boxed") else env
    with Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=console) as bar:
        task = bar.add_task("episodes", total=total)
        counted = _Counted(objective, env.preferred_batch, lambda rows: bar.advance(task, rows))
        found = characterise(
            counted, dataset, rounding=PRECISION[env.fidelity.precision], events=env.events, **settings
        )
        bar.update(task, completed=total)
    return found


class _Counted:
    """Evaluate an objective a batch at a time, and say how many rows are done."""

    def __init__(self, objective: Objective, batch: int, advance: Any) -> None:
        self.objective, self.space, self.batch, self.advance = objective, objective.space, batch, advance
        self.beyond_box = getattr(objective, "beyond_box", False)
        self.name = getattr(objective, "name", type(objective).__name__)

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""
        import torch

        from ..landscapes.objective import Evaluation

        parts = []
        for rows in torch.split(x, self.batch):
            parts.append(self.objective.evaluate(rows, grad=grad))
            self.advance(len(rows))
        if not parts:
            return Evaluation.empty(self.space.dim, grad=grad)
        slopes = torch.cat([part.grad for part in parts if part.grad is not None]) if grad else None
        return Evaluation(torch.cat([p.loss for p in parts]), slopes, torch.cat([p.status for p in parts]))


def refuse_too_many(points: int, rank: int, dim: int) -> None:
    """Refuse more points along each axis than this machine has memory for."""
    from ..landscapes.measures.profile import need_of

    require("points", points, lambda count: need_of(rank, dim, count))


def _announce(console: Console, env: Environment, dataset: xr.Dataset, points: int) -> None:
    """Say what a report takes: its episodes, and what is measured of the slice itself."""
    from ..jobs.slice import peak_memory
    from ..landscapes.measures.profile import effort, need_of, own_cost

    rank = dataset["loss"].ndim
    losses, gradients = effort(rank, points)
    own_seconds, own_bytes = own_cost(dataset["loss"].size)
    with console.status(f"{env.name}: preparing (kernels are compiled once, then kept)"):
        env.prepare()
        seconds = seconds_of(env, losses, gradients)
    episodes = env.memory() * env.preferred_batch
    device = f", {size(episodes)} of the GPU's" if env.device == "cuda" else ""
    memory = peak_memory() + own_bytes + need_of(rank, env.space.dim, points).memory + (0 if device else episodes)
    console.print(
        f"{env.name} · {env.fidelity.name} · {env.device}: up to {losses} episodes and {gradients} with gradients: "
        f"about {duration(seconds)}, and {duration(own_seconds)} to measure {dataset['loss'].size} samples; "
        f"{size(memory)} of memory{device}",
        markup=False,
    )


def seconds_of(env: Environment, losses: int, gradients: int) -> float:
    """Estimate the seconds of so many episodes without and with gradient."""
    return sum(count * _rate(env, grad) for grad, count in ((False, losses), (True, gradients)))


def _rate(env: Environment, grad: bool) -> float:
    """Return seconds per episode: of one, or of a batch where one is quick."""
    for count in (1, min(env.preferred_batch, TRIAL)):
        x = env.space.uniform(count, seed=0)
        start = time.perf_counter()
        env.evaluate(x, grad=grad)
        seconds = (time.perf_counter() - start) / count
        if seconds > 1:
            return seconds / env.threads
    return seconds


def _warn(console: Console, subject: Subject, dataset: xr.Dataset, env: Environment) -> None:
    theirs, ours = stored_identity(dataset), env.identity()
    differ = [name for name in ("code", "device") if theirs.get(name) != ours[name]]
    if differ:
        said = "; ".join(f"{name} {theirs.get(name)} there, {ours[name]} here" for name in differ)
        console.print(f"warning: {subject.name} was sampled otherwise ({said}), so losses may differ", markup=False)


def _beside(character: Character, said: Said | None) -> dict[str, Any] | None:
    if said is None:
        return None
    return {"words": character.verdict.beside(said.words), "where": said.where}


def _leave(console: Console, dataset: xr.Dataset, character: Character, record: dict[str, Any], folder: Path) -> None:
    import xarray as xr

    from ..landscapes.draw.figures.page import save
    from ..landscapes.draw.figures.quality import quality_figure
    from ..landscapes.storage.bundle import save_bundle

    noise = xr.Dataset({"deviation": character.noise.deviation})
    save_bundle(folder / ARRAYS, steps=character.steps, smooth=character.smooth, noise=noise)
    save(quality_figure(dataset, character.steps, character.samples, character.smooth), folder / PICTURE)
    leave_measures(folder, record)
    write_record(folder / REPORT, record)
    console.print(f"{folder}: {REPORT}, {MEASURES}, {PICTURE}, {ARRAYS}", markup=False)


def _print(console: Console, subject: Subject, folder: Path, prints: Sequence[float]) -> None:
    """Draw a report that is there for pages so wide [mm]."""
    if not prints:
        return
    if not (folder / ARRAYS).exists():
        raise ValueError(
            f"{folder} is a report from before {ARRAYS} was kept to draw from; delete it to measure it anew"
        )
    import numpy as np

    from ..landscapes.draw.figures.page import save_prints
    from ..landscapes.draw.figures.quality import quality_figure
    from ..landscapes.measures.gradient_quality import compare_samples
    from ..landscapes.storage.bundle import open_bundle
    from ..landscapes.storage.store import open_slice

    dataset, kept = open_slice(subject.store), open_bundle(folder / ARRAYS)
    samples = compare_samples(dataset, deviation=float(np.nan_to_num(kept["noise"]["deviation"])))
    draw = partial(quality_figure, dataset, kept["steps"], samples, kept["smooth"])
    printed = save_prints(lambda width: draw(width=width), folder / PICTURE, prints)
    console.print(f"{folder}: {', '.join(printed)}", markup=False)


def digest(dataset: xr.Dataset) -> str:
    """Return what a slice is known by in its report."""
    text = json.dumps(stored_identity(dataset), sort_keys=True).encode()
    return hashlib.sha256(text + dataset["loss"].to_numpy().tobytes()).hexdigest()[:12]


def _folder_name(what: str, subjects: Sequence[Subject], settings: dict[str, Any]) -> str:
    name = subjects[0].name if len(subjects) == 1 else Path(what).name
    text = json.dumps([[str(subject.store) for subject in subjects], settings], sort_keys=True)
    return f"report-{name}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def _check(folder: Path, single: bool) -> None:
    """Refuse a folder that holds anything but reports."""
    ours = {REPORT, MEASURES, PICTURE, ARRAYS} if single else {REPORT, TABLE}
    if not single:
        check_summary(folder)
    if any(single or not (file / PICTURE).exists() for file in other_files(folder, ours, PICTURE)):
        raise ValueError(f"{folder} holds other files; give --out a new or an empty folder")


def _show(record: dict[str, Any], as_json: bool, folder: Path) -> None:
    """Print one slice's measures and verdict."""
    if as_json:
        print(json.dumps({**record, "folder": str(folder)}))
        return
    from ..landscapes.measures.profile import named_measures

    console = Console(highlight=False)
    found = table("measure", "value, 95 % interval", title=f"{record['name']} ({record['env']})")
    for name, text in named_measures(record).items():
        found.add_row(name, text)
    console.print(found)
    for line in verdict_lines(record):
        console.print(line, markup=False)
