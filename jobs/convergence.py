"""A scene's self-convergence about its reference, the divergence of its neighbours, and distributions of its losses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..landscapes.capacity import Need, require
from ..landscapes.cost import duration, seconds_per_episode
from ..landscapes.storage.files import tidy
from ..landscapes.storage.records import write_record
from .folder import CONVERGENCE, ROOT, folder_named
from .refinement import Refinement, find_refinements
from .scene import SceneSpec, provenance
from .studies import going_on
from .variants import Variant, expected_work, refuse_single
from .watch import PREPARING, Watch, resumable

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.measures.convergence_record import Convergence
    from ..landscapes.measures.self_convergence import Ladder, Values
    from ..landscapes.storage.checkpoint import Checkpoint
    from .neighbours import Neighbours

COPIES = 50  # of the points: a loss and a gradient there by every level
RECORD, PICTURE = CONVERGENCE.files


@dataclass(frozen=True)
class ConvergenceJob:
    """The levels of a scene's knobs to measure at the points `x`, shape (point, dim); a piece on disk for each.

    `env` is the reference. `refused` gathers the levels that cannot be measured, and why. `prints` are widths of pages
    [mm] that it is also drawn for; `command` is how it is made again.
    """

    env: Environment
    refinements: list[Refinement]
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
        points: int = 16,
        seed: int = 0,
        settings: Sequence[str] = (),
        out: Path | None = None,
        root: Path = ROOT,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
    ) -> ConvergenceJob:
        """Go on with the study in its folder, by default one named after it under `root`, or begin it there.

        `settings` are the knobs to refine, by default all that the scene has. The fidelity of `scene` does not matter:
        the reference is its last. Raises ValueError where the scene has one fidelity only and for knobs it does not
        have, TooLargeError for more points than there is memory for, StoreMismatchError where the folder holds another
        study.
        """
        from ..landscapes.storage.checkpoint import Checkpoint

        kind = scene.kind
        env = replace(scene, fidelity=list(kind.fidelities)[-1], tolerance=None).make()
        refuse_single(env)
        require("points", points, lambda count: Need(8.0 * COPIES * (1 + env.space.dim) * count))
        found = find_refinements(env, settings)
        identity = {**env.identity(), "points": points, "seed": seed, "knobs": [one.knob for one in found]}
        folder = out or folder_named(["convergence", env.name, points], identity, root)
        pieces = Checkpoint.open(folder, identity, what="convergence", force=force)
        return cls(env, found, env.space.sobol(points, seed=seed), seed, pieces, {}, command, prints)

    @property
    def folder(self) -> Path:
        """Where it is kept."""
        return self.pieces.folder

    @cached_property
    def variants(self) -> list[Variant]:
        """What is simulated, the reference first, then the named fidelities, then what is refined."""
        reference = Variant.of(self.env)
        named = [replace(reference, name=name, fidelity=one) for name, one in self.env.fidelities.items()]
        levels = [variant for one in self.refinements for variant, _ in one.levels]
        unique: dict[str, Variant] = {}
        for variant in (reference, *named, *levels):
            unique.setdefault(variant.name, variant)
        return list(unique.values())

    def run(self, watch: Watch | None = None) -> Convergence:
        """Measure what is missing, the reference first; draw, write and return what is found.

        Raises ValueError where the scene refuses the reference, Stopped where it is interrupted, and DiskFullError;
        the same job goes on from what is kept then.
        """
        from ..landscapes.draw.figures.page import save

        watch = watch or Watch()
        with going_on(self.pieces, self.env.remake, self.say_kept, watch):
            self._announce(watch)
            found = self._conclude(self._measure(watch), watch)
            save(found.plot(), self.folder / PICTURE)
            write_record(self.folder / RECORD, found.record())
            tidy(self.folder)
        return found

    def say_kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.pieces.count()} pieces are kept in {self.folder}"

    def variants_left(self) -> list[Variant]:
        """Return the variants that are not measured yet."""
        return [variant for variant in self.variants if self.pieces.load(variant.name) is None]

    def estimate(self) -> dict[str, float]:
        """Return the seconds that each variant that is left should take, by the work of the cheapest fidelity.

        One that is refused takes none.
        """
        left = self.variants_left()
        base = self.env.remake(fidelity=next(iter(self.env.fidelities)))
        base.prepare()
        rate = seconds_per_episode(base, self.x[: base.preferred_batch], grad=True) / base.work().count
        seconds = {variant.name: 0.0 for variant in left}
        for variant in left:
            if env := self._make(variant):
                seconds[variant.name] = len(self.x) * rate * expected_work(env)
        return seconds

    def _announce(self, watch: Watch) -> None:
        """Say what is left to measure and about how long that takes."""
        left = self.variants_left()
        kept = f", {len(self.variants) - len(left)} are there already" if len(left) < len(self.variants) else ""
        watch.note(f"{self.env.name} · {self.env.device} · {self.env.engine} · {self.folder}")
        watch.note(f"{len(left)} levels to measure at {len(self.x)} points{kept}")
        if not left:
            return
        with watch.busy(f"{self.env.name}: {PREPARING}"):
            seconds = self.estimate()
        dearest = max(seconds, key=lambda name: seconds[name])
        watch.note(
            f"about {duration(sum(seconds.values()))}, {duration(seconds[dearest])} of it {dearest}, by the work of an "
            "episode; compiling kernels and the divergence of neighbours come on top; --points and --variants lower it"
        )

    def _make(self, variant: Variant) -> Environment | None:
        """Make a variant's environment; note what a scene refuses, and why, and what a CPU has no memory for."""
        try:
            env = variant.make(self.env)
            if env.device == "cpu":
                require("episodes", 1, lambda count: Need(float(count * env.memory())))
            return env
        except ValueError as error:
            self.refused[variant.name] = " ".join(str(error).split())
            return None

    def _measure(self, watch: Watch) -> dict[str, Values]:
        from ..landscapes.measures.self_convergence import Values

        found: dict[str, Values] = {}
        with watch.progress(len(self.variants), "levels") as advance:
            for number, variant in enumerate(self.variants):
                advance(number, variant.name)
                if (arrays := self.pieces.load(variant.name)) is not None:
                    found[variant.name] = Values.of_arrays(arrays)
                    continue

                def follow(done: int, number: int = number, name: str = variant.name) -> None:
                    advance(number, f"{name}, {done} of {len(self.x)} points")

                if (values := self._evaluate(variant, follow)) is not None:
                    found[variant.name] = values
                    self.pieces.save(variant.name, **values.arrays())
                if number == 0 and variant.name in self.refused:
                    raise ValueError(f"{self.env.name} has no reference to measure by: {self.refused[variant.name]}")
            advance(len(self.variants))
        return found

    def _evaluate(self, variant: Variant, follow: Callable[[int], None]) -> Values | None:
        """Evaluate a variant at all points, if that can be done; the memory of the one before must be free by then."""
        from ..landscapes.sampling.memory import free_memory
        from .neighbours import evaluate_points

        free_memory()
        env = self._make(variant)
        if env is None:
            return None
        try:
            return evaluate_points(env, self.x, follow)
        except (RuntimeError, MemoryError) as error:  # no room for it, or an engine that gives up
            self.refused[variant.name] = " ".join(str(error).split())
            return None

    def _conclude(self, values: dict[str, Values], watch: Watch) -> Convergence:
        from ..landscapes.measures.convergence_record import Convergence
        from ..landscapes.measures.self_convergence import conclude, counted, estimate_remainders, judge
        from ..landscapes.measures.tradeoff import RefusedVariant

        name, named = self.variants[0].name, list(self.env.fidelities)
        reference = values[name].loss
        spread, scale = self._scale(values)
        ladders = [one for one in self._ladders(values) if len(one.levels) > 1]
        found = [conclude(ladder, name, scale) for ladder in ladders]
        asked = counted(ladders)
        pairs = [(ladder, order) for ladder, (_, order) in zip(ladders, found, strict=True) if ladder in asked]
        losses = {one: values[one].loss for one in named if one in values}
        knobs = tuple(one for one, _ in found)
        neighbours = self._neighbours(scale.spread)
        divergence = neighbours.measure_divergence(watch)
        return Convergence(
            env=self.env.name,
            reference=name,
            points=len(self.x),
            seed=self.seed,
            loss_unit=self.env.loss_unit,
            spread=spread,
            knobs=knobs,
            rule=judge(knobs, scale),
            remainders=estimate_remainders(pairs, losses, reference, scale),
            divergence=divergence,
            distributions=neighbours.measure_distributions(watch) if divergence and divergence.is_chaos else None,
            refused=tuple(RefusedVariant(one, why) for one, why in self.refused.items()),
            identity=self.env.identity(),
            provenance=provenance(self.env, self.command),
            command=self.command,
        )

    def _scale(self, values: dict[str, Values]) -> tuple[float | None, Any]:
        from ..landscapes.measures.self_convergence import Scale, error, sum_up

        reference = values[self.variants[0].name].loss
        known = reference[np.isfinite(reference)]
        spread = float(np.subtract(*np.percentile(known, (95, 5)))) if known.size else 0.0
        whole = spread or 1.0
        standard = values.get(list(self.env.fidelities)[-2])
        far: NDArray[np.float64] = error(standard.loss, reference) if standard else np.empty(0)
        return spread or None, Scale(whole, sum_up(far, whole, self.seed)[1], self.seed)

    def _ladders(self, values: dict[str, Values]) -> list[Ladder]:

        from ..landscapes.measures.convergence_record import Level
        from ..landscapes.measures.self_convergence import Ladder

        found = []
        for one in self.refinements:
            known = [(variant, width) for variant, width in one.levels if variant.name in values]
            levels = [
                Level(variant.name, width, variant.fidelity.record(), values[variant.name].seconds)
                for variant, width in known
            ]
            said = [values[variant.name] for variant, _ in known]
            found.append(Ladder(one.knob, levels, said, self.env.designed_order.get(one.knob)))
        return found

    def _neighbours(self, spread: float) -> Neighbours:
        from .neighbours import Neighbours

        return Neighbours(self.env, self.x, self.seed, self.pieces, spread, self._compared)

    def _compared(self) -> list[Variant]:
        """Return what is compared with the reference by distributions: named fidelities, and the finest of each knob.

        Of a knob it is the one step that is finer than the reference; what was refused is left out.
        """
        named = [one for one in self.variants[1:] if one.name in self.env.fidelities]
        finer = []
        for one in self.refinements:
            names = [variant.name for variant, _ in one.levels]
            beyond = one.levels[names.index(self.variants[0].name) + 1 :]
            finer += [variant for variant, _ in beyond[:1]]
        return [one for one in (*named, *finer) if one.name not in self.refused]

    def print(self, found: Convergence) -> list[str]:
        """Draw it for pages, too, and return the names of the files. Raises DiskFullError."""
        from ..landscapes.draw.figures.page import save_prints

        with resumable(self.say_kept):
            return save_prints(lambda width: found.plot(width), self.folder / PICTURE, self.prints)
