"""Variants of a scene, one setting changed at a time, and the study that measures them all at the same points."""

from __future__ import annotations

import abc
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from ..envs.records import Fidelity
from ..landscapes.capacity import Need, require
from ..landscapes.cost import episode_cost
from ..landscapes.identity import MODEL_VERSION
from ..landscapes.options import record_options
from ..landscapes.plain import digest
from ..landscapes.sampling.memory import free_memory
from ..landscapes.storage.checkpoint import Checkpoint
from ..landscapes.verification import POINTS
from .references import evaluate_reference, is_kept
from .samples import Sample, evaluate_parts, evaluate_points

if TYPE_CHECKING:
    import pandas as pd
    from torch import Tensor

    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from ..landscapes.draw.figures.page import Picture
    from .samples import Evaluate, Follow

FLOAT64_COST = 1.5  # what float64 is expected to take, in times what float32 takes
MAX_TIMED_WORK, MIN_HORIZON_SHARE = 1e6, 0.05  # of an episode that is timed: it is shortened to that, if it can be
EPISODE_ROUNDING = 1e-3  # of an episode's length, by which one of rounded steps may differ


@dataclass(frozen=True)
class Variant:
    """One way to simulate a scene: a fidelity, an engine, a device, options.

    `changed` is the setting that differs from a named fidelity of the same scene, whose time step is `base_dt`; "named"
    for such a fidelity itself.
    """

    name: str
    changed: str
    fidelity: Fidelity
    engine: str
    device: str
    options: dict[str, Any]
    base_dt: float | None = field(default=None, compare=False)

    @classmethod
    def of(cls, env: Environment) -> Variant:
        """Return the variant of an environment."""
        return cls(env.fidelity.name, "named", env.fidelity, env.engine, env.device, record_options(env.options))

    @classmethod
    def all_named(cls, env: Environment) -> list[Variant]:
        """Return the variants of the named fidelities of an environment."""
        own = cls.of(env)
        return [replace(own, name=name, fidelity=fidelity) for name, fidelity in env.fidelities.items()]

    def make(self, scene: Environment) -> Environment:
        """Make the environment of this variant of a scene.

        Raises ValueError where the scene refuses it, or would change the length of an episode by rounding its steps.
        """
        env = scene.remake(fidelity=self.fidelity, engine=self.engine, device=self.device, **self.options)
        if self.base_dt is not None and self.fidelity.dt != self.base_dt:
            longer = env.length() / env.remake(fidelity=replace(self.fidelity, dt=self.base_dt)).length()
            if abs(longer - 1) > EPISODE_ROUNDING:
                raise ValueError(
                    f"{env.name} rounds an episode to whole steps; with dt {self.fidelity.dt:.4g} s it would be "
                    f"{longer:.3g} times as long"
                )
        return env

    def change(self, name: str, setting: str, **changes: Any) -> Variant:
        """Return this variant with one setting changed."""
        return replace(self, name=name, changed=setting, base_dt=self.fidelity.dt, **changes)

    def refine(self, setting: str, what: str, **changes: Any) -> Variant:
        """Return this variant at a changed fidelity, named after the change."""
        fidelity = replace(self.fidelity, name=f"{self.fidelity.name}-{what}", **changes)
        return self.change(fidelity.name, setting, fidelity=fidelity)

    def with_dt(self, dt: float) -> Variant:
        """Return this variant at another time step [s]."""
        return self.refine("dt", f"dt-x{dt / self.fidelity.dt:.3g}", dt=dt)

    def with_cells(self, factor: float) -> Variant:
        """Return this variant with this factor on the cells along each axis, rounded to even: some scenes need that."""
        cells = self.even_cells(factor)
        return self.refine("resolution", f"resolution-{cells}", resolution=cells)

    def even_cells(self, factor: float) -> int:
        """Return the nearest even number to this factor times the cells along each axis."""
        return 2 * round(self.fidelity.resolution * factor / 2)

    def with_particles(self, factor: float) -> Variant:
        """Return this variant with this factor on the particles."""
        changes: dict[str, float] = {"particles": round(self.fidelity.particles * factor)}
        if not self.fidelity.particles:
            changes = {"sampling": round(self.fidelity.sampling * math.cbrt(factor), 3)}
        return self.refine("particles", f"particles-x{factor:g}", **changes)

    def with_other_precision(self) -> Variant:
        """Return this variant in float64 if it is in float32, and the other way round."""
        other = "float64" if self.fidelity.precision == "float32" else "float32"
        return self.refine("precision", other, precision=other)

    def vary(self, setting: str, factors: Sequence[float], env: Environment) -> Iterator[Variant]:
        """Yield this variant with a factor on a setting of its fidelity, or in the other precision, if it has it."""
        if setting == "dt" and self.fidelity.dt:
            yield from (self.with_dt(env.nearest_dt(self.fidelity.dt * factor)) for factor in factors)
        elif setting == "resolution" and self.fidelity.resolution:
            yield from map(self.with_cells, factors)
        elif setting == "particles" and env.work().unit == "particle-substep":
            yield from map(self.with_particles, factors)
        elif setting == "precision":
            yield self.with_other_precision()

    def key(self) -> tuple[Any, ...]:
        """Return the settings that decide the variant's numbers."""
        same = replace(self.fidelity, name="")
        return same, self.engine, self.device, tuple(sorted(self.options.items()))


def expected_work(env: Environment) -> float:
    """Return the expected cost of an episode, relative to other variants of its scene."""
    return env.work().count * precision_cost(env.fidelity.precision)


def precision_cost(precision: str) -> float:
    """Return the expected cost of a precision, relative to float32."""
    return FLOAT64_COST if precision == "float64" else 1.0


def seconds_with_gradient(env: Environment) -> float:
    """Time an episode with gradient [s]; of a long one only the beginning is simulated."""
    whole = env.work().count
    if env.horizon and whole > MAX_TIMED_WORK:
        env = env.with_horizon(env.horizon * max(MIN_HORIZON_SHARE, MAX_TIMED_WORK / whole))
    return episode_cost(env).gradient * whole / env.work().count


def refuse_single(env: Environment) -> None:
    """Raise ValueError for a scene with a single fidelity, which has nothing to compare."""
    if len(env.fidelities) < 2:
        raise ValueError(
            f"{env.name} has one fidelity, {', '.join(env.fidelities)}, so there is nothing to compare; add some: a "
            "function takes fidelities={'draft': {'dt': 0.001}, 'reference': {'dt': 0.001}}, and a class has "
            "`fidelities`"
        )


def refuse_settings(settings: Sequence[str], known: Sequence[str], where: str = "") -> None:
    """Raise ValueError for a setting that a kind of study does not change."""
    if unknown := set(settings) - set(known):
        raise ValueError(f"--settings takes {', '.join(known)}{where}; got {', '.join(sorted(unknown))}")


def part_name(prefix: str, name: str, key: Any) -> str:
    """Return the name of a part of a checkpoint, different for each key, which is plain JSON."""
    slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    return f"{prefix}-{slug}-{digest(key)}"


def one_line(error: BaseException) -> str:
    """Return an error's message, on one line."""
    return " ".join(str(error).split())


@dataclass(frozen=True)
class Refused:
    """A variant or setting that the scene or its engine refused, and why."""

    name: str
    why: str


@dataclass(frozen=True, kw_only=True)
class StudyRecord(abc.ABC):
    """The common results of every study: the number of points, the scene, and refusals.

    The fields are those of the JSON file; see `landscapes.convert`.
    """

    kind: ClassVar[str]
    derived: ClassVar[tuple[str, ...]] = ("kind",)
    kept_by: ClassVar[tuple[str, ...]] = ("options",)  # of the identity: of others the user's own study is another one
    read_elsewhere: ClassVar[bool] = True  # by other verbs, so that it is worth keeping
    index: ClassVar[tuple[str, ...]] = ("name",)  # columns of the table that tell its rows apart

    env: str
    points: int
    seed: int
    loss_unit: str
    refused: tuple[Refused, ...]
    identity: dict[str, Any]
    provenance: dict[str, Any]
    command: str

    @property
    def device(self) -> str:
        """The device of the measurement."""
        return str(self.identity["device"])

    @abc.abstractmethod
    def rows(self) -> Iterable[Mapping[str, Any]]:
        """Return the measurements, a row each, in the columns of the table."""

    def table(self) -> pd.DataFrame:
        """Return the measurements as a table; `rows` describes its columns."""
        import pandas as pd

        rows, index = list(self.rows()), list(self.index)
        return pd.DataFrame(rows, columns=None if rows else index).set_index(index)

    @abc.abstractmethod
    def sentences(self) -> list[str]:
        """Return the verdicts."""

    def to_keep(self) -> StudyRecord | None:
        """Return the part worth storing for other commands; changes of a function cannot be detected."""
        return self if self.read_elsewhere and self.identity.get(MODEL_VERSION) else None

    def plot(self, width: float | None = None) -> Picture:
        """Draw it, for a screen, or for a page of this width [mm]."""
        from ..landscapes.draw.figure import figure_of

        return figure_of(self, width)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


@dataclass(frozen=True, eq=False)
class NamedPoint:
    """A point and its name."""

    name: str
    x: Tensor


@dataclass(frozen=True)
class StudyOptions:
    """The options of a study, as `gradscape.study` explains them; None is the default of its kind."""

    points: int | None = None
    seed: int = 0
    settings: tuple[str, ...] = ()
    pairs: tuple[str, ...] | None = None
    precisions: tuple[str, ...] = ()
    grid: int | None = None
    width: float | None = None
    tolerance: float | None = None
    reference: str | None = None
    max_cost: float | None = None
    time_limit: float | None = None
    chaotic: bool = False
    through: NamedPoint | None = None
    noise: float | None = None
    rate: float | None = None

    def given(self) -> dict[str, Any]:
        """Return the options that differ from the defaults."""
        return {name: value for name, value in vars(self).items() if value != getattr(StudyOptions, name)}


EVERY_STUDY = ("points", "seed")  # the options that every study takes


@dataclass(frozen=True)
class Expected:
    """The remaining simulations of a variant: `episodes` with gradient, and `repeats` to time it.

    `repeats` maps the time of an episode [s] to the time of the repeats [s].
    """

    name: str
    env: Environment
    episodes: float
    repeats: Callable[[float], float] = lambda each: 0.0


class Study(abc.ABC):
    """The measurements of a kind of study at the points `x`, shape (point, dim).

    Results are stored in the `checkpoint`, so a study can be stopped at any time. `refused` has the reason for each
    refused measurement; `takes` are the kind's own options.
    """

    kind: ClassVar[str]
    takes: ClassVar[tuple[str, ...]] = ()
    what: ClassVar[str] = "variants"
    default_points: ClassVar[int] = 64
    copies: ClassVar[int] = 50  # of the points: a loss and a gradient there by every variant
    about_last: ClassVar[bool] = True  # of a scene's fidelities, or else about the one that is given
    advice: ClassVar[str] = "plus compiling kernels; fewer --points or --settings take less"
    checkpoint: Checkpoint

    def __init__(self, env: Environment, options: StudyOptions) -> None:
        self._refuse_options(options)
        self.env, self.options, self.seed = env, options, options.seed
        points = self.default_points if options.points is None else options.points
        require("points", points, lambda count: Need(8.0 * self.copies * (1 + env.space.dim) * count))
        self.x = self._points(points)
        self.refused: dict[str, str] = {}

    @classmethod
    def choose_fidelity(
        cls, scene: Environment | type[Environment], given: Fidelity | str | None
    ) -> Fidelity | str | None:
        """Return the fidelity of the reference. Raises ValueError where it is the scene's last, but one is `given`."""
        if not cls.about_last:
            return given
        if given is not None:
            raise ValueError(f"study {cls.kind} examines the last fidelity of a scene; got {given}, so leave it out")
        return list(scene.fidelities)[-1]

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers, as plain JSON; a study with others is not continued."""
        return {**self.env.identity(), "points": len(self.x), "seed": self.seed}

    def folder_parts(self) -> list[object]:
        """Return the parts of the name of the study's folder."""
        return [self.kind, self.env.name, len(self.x)]

    def open(self, folder: Path, *, force: bool = False) -> None:
        """Continue the study in a folder, or begin it there. Raises StoreMismatchError for another study."""
        self.checkpoint = Checkpoint.open(folder, self.identity(), what=f"{self.kind} study", force=force)

    @abc.abstractmethod
    def run(self, watch: Watch, provenance: Mapping[str, Any], command: str) -> StudyRecord:
        """Measure the missing parts and return the record. Raises ValueError where the reference cannot be measured."""

    @abc.abstractmethod
    def expected(self) -> Iterator[Expected]:
        """Yield the remaining simulations."""

    def describe_kept(self) -> str:
        """Describe the stored part."""
        return f"{self.checkpoint.count()} {self.what} are kept in {self.checkpoint.folder}"

    @abc.abstractmethod
    def describe_left(self) -> str:
        """Describe the remaining measurements."""

    @contextmanager
    def refusing(self, name: str) -> Iterator[None]:
        """Record a refusal of the scene or its engine, and the reason."""
        try:
            yield
        except (ValueError, RuntimeError, MemoryError) as error:
            self.refused[name] = one_line(error)

    def about(self, provenance: Mapping[str, Any], command: str) -> dict[str, Any]:
        """Return the fields of every record."""
        return {
            **{"env": self.env.name, "points": len(self.x), "seed": self.seed, "loss_unit": self.env.loss_unit},
            "refused": tuple(Refused(name, why) for name, why in self.refused.items()),
            **{"identity": self.env.identity(), "provenance": dict(provenance), "command": command},
        }

    def _points(self, points: int) -> Tensor:
        return self.env.space.sobol(points, seed=self.seed)

    @classmethod
    def _refuse_options(cls, options: StudyOptions) -> None:
        """Raise ValueError for options that this kind of study does not take."""
        known = (*EVERY_STUDY, *cls.takes)
        if foreign := [name for name in options.given() if name not in known]:
            raise ValueError(
                f"study {cls.kind} takes {', '.join(known)}; got {', '.join(foreign)}, so leave out the others"
            )


class VariantStudy(Study):
    """Variants of a scene, each compared with the first of them, the reference `env`.

    A kind of study defines the variants, how to measure one, and the conclusions from all of them.
    """

    @property
    @abc.abstractmethod
    def variants(self) -> Sequence[Variant]:
        """The variants to measure, the reference first."""

    def part(self, variant: Variant) -> str:
        """Return the name of a variant's part of the checkpoint."""
        return variant.name

    def measure(self, variant: Variant, follow: Follow) -> Mapping[str, Any]:
        """Return the measured arrays of a variant, and free its memory."""
        env = self._make(variant)
        found = evaluate_points(env, self.x, follow, by=self.evaluates(variant)).arrays()
        env.release()
        return found

    def evaluates(self, variant: Variant) -> Evaluate:
        """Return the evaluator of a variant: the reference is stored for every study of the same points."""
        return evaluate_reference if variant.name == self.variants[0].name else evaluate_parts

    def measure_all(self, watch: Watch) -> dict[str, dict[str, Any]]:
        """Return the arrays of each measurable variant, by its name; stored ones are not measured again.

        Raises ValueError where the first, the reference, cannot be measured.
        """
        found: dict[str, dict[str, Any]] = {}
        with watch.progress(len(self.variants), self.what) as advance:
            for number, variant in enumerate(self.variants):
                advance(number, variant.name)

                def follow(done: int, number: int = number, name: str = variant.name) -> None:
                    advance(number, f"{name}, {done} of {len(self.x)} points")

                def compute(variant: Variant = variant, follow: Follow = follow) -> Mapping[str, Any]:
                    free_memory()  # a variant that got the rest of a GPU's memory would seem slow
                    return self.measure(variant, follow)

                with self.refusing(variant.name):
                    found[variant.name] = self.checkpoint.load_or_compute(self.part(variant), compute)
                if number == 0 and variant.name in self.refused:
                    raise ValueError(f"{self.env.name} has no reference for comparison: {self.refused[variant.name]}")
            advance(len(self.variants))
        return found

    def left(self) -> list[Variant]:
        """Return the variants that are not measured yet."""
        return [variant for variant in self.variants if self.checkpoint.load(self.part(variant)) is None]

    def describe_kept(self) -> str:
        """Describe the stored part."""
        done = len(self.variants) - len(self.left())
        return f"{done} of {len(self.variants)} {self.what} are kept in {self.checkpoint.folder}"

    def describe_left(self) -> str:
        """Describe the remaining measurements."""
        left = len(self.left())
        kept = f", {len(self.variants) - left} are done already" if left < len(self.variants) else ""
        known = f", the {self.variants[0].name} from stored results" if self._is_known(self.variants[0]) else ""
        return f"{left} {self.what} to measure{kept}{known}"

    def _is_known(self, variant: Variant) -> bool:
        """Return whether a variant is the reference, with stored results of an earlier study at these points."""
        if variant.name != self.variants[0].name or self.checkpoint.load(self.part(variant)) is not None:
            return False
        with suppress(ValueError, RuntimeError, MemoryError):  # refused: whoever measures it will say so
            return is_kept(self._make(variant), self.x)
        return False

    def expected(self) -> Iterator[Expected]:
        """Yield the variants that are neither measured nor refused."""
        for variant in self.left():
            with self.refusing(variant.name):
                found = self._expect(variant, self._make(variant))
                known = len(self.x) - POINTS if self._is_known(variant) else 0
                yield replace(found, episodes=max(0.0, found.episodes - known))

    def _make(self, variant: Variant) -> Environment:
        return variant.make(self.env)

    def _expect(self, variant: Variant, env: Environment) -> Expected:
        return Expected(variant.name, env, len(self.x))


def samples_of(arrays: Mapping[str, Mapping[str, Any]]) -> dict[str, Sample]:
    """Return the samples of measured variants, by name."""
    return {name: Sample.of_arrays(found) for name, found in arrays.items()}


def read_positive(name: str, value: float | None, default: float) -> float:
    """Return an option that is a positive number. Raises ValueError for anything else."""
    value = default if value is None else value
    if not 0 < value < math.inf:
        raise ValueError(f"{name} takes a positive number; got {value:g}")
    return value
