"""Verification: a few points of a stored result are evaluated again before it is continued.

If their bits equal the stored ones, that is enough. If not, the change of losses and gradients without a cause is
measured: once more, in other batches, and at points moved within rounding. A larger difference means another function;
it is refused with both numbers.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from .identity import StoreMismatchError, plane_of, stored_identity
from .objective import NOT_EVALUATED, BoxedObjective, Evaluation, Objective, Status, evaluate, in_box

POINTS = 3  # of a result that are evaluated again
ROUNDING = {"float32": 1e-4, "float64": 1e-10}  # what rounding changes: a share of the losses' spread, of a gradient
LAST_PLACE = {"float32": 2.0**-23, "float64": 2.0**-52}
PLACES = 64  # units in the last place of a loss that rounding changes
MOVES, REACH = 8, 8  # evaluations at points that are moved, and how far these are [units in the last place]
MARGIN = 10.0  # times what changes by noise
SHOWN = 6  # parameters of a point that a refusal shows
TODO = "write elsewhere with --out, or replace it with --force"
RESAMPLE = "sample it again with --force, or use its former simulator"  # where it is only read


@dataclass(frozen=True, eq=False)
class StoredPoints:
    """Points of a stored result with its values, and its type: a slice, a run.

    `x` has shape (point, dim). `sloped`: a failed point can have been evaluated with its gradient, too; for other
    points the gradient itself shows it.
    """

    path: Path
    what: str
    x: Float[Tensor, "point dim"]
    found: Evaluation
    sloped: bool

    @classmethod
    def of_slice(cls, dataset: xr.Dataset, path: Path) -> StoredPoints:
        """Return the points of a slice."""
        plane, names = plane_of(dataset), [name for name in ("v", "u") if name in dataset["loss"].dims]
        arrays = {
            name: dataset[name].transpose(*names, ...).to_numpy()
            for name in ("loss", "status", "grad")
            if name in dataset
        }
        grid = np.meshgrid(*(dataset[name].to_numpy() for name in names), indexing="ij")[::-1]
        x = plane.lift(torch.from_numpy(np.stack([axis.ravel() for axis in grid], axis=1)))
        return cls(path, "slice", x, stored_evaluation(arrays, plane.dim), "grad" in dataset)

    def choose(self, objective: Objective, count: int) -> list[int]:
        """Return the rows to evaluate again: those with the median, the lowest and the highest loss.

        Rows with a gradient come first, then rows with a loss. Points at which the objective is not evaluated are left
        out.
        """
        space, status = objective.space, self.found.status
        usable = self.x.isfinite().all(dim=1) & ~torch.isin(status, torch.tensor(NOT_EVALUATED, dtype=status.dtype))
        if not objective.beyond_box:
            usable &= in_box(space, self.x)
        known = usable & self.found.loss.isfinite()
        rows = next((some for some in (known & self._has_gradient(), known, usable) if bool(some.any())), known)
        order = rows.nonzero()[:, 0]
        order = order[self.found.loss[order].argsort(stable=True)]
        picks = [len(order) // 2, 0, len(order) - 1][:count] if len(order) else []
        return list(dict.fromkeys(int(order[pick]) for pick in picks))

    def asked(self) -> Bool[Tensor, " point"]:
        """Return which points are known to have been evaluated with their gradients."""
        failed = self.found.status != Status.OK
        return self._has_gradient() | (failed & self.sloped)

    def _has_gradient(self) -> Bool[Tensor, " point"]:
        grad = self.found.grad
        return torch.zeros(len(self.x), dtype=torch.bool) if grad is None else grad.isfinite().all(dim=1)


@dataclass(frozen=True, eq=False)
class _Probe:
    """One stored point that is evaluated again, and the scales for its rounding.

    `spread` is that of all losses stored with it, `slope` the median length of their gradients in widths of the box,
    `widths`. `grad`: whether it was evaluated with its gradient.
    """

    stored: StoredPoints
    row: int
    spread: float
    slope: float
    widths: Float[Tensor, " dim"]
    grad: bool

    @property
    def x(self) -> Float[Tensor, " dim"]:
        return self.stored.x[self.row]

    @property
    def then(self) -> Evaluation:
        return _row(self.stored.found, self.row)


def verify(objective: Objective, results: Sequence[StoredPoints], *, points: int = POINTS, todo: str = TODO) -> None:
    """Evaluate this many points of each stored result again, all in one batch, and refuse other numbers.

    Losses, stored gradients, and statuses are compared. Raises StoreMismatchError, which gives the result, both numbers
    and `todo`.
    """
    probes = [probe for one in results for probe in _probes(objective, one, points)]
    for grad in (True, False):
        some = [probe for probe in probes if probe.grad == grad]
        if not some:
            continue
        now = _evaluate(objective, torch.stack([probe.x for probe in some]), grad=grad)
        unlike = [number for number, probe in enumerate(some) if not _same(probe.then, _row(now, number))]
        if unlike:
            suspects = [some[number] for number in unlike]
            _compare(objective, suspects, now.rows(torch.tensor(unlike)), grad=grad, todo=todo)


def verify_dataset(objective: Objective, dataset: xr.Dataset, path: Path, *, todo: str = TODO) -> None:
    """Verify a loaded slice; raises StoreMismatchError where the objective gives other numbers."""
    if stored_identity(dataset).get("boxed"):
        objective = BoxedObjective(objective)
    verify(objective, [StoredPoints.of_slice(dataset, path)], todo=todo)


def stored_evaluation(arrays: Mapping[str, NDArray[Any]], dim: int) -> Evaluation:
    """Return the content of a slice's arrays, point by point."""
    loss, status = (torch.from_numpy(arrays[name].reshape(-1)) for name in ("loss", "status"))
    return Evaluation(loss, torch.from_numpy(arrays["grad"].reshape(-1, dim)) if "grad" in arrays else None, status)


def _probes(objective: Objective, stored: StoredPoints, count: int) -> list[_Probe]:
    losses, grad = stored.found.loss, stored.found.grad
    known, widths = losses[losses.isfinite()].numpy(), objective.space.upper - objective.space.lower
    high, low = np.percentile(known / 4, (95, 5)).tolist() if len(known) else (0.0, 0.0)
    spread = min(4 * (high - low), sys.float_info.max)  # of losses of 1e308, too
    slopes = torch.empty(0) if grad is None else (grad * widths).abs().amax(dim=1)
    slopes = slopes[slopes.isfinite()]
    slope = float(slopes.median()) if len(slopes) else 0.0
    asked = stored.asked()
    return [_Probe(stored, row, spread, slope, widths, bool(asked[row])) for row in stored.choose(objective, count)]


def _row(found: Evaluation, number: int) -> Evaluation:
    return found.rows(slice(number, number + 1))


def _same(then: Evaluation, now: Evaluation) -> bool:
    """Whether two evaluations of a point are the same: status, loss, and gradient where both are finite."""
    pairs = ((then.loss, now.loss), (then.grad, now.grad))
    known = [(one, other) for one, other in pairs if one is not None and other is not None]
    return int(then.status) == int(now.status) and not any(bool((_apart(*pair) > 0).any()) for pair in known)


def _apart(one: Tensor, other: Tensor) -> Tensor:
    """Return the differences of numbers, 0 where either is not finite."""
    return torch.where(one.isfinite() & other.isfinite(), (one - other).abs(), 0.0)


def _differences(
    probe: _Probe,
    now: Evaluation,
    again: Sequence[Evaluation],
    statuses: set[int],
    precision: str,
    names: Sequence[str],
) -> tuple[str, str, str]:
    """Describe the changes of losses, statuses and gradients of a point; empty if rounding or noise explains them.

    `again` was evaluated in other ways, with the final `statuses`. Gradients are described by the parameter with the
    largest difference in widths of the box.
    """
    then, loss, status, gradient = probe.then, "", "", ""
    noise = max(float(_apart(now.loss, one.loss)) for one in again)
    size = PLACES * LAST_PLACE[precision] * abs(float(now.loss.nan_to_num(0.0)))
    if float(_apart(then.loss, now.loss)) > max(ROUNDING[precision] * probe.spread, size, MARGIN * noise):
        loss = f"losses have changed: {_both(float(then.loss), float(now.loss))}"
    if int(then.status) not in statuses:
        ends = f"{Status(int(then.status)).name} then, {Status(int(now.status)).name} now"
        status = f"points end differently: {ends}"
    if then.grad is not None and now.grad is not None:
        shift = (_apart(then.grad, now.grad) * probe.widths)[0]
        noise = max(float((_apart(now.grad, one.grad) * probe.widths).max()) for one in again if one.grad is not None)
        size = max(probe.slope, float((now.grad.nan_to_num(0.0).abs() * probe.widths).max()))
        axis = int(shift.argmax())
        if float(shift[axis]) > max(ROUNDING[precision] * size, MARGIN * noise):
            both = _both(float(then.grad[0, axis]), float(now.grad[0, axis]))
            gradient = f"gradients have changed: gradient by {names[axis]} {both}"
    return loss, status, gradient


def _compare(objective: Objective, probes: Sequence[_Probe], now: Evaluation, *, grad: bool, todo: str) -> None:
    """Raise StoreMismatchError for the first point whose numbers differ by more than noise and rounding change."""
    precision, x = objective.precision, torch.stack([probe.x for probe in probes])
    others = _evaluate_again(objective, x, grad=grad, reach=REACH * LAST_PLACE[precision])
    statuses = [set(map(int, column)) for column in torch.stack([one.status for one in (now, *others)]).T]
    if grad and any(int(probe.then.status) not in known for probe, known in zip(probes, statuses, strict=True)):
        for known, status in zip(statuses, _evaluate(objective, x, grad=False).status, strict=True):
            known.add(int(status))  # a point that failed may have been asked for its loss alone
    names = objective.space.names
    differ = [
        _differences(
            probe, _row(now, number), [_row(one, number) for one in others], statuses[number], precision, names
        )
        for number, probe in enumerate(probes)
    ]
    for kind in zip(*differ, strict=True):  # losses of all points come first
        for probe, said in zip(probes, kind, strict=True):
            if said:
                raise StoreMismatchError(
                    f"{probe.stored.path} contains a {probe.stored.what} of {objective.name} whose {said}, at x = "
                    f"{_point(objective.space.to_values(probe.x))}; {todo}"
                )


def _evaluate_again(
    objective: Objective, x: Float[Tensor, "point dim"], *, grad: bool, reach: float
) -> list[Evaluation]:
    """Evaluate points once more: one by one, in pairs, and together with others within rounding of them."""
    space, generator = objective.space, torch.Generator().manual_seed(0)
    moves = 2 * torch.rand(MOVES, *x.shape, generator=generator, dtype=torch.float64) - 1
    moved = x + moves * reach * (space.upper - space.lower)
    moved = torch.where(in_box(space, x)[:, None], moved.clamp(space.lower, space.upper), moved)
    batches = [*x[:, None], torch.cat([x, x]), torch.cat([x, *moved])]
    parts = [_evaluate(objective, batch, grad=grad) for batch in batches]
    whole = Evaluation.join(parts, dim=space.dim, grad=grad)
    return [whole.rows(slice(at, at + len(x))) for at in range(0, len(whole.loss), len(x))]


def _evaluate(objective: Objective, x: Float[Tensor, "point dim"], *, grad: bool) -> Evaluation:
    """Evaluate points in the objective's preferred batches, or all at once."""
    batch = objective.preferred_batch if objective.preferred_batch > 1 else max(1, len(x))
    parts = [evaluate(objective, part, grad=grad) for part in torch.split(x, batch)]
    return Evaluation.join(parts, dim=objective.space.dim, grad=grad)


def _both(then: float, now: float) -> str:
    """Return two numbers with enough digits to distinguish them."""
    for digits in range(3, 18):
        if f"{then:.{digits}g}" != f"{now:.{digits}g}":
            break
    return f"{then:.{digits}g} then, {now:.{digits}g} now"


def _point(x: Float[Tensor, " dim"]) -> str:
    shown = [f"{value:.6g}" for value in x[:SHOWN].tolist()]
    return f"({', '.join([*shown, *(['...'] if len(x) > SHOWN else [])])})"
