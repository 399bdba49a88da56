"""A scene's accuracy against its speed, measured variant by variant at the same points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..landscapes.capacity import Need, require
from ..landscapes.cost import duration, seconds_per_episode
from ..landscapes.storage.files import tidy
from ..landscapes.storage.records import write_record
from .folder import ROOT, TRADEOFF, folder_named
from .scene import SceneSpec, provenance
from .studies import going_on
from .watch import PREPARING, Watch, resumable

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.measures.fidelity import Sample
    from ..landscapes.measures.tradeoff import MeasuredVariant, Tradeoff
    from ..landscapes.storage.checkpoint import Checkpoint
    from .variants import Variant

COPIES = 50  # of the points: a loss and a gradient there by every variant
RECORD, PICTURE = TRADEOFF.files


@dataclass(frozen=True)
class TradeoffJob:
    """The variants of a scene to measure at the points `x`, shape (point, dim); a piece on disk for each.

    `env` is the reference. `refused` gathers the variants that cannot be measured, and why. `prints` are widths of
    pages [mm] that it is also drawn for; `command` is how it is made again.
    """

    env: Environment
    variants: list[Variant]
    x: Tensor
    seed: int
    pieces: Checkpoint
    refused: dict[str, str]
    command: str
    prints: Sequence[float] = ()

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
    ) -> TradeoffJob:
        """Go on with the study in its folder, by default one named after it under `root`, or begin it there.

        `settings` are those that are changed beside the named fidelities, by default all that the scene has. The
        fidelity of `scene` does not matter: the reference is its last. Raises ValueError where the scene has one
        fidelity only, TooLargeError for more points than there is memory for, StoreMismatchError where the folder
        holds another study.
        """
        from ..landscapes.storage.checkpoint import Checkpoint
        from .variants import SETTINGS, refuse_single, variants

        env = reference_of(scene)
        refuse_single(env)
        require("points", points, lambda count: Need(8.0 * COPIES * (1 + env.space.dim) * count))
        found = variants(env, settings or SETTINGS)
        identity = {**env.identity(), "points": points, "seed": seed}
        folder = out or folder_named(["tradeoff", env.name, points], identity, root)
        pieces = Checkpoint.open(folder, identity, what="tradeoff", force=force)
        return cls(env, found, env.space.sobol(points, seed=seed), seed, pieces, {}, command, prints)

    @property
    def folder(self) -> Path:
        """Where it is kept."""
        return self.pieces.folder

    def run(self, watch: Watch | None = None) -> Tradeoff:
        """Measure what is missing, the reference first; draw, write and return the trade-off.

        Raises ValueError where the scene refuses the reference, Stopped where it is interrupted, and DiskFullError;
        the same job goes on from what is kept then.
        """
        from ..landscapes.draw.figures.page import save

        watch = watch or Watch()
        with going_on(self.pieces, self.env.remake, self.say_kept, watch):
            self._announce(watch)
            found = self._conclude(self._measure(watch))
            save(found.plot(), self.folder / PICTURE)
            write_record(self.folder / RECORD, found.record())
            tidy(self.folder)
        return found

    def say_kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.pieces.count()} of {len(self.variants)} variants are kept in {self.folder}"

    def variants_left(self) -> list[Variant]:
        """Return the variants that are not measured yet."""
        return [variant for variant in self.variants if self.pieces.load(variant.name) is None]

    def estimate(self) -> dict[str, float]:
        """Return the seconds that each variant that is left should take, by the work of the cheapest fidelity.

        One that is refused takes none.
        """
        from ..landscapes.measures.fidelity import REPETITION
        from .variants import expected_work

        left = self.variants_left()
        base = self._cheapest()
        batch = self.x[: base.preferred_batch]
        rate = seconds_per_episode(base, batch, grad=True) / base.work().count
        seconds = {variant.name: 0.0 for variant in left}
        for variant, env in self._make(left):
            each = rate * expected_work(env)
            repetition = max(REPETITION, min(len(self.x), env.preferred_batch) * each / 3)
            seconds[variant.name] = len(self.x) * each + 2 * repetition
        return seconds

    def _cheapest(self) -> Environment:
        env = self.env.remake(fidelity=next(iter(self.env.fidelities)))
        env.prepare()
        return env

    def _announce(self, watch: Watch) -> None:
        """Say what is left to measure and about how long that takes."""
        left = self.variants_left()
        kept = f", {len(self.variants) - len(left)} are there already" if len(left) < len(self.variants) else ""
        watch.note(f"{self.env.name} · {self.env.device} · {self.env.engine} · {self.folder}")
        watch.note(f"{len(left)} variants to measure at {len(self.x)} points{kept}")
        if not left:
            return
        with watch.busy(f"{self.env.name}: {PREPARING}"):
            seconds = self.estimate()
        dearest = max(seconds, key=lambda name: seconds[name])
        first = f"{duration(seconds[dearest])} of it {dearest}, " if len(seconds) > 1 else ""
        watch.note(
            f"about {duration(sum(seconds.values()))}, {first}by the work of an episode; compiling kernels comes on "
            "top, minutes for taichi; --points and --variants lower it"
        )

    def _make(self, variants: Sequence[Variant]) -> Iterator[tuple[Variant, Environment]]:
        """Make each variant's environment; note what a scene refuses, and why."""
        for variant in variants:
            try:
                yield variant, variant.make(self.env)
            except ValueError as error:
                self.refused[variant.name] = " ".join(str(error).split())

    def _measure(self, watch: Watch) -> dict[str, Sample]:
        from ..landscapes.measures.fidelity import Sample

        samples: dict[str, Sample] = {}
        with watch.progress(len(self.variants), "variants") as advance:
            for number, variant in enumerate(self.variants):
                advance(number, variant.name)
                if (arrays := self.pieces.load(variant.name)) is not None:
                    samples[variant.name] = Sample.of_arrays(arrays)
                    continue

                def follow(done: int, number: int = number, name: str = variant.name) -> None:
                    advance(number, f"{name}, {done} of {len(self.x)} points")

                if (sample := self._sample(variant, follow)) is not None:
                    samples[variant.name] = sample
                    self.pieces.save(variant.name, **sample.arrays())
                if number == 0 and variant.name in self.refused:
                    raise ValueError(f"{self.env.name} has no reference to measure by: {self.refused[variant.name]}")
            advance(len(self.variants))
        return samples

    def _sample(self, variant: Variant, follow: Callable[[int], None]) -> Sample | None:
        """Measure a variant, if that can be done.

        The one before must be gone by then: a solver takes what memory a GPU has, and a variant that got the rest would
        seem slow.
        """
        return self._sample_at(variant, self.x, follow)

    def _sample_at(
        self, variant: Variant, x: Tensor, follow: Callable[[int], None], patience: float | None = None
    ) -> Sample | None:
        from ..landscapes.measures.fidelity import measure
        from ..landscapes.sampling.memory import free_memory

        free_memory()
        for _, env in self._make([variant]):
            try:
                return measure(env, x, follow=follow, **({} if patience is None else {"patience": patience}))
            except RuntimeError as error:  # no room for it, or an engine that gives up
                self.refused[variant.name] = " ".join(str(error).split())
        return None

    def _conclude(self, samples: dict[str, Sample]) -> Tradeoff:
        from ..landscapes.measures.fidelity import spread
        from ..landscapes.measures.tradeoff import RefusedVariant, Tradeoff, fit_orders

        reference = samples[self.variants[0].name]
        rows = tuple(
            self._compare(variant, samples[variant.name], reference)
            for variant in self.variants
            if variant.name in samples
        )
        return Tradeoff(
            env=self.env.name,
            reference=self.variants[0].name,
            points=len(self.x),
            seed=self.seed,
            loss_unit=self.env.loss_unit,
            spread=spread(reference),
            reference_failed=len(self.x) - rows[0].comparison.compared,
            variants=rows,
            refused=tuple(RefusedVariant(name, why) for name, why in self.refused.items()),
            orders=fit_orders(rows),
            identity=self.env.identity(),
            provenance=provenance(self.env, self.command),
            command=self.command,
        )

    def _compare(self, variant: Variant, sample: Sample, reference: Sample) -> MeasuredVariant:
        from ..landscapes.measures.fidelity import compare
        from ..landscapes.measures.tradeoff import MeasuredVariant

        return MeasuredVariant(
            variant.name,
            variant.changed,
            variant.fidelity.record(),
            variant.engine,
            variant.device,
            variant.options,
            variant.make(self.env).memory(),
            compare(sample, reference, seed=self.seed),
        )

    def print(self, found: Tradeoff) -> list[str]:
        """Draw it for pages, too, and return the names of the files. Raises DiskFullError."""
        from ..landscapes.draw.figures.page import save_prints

        with resumable(self.say_kept):
            return save_prints(lambda width: found.plot(width), self.folder / PICTURE, self.prints)


def reference_of(scene: SceneSpec) -> Environment:
    """Make the reference of a scene: its last fidelity."""
    kind = scene.kind
    return replace(scene, fidelity=list(kind.fidelities)[-1], tolerance=None).make()
