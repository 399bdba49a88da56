"""User functions as environments, and their libraries: torch and NumPy here, JAX and Warp among the engines."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Unpack, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.objective import Evaluation, SimulatorError, Status, first_line
from ..landscapes.space import ParameterSpace, as_tensor, as_whole
from .base import Environment, check_shape
from .origins import torch_origin
from .user_functions import Backend, Compute, Function, FunctionKeywords

if TYPE_CHECKING:
    from numpy.typing import NDArray


class FunctionEnvironment(Environment):
    """A function of points, in one of the libraries, as an environment.

    The function is the model. Its user describes parameters and loss.
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
            own_programs=function.backend.own_programs,
        )
        self.beyond_box = bool(function.space.arrays)  # weights mean something beyond their bounds, too
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

    def with_horizon(self, horizon: float) -> Environment:
        """Return this environment with episodes of another length, rounded where the keyword is a whole number.

        Raises ValueError where no keyword sets the length of an episode.
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
        """Return a number proportional to the simulated time of an episode: 1 where no keyword sets its length."""
        if not self.function.counts_steps:
            return 1.0
        steps: float = self._settings[self.horizon_option]
        return steps * self.fidelity.dt

    def about(self) -> str:  # type: ignore[override] # a function's documentation is its own, not the class's
        """Return the function's own description."""
        return inspect.getdoc(self.function.fn) or f"The function {self.name}, which has no docstring."

    def noise(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"] | None:
        """Return the standard error of the mean over seeds at each point [loss unit]; None for one seed."""
        if self.function.seeds < 2:
            return None
        values = self.space.to_values(self._check_points(x))
        losses = torch.stack([self._compute(seed)(values, False)[0].double() for seed in self._seeds])
        error: Tensor = losses.std(dim=0) / len(losses) ** 0.5
        return error

    def nan_origin(self, x: Float[Tensor, " dim"]) -> str:
        """Return the operation that makes the gradient at a point not finite, although the loss is; "" where none does.

        The text ends a sentence, such as `sqrt in line 12 of my.py ("jnp.sqrt(p[0])")`.
        """
        found = self.evaluate(x[None])
        if int(found.status[0]) != Status.NO_GRADIENT:
            return ""
        return self._first_said("nan_origin", x)

    def wrong_origin(self, x: Float[Tensor, " dim"]) -> str:
        """Return the operation whose own derivative is wrong at a point, where it is finite; "" where none is known.

        The text ends a sentence, such as `kernel step in line 12 of my.py`.
        """
        return self._first_said("wrong_origin", x)

    def _first_said(self, asked: Literal["nan_origin", "wrong_origin"], x: Float[Tensor, " dim"]) -> str:
        """Return the library's finding on the function at a point, for the first seed with a finding."""
        values = self.space.to_values(self._check_points(x[None]))
        with torch.inference_mode(False), torch.enable_grad(), suppress(Exception):  # it is no more than a hint
            return next(filter(None, (getattr(self._compute(seed), asked)(values) for seed in self._seeds)), "")
        return ""

    def replicas(self) -> Mapping[str, Environment]:
        """Return the functions that compute the same physics differently, with the settings of this one."""
        given = self.function.replicas or {}
        return {changed: self._with_function(self.function.with_call(fn)) for changed, fn in given.items()}

    def _with_function(self, function: Function) -> FunctionEnvironment:
        """Return the environment of another function, without the options that are bound in it."""
        known = {one.name for one in fields(function.options_class)}
        options = {name: value for name, value in asdict(self.options).items() if name in known}
        return FunctionEnvironment(function, fidelity=self.fidelity, device=self.device, **options)

    def named(self, name: str) -> FunctionEnvironment:
        """Return the same environment by another name."""
        return self._with_function(replace(self.function, name=name))

    def _remake(self, **settings: Any) -> Environment:
        return FunctionEnvironment(self.function, **settings)

    def _setup(self) -> None:
        self._settings = self.function.settings_of(self.options, self.fidelity)
        self._computes: dict[int, Compute] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out compiled code and the class of the options: another process makes both again."""
        left = {"_computes": {}, "Options": None, "options": asdict(self.options)}
        return {**super().__getstate__(), **left}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state that another process sent."""
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
            function = self.function
            settings = {**self._settings, **({function.seed_argument: seed} if function.seed_argument else {})}
            self._computes[seed] = function.backend.bind(function, settings, self.fidelity.precision, self.device)
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
        """Return the settings that decide the numbers, as plain JSON."""
        own: dict[str, Any] = {"maximize": True} if self.function.maximize else {}
        return super().identity() | own | ({"seeds": self.function.seeds} if self.function.seeds > 1 else {})


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

    Gradients come by autograd. Each loss may depend only on its own row. With `vectorized=False` the function takes a
    single point, shape (dim,), and returns one loss. Points lie on `device`, cpu or cuda. The other keywords are those
    of `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows, replicas.

    Raises ValueError for settings that the function does not take. Evaluating raises it where the function does not
    return one loss per row, or its losses have no gradient.
    """
    return _wrap(fn, space, Backend("torch", partial(_Torch, vectorized), torch.cuda.is_available, device), said)


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
    `differences` makes gradients by central differences with that step, a fraction of each parameter's range. At the
    bounds they are one-sided, because the function is not evaluated outside them. With `vectorized=False` the function
    takes a single point, shape (dim,), and returns one loss, or one loss and its gradient. The other keywords are those
    of `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows, replicas.

    Raises ValueError where `differences` is no fraction of the bounds, or lost in rounding relative to them.
    """
    step = None if differences is None else _step(differences, space)
    return _wrap(fn, space, Backend("numpy", partial(_NumPy, vectorized, step), device="cpu", devices=("cpu",)), said)


def from_jax(
    fn: Callable[..., Any],
    space: ParameterSpace,
    *,
    mode: Mode = "reverse",
    batch: Batch = "vmap",
    **said: Unpack[FunctionKeywords],
) -> Environment:
    """Make an environment of a JAX function from one point, an array of shape (dim,), to its loss, of shape ().

    Gradients come by reverse or forward differentiation. Loops of unknown length need forward, and it is faster for few
    parameters. `batch` says how points are computed together. `vmap` vectorizes the function. `map` calls it point by
    point, for functions without a batching rule and for large simulations. Batches smaller than `rows` are padded to
    the next power of four, because each size needs its own compilation. The function runs in its own precision,
    whatever JAX is configured to. Settings are static, so each needs its own compilation, too. The other keywords are
    those of `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows,
    replicas.

    Raises ValueError where JAX is not installed, and for other modes and batches. Evaluating raises it where the
    function does not return a single number, or JAX cannot trace, differentiate or vectorize it.
    """
    for option, value, known in (("mode", mode, Mode), ("batch", batch, Batch)):
        if value not in get_args(known):
            raise ValueError(f"from_jax takes {option} {' or '.join(get_args(known))}; got {value!r}")
    try:
        from .engines.jax_functions import JaxCompute, has_cuda
    except ImportError as error:
        raise ValueError(f"from_jax needs JAX, which is not installed ({error}): pip install jax") from error
    return _wrap(fn, space, Backend("jax", partial(JaxCompute, mode, batch), has_cuda, own_programs=True), said)


def from_warp(
    fn: Callable[..., Any],
    space: ParameterSpace,
    *,
    device: str = "auto",
    check_overwrites: bool = True,
    **said: Unpack[FunctionKeywords],
) -> Environment:
    """Make an environment of a function that launches Warp kernels, from points to losses.

    The function takes a Warp array of points, shape (batch, dim), and returns one of losses, shape (batch,), both in
    its `precision`, by default float32. Each loss may depend on its own row only. Its launches are recorded on a tape,
    which is played backwards for the gradients. The gradients of arrays that the function keeps are set to zero after
    each evaluation. The losses are made with requires_grad=True.

    A kernel that overwrites an array that an earlier kernel has read makes gradients silently wrong. `check_overwrites`
    looks for such kernels once, before the first gradient. It compiles the function's kernels again for that, which can
    take long; switch it off for a simulator that is known to be right. The other keywords are those of
    `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows, replicas.

    Raises ValueError for other precisions and devices. Evaluating raises it where the function returns no such array,
    launches nothing, does not read its points, or overwrites arrays that were read.
    """
    from .engines.warp_functions import WarpCompute, cuda_available

    backend = Backend("warp", partial(WarpCompute, check_overwrites), cuda_available, device)
    return _wrap(fn, space, backend, {"precision": "float32", **said})


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

    A point consists of the actions in order; each lasts an equal share of the `steps` of an episode. An episode starts
    with reset(seed=0), the same at every point, and ends early where `step` returns terminated or truncated.
    `step(action)` returns (observation, reward, terminated, truncated, info). Gradients come by central `differences`,
    as for `from_numpy`.

        gs.from_step(env.step, env.reset, gs.ParameterSpace.box([f"push {k}" for k in range(5)], -1, 1), steps=100)

    Raises ValueError where the number of parameters is not a multiple of the size of an action.
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
    """Return the size of an action: that of the simulator's action space, where `step` is its method."""
    simulator = getattr(step, "__self__", None)
    shape = getattr(getattr(simulator, "action_space", None), "shape", None) or ()
    size = int(np.prod(shape))
    if space.dim % size:
        raise ValueError(f"an action has {size} numbers, so {space.dim} parameters are not a whole number of actions")
    return size


def _wrap(fn: Callable[..., Any], space: ParameterSpace, backend: Backend, said: FunctionKeywords) -> Environment:
    if unknown := said.keys() - FunctionKeywords.__annotations__.keys():
        raise TypeError(f"from_{backend.engine} takes no keyword {', '.join(sorted(unknown))}")
    return FunctionEnvironment(Function(fn, space, backend, **said))


@dataclass(frozen=True, eq=False)
class _Torch(Compute):
    vectorized: bool
    call: Function
    settings: Mapping[str, Any]
    precision: str
    device: str

    def __call__(self, x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None, str]:
        points = x.to(self.device, getattr(torch, self.precision), copy=True).requires_grad_(grad)
        loss = self._losses(points)
        losses = _numbers(loss, f"the loss of {self.call.name}")
        slope = _autograd(loss, points, self.call.name) if grad else None
        return losses, slope, str(loss.dtype).removeprefix("torch.")

    def nan_origin(self, x: Float[Tensor, "one dim"]) -> str:
        return torch_origin(self._losses, x.to(self.device, getattr(torch, self.precision)))

    def _losses(self, x: Float[Tensor, "batch dim"]) -> Tensor:
        if self.vectorized:
            found = _called(self.call, x, self.settings)
        else:
            parts = [_called(self.call, point, self.settings) for point in x]
            found = torch.stack(parts) if all(isinstance(one, Tensor) for one in parts) else parts[0]
        if isinstance(found, tuple):
            raise SimulatorError(
                f"{self.call.name} must return losses only, because torch differentiates them; got {len(found)} "
                "values (from_numpy takes losses with gradients)"
            )
        if not isinstance(found, Tensor):
            raise SimulatorError(f"{self.call.name} must return a tensor; got {type(found).__name__}")
        check_shape(tuple(found.shape), (len(x),), "losses", self.call.name)
        return found


def _called(call: Function, x: Tensor, settings: Mapping[str, Any]) -> Any:
    """Return the result of a function; name the precision it needs where torch refuses to mix two."""
    try:
        return call.fn(x, **settings)
    except RuntimeError as error:
        if "dtype" in str(error) and {"Float", "Double"} <= set(re.findall(r"\w+", str(error))):
            other = "float32" if x.dtype == torch.float64 else "float64"
            raise SimulatorError(
                f"{call.name} mixes its points with numbers of another type ({first_line(error)}); pass "
                f"precision={other!r} to from_torch, or convert your tensors with .to(x)"
            ) from error
        raise


def _autograd(loss: Float[Tensor, " batch"], x: Float[Tensor, "batch dim"], name: str) -> Tensor:
    (gradient,) = torch.autograd.grad(loss.sum(), x, allow_unused=True) if loss.requires_grad else (None,)
    if gradient is None:
        raise SimulatorError(
            f"{name} returned losses without a gradient; compute them from x with torch operations, or sample with "
            "gradients=0 (--no-gradients)"
        )
    return gradient.detach().to("cpu", torch.float64)


@dataclass(frozen=True, eq=False)
class _NumPy(Compute):
    vectorized: bool
    differences: float | None
    call: Function
    settings: Mapping[str, Any]
    precision: str
    device: str

    def __call__(self, x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None, str]:
        loss, slope, kind = self._found(x)
        if grad and slope is None:
            slope = self._central_differences(x)
        return loss, slope if grad else None, kind

    def _found(self, x: Float[Tensor, "batch dim"]) -> tuple[Tensor, Tensor | None, str]:
        points, name = x.numpy().astype(self.precision), self.call.name  # a copy: a function may change its points
        if self.vectorized:
            result = self.call.fn(points, **self.settings)
        else:
            result = _columns([_copied(self.call.fn(point, **self.settings)) for point in points])
        if isinstance(result, tuple) and len(result) != 2:
            raise SimulatorError(
                f"{name} must return losses, or (losses, gradients); got {len(result)} values, so drop the rest"
            )
        loss, gradient = result if isinstance(result, tuple) else (result, None)
        kind = str(np.asarray(loss).dtype)
        losses = _numbers(loss, f"the loss of {name}")
        check_shape(tuple(losses.shape), (len(x),), "losses", name)
        if gradient is None:
            return losses, None, kind
        slope = _numbers(gradient, f"the gradient of {name}")
        check_shape(tuple(slope.shape), tuple(x.shape), "gradients", name)
        return losses, slope, kind

    def _central_differences(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
        """Return central differences, one-sided at the bounds; steps are fractions of the scaled box."""
        if self.differences is None:
            raise SimulatorError(
                f"{self.call.name} returned losses without gradients; return (losses, gradients), pass "
                "differences=1e-4 to from_numpy, or sample with gradients=0 (--no-gradients)"
            )
        space = self.call.space
        lower, upper = space.to_values(space.lower), space.to_values(space.upper)
        slopes, scaled = [], space.from_values(x)
        for axis in range(space.dim):
            step = torch.zeros_like(space.lower)
            step[axis] = self.differences * (space.upper - space.lower)[axis]
            ahead = torch.minimum(space.to_values(scaled + step), upper)
            behind = torch.maximum(space.to_values(scaled - step), lower)
            apart = (ahead - behind)[:, axis]
            slopes.append((self._found(ahead)[0] - self._found(behind)[0]) / apart)
        return torch.stack(slopes, dim=1)


def _numbers(values: object, what: str) -> Tensor:
    """Return a copy of a function's numbers as a tensor. Raises SimulatorError for anything else."""
    try:
        return as_tensor(values, what).clone()
    except ValueError as error:
        raise SimulatorError(str(error)) from None


def _copied(result: Any) -> Any:
    """Return a copy of a function's result, because a function may reuse its own buffer at the next point."""
    return tuple(map(_copied, result)) if isinstance(result, tuple) else np.array(result, subok=True)  # masks stay


def _columns(found: Sequence[Any]) -> Any:
    """Return results of single points as columns; return anything else unchanged for the caller to refuse."""
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
    """A user's object with `space` and `evaluate` as an environment.

    The object defines the model, its parameters and its loss.
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
        """Return an object as an environment. Raises ValueError that names what it lacks."""
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
        """Count the events at each point, where the object counts them."""
        counts: Callable[[Tensor], Mapping[str, Any]] | None = getattr(self.given, "events", None)
        return {} if counts is None else counts(x)

    def replicas(self) -> Mapping[str, Environment]:
        """Return environments that compute the same physics differently, where the object has them."""
        offered: Callable[[], Mapping[str, Any]] | None = getattr(self.given, "replicas", None)
        found = {} if offered is None else offered()
        return {name: one if isinstance(one, Environment) else GivenEnvironment.of(one) for name, one in found.items()}

    def _remake(self, **settings: Any) -> Environment:
        return GivenEnvironment(self.given, **settings)

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        found: Evaluation = self.given.evaluate(x, grad=grad)
        return found
