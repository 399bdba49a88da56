"""The study `convergence`: whether the reference is converged.

Each setting of the reference is refined. The levels show the order of convergence and the distance of the reference
from its limit. Neighbouring motions are simulated too, because a chaotic motion has no limit point by point.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..envs.records import Fidelity
from ..landscapes.capacity import Need, require
from ..landscapes.plain import finite
from ..landscapes.statistics import gradient_error, median_of, p95_of
from .divergence import Distributions, Divergence, Neighbours
from .order import UNMOVED, Shapes, Verdict, choose_order, extrapolate, find_floor, fit_order, measure_order
from .samples import Bootstrap, Sample, interval_columns, loss_range, percent
from .variants import Expected, StudyRecord, Variant, VariantStudy, refuse_settings, refuse_single, samples_of

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from .variants import StudyOptions

Array = NDArray[np.float64]
JOINT, PRECISION = "joint", "precision"
SETTINGS = ("dt", "resolution", "particles", JOINT, PRECISION)
DT_FACTORS = (4.0, 2.0, 0.5, 0.25)
FACTORS = {"resolution": (2 / 3, 1.5, 2.0), "particles": (0.5, 2.0, 4.0)}
ALLOWED = 0.1  # of what standard is off: a reference that moves by less is converged


@dataclass(frozen=True)
class Level:
    """One level of a setting: its `width`, which refinement lowers, and the time of an episode [s]."""

    name: str
    width: float
    fidelity: Fidelity
    seconds: float


@dataclass(frozen=True)
class Move:
    """The change of losses and gradients from a level to the next finer one.

    `median` and `p95` of |difference|, as shares of the spread; medians of the gradients' `cosine` and relative error;
    at `compared` points. `width` is that of the coarser level.
    """

    coarse: str
    fine: str
    width: float
    median: Bootstrap
    p95: Bootstrap
    cosine: Bootstrap
    relative_error: Bootstrap
    compared: int


@dataclass(frozen=True)
class SettingConvergence:
    """The levels of one setting, from coarse to fine.

    `order` is the observed one, `per_point` each point's, `designed` the one of the scene's method. `moved` is the 95th
    percentile of the change by refining the reference once, as a share of the spread. `met`: that is rounding or within
    a tenth of standard's error; `met_from` names the first level where it is. `floor` is the lower limit of the median
    of |difference|, None where it still falls.
    """

    setting: str
    levels: tuple[Level, ...]
    moves: tuple[Move, ...]
    verdict: Verdict
    order: Bootstrap
    per_point: tuple[float | None, ...]
    shapes: Shapes
    designed: float | None
    floor: float | None
    moved: Bootstrap | None
    met: bool | None
    met_from: str | None

    def sentence(self) -> str:
        """Give the order of convergence, or say that it does not converge."""
        said = [f"{self.setting}: {self.verdict}"]
        if self.verdict == "too few levels" and self.moves:
            said.append(f"losses move by {percent(self.moves[-1].p95.value)} (95 % of points) to the finest")
        if self.order.value is not None:
            count = self.shapes
            said[0] += f", order {self.order}"
            said.append(f"{count.monotone} points monotone, {count.oscillating} oscillating, {count.growing} growing")
        if self.designed is not None:
            match = {True: "as observed", False: "not as observed", None: "not compared"}[self.as_designed]
            said.insert(1, f"designed {self.designed:g}, {match}")
        if self.floor is not None:
            said.append(f"differences do not fall below {percent(self.floor)}")
        if self.met_from is not None and self.verdict != "unmoved":
            said.append(f"within a tenth of standard's error from {self.met_from} on")
        return "; ".join(said)

    @property
    def as_designed(self) -> bool | None:
        """Whether the interval of the observed order contains the designed one, None where one of them is unknown."""
        if self.designed is None or self.order.low is None or self.order.high is None:
            return None
        return self.order.low <= self.designed <= self.order.high


@dataclass(frozen=True)
class Remainder:
    """The distance of a named fidelity from Richardson's limit, as shares of the spread."""

    name: str
    median: Bootstrap
    p95: Bootstrap


@dataclass(frozen=True)
class ConvergenceRule:
    """Whether the reference is converged: refining it changes losses by rounding or a tenth of standard's error.

    `off` is that error. Both are 95th percentiles, as shares of the spread. `moved` is by the `setting` with the
    largest change, and `failing` are the settings above the limit.
    """

    off: Bootstrap
    moved: Bootstrap | None
    setting: str | None
    met: bool | None
    failing: tuple[str, ...]

    def sentence(self) -> str:
        """Give the result in a sentence."""
        off, moved = (percent(one.value if one else None) for one in (self.off, self.moved))
        if self.met is None:
            return f"the convergence of the reference is unknown: it moves by {moved}, standard is off by {off}"
        if self.met and self.moved is not None and (self.moved.value or 0.0) <= UNMOVED:
            return f"the reference is converged to rounding: it moves by at most {moved}"
        if self.met:
            return f"the reference is converged: it moves by at most {moved}, while standard is off by {off}"
        said = f"the reference is not converged: refining its {self.setting} moves it by {moved}, while standard is off"
        return f"{said} by {off} and a tenth of that is allowed; it fails in {', '.join(self.failing)}"


@dataclass(frozen=True, kw_only=True)
class ConvergenceRecord(StudyRecord):
    """The self-convergence of a scene about its reference, at the same points.

    `spread` is the 5th to 95th percentile of the reference's losses [`loss_unit`], None where they are all equal:
    differences are in the loss's unit then. `remainders` are empty where some setting has no limit. `divergence` is
    None for a scene without a motion, `distributions` for one whose motion is not chaotic.
    """

    kind: ClassVar[str] = "convergence"
    index: ClassVar[tuple[str, ...]] = ("setting", "coarse", "fine")

    reference: str
    spread: float | None
    settings: tuple[SettingConvergence, ...]
    rule: ConvergenceRule
    remainders: tuple[Remainder, ...]
    divergence: Divergence | None
    distributions: Distributions | None

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each setting and refinement, identified by `setting`, `coarse` and `fine`.

        Columns: `median` and `p95` of |difference| and the latter's interval, as shares of the spread; `cosine` and
        `relative_error` of gradients; `compared` points; of the setting, `order` with its interval, `designed`,
        `verdict` and `met`, whether the reference meets the rule.
        """
        for one in self.settings:
            for move in one.moves:
                yield {
                    **{"setting": one.setting, "coarse": move.coarse, "fine": move.fine, "median": move.median.value},
                    **interval_columns("p95", move.p95),
                    **{"cosine": move.cosine.value, "relative_error": move.relative_error.value},
                    **{"compared": move.compared, **interval_columns("order", one.order)},
                    **{"designed": one.designed, "verdict": one.verdict, "met": one.met},
                }

    def sentences(self) -> list[str]:
        """Return the results: the orders of convergence, whether the reference is converged, the remaining errors."""
        said = [*(one.sentence() for one in self.settings), self.rule.sentence(), *self.remainder_sentences()]
        return said + [one.sentence() for one in (self.divergence, self.distributions) if one]

    def remainder_sentences(self) -> list[str]:
        """Return the distances of named fidelities from Richardson's limit, or the settings without one."""
        if not self.remainders:
            without = [one.setting for one in self.settings if one.verdict == "does not converge"] or ["too few levels"]
            return [f"there is no limit for extrapolation, because of {', '.join(without)}"]
        return [
            f"{one.name} is {percent(one.median.value)} (median) and {percent(one.p95.value)} (95 % of points, "
            f"{percent(one.p95.low)} to {percent(one.p95.high)}) from Richardson's limit"
            for one in self.remainders
        ]


Refinements = dict[str, list[tuple[Variant, float]]]  # variants and widths by setting, from coarse to fine


def find_refinements(env: Environment, settings: Sequence[str] = ()) -> Refinements:
    """Return the refinable settings of a scene at its reference, by default all of them.

    Steps that do not divide a control step, and grids that the scene does not have, are left out. Raises ValueError for
    an unknown setting, and where the scene has none of the requested ones.
    """
    refuse_settings(settings, SETTINGS, " in a study of convergence")
    reference, found = Variant.of(env), Refinements()
    for setting in settings or SETTINGS:
        every = {variant.key(): variant for variant in (*_refine(reference, setting, env), reference)}
        levels = [(variant, _width(variant.fidelity, reference.fidelity, setting)) for variant in every.values()]
        if len(levels) > 1:
            found[setting] = sorted(levels, key=lambda level: -level[1])
    if not found:
        raise ValueError(f"{env.name} has none of {', '.join(settings or SETTINGS)} to refine")
    return found


def _width(fidelity: Fidelity, reference: Fidelity, setting: str) -> float:
    """Return the time step [s], or the width of a cell or the distance of particles relative to the reference's."""
    if setting == "dt":
        return fidelity.dt
    if setting == PRECISION:
        return 2.0**-52 if fidelity.precision == "float64" else 2.0**-23
    if setting == "particles":
        fewer = reference.particles / fidelity.particles if fidelity.particles else 1.0
        return reference.sampling / fidelity.sampling * math.cbrt(fewer)
    return reference.resolution / fidelity.resolution if fidelity.resolution else 1.0


def _refine(base: Variant, setting: str, env: Environment) -> Iterator[Variant]:
    """Yield the reference at other levels of a setting."""
    own = base.fidelity
    if setting == "dt" and own.dt:
        steps = [own.dt * factor for factor in DT_FACTORS]
        yield from (base.with_dt(dt) for dt in steps if abs(env.nearest_dt(dt) - dt) < 1e-6 * dt)
    elif setting == JOINT and own.resolution and own.dt:
        # Grid, step and particles together, so that a wave crosses as many cells in a step (Courant's number).
        for finer in FACTORS["resolution"]:
            cells, dt = base.even_cells(finer), env.nearest_dt(own.dt / finer)
            count = {"particles": round(own.particles * (cells / own.resolution) ** 3)} if own.particles else {}
            yield base.refine(JOINT, f"joint-x{finer:.3g}", resolution=cells, dt=dt, **count)
    elif setting != "dt":
        yield from base.vary(setting, FACTORS.get(setting, ()), env)


class ConvergenceStudy(VariantStudy):
    """The levels of each setting of a scene's reference, and the neighbours of its points."""

    kind = "convergence"
    takes = ("settings",)
    what = "levels"
    advice = (
        "plus compiling kernels, and distributions if it is chaotic; fewer --points (16 are enough) or --settings "
        "take less"
    )

    def __init__(self, env: Environment, options: StudyOptions) -> None:
        super().__init__(env, options)
        refuse_single(env)
        self.refinements = find_refinements(env, options.settings)

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers."""
        return {**super().identity(), "settings": list(self.refinements)}

    @cached_property
    def variants(self) -> list[Variant]:
        """The simulations: the reference, the named fidelities, then the refinements."""
        levels = [variant for one in self.refinements.values() for variant, _ in one]
        unique: dict[str, Variant] = {}
        for variant in (Variant.of(self.env), *Variant.all_named(self.env), *levels):
            unique.setdefault(variant.name, variant)
        return list(unique.values())

    def _make(self, variant: Variant) -> Environment:
        """Make a variant's environment. Raises TooLargeError where it does not fit into a CPU's memory."""
        env = variant.make(self.env)
        if env.device == "cpu":
            require("episodes", 1, lambda count: Need(float(count * env.memory())))
        return env

    def expected(self) -> Iterator[Expected]:
        """Yield the variants that are neither measured nor refused, and the neighbours."""
        yield from super().expected()
        if count := self._neighbours(1.0).count_left():
            yield Expected("the divergence of neighbours", self.env, count)

    def _neighbours(self, spread: float) -> Neighbours:
        return Neighbours(self.env, self.x, self.seed, self.checkpoint, spread)

    def run(self, watch: Watch, provenance: Mapping[str, Any], command: str) -> ConvergenceRecord:
        """Measure the missing parts and return the record."""
        samples = samples_of(self.measure_all(watch))
        name = self.variants[0].name
        reference = samples[name].loss
        spread = loss_range(reference[np.isfinite(reference)]) or None
        scale = self._scale(samples, spread or 1.0)
        refined = [one for one in self._refined(samples) if len(one.levels) > 1]
        settings = tuple(conclude(one, name, scale) for one in refined)
        limits = joint_or_single(list(zip(refined, settings, strict=True)))
        losses = {one: samples[one].loss for one in self.env.fidelities if one in samples}
        neighbours = self._neighbours(scale.spread)
        divergence = neighbours.measure_divergence(watch)
        chaos = divergence is not None and divergence.is_chaos
        return ConvergenceRecord(
            **self.about(provenance, command),
            reference=name,
            spread=spread,
            settings=settings,
            rule=judge(settings, scale),
            remainders=estimate_remainders(limits, losses, reference, scale),
            divergence=divergence,
            distributions=neighbours.measure_distributions(self._compared(), watch) if chaos else None,
        )

    def _scale(self, samples: Mapping[str, Sample], spread: float) -> Scale:
        standard = samples.get(list(self.env.fidelities)[-2])
        far = error(standard.loss, samples[self.variants[0].name].loss) if standard else np.empty(0)
        return Scale(spread, sum_up(far, spread, self.seed)[1], self.seed)

    def _refined(self, samples: Mapping[str, Sample]) -> Iterator[Levels]:
        for setting, every in self.refinements.items():
            known = [(variant, width) for variant, width in every if variant.name in samples]
            found = [samples[variant.name] for variant, _ in known]
            levels = [
                Level(variant.name, width, variant.fidelity, sample.with_gradient)
                for (variant, width), sample in zip(known, found, strict=True)
            ]
            losses, gradients = ([getattr(sample, name) for sample in found] for name in ("loss", "grad"))
            yield Levels(setting, levels, np.array(losses), gradients, self.env.designed_order.get(setting))

    def _compared(self) -> list[Variant]:
        """Return the variants to compare with the reference by distributions: named fidelities, and refinements.

        Of a setting it is the step just finer than the reference; refused ones are left out.
        """
        found = [one for one in self.variants[1:] if one.name in self.env.fidelities]
        for levels in self.refinements.values():
            variants = [variant for variant, _ in levels]
            place = [one.name for one in variants].index(self.variants[0].name)
            found += variants[place + 1 : place + 2]
        return [one for one in found if one.name not in self.refused]


@dataclass(frozen=True, eq=False)
class Levels:
    """The levels of one setting, from coarse to fine, their results, and the order of the scene's method.

    `losses`, shape (level, point), NaN where a point failed; `gradients`, shape (point, dim) each.
    """

    setting: str
    levels: Sequence[Level]
    losses: Array
    gradients: Sequence[Array]
    designed: float | None

    @property
    def widths(self) -> list[float]:
        """The width of each level."""
        return [level.width for level in self.levels]


@dataclass(frozen=True)
class Scale:
    """The scale of differences: shares of the `spread` of losses, from a `seed`; `off` is standard's error."""

    spread: float
    off: Bootstrap
    seed: int

    def meets(self, moved: float | None) -> bool | None:
        """Return whether a change is rounding or within a tenth of standard's error, None where one is unknown."""
        if self.off.value is None:
            return None
        return moved is not None and moved <= max(ALLOWED * self.off.value, UNMOVED)


def error(values: Array, reference: Array) -> Array:
    """Return |difference| at the points where the reference has a loss, infinite where only it has one."""
    known = np.isfinite(reference)
    return np.nan_to_num(np.abs(values - reference)[known], nan=np.inf)


def sum_up(errors: Array, spread: float, seed: int) -> tuple[Bootstrap, Bootstrap]:
    """Return the median and the 95th percentile of errors, as shares of the spread."""
    median, p95 = (Bootstrap.of(of, errors, seed=seed).share(spread) for of in (median_of, p95_of))
    return median, p95


def conclude(levels: Levels, reference: str, scale: Scale) -> SettingConvergence:
    """Return the results of a setting's levels; one of them is the `reference`."""
    order = measure_order(levels.widths, levels.losses, scale=scale.spread, seed=scale.seed)
    moves = [_move(levels, place, scale) for place in range(len(levels.levels) - 1)]
    place = [level.name for level in levels.levels].index(reference)
    beyond = moves[place:]
    met = [scale.meets(move.p95.value) for move in beyond]
    return SettingConvergence(
        setting=levels.setting,
        levels=tuple(levels.levels),
        moves=tuple(moves),
        verdict=order.verdict,
        order=order.pooled,
        per_point=tuple(finite(float(one)) for one in order.per_point),
        shapes=order.shapes,
        designed=levels.designed,
        floor=find_floor([move.median.value for move in moves], order.verdict),
        moved=beyond[0].p95 if beyond else None,
        met=met[0] if met else None,
        met_from=next((move.coarse for move, yes in zip(beyond, met, strict=True) if yes), None),
    )


def _move(found: Levels, place: int, scale: Scale) -> Move:
    (coarse, fine), (first, second) = found.losses[place : place + 2], found.levels[place : place + 2]
    both, either = np.isfinite(coarse) & np.isfinite(fine), np.isfinite(coarse) | np.isfinite(fine)
    angles = gradient_error(*(grad[both] for grad in found.gradients[place : place + 2]))
    cosine, off = (Bootstrap.of(median_of, one, seed=scale.seed) for one in angles)
    errors = np.nan_to_num(np.abs(coarse - fine)[either], nan=np.inf)
    median, p95 = sum_up(errors, scale.spread, scale.seed)
    return Move(first.name, second.name, first.width, median, p95, cosine, off, int(both.sum()))


def judge(settings: Sequence[SettingConvergence], scale: Scale) -> ConvergenceRule:
    """Apply the rule: refining a reference changes losses by rounding, or by less than a tenth of standard's error."""
    known = [one for one in settings if one.setting != PRECISION and one.moved is not None]
    worst = max(known, key=_moved, default=None)
    met = [one.met for one in known]
    return ConvergenceRule(
        scale.off,
        worst.moved if worst else None,
        worst.setting if worst else None,
        None if not met or None in met else all(met),
        tuple(one.setting for one in known if one.met is False),
    )


def _moved(one: SettingConvergence) -> float:
    value = one.moved.value if one.moved else None
    return np.inf if value is None else value


Refined = Sequence[tuple[Levels, SettingConvergence]]


def joint_or_single(refined: Refined) -> Refined:
    """Return the settings whose corrections add up to the scene's limit: only the joint one where there is one."""
    joint = [pair for pair in refined if pair[0].setting == JOINT]
    return joint or [pair for pair in refined if pair[0].setting != PRECISION]


def estimate_remainders(
    refined: Refined, named: Mapping[str, Array], reference: Array, scale: Scale
) -> tuple[Remainder, ...]:
    """Estimate the distance of `named` losses from Richardson's limit, shape (point,) each.

    Corrections of the settings add up to leading order. Each draw of the bootstrap measures the orders again, unless
    designed ones are used. Empty where some setting has no limit.
    """
    corrections = [_Correction.of(levels, found, reference) for levels, found in refined]
    every = [one for one in corrections if one is not None]
    if not every or len(every) < len(corrections):
        return ()
    rows = np.flatnonzero(np.isfinite(np.array([reference, *(one.levels.losses[-1] for one in every)])).all(axis=0))
    rows = rows[np.isfinite(np.array([one.at(rows, rows) for one in every])).all(axis=0)]
    return tuple(Remainder(name, *_left(every, rows, losses, reference, scale)) for name, losses in named.items())


def _left(
    every: Sequence[_Correction], rows: NDArray[np.int64], losses: Array, reference: Array, scale: Scale
) -> list[Bootstrap]:
    known: dict[bytes, Array] = {}  # both statistics are of the same draws

    def errors(drawn: NDArray[np.int64]) -> Array:
        if drawn.tobytes() not in known:
            limit = reference[drawn] + sum(one.at(drawn, drawn) for one in every)
            known[drawn.tobytes()] = np.nan_to_num(np.abs(losses[drawn] - limit), nan=np.inf)
        return known[drawn.tobytes()]

    def of(statistic: Any) -> Any:
        return lambda drawn: np.apply_along_axis(lambda one: statistic(errors(one)), -1, drawn)

    # What is drawn, as samples are elsewhere, are the places of points.
    return [Bootstrap.of(of(one), rows, seed=scale.seed).share(scale.spread) for one in (median_of, p95_of)]


@dataclass(frozen=True, eq=False)
class _Correction:
    """The correction from the reference to the limit of one setting; `by` is a fixed order, None to measure it."""

    levels: Levels
    by: float | None
    still: bool
    reference: Array

    @classmethod
    def of(cls, levels: Levels, found: SettingConvergence, reference: Array) -> _Correction | None:
        by = choose_order(found.verdict, found.order, levels.designed)
        if found.verdict == "unmoved":
            return cls(levels, None, True, reference)
        return None if by is None else cls(levels, by if by == levels.designed else None, False, reference)

    def at(self, rows: NDArray[np.int64], drawn: NDArray[np.int64]) -> Array:
        """Return the correction at points, by the order from the `drawn` points."""
        losses, widths = self.levels.losses, self.levels.widths
        if self.still:
            return np.asarray(losses[-1][rows] - self.reference[rows])
        order = self.by or self._order(drawn)
        if not order > 0:  # a draw that shows none is as far off as can be
            return np.full(len(rows), np.inf)
        return np.asarray(extrapolate(widths, losses[:, rows], order) - self.reference[rows])

    def _order(self, drawn: NDArray[np.int64]) -> float:
        losses = self.levels.losses[:, drawn]
        losses = losses[:, np.isfinite(losses[-3:]).all(axis=0)]
        first = next(k for k in range(len(losses)) if np.isfinite(losses[k:]).all())
        moves = np.median(np.abs(np.diff(losses[first:], axis=0)), axis=-1)
        return float(fit_order(self.levels.widths[first:], moves))
