"""The user's description of a function, and how a library calls and differentiates the function."""

from __future__ import annotations

import abc
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, make_dataclass, replace
from functools import cached_property, partial
from typing import Any, TypedDict

from jaxtyping import Float
from torch import Tensor

from ..landscapes.identity import UNNAMED
from ..landscapes.space import ParameterSpace, as_whole
from .records import Fidelity

NAMELESS = "function"  # what a lambda is called
SAME_TIME = 0.01  # relative difference of what counts as the same time
SEED_ARGUMENTS = ("key", "seed")  # of a function that draws random numbers
FIDELITY_FIELDS = ("dt", "resolution", "sampling", "particles")  # that a function and a `Fidelity` call the same
KINDS = (bool, int, float, str)  # of options


class FunctionKeywords(TypedDict, total=False):
    """The keywords that every `from_...` takes.

    `name` of the function, by default its own, and `loss_unit`, the unit of its result. `maximize` searches for its
    largest value: losses are the negative of its result.

    Keyword arguments of the function are its settings. `options` are the settings that a user changes, with their
    defaults. By default they are all arguments whose default is a number, a text or a truth value. `fidelities` names
    the settings that decide the accuracy, from the cheapest to the most accurate: {"draft": {"dt": 0.02}, "reference":
    {"dt": 0.001}}. `horizon` names the keyword for the length of an episode. Settings that depend on each other, such
    as the number of steps and the time step, belong together in the fidelities.

    A function that takes a `key` (of JAX) or a `seed` gets the same one at every point: common random numbers. The loss
    is the mean over `seeds` of them, which also gives its standard error.

    `precision`, float64 or float32, is that of the points the function receives, at most `rows` of them in one call.
    `replicas` maps a description of a change to a function of the same kind that computes the same physics differently:
    `{"shifted grid": partial(fn, shift=0.5)}`. The differences between them are the numerical floor.
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
    replicas: Mapping[str, Callable[..., Any]] | None


class Compute(abc.ABC):
    """A function with bound keyword arguments in a library, at a precision and on a device, differentiated by it."""

    @abc.abstractmethod
    def __call__(self, x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None, str]:
        """Return losses, gradients if requested, and the number type of the losses, at points."""

    def nan_origin(self, x: Float[Tensor, "one dim"]) -> str:
        """Return the operation that makes the gradient at a point not finite, and its call site; "" where unknown."""
        return ""

    def wrong_origin(self, x: Float[Tensor, "one dim"]) -> str:
        """Return the operation whose own derivative is wrong at a point, where it is finite; "" where unknown."""
        return ""


@dataclass(frozen=True)
class Backend:
    """A library in which a function is written.

    `bind` makes a `Compute` from a function with keyword arguments, a precision and a device. `device` is the default
    device: auto, cpu or cuda. With `own_programs`, each size of batch is compiled.
    """

    engine: str
    bind: Callable[[Function, Mapping[str, Any], str, str], Compute]
    has_cuda: Callable[[], bool] = bool
    device: str = "auto"
    devices: tuple[str, ...] = ("cpu", "cuda")
    own_programs: bool = False


@dataclass(eq=False)
class Function:
    """A function of points with its user's description, as in `FunctionKeywords`.

    Raises ValueError for settings that contradict each other.
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
    replicas: Mapping[str, Callable[..., Any]] | None = None

    def __post_init__(self) -> None:
        fn, who = self.fn, f"from_{self.backend.engine}"
        if not callable(fn):
            raise ValueError(f"expected a function; got {type(fn).__name__} {fn!r}")
        if not isinstance(self.space, ParameterSpace):
            raise ValueError(
                f"expected a ParameterSpace such as gs.ParameterSpace({{'x': (-1, 1)}}); got {self.space!r}"
            )
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
            raise ValueError(f"seeds={self.seeds} averages over random numbers, but {self.name} takes no {seeded}")
        self.defaults = chosen | ({"seed": 0} if self.seed_argument else {})
        self.known_fidelities = _read_fidelities(self.name, given, _check_precision(self.precision, who))
        self.fidelity_arguments = tuple(own)
        for changed, replica in (self.replicas or {}).items():
            if not callable(replica):
                raise ValueError(f"{self.name}'s replica {changed!r} must be a function; got {type(replica).__name__}")

    def with_call(self, fn: Callable[..., Any]) -> Function:
        """Return another function with the description of this one, except its replicas."""
        bound = fn.keywords if isinstance(fn, partial) else {}

        def free(settings: Mapping[str, Any]) -> dict[str, Any]:
            return {name: value for name, value in settings.items() if name not in bound}

        options = None if self.options is None else free(self.options)
        fidelities = {name: free(settings) for name, settings in (self.fidelities or {}).items()}
        return replace(self, fn=fn, options=options, fidelities=fidelities or None, replicas=None)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the parts that another process makes again."""
        return {name: value for name, value in vars(self).items() if name != "options_class"}

    @cached_property
    def options_class(self) -> type[Any]:
        """The dataclass of the options, each with the type of its default."""
        declared = [(name, type(value), field(default=value)) for name, value in self.defaults.items()]
        return make_dataclass("Options", declared, frozen=True)

    @cached_property
    def counts_steps(self) -> bool:
        """Whether the horizon counts time steps; times dt, it is then the same time in every fidelity."""
        if not {self.horizon, "dt"} <= set(self.fidelity_arguments):
            return False
        steps: list[Any] = [one.settings.get(self.horizon or "") for one in self.known_fidelities.values()]
        if not all(isinstance(count, int) for count in steps):
            return False
        times = [count * one.dt for count, one in zip(steps, self.known_fidelities.values(), strict=True)]
        return bool(max(times) - min(times) <= SAME_TIME * max(times))

    def settings_of(self, options: Any, fidelity: Fidelity) -> dict[str, Any]:
        """Return the function's keyword arguments, except its random numbers, with these options at a fidelity."""
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


def function_name(fn: Callable[..., object]) -> str:
    """Return the name of a function, or of its type where it has none."""
    name = str(getattr(fn, "__name__", type(fn).__name__))
    return NAMELESS if name == "<lambda>" else name


def _arguments(fn: Callable[..., Any]) -> dict[str, Any]:
    """Return the keyword arguments of a function with their defaults, or `inspect.Parameter.empty`."""
    try:
        found = list(inspect.signature(fn).parameters.values())
    except (TypeError, ValueError):  # of a function in C
        return {}
    return {one.name: one.default for one in found[1:] if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)}


def _default_options(known: Mapping[str, Any], taken: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keyword arguments whose default is a number, a text or a truth value, except those `taken`."""
    free = {name: value for name, value in known.items() if name not in (*taken, *SEED_ARGUMENTS)}
    return {name: value for name, value in free.items() if isinstance(value, KINDS)}


def _check_arguments(
    name: str, known: Mapping[str, Any], options: Mapping[str, Any], own: Mapping[str, Any], horizon: str | None
) -> None:
    """Raise ValueError for settings that are no keyword arguments of the function, or that are given twice."""
    for option, value in options.items():
        if not isinstance(value, KINDS):
            raise ValueError(
                f"{name}'s option {option} needs a number, a text or a truth value as its default; got {value!r}"
            )
    if twice := options.keys() & own.keys():
        raise ValueError(
            f"{name} has {', '.join(sorted(twice))} in both options and fidelities; keep it in one of them"
        )
    if horizon and horizon not in options.keys() | own.keys():
        raise ValueError(f"{name}'s horizon must be one of its options or fidelity settings; got {horizon!r}")
    strange = [one for one in (*options, *own) if known and one not in known]
    if strange:
        takes = ", ".join(known) or "none"
        raise ValueError(f"{name} takes no keyword argument {', '.join(strange)}; it takes {takes}")


def _read_fidelities(name: str, given: Mapping[str, Mapping[str, Any]], precision: str) -> dict[str, Fidelity]:
    """Return fidelities by name, from the settings that a user gave for each."""
    found = {}
    names = {argument for settings in given.values() for argument in settings}
    for fidelity, settings in (given or {UNNAMED: {}}).items():
        if lacking := names - settings.keys() - {"precision"}:
            raise ValueError(
                f"{name}'s fidelity {fidelity} lacks {', '.join(sorted(lacking))}, which other fidelities have"
            )
        own = {key: value for key, value in settings.items() if key in FIDELITY_FIELDS}
        other = {key: value for key, value in settings.items() if key not in (*FIDELITY_FIELDS, "precision")}
        computed = _check_precision(settings.get("precision", precision), name)
        found[fidelity] = Fidelity(fidelity, **{"dt": 0.0, **own}, precision=computed, settings=other)
    return found


def _check_precision(precision: Any, who: str) -> str:
    if precision not in ("float64", "float32"):
        raise ValueError(f"{who} takes precision float64 or float32; got {precision!r}")
    return str(precision)
