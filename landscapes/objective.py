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

    INTERPOLATED is a point of a refined slice that was not evaluated, as those around it explain it: its loss is NaN.
    NO_GRADIENT has a finite loss, which is kept, and a gradient that is not finite and therefore NaN.
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
    """Say which points have a finite loss; `status` is a tensor, an array or one Status."""
    return _is_any(status, HAS_LOSS)


def failed(status: Codes) -> Codes:
    """Say which points were evaluated and have no loss; `status` is a tensor, an array or one Status."""
    return _is_any(status, FAILED)


def _is_any(status: Codes, kinds: tuple[Status, ...]) -> Codes:
    found: Codes = status == kinds[0]
    for kind in kinds[1:]:
        found = found | (status == kind)
    return found


def describe_errors(count: int, first: str) -> str:
    """Say how many points raised and what the first of them said, in a line; nothing where none did."""
    if not count:
        return ""
    said = " ".join(first.split())
    shown = said if len(said) <= LONGEST_ERROR else f"{said[:LONGEST_ERROR]}..."
    return f"{count} point{'s' if count > 1 else ''} raised" + (f": first {shown!r}" if shown else "")


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Hold the result of evaluating a batch of points.

    `loss` [objective's unit], float64, shape (batch,); `grad` [loss unit / parameter unit], float64, shape
    (batch, dim), or None where it was not asked for; `status`, int8, shape (batch,). Where the status is not OK, the
    gradient is NaN, and so is the loss unless the status is NO_GRADIENT. `error` is what the first of the points with
    status ERROR raised. Arrays become tensors; raises ValueError for what is no real number, or no Status.
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
        """Which points have a finite gradient; none where gradients were not asked for."""
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
        """Make an evaluation from raw results: mark non-finite rows, keep what `failed` says, blank what is missing.

        `failed` holds a Status per row, OK where nothing is known to have gone wrong. A row whose loss alone is finite
        keeps it and has status NO_GRADIENT; without gradients, none is missing, and its status is OK.

        Raises ValueError where results are no real numbers, or codes in `failed` mean no Status.
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

        Gradients are left out unless `grad` asks for them. Raises ValueError where a part has none of those asked for.
        """
        parts = list(parts)
        if not parts:
            return cls.empty(dim, grad=grad)
        slopes = [part.grad for part in parts if part.grad is not None] if grad else []
        if grad and len(slopes) < len(parts):
            raise ValueError(f"{len(parts) - len(slopes)} of {len(parts)} evaluations to join have no gradients")
        loss, status = torch.cat([part.loss for part in parts]), torch.cat([part.status for part in parts])
        error = next((part.error for part in parts if part.error), "")
        return cls(loss, torch.cat(slopes) if grad else None, status, error)

    def rows(self, rows: slice | Int[Tensor, " some"]) -> Evaluation:
        """Return the evaluation of some of the points; the error message stays with those that raised."""
        status = self.status[rows]
        error = self.error if bool((status == Status.ERROR).any()) else ""
        return Evaluation(self.loss[rows], None if self.grad is None else self.grad[rows], status, error)

    def without_gradients(self) -> Evaluation:
        """Return what would be there had gradients not been asked for: none is missing."""
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

    Needed are `space` and `evaluate`. What only some can do has a default, so that nobody has to ask. An objective is
    evaluated inside its bounds only, unless `beyond_box` allows more.
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
        """Return losses, and gradients if asked, at points `x` of the space."""

    def __call__(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        """Return losses that torch can differentiate. Raises ValueError for x that holds no floating-point numbers."""
        if not isinstance(x, Tensor) or not x.is_floating_point():
            kind = f"a tensor of {x.dtype}" if isinstance(x, Tensor) else type(x).__name__
            raise ValueError(f"{self.name}(x) takes a floating-point tensor, and evaluate(x) any numbers; got {kind}")
        losses: Tensor = _Bridge.apply(x, self)  # type: ignore[no-untyped-call]
        return losses

    @property
    def precision(self) -> str:
        """float32 or float64: what losses are computed in."""
        return "float64"

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages that losses depend on, in addition to those that all depend on."""
        return ()

    def identity(self) -> dict[str, Any]:
        """Return what decides the numbers, as plain JSON."""
        return {"objective": self.name}

    def prepare(self) -> None:  # noqa: B027 -- most have nothing to prepare
        """Do what the first evaluation would do besides evaluating."""

    def shrink(self, rows: int) -> None:  # noqa: B027 -- most hold no memory between evaluations
        """Take at most `rows` points at once from now on."""

    def release(self) -> None:  # noqa: B027 -- most hold no memory between evaluations
        """Give back the memory that is held between evaluations."""

    def memory(self) -> int:
        """Estimate the bytes that the evaluation of one point takes."""
        return 0

    def events(self, x: Float[Tensor, "batch dim"]) -> Mapping[str, Int[Tensor, " batch"]]:
        """Count what happens at each point, name -> shape (batch,); where a count changes, losses may jump."""
        return {}

    def special_places(self) -> Mapping[str, Float[Tensor, " dim"]]:
        """Return points by name at which a check is to look: a contact begins, two bodies meet, a motor stalls."""
        return {}

    def nan_origin(self, x: Float[Tensor, " dim"]) -> str:
        """Say which operation makes the first NaN of the gradient at one point; empty where nothing tells."""
        return ""

    def wrong_origin(self, x: Float[Tensor, " dim"]) -> str:
        """Say which operation's own derivative is wrong at one point, where it is finite; empty where nothing tells."""
        return ""

    def energy(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step"] | None:
        """Return the mechanical energy [J] over time of a motion that nothing drives; None where there is none."""
        return None

    def noise(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"] | None:
        """Return the standard error of the loss at each point [loss unit]; None where repeats have to tell."""
        return None

    def replicas(self) -> Mapping[str, Objective]:
        """Return objectives of the same space, by what was changed, that would be the same if physics alone decided.

        The same physics computed otherwise: a shifted grid, other particles, the mirrored scene with its parameters
        mirrored. Each takes points of this space and returns losses and gradients in it.
        """
        return {}

    def observe(self, x: Float[Tensor, "batch dim"], decision: int) -> Float[Tensor, "batch feature"]:
        """Return what a policy sees before a decision: here no more than that nothing has happened yet."""
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
    """An objective around another one, which has all that the other one has: below, what is asked of that one."""

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
    """Evaluate an objective inside its box only, though it allows points beyond: these have status ESCAPED."""

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
    """An objective whose losses alone are known: its gradients are NaN."""

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses at points `x` of the space."""
        found = self.objective.evaluate(x, grad=False)
        return Evaluation.from_results(found.loss, torch.full_like(x, torch.nan) if grad else None, found.status)


class SimulatorError(ValueError):
    """What a simulator returned is not what it has to return; no status of a single point can say that."""


def evaluate(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Evaluate an objective, hold the result against the protocol, and blank every failure.

    Points beyond its bounds have left the domain (status ESCAPED), unless the objective invites them.

    Raises ValueError where the objective's answer is not what the protocol says, and what it raises itself.
    """
    raw = _ask(objective, x, grad=grad) if objective.beyond_box else evaluate_inside(objective, x, grad=grad)
    loss, status = (tensor.detach().cpu() for tensor in (raw.loss, raw.status))
    gradient = raw.grad.detach().cpu().double() if grad and raw.grad is not None else None
    return Evaluation.from_results(loss.double(), gradient, status, raw.error)


def evaluate_inside(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Evaluate an objective at those of the points that lie in its box; the others have left the domain.

    What is no point at all, of a wrong shape or not a number, is for the objective to refuse.

    Raises what `evaluate` does.
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
    """Return what an objective says of points, held against the protocol."""
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
            raise SimulatorError(f"{who} must say how every point ended; got status {status.name}")
    return found


def in_box(space: ParameterSpace, x: Float[Tensor, "batch dim"]) -> Bool[Tensor, " batch"]:
    """Say which points lie nowhere beyond the bounds, to rounding."""
    unit = space.to_unit(x)
    return ~((unit < -ROUNDING) | (unit > 1 + ROUNDING)).any(dim=1)


def _clamp(space: ParameterSpace, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
    return torch.clamp(x, space.lower, space.upper)


def check_points(x: object, space: ParameterSpace, name: str) -> Float[Tensor, "batch dim"]:
    """Return points as a tensor. Raises ValueError where they are no points of the space."""
    points = as_tensor(x, name)
    if points.ndim != 2 or points.shape[1] != space.dim:
        raise ValueError(
            f"{name} takes {space.dim} parameters, x of shape (batch, {space.dim}); got x of shape "
            f"{tuple(points.shape)}"
        )
    return points


def first_line(error: BaseException) -> str:
    """Return the first line of what an error says: others' messages may go on for pages."""
    return (str(error).strip().splitlines() or ["it says nothing"])[0].rstrip(":")


def _real(values: object, what: str) -> Tensor:
    """Return a tensor of real numbers as it is, and one of what else holds some."""
    if isinstance(values, Tensor) and not values.is_complex() and values.dtype != torch.bool:
        return values
    return as_tensor(values, what)


def _check_codes(status: object) -> Tensor:
    """Return a tensor of statuses as it is, and refuse codes that mean none: as int8, 257 would be OK."""
    codes = _real(status, "a status")
    sound = (codes >= 0) & (codes <= max(Status)) & (codes % 1 == 0)
    if not bool(sound.all()):
        known = ", ".join(f"{kind.value} {kind.name}" for kind in Status)
        raise ValueError(f"a status is one of {known}; got {codes[~sound][0].item()}")
    return codes


def _require_gradient(grad: Tensor | None, who: str) -> Tensor:
    if grad is None:
        raise SimulatorError(
            f"{who} was asked for gradients and returned none; sample with gradients=0 (--no-gradients), "
            "or search with a method that needs none"
        )
    return grad
