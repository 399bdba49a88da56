"""What `landscape tradeoff` does and prints: the cost, progress by rung, then a table, a picture and a file."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TimeElapsedColumn

from ..envs.registry import environment_class, make
from ..jobs.scene import provenance as provenance_of
from ..jobs.tolerance import keep
from ..landscapes.capacity import Need, require, size
from ..landscapes.cost import duration
from .arguments import read_settings
from .terminal import Console, Described, table

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment
    from ..jobs.variants import Rung
    from ..landscapes.measures.fidelity import Sample
    from ..landscapes.storage.checkpoint import Checkpoint

COPIES = 50  # of the points: a loss and a gradient there by every rung
RECORD, PICTURE = "tradeoff.json", "tradeoff.png"


def tradeoff(
    name: str,
    *,
    points: int,
    seed: int,
    device: str,
    engine: str,
    ladders: Sequence[str],
    settings: Sequence[str],
    out: str | None,
    as_json: bool,
    force: bool,
    prints: Sequence[float] = (),
) -> None:
    """Measure every rung against the reference, keep what was found for --tolerance, and show it."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    fidelities = environment_class(name).fidelities
    env = make(name, fidelity=list(fidelities)[-1], device=device, engine=engine, **read_settings(settings))
    from ..jobs.variants import refuse_single
    from ..landscapes.storage.disk import until_full

    refuse_single(env)
    require("points", points, lambda count: Need(8.0 * COPIES * (1 + env.space.dim) * count))
    study = Study.open(env, points=points, seed=seed, ladders=ladders, out=out, force=force)
    try:
        with until_full(study.kept):
            study.announce(console)
            report = study.run(console)
            printed = study.print(report, prints)
            kept = keep(report)
    except KeyboardInterrupt:
        said = f"stopped: {study.kept()}; the same command goes on from there: {study.command}"
        console.print(said, markup=False)
        sys.exit(130)
    show(report, Console(stderr=as_json))
    files = ", ".join([PICTURE, *printed, RECORD])
    console.print(f"{study.pieces.folder}: {files}; kept for --tolerance: {kept}", markup=False)
    if as_json:
        print(json.dumps({**report, "folder": str(study.pieces.folder)}))


@dataclass(frozen=True)
class Study:
    """The rungs of a scene to measure at the same points, one piece each."""

    env: Environment
    rungs: list[Rung]
    x: Tensor
    seed: int
    pieces: Checkpoint
    refused: dict[str, str]
    command: str

    @classmethod
    def open(
        cls, env: Environment, *, points: int, seed: int, ladders: Sequence[str], out: str | None, force: bool
    ) -> Study:
        """Go on with the study in its folder, or begin it there."""
        from ..jobs.variants import LADDERS, rungs
        from ..landscapes.measures.fidelity import sobol_points
        from ..landscapes.storage.checkpoint import Checkpoint

        chosen = [part for text in ladders for part in text.split(",") if part] or list(LADDERS)
        found = rungs(env, chosen)
        identity = {**env.identity(), "points": points, "seed": seed}
        digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:6]
        folder = Path(out) if out else Path("out") / f"tradeoff-{env.name}-{points}-{digest}"
        pieces = Checkpoint.open(folder, identity, what="tradeoff", force=force)
        x = sobol_points(env.space, points, seed=seed)
        command = shlex.join(["landscape", *sys.argv[1:]])
        return cls(env, found, x, seed, pieces, {}, command)

    def announce(self, console: Console) -> None:
        """Say what is left to measure and about how long that takes, from the cheapest fidelity's time for its work."""
        left = self.left()
        kept = f", {len(self.rungs) - len(left)} are there already" if len(left) < len(self.rungs) else ""
        where = f"{self.env.name} · {self.env.device} · {self.env.engine} · {self.pieces.folder}"
        console.print(f"{where}\n{len(left)} rungs to measure at {len(self.x)} points{kept}", markup=False)
        if not left:
            return
        with console.status(f"{self.env.name}: preparing (kernels are compiled once, then kept)"):
            seconds = self.estimate()
        dearest = max(seconds, key=lambda name: seconds[name])
        first = f"{duration(seconds[dearest])} of it {dearest}, " if len(seconds) > 1 else ""
        console.print(
            f"about {duration(sum(seconds.values()))}, {first}by the work of an episode; compiling kernels comes on "
            "top, minutes for taichi; --points and --ladder lower it",
            markup=False,
        )

    def left(self) -> list[Rung]:
        """Return the rungs that are not measured yet."""
        return [rung for rung in self.rungs if self.pieces.load(rung.name) is None]

    def estimate(self) -> dict[str, float]:
        """Return the seconds that each rung that is left should take; one that is refused takes none."""
        from ..jobs.variants import expected_work
        from ..landscapes.measures.fidelity import TIMING

        left = self.left()
        base = make(self.env.name, fidelity=next(iter(self.env.fidelities)), **self._how())
        base.prepare()
        batch = self.x[: base.preferred_batch]
        base.evaluate(batch[:1])
        began = time.perf_counter()
        base.evaluate(batch)
        rate = (time.perf_counter() - began) / len(batch) / base.work().count
        seconds = {rung.name: 0.0 for rung in left}
        for rung, env in self._made(left):
            each = rate * expected_work(env)
            seconds[rung.name] = len(self.x) * each + 2 * max(TIMING, min(len(self.x), env.preferred_batch) * each / 3)
        return seconds

    def _how(self) -> dict[str, Any]:
        return {"device": self.env.device, "engine": self.env.engine, **asdict(self.env.options)}

    def _made(self, rungs: Sequence[Rung]) -> Iterator[tuple[Rung, Environment]]:
        """Make each rung's environment; note what a scene refuses, and why."""
        for rung in rungs:
            try:
                yield rung, rung.make(self.env.name)
            except ValueError as error:
                self.refused[rung.name] = " ".join(str(error).split())

    def run(self, console: Console) -> dict[str, Any]:
        """Measure what is missing, the reference first; write and return the report."""
        samples = self._measure(console)
        report = self._report(samples)
        from ..landscapes.draw.figures.page import save
        from ..landscapes.draw.figures.tradeoff import tradeoff_figure
        from ..landscapes.storage.files import tidy
        from ..landscapes.storage.records import write_record

        folder = self.pieces.folder
        save(tradeoff_figure(report), folder / PICTURE)
        write_record(folder / RECORD, report)
        tidy(folder)
        return report

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.pieces.count()} of {len(self.rungs)} rungs are kept in {self.pieces.folder}"

    def print(self, report: dict[str, Any], prints: Sequence[float]) -> list[str]:
        """Draw the report for pages so wide [mm], too; return the files' names."""
        from ..landscapes.draw.figures.page import save_prints
        from ..landscapes.draw.figures.tradeoff import tradeoff_figure

        return save_prints(lambda width: tradeoff_figure(report, width=width), self.pieces.folder / PICTURE, prints)

    def _measure(self, console: Console) -> dict[str, Sample]:
        from ..landscapes.measures.fidelity import Sample

        samples: dict[str, Sample] = {}
        columns = (Described(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console) as bar:
            task = bar.add_task("rungs", total=len(self.rungs))
            for number, rung in enumerate(self.rungs):
                bar.update(task, completed=number, description=rung.name)
                if (arrays := self.pieces.load(rung.name)) is not None:
                    samples[rung.name] = Sample.of_arrays(arrays)
                    continue
                if (sample := self._sampled(rung, partial(self._follow, bar, task, rung.name))) is not None:
                    samples[rung.name] = sample
                    self.pieces.save(rung.name, **sample.arrays())
                if number == 0 and rung.name in self.refused:
                    raise ValueError(f"{self.env.name} has no reference to measure by: {self.refused[rung.name]}")
            bar.update(task, completed=len(self.rungs), description="rungs")
        return samples

    def _sampled(self, rung: Rung, follow: Callable[[int], None]) -> Sample | None:
        """Measure a rung, if that can be done.

        The one before must be gone by then: a solver takes what memory a GPU has, and a rung that got the rest would
        seem slow.
        """
        from ..landscapes.measures.fidelity import measure
        from ..landscapes.sampling.memory import free_memory

        free_memory()
        for _, env in self._made([rung]):
            try:
                return measure(env, self.x, follow=follow)
            except RuntimeError as error:  # no room for it, or an engine that gives up
                self.refused[rung.name] = " ".join(str(error).split())
        return None

    def _follow(self, bar: Progress, task: TaskID, name: str, done: int) -> None:
        bar.update(task, description=f"{name}, {done} of {len(self.x)} points")

    def _report(self, samples: dict[str, Sample]) -> dict[str, Any]:
        from ..landscapes.measures.fidelity import compare, spread

        reference = self.rungs[0]
        held = samples[reference.name]
        rows = [
            {**_record(rung, self.env), **compare(samples[rung.name], held, seed=self.seed)}
            for rung in self.rungs
            if rung.name in samples
        ]
        return {
            "env": self.env.name,
            "reference": reference.name,
            "points": len(self.x),
            "seed": self.seed,
            "loss_unit": self.env.loss_unit,
            "spread": spread(held),
            "reference_failed": len(self.x) - rows[0]["compared"],
            "rungs": rows,
            "refused": [{"name": name, "why": why} for name, why in self.refused.items()],
            "orders": _orders(rows),
            "identity": self.env.identity(),
            "provenance": provenance_of(self.env, self.command),
            "command": self.command,
        }


def _record(rung: Rung, reference: Environment) -> dict[str, Any]:
    """Return what a rung is, with the memory of an episode [bytes] as its scene estimates it."""
    return {
        "name": rung.name,
        "ladder": rung.ladder,
        "fidelity": asdict(rung.fidelity),
        "engine": rung.engine,
        "device": rung.device,
        "options": rung.options,
        "memory": rung.make(reference.name).memory(),
    }


def _orders(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Fit the order of convergence in dt of the rungs that differ in it, and in precision at most, from the reference.

    With another resolution the errors would level off at that of the resolution.
    """
    from ..landscapes.measures.fidelity import order

    def otherwise(row: dict[str, Any]) -> list[Any]:
        same = {**row["fidelity"], "name": "", "dt": 0, "precision": ""}
        return [same, row["engine"], row["device"], row["options"]]

    found = []
    for precision in ("float32", "float64"):
        members = [
            (row["fidelity"]["dt"], row["loss_error"]["median"]["value"], row["name"])
            for row in rows
            if otherwise(row) == otherwise(rows[0]) and row["fidelity"]["precision"] == precision
        ]
        members = [row for row in sorted(members, reverse=True) if row[1] and row[0] > rows[0]["fidelity"]["dt"]]
        if fit := order([row[0] for row in members], [row[1] for row in members]):
            found.append({"rungs": [row[2] for row in members], **fit})
    return found


def show(report: dict[str, Any], console: Console) -> None:
    """Print a report: a row for each rung, cheapest first, with those that no other beats marked."""
    from ..landscapes.measures.fidelity import front, p95

    rows = sorted(report["rungs"], key=lambda row: row["seconds"]["with_gradient"])
    others = rows[: [row["name"] for row in rows].index(report["reference"])]  # a slower one is beaten by it
    errors = [math.inf if (off := p95(row, relative=False)) is None else off for row in others]
    best = {others[k]["name"] for k in front([row["seconds"]["with_gradient"] for row in others], errors)}
    console = Console(file=console.file, width=console.width, highlight=False)
    console.print(_subject(report), markup=False)
    accuracy = ("rung", "median", "95 % of points", "rank", "cosine", "slope", "failed")
    found = table(*accuracy, "ms", "with grad", "memory", box=SIMPLE, padding=(0, 1), collapse_padding=True)
    for row in rows:
        mark = " *" if row["name"] in best else ""
        found.add_row(row["name"] + mark, *_cells(row, reference=row["name"] == report["reference"]))
    console.print(found)
    console.print(
        "median, 95 %: loss error as a share of the spread (95 % interval); rank: Spearman's correlation of losses; "
        "cosine, slope: of gradients, median cosine and relative error; ms an episode; * none is quicker and nearer",
        markup=False,
    )
    for fit in report["orders"]:
        console.print(
            f"error ~ dt^{fit['order']:z.2f} ± {fit['standard_error']:.2f}: {', '.join(fit['rungs'])}", markup=False
        )
    for why in dict.fromkeys(refused["why"] for refused in report["refused"]):
        names = [refused["name"] for refused in report["refused"] if refused["why"] == why]
        console.print(f"refused: {', '.join(names)}: {why}", markup=False)


def _subject(report: dict[str, Any]) -> str:
    said = f"{report['points']} points against {report['reference']}"
    width, unit = report["spread"], report["loss_unit"]
    scale = f"spread of the loss (5th to 95th percentile) {width:.4g} {unit}".rstrip() if width else "no spread"
    failed = f"; {report['reference_failed']} points left out, the reference fails there"
    return f"{report['env']}: {said}; {scale}" + (failed if report["reference_failed"] else "")


def _cells(row: dict[str, Any], *, reference: bool) -> list[str]:
    seconds = [f"{1e3 * row['seconds'][way]:.3g}" for way in ("forward", "with_gradient")]
    if reference:
        return ["reference", *[""] * 5, *seconds, size(row["memory"])]
    error, gradient = row["loss_error"], row["gradient"]
    median = error["median_relative"]["value"]
    shares = ["" if median is None else f"{_percent(median)}%", _share(error["p95_relative"])]
    diverged = "" if row["diverged"] is None else f"{row['diverged']:.0%}"
    return [
        *shares,
        _number(row["spearman"]),
        _number(gradient["cosine"]),
        _number(gradient["relative_error"]),
        diverged,
        *seconds,
        size(row["memory"]),
    ]


def _share(found: dict[str, float | None]) -> str:
    value, low, high = found["value"], found["low"], found["high"]
    if value is None:
        return "not finite"
    return f"{_percent(value)}% ({_percent(low)}-{_percent(high)})"


def _percent(value: float | None) -> str:
    return "?" if value is None else f"{100 * value:.2g}"


def _number(found: dict[str, float | None]) -> str:
    return "" if found["value"] is None else f"{found['value']:z.3f}"
