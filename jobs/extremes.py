"""A scene at its extremes: how far each of its knobs can be turned, maps of pairs of them, and what happens beyond."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..landscapes.capacity import Need, require
from ..landscapes.cost import duration, seconds_per_episode
from ..landscapes.measures.extremes import Extremes, Limit, RefusedSetting, StabilityMap
from ..landscapes.measures.stability import Answer, Cell, ask, bisect, bracket, islands, judge
from ..landscapes.storage.files import tidy
from ..landscapes.storage.records import write_record
from .folder import EXTREMES, ROOT, folder_named
from .knobs import BOX, DEAREST, DT, RESOLUTION, Knob, Knobs, Pair, Settings, settings_key
from .scene import SceneSpec, provenance
from .studies import going_on
from .variants import SLOWER
from .watch import PREPARING, Watch, resumable

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.storage.checkpoint import Checkpoint
    from .watch import Advance

RECORD, PICTURE = EXTREMES.files
COPIES = 20  # of the points: what an answer holds of each
BEYOND = 2.0  # times the limit, or less by that, a map reaches; of an option, whose effect goes with its root:
BEYOND_OPTION = 8.0


@dataclass(frozen=True)
class ExtremesJob:
    """The settings of a scene to try at the points `unit`, shape (point, dim) [of the box]; a piece on disk for each.

    `reference` is the fidelity that says whether finite losses are right. `refused` gathers the settings that the scene
    refuses, and why. `prints` are widths of pages [mm] that it is also drawn for; `command` is how it is made again.
    """

    knobs: Knobs
    turned: list[Knob]
    pairs: list[Pair]
    precisions: list[str]
    reference: str
    unit: Tensor
    seed: int
    grid: int
    width: float
    accuracy: float
    pieces: Checkpoint
    command: str
    prints: Sequence[float] = ()
    refused: dict[str, str] = field(default_factory=dict)
    answers: dict[str, Answer] = field(default_factory=dict)

    @classmethod
    def open(
        cls,
        scene: SceneSpec,
        *,
        points: int = 16,
        seed: int = 0,
        knobs: Sequence[str] = (),
        pairs: Sequence[str] | None = None,
        precisions: Sequence[str] = (),
        grid: int = 8,
        width: float = 0.05,
        accuracy: float = 0.1,
        reference: str | None = None,
        out: Path | None = None,
        root: Path = ROOT,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
    ) -> ExtremesJob:
        """Go on with the study in its folder, by default one named after it under `root`, or begin it there.

        The fidelity is standard, or the scene's first, unless `scene` says another. `knobs` and `pairs` ("dt:ke") are
        those that are turned, by default what says how stiff, fine, fast and long a scene is; `precisions` are by
        default all that the scene has. Raises ValueError for what the scene does not have, TooLargeError for more
        points than there is memory for, StoreMismatchError where the folder holds another study.
        """
        from ..landscapes.storage.checkpoint import Checkpoint

        _refuse_numbers(width, accuracy)
        env = _with_fidelity(scene).make()
        require("points", points, lambda count: Need(8.0 * COPIES * (1 + env.space.dim) * count))
        spec = replace(SceneSpec.of(env), options=dict(scene.options))
        found = Knobs(env, spec)
        turned = found.pick(knobs)
        if not turned:
            raise ValueError(
                f"{env.name} has nothing to turn: no time step, no grid, no option that is a number above 0 and no "
                "horizon, and it is not asked beyond its box; a function takes options=, fidelities= and horizon="
            )
        judge_by = _find_reference(env, reference)
        identity = {**env.identity(), "points": points, "seed": seed, "reference": judge_by}
        folder = out or folder_named(["extremes", env.name, env.fidelity.name, points], identity, root)
        wanted = found.pick_pairs(pairs) if pairs is not None else [] if knobs else found.usual_pairs
        kinds = found.pick_precisions(precisions)
        pieces = Checkpoint.open(folder, identity, what="extremes", force=force)
        unit = spread_points(env.space.dim, points, seed)
        how = {"grid": grid, "width": width, "accuracy": accuracy, "pieces": pieces}
        return cls(found, turned, wanted, kinds, judge_by, unit, seed, command=command, prints=prints, **how)  # type: ignore[arg-type] # each of its kind

    @property
    def env(self) -> Environment:
        """The scene that the knobs are turned from."""
        return self.knobs.base

    @property
    def folder(self) -> Path:
        """Where it is kept."""
        return self.pieces.folder

    def run(self, watch: Watch | None = None) -> Extremes:
        """Try what is missing; draw, write and return the extremes.

        Raises Stopped where it is interrupted, and DiskFullError; the same job goes on from what is kept then.
        """
        from ..landscapes.draw.figures.page import save

        watch = watch or Watch()
        with going_on(self.pieces, lambda: self.env, self.say_kept, watch):
            found = self._measure(watch, self._announce(watch))
            save(found.plot(), self.folder / PICTURE)
            write_record(self.folder / RECORD, found.record())
            tidy(self.folder)
        return found

    def say_kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.pieces.count()} settings are kept in {self.folder}"

    def print(self, found: Extremes) -> list[str]:
        """Draw it for pages, too, and return the names of the files. Raises DiskFullError."""
        from ..landscapes.draw.figures.page import save_prints

        with resumable(self.say_kept):
            return save_prints(lambda width: found.plot(width), self.folder / PICTURE, self.prints)

    def estimate(self) -> tuple[int, float]:
        """Return about how many settings will be tried, and the seconds that they take, by the work of an episode.

        The references are part of it; what is kept already is not taken off.
        """
        env = self.env
        env.prepare()
        x = self._points({})
        base = seconds_per_episode(env, x, grad=True) * len(x)
        judged = self.knobs.make({}, "", self.reference)
        dearer = judged.work().count / env.work().count * _slower(judged) / _slower(env)
        bisections = math.ceil(math.log2(math.log(4.0) / math.log1p(self.width)))
        works = [self.knobs.work(knob, value) for knob in self.turned for end in knob.ends for value in knob.rungs(end)]
        works = [work for work in works if work <= DEAREST]
        works += [1.0] * (bisections * sum(len(knob.ends) for knob in self.turned))
        works += [1.0] * (len(self.pairs) * self.grid * (self.grid + bisections))
        references = 1.0 + sum(
            self.knobs.work(knob, value)
            for knob in self.turned
            if knob.name not in (DT, RESOLUTION)
            for end in knob.ends
            for value in knob.rungs(end)[1:]
        )
        references += sum(self.grid for pair in self.pairs for name in pair if name not in (DT, RESOLUTION))
        slower = sum(SLOWER if one == "float64" else 1.0 for one in self.precisions) / _slower(env)
        return round(len(works) * len(self.precisions) + references), base * (sum(works) * slower + references * dearer)

    def _announce(self, watch: Watch) -> int:
        """Say what is tried, and about how long that takes; return about how many settings."""
        env = self.env
        watch.note(f"{env.name} · {env.fidelity.name} · {env.device} · {env.engine} · {self.folder}")
        with watch.busy(f"{env.name}: {PREPARING}"):
            count, seconds = self.estimate()
        kept = self.pieces.count()
        there = f"; {kept} are kept already" if kept else ""
        watch.note(
            f"some {count} settings of {', '.join(knob.name for knob in self.turned)}, "
            f"{' and '.join(self.precisions)}, at {len(self.unit)} points, judged by {self.reference}{there}"
        )
        watch.note(
            f"about {duration(seconds)}, by the work of an episode, and less where steps are longer; compiling kernels "
            "comes on top; --points, --knobs, --pairs and --grid lower it"
        )
        return count

    def _measure(self, watch: Watch, count: int) -> Extremes:
        with watch.progress(count, "settings") as advance:
            limits = [
                self._limit(knob, end, precision, advance)
                for precision in self.precisions
                for knob in self.turned
                for end in knob.ends
            ]
            maps = [self._map(pair, precision, advance) for precision in self.precisions for pair in self.pairs]
            advance(count, f"{len(self.answers)} tried")
        env = self.env
        return Extremes(
            env=env.name, fidelity=env.fidelity.name, reference=self.reference, points=len(self.unit), seed=self.seed,
            width=self.width, accuracy=self.accuracy, limits=tuple(limits), maps=tuple(maps),
            refused=tuple(RefusedSetting(name, why) for name, why in self.refused.items()), identity=env.identity(),
            provenance=provenance(env, self.command), command=self.command,
        )  # fmt: skip

    def _limit(self, knob: Knob, end: str, precision: str, advance: Advance) -> Limit:
        """Scan a knob towards an end, then bisect the first failure: what is stable beyond it is not hidden by that."""
        axis = self.knobs.axis(knob)
        wanted = list(dict.fromkeys(map(axis.settle, knob.rungs(end))))
        rungs = [value for value in wanted if self.knobs.work(knob, value) <= DEAREST]
        cells = [self._cell([(knob, value)], precision, advance) for value in rungs]
        other = "smallest" if end == "largest" else "largest"
        for value in list(dict.fromkeys(map(axis.settle, knob.rungs(other))))[1:]:
            if cells[0].stable or self.knobs.work(knob, value) > DEAREST:
                break
            cells.insert(0, self._cell([(knob, value)], precision, advance))
        values, fine = [cell.values[0] for cell in cells], [cell.stable for cell in cells]
        stable, failed = self._end([(knob, value) for value in values], (), cells, "stable", precision, advance)
        accurate, wrong = self._end([(knob, value) for value in values], (), cells, "accurate", precision, advance)
        beyond = "" if failed is None else self._cell([(knob, failed)], precision, advance).outcome
        return Limit(
            knob.name, knob.unit, precision, end, knob.base, stable, failed, beyond, accurate, wrong,
            islands(values, fine), tuple(cells), len(wanted) - len(rungs),
        )  # fmt: skip

    def _end(
        self,
        turned: Sequence[tuple[Knob, float]],
        beside: Sequence[tuple[Knob, float]],
        cells: Sequence[Cell],
        what: str,
        precision: str,
        advance: Advance,
    ) -> tuple[float | None, float | None]:
        """Return the last value of a knob at which it is `what` (stable, accurate), and the first at which it is not.

        They are bisected, accuracy only where no other reference is needed for that.
        """
        knob, axis = turned[0][0], self.knobs.axis(turned[0][0])
        last, first = bracket([value for _, value in turned], [getattr(cell, what) for cell in cells])
        if last is None or first is None or (what == "accurate" and knob.name not in (DT, RESOLUTION)):
            return last, first

        def holds(value: float) -> bool:
            return bool(getattr(self._cell([(knob, value), *beside], precision, advance), what))

        return bisect(last, first, holds, axis, self.width)

    def _map(self, pair: Pair, precision: str, advance: Advance) -> StabilityMap:
        """Try a grid of two knobs around their base and their limits; then bisect where each row ends."""
        x, y = (self.knobs.all[name] for name in pair)
        xs, ys = (self._values(knob, precision, advance) for knob in (x, y))
        rows = [[self._cell([(x, a), (y, b)], precision, advance) for a in xs] for b in ys]
        found: dict[str, list[tuple[float, float, float]]] = {"stable": [], "accurate": []}
        for what, line in found.items():
            for b, row in zip(ys, rows, strict=True):
                last, first = self._end([(x, a) for a in xs], [(y, b)], row, what, precision, advance)
                if last is not None and first is not None and (what == "stable" or x.name in (DT, RESOLUTION)):
                    line.append((b, last, first))
        return StabilityMap(
            x.name, y.name, (x.unit, y.unit), precision, (x.base, y.base), tuple(xs), tuple(ys),
            tuple(cell for row in rows for cell in row), tuple(found["stable"]), tuple(found["accurate"]),
        )  # fmt: skip

    def _values(self, knob: Knob, precision: str, advance: Advance) -> list[float]:
        """Return the values of a knob that a map has: from below its base to beyond its limit."""
        axis = self.knobs.axis(knob)
        if knob.linear:
            return axis.spread(knob.least, knob.most, self.grid)
        limit = self._limit(knob, "largest", precision, advance)
        tried = [cell.values[0] for cell in limit.rungs]
        reach = BEYOND_OPTION if "smallest" in knob.ends and knob.name != RESOLUTION else BEYOND
        ends = [end for end in (limit.failed, limit.wrong and reach * limit.wrong) if end] or [tried[-1]]
        high = max(knob.base, *ends) * BEYOND
        low = min(knob.base, limit.stable or knob.base) / (
            1.0 if knob.ends == ("largest",) and knob.name != DT else reach
        )
        dearest = max(tried) if limit.dearer else math.inf
        return axis.spread(max(low, knob.least), min(high, knob.most, dearest), self.grid)

    def _cell(self, turned: Sequence[tuple[Knob, float]], precision: str, advance: Advance) -> Cell:
        """Say how a setting ended, against the reference of the same scene."""
        settings = {knob.name: value for knob, value in turned if value != knob.base}
        advance(len(self.answers), ", ".join([precision, *(f"{name} {value:.4g}" for name, value in settings.items())]))
        answer = self._answer(settings, precision)
        same = {name: value for name, value in settings.items() if name not in (DT, RESOLUTION)}
        reference = None if answer.refused else self._answer(same, "", self.reference)
        return judge([value for _, value in turned], answer, reference, accuracy=self.accuracy)

    def _answer(self, settings: Settings, precision: str, fidelity: str | None = None) -> Answer:
        """Return what a setting answers, from memory, from disk, or from the scene; the last is kept on disk."""
        name = _name(settings, fidelity or precision)
        if name not in self.answers:
            arrays = self.pieces.load(name)
            self.answers[name] = answer = (
                Answer.of_arrays(arrays) if arrays else self._try(settings, precision, fidelity)
            )
            if not arrays:
                self.pieces.save(name, **answer.arrays())
            if answer.refused:
                self.refused[_said(settings, fidelity or precision)] = answer.refused
        return self.answers[name]

    def _try(self, settings: Settings, precision: str, fidelity: str | None) -> Answer:
        from ..landscapes.sampling.memory import free_memory

        if self.env.device == "cuda":
            free_memory()
        try:
            env = self.knobs.make(settings, precision, fidelity)
        except ValueError as refusal:
            return Answer.of_refusal(" ".join(str(refusal).split()))
        except RuntimeError as error:  # no room for it
            return Answer.of_refusal(" ".join(str(error).split()))
        return ask(env, self._points(settings))

    def _points(self, settings: Mapping[str, float]) -> Tensor:
        """Return the points, as far beyond the box as a setting says."""
        scale = settings.get(BOX, 1.0)
        return self.env.space.from_unit(0.5 + scale * (self.unit - 0.5))


def spread_points(dim: int, points: int, seed: int) -> Tensor:
    """Return points of the unit cube: corners, half of the points at most, and Sobol points."""
    import torch

    from ..landscapes.conformance.extremes import corners
    from ..landscapes.space import sobol

    ends = corners(dim)
    count = min(len(ends), points // 2)
    chosen = torch.linspace(0, len(ends) - 1, count).round().long()
    return torch.cat([ends[chosen], sobol(points - count, dim, seed=seed)])


def _with_fidelity(scene: SceneSpec) -> SceneSpec:
    """Return a scene at standard, or at its first fidelity, unless it has another."""
    if scene.fidelity is not None:
        return scene
    named = scene.kind.fidelities
    return replace(scene, fidelity="standard" if "standard" in named else next(iter(named)), tolerance=None)


def _find_reference(env: Environment, name: str | None) -> str:
    if name is not None and name not in env.fidelities:
        raise ValueError(f"{env.name} has fidelities {', '.join(env.fidelities)} to be judged by; got {name!r}")
    return name or list(env.fidelities)[-1]


def _refuse_numbers(width: float, accuracy: float) -> None:
    if not 0 < width < 1:
        raise ValueError(f"--width takes a share between 0 and 1, as 0.05; got {width:g}")
    if not 0 <= accuracy < math.inf:
        raise ValueError(f"--accuracy takes a share of the losses' spread, as 0.1; got {accuracy:g}")


def _slower(env: Environment) -> float:
    return SLOWER if env.fidelity.precision == "float64" else 1.0


def _name(settings: Settings, how: str) -> str:
    return " ".join([how, *(f"{name}={value}" for name, value in settings_key(settings))])


def _said(settings: Settings, how: str) -> str:
    return ", ".join([*(f"{name} {value}" for name, value in settings_key(settings)), how])
