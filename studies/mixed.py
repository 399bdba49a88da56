"""The study `mixed`: what draft and standard should be, by a search in which all settings change together.

It searches for the cheapest variant that keeps the claim of a fidelity's name. Starting at the named fidelities, it
walks along the front. The neighbours of its members are measured, beginning with the member closest to a claim's limit,
until no member has an unmeasured neighbour. On a CPU a variant is first tried at a few points, and abandoned where it
fails or is certainly beaten there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ..envs.records import Fidelity
from ..landscapes.sampling.memory import free_memory
from . import samples
from .claims import CLAIMS, Choice, Claim, Shortfall, choose, fronts, nearness, surely_beaten
from .fidelity import FidelityRecord, FidelityStudy, MeasuredVariant
from .samples import Sample, interval_columns
from .variants import Refused, Study, StudyRecord, Variant, expected_work, read_positive, seconds_with_gradient

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from .variants import StudyOptions

DT_RATIO, CELL_RATIO, PARTICLE_RATIO, STIFFNESS_RATIO = 1.5, 1.25, 2.0, 2.0  # of one value of a setting to the next
SAME_SHARE = 0.1  # two values that differ by less than this share are the same
MIN_CELLS, MIN_PARTICLES, MAX_STIFFNESS_FACTOR = 4, 50, 8.0  # where values end; of a stiffness, times its default
MIXED = "mixed"  # what changes of such a variant: several settings together
FIRST_POINTS = 16  # of the first trial on a CPU; a GPU simulates points side by side, so that few save nothing
PATIENCE = 0.5  # seconds of repetitions that time a variant, each way
CLOSE_COST, ROUNDS = 1.5, 3  # costs, in times the cheapest one's, that are timed again, in turn, and how often
MAX_COST, TIME_LIMIT = 4.0, 600.0  # in times today's cost, and [s]
TIMED_AGAIN, TIMED_ON_CPU = "timed again", "timed on cpu"  # parts with seconds, by the names of variants
Costs = dict[str, dict[str, float]]


@dataclass(frozen=True, kw_only=True)
class MixedRecord(StudyRecord):
    """A search of the front on mixed variants, and the choices from it.

    `measured` are the variants measured at all points, `dismissed` those abandoned after the first points, with the
    reason. `choices` are among variants with the scene's own options, `with_options` those that another option would
    make cheaper or more accurate. `cost_device` is the device of a claim's costs, by its name; `lines` are of Python.
    `complete`: no neighbour of the front was left; otherwise the search ended after `time_limit` seconds. If the motion
    is `chaotic`, gradients are no criterion.
    """

    kind: ClassVar[str] = MIXED
    index: ClassVar[tuple[str, ...]] = ("claim", "which")

    measured: FidelityRecord
    choices: tuple[Choice, ...]
    with_options: tuple[Choice, ...]
    dismissed: tuple[Refused, ...]
    cost_device: dict[str, str]
    lines: tuple[str, ...]
    max_cost: float
    time_limit: float
    spent: float
    complete: bool
    chaotic: bool

    def to_keep(self) -> StudyRecord | None:
        """Return the measurements of the variants."""
        return self.measured.to_keep()

    def variant(self, name: str) -> MeasuredVariant:
        """Return a measured variant by its name."""
        return self.measured.variant(name)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield two rows for each claim: the variant with its name `today`, and the one `chosen`.

        Columns: `variant`; `rank`, `cosine` and `error`, the 95th percentile of loss errors as a share of the spread,
        each with the ends of its 95 % interval; `seconds` per episode with gradient, on `device`; `shortfall`, the
        largest shortfall relative to the claim's limit, and `kept`, whether that is at most 1.
        """
        for one in self.choices:
            yield from self._rows(one)

    def _rows(self, one: Choice) -> Iterator[dict[str, Any]]:
        today = ("today", one.claim.name, one.today_seconds, one.today_shortfall)
        for which, name, seconds, shortfall in (today, ("chosen", one.variant, one.seconds, one.shortfall)):
            if name is None:
                continue
            found = self.variant(name).comparison
            parts = {"rank": found.spearman, "cosine": found.gradient.cosine, "error": found.loss_error.p95_relative}
            ends = [interval_columns(part, value).items() for part, value in parts.items()]
            yield {
                **{"claim": one.claim.name, "which": which, "variant": name, **dict(chain.from_iterable(ends))},
                **{"seconds": seconds, "device": self.cost_device[one.claim.name]},
                **{"shortfall": shortfall, "kept": shortfall is not None and shortfall <= 1},
            }

    @property
    def chosen(self) -> dict[str, str]:
        """The chosen variants, by the names of their fidelities."""
        return {one.claim.name: one.variant for one in self.choices if one.variant is not None}

    def sentences(self) -> list[str]:
        """Describe the choice of the variants, the missing ones, and the lines of Python."""
        said = [self._sentence(one) for one in self.choices]
        own = self.identity["options"]
        for one in self.with_options:
            options = self.variant(one.variant).options if one.variant else {}
            others = ", ".join(f"{name}={value!r}" for name, value in options.items() if value != own[name])
            said.append(f"with {others} {one.claim.name} would be {one.variant}, {1e3 * (one.seconds or 0):.3g} ms")
        if self.chaotic:
            said.append("the motion is chaotic: gradients are no criterion")
        end = "no neighbour of the front is left" if self.complete else f"its limit is {self.time_limit:g} s"
        return [*said, f"the search ended after {self.spent:.3g} s: {end}", *self.lines]

    def _sentence(self, one: Choice) -> str:
        claim, device = one.claim, self.cost_device[one.claim.name]
        wanted = f"rank {claim.rank:g}, " + ("" if self.chaotic else f"cosine {claim.cosine:g}, ")
        what = f"{claim.name} ({wanted}95 % error {claim.error:.0%}; ms on {device})"
        within = f"{self.max_cost:g} times today's cost"
        if one.variant is None:
            return f"{what}: no variant within {within} succeeds at every point"
        if one.kept:
            return f"{what}: the cheapest that keeps it; {one.candidates} variants are within {within}"
        return (
            f"{what}: none of {one.candidates} within {within} keeps it, so this is the nearest; its largest "
            f"shortfall is in {one.lacking}"
        )


class MixedStudy(FidelityStudy):
    """Search the front of a scene's variants in which several settings change together.

    A variant expected to cost more than `max_cost` times standard is not measured, and nothing is measured after
    `time_limit` seconds.
    """

    kind = MIXED
    describe_kept = Study.describe_kept  # nobody knows how many there will be
    takes = ("max_cost", "time_limit", "chaotic")
    advice = "plus a search among their neighbours, of at most --time-limit seconds"

    def __init__(self, env: Environment, options: StudyOptions) -> None:
        self.max_cost = read_positive("--max-cost", options.max_cost, MAX_COST)
        self.time_limit = read_positive("--time-limit", options.time_limit, TIME_LIMIT)
        self.chaotic = options.chaotic
        super().__init__(env, options)
        self.samples: dict[str, Sample] = {}
        self.rows: dict[str, MeasuredVariant] = {}
        self.begun: dict[str, MeasuredVariant] = {}
        self.dismissed: dict[str, str] = {}
        self.took: dict[str, float] = {}
        self.works: dict[tuple[Any, ...], float] = {}

    def _list_variants(self) -> list[Variant]:
        return [Variant.of(self.env), *(named_variant(self.env, claim) for claim in CLAIMS)]

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers."""
        limits = {"max_cost": self.max_cost, "time_limit": self.time_limit, "chaotic": self.chaotic}
        return {**super().identity(), **limits}

    def run(self, watch: Watch, provenance: Mapping[str, Any], command: str) -> MixedRecord:  # type: ignore[override]
        """Measure the missing parts, the reference and the named fidelities first, and return the record.

        Raises ValueError where a named fidelity cannot be measured.
        """
        with watch.busy(self.env.name) as say:
            for variant in list(self.variants):
                self._measure_named(variant, say)
            complete = self._search(say)
            self._time_again(say)
            costs = self._final_costs(say)
        own = self._choose(costs, [row for row in self._measured if self._has_own_options(row)])
        able = self._choose(costs, self._measured)
        local = self.env.device == "cpu" or "cpu" not in self.env.devices
        measured = self.conclude(self.samples, provenance, command)
        return MixedRecord(
            **self.about(provenance, command),
            measured=measured,
            choices=own,
            with_options=tuple(one for one, same in zip(able, own, strict=True) if one.variant != same.variant),
            dismissed=tuple(Refused(name, why) for name, why in self.dismissed.items()),
            cost_device={"draft": self.env.device if local else "cpu", "standard": self.env.device},
            lines=tuple(self._line(one) for one in own if one.variant is not None),
            max_cost=self.max_cost,
            time_limit=self.time_limit,
            spent=self.spent,
            complete=complete,
            chaotic=self.chaotic,
        )

    @property
    def spent(self) -> float:
        """Time of the variants measured by the search so far [s], in all its runs."""
        return sum(self.took.values())

    @property
    def _measured(self) -> list[MeasuredVariant]:
        """The measurements of all variants but the reference."""
        return [self.rows[variant.name] for variant in self.variants[1:]]

    def _measure_named(self, variant: Variant, say: Callable[[str], None]) -> None:
        say(f"{variant.name} at {len(self.x)} points")
        sample = self._load(variant)
        if sample is None or len(sample.loss) < len(self.x):
            sample = self._take(variant, self.x)
        if sample is None:
            raise ValueError(f"{self.env.name} cannot be measured at {variant.name}: {self.refused[variant.name]}")
        self._accept(variant, sample)
        self.took[variant.name] = 0.0  # the limit is that of the search

    def _search(self, say: Callable[[str], None]) -> bool:
        """Measure neighbours of the front while there are any and time is left; return whether none is left."""
        seen = {variant.key() for variant in self.variants}
        while ahead := self._ahead(seen):
            for variant in ahead:
                if self.spent >= self.time_limit:
                    return False
                seen.add(variant.key())
                say(f"{len(self.samples)} measured, {len(self.dismissed)} abandoned; {variant.name}")
                self._try(variant)
        return True

    def _ahead(self, seen: set[tuple[Any, ...]]) -> list[Variant]:
        """Return the variants to measure next: affordable neighbours of the member closest to a claim's limit."""
        found = {variant.name: variant for variant in self.variants[1:]}
        limit = self.max_cost * self.rows["standard"].seconds
        members = self._members()
        for last in (False, True):  # the other precision, which is seldom what losses lack, comes last
            for name in members:
                of, rate = found[name], self.rows[name].seconds / self._work(found[name])
                able = [
                    variant
                    for variant in neighbours(of, self._named("standard"), self.env)
                    if variant.key() not in seen
                    and (variant.fidelity.precision != of.fidelity.precision) == last
                    and rate * self._work(variant) <= limit
                ]
                if able:
                    return sorted(able, key=self._work)
        return []

    def _members(self) -> list[str]:
        """Return the front of the variants with the scene's own options, then that of all, nearest to a limit first."""
        rows, found = self._measured, list[str]()
        for among in ([row for row in rows if self._has_own_options(row)], rows):
            members = fronts(among, self._costs(), chaotic=self.chaotic)
            found += sorted(members, key=lambda name: nearness(self.rows[name].comparison, chaotic=self.chaotic))
        return list(dict.fromkeys(found))

    def _has_own_options(self, one: MeasuredVariant | Variant) -> bool:
        return one.options == self.variants[0].options

    def _named(self, name: str) -> Variant:
        return next(variant for variant in self.variants if variant.name == name)

    def _work(self, variant: Variant) -> float:
        """Return the expected cost of an episode of a variant, infinite where the scene refuses it."""
        if variant.key() not in self.works:
            self.works[variant.key()] = math.inf
            with self.refusing(variant.name):
                self.works[variant.key()] = expected_work(self._make(variant))
        return self.works[variant.key()]

    def _try(self, variant: Variant) -> None:
        """Measure a variant at a few points, and if it is promising at the others."""
        few = len(self.x) if self.env.device == "cuda" else min(FIRST_POINTS, len(self.x))
        sample = self._load(variant) or self._take(variant, self.x[:few])
        if sample is not None and len(sample.loss) < len(self.x):
            if why := self._hopeless(variant, sample):
                self.dismissed[variant.name] = why
                return
            sample = self._take(variant, self.x[len(sample.loss) :], sample)
        if sample is not None:
            self.variants.append(variant)
            self._accept(variant, sample)

    def _hopeless(self, variant: Variant, sample: Sample) -> str:
        """Explain why a variant is abandoned after its first points, empty where it is not."""
        points = len(sample.loss)
        row = self.compare(variant, sample, self._reference.first(points))
        if (failed := row.comparison.diverged) != 0:
            return f"fails at {failed or 1:.0%} of {points} points"
        others = [
            self._begun(one, points)
            for one in self.variants[1:]
            if self.rows[one.name].seconds < row.seconds
            and (self._has_own_options(one) or not self._has_own_options(variant))
        ]
        if surely_beaten(row, others, chaotic=self.chaotic):
            return f"faster ones are certainly closer at {points} points"
        return ""

    def _begun(self, variant: Variant, points: int) -> MeasuredVariant:
        """Return the results of a measured variant at its first points alone."""
        if variant.name not in self.begun:
            sample = self.samples[variant.name].first(points)
            self.begun[variant.name] = self.compare(variant, sample, self._reference.first(points))
        return self.begun[variant.name]

    @property
    def _reference(self) -> Sample:
        return self.samples[self.variants[0].name]

    def _load(self, variant: Variant) -> Sample | None:
        if (arrays := self.checkpoint.load(variant.name)) is None:
            return None
        self.took[variant.name] = float(arrays.pop("took"))
        return Sample.of_arrays(arrays)

    def _take(self, variant: Variant, x: Tensor, before: Sample | None = None) -> Sample | None:
        """Measure a variant at some of the points, and store that with those `before`; None if impossible."""
        started, sample = time.perf_counter(), None
        free_memory()
        with self.refusing(variant.name):
            sample = samples.measure(self._make(variant), x, patience=PATIENCE, by=self.evaluates(variant))
        self.took[variant.name] = self.took.get(variant.name, 0.0) + time.perf_counter() - started
        if sample is None:
            return None
        whole = sample if before is None else before.join(sample)
        self.checkpoint.save(variant.name, **whole.arrays(), took=np.array(self.took[variant.name]))
        return whole

    def _accept(self, variant: Variant, sample: Sample) -> None:
        self.samples[variant.name] = sample
        self.rows[variant.name] = self.compare(variant, sample, self._reference)

    def _costs(self) -> Costs:
        """Return the cost for each claim: standard's is that of the device, a draft's that of a CPU.

        On a GPU a draft's cost is the work of an episode, in the seconds of today's draft there.
        """
        here = {name: row.seconds for name, row in self.rows.items()}
        if self.env.device == "cpu":
            return {claim.name: here for claim in CLAIMS}
        work = {variant.name: self._work(variant) for variant in self.variants}
        rate = here["draft"] / work["draft"]
        return {"draft": {name: rate * count for name, count in work.items()}, "standard": here}

    def _time_again(self, say: Callable[[str], None]) -> None:
        """Time the candidates and the named variants in turn, so that no busy moment decides between them."""
        names = sorted({name for claim in CLAIMS for name in self._contenders(claim, self._costs())})
        for name, seconds in self._keep_seconds(TIMED_AGAIN, names, lambda: self._rounds(names, say)).items():
            sample = self.samples[name]
            self._accept(self._named(name), replace(sample, with_gradient=min(seconds, sample.with_gradient)))

    def _contenders(self, claim: Claim, costs: Costs) -> list[str]:
        """Return the named variants and those that keep a claim at about the lowest cost."""
        kept = {
            name: costs[claim.name][name]
            for name, row in self.rows.items()
            if Shortfall.of(row.comparison, claim, chaotic=self.chaotic).kept and name != self.variants[0].name
        }
        close = [name for name, cost in kept.items() if cost <= CLOSE_COST * min(kept.values())]
        return [*(one.name for one in CLAIMS), *close]

    def _rounds(self, names: Sequence[str], say: Callable[[str], None]) -> dict[str, float]:
        best = dict.fromkeys(names, math.inf)
        for turn in range(ROUNDS):
            for name in names:
                say(f"timing {len(names)} once more, in turn, {turn + 1} of {ROUNDS}; {name}")
                free_memory()
                best[name] = min(best[name], self._batch_seconds(name))
        return best

    def _batch_seconds(self, name: str) -> float:
        """Time a batch of a variant, the second after it is made [s per episode with gradient]."""
        env, rows = self._named(name).make(self.env), self.samples[name].batch
        batch = self.x.repeat(-(-rows // len(self.x)), 1)[:rows]
        env.evaluate(batch, grad=True)
        began = time.perf_counter()
        env.evaluate(batch, grad=True)
        return (time.perf_counter() - began) / rows

    def _keep_seconds(
        self, part: str, names: Sequence[str], time_them: Callable[[], dict[str, float]]
    ) -> dict[str, float]:
        """Return the stored seconds of variants by name; they are timed again if the part is for others."""
        arrays = self.checkpoint.load(part)
        if arrays is not None and set(map(str, arrays["names"])) == set(names):
            return dict(zip(map(str, arrays["names"]), map(float, arrays["seconds"]), strict=True))
        found = time_them()
        self.checkpoint.save(part, names=np.array(list(found)), seconds=np.array(list(found.values())))
        return found

    def _final_costs(self, say: Callable[[str], None]) -> Costs:
        """Return the deciding costs: on a GPU, candidates for a draft are timed on the CPU.

        Costs of the others are their work, in the seconds of today's draft on the CPU.
        """
        costs = self._costs()
        if self.env.device == "cpu" or "cpu" not in self.env.devices:
            return costs
        names = [name for name in dict.fromkeys(self._contenders(CLAIMS[0], costs)) if name != "standard"]
        timed = self._keep_seconds(TIMED_ON_CPU, names, lambda: {name: self._cpu_seconds(name, say) for name in names})
        rate = timed["draft"] / costs["draft"]["draft"]
        return costs | {"draft": {name: rate * cost for name, cost in costs["draft"].items()} | timed}

    def _cpu_seconds(self, name: str, say: Callable[[str], None]) -> float:
        say(f"timing {name} on the CPU, where a draft's cost counts")
        return seconds_with_gradient(replace(self._named(name), device="cpu").make(self.env))

    def _choose(self, costs: Costs, rows: Sequence[MeasuredVariant]) -> tuple[Choice, ...]:
        limits: dict[str, Any] = {"max_cost": self.max_cost, "chaotic": self.chaotic}
        return tuple(choose(rows, claim, costs[claim.name], **limits) for claim in CLAIMS)

    def _line(self, one: Choice) -> str:
        fidelity = self._named(str(one.variant)).fidelity
        return fidelity_line(fidelity, one.claim.name, self.env.control_step)


def named_variant(env: Environment, claim: Claim) -> Variant:
    """Return the variant with a claim's name. Raises ValueError where there is only the reference."""
    if claim.name not in env.fidelities or claim.name == env.fidelity.name:
        raise ValueError(
            f"a study of mixed variants needs scenes with {' and '.join(one.name for one in CLAIMS)} besides their "
            f"reference; {env.name} has {', '.join(env.fidelities)}"
        )
    return replace(Variant.of(env), name=claim.name, fidelity=env.fidelities[claim.name])


def fidelity_line(fidelity: Fidelity, name: str, control_step: float) -> str:
    """Return the line of Python that makes a fidelity under a name."""
    unit = control_step or 1.0
    steps = round(unit / fidelity.dt)
    exact = steps > 0 and math.isclose(unit / steps, fidelity.dt, rel_tol=1e-12)
    words = [f'"{name}"', f"dt={unit:.12g} / {steps}" if exact else f"dt={fidelity.dt!r}"]
    words += [f"resolution={fidelity.resolution}"] if fidelity.resolution else []
    words += [f"sampling={fidelity.sampling:g}"] if fidelity.sampling != Fidelity.sampling else []
    words += [f"particles={fidelity.particles:_}"] if fidelity.particles else []
    words += [f'precision="{fidelity.precision}"'] if fidelity.precision != "float32" else []
    return f'"{name}": Fidelity({", ".join(words)}),'


def neighbours(of: Variant, standard: Variant, env: Environment) -> list[Variant]:
    """Return the variants that differ in a single setting, by one value of its grid.

    `env` is any environment of the scene. The values of a setting are a geometric series through that of the scene's
    standard, so different paths lead to the same variants.
    """
    found = [(fidelity, of.options) for fidelity in _next_fidelities(of.fidelity, standard.fidelity, env)]
    found += [(of.fidelity, options) for options in _next_options(of.options, standard.options, env)]
    return [_with_name(standard, fidelity, options) for fidelity, options in found]


def _with_name(standard: Variant, fidelity: Fidelity, options: dict[str, Any]) -> Variant:
    """Name a variant by its settings, which identify it."""
    words = [f"dt {1e3 * fidelity.dt:.4g} ms"]
    words += [f"{fidelity.resolution} cells"] if fidelity.resolution else []
    words += [f"{fidelity.particles} particles"] if fidelity.particles else []
    words += [f"sampling {fidelity.sampling:g}"] if fidelity.sampling != standard.fidelity.sampling else []
    words += [fidelity.precision] if fidelity.precision != standard.fidelity.precision else []
    words += [f"{name} {value:g}" for name, value in options.items() if value != standard.options[name]]
    name = ", ".join(words)
    return standard.change(name, MIXED, fidelity=replace(fidelity, name=name), options=options)


def _next_fidelities(of: Fidelity, standard: Fidelity, env: Environment) -> Iterator[Fidelity]:
    unit = env.control_step or 1.0
    whole = round if env.control_step else _two_digits
    for steps in next_values(unit / of.dt, unit / standard.dt, DT_RATIO, whole, least=1):
        yield replace(of, dt=env.nearest_dt(unit / steps))
    for cells in next_values(of.resolution, standard.resolution, CELL_RATIO, _even, least=MIN_CELLS):
        yield replace(of, resolution=int(cells))
    if env.work().unit == "particle-substep" and of.particles:
        for count in next_values(of.particles, standard.particles, PARTICLE_RATIO, _two_digits, least=MIN_PARTICLES):
            yield replace(of, particles=int(count))
    elif env.work().unit == "particle-substep":
        ratio = math.cbrt(PARTICLE_RATIO)
        for sampling in next_values(of.sampling, standard.sampling, ratio, lambda value: round(value, 2), least=1.0):
            yield replace(of, sampling=sampling)
    yield replace(of, precision="float64" if of.precision == "float32" else "float32")


def _next_options(of: dict[str, Any], standard: dict[str, Any], env: Environment) -> Iterator[dict[str, Any]]:
    """Yield the options in which one that makes a scene stiff or accurate has its next value up or down."""
    if option := env.contact_stiffness:
        middle = standard[option]
        ends = {"least": middle / MAX_STIFFNESS_FACTOR, "most": middle * MAX_STIFFNESS_FACTOR}
        for value in next_values(of[option], middle, STIFFNESS_RATIO, float, **ends):
            yield of | {option: value}
    for option, listed in env.accuracy_options.items():
        values = sorted({*listed, standard[option]})
        below = [value for value in values if value < of[option]][-1:]
        above = [value for value in values if value > of[option]][:1]
        yield from (of | {option: value} for value in below + above)


def next_values(
    value: float, middle: float, ratio: float, tidy: Callable[[float], float], *, least: float, most: float = math.inf
) -> list[float]:
    """Return the values next to one, below and above, in the series middle x ratio^k; none of a setting at 0."""
    if not value or not middle:
        return []
    at = math.floor(math.log(value / middle, ratio))
    near = [tidy(middle * ratio**k) if k else middle for k in range(at - 2, at + 4)]
    below = [one for one in near if least <= one < value * (1 - SAME_SHARE)][-1:]
    above = [one for one in near if most >= one > value * (1 + SAME_SHARE)][:1]
    return below + above


def _two_digits(value: float) -> int:
    """Round to two digits, so that an episode of round length takes a whole number of steps."""
    size = 10 ** max(0, math.floor(math.log10(value)) - 1) if value >= 1 else 1
    return round(value / size) * size


def _even(value: float) -> int:
    return 2 * round(value / 2)  # some scenes take even numbers only
