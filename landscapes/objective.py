"""Objectives, which are evaluated at a batch of points, and the records of their results."""

from __future__ import annotations

import abc
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .space import ParameterSpace, as_tensor

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

Codes = TypeVar("Codes", Tensor, "xr.DataArray", "NDArray[Any]", int)  # one Status, or many
ROUNDING = 1e-9  # of the box; points that are no farther beyond it are moved back


class Status(IntEnum):
    """Say how the evaluation of one point ended; a NaN result is not a missing one.

    INTERPOLATED is a point of a refined slice that was not evaluated, because its neighbours predict it: its loss is
    NaN. NO_GRADIENT has a finite loss, which is kept, but its gradient is not finite and is stored as NaN.
    """

    MISSING = 0
    OK = 1
    NONFINITE = 2
    ESCAPED = 3
    ERROR = 4
    INTERPOLATED = 5
    NO_GRADIENT = 6


NOT_EVALUATED = (Status.MISSING, Status.INTERPOLATED)
HAS_LOSS = (Status.OK, Status.NO_GRADIENT)
FAILED = (Status.NONFINITE, Status.ESCAPED, Status.ERROR)
LONGEST_ERROR = 200  # characters of a message that are shown


def has_loss(status: Codes) -> Codes:
    """Return which points have a finite loss; `status` is a tensor, an array or one Status."""
    return _is_any(status, HAS_LOSS)


def failed(status: Codes) -> Codes:
    """Return which points were evaluated and have no loss; `status` is a tensor, an array or one Status."""
    return _is_any(status, FAILED)


def _is_any(status: Codes, kinds: tuple[Status, ...]) -> Codes:
    found: Codes = status == kinds[0]
    for kind in kinds[1:]:
        found = found | (status == kind)
    return found


def describe_errors(count: int, first: str) -> str:
    """Return how many points raised, and the first message, in a line; empty where none did."""
    if not count:
        return ""
    said = " ".join(first.split())
    shown = said if len(said) <= LONGEST_ERROR else f"{said[:LONGEST_ERROR]}..."
    return f"{count} point{'s' if count > 1 else ''} raised" + (f": first {shown!r}" if shown else "")


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The result of evaluating a batch of points.

    `loss` [objective's unit], float64, shape (batch,). `grad` [loss unit / parameter unit], float64, shape (batch,
    dim), or None if it was not requested. `status`, int8, shape (batch,). Where the status is not OK, the gradient is
    NaN, and so is the loss unless the status is NO_GRADIENT. `error` is the message of the first point with status
    ERROR. Arrays become tensors. Raises ValueError for values that are not real numbers, or no Status.
    """

    loss: Float[Tensor, " batch"]
    grad: Float[Tensor, "batch dim"] | None
    status: Int[Tensor, " batch"]
    error: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "loss", _real(self.loss, "a loss"))
        object.__setattr__(self, "grad", None if self.grad is None else _real(self.grad, "a gradient"))
        object.__setattr__(self, "status", _check_codes(self.status))

    @property
    def has_loss(self) -> Bool[Tensor, " batch"]:
        """Which points have a finite loss."""
        return has_loss(self.status)

    @property
    def has_gradient(self) -> Bool[Tensor, " batch"]:
        """Which points have a finite gradient; none where gradients were not requested."""
        return (self.status == Status.OK) & (self.grad is not None)

    @property
    def failed(self) -> Bool[Tensor, " batch"]:
        """Which points have no loss."""
        return failed(self.status)

    @classmethod
    def from_results(
        cls,
        loss: Float[Tensor, " batch"],
        grad: Float[Tensor, "batch dim"] | None,
        failed: Int[Tensor, " batch"] | None = None,
        error: str = "",
    ) -> Evaluation:
        """Make an evaluation from raw results: mark non-finite rows, keep `failed`, blank missing values.

        `failed` has a Status per row, OK where no failure is known. A row with only a finite loss keeps it and has
        status NO_GRADIENT. Without gradients none is missing, and its status is OK. Raises ValueError where results are
        not real numbers, or codes in `failed` are no Status.
        """
        loss, grad = _real(loss, "a loss"), None if grad is None else _real(grad, "a gradient")
        status = torch.full(loss.shape, Status.OK, dtype=torch.int8)
        if failed is not None:
            status = _check_codes(failed).to(torch.int8).clone()
        there = has_loss(status)
        status[there & ~loss.isfinite()] = Status.NONFINITE
        loss = loss.masked_fill(~has_loss(status), torch.nan)
        if grad is None:
            status[status == Status.NO_GRADIENT] = Status.OK
            return cls(loss, None, status, error)
        status[(status == Status.OK) & ~grad.isfinite().all(dim=1)] = Status.NO_GRADIENT
        return cls(loss, grad.masked_fill((status != Status.OK)[:, None], torch.nan), status, error)

    judged = from_results  # its first name, which environments of others call it by

    @classmethod
    def join(cls, parts: Iterable[Evaluation], *, dim: int, grad: bool) -> Evaluation:
        """Return the evaluation of several batches, one after the other; of none, that of no points at all.

        Gradients are left out unless `grad` requests them. Raises ValueError where a part lacks requested gradients.
        """
        parts = list(parts)
        if not parts:
            return cls.empty(dim, grad=grad)
        slopes = [part.grad for part in parts if part.grad is not None] if grad else []
        if grad and len(slopes) < len(parts):
            raise ValueError(f"cannot join gradients: {len(parts) - len(slopes)} of {len(parts)} evaluations have none")
        loss, status = torch.cat([part.loss for part in parts]), torch.cat([part.status for part in parts])
        error = next((part.error for part in parts if part.error), "")
        return cls(loss, torch.cat(slopes) if grad else None, status, error)

    def rows(self, rows: slice | Int[Tensor, " some"]) -> Evaluation:
        """Return the evaluation of some of the points; the error message stays with those that raised."""
        status = self.status[rows]
        error = self.error if bool((status == Status.ERROR).any()) else ""
        return Evaluation(self.loss[rows], None if self.grad is None else self.grad[rows], status, error)

    def without_gradients(self) -> Evaluation:
        """Return the evaluation as if gradients had not been requested: none is missing."""
        return Evaluation.from_results(self.loss, None, self.status, self.error)

    @classmethod
    def raised(cls, error: Exception, *, dim: int, grad: bool) -> Evaluation:
        """Return the evaluation of one point at which the simulation raised."""
        loss = torch.full((1,), torch.nan, dtype=torch.float64)
        slope = loss.expand(1, dim).clone() if grad else None
        status = torch.full((1,), Status.ERROR, dtype=torch.int8)
        return cls(loss, slope, status, f"{type(error).__name__}: {first_line(error)}")

    @classmethod
    def empty(cls, dim: int, *, grad: bool, error: str = "") -> Evaluation:
        """Return the evaluation of no points at all."""
        loss = torch.zeros(0, dtype=torch.float64)
        return cls.from_results(loss, loss.new_zeros(0, dim) if grad else None, error=error)


class Objective(abc.ABC):
    """Anything with a parameter space that can be evaluated at a batch of points.

    It needs `space` and `evaluate`. Optional abilities have a default, so callers never need to ask. An objective is
    evaluated only inside its bounds, unless `beyond_box` allows more.
    """

    name: str  # by default the class's own in lower case
    space: ParameterSpace  # the parameters and their box
    loss_unit: str = ""
    beyond_box: bool = False  # whether parameters beyond their bounds mean something and may be tried
    device: str = "cpu"
    threads: int = 1  # that a batch is spread over
    preferred_batch: int = 1  # points worth evaluating at once
    whole_batches: bool = False  # whether a part of a batch takes as long as all of it
    own_programs: bool = False  # whether each one made compiles programs of its own, for each size of batch
    episodes_per_point: int = 1  # that the evaluation of one point takes
    decisions: int = 1  # how often controls are chosen in an episode: dim / decisions of them, time first
    has_gradient: bool = True  # False where it is known that there is none
    _named: bool = False

    def __init_subclass__(cls, **how: Any) -> None:
        super().__init_subclass__(**how)
        if "name" in vars(cls):
            cls._named = True
        elif not cls._named:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", cls.__name__).lower().lstrip("_")

    @abc.abstractmethod
    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if requested, at points `x` of the space."""

    def __call__(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        """Return losses that torch can differentiate. Raises ValueError for x that is not a floating-point tensor."""
        if not isinstance(x, Tensor) or not x.is_floating_point():
            kind = f"a tensor of {x.dtype}" if isinstance(x, Tensor) else type(x).__name__
            raise ValueError(f"{self.name}(x) takes a floating-point tensor, evaluate(x) takes any numbers; got {kind}")
        losses: Tensor = _Bridge.apply(x, self)  # type: ignore[no-untyped-call]
        return losses

    @property
    def precision(self) -> str:
        """float32 or float64: the precision of the losses."""
        return "float64"

    @property
    def packages(self) -> tuple[str, ...]:
        """Additional packages that affect the losses."""
        return ()

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers, as plain JSON."""
        return {"objective": self.name}

    def prepare(self) -> None:  # noqa: B027 -- most have nothing to prepare
        """Do the one-time work of the first evaluation."""

    def shrink(self, rows: int) -> None:  # noqa: B027 -- most hold no memory between evaluations
        """Evaluate at most `rows` points together from now on."""

    def release(self) -> None:  # noqa: B027 -- most hold no memory between evaluations
        """Free the memory that is held between evaluations."""

    def memory(self) -> int:
        """Estimate the memory of the evaluation of one point [bytes]."""
        return 0

    def events(self, x: Float[Tensor, "batch dim"]) -> Mapping[str, Int[Tensor, " batch"]]:
        """Count the events at each point, name -> shape (batch,); where a count changes, losses can jump."""
        return {}

    def special_places(self) -> Mapping[str, Float[Tensor, " dim"]]:
        """Return points by name that a check should examine: a contact begins, two bodies meet, a motor stalls."""
        return {}

    def nan_origin(self, x: Float[Tensor, " dim"]) -> str:
        """Return the operation that makes the first NaN of the gradient at one point; empty if unknown."""
        return ""

    def wrong_origin(self, x: Float[Tensor, " dim"]) -> str:
        """Return the operation whose own derivative is wrong at one point, where it is finite; empty if unknown."""
        return ""

    def energy(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step"] | None:
        """Return the mechanical energy [J] over time of an undriven motion; None where there is none."""
        return None

    def noise(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"] | None:
        """Return the standard error of the loss at each point [loss unit]; None where only repeats can measure it."""
        return None

    def replicas(self) -> Mapping[str, Objective]:
        """Return objectives of the same space, by the name of the change, that would be equal if only physics mattered.

        They compute the same physics differently: a shifted grid, other particles, the mirrored scene with its
        parameters mirrored. Each takes points of this space and returns losses and gradients in it.
        """
        return {}

    def observe(self, x: Float[Tensor, "batch dim"], decision: int) -> Float[Tensor, "batch feature"]:
        """Return a policy's observation before a decision: here only that nothing has happened yet."""
        return x.new_zeros(len(x), 1)


class _Bridge(torch.autograd.Function):
    """Make an objective one node of torch's graph: the gradient is computed with the loss, rows being independent."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, objective: Objective) -> Tensor:
        result = objective.evaluate(x, grad=ctx.needs_input_grad[0])
        if result.grad is not None:
            ctx.save_for_backward(result.grad.to(x))
        return result.loss.to(x)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None]:
        (grad,) = ctx.saved_tensors
        return grad_loss[:, None] * grad, None


class ObjectiveWrapper(Objective):
    """An objective around another one, which delegates everything below to that one."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        self.name, self.space, self.loss_unit = objective.name, objective.space, objective.loss_unit
        self.beyond_box, self.device, self.decisions = objective.beyond_box, objective.device, objective.decisions
        self.whole_batches, self.own_programs = objective.whole_batches, objective.own_programs
        self.has_gradient = objective.has_gradient


PASSED_ON = (
    "threads preferred_batch episodes_per_point precision packages identity prepare shrink release memory events "
    "special_places nan_origin wrong_origin energy noise replicas observe"
)
for _part in PASSED_ON.split():
    setattr(ObjectiveWrapper, _part, property(attrgetter(f"objective.{_part}")))


class BoxedObjective(ObjectiveWrapper):
    """Evaluate an objective only inside its box, although it allows points outside: these have status ESCAPED."""

    def __init__(self, objective: Objective) -> None:
        super().__init__(objective)
        self.beyond_box = False

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` of the space."""
        return evaluate_inside(self.objective, check_points(x, self.space, self.name), grad=grad)

    def replicas(self) -> Mapping[str, Objective]:
        """Return the replicas, each inside its box only."""
        return {name: BoxedObjective(replica) for name, replica in self.objective.replicas().items()}


class LossesOnly(ObjectiveWrapper):
    """An objective with only its losses: its gradients are NaN."""

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses at points `x` of the space."""
        found = self.objective.evaluate(x, grad=False)
        return Evaluation.from_results(found.loss, torch.full_like(x, torch.nan) if grad else None, found.status)


class SimulatorError(ValueError):
    """A simulator returned an invalid result, which no status of a single point can express."""


def evaluate(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Evaluate an objective, check the result against the protocol, and blank every failure.

    Points outside its bounds have left the domain (status ESCAPED), unless the objective allows them.

    Raises ValueError where the objective's result violates the protocol, and any error of the objective.
    """
    raw = _ask(objective, x, grad=grad) if objective.beyond_box else evaluate_inside(objective, x, grad=grad)
    loss, status = (tensor.detach().cpu() for tensor in (raw.loss, raw.status))
    gradient = raw.grad.detach().cpu().double() if grad and raw.grad is not None else None
    return Evaluation.from_results(loss.double(), gradient, status, raw.error)


def evaluate_inside(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Evaluate an objective at the points inside its box; the others have left the domain.

    The objective itself refuses invalid points, of a wrong shape or not a number. Raises what `evaluate` does.
    """
    if x.ndim != 2 or x.shape[1] != objective.space.dim:
        return objective.evaluate(x, grad=grad)
    inside = in_box(objective.space, x)
    if bool(inside.all()):
        return _ask(objective, _clamp(objective.space, x), grad=grad)
    loss, slope = x.new_full((len(x),), torch.nan), torch.full_like(x, torch.nan) if grad else None
    status, error = torch.full((len(x),), Status.ESCAPED, dtype=torch.int8), ""
    if bool(inside.any()):
        found = _ask(objective, _clamp(objective.space, x[inside]), grad=grad)
        error = found.error
        loss[inside], status[inside] = found.loss.detach().to(loss), found.status.to(status)
        if slope is not None and found.grad is not None:
            slope[inside] = found.grad.detach().to(slope)
    return Evaluation(loss, slope, status, error)


def _ask(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Return an objective's evaluation of points, checked against the protocol."""
    found, who = objective.evaluate(x, grad=grad), objective.name
    if not isinstance(found, Evaluation):
        raise SimulatorError(f"{who} must return an Evaluation; got {type(found).__name__}")
    count = len(x)
    wanted: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "loss": (found.loss, (count,)),
        "status": (found.status, (count,)),
    }
    if grad:
        wanted["grad"] = (_require_gradient(found.grad, who), tuple(x.shape))
    for field, (tensor, shape) in wanted.items():
        if tuple(tensor.shape) != shape:
            raise SimulatorError(
                f"{who} must return {field} of shape {shape} for x of shape {tuple(x.shape)}; got {tuple(tensor.shape)}"
            )
    for status in NOT_EVALUATED:
        if bool((found.status == status).any()):
            raise SimulatorError(f"{who} must give the final status of every point; got status {status.name}")
    return found


def in_box(space: ParameterSpace, x: Float[Tensor, "batch dim"]) -> Bool[Tensor, " batch"]:
    """Return which points are inside the bounds, up to rounding."""
    unit = space.to_unit(x)
    return ~((unit < -ROUNDING) | (unit > 1 + ROUNDING)).any(dim=1)


def _clamp(space: ParameterSpace, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
    return torch.clamp(x, space.lower, space.upper)


def check_points(x: object, space: ParameterSpace, name: str) -> Float[Tensor, "batch dim"]:
    """Return points as a tensor. Raises ValueError where they are not points of the space."""
    points = as_tensor(x, name)
    if points.ndim != 2 or points.shape[1] != space.dim:
        raise ValueError(
            f"{name} takes {space.dim} parameters, x of shape (batch, {space.dim}); got x of shape "
            f"{tuple(points.shape)}"
        )
    return points


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message: others' messages can be pages long."""
    return (str(error).strip().splitlines() or ["it has no message"])[0].rstrip(":")


def _real(values: object, what: str) -> Tensor:
    """Return a tensor of real numbers, converting anything else that contains some."""
    if isinstance(values, Tensor) and not values.is_complex() and values.dtype != torch.bool:
        return values
    return as_tensor(values, what)


def _check_codes(status: object) -> Tensor:
    """Return a tensor of statuses unchanged, and refuse codes that mean none: as int8, 257 would be OK."""
    codes = _real(status, "a status")
    sound = (codes >= 0) & (codes <= max(Status)) & (codes % 1 == 0)
    if not bool(sound.all()):
        known = ", ".join(f"{kind.value} {kind.name}" for kind in Status)
        raise ValueError(f"status takes {known}; got {codes[~sound][0].item()}")
    return codes


def _require_gradient(grad: Tensor | None, who: str) -> Tensor:
    if grad is None:
        raise SimulatorError(
            f"{who} returned no gradients with grad=True; sample with gradients=0 (--no-gradients), or search with a "
            "method that needs none"
        )
    return grad
