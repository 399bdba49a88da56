"""The base class of all environments: a scene with parameters, three fidelities, losses and gradients."""

from __future__ import annotations

import abc
import inspect
import threading
import weakref
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from importlib import import_module
from types import MethodType, ModuleType
from typing import Any, ClassVar, TypeVar, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..landscapes.episode import Episode as Episode
from ..landscapes.identity import MODEL_VERSION
from ..landscapes.objective import Evaluation, Objective, SimulatorError, Status, check_points
from ..landscapes.options import NoOptions, read_options, record_options
from ..landscapes.sampling.memory import Pool, free_memory, is_out_of_memory
from ..landscapes.space import ParameterSpace, as_tensor
from .engines import EXTRAS, Engine, find_engine
from .records import Fidelity as Fidelity
from .records import MaterialRange as MaterialRange
from .records import ModelPart as ModelPart
from .records import Work as Work
from .records import unknown_fidelity

T = TypeVar("T")


def cores() -> int:
    """Count the cores this process may use."""
    from .engines import runtime

    return runtime.cores()


class OwnMethod:
    """A method of an object that does not keep the object alive.

    An object that stores its own bound method is part of a cycle, whose memory is freed only by garbage collection.
    """

    def __init__(self, method: Callable[..., Any]) -> None:
        self._owner, self._function = weakref.ref(method.__self__), method.__func__  # type: ignore[attr-defined]

    def __call__(self, *values: Any) -> Any:
        """Call it."""
        return self._function(self._owner(), *values)

    def __reduce__(self) -> tuple[Any, ...]:
        """Move to another process with the object."""
        return OwnMethod, (MethodType(self._function, self._owner()),)


def copied(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Copy numbers out of a solver's memory, which its next run overwrites, to float64 on the CPU.

    `.double().cpu()` would return the same memory where a solver computes in float64 on a CPU.
    """
    return values.to("cpu", torch.float64, copy=True)


def describe_presets(presets: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the names of presets, to end a sentence about a scene."""
    return f"preset{'s' if len(presets) > 1 else ''} {', '.join(presets)}" if presets else "no presets"


def describe_settings(options: Mapping[str, Any]) -> str:
    """Return the options that a preset sets, in the spelling of the command line; empty for none."""
    said = (f"{name}={str(value).lower() if isinstance(value, bool) else value}" for name, value in options.items())
    return ", ".join(said) or "the defaults"


FLOAT32 = torch.finfo(torch.float32).max
SHORTER = (0.01, 0.02)  # shares by which replicas shorten the time step; a longer step might be unstable
PROBES = 8  # points besides the centre that are tried where a whole batch raised


class Environment(Objective):
    """A differentiable scene: a batch of parameter vectors in, losses and gradients out.

    A new scene derives from this class. It needs `space` and `_evaluate`, which simulates; class attributes describe
    it. Optional abilities have defaults. An environment is also a torch function: `env(x)` returns losses, shape
    (batch,), that can be differentiated. `fidelity` is a name from `fidelities`, by default the first, or a record;
    `device` is auto, cpu or cuda. `engine` is one of `engines`, by default the first; options are those of the class's
    `Options`. Two runs give the same bits, on a CPU and on a GPU, alone or in a batch, except on an engine that cannot
    promise that. `deterministic` refuses such an engine.
    """

    # Of all engines or by name, raised by hand when numbers change; 0 where nothing says when they do.
    model_version: ClassVar[int | Mapping[str, int]] = 1
    fidelities: ClassVar[Mapping[str, Fidelity]] = {"default": Fidelity("default", dt=0.0, precision="float64")}
    examples: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    Options: ClassVar[type[Any]] = NoOptions
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}  # name -> options that are set together, by their names
    devices: ClassVar[tuple[str, ...]] = ("cpu",)
    engines: ClassVar[tuple[str, ...]] = ("warp",)
    horizon_option: ClassVar[str] = "horizon"  # the setting that says how long an episode is, where there is one
    control_step: ClassVar[float] = 0.0  # how long a control is held [s], in whole time steps; 0 where any step does
    known_failures: ClassVar[Mapping[str, Mapping[str, str]]] = {}  # fidelity -> check of `landscape check` -> reason
    contact_stiffness: ClassVar[str] = ""  # the option that says how stiff contact is, where it is by penalty
    accuracy_options: ClassVar[Mapping[str, tuple[float, ...]]] = {}  # of the same scene, but nearer or cheaper: to try
    material_range: ClassVar[MaterialRange | None] = None  # where an option sets what the scene is made of
    designed_order: ClassVar[Mapping[str, float]] = {}  # of convergence in dt, resolution, joint (both at once)
    model_parts: ClassVar[tuple[ModelPart, ...]] = ()  # what the model is made of, each with options that change it
    differentiates_observations: ClassVar[bool] = False  # whether there are gradients of what a policy sees

    _solvers: Pool[Any] | None = None  # a scene on an engine sets both in `_setup`: what simulates,
    _capacity = 1 << 20  # and how many rows it takes at once,
    _max_rows = 1 << 20  # at most

    def __init__(
        self,
        /,
        *,
        fidelity: str | Fidelity | None = None,
        device: str = "auto",
        engine: str | None = None,
        deterministic: bool = False,
        **options: Any,
    ) -> None:
        self.fidelity = self._find_fidelity(fidelity)
        self._refuse_broken_steps()
        self.device = self._find_device(device)
        self.engine = self.check_engine(engine or self.engines[0])
        self.deterministic = deterministic
        if deterministic and not self.capabilities.deterministic:
            able = " and ".join(name for name in self.engines if find_engine(name).deterministic)
            raise ValueError(f"{self.name} is deterministic on engine {able or 'none'} only; got engine {self.engine}")
        self.options = read_options(self.name, self.Options, options)
        self._stop = threading.Event()
        self._raised: Exception | None = None  # what the simulation has raised now,
        self._answering: Tensor | None = None  # and a point at which it did not
        self._setup()
        if not isinstance(getattr(self, "space", None), ParameterSpace):
            raise ValueError(
                f"{self.name} has no parameters; give the class a ParameterSpace as `space`, or set one in `_setup`"
            )

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers, as plain JSON."""
        return {
            "objective": self.name,
            "options": record_options(self.options),
            "fidelity": self.fidelity.name,
            "settings": self.fidelity.record(),
            "device": self.device,
            "engine": self.engine,
            "deterministic": self.deterministic,
            MODEL_VERSION: self.version_on(self.engine),
        }

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the parts of this process, so that an environment in pure Python can be sent to another one."""
        return {name: value for name, value in vars(self).items() if name != "_stop"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state that another process sent."""
        vars(self).update(state, _stop=threading.Event())

    @final
    def remake(
        self,
        *,
        fidelity: str | Fidelity | None = None,
        device: str | None = None,
        engine: str | None = None,
        deterministic: bool | None = None,
        **options: Any,
    ) -> Environment:
        """Return this environment with other settings; settings that are not given stay.

        Raises ValueError for unknown settings.
        """
        return self._remake(
            fidelity=self.fidelity if fidelity is None else fidelity,
            device=device or self.device,
            engine=engine or self.engine,
            deterministic=self.deterministic if deterministic is None else deterministic,
            **{**asdict(self.options), **options},
        )

    @final
    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if requested, at points `x` of the space, shape (batch, dim).

        A row is a point of `space`: a parameter on a logarithmic scale is given by its decimal logarithm. Rows do not
        depend on each other. The status of a row reports a failed simulation. A row that raises has status ERROR, and
        the evaluation contains the first message. Raises ValueError where x has another shape, another type or values
        that are not finite, and where the simulation raises at every tried point.
        """
        x = self._check_points(x)
        if len(x) == 0:
            return Evaluation.empty(self.space.dim, grad=grad)
        parts = self._map_parts(partial(self._evaluate_rows, grad=grad), x)
        whole = Evaluation.join(parts, dim=self.space.dim, grad=grad)
        slope = None if whole.grad is None else whole.grad.to(x)
        found = Evaluation.from_results(whole.loss.to(x), slope, whole.status.cpu(), whole.error)
        if found.error:
            self._refuse_broken(x, found)
        return found

    @final
    @classmethod
    def preset_options(cls, name: str) -> dict[str, Any]:
        """Return the options that a preset sets. Raises ValueError for an unknown name."""
        if name not in cls.presets:
            raise ValueError(f"{cls.name} has {describe_presets(cls.presets)}; got preset {name!r}")
        return dict(cls.presets[name])

    @final
    @classmethod
    def version_on(cls, engine: str) -> int:
        """Return the model version on an engine; results of different versions are never mixed."""
        return cls.model_version if isinstance(cls.model_version, int) else cls.model_version.get(engine, 1)

    @classmethod
    def about(cls) -> str:
        """Return the description of the scene, then that of its family."""
        return "\n\n".join(inspect.cleandoc(kind.__doc__) for kind in cls.own_classes() if kind.__doc__)

    @final
    @classmethod
    def own_classes(cls) -> tuple[type, ...]:
        """Return the scene's class and its base classes, up to this one."""
        return cls.__mro__[: cls.__mro__.index(Environment)]

    @final
    @classmethod
    def nearest_dt(cls, dt: float) -> float:
        """Return the nearest time step to `dt` [s] that divides a control step into whole steps."""
        return cls.control_step / max(1, round(cls.control_step / dt)) if cls.control_step else dt

    @final
    def check_engine(self, engine: str) -> str:
        """Return the name of one of the scene's engines. Raises ValueError where the scene has no such engine."""
        if engine not in self.engines:
            raise ValueError(f"{self.name} has engine {' and '.join(self.engines)}; got engine {engine!r}")
        return engine

    @final
    def example(self, name: str) -> Float[Tensor, " dim"]:
        """Return one of the scene's named parameter vectors. Raises ValueError where it has no such example."""
        if name not in self.examples:
            raise ValueError(f"{self.name} has no example {name!r}; it has {', '.join(self.examples) or 'none'}")
        return self.space.from_values(torch.tensor(self.examples[name], dtype=torch.float64))

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the frames of the episode at one point. Raises ValueError where a scene has nothing to draw."""
        raise ValueError(f"{self.name} has no episode to draw; give its class a method `episode`")

    def events(self, x: Float[Tensor, "batch dim"]) -> Mapping[str, Int[Tensor, " batch"]]:
        """Count the events of each episode, name -> shape (batch,); where a count changes, losses can jump."""
        return {}

    @final
    def energy(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step"] | None:
        """Return the mechanical energy [J] after each step of an undriven motion that starts from `x`.

        It is relative to rest at the lowest point, so its initial value is its scale. It can fall but must never rise.
        None where a scene has no such motion.
        """
        parts = [self._energy(part) for part in torch.split(self._check_points(x), self._capacity)]
        known = [part for part in parts if part is not None]
        return torch.cat(known) if known else None

    @final
    def closed_form(self, x: Float[Tensor, "batch dim"]) -> Evaluation | None:
        """Return losses and gradients of the scene's physics in closed form; None where there is none."""
        points = self._check_points(x).clone().requires_grad_()
        with torch.inference_mode(False), torch.enable_grad():
            loss = self._closed_form(self.space.to_values(points))
            if loss is None:
                return None
            (slope,) = torch.autograd.grad(loss.sum(), points)
        return Evaluation.from_results(loss.detach(), slope)

    @final
    def observe(self, x: Float[Tensor, "batch dim"], decision: int) -> Float[Tensor, "batch feature"]:
        """Return an observation of the state just before a decision, float64, scaled to be about one.

        It does not depend on the parameters of this decision and later ones. The last feature is the elapsed fraction
        of the episode. If parameters set the start of an episode or its materials, that is the only feature: the scene
        is a bandit with a single decision. Raises ValueError where there is no such decision, and at a horizon other
        than 1, where decisions do not divide an episode.
        """
        x, _ = self._before(self._check_points(x), decision)
        seen = torch.cat(self._map_parts(partial(self._observe, decision=decision), x))
        return torch.cat([seen, seen.new_full((len(x), 1), decision / self.decisions)], dim=1)

    @final
    def pull_back_observation(
        self, x: Float[Tensor, "batch dim"], decision: int, weight: Float[Tensor, "batch feature"]
    ) -> Float[Tensor, "batch dim"]:
        """Return the gradient by x of the weighted sum of an observation.

        It is zero for the parameters of this decision and later ones. Raises ValueError as `observe` does, and where
        observations are not differentiated.
        """
        if not self.differentiates_observations:
            raise ValueError(f"{self.name} does not differentiate its observations")
        x, made = self._before(self._check_points(x), decision)

        def part(both: Float[Tensor, "some dim_and_feature"]) -> Float[Tensor, "some dim"]:
            with torch.inference_mode(False), torch.enable_grad():
                return self._pull_back_observation(both[:, : x.shape[1]], decision, both[:, x.shape[1] :])

        slope = torch.cat(self._map_parts(part, torch.cat([x, weight[:, :-1].to(x)], dim=1)))
        slope[:, made:] = 0
        return slope

    def _before(self, x: Float[Tensor, "batch dim"], decision: int) -> tuple[Float[Tensor, "batch dim"], int]:
        """Return points with the middle of the box from a decision on, and the number of parameters before that."""
        if self.decisions > 1 and self.horizon not in (None, 1.0):
            raise ValueError(f"{self.name} takes decisions at horizon 1 only; got horizon {self.horizon:g}")
        if not 0 <= decision < self.decisions:
            raise ValueError(f"{self.name} numbers its decisions 0 to {self.decisions - 1}; got {decision}")
        made = self.space.dim * decision // self.decisions
        return torch.cat([x[:, :made], self.space.center[made:].expand(len(x), -1)], dim=1), made

    @final
    def prepare(self) -> None:
        """Compile the kernels, or load them from the cache, so that the first evaluation is as fast as the next."""
        self._compile_ahead()
        if self._solvers is not None:
            with self._solvers.lend():
                pass
        self._prepare()

    @final
    def shrink(self, rows: int) -> None:
        """Limit batches to `rows` rows from now on, to reduce the memory of the solvers."""
        self._max_rows, self._solvers = rows, None
        free_memory()
        self._setup()

    @final
    def release(self) -> None:
        """Free the memory that solvers hold between evaluations; the next evaluation makes them again."""
        self._drop_solvers()
        free_memory()

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        return 0

    def work(self) -> Work:
        """Return the amount of computation of one episode, to compare engines."""
        return Work(1, "evaluation")

    @property
    def precision(self) -> str:
        """float32 or float64: the precision of the losses."""
        return self.fidelity.precision

    @property
    def packages(self) -> tuple[str, ...]:
        """Additional packages that the environment's engine needs."""
        return EXTRAS.get(self.capabilities.extra, ())

    @property
    def horizon(self) -> float | None:
        """The length of an episode, in the unit of its setting; None where there is no such setting."""
        value = {**vars(self.options), **self.fidelity.settings}.get(self.horizon_option)
        return float(value) if isinstance(value, int | float) else None

    def with_horizon(self, horizon: float) -> Environment:
        """Return this environment with episodes of another length, rounded where the setting is a whole number.

        Raises ValueError where no setting gives the length of an episode.
        """
        value = vars(self.options).get(self.horizon_option)
        if value is None:
            raise ValueError(f"{self.name} has no setting for the length of an episode; name one as horizon")
        options: dict[str, Any] = {self.horizon_option: max(1, round(horizon)) if isinstance(value, int) else horizon}
        return self.remake(**options)

    def length(self) -> float:
        """Return a number proportional to the simulated time of an episode, for one size of the scene."""
        return self.work().count * self.fidelity.dt

    def replicas(self) -> Mapping[str, Environment]:
        """Return the same physics computed differently but equally accurately, by the name of the change.

        {} where nothing can be changed: a closed form has neither steps nor a grid.
        """
        return {}

    def plain_point(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Return the corresponding points of the environment without its remedies."""
        return x

    @property
    def gradients_from_losses(self) -> bool:
        """Whether gradients are computed from losses alone and cost nothing extra."""
        return False

    def without(self) -> Environment:
        """Return the environment without its remedies, or itself."""
        return self

    def engine_call(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Callable[[], object] | None:
        """Return a call of the engine alone at these points, for timing; None where evaluating does nothing else."""
        return None

    @property
    def stiffness_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that set the stiffness of a material: those that contain "stiffness"."""
        return tuple(name for name in self.space.names if "stiffness" in name)

    @property
    def threads(self) -> int:  # type: ignore[override] # read only
        """Number of threads a batch is spread over: on a CPU, if the engine's solvers can run in parallel."""
        return cores() if self._solvers is not None and self.device == "cpu" and self.capabilities.concurrent else 1

    @property
    def capabilities(self) -> Engine:
        """What the environment's engine can do."""
        return find_engine(self.engine)

    @property
    def _solvers_at_most(self) -> int | None:
        return 1 if self.device == "cuda" else None  # one takes what memory a GPU has

    @property
    def preferred_batch(self) -> int:  # type: ignore[override] # read only
        """Number of points worth evaluating at once."""
        return 16 if self._solvers is None else self._capacity * self.threads

    @abc.abstractmethod
    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Simulate at least one point, given by the parameters' own values.

        Called from several threads at once where `threads` is above one.
        """

    def _remake(self, **settings: Any) -> Environment:
        """Return this environment with all settings given."""
        return type(self)(**settings)

    @final
    def _replicas_of(self, changes: Mapping[str, Mapping[str, Any]]) -> dict[str, Environment]:
        """Return this environment with changed fields of its fidelity and added settings, by name."""
        found = {}
        for name, change in changes.items():
            settings = {**self.fidelity.settings, **change.get("settings", {})}
            named = {**change, "name": f"{self.fidelity.name}, {name}", "settings": settings}
            found[name] = self.remake(fidelity=replace(self.fidelity, **named))
        return found

    @final
    def _shorter_steps(self, steps: int) -> dict[str, dict[str, float]]:
        """Return the fidelity changes that move contacts within their steps, for an episode of this many steps."""
        shorter = {
            share: max(steps + place, round(steps * (1 + share))) for place, share in enumerate(SHORTER, start=1)
        }
        names = {share: f"time steps {100 * share:.0f} % shorter" for share in shorter}
        return {names[share]: {"dt": self.fidelity.dt * steps / count} for share, count in shorter.items()}

    def _observe(self, x: Float[Tensor, "batch dim"], decision: int) -> Float[Tensor, "batch feature"]:
        """Return the state just before a decision, scaled to be about one."""
        return x.new_zeros(len(x), 0)

    def _pull_back_observation(
        self, x: Float[Tensor, "batch dim"], decision: int, weight: Float[Tensor, "batch feature"]
    ) -> Float[Tensor, "batch dim"]:
        """Return the gradient of the weighted sum of what `_observe` returns, where `differentiates_observations`."""
        raise NotImplementedError

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"] | None:
        """Return the losses of the scene's physics in closed form, differentiable in the parameters' own values."""
        return None

    def _energy(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step"] | None:
        """Return the energy over time of an undriven motion [J], for at most as many rows as a solver takes."""
        return None

    def _evaluate_rows(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Evaluate rows together; where that raises, in halves, to find the rows that raise."""
        try:
            return self._simulate(x, grad=grad)
        except Exception as error:
            if isinstance(error, SimulatorError) or is_out_of_memory(error):
                raise
            self._raised = error
            if len(x) == 1:
                return Evaluation.raised(error, dim=x.shape[1], grad=grad)
        parts = [self._evaluate_rows(part, grad=grad) for part in torch.tensor_split(x, 2)]
        return Evaluation.join(parts, dim=x.shape[1], grad=grad)

    def _refuse_broken(self, x: Float[Tensor, "batch dim"], found: Evaluation) -> None:
        """Raise SimulatorError where a whole batch raised, and every other tried point raises, too.

        So a broken engine, or a function that cannot work, is not mistaken for a landscape of errors.
        """
        raised, self._raised = self._raised, None  # which holds all that was there, this too
        answered = found.status != Status.ERROR
        if bool(answered.any()):
            self._answering = x[answered][:1]
            return
        tried = self._answering
        if tried is None:
            tried = torch.cat([self.space.center[None], self.space.sobol(PROBES, seed=0)])
        for point in tried:
            with suppress(Exception):
                self._simulate(point[None], grad=False)
                self._answering = point[None]
                return
        raise SimulatorError(
            f"{self.name} raised at all {len(x) + len(tried)} points where it was tried: {found.error}; the first was "
            f"x = {self.space.to_values(x[0]).tolist()}"
        ) from raised

    def _simulate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        values = self.space.to_values(x)
        # Torch switches gradients off around `_Bridge.forward`, and callers may have; threads have their own switch.
        with torch.inference_mode(False), torch.set_grad_enabled(grad):
            found = self._evaluate(values, grad=grad)
        if not isinstance(found, Evaluation):
            raise SimulatorError(
                f"{self.name}._evaluate must return an Evaluation; got {type(found).__name__}; make one with "
                "Evaluation.from_results(losses, gradients)"
            )
        if grad and found.grad is None:
            raise SimulatorError(f"{self.name}._evaluate must return gradients with grad=True; got none")
        if found.grad is None or self.space.is_linear:
            return found
        return replace(found, grad=self.space.chain(values, found.grad.detach().to(values)))

    def _setup(self) -> None:
        """Prepare the parts that all evaluations share; sets `space` unless the class does."""

    def _within(self) -> Iterable[Environment]:
        """Return the environments that this one evaluates."""
        return ()

    def _drop_solvers(self) -> None:
        if self._solvers is not None:
            self._solvers.clear()
        for one in self._within():
            one._drop_solvers()

    def _compile_ahead(self) -> None:
        """Compile all kernels in parallel."""

    def _prepare(self) -> None:
        """Prepare everything else that a first evaluation would make."""

    @final
    def _engine(self, kind: str) -> ModuleType:
        """Return the engine's module for `kind` (mpm, springs), imported only when asked for."""
        module = self.capabilities.solvers.get(kind)
        if module is None:
            raise ValueError(f"{self.name} needs an engine that simulates {kind}; engine {self.engine} does not")
        try:
            return import_module(f".engines.{module}", __package__)
        except ImportError as error:
            why = self.capabilities.explain(error)
            raise ValueError(f"{self.name} cannot run on engine {self.engine} here: {why}") from error

    @final
    def _limit_rows(self, capacity: int) -> int:
        """Return the rows a solver takes, from the `capacity` of one that shares the cores."""
        alone = self.device == "cpu" and not self.capabilities.concurrent
        return min(self._max_rows, capacity * (cores() if alone else 1))

    def _refuse_broken_steps(self) -> None:
        dt, nearest = self.fidelity.dt, self.nearest_dt(self.fidelity.dt)
        if abs(nearest - dt) > 1e-6 * dt:
            raise ValueError(
                f"{self.name} keeps each control for {self.control_step:g} s, which must be a whole number of time "
                f"steps; got dt {dt:.6g} s, use {nearest:.6g} s"
            )

    def _rows_per_part(self, rows: int) -> int:
        return max(1, min(-(-rows // self.threads), self._capacity))

    def _map_parts(self, work: Callable[[Tensor], T], x: Float[Tensor, "batch dim"]) -> list[T]:
        """Do the work on each part, in several threads at once where there are some; `_stop` is set while they end."""
        parts, threads = torch.split(x, self._rows_per_part(len(x))), self.threads
        if threads == 1 or len(parts) == 1:
            return list(map(work, parts))
        with ThreadPoolExecutor(threads) as executor:
            try:
                return list(executor.map(work, parts))
            except BaseException:  # an interrupt too: let no thread simulate on
                self._stop.set()
                executor.shutdown(cancel_futures=True)
                self._stop.clear()
                raise

    def _check_points(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
        x = check_points(x, self.space, self.name)
        if not bool(x.isfinite().all()):
            row = int((~x.isfinite().all(dim=1)).nonzero()[0])
            raise ValueError(f"{self.name} takes finite parameters; row {row} of x is {x[row].tolist()}")
        if self.fidelity.precision == "float32" and bool((large := x.abs() > FLOAT32).any()):
            row = int(large.any(dim=1).nonzero()[0])
            raise ValueError(
                f"{self.name} computes in float32, whose largest number is 3.4e38; row {row} of x is {x[row].tolist()}"
            )
        return x

    def _row(self, x: Float[Tensor, " dim"]) -> Float[Tensor, "one dim"]:
        """Return the parameters' own values at a single point, as `episode` takes it, as a batch of one row."""
        return self.space.to_values(self._check_points(as_tensor(x, self.name)[None]))

    def _find_fidelity(self, fidelity: str | Fidelity | None) -> Fidelity:
        if isinstance(fidelity, Fidelity):
            return fidelity
        if fidelity is None:
            return next(iter(self.fidelities.values()))
        if fidelity not in self.fidelities:
            raise unknown_fidelity(self.name, self.fidelities, fidelity)
        return self.fidelities[fidelity]

    def _find_device(self, device: str) -> str:
        if device == "auto":
            return "cuda" if "cuda" in self.devices and self._has_cuda() else "cpu"
        if device not in self.devices:
            raise ValueError(f"{self.name} runs on {' and '.join(self.devices)}; got device {device!r}")
        if device == "cuda" and not self._has_cuda():
            raise ValueError(f"{self.name} cannot run on cuda: this machine has no CUDA device; use --device cpu")
        return device

    def _has_cuda(self) -> bool:
        from .engines.runtime import cuda_available

        return cuda_available()


def check_shape(got: tuple[int, ...], wanted: tuple[int, ...], what: str, name: str) -> None:
    """Raise SimulatorError where a function returned another shape than expected."""
    if got == wanted:
        return
    advice = "a function of one point: vectorized=False"
    if got == (*wanted, 1):
        advice = "squeeze the last axis: `.squeeze(-1)`"
    raise SimulatorError(f"{name} must return {what} of shape {wanted}; got shape {got} ({advice})")
