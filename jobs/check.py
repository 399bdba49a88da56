"""The checks of an environment: those of every objective, and variants by its own options and settings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.capacity import Need, require
from ..landscapes.checks.diagnosis import Diagnosis
from ..landscapes.checks.examination import Share, points_for
from ..landscapes.checks.finding import Finding
from ..landscapes.checks.parameters import ParameterRow
from ..landscapes.checks.slopes import Kind, counts
from ..landscapes.checks.suite import POWER, Results, Settings, check, count_others, episodes
from ..landscapes.checks.usefulness import Usefulness
from ..landscapes.convert import to_json
from ..landscapes.cost import duration, episode_cost, start_seconds
from ..landscapes.options import record_options
from ..landscapes.storage.files import until_full
from .folder import CHECK, IDENTITY
from .job import Job
from .scene import SceneSpec, first_line
from .watch import PREPARING, Say, Stopped, Watch, Work

if TYPE_CHECKING:
    from collections.abc import Callable

    import pandas as pd

    from ..envs.base import Environment
    from ..landscapes.checks.extremes import ExtremeCase
    from ..landscapes.draw.figure import Picture

FACTORS = (1, 2, 4, 8)  # of the fidelity's time step, and of the scene's horizon
GROWTH = (1, 2, 4)  # of the horizon: how long gradients are held against the rise of the loss
POINT_ROWS = 32  # rows that are held for a point: those of all steps of a ladder
FORWARD = 64  # parameters of which both modes are compared at most
FINER, SAME_STEP = (2, 4), 0.01  # parts of the time step, and by which share of it the nearest may be another
LENGTHS = 32  # of episodes, among which the first whose gradient is wrong is looked for
COMPILED_ROWS = 12  # of the batch by which it is measured what another environment compiles: as many as it will get
OWN_SECONDS = 1.0  # that checks take themselves, such as whether memory grows
MODES = ("forward", "reverse")  # of automatic differentiation


def _materials(job: CheckJob) -> list[ExtremeCase]:
    """Return the softest and the stiffest of what a scene is made of, by its options or its parameters."""
    from ..landscapes.checks.extremes import ExtremeCase

    if (ends := job.env.material_range) is not None:
        values = (ends.softest, ends.stiffest)
        return [ExtremeCase(f"{ends.option} {value:g}", _with_option(job.spec, ends.option, value)) for value in values]
    space = job.env.space
    stiff = [space.names.index(name) for name in job.env.stiffness_parameters]
    if not stiff:
        return [ExtremeCase("softest and stiffest", why="it has no stiffness to set")]
    found = []
    for name, bound in (("softest", space.lower), ("stiffest", space.upper)):
        x = space.center[None].clone()
        x[0, stiff] = bound[stiff]
        found.append(ExtremeCase(name, job.itself, x=x))
    return found


@dataclass(frozen=True)
class CheckReport:
    """Record the findings of a check, with the field names of `landscape check --json`.

    `kinds` counts the random points by how their gradients compare with finite differences, without empty kinds.
    """

    env: str
    fidelity: str
    settings: dict[str, Any]
    options: dict[str, Any]
    device: str
    engine: str
    power: float
    seed: int
    passed: bool
    findings: tuple[Finding, ...]
    command: str
    diagnoses: tuple[Diagnosis, ...] = ()
    share: Share | None = None
    parameters: tuple[ParameterRow, ...] = ()
    usefulness: tuple[Usefulness, ...] = ()
    kinds: dict[Kind, int] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON, which has no infinity; the findings are its `checks`."""
        found: dict[str, Any] = to_json(vars(self))
        return found | {"checks": [one | {"numbers": one["numbers"] or {}} for one in found.pop("findings")]}

    def table(self) -> pd.DataFrame:
        """Return a table with a row for each check, indexed by `check`: its `outcome`, its `figure` and `why`."""
        import pandas as pd

        rows = [(one.check, one.outcome, one.figure, one.why) for one in self.findings]
        return pd.DataFrame(rows, columns=["check", "outcome", "figure", "why"]).set_index("check")

    def parameter_table(self) -> pd.DataFrame:
        """Return a table of parameters: `zero`, `ratio` to the slope over a hundredth of the box, `verdict`."""
        import pandas as pd

        rows = [asdict(row) for row in self.parameters]
        columns = list(ParameterRow.__dataclass_fields__)
        return pd.DataFrame(rows, columns=columns).set_index("parameter")

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())

    def plot(self, width: float | None = None) -> Picture:
        """Draw over which steps gradients predict the change of the loss; `width` is for print [mm]."""
        from ..landscapes.draw.figure import figure_of

        return figure_of(self, width)


@dataclass(frozen=True)
class CheckJob:
    """An environment to check at random points of its box; `spec` makes it again, and its variants."""

    env: Environment
    spec: SceneSpec
    power: float
    seed: int
    command: str = ""
    results: Results = field(default_factory=Results)

    @classmethod
    def open(cls, scene: SceneSpec, *, power: float = POWER, seed: int = 0, command: str = "") -> CheckJob:
        """Make the environment; nothing is kept on disk. `power` is the share of the box that a defect fills.

        Raises ValueError for what the scene does not have, TooLargeError for more points than there is memory for.
        """
        env = scene.make()
        require("points", points_for(power), partial(_need, env.space.dim))
        known = replace(scene, fidelity=env.fidelity, tolerance=None, device=env.device, engine=env.engine)
        return cls(env, known, power, seed, command)

    @property
    def name(self) -> str:
        """The name that the environment is registered by."""
        return self.spec.name if isinstance(self.spec.name, str) else self.env.name

    def itself(self) -> Environment:
        """Return the environment, where others of its kind are made."""
        return self.env

    def findings(self, watch: Watch | None = None) -> Iterator[Finding]:
        """Say what it will cost, then yield what each check finds as soon as it is found.

        Raises Stopped where it is interrupted.
        """
        watch, count = watch or Watch(), 0
        watch.plan(self.work())
        say: Say = lambda text: None  # noqa: E731 -- of the moment
        found = self._run(lambda check: say(f"{self.name}: {check}"))
        try:
            with watch.busy(f"{self.name}: {PREPARING}"):
                said, seconds = self._cost()
            watch.announce(said, seconds)
            while True:
                with watch.busy(f"{self.name}: checking") as say:
                    finding = next(found, None)
                if finding is None:
                    return
                count += 1
                yield finding
        except KeyboardInterrupt as error:
            raise Stopped(f"{count} checks were done, but nothing is kept", kept=False) from error

    def run(self, watch: Watch | None = None) -> CheckReport:
        """Check it and return all that was found. Raises Stopped where it is interrupted."""
        return self.report(tuple(self.findings(watch)))

    def report(self, findings: tuple[Finding, ...]) -> CheckReport:
        """Return what was found as one record."""
        env, seen = self.env, self.results.examination
        seen = seen if seen and seen.found.grad is not None else None
        return CheckReport(
            env=env.name,
            fidelity=env.fidelity.name,
            settings=env.fidelity.record(),
            options=record_options(env.options),
            device=env.device,
            engine=env.engine,
            power=self.power,
            seed=self.seed,
            passed=not any(finding.bad for finding in findings),
            findings=findings,
            command=self.command,
            diagnoses=self.results.diagnoses,
            share=seen.share if seen else None,
            parameters=seen.parameters() if seen else (),
            usefulness=self.results.usefulness,
            kinds={kind: count for kind, count in counts(seen.random.judged).items() if count} if seen else {},
        )

    def into(self, folder: Path, *, force: bool = False, prints: Sequence[float] = ()) -> CheckFolder:
        """Return the job that also leaves the report in a folder, as JSON and as a picture.

        Raises ValueError where the folder holds something else, or another check, which `force` replaces.
        """
        identity = {**self.env.identity(), "power": self.power, "seed": self.seed}
        CHECK.check(folder)
        if not force:
            CHECK.refuse_another(folder, identity)
        return CheckFolder(check=self, identity=identity, folder=folder, command=self.command, prints=prints)

    def _run(self, follow: Callable[[str], None]) -> Iterator[Finding]:
        # Once the cost is known, and by that the type of the losses.
        how = replace(self._settings, precision=self.env.precision, follow=follow)
        yield from check(self.env, how, self.results)

    @cached_property
    def _settings(self) -> Settings:
        """What is checked, and what else can be made of the environment for that."""
        return Settings(
            power=self.power,
            seed=self.seed,
            twin=_twin(self),
            variants=[*_time_steps(self), *_materials(self), *_horizons(self)],
            horizons=_lengths(self),
            other_mode=_other_mode(self),
            finer={factor: self._keep(make) for factor in FINER if (make := _finer(self, factor))},
            lengths=_shorter(self.env),
            make_length=self.env.with_horizon,
            expected=self.env.known_failures.get(self.env.fidelity.name, {}),
        )

    @cached_property
    def longer(self) -> dict[int, Callable[[], Environment]]:
        """What makes the environment with episodes so many times as long, once each; empty without a horizon."""
        own = self.env.horizon
        if not own:
            return {}
        others = {factor: self._keep(partial(self.env.with_horizon, factor * own)) for factor in FACTORS[1:]}
        return {1: self.itself, **others}

    def _keep(self, make: Callable[[], Environment]) -> Callable[[], Environment]:
        """Return what makes another environment, once: but there is no memory for all of them on a GPU."""
        return cache(make) if self.env.device == "cpu" else make

    def work(self) -> list[Work]:
        """Return about how many episodes all checks take."""
        losses, gradients = episodes(self.env.space.dim, self.power, tuple(_lengths(self)))
        gradients += 2 * (sum(FACTORS) + 4)  # two points over longer horizons, time steps and materials
        return [Work(self.env, losses, gradients, others=self._others)]

    @property
    def _others(self) -> float:
        """How many other environments are made, by the time that it takes to compile them."""
        return count_others(self._settings, self.itself)

    def _cost(self) -> tuple[str, float]:
        """Return what is checked, and how long it will take [s]: episodes, and what other environments compile."""
        env, cost, (work,) = self.env, episode_cost(self.env), self.work()
        plain, sloped = work.losses, work.gradients
        compiling = self._compiling_seconds()
        seconds = (plain * cost.forward + sloped * cost.gradient) / env.threads + compiling + OWN_SECONDS
        subject = first_line(env.identity(), env.engine, f"{points_for(self.power)} points")
        if env.precision != env.fidelity.precision:
            subject += f" · its losses are {env.precision}"
        whole = f"{subject}: about {plain} episodes and {sloped} with gradients, in about {duration(seconds)}"
        return whole + (f", {duration(compiling)} of it to compile variants" if compiling else ""), seconds

    def _compiling_seconds(self) -> float:
        """Measure what one other environment compiles, and return what those take that are left [s]."""
        if not self.env.own_programs or not self._others:
            return 0.0
        finer = [*self._settings.finer.values()]
        first = (finer[0] if finer else self.env.remake)()
        rows = min(COMPILED_ROWS, first.preferred_batch)
        return (self._others - bool(finer)) * start_seconds(first, first.space.uniform(rows, seed=0))


@dataclass(frozen=True, kw_only=True)
class CheckFolder(Job[CheckReport]):
    """A check whose report goes to a folder; `identity` says what is checked, and how."""

    results = CHECK
    check: CheckJob
    identity: dict[str, Any]

    def work(self) -> list[Work]:
        """Return what the check has to simulate."""
        return self.check.work()

    def compute(self, watch: Watch) -> CheckReport:
        """Check the environment."""
        return self.check.run(watch)

    def holding(self, watch: Watch) -> AbstractContextManager[None]:
        """Let a full disk end it; a check that is stopped begins again."""
        return until_full(lambda: "the check is not saved")

    def record(self, found: CheckReport) -> Any:
        """Return what is written of it, with what was checked."""
        return {**found.record(), IDENTITY: self.identity}


def _need(dim: int, points: int) -> Need:
    """Return what the points and gradients of all checks take, a copy of each included."""
    return Need(4.0 * 8 * dim * points * POINT_ROWS)


def _with_option(scene: SceneSpec, option: str, value: float | str) -> Callable[[], Environment]:
    """Return what makes a scene with one of its options changed."""
    return replace(scene, options={**scene.options, option: value}).make


def _twin(job: CheckJob) -> Callable[[], Environment] | None:
    """Return what makes the environment in the other precision, if it has one."""
    own = job.env.fidelity
    if not own.dt:  # a formula, not a simulation
        return None
    other = "float32" if own.precision == "float64" else "float64"
    twin = replace(job.spec, fidelity=replace(own, name=f"{own.name} in {other}", precision=other))
    with suppress(ValueError):  # refused: it computes in its own precision only
        twin.make()
        return twin.make
    return None


def _time_steps(job: CheckJob) -> list[ExtremeCase]:
    from ..landscapes.checks.extremes import ExtremeCase

    if not job.env.fidelity.dt:
        return [ExtremeCase("dt 1x to 8x", why="it has no time step")]
    found: list[ExtremeCase] = []
    taken: dict[float, int] = {}
    for factor in FACTORS:
        dt = job.env.nearest_dt(factor * job.env.fidelity.dt)
        if dt in taken:
            why = f"the nearest step that fits into a control step is the same as for dt {taken[dt]}x"
            found.append(ExtremeCase(f"dt {factor}x", why=why))
        else:
            found.append(_time_step(job, factor, dt))
            taken[dt] = factor
    return found


def _time_step(job: CheckJob, factor: int, dt: float) -> ExtremeCase:
    from ..landscapes.checks.extremes import ExtremeCase

    if factor == 1:
        return ExtremeCase("dt 1x", job.itself)
    own = job.env.fidelity
    longer_steps = replace(job.spec, fidelity=replace(own, name=f"{own.name}, dt {factor}x", dt=dt))
    note = ""
    if abs(dt - factor * own.dt) > 1e-6 * dt:
        note = f"{dt / own.dt:.3g}x, the nearest step that fits into a control step"
    with suppress(Exception):  # the check itself will meet it, and say so
        work, before = longer_steps.make().work().count, job.env.work().count
        longer = dt / own.dt * work / before
        if work != before and abs(longer - 1) > 1e-3:
            note = f"its steps are rounded: an episode is {longer:.3g} times as long"
    return ExtremeCase(f"dt {factor}x", longer_steps.make, why=note)


def _finer(job: CheckJob, factor: int) -> Callable[[], Environment] | None:
    """Return what makes the environment with time steps that are so many times shorter, in float64 where it can."""
    own = job.env.fidelity
    if not own.dt:
        return None
    dt = job.env.nearest_dt(own.dt / factor)
    if abs(dt * factor / own.dt - 1) > SAME_STEP:
        return None
    shorter = replace(own, name=f"{own.name}, dt / {factor}", dt=dt)
    return replace(job.spec, fidelity=shorter).make


def _shorter(env: Environment) -> list[float]:
    """Return lengths of episodes up to its own, among which the first wrong one is looked for."""
    own = env.horizon
    if not own:
        return []
    whole = float(own).is_integer() and own >= LENGTHS / 2
    return (
        [float(one) for one in range(1, int(own) + 1)]
        if whole
        else [own * one / LENGTHS for one in range(1, LENGTHS + 1)]
    )


def _horizons(job: CheckJob) -> list[ExtremeCase]:
    from ..landscapes.checks.extremes import ExtremeCase

    if not job.longer:
        return [ExtremeCase("horizon 1x to 8x", why="no setting controls how long an episode is")]
    return [ExtremeCase(f"horizon {factor}x", make) for factor, make in job.longer.items()]


def _lengths(job: CheckJob) -> dict[float, Callable[[], Environment]]:
    """Return what makes the environment with longer episodes, in float64 where it computes in that, by factor."""
    if job.longer and job.env.fidelity.precision != "float64":
        exact = replace(job.spec, fidelity=replace(job.env.fidelity, precision="float64"))
        with suppress(ValueError):  # refused: it computes in its own precision only
            env = exact.make()
            return {factor: partial(env.with_horizon, factor * (job.env.horizon or 1.0)) for factor in GROWTH}
    return {factor: make for factor, make in job.longer.items() if factor in GROWTH}


def _other_mode(job: CheckJob) -> Callable[[], Environment] | None:
    """Return what makes the environment with gradients by the other mode, where its option `mode` offers both."""
    mode = vars(job.env.options).get("mode")
    if mode not in MODES:
        return None
    (other,) = set(MODES) - {mode}
    if job.env.space.dim > FORWARD:
        return partial(_refuse_forward, job.env.space.dim)
    return _with_option(job.spec, "mode", other)


def _refuse_forward(dim: int) -> Environment:
    raise ValueError(f"forward differentiation takes one tangent per parameter; {dim} are too many to try")
