"""Functions of torch, NumPy, JAX and Warp, simulators with reset and step, and objects of one's own as environments."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Unpack, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.objective import Evaluation, SimulatorError, first_line
from ..landscapes.space import ParameterSpace, as_tensor, as_whole
from .base import Environment
from .function import Compute, Function, FunctionEnvironment, FunctionKeywords, check_shape

if TYPE_CHECKING:
    from numpy.typing import NDArray

LEAST_STEP = 1e-12  # of differences: losses are rounded to 1e-16 of themselves, and their difference is divided by it
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
    return FunctionEnvironment(Function.of(fn, space, _Torch(vectorized, device), said))


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

    Raises ValueError where `differences` is no fraction of the bounds, or lost in rounding beside them.
    """
    step = None if differences is None else _step(differences, space)
    return FunctionEnvironment(Function.of(fn, space, _NumPy(vectorized, step), said))


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
    backend = JaxBackend(mode, batch)
    return FunctionEnvironment(Function.of(fn, space, backend, said))


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
    `check_overwrites` looks for that once, before the first gradient, and builds the function's kernels anew for it,
    which may take long; leave it out for a simulator that is known to be right. The other keywords are those of
    `FunctionKeywords`: name, loss_unit, maximize, options, fidelities, horizon, seeds, precision, rows.

    Raises ValueError for other precisions and devices; evaluating raises it where the function returns no such array,
    launches nothing, does not read its points, or writes to what was read.
    """
    from .engines.warp_functions import WarpBackend

    backend = WarpBackend(device, check_overwrites)
    return FunctionEnvironment(Function.of(fn, space, backend, {"precision": "float32", **said}))


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


@dataclass(frozen=True)
class _Torch:
    """Call functions of torch."""

    vectorized: bool
    device: str
    engine: str = "torch"
    devices: tuple[str, ...] = ("cpu", "cuda")

    def find_device(self, device: str) -> str:
        """Return the device of points, which auto leaves to `from_torch`. Raises ValueError where it is not there."""
        found = self.device if device == "auto" else device
        if found not in self.devices or (found == "cuda" and not torch.cuda.is_available()):
            raise ValueError(f"from_torch runs on cpu, and on cuda where torch finds a device; got device {found!r}")
        return found

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
    engine: str = "numpy"
    devices: tuple[str, ...] = ("cpu",)

    def find_device(self, device: str) -> str:
        """Return the CPU. Raises ValueError for another device."""
        if device not in ("auto", "cpu"):
            raise ValueError(f"from_numpy runs on cpu; got device {device!r}")
        return "cpu"

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
    """Return a copy of what a function returned: one that returns its own buffer fills it anew at the next point."""
    return tuple(map(_copied, result)) if isinstance(result, tuple) else np.array(result, subok=True)  # masks stay


def _columns(found: Sequence[Any]) -> Any:
    """Return results of single points as columns; what is none is returned for the caller to refuse."""
    if found and isinstance(found[0], tuple):
        return tuple(list(column) for column in zip(*found, strict=True))
    return list(found)


def _step(differences: object, space: ParameterSpace) -> float:
    """Return a step, a fraction of the bounds, that is no larger than they are and not lost in rounding."""
    fraction = float(as_tensor(differences, "from_numpy's differences"))
    if not LEAST_STEP <= fraction <= 1:
        raise ValueError(
            f"from_numpy takes differences from {LEAST_STEP:g} to 1, a fraction of the bounds; got {fraction}"
        )
    farthest = torch.maximum(space.lower.abs(), space.upper.abs())
    lost = (farthest + fraction * (space.upper - space.lower) == farthest).tolist()
    if any(lost):
        name = space.names[lost.index(True)]
        raise ValueError(f"from_numpy's differences of {fraction:g} are lost in rounding beside the bounds of {name}")
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
