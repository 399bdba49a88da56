"""A search for the cheapest variant that keeps what a fidelity's name promises, all settings of a scene together.

From the named fidelities on, the front is walked: the neighbours of its members are measured, those of the member next
to a claim's limit first, until no neighbour of any member is left. On a CPU a variant is first tried at a few points,
and given up where it fails or is surely beaten there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..landscapes.capacity import Need, require
from ..landscapes.cost import duration
from ..landscapes.measures.choice import CLAIMS, Shortfall, choose, fronts, nearness, surely_beaten
from ..landscapes.storage.files import tidy
from ..landscapes.storage.records import write_record
from .folder import MIXED, ROOT, folder_named
from .notches import fidelity_line, named_variant, neighbours
from .scene import SceneSpec
from .studies import going_on
from .tradeoff import COPIES, TradeoffJob, reference_of
from .variants import Variant, expected_work
from .watch import Watch, resumable

if TYPE_CHECKING:
    from ..landscapes.measures.choice import Choice, Claim
    from ..landscapes.measures.fidelity import Sample
    from ..landscapes.measures.mixed import MixedTradeoff
    from ..landscapes.measures.tradeoff import MeasuredVariant

FEW = 16  # points of the first trial on a CPU; a GPU simulates points beside each other, so that few save nothing
PATIENCE = 0.5  # seconds of repetitions that time a variant, each way
CLOSE, ROUNDS = 1.5, 3  # costs beside the cheapest one's that are timed again, in turn, and how often
AT_MOST, BUDGET = 4.0, 600.0
RECORD, PICTURE = MIXED.files
AGAIN, ON_CPU = "timed again", "timed on cpu"  # pieces with seconds, by the names of variants
Costs = dict[str, dict[str, float]]


@dataclass(frozen=True)
class MixedJob(TradeoffJob):
    """The search of a scene's front at the points `x`; a piece on disk for each variant.

    `variants` are those measured at all points, the reference first, and grow. Nothing is measured that should cost
    more than `at_most` times what standard does, and nothing more once measuring took `budget` seconds. `chaotic` says
    that gradients are no criterion.
    """

    at_most: float = AT_MOST
    budget: float = BUDGET
    chaotic: bool = False
    samples: dict[str, Sample] = field(default_factory=dict)
    rows: dict[str, MeasuredVariant] = field(default_factory=dict)
    begun: dict[str, MeasuredVariant] = field(default_factory=dict)
    dismissed: dict[str, str] = field(default_factory=dict)
    took: dict[str, float] = field(default_factory=dict)
    works: dict[tuple[Any, ...], float] = field(default_factory=dict)

    @classmethod
    def open(
        cls,
        scene: SceneSpec,
        *,
        points: int = 64,
        seed: int = 0,
        settings: Sequence[str] = (),
        out: Path | None = None,
        root: Path = ROOT,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
        at_most: float = AT_MOST,
        budget: float = BUDGET,
        chaotic: bool = False,
    ) -> MixedJob:
        """Go on with the search in its folder, by default one named after it under `root`, or begin it there.

        The fidelity of `scene` does not matter: the reference is its last. Raises ValueError where `settings` are
        named (all are changed), for a scene without the fidelities that make a claim, and for limits that are not
        positive; TooLargeError for more points than there is memory for, StoreMismatchError where the folder holds
        another study.
        """
        from ..landscapes.storage.checkpoint import Checkpoint

        if settings:
            raise ValueError(f"a search of mixed variants changes every setting; got {', '.join(settings)}")
        for what, limit in (("at-most", at_most), ("budget", budget)):
            if not 0 < limit < float("inf"):
                raise ValueError(f"{what} takes a positive number; got {limit:g}")
        env = reference_of(scene)
        named = [Variant.of(env)] + [named_variant(env, claim) for claim in CLAIMS]
        require("points", points, lambda count: Need(8.0 * COPIES * (1 + env.space.dim) * count))
        identity = {**env.identity(), "points": points, "seed": seed}
        identity |= {"at_most": at_most, "budget": budget, "chaotic": chaotic}
        folder = out or folder_named(["mixed", env.name, points], identity, root)
        pieces = Checkpoint.open(folder, identity, what="search of mixed variants", force=force)
        x = env.space.sobol(points, seed=seed)
        return cls(env, named, x, seed, pieces, {}, command, prints, at_most, budget, chaotic)

    def run(self, watch: Watch | None = None) -> MixedTradeoff:  # type: ignore[override]
        """Measure what is missing, the reference and the named fidelities first; draw, write and return what is found.

        Raises ValueError where a named fidelity cannot be measured, Stopped where it is interrupted, and DiskFullError;
        the same job goes on from what is kept then.
        """
        from ..landscapes.draw.figures.page import save

        watch = watch or Watch()
        with going_on(self.pieces, self.env.remake, self.say_kept, watch):
            self._announce(watch)
            watch.note(f"then a search among their neighbours, of {duration(self.budget)} at most (--budget)")
            with watch.busy(self.env.name) as say:
                for variant in list(self.variants):
                    self._measure_named(variant, say)
                complete = self._search(say)
                self._time_again(say)
                found = self._choose(complete, say)
            save(found.plot(), self.folder / PICTURE)
            write_record(self.folder / RECORD, found.record())
            tidy(self.folder)
        return found

    def say_kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.pieces.count()} variants are kept in {self.folder}"

    def print(self, found: MixedTradeoff) -> list[str]:  # type: ignore[override]
        """Draw it for pages, too, and return the names of the files. Raises DiskFullError."""
        from ..landscapes.draw.figures.page import save_prints

        with resumable(self.say_kept):
            return save_prints(lambda width: found.plot(width), self.folder / PICTURE, self.prints)

    @property
    def spent(self) -> float:
        """How long the variants took that the search has measured so far [s], in all runs of it."""
        return sum(self.took.values())

    def _measure_named(self, variant: Variant, say: Callable[[str], None]) -> None:
        say(f"{variant.name} at {len(self.x)} points")
        sample = self._load(variant)
        if sample is None or len(sample.loss) < len(self.x):
            sample = self._take(variant, 0, len(self.x))
        if sample is None:
            raise ValueError(f"{self.env.name} cannot be measured at {variant.name}: {self.refused[variant.name]}")
        self._accept(variant, sample)
        self.took[variant.name] = 0.0  # the budget is that of the search

    def _search(self, say: Callable[[str], None]) -> bool:
        """Measure neighbours of the front while there are any and the budget lasts; return whether none is left."""
        seen = {variant.key() for variant in self.variants}
        while ahead := self._ahead(seen):
            for variant in ahead:
                if self.spent >= self.budget:
                    return False
                seen.add(variant.key())
                say(f"{len(self.samples)} measured, {len(self.dismissed)} given up; {variant.name}")
                self._try(variant)
        return True

    def _ahead(self, seen: set[tuple[Any, ...]]) -> list[Variant]:
        """Return what to measure next: the affordable neighbours of the front's member next to a claim's limit."""
        found = {variant.name: variant for variant in self.variants[1:]}
        limit = self.at_most * self.rows["standard"].seconds
        members = self._members()
        for last in (False, True):  # the other precision, which is seldom what losses lack, comes last
            for name in members:
                of, rate = found[name], self.rows[name].seconds / self._work(found[name])
                able = [
                    variant
                    for variant in neighbours(of, self._standard, self.env)
                    if variant.key() not in seen
                    and (variant.fidelity.precision != of.fidelity.precision) == last
                    and rate * self._work(variant) <= limit
                ]
                if able:
                    return sorted(able, key=self._work)
        return []

    def _members(self) -> list[str]:
        """Return the front of the variants with the scene's own options, then that of all, nearest to a limit first."""
        rows = [self.rows[variant.name] for variant in self.variants[1:]]
        found = list[str]()
        for among in ([row for row in rows if self._has_own_options(row)], rows):
            members = fronts(among, self._costs(), chaotic=self.chaotic)
            found += sorted(members, key=lambda name: nearness(self.rows[name].comparison, chaotic=self.chaotic))
        return list(dict.fromkeys(found))

    def _has_own_options(self, one: MeasuredVariant | Variant) -> bool:
        return one.options == self.variants[0].options

    @property
    def _standard(self) -> Variant:
        return next(variant for variant in self.variants if variant.name == "standard")

    def _work(self, variant: Variant) -> float:
        """Return what an episode of a variant is expected to cost, infinitely much where the scene refuses it."""
        if variant.key() not in self.works:
            made = [expected_work(env) for _, env in self._make([variant])]
            self.works[variant.key()] = made[0] if made else float("inf")
        return self.works[variant.key()]

    def _try(self, variant: Variant) -> None:
        """Measure a variant at a few points, and if it is worth it at the others."""
        sample = self._load(variant) or self._take(variant, 0, self._few)
        if sample is None:
            return
        if len(sample.loss) < len(self.x):
            if why := self._hopeless(variant, sample):
                self.dismissed[variant.name] = why
                return
            sample = self._take(variant, len(sample.loss), len(self.x), sample)
        if sample is not None:
            self.variants.append(variant)
            self._accept(variant, sample)

    @property
    def _few(self) -> int:
        return len(self.x) if self.env.device == "cuda" else min(FEW, len(self.x))

    def _hopeless(self, variant: Variant, sample: Sample) -> str:
        """Say why a variant is given up after its first points, nothing where it is not."""
        points = len(sample.loss)
        row = self._compare(variant, sample, self._reference.first(points))
        if (failed := row.comparison.diverged) != 0:
            return f"fails at {failed or 1:.0%} of {points} points"
        others = [
            self._begun(one, points)
            for one in self.variants[1:]
            if self.rows[one.name].seconds < row.seconds
            and (self._has_own_options(one) or not self._has_own_options(variant))
        ]
        if surely_beaten(row, others, chaotic=self.chaotic):
            return f"quicker ones are surely nearer at {points} points"
        return ""

    def _begun(self, variant: Variant, points: int) -> MeasuredVariant:
        """Return what is known of a measured variant from its first points alone."""
        if variant.name not in self.begun:
            sample = self.samples[variant.name].first(points)
            self.begun[variant.name] = self._compare(variant, sample, self._reference.first(points))
        return self.begun[variant.name]

    @property
    def _reference(self) -> Sample:
        return self.samples[self.variants[0].name]

    def _load(self, variant: Variant) -> Sample | None:
        from ..landscapes.measures.fidelity import Sample

        if (arrays := self.pieces.load(variant.name)) is None:
            return None
        self.took[variant.name] = float(arrays.pop("took"))
        return Sample.of_arrays(arrays)

    def _take(self, variant: Variant, begin: int, end: int, before: Sample | None = None) -> Sample | None:
        """Measure a variant at some of the points, and keep that with those `before`; None where that cannot be."""
        started = time.perf_counter()
        sample = self._sample_at(variant, self.x[begin:end], lambda done: None, PATIENCE)
        self.took[variant.name] = self.took.get(variant.name, 0.0) + time.perf_counter() - started
        if sample is None:
            return None
        whole = sample if before is None else before.join(sample)
        self.pieces.save(variant.name, **whole.arrays(), took=np.array(self.took[variant.name]))
        return whole

    def _accept(self, variant: Variant, sample: Sample) -> None:
        self.samples[variant.name] = sample
        self.rows[variant.name] = self._compare(variant, sample, self._reference)

    def _costs(self) -> Costs:
        """Return what counts as cost for each claim: standard's is that of the device, a draft's that of a CPU.

        On a GPU a draft's is the work of an episode, in the seconds of today's draft there.
        """
        here = {name: row.seconds for name, row in self.rows.items()}
        if self.env.device == "cpu":
            return {claim.name: here for claim in CLAIMS}
        work = {variant.name: self._work(variant) for variant in self.variants}
        rate = here["draft"] / work["draft"]
        return {"draft": {name: rate * count for name, count in work.items()}, "standard": here}

    def _time_again(self, say: Callable[[str], None]) -> None:
        """Time those in turn that may be chosen, and the named ones, so that no busy moment decides between them."""
        names = sorted({name for claim in CLAIMS for name in self._contenders(claim, self._costs())})
        kept = self._load_seconds(AGAIN)
        if set(kept) != set(names):
            kept = self._rounds(names, say)
            self._save_seconds(AGAIN, kept)
        for name, seconds in kept.items():
            sample = self.samples[name]
            self.samples[name] = replace(sample, with_gradient=min(seconds, sample.with_gradient))
            self._accept(self._variant(name), self.samples[name])

    def _contenders(self, claim: Claim, costs: Costs) -> list[str]:
        """Return the named variants and those that keep a claim at about the least cost."""
        kept = {
            name: costs[claim.name][name]
            for name, row in self.rows.items()
            if Shortfall.of(row.comparison, claim, chaotic=self.chaotic).kept and name != self.variants[0].name
        }
        close = [name for name, cost in kept.items() if cost <= CLOSE * min(kept.values())]
        return [*(one.name for one in CLAIMS), *close]

    def _rounds(self, names: Sequence[str], say: Callable[[str], None]) -> dict[str, float]:
        from ..landscapes.sampling.memory import free_memory

        best = dict.fromkeys(names, float("inf"))
        for turn in range(ROUNDS):
            for name in names:
                say(f"timing {len(names)} once more, in turn, {turn + 1} of {ROUNDS}; {name}")
                free_memory()
                best[name] = min(best[name], self._seconds(name))
        return best

    def _seconds(self, name: str) -> float:
        """Time a batch of a variant, the second after it is made [s per episode with gradient]."""
        env, rows = self._variant(name).make(self.env), self.samples[name].batch
        batch = self.x.repeat(-(-rows // len(self.x)), 1)[:rows]
        env.evaluate(batch, grad=True)
        began = time.perf_counter()
        env.evaluate(batch, grad=True)
        return (time.perf_counter() - began) / rows

    def _variant(self, name: str) -> Variant:
        return next(variant for variant in self.variants if variant.name == name)

    def _load_seconds(self, piece: str) -> dict[str, float]:
        arrays = self.pieces.load(piece) or {"names": np.array([]), "seconds": np.array([])}
        return dict(zip(map(str, arrays["names"]), map(float, arrays["seconds"]), strict=True))

    def _save_seconds(self, piece: str, seconds: Mapping[str, float]) -> None:
        self.pieces.save(piece, names=np.array(list(seconds)), seconds=np.array(list(seconds.values())))

    def _final_costs(self, say: Callable[[str], None]) -> Costs:
        """Return the costs that decide: a draft's, measured on a GPU, are timed on the CPU of those that may be it.

        Those of the others are by their work, in the seconds of today's draft on the CPU.
        """
        costs = self._costs()
        if self.env.device == "cpu" or "cpu" not in self.env.devices:
            return costs
        names = self._contenders(CLAIMS[0], costs)
        timed = self._load_seconds(ON_CPU)
        if set(timed) != {*names} - {"standard"}:
            timed = {name: self._cpu_seconds(name, say) for name in dict.fromkeys(names) if name != "standard"}
            self._save_seconds(ON_CPU, timed)
        rate = timed["draft"] / costs["draft"]["draft"]
        return costs | {"draft": {name: rate * cost for name, cost in costs["draft"].items()} | timed}

    def _cpu_seconds(self, name: str, say: Callable[[str], None]) -> float:
        from .tolerance import seconds_with_gradient

        say(f"timing {name} on the CPU, where a draft's cost counts")
        return seconds_with_gradient(replace(self._variant(name), device="cpu").make(self.env))

    def _choose(self, complete: bool, say: Callable[[str], None]) -> MixedTradeoff:
        from ..landscapes.measures.mixed import MixedTradeoff
        from ..landscapes.measures.tradeoff import RefusedVariant

        costs = self._final_costs(say)
        rows = [self.rows[variant.name] for variant in self.variants[1:]]
        how: dict[str, Any] = {"at_most": self.at_most, "chaotic": self.chaotic}
        pick = partial(self._pick, costs=costs, how=how)
        own = pick(filter(self._has_own_options, rows))
        able = pick(rows)
        cpu = self.env.device == "cpu" or "cpu" not in self.env.devices
        return MixedTradeoff(
            tradeoff=self._conclude(self.samples),
            choices=own,
            with_options=tuple(one for one, same in zip(able, own, strict=True) if one.variant != same.variant),
            dismissed=tuple(RefusedVariant(name, why) for name, why in self.dismissed.items()),
            device={"draft": self.env.device if cpu else "cpu", "standard": self.env.device},
            lines=tuple(self._line(one) for one in own if one.variant is not None),
            at_most=self.at_most,
            budget=self.budget,
            spent=self.spent,
            complete=complete,
            chaotic=self.chaotic,
        )

    @staticmethod
    def _pick(rows: Iterable[MeasuredVariant], *, costs: Costs, how: dict[str, Any]) -> tuple[Choice, ...]:
        able = list(rows)
        return tuple(choose(able, claim, costs[claim.name], **how) for claim in CLAIMS)

    def _line(self, one: Choice) -> str:
        fidelity = self._variant(str(one.variant)).fidelity
        return fidelity_line(fidelity, one.claim.name, self.env.control_step)
