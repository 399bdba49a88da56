"""The study `fidelity`: accuracy against speed of a scene's fidelities, and of changes to them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ..envs.records import Fidelity
from ..landscapes.sampling.memory import sparing_collections
from ..landscapes.statistics import fit_line
from . import samples
from .samples import Comparison, Sample, compare, pareto_front, spread
from .variants import Expected, StudyRecord, Variant, VariantStudy, refuse_settings, refuse_single, samples_of

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from .samples import Follow
    from .variants import StudyOptions

SETTINGS = ("dt", "resolution", "particles", "precision", "stiffness", "engine", "device")
FACTORS = {"dt": (0.5, 2.0, 4.0), "resolution": (2 / 3, 1.5), "particles": (0.5, 2.0)}
STIFFNESS_FACTORS = (0.25, 0.5, 2.0, 4.0)
MIN_ERRORS = 3  # that an order of convergence is fitted to
IN_TURN = "timed-in-turn"  # the part of the checkpoint that holds these times
OUT_OF_REACH = 3.0  # times the reference's time: a variant that takes more is measured at its first points alone


@dataclass(frozen=True)
class MeasuredVariant:
    """One way to simulate a scene and its measurements.

    `changed` names the setting that differs from a named fidelity, "named" where none does; `memory` is the scene's own
    estimate for an episode [bytes]. A variant that takes far longer than the reference is `given_up` after that many
    points, 0 for others.
    """

    name: str
    changed: str
    fidelity: Fidelity
    engine: str
    device: str
    options: dict[str, Any]
    memory: int | None
    comparison: Comparison
    given_up: int = 0

    @property
    def seconds(self) -> float:
        """Time of an episode with gradient [s]."""
        return self.comparison.seconds.with_gradient

    def p95(self, *, relative: bool) -> float | None:
        """Return the 95th percentile of loss errors, as a share of the spread or in the loss's unit."""
        error = self.comparison.loss_error
        return (error.p95_relative if relative else error.p95).value

    def differs_beyond_dt(self, other: MeasuredVariant) -> bool:
        """Return whether they differ in more than time step and precision."""
        return self._others() != other._others()

    def _others(self) -> tuple[Any, ...]:
        same = {**self.fidelity.record(), "name": "", "dt": 0, "precision": ""}
        return same, self.engine, self.device, self.options


@dataclass(frozen=True)
class ConvergenceOrder:
    """The order p of error ~ dt^p, fitted to some variants, with its standard error."""

    variants: tuple[str, ...]
    order: float
    standard_error: float


@dataclass(frozen=True, kw_only=True)
class FidelityRecord(StudyRecord):
    """The variants of a scene at the same points, all compared with the first of them, the reference.

    `spread` is the 5th to 95th percentile of the reference's losses [`loss_unit`], None where they are all equal;
    `reference_failed` counts points that are left out because the reference fails there.
    """

    kind: ClassVar[str] = "fidelity"

    reference: str
    spread: float | None
    reference_failed: int
    variants: tuple[MeasuredVariant, ...]
    orders: tuple[ConvergenceOrder, ...]

    @property
    def by_time(self) -> list[MeasuredVariant]:
        """The variants, the fastest first."""
        return sorted(self.variants, key=lambda one: one.seconds)

    @property
    def front(self) -> list[str]:
        """The Pareto front: the variants faster than the reference that no other beats in both, fastest first."""
        rows = self.by_time
        others = rows[: [row.name for row in rows].index(self.reference)]  # a slower one is beaten by it
        errors = [math.inf if (off := row.p95(relative=False)) is None else off for row in others]
        return [others[number].name for number in pareto_front([row.seconds for row in others], errors)]

    def variant(self, name: str) -> MeasuredVariant:
        """Return a measured variant by its name."""
        return next(one for one in self.variants if one.name == name)

    def cheapest(self, tolerance: float) -> MeasuredVariant | None:
        """Return the fastest variant except the reference within a share of the spread, None if none."""
        others = [row for row in self.by_time if row.name != self.reference and not row.given_up]
        return next((row for row in others if (off := row.p95(relative=True)) is not None and off <= tolerance), None)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each variant, the fastest first.

        Columns: `changed`; `median` and `p95`, loss errors as shares of the spread, with the ends of the latter's 95 %
        interval; `spearman`, `cosine`, `relative_error`, `diverged`; `forward` and `with_gradient` [s per episode];
        `memory` [bytes per episode]; `front`, whether it is on the Pareto front.
        """
        front = set(self.front)
        for row in self.by_time:
            yield {
                **{"name": row.name, "changed": row.changed, **row.comparison.columns()},
                **{**asdict(row.comparison.seconds), "memory": row.memory, "front": row.name in front},
            }

    def sentences(self) -> list[str]:
        """Return the orders of convergence in dt, and the abandoned variants."""
        lost = [f"{one.name} after {one.given_up} of {self.points}" for one in self.variants if one.given_up]
        said = [f"abandoned, at more than {OUT_OF_REACH:g} times the reference's time: {', '.join(lost)} points"]
        return said * bool(lost) + [
            f"error ~ dt^{fit.order:z.2f} ± {fit.standard_error:.2f}: {', '.join(fit.variants)}" for fit in self.orders
        ]


class FidelityStudy(VariantStudy):
    """Time and loss errors of each named fidelity, and of each changed in one setting at a time.

    The reference is the last named fidelity.
    """

    kind = "fidelity"
    takes: ClassVar[tuple[str, ...]] = ("settings",)
    advice = "plus compiling kernels, minutes for taichi; fewer --points or --settings take less"

    def __init__(self, env: Environment, options: StudyOptions) -> None:
        super().__init__(env, options)
        self._variants = self._list_variants()
        self._made: dict[str, Environment] = {}

    def _list_variants(self) -> list[Variant]:
        refuse_single(self.env)
        return list_variants(self.env, self.options.settings or SETTINGS)

    @property
    def variants(self) -> list[Variant]:
        """The reference, the named fidelities, and their changes."""
        return self._variants

    def measure(self, variant: Variant, follow: Follow) -> Mapping[str, Any]:
        """Return the arrays of a variant's sample, with its times."""
        reference = self.checkpoint.load(self.part(self.variants[0]))
        limit = math.inf if reference is None else OUT_OF_REACH * float(reference["with_gradient"])
        env, by = self._make(variant), self.evaluates(variant)
        if variant.device == "cpu":
            self._made[variant.name] = env
        found = samples.measure(env, self.x, follow=follow, limit=limit, by=by).arrays()
        env.release()
        return found

    def _expect(self, variant: Variant, env: Environment) -> Expected:
        return Expected(variant.name, env, len(self.x), partial(samples.repeat_seconds, env, len(self.x)))

    def run(self, watch: Watch, provenance: Mapping[str, Any], command: str) -> FidelityRecord:
        """Measure the missing parts and return the record."""
        with sparing_collections():
            found = self._time_in_turn(samples_of(self.measure_all(watch)), watch)
        return self.conclude(found, provenance, command)

    def _time_in_turn(self, found: Mapping[str, Sample], watch: Watch) -> dict[str, Sample]:
        """Time fast variants again, all in each turn, so that other load on the machine affects all of them."""
        kept, quick = self.checkpoint.load(IN_TURN), [one for one in self.variants if self._is_quick(found, one)]
        names, times = [one.name for one in quick], ("forward", "with_gradient")
        if kept is None or kept["names"].tolist() != names:
            timed = {name: found[name] for name in names}
            with watch.busy(f"{self.env.name}: timing {len(names)} {self.what} in turn"):
                for one in quick * (samples.TURNS - 1):
                    timed[one.name] = samples.time_again(self._remade(one), self.x, timed[one.name])
                    self._remade(one).release()
            kept = {part: np.array([getattr(one, part) for one in timed.values()]) for part in times}
            self.checkpoint.save(IN_TURN, names=np.array(names), **kept)
        rows = zip(names, *(kept[part].tolist() for part in times), strict=True)
        again = {name: replace(found[name], forward=forward, with_gradient=both) for name, forward, both in rows}
        return {**found, **again}

    def _is_quick(self, found: Mapping[str, Sample], variant: Variant) -> bool:
        return variant.device == "cpu" and variant.name in found and found[variant.name].quick

    def _remade(self, variant: Variant) -> Environment:
        """Return the measured environment, made again if an earlier process measured it."""
        if variant.name not in self._made:
            self._made[variant.name] = self._make(variant)
        return self._made[variant.name]

    def conclude(self, found: Mapping[str, Sample], provenance: Mapping[str, Any], command: str) -> FidelityRecord:
        """Compare the samples with that of the reference, which is the first variant."""
        reference = found[self.variants[0].name]
        rows = tuple(
            self.compare(variant, found[variant.name], reference) for variant in self.variants if variant.name in found
        )
        return FidelityRecord(
            **self.about(provenance, command),
            reference=self.variants[0].name,
            spread=spread(reference),
            reference_failed=len(self.x) - rows[0].comparison.compared,
            variants=rows,
            orders=fit_orders(rows),
        )

    def compare(self, variant: Variant, sample: Sample, reference: Sample) -> MeasuredVariant:
        """Compare a variant's sample with the reference's."""
        memory, points = variant.make(self.env).memory(), len(sample.loss)
        return MeasuredVariant(
            name=variant.name,
            changed=variant.changed,
            fidelity=variant.fidelity,
            engine=variant.engine,
            device=variant.device,
            options=variant.options,
            memory=memory,
            comparison=compare(sample, reference, seed=self.seed),
            given_up=points if points < len(self.x) else 0,
        )


def list_variants(env: Environment, settings: Sequence[str]) -> list[Variant]:
    """Return the variants of a scene, the reference first, without duplicates under other names.

    `env` is the reference, the last of the named fidelities. Each named fidelity is a variant, with its engine, device
    and options. All settings of the others are changed, and precision and device of the reference too. Raises
    ValueError for an unknown setting.
    """
    refuse_settings(settings, SETTINGS)
    named = Variant.all_named(env)
    found = [Variant.of(env), *named]
    for setting in SETTINGS:
        for base in named if setting in ("precision", "device") else named[:-1]:
            found += _changes(base, setting, env) if setting in settings else ()
    unique: dict[tuple[Any, ...], Variant] = {}
    for variant in found:
        unique.setdefault(variant.key(), variant)
    return list(unique.values())


def _changes(base: Variant, setting: str, env: Environment) -> Iterator[Variant]:
    """Yield the variants that differ from a named fidelity in one setting."""
    yield from base.vary(setting, FACTORS.get(setting, ()), env)
    if setting == "stiffness" and (option := env.contact_stiffness):
        for factor in STIFFNESS_FACTORS:
            options = base.options | {option: base.options[option] * factor}
            yield base.change(f"{base.name}-{option}-x{factor:g}", setting, options=options)
    elif setting in ("engine", "device"):
        for other in env.engines if setting == "engine" else env.devices:
            if other != getattr(base, setting):
                yield base.change(f"{base.name} on {other}", setting, **{setting: other})


def fit_orders(variants: tuple[MeasuredVariant, ...]) -> tuple[ConvergenceOrder, ...]:
    """Fit the order of convergence in dt of the variants that differ from the first in it, and at most in precision.

    With another resolution the errors would level off at the error of the resolution.
    """
    reference, found = variants[0], list[ConvergenceOrder]()
    for precision in ("float32", "float64"):
        members = [
            (one.fidelity.dt, error, one.name)
            for one in variants
            if not one.differs_beyond_dt(reference)
            and not one.given_up
            and one.fidelity.precision == precision
            and one.fidelity.dt > reference.fidelity.dt
            and (error := one.comparison.loss_error.median.value)
        ]
        if fit := fit_order_in_dt(sorted(members, reverse=True)):
            found.append(fit)
    return tuple(found)


def fit_order_in_dt(members: Sequence[tuple[float, float, str]]) -> ConvergenceOrder | None:
    """Fit error ~ dt^p to (dt, error, name); return None below three errors that are positive and finite."""
    pairs = [(dt, error) for dt, error, _ in members if np.isfinite(error) and error > 0]
    if len(pairs) < MIN_ERRORS:
        return None
    fit = fit_line(*np.log(pairs).T)
    return ConvergenceOrder(tuple(name for *_, name in members), fit.slope, fit.standard_error)
