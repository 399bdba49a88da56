"""The study `extremes`: how far each setting of a scene can be changed before it fails, and maps of setting pairs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from ..envs.records import Fidelity
from ..landscapes.identity import MODEL_VERSION
from ..landscapes.sampling.memory import free_memory
from .samples import Sample
from .settings import BOX, DT, MAX_WORK, RESOLUTION, Pair, SceneSettings, Setting, Values, values_key
from .stability import Cell, ask, bisect, bracket, evaluate_bound, evaluate_kept, islands, judge, refuse
from .variants import Expected, Study, StudyRecord, one_line, precision_cost

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from .variants import StudyOptions

GRID, WIDTH, TOLERANCE = 8, 0.05, 0.1  # by default
MAP_REACH = 2.0  # times the limit, or less by that, a map reaches; of an option, whose effect goes with its root:
OPTION_REACH = 8.0
Changes = Sequence[tuple[Setting, float]]


@dataclass(frozen=True)
class Limit:
    """How far one setting can be changed, in one precision, from its value `base` in the scene.

    `end` is the direction: largest or smallest. `stable` is the last value before the first failure, `failed` the first
    value that failed, either None where there is none; `islands` are stable ranges beyond it. In the same way losses
    are right up to `accurate` and wrong at `wrong`: by bisection for a setting that the reference does not share, else
    from the scan. `scanned` are the scanned values, in order, with any outcome; `skipped` counts those left out as too
    expensive.
    """

    setting: str
    unit: str
    precision: str
    end: str
    base: float
    stable: float | None
    failed: float | None
    beyond: str
    accurate: float | None
    wrong: float | None
    islands: tuple[tuple[float, float], ...]
    scanned: tuple[Cell, ...]
    skipped: int = 0

    derived: ClassVar[tuple[str, ...]] = ("margin", "accurate_margin")

    @property
    def margin(self) -> float | None:
        """The base as a share of the largest stable value, or of the smallest one its inverse; None without one.

        Below one the scene is stable; if nothing failed, it is relative to the farthest tested value.
        """
        return self._share(self.stable)

    @property
    def accurate_margin(self) -> float | None:
        """The base as a share of the largest accurate value, or of the smallest one its inverse; None without one."""
        return self._share(self.accurate)

    def _share(self, end: float | None) -> float | None:
        if not end or not self.base:
            return None
        return self.base / end if self.end == "largest" else end / self.base

    @property
    def last_error(self) -> float | None:
        """The loss error at the last value before the first failure: the largest error of finite losses."""
        error = None
        for cell in self.scanned:
            if not cell.stable:
                break
            error = cell.error
        return error

    def sentence(self) -> str:
        """Give the limit, the failure beyond it, the largest error before it, and the limit of right losses."""
        if self.stable is None:
            said = [f"none is stable: {self.scanned[0].outcome}"]
        elif self.failed is None:
            said = [f"stable up to {self.stable:.4g} ({self.stable / self.base:.3g}x), the last tried"]
        else:
            said = [f"{self.stable:.4g} ({self.stable / self.base:.3g}x), then {self.beyond}"]
        said += [f"stable again {low:.4g} to {high:.4g}" for low, high in self.islands]
        said += [f"{self.skipped} values too expensive"] if self.skipped else []
        if self.last_error is not None:
            right = "not accurate" if self.accurate is None else f"accurate to {self.accurate:.4g}"
            right += f", not at {self.wrong:.4g}" if self.accurate is not None and self.wrong is not None else ""
            said.append(f"{right}, finally {100 * self.last_error:.2g} % off")
        return "; ".join(said)


@dataclass(frozen=True)
class StabilityMap:
    """The outcomes of a scene on a grid of two settings, in one precision.

    `cells` go along `x` first, then along `y`. `boundary` has for values of `y` the last stable value along x and the
    first that failed, which enclose the limit; values of y without any failure, or without any success, have none.
    `accurate_boundary` is the same for the last accurate value and the first inaccurate one, where the reference does
    not share x.
    """

    x: str
    y: str
    units: tuple[str, str]
    precision: str
    base: tuple[float, float]
    xs: tuple[float, ...]
    ys: tuple[float, ...]
    cells: tuple[Cell, ...]
    boundary: tuple[tuple[float, float, float], ...]  # y, stable x, failed x
    accurate_boundary: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, kw_only=True)
class ExtremesRecord(StudyRecord):
    """The behaviour of a scene under extreme settings, at the same points everywhere.

    `fidelity` is the starting point of the changes. `reference` is the fidelity whose losses decide whether finite ones
    are right, within `tolerance` of their spread; limits are known to a relative `width`.
    """

    kind: ClassVar[str] = "extremes"
    kept_by: ClassVar[tuple[str, ...]] = ("settings", "options", "engine")
    index: ClassVar[tuple[str, ...]] = ("setting", "end", "precision")

    fidelity: str
    reference: str
    width: float
    tolerance: float
    limits: tuple[Limit, ...]
    maps: tuple[StabilityMap, ...]

    @property
    def precisions(self) -> list[str]:
        """The tested precisions, in order."""
        return list(dict.fromkeys(one.precision for one in self.limits))

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each end of each setting in each precision, identified by `setting`, `end` and `precision`.

        Columns: `base`; `stable` and `failed`, which enclose the limit; `margin`; `beyond`, the failure there;
        `accurate` and `wrong`, the last value with right losses and the first without; `islands`; `error`, at the last
        stable value.
        """
        names = (*self.index, "base", "stable", "failed", "margin", "beyond", "accurate", "wrong", "islands")
        for one in self.limits:
            yield {**{name: getattr(one, name) for name in names}, "error": one.last_error}

    def sentences(self) -> list[str]:
        """Return each limit in words."""
        return [f"{one.setting}, {one.end}, {one.precision}: {one.sentence()}" for one in self.limits]

    def to_keep(self) -> ExtremesRecord | None:
        """Return the record if it has a result on the step."""
        return self if any(limit.setting == DT for limit in self.limits) else None

    def margin_sentences(self, env: Environment) -> Iterator[str]:
        """Yield the step relative to its limit in each precision, with device, engine and settings of the measurement.

        `env` is the scene as it is now.
        """
        known, now = self.identity, env.fidelities.get(self.fidelity)
        of = f"{known['engine']} on {known['device']}, {self.points} points, {self.provenance['created']}"
        if (theirs := known[MODEL_VERSION]) != (ours := env.version_on(known["engine"])):
            of += f", with {env.name} model {theirs}; this is model {ours}"
        if now is not None and (others := now.changes_from(known["settings"])):
            of += f", when {self.fidelity} had {', '.join(f'{name} {value}' for name, (value, _) in others.items())}"
        for limit in self.limits:
            if limit.setting == DT:
                right = f"{self._margin(limit)}; {self._accuracy(limit)}"
                yield f"stability: {right} ({limit.precision}; {of})"

    def _margin(self, limit: Limit) -> str:
        if limit.stable is None:
            return f"{self.fidelity}'s step was not stable, and neither was any shorter one that was tried"
        if limit.failed is None:
            return f"{self.fidelity}'s step is stable, and so is one {limit.stable / limit.base:.3g} times as long"
        share = "" if limit.stable == limit.base else f"{limit.margin:.2g} of "
        stable = f"{self.fidelity}'s step is {share}the largest stable one, {limit.stable:.3g} s"
        return f"{stable} ({limit.beyond} at {limit.failed:.3g} s)"

    def _accuracy(self, limit: Limit) -> str:
        of = f"within {self.tolerance:.0%} of the spread of {self.reference}'s"
        if limit.accurate is None:
            return f"its losses are not {of}"
        if limit.wrong is None:
            return f"all losses are {of}"
        return (
            f"losses are {of} up to a step of {limit.accurate:.3g} s; {self.fidelity}'s step is "
            f"{limit.accurate_margin:.2g} of that"
        )


class ExtremesStudy(Study):
    """Scan and bisect settings of a scene, and map pairs of them.

    The points are `unit`, shape (point, dim) [of the box]. `reference` is the fidelity that decides whether finite
    losses are right.
    """

    kind = "extremes"
    takes = ("settings", "pairs", "precisions", "grid", "width", "tolerance", "reference")
    what = "settings"
    default_points = 16
    copies = 20
    advice = (
        "less if steps are longer, plus compiling kernels; fewer --points, --settings, --pairs or a smaller --grid "
        "take less"
    )

    def __init__(self, env: Environment, options: StudyOptions) -> None:
        self.grid = GRID if options.grid is None else options.grid
        self.width = WIDTH if options.width is None else options.width
        self.tolerance = TOLERANCE if options.tolerance is None else options.tolerance
        if not 0 < self.width < 1:
            raise ValueError(f"--width takes a share between 0 and 1, such as 0.05; got {self.width:g}")
        if not 0 <= self.tolerance < math.inf:
            raise ValueError(f"--tolerance takes a share of the losses' spread, such as 0.1; got {self.tolerance:g}")
        super().__init__(env, options)
        self.settings = SceneSettings(env)
        self.changed = self.settings.pick(options.settings)
        if not self.changed:
            raise ValueError(
                f"{env.name} has nothing to change: no time step, no grid, no option with a number above 0 and no "
                "horizon, and it is undefined outside its bounds; give a function options=, fidelities= or horizon="
            )
        self.reference = options.reference or list(env.fidelities)[-1]
        if self.reference not in env.fidelities:
            raise ValueError(
                f"{env.name} has fidelities {', '.join(env.fidelities)} as its reference; got {self.reference!r}"
            )
        usual = [] if options.settings else self.settings.usual_pairs
        self.pairs = usual if options.pairs is None else self.settings.pick_pairs(options.pairs)
        self.precisions = self.settings.pick_precisions(options.precisions)
        self.answers: dict[str, Sample] = {}

    @classmethod
    def choose_fidelity(cls, scene: Environment | type[Environment], given: Fidelity | str | None) -> Fidelity | str:
        """Return the fidelity at which the changes start: the given one, else standard, or the scene's first."""
        return given or ("standard" if "standard" in scene.fidelities else next(iter(scene.fidelities)))

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers."""
        return {**super().identity(), "reference": self.reference}

    def folder_parts(self) -> list[object]:
        """Return the parts of the name of the study's folder."""
        return [self.kind, self.env.name, self.env.fidelity.name, len(self.x)]

    def describe_left(self) -> str:
        """Describe the remaining measurements."""
        kept = f", {self.checkpoint.count()} are done already" if self.checkpoint.count() else ""
        return f"about {self._count()} settings to measure{kept}"

    def expected(self) -> Iterator[Expected]:
        """Yield all settings as one, including the references, in episodes of the fidelity at the start.

        Stored results are not subtracted.
        """
        judged = self.settings.make({}, "", self.reference)
        own = precision_cost(self.env.fidelity.precision)
        dearer = judged.work().count / self.env.work().count * precision_cost(judged.fidelity.precision) / own
        slower = sum(map(precision_cost, self.precisions)) / own
        works, references = self._expected()
        yield Expected(f"{self._count()} settings", self.env, len(self.x) * (sum(works) * slower + references * dearer))

    def _count(self) -> int:
        """Return the approximate number of settings to try, with the references."""
        works, references = self._expected()
        return round(len(works) * len(self.precisions) + references)

    def _expected(self) -> tuple[list[float], float]:
        """Return the work of each setting in a precision, in units of the base, and that of references."""
        bisections = math.ceil(math.log2(math.log(4.0) / math.log1p(self.width)))
        ends = [(setting, end) for setting in self.changed for end in setting.ends]
        works = [self.settings.work(setting, value) for setting, end in ends for value in setting.grid(end)]
        works = [work for work in works if work <= MAX_WORK]
        works += [1.0] * (bisections * len(ends) + len(self.pairs) * self.grid * (self.grid + bisections))
        references = 1.0 + sum(
            self.settings.work(setting, value)
            for setting, end in ends
            if not _is_fidelity(setting.name)
            for value in setting.grid(end)[1:]
        )
        return works, references + sum(self.grid for pair in self.pairs for name in pair if not _is_fidelity(name))

    def run(self, watch: Watch, provenance: Mapping[str, Any], command: str) -> ExtremesRecord:
        """Try the missing settings and return the record."""
        count = self._count()
        with watch.progress(count, self.what) as self._advance:
            limits = [
                self._limit(setting, end, precision)
                for precision in self.precisions
                for setting in self.changed
                for end in setting.ends
            ]
            maps = [self._map(pair, precision) for precision in self.precisions for pair in self.pairs]
            self._advance(count, f"{len(self.answers)} tried")
        return ExtremesRecord(
            **self.about(provenance, command),
            fidelity=self.env.fidelity.name,
            reference=self.reference,
            width=self.width,
            tolerance=self.tolerance,
            limits=tuple(limits),
            maps=tuple(maps),
        )

    def _limit(self, setting: Setting, end: str, precision: str) -> Limit:
        """Scan a setting towards an end, then bisect the first failure; the scan also finds stable ranges beyond it."""
        axis = self.settings.axis(setting)
        wanted = list(dict.fromkeys(map(axis.settle, setting.grid(end))))
        scanned = [value for value in wanted if self.settings.work(setting, value) <= MAX_WORK]
        cells = [self._cell([(setting, value)], precision) for value in scanned]
        other = "smallest" if end == "largest" else "largest"
        for value in list(dict.fromkeys(map(axis.settle, setting.grid(other))))[1:]:
            if cells[0].stable or self.settings.work(setting, value) > MAX_WORK:
                break
            cells.insert(0, self._cell([(setting, value)], precision))
        values = [cell.values[0] for cell in cells]
        changed = [(setting, value) for value in values]
        stable, failed = self._end(changed, (), cells, "stable", precision)
        accurate, wrong = self._end(changed, (), cells, "accurate", precision)
        beyond = "" if failed is None else self._cell([(setting, failed)], precision).outcome
        return Limit(
            setting=setting.name,
            unit=setting.unit,
            precision=precision,
            end=end,
            base=setting.base,
            stable=stable,
            failed=failed,
            beyond=beyond,
            accurate=accurate,
            wrong=wrong,
            islands=islands(values, [cell.stable for cell in cells]),
            scanned=tuple(cells),
            skipped=len(wanted) - len(scanned),
        )

    def _end(
        self, changed: Changes, fixed: Changes, cells: Sequence[Cell], what: str, precision: str
    ) -> tuple[float | None, float | None]:
        """Return the last value of a setting at which it is `what` (stable, accurate), and the first at which not.

        They are bisected, accuracy only if that needs no other reference.
        """
        setting = changed[0][0]
        last, first = bracket([value for _, value in changed], [getattr(cell, what) for cell in cells])
        if last is None or first is None or (what == "accurate" and not _is_fidelity(setting.name)):
            return last, first

        def holds(value: float) -> bool:
            return bool(getattr(self._cell([(setting, value), *fixed], precision), what))

        return bisect(last, first, holds, self.settings.axis(setting), self.width)

    def _map(self, pair: Pair, precision: str) -> StabilityMap:
        """Try a grid of two settings around their base and their limits; then bisect the end of each row."""
        x, y = (self.settings.all[name] for name in pair)
        xs, ys = (self._map_values(setting, precision) for setting in (x, y))
        rows = [[self._cell([(x, a), (y, b)], precision) for a in xs] for b in ys]
        found: dict[str, list[tuple[float, float, float]]] = {"stable": [], "accurate": []}
        for what, line in found.items():
            for b, row in zip(ys, rows, strict=True):
                last, first = self._end([(x, a) for a in xs], [(y, b)], row, what, precision)
                if last is not None and first is not None and (what == "stable" or _is_fidelity(x.name)):
                    line.append((b, last, first))
        return StabilityMap(
            x=x.name,
            y=y.name,
            units=(x.unit, y.unit),
            precision=precision,
            base=(x.base, y.base),
            xs=tuple(xs),
            ys=tuple(ys),
            cells=tuple(cell for row in rows for cell in row),
            boundary=tuple(found["stable"]),
            accurate_boundary=tuple(found["accurate"]),
        )

    def _map_values(self, setting: Setting, precision: str) -> list[float]:
        """Return the values of a setting in a map: from below its base to beyond its limit."""
        axis = self.settings.axis(setting)
        if setting.linear:
            return axis.spread(setting.least, setting.most, self.grid)
        limit = self._limit(setting, "largest", precision)
        tried = [cell.values[0] for cell in limit.scanned]
        reach = OPTION_REACH if "smallest" in setting.ends and setting.name != RESOLUTION else MAP_REACH
        ends = [end for end in (limit.failed, limit.wrong and reach * limit.wrong) if end] or [tried[-1]]
        high = max(setting.base, *ends) * MAP_REACH
        low = min(setting.base, limit.stable or setting.base) / (
            1.0 if setting.ends == ("largest",) and setting.name != DT else reach
        )
        dearest = max(tried) if limit.skipped else math.inf
        return axis.spread(max(low, setting.least), min(high, setting.most, dearest), self.grid)

    def _cell(self, changed: Changes, precision: str) -> Cell:
        """Return the outcome at values of settings, compared with the reference of the same scene."""
        values = {setting.name: value for setting, value in changed if value != setting.base}
        self._advance(
            len(self.answers), ", ".join([precision, *(f"{name} {value:.4g}" for name, value in values.items())])
        )
        answer = self._answer(values, precision)
        same = {name: value for name, value in values.items() if not _is_fidelity(name)}
        reference = None if answer.refused else self._answer(same, "", self.reference)
        return judge([value for _, value in changed], answer, reference, tolerance=self.tolerance)

    def _answer(self, values: Values, precision: str, fidelity: str | None = None) -> Sample:
        """Return the scene's results at values of settings, from memory, from disk, or from the scene."""
        how, known = fidelity or precision, values_key(values)
        name = " ".join([how, *(f"{key}={value}" for key, value in known)])
        if name not in self.answers:
            arrays = self.checkpoint.load_or_compute(name, lambda: self._try(values, precision, fidelity).arrays())
            self.answers[name] = answer = Sample.of_arrays(arrays)
            if answer.refused:
                self.refused[", ".join([*(f"{key} {value}" for key, value in known), how])] = answer.refused
        return self.answers[name]

    def _try(self, values: Values, precision: str, fidelity: str | None) -> Sample:
        if self.env.device == "cuda":
            free_memory()
        try:
            env = self.settings.make(values, precision, fidelity)
        except (ValueError, RuntimeError) as refusal:  # RuntimeError: no memory for it
            return refuse(one_line(refusal))
        return ask(env, self._beyond(values), by=evaluate_kept if fidelity else evaluate_bound)

    def _points(self, points: int) -> Tensor:
        """Return the points, of the unit box."""
        return spread_points(self.env.space.dim, points, self.seed)

    def _beyond(self, values: Values) -> Tensor:
        """Return the points, extended beyond the box according to values of settings."""
        return self.env.space.from_unit(0.5 + values.get(BOX, 1.0) * (self.x - 0.5))


def _is_fidelity(setting: str) -> bool:
    """Return whether a setting belongs to the fidelity, and so has its own value in the reference."""
    return setting in (DT, RESOLUTION)


def spread_points(dim: int, points: int, seed: int) -> Tensor:
    """Return points of the unit cube: corners, at most half of the points, and Sobol points."""
    import torch

    from ..landscapes.checks.extremes import corners
    from ..landscapes.space import sobol

    ends = corners(dim)
    count = min(len(ends), points // 2)
    chosen = torch.linspace(0, len(ends) - 1, count).round().long()
    return torch.cat([ends[chosen], sobol(points - count, dim, seed=seed)])
