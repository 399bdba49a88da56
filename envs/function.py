"""Functions of others as environments: what a user says of a function, and the environment that calls it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from functools import cached_property, partial
from typing import Any, Protocol, TypedDict

import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.identity import UNNAMED
from ..landscapes.objective import Evaluation, SimulatorError
from ..landscapes.space import ParameterSpace, as_whole
from .base import Environment, Fidelity

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

    name: str | None
    loss_unit: str
    maximize: bool
    options: Mapping[str, Any] | None
    fidelities: Mapping[str, Mapping[str, Any]] | None
    horizon: str | None
    seeds: int
    precision: str
    rows: int


DEFAULTS: FunctionKeywords = {
    "name": None, "loss_unit": "", "maximize": False, "options": None, "fidelities": None, "horizon": None,
    "seeds": 1, "precision": "float64", "rows": 256,
}  # fmt: skip

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

    def find_device(self, device: str) -> str:
        """Return the device that auto stands for, or the one named. Raises ValueError where it is not there."""

    def bind(self, call: Function, settings: Mapping[str, Any], precision: str, device: str) -> Compute:
        """Return what computes the function with these keyword arguments."""


@dataclass(frozen=True, eq=False)
class Function:
    """A function of points with what its user says of it."""

    fn: Callable[..., Any]
    space: ParameterSpace
    backend: Backend
    name: str
    loss_unit: str = ""
    maximize: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    fidelities: Mapping[str, Fidelity] = field(default_factory=dict)
    fidelity_arguments: tuple[str, ...] = ()
    horizon: str = ""
    seed_argument: str = ""
    seeds: int = 1
    rows: int = DEFAULTS["rows"]

    @classmethod
    def of(cls, fn: Callable[..., Any], space: ParameterSpace, backend: Backend, said: FunctionKeywords) -> Function:
        """Read what a user says of a function. Raises ValueError for what does not go together."""
        if not callable(fn):
            raise ValueError(f"a function is wanted; got {type(fn).__name__} {fn!r}")
        if not isinstance(space, ParameterSpace):
            raise ValueError(f"a ParameterSpace is wanted, as gs.ParameterSpace({{'x': (-1, 1)}}); got {space!r}")
        if unknown := said.keys() - FunctionKeywords.__annotations__.keys():
            raise TypeError(f"from_{backend.engine} takes no keyword {', '.join(sorted(unknown))}")
        who, said = f"from_{backend.engine}", {**DEFAULTS, **said}
        name, known = said["name"] or function_name(fn), _arguments(fn)
        given = {key: dict(value) for key, value in (said["fidelities"] or {}).items()}
        own = {argument: None for settings in given.values() for argument in settings if argument != "precision"}
        options = said["options"]
        bound = fn.keywords if isinstance(fn, partial) else {}  # by the user: no setting any more
        found = _default_options(known, {**own, **bound}) if options is None else dict(options)
        _check_arguments(name, known, found, own, said["horizon"])
        precision = _check_precision(said["precision"], who)
        seeds = as_whole(said["seeds"], f"{who}'s seeds", least=1)
        rows = as_whole(said["rows"], f"{who}'s rows", least=1)
        seed_argument = next((one for one in SEED_ARGUMENTS if one in known and one not in own | found), "")
        if seeds > 1 and not seed_argument:
            raise ValueError(
                f"seeds={seeds} averages over random numbers, and {name} takes no {' or '.join(SEED_ARGUMENTS)}"
            )
        if seed_argument:
            found["seed"] = 0
        return cls(
            fn, space, backend, name, said["loss_unit"], said["maximize"], found,
            _read_fidelities(name, given, precision), tuple(own), said["horizon"] or "", seed_argument, seeds, rows,
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what another process makes again."""
        return {name: value for name, value in vars(self).items() if name != "options_class"}

    @cached_property
    def options_class(self) -> type[Any]:
        """The dataclass of the options, each of the type of its default."""
        declared = [(name, type(value), field(default=value)) for name, value in self.options.items()]
        return make_dataclass("Options", declared, frozen=True)

    @cached_property
    def counts_steps(self) -> bool:
        """Whether the horizon counts time steps: times dt, it is the same time in every fidelity."""
        if not {self.horizon, "dt"} <= set(self.fidelity_arguments):
            return False
        steps: list[Any] = [one.settings.get(self.horizon) for one in self.fidelities.values()]
        if not all(isinstance(count, int) for count in steps):
            return False
        times = [count * one.dt for count, one in zip(steps, self.fidelities.values(), strict=True)]
        return bool(max(times) - min(times) <= SAME_TIME * max(times))

    def settings_of(self, options: Any, fidelity: Fidelity) -> dict[str, Any]:
        """Return the function's keyword arguments, but for its random numbers, with these options at a fidelity."""
        found = {one.name: getattr(options, one.name) for one in fields(options)}
        if self.seed_argument:
            found.pop("seed")
        for argument in self.fidelity_arguments:
            known = argument in FIDELITY_FIELDS
            found[argument] = getattr(fidelity, argument) if known else fidelity.settings.get(argument)
        of = next((one for one in self.fidelities.values() if one.settings == fidelity.settings), fidelity)
        if self.counts_steps and of.dt != fidelity.dt:  # a variant of a fidelity, of the same time
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
            fidelities=function.fidelities,
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
        return self.function.backend.find_device(device)

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


def check_shape(got: tuple[int, ...], wanted: tuple[int, ...], what: str, name: str) -> None:
    """Raise SimulatorError where what a function returned has another shape than it must have."""
    if got == wanted:
        return
    advice = "a function of one point: vectorized=False"
    if got == (*wanted, 1):
        advice = "squeeze the last axis: `.squeeze(-1)`"
    raise SimulatorError(f"{name} must return {what} of shape {wanted}; got shape {got} ({advice})")


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
