"""Functions of others as environments: what a user says of a function, and the environment that calls it."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypedDict, Unpack, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.identity import UNNAMED
from ..landscapes.objective import Evaluation, SimulatorError, first_line
from ..landscapes.space import ParameterSpace, as_tensor, as_whole
from .base import Environment, Fidelity, check_shape

if TYPE_CHECKING:
    from numpy.typing import NDArray

NAMELESS = "function"  # what a lambda is called
SAME_TIME = 0.01  # relative difference of what counts as the same time
SEED_ARGUMENTS = ("key", "seed")  # of a function that draws random numbers
FIDELITY_FIELDS = ("dt", "resolution", "sampling", "particles")  # that a function and a `Fidelity` call the same
KINDS = (bool, int, float, str)  # of options


class FunctionKeywords(TypedDict, total=False):
    """The keywords that every `from_...` takes.

    `name` is what the function is called, by default its own name, and `loss_unit` the unit of what it returns.
    `maximize` looks for its greatest value: losses are its negative.

    Keyword arguments of the function are its settings. `options` are those that a user sets, with their defaults; by
    default all whose default is a number, a text or a truth value. `fidelities` names what decides how accurately it
    simulates, the cheapest first and the most accurate last: {"draft": {"dt": 0.02}, "reference": {"dt": 0.001}}.
    `horizon` names the keyword that says how long an episode is. What belongs together goes into the fidelities
    together, such as the number of steps with the time step.

    A function that takes a `key` (of JAX) or a `seed` gets the same one at every point: common random numbers. The
    loss is the mean over `seeds` of them, and then it knows its standard error.
    `precision`, float64 or float32, is what it is given its points in, at most `rows` of them in one call.
    """

    name: str
    loss_unit: str
    maximize: bool
    options: Mapping[str, Any] | None
    fidelities: Mapping[str, Mapping[str, Any]] | None
    horizon: str | None
    seeds: int
    precision: str
    rows: int


Compute = Callable[[Float[Tensor, "batch dim"], bool], tuple[Tensor, Tensor | None, str]]
"""Returns losses, gradients if asked for, and the type of numbers that the losses came in, at points."""


class Backend(Protocol):
    """A library that a function is written in, and how it is called and differentiated there."""

    @property
    def engine(self) -> str:
        """What the library is called."""

    @property
    def devices(self) -> tuple[str, ...]:
        """What it runs on."""

    @property
    def device(self) -> str:
        """Where it runs by default: auto, cpu or cuda."""

    def has_cuda(self) -> bool:
        """Say whether it finds a CUDA device."""

    def bind(self, call: Function, settings: Mapping[str, Any], precision: str, device: str) -> Compute:
        """Return what computes the function with these keyword arguments."""


@dataclass(eq=False)
class Function:
    """A function of points with what its user says of it, as `FunctionKeywords` has it.

    Raises ValueError for what does not go together.
    """

    fn: Callable[..., Any]
    space: ParameterSpace
    backend: Backend
    name: str = ""
    loss_unit: str = ""
    maximize: bool = False
    options: Mapping[str, Any] | None = None
    fidelities: Mapping[str, Mapping[str, Any]] | None = None
    horizon: str | None = None
    seeds: int = 1
    precision: str = "float64"
    rows: int = 256

    def __post_init__(self) -> None:
        fn, who = self.fn, f"from_{self.backend.engine}"
        if not callable(fn):
            raise ValueError(f"a function is wanted; got {type(fn).__name__} {fn!r}")
        if not isinstance(self.space, ParameterSpace):
            raise ValueError(f"a ParameterSpace is wanted, as gs.ParameterSpace({{'x': (-1, 1)}}); got {self.space!r}")
        self.name, known = self.name or function_name(fn), _arguments(fn)
        given = {key: dict(value) for key, value in (self.fidelities or {}).items()}
        own = {argument: None for settings in given.values() for argument in settings if argument != "precision"}
        bound = fn.keywords if isinstance(fn, partial) else {}  # by the user: no setting any more
        chosen = _default_options(known, {**own, **bound}) if self.options is None else dict(self.options)
        _check_arguments(self.name, known, chosen, own, self.horizon)
        self.seeds = as_whole(self.seeds, f"{who}'s seeds", least=1)
        self.rows = as_whole(self.rows, f"{who}'s rows", least=1)
        self.seed_argument = next((one for one in SEED_ARGUMENTS if one in known and one not in own | chosen), "")
        if self.seeds > 1 and not self.seed_argument:
            seeded = " or ".join(SEED_ARGUMENTS)
            raise ValueError(f"seeds={self.seeds} averages over random numbers, and {self.name} takes no {seeded}")
        self.defaults = chosen | ({"seed": 0} if self.seed_argument else {})
        self.known_fidelities = _read_fidelities(self.name, given, _check_precision(self.precision, who))
        self.fidelity_arguments = tuple(own)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what another process makes again."""
        return {name: value for name, value in vars(self).items() if name != "options_class"}

    @cached_property
    def options_class(self) -> type[Any]:
        """The dataclass of the options, each of the type of its default."""
        declared = [(name, type(value), field(default=value)) for name, value in self.defaults.items()]
        return make_dataclass("Options", declared, frozen=True)

    @cached_property
    def counts_steps(self) -> bool:
        """Whether the horizon counts time steps: times dt, it is the same time in every fidelity."""
        if not {self.horizon, "dt"} <= set(self.fidelity_arguments):
            return False
        steps: list[Any] = [one.settings.get(self.horizon or "") for one in self.known_fidelities.values()]
        if not all(isinstance(count, int) for count in steps):
            return False
        times = [count * one.dt for count, one in zip(steps, self.known_fidelities.values(), strict=True)]
        return bool(max(times) - min(times) <= SAME_TIME * max(times))

    def settings_of(self, options: Any, fidelity: Fidelity) -> dict[str, Any]:
        """Return the function's keyword arguments, but for its random numbers, with these options at a fidelity."""
        found = {one.name: getattr(options, one.name) for one in fields(options)}
        if self.seed_argument:
            found.pop("seed")
        for argument in self.fidelity_arguments:
            known = argument in FIDELITY_FIELDS
            found[argument] = getattr(fidelity, argument) if known else fidelity.settings.get(argument)
        of = next((one for one in self.known_fidelities.values() if one.settings == fidelity.settings), fidelity)
        if self.horizon and self.counts_steps and of.dt != fidelity.dt:  # a variant of a fidelity, of the same time
            found[self.horizon] = max(1, round(found[self.horizon] * of.dt / fidelity.dt))
        return {name: value for name, value in found.items() if value is not None}


class FunctionEnvironment(Environment):
    """A function of points, in somebody's library, as an environment.

    The model is the function's own. Parameters and loss are what its user says.
    """

    model_version = 0  # nothing says when a function changes; stored results are compared with it by evaluating it

    def __init__(self, function: Function, /, **settings: Any) -> None:
        self.function = function
        self.name, self.space, self.loss_unit = function.name, function.space, function.loss_unit
        vars(self).update(
            fidelities=function.known_fidelities,
            Options=function.options_class,
            engines=(function.backend.engine,),
            devices=function.backend.devices,
            horizon_option=function.horizon or "horizon",
        )
        self.loss_type = ""  # of numbers that the losses came in, once there are some
        super().__init__(**settings)

    @property
    def preferred_batch(self) -> int:  # type: ignore[override] # read only
        """Number of points worth evaluating at once."""
        return min(self.function.rows, self._max_rows)

    @property
    def precision(self) -> str:
        """float32 or float64: the precision of the losses, by their type of numbers."""
        return "float32" if self.loss_type in ("float32", "float16", "bfloat16") else self.fidelity.precision

    @property
    def horizon(self) -> float | None:
        """How long an episode is, in the unit of the keyword that says so; None where none does."""
        value = {**vars(self.options), **self.fidelity.settings}.get(self.horizon_option)
        return float(value) if isinstance(value, int | float) else None

    def with_horizon(self, horizon: float) -> Environment:
        """Return this environment with episodes of another length; where the keyword is a whole number, rounded.

        Raises ValueError where no keyword says how long an episode is.
        """
        if self.horizon is None or self.horizon_option not in self.function.fidelity_arguments:
            return super().with_horizon(horizon)
        now = self._settings[self.horizon_option]  # other than the fidelity's in a variant with another time step
        value = now * horizon / self.horizon
        value = max(1, round(value)) if isinstance(now, int) else value
        settings = {**self.fidelity.settings, self.horizon_option: value}
        named = f"{self.fidelity.name}-{self.horizon_option}-{value:g}"
        return self.remake(fidelity=replace(self.fidelity, name=named, settings=settings))

    def length(self) -> float:
        """Return what is proportional to the time that an episode simulates: 1 where nobody says how long it is."""
        if not self.function.counts_steps:
            return 1.0
        steps: float = self._settings[self.horizon_option]
        return steps * self.fidelity.dt

    def about(self) -> str:  # type: ignore[override] # a function's documentation is its own, not the class's
        """Return what the function says of itself."""
        return inspect.getdoc(self.function.fn) or f"The function {self.name}, which says nothing of itself."

    def noise(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"] | None:
        """Return the standard error of the mean over seeds at each point [loss unit]; None of one seed."""
        if self.function.seeds < 2:
            return None
        values = self.space.to_values(self._check_points(x))
        losses = torch.stack([self._compute(seed)(values, False)[0].double() for seed in self._seeds])
        error: Tensor = losses.std(dim=0) / len(losses) ** 0.5
        return error

    def named(self, name: str) -> FunctionEnvironment:
        """Return the same environment by another name."""
        settings = {"fidelity": self.fidelity, "device": self.device, **asdict(self.options)}
        return FunctionEnvironment(replace(self.function, name=name), **settings)

    def _remake(self, **settings: Any) -> Environment:
        return FunctionEnvironment(self.function, **settings)

    def _setup(self) -> None:
        self._settings = self.function.settings_of(self.options, self.fidelity)
        self._computes: dict[int, Compute] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what was compiled and the class of the options: another process makes both again."""
        left = {"_computes": {}, "Options": None, "options": asdict(self.options)}
        return {**super().__getstate__(), **left}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over what was sent."""
        super().__setstate__(state)
        kind = self.function.options_class
        vars(self).update(Options=kind, options=kind(**state["options"]))

    @property
    def _seeds(self) -> range:
        first = self.options.seed if self.function.seed_argument else 0
        return range(first, first + self.function.seeds)

    def _find_device(self, device: str) -> str:
        return super()._find_device(self.function.backend.device if device == "auto" else device)

    def _has_cuda(self) -> bool:
        return self.function.backend.has_cuda()

    def _rows_per_part(self, rows: int) -> int:
        return min(rows, self.preferred_batch) or 1

    def _compute(self, seed: int) -> Compute:
        if seed not in self._computes:
            settings = dict(self._settings)
            if self.function.seed_argument:
                settings[self.function.seed_argument] = seed
            bound = self.function.backend.bind(self.function, settings, self.fidelity.precision, self.device)
            self._computes[seed] = bound
        return self._computes[seed]

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        losses, slopes, sign = [], [], -1.0 if self.function.maximize else 1.0
        for seed in self._seeds:
            loss, slope, self.loss_type = self._compute(seed)(x, grad)
            losses.append(sign * loss.double())
            slopes.append(None if slope is None else sign * slope.double())
        if len(losses) == 1:
            return Evaluation.from_results(losses[0], slopes[0])
        mean = torch.stack([slope for slope in slopes if slope is not None]).mean(dim=0) if grad else None
        return Evaluation.from_results(torch.stack(losses).mean(dim=0), mean)

    def identity(self) -> dict[str, Any]:
        """Return what decides the numbers, as plain JSON."""
        own: dict[str, Any] = {"maximize": True} if self.function.maximize else {}
        return super().identity() | own | ({"seeds": self.function.seeds} if self.function.seeds > 1 else {})


def function_name(fn: Callable[..., object]) -> str:
    """Return what a function is called, or its type where it has no name."""
    name = str(getattr(fn, "__name__", type(fn).__name__))
    return NAMELESS if name == "<lambda>" else name


def _arguments(fn: Callable[..., Any]) -> dict[str, Any]:
    """Return the keyword arguments of a function with their defaults, `inspect.Parameter.empty` where one has none."""
    try:
        found = list(inspect.signature(fn).parameters.values())
    except (TypeError, ValueError):  # of a function in C
        return {}
    return {one.name: one.default for one in found[1:] if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)}


def _default_options(known: Mapping[str, Any], taken: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keyword arguments whose default is a number, a text or a truth value, and that are not `taken`."""
    free = {name: value for name, value in known.items() if name not in (*taken, *SEED_ARGUMENTS)}
    return {name: value for name, value in free.items() if isinstance(value, KINDS)}


def _check_arguments(
    name: str, known: Mapping[str, Any], options: Mapping[str, Any], own: Mapping[str, Any], horizon: str | None
) -> None:
    """Raise ValueError for settings that are no keyword arguments of the function, or that are said twice."""
    for option, value in options.items():
        if not isinstance(value, KINDS):
            raise ValueError(
                f"{name}'s option {option} needs a number, a text or a truth value as default; got {value!r}"
            )
    if twice := options.keys() & own.keys():
        raise ValueError(f"{name} has {', '.join(sorted(twice))} in options and in fidelities; leave it in one of them")
    if horizon and horizon not in options.keys() | own.keys():
        raise ValueError(f"{name}'s horizon is one of its options or fidelities' settings; got {horizon!r}")
    strange = [one for one in (*options, *own) if known and one not in known]
    if strange:
        takes = ", ".join(known) or "none"
        raise ValueError(f"{name} takes no keyword argument {', '.join(strange)}; it takes {takes}")


def _read_fidelities(name: str, given: Mapping[str, Mapping[str, Any]], precision: str) -> dict[str, Fidelity]:
    """Return fidelities by name, of the settings that a user gave for each."""
    found = {}
    names = {argument for settings in given.values() for argument in settings}
    for fidelity, settings in (given or {UNNAMED: {}}).items():
        if lacking := names - settings.keys() - {"precision"}:
            raise ValueError(f"{name}'s fidelity {fidelity} lacks {', '.join(sorted(lacking))}, which others have")
        own = {key: value for key, value in settings.items() if key in FIDELITY_FIELDS}
        other = {key: value for key, value in settings.items() if key not in (*FIDELITY_FIELDS, "precision")}
        computed = _check_precision(settings.get("precision", precision), name)
        found[fidelity] = Fidelity(fidelity, **{"dt": 0.0, **own}, precision=computed, settings=other)
    return found


def _check_precision(precision: Any, who: str) -> str:
    if precision not in ("float64", "float32"):
        raise ValueError(f"{who} takes precision float64 or float32; got {precision!r}")
    return str(precision)


# ---- Functions of torch, NumPy, JAX and Warp, simulators with reset and step, and objects of one's own as
# environments.

MIN_STEP = 1e-12  # of differences: losses are rounded to 1e-16 of themselves, and their difference is divided by it
Mode = Literal["reverse", "forward"]
Batch = Literal["vmap", "map"]


def from_torch(
    fn: Callable[..., Tensor],
    space: ParameterSpace,
    *,
    vectorized: bool = True,
    device: str = "cpu",
    **said: Unpack[FunctionKeywords],
) -> Environment:
    """Make an environment of a torch function from points, shape (batch, dim), to losses, shape (batch,).

    Gradients come by autograd. Each loss may depend on its own row only. With `vectorized=False` the function takes a
    single point, shape (dim,), and returns one loss. Points lie on `device`, cpu or cuda. The other keywords are those
    of `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows.

    Raises ValueError for settings that the function does not take; evaluating raises it where the function returns no
    losses of the batch, or losses that carry no gradient.
    """
    return _wrap(fn, space, _Torch(vectorized, device), said)


def from_numpy(
    fn: Callable[..., Any],
    space: ParameterSpace,
    *,
    differences: float | None = None,
    vectorized: bool = True,
    **said: Unpack[FunctionKeywords],
) -> Environment:
    """Make an environment of a NumPy function from points, shape (batch, dim), to losses, shape (batch,).

    The function may return (losses, gradients) instead, gradients of shape (batch, dim). If it returns losses only,
    `differences` makes gradients by central differences with that step, a fraction of each parameter's range; at the
    bounds they are one-sided, since the function is not asked beyond them. With `vectorized=False` the function takes a
    single point, shape (dim,), and returns one loss, or that and its gradient. The other keywords are those of
    `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows.

    Raises ValueError where `differences` is no fraction of the bounds, or lost in rounding relative to them.
    """
    step = None if differences is None else _step(differences, space)
    return _wrap(fn, space, _NumPy(vectorized, step), said)


def from_jax(
    fn: Callable[..., Any],
    space: ParameterSpace,
    *,
    mode: Mode = "reverse",
    batch: Batch = "vmap",
    **said: Unpack[FunctionKeywords],
) -> Environment:
    """Make an environment of a JAX function from one point, an array of shape (dim,), to its loss, of shape ().

    Gradients come by reverse differentiation, or forward, which loops of unknown length need and few parameters
    favour. `batch` says how many points are computed together: `vmap` vectorizes the function, `map` calls it point
    after point, which functions without a batching rule and large simulations need. Batches smaller than `rows` are
    padded to the next power of four, since the function is compiled for each size. It runs in its own precision,
    whatever JAX is configured to. Settings are static: the function is compiled for each. The other keywords are those
    of `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows.

    Raises ValueError where JAX is not installed, and for other modes and batches; evaluating raises it where the
    function returns no single number, or JAX cannot trace, differentiate or vectorize it.
    """
    for option, value, known in (("mode", mode, Mode), ("batch", batch, Batch)):
        if value not in get_args(known):
            raise ValueError(f"from_jax takes {option} {' or '.join(get_args(known))}; got {value!r}")
    try:
        from .engines.jax_functions import JaxBackend
    except ImportError as error:
        raise ValueError(f"from_jax needs JAX, which is not here ({error}): pip install jax") from error
    return _wrap(fn, space, JaxBackend(mode, batch), said)


def from_warp(
    fn: Callable[..., Any],
    space: ParameterSpace,
    *,
    device: str = "auto",
    check_overwrites: bool = True,
    **said: Unpack[FunctionKeywords],
) -> Environment:
    """Make an environment of a function that launches Warp kernels, from points to losses.

    The function takes a Warp array of points, shape (batch, dim), and returns one of losses, shape (batch,), both of
    its `precision`, by default float32; each loss may depend on its own row only. What it launches is recorded on a
    tape, and the tape is played backwards for the gradients; the gradients of arrays that the function keeps are set to
    zero after each evaluation. The losses are made with requires_grad=True.

    A kernel that writes to an array which an earlier one has read makes gradients wrong without a word.
    `check_overwrites` looks for that once, before the first gradient, and builds the function's kernels again for it,
    which may take long; leave it out for a simulator that is known to be right. The other keywords are those of
    `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows.

    Raises ValueError for other precisions and devices; evaluating raises it where the function returns no such array,
    launches nothing, does not read its points, or writes to what was read.
    """
    from .engines.warp_functions import WarpBackend

    return _wrap(fn, space, WarpBackend(check_overwrites, device), {"precision": "float32", **said})


def from_step(
    step: Callable[[Any], Any],
    reset: Callable[..., Any],
    space: ParameterSpace,
    *,
    steps: int,
    differences: float | None = None,
    **said: Unpack[FunctionKeywords],
) -> Environment:
    """Make an environment of a simulator with Gymnasium's `reset` and `step`: the loss is minus the sum of rewards.

    A point holds the actions, the first one first; each is held for an equal share of the `steps` of an episode. An
    episode starts with reset(seed=0), the same at every point, and ends early where `step` says terminated or
    truncated. `step(action)` returns (observation, reward, terminated, truncated, info). Gradients come by central
    `differences`, as for `from_numpy`.

        gs.from_step(env.step, env.reset, gs.ParameterSpace.box([f"push {k}" for k in range(5)], -1, 1), steps=100)

    Raises ValueError where the parameters are no whole number of actions.
    """
    steps = as_whole(steps, "from_step's steps", least=1)

    def total(actions: NDArray[np.float64]) -> float:
        reset(seed=0)
        reward = 0.0
        for action in actions[np.arange(steps) * len(actions) // steps]:
            _, gained, terminated, truncated, *_ = step(action)
            reward += float(gained)
            if terminated or truncated:
                break
        return -reward

    size = _action_size(step, space)
    named: FunctionKeywords = {"name": "episode", **said}
    return from_numpy(lambda x: total(x.reshape(-1, size)), space, differences=differences, vectorized=False, **named)


def _action_size(step: Callable[[Any], Any], space: ParameterSpace) -> int:
    """Return how many numbers an action has: those of the simulator's action space, where `step` is its method."""
    simulator = getattr(step, "__self__", None)
    shape = getattr(getattr(simulator, "action_space", None), "shape", None) or ()
    size = int(np.prod(shape))
    if space.dim % size:
        raise ValueError(f"an action has {size} numbers, and {space.dim} parameters are no whole number of actions")
    return size


def _wrap(fn: Callable[..., Any], space: ParameterSpace, backend: Backend, said: FunctionKeywords) -> Environment:
    if unknown := said.keys() - FunctionKeywords.__annotations__.keys():
        raise TypeError(f"from_{backend.engine} takes no keyword {', '.join(sorted(unknown))}")
    return FunctionEnvironment(Function(fn, space, backend, **said))


@dataclass(frozen=True)
class _Torch:
    """Call functions of torch."""

    vectorized: bool
    device: str
    engine: str = "torch"
    devices: tuple[str, ...] = ("cpu", "cuda")

    def has_cuda(self) -> bool:
        """Say whether torch finds a CUDA device."""
        return torch.cuda.is_available()

    def bind(self, call: Function, settings: Mapping[str, Any], precision: str, device: str) -> Compute:
        """Return what computes the function with these keyword arguments."""

        def compute(x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None, str]:
            points = x.to(device, getattr(torch, precision), copy=True).requires_grad_(grad)
            loss = self._losses(call, points, settings)
            losses = _numbers(loss, f"the loss of {call.name}")
            slope = _autograd(loss, points, call.name) if grad else None
            return losses, slope, str(loss.dtype).removeprefix("torch.")

        return compute

    def _losses(self, call: Function, x: Float[Tensor, "batch dim"], settings: Mapping[str, Any]) -> Tensor:
        if self.vectorized:
            found = _called(call, x, settings)
        else:
            parts = [_called(call, point, settings) for point in x]
            found = torch.stack(parts) if all(isinstance(one, Tensor) for one in parts) else parts[0]
        if isinstance(found, tuple):
            raise SimulatorError(
                f"{call.name} must return losses alone, and torch differentiates them; got {len(found)} values "
                "(from_numpy takes losses with gradients)"
            )
        if not isinstance(found, Tensor):
            raise SimulatorError(f"{call.name} must return a tensor; got {type(found).__name__}")
        check_shape(tuple(found.shape), (len(x),), "losses", call.name)
        return found


def _called(call: Function, x: Tensor, settings: Mapping[str, Any]) -> Any:
    """Return what a function returns; say which precision it wants where torch refuses to mix two."""
    try:
        return call.fn(x, **settings)
    except RuntimeError as error:
        if "dtype" in str(error) and {"Float", "Double"} <= set(re.findall(r"\w+", str(error))):
            other = "float32" if x.dtype == torch.float64 else "float64"
            raise SimulatorError(
                f"{call.name} mixes its points with numbers of another type ({first_line(error)}); pass "
                f"precision={other!r} to from_torch, or convert its own with .to(x)"
            ) from error
        raise


def _autograd(loss: Float[Tensor, " batch"], x: Float[Tensor, "batch dim"], name: str) -> Tensor:
    (gradient,) = torch.autograd.grad(loss.sum(), x, allow_unused=True) if loss.requires_grad else (None,)
    if gradient is None:
        raise SimulatorError(
            f"{name} returned losses that carry no gradient; compute them from x with torch operations, "
            "or sample with gradients=0 (--no-gradients)"
        )
    return gradient.detach().to("cpu", torch.float64)


@dataclass(frozen=True)
class _NumPy:
    """Call functions of NumPy."""

    vectorized: bool
    differences: float | None
    device: str = "cpu"
    engine: str = "numpy"
    devices: tuple[str, ...] = ("cpu",)

    def has_cuda(self) -> bool:
        """Say no."""
        return False

    def bind(self, call: Function, settings: Mapping[str, Any], precision: str, device: str) -> Compute:
        """Return what computes the function with these keyword arguments."""

        def losses(x: Float[Tensor, "batch dim"]) -> tuple[Tensor, Tensor | None, str]:
            return self._call(call, x, settings, precision)

        def compute(x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None, str]:
            loss, slope, kind = losses(x)
            if grad and slope is None:
                slope = self._differences(lambda at: losses(at)[0], x, call)
            return loss, slope if grad else None, kind

        return compute

    def _call(
        self, call: Function, x: Float[Tensor, "batch dim"], settings: Mapping[str, Any], precision: str
    ) -> tuple[Tensor, Tensor | None, str]:
        points = x.numpy().astype(precision)  # a copy: what a function does to its points is its own affair
        if self.vectorized:
            result = call.fn(points, **settings)
        else:
            result = _columns([_copied(call.fn(point, **settings)) for point in points])
        if isinstance(result, tuple) and len(result) != 2:
            raise SimulatorError(
                f"{call.name} must return losses, or (losses, gradients); got {len(result)} values, so drop the others"
            )
        loss, gradient = result if isinstance(result, tuple) else (result, None)
        kind = str(np.asarray(loss).dtype)
        losses = _numbers(loss, f"the loss of {call.name}")
        check_shape(tuple(losses.shape), (len(x),), "losses", call.name)
        if gradient is None:
            return losses, None, kind
        slope = _numbers(gradient, f"the gradient of {call.name}")
        check_shape(tuple(slope.shape), tuple(x.shape), "gradients", call.name)
        return losses, slope, kind

    def _differences(
        self, losses: Callable[[Tensor], Tensor], x: Float[Tensor, "batch dim"], call: Function
    ) -> Float[Tensor, "batch dim"]:
        """Return central differences, one-sided at the bounds; steps are fractions of the scaled box."""
        if self.differences is None:
            raise SimulatorError(
                f"{call.name} returned losses without gradients; return (losses, gradients), pass differences=1e-4 "
                "to from_numpy, or sample with gradients=0 (--no-gradients)"
            )
        space = call.space
        lower, upper = space.to_values(space.lower), space.to_values(space.upper)
        slopes, scaled = [], space.from_values(x)
        for axis in range(space.dim):
            step = torch.zeros_like(space.lower)
            step[axis] = self.differences * (space.upper - space.lower)[axis]
            ahead = torch.minimum(space.to_values(scaled + step), upper)
            behind = torch.maximum(space.to_values(scaled - step), lower)
            apart = (ahead - behind)[:, axis]
            slopes.append((losses(ahead) - losses(behind)) / apart)
        return torch.stack(slopes, dim=1)


def _numbers(values: object, what: str) -> Tensor:
    """Return a copy of a function's numbers as a tensor. Raises SimulatorError for what is none."""
    try:
        return as_tensor(values, what).clone()
    except ValueError as error:
        raise SimulatorError(str(error)) from None


def _copied(result: Any) -> Any:
    """Return a copy of what a function returned: one that returns its own buffer fills it again at the next point."""
    return tuple(map(_copied, result)) if isinstance(result, tuple) else np.array(result, subok=True)  # masks stay


def _columns(found: Sequence[Any]) -> Any:
    """Return results of single points as columns; what is none is returned for the caller to refuse."""
    if found and isinstance(found[0], tuple):
        return tuple(list(column) for column in zip(*found, strict=True))
    return list(found)


def _step(differences: object, space: ParameterSpace) -> float:
    """Return a step, a fraction of the bounds, that is no larger than they are and not lost in rounding."""
    fraction = float(as_tensor(differences, "from_numpy's differences"))
    if not MIN_STEP <= fraction <= 1:
        raise ValueError(
            f"from_numpy takes differences from {MIN_STEP:g} to 1, a fraction of the bounds; got {fraction}"
        )
    farthest = torch.maximum(space.lower.abs(), space.upper.abs())
    lost = (farthest + fraction * (space.upper - space.lower) == farthest).tolist()
    if any(lost):
        name = space.names[lost.index(True)]
        raise ValueError(
            f"from_numpy's differences of {fraction:g} are lost in rounding relative to the bounds of {name}"
        )
    return fraction


class GivenEnvironment(Environment):
    """An object of one's own with `space` and `evaluate` as an environment.

    The model is the object's own, and so are its parameters and its loss.
    """

    model_version = 0  # nothing says when an object changes; stored results are compared with it by evaluating it
    engines = ("object",)

    def __init__(self, given: Any, /, **settings: Any) -> None:
        self.given, self.space = given, given.space
        self.name = str(getattr(given, "name", type(given).__name__))
        for name in ("loss_unit", "beyond_box", "decisions", "whole_batches"):
            vars(self)[name] = getattr(given, name, getattr(type(self), name))
        super().__init__(**settings)

    @classmethod
    def of(cls, given: Any) -> GivenEnvironment:
        """Return an object as an environment. Raises ValueError that says what it lacks."""
        wanted = {"space": isinstance(getattr(given, "space", None), ParameterSpace)}
        wanted["evaluate"] = callable(getattr(given, "evaluate", None))
        if lacking := [name for name, there in wanted.items() if not there]:
            raise ValueError(
                f"{type(given).__name__} is no simulator: it has no {' and no '.join(lacking)}. An object needs a "
                "ParameterSpace as `space` and a method evaluate(x, *, grad=True) that returns an Evaluation; a "
                "function becomes an environment by gs.from_torch, from_jax, from_numpy or from_warp"
            )
        return cls(given)

    @property
    def preferred_batch(self) -> int:  # type: ignore[override] # read only
        """Number of points worth evaluating at once."""
        return min(int(getattr(self.given, "preferred_batch", super().preferred_batch)), self._max_rows)

    def events(self, x: Float[Tensor, "batch dim"]) -> Mapping[str, Any]:
        """Count what happens at each point, where the object says that."""
        counts: Callable[[Tensor], Mapping[str, Any]] | None = getattr(self.given, "events", None)
        return {} if counts is None else counts(x)

    def _remake(self, **settings: Any) -> Environment:
        return GivenEnvironment(self.given, **settings)

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        found: Evaluation = self.given.evaluate(x, grad=grad)
        return found
