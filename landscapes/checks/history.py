"""What an evaluation remembers of earlier ones, and of other rows: the same points, called in several orders."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Objective, evaluate
from .evidence import Evidence

REPEATS = 6  # calls at one point, whose losses drift where a call counts
ROWS = 4  # points of the batch that is compared with single rows
ALIKE = 1e-3  # relative difference of gradients that are the same
SAME = 1e-9  # relative difference of losses that are the same


def observe(objective: Objective, x: Float[Tensor, "batch dim"]) -> Evidence:
    """Evaluate two points alone in several orders, and both in a batch; return how that changes the results.

    `loss_moves` and `gradient_moves` are relative differences between two calls at one point. `random`: the same calls
    do not reproduce these, and they do not drift. `hidden`: losses move in another way. `stale`: a call returns the
    gradient of the previous one. `grows`: gradients add up from call to call. `batch` is a gradient alone over that
    within a batch of `rows`. `alike`: all gradients of a batch are the same, although alone they are not. `leaks`: the
    loss of a row differs between a batch and alone, and `gradient_leak` is the relative difference of its gradients.
    Raises any error of the objective.
    """
    a, b = x[:1], x[1:2]
    order = [a, b, a, a, b, a, a]
    first, other, after, repeated, _, after_again, repeated_again = [
        evaluate(objective, one, grad=True) for one in order
    ]
    moved = max(_apart(after.loss, repeated.loss), _apart(first.loss, repeated.loss))
    again = max(_apart(after.loss, after_again.loss), _apart(repeated.loss, repeated_again.loss))
    batch = evaluate(objective, x[:ROWS], grad=True)
    drifts = moved > SAME and _drifts([float(evaluate(objective, a, grad=False).loss) for _ in range(REPEATS)])
    random = (moved > SAME and again > moved / 10 and not drifts) or _varies(after, after_again, repeated)
    gradient = max(_gap(after, repeated), _gap(first, repeated))
    leak = max(_gap(repeated, batch.rows(slice(0, 1))), _gap(other, batch.rows(slice(1, 2))))
    found = {
        "random": random,
        "hidden": moved > SAME and not random,
        "leaks": _apart(repeated.loss, batch.loss[:1]) > max(SAME, 10 * moved),
        "stale": _gap(other, repeated) < ALIKE < _gap(after, repeated),
        "grows": _grows(after, repeated, after_again, repeated_again),
        "batch": _ratio(repeated, batch),
        "alike": _is_alike(batch) and _gap(repeated, other) > ALIKE,
        "gradient_leak": leak if leak > 10 * gradient else 0.0,
        "rows": ROWS,
        "loss_moves": moved,
        "gradient_moves": gradient,
    }
    return {name: float(value) for name, value in found.items()}


def _drifts(losses: list[float]) -> bool:
    """Return whether losses of the same call go one way, or converge: chance does neither for so long."""
    steps = [late - early for early, late in pairwise(losses)]
    return all(step > 0 for step in steps) or all(step < 0 for step in steps)


def _varies(found: Evaluation, again: Evaluation, other: Evaluation) -> bool:
    """Return whether gradients at one point differ, and the same order of calls does not reproduce them."""
    same_loss = _apart(found.loss, other.loss) <= SAME
    return same_loss and SAME < _gap(found, other) < 10 * _gap(found, again) and not _grows(found, again)


def _is_alike(batch: Evaluation) -> bool:
    if batch.grad is None or len(batch.loss) < ROWS or not bool(batch.has_gradient.all()):
        return False
    return bool(batch.grad.any()) and _apart(batch.grad, batch.grad[:1].expand_as(batch.grad)) < SAME


def _apart(one: Tensor, other: Tensor) -> float:
    scale = max(float(one.abs().max()), float(other.abs().max()))
    apart = float((one - other).abs().max())
    return apart / scale if scale > 0 and apart == apart else 0.0


def _gap(one: Evaluation, other: Evaluation) -> float:
    """Return the difference of two gradients, relative to the longer."""
    if one.grad is None or other.grad is None or not bool((one.has_gradient & other.has_gradient).all()):
        return 0.0
    return _apart(one.grad, other.grad)


def _grows(*found: Evaluation) -> bool:
    """Return whether repeated gradients at one point keep growing along one direction."""
    grads = [one.grad for one in found if one.grad is not None and bool(one.has_gradient.all())]
    if len(grads) < len(found):
        return False
    sizes = [float(grad.norm()) for grad in grads]
    return all(late > 1.1 * early for early, late in pairwise(sizes))


def _ratio(alone: Evaluation, batch: Evaluation) -> float:
    """Return the length of a gradient alone over that of the same row in a batch, 1 where there is none."""
    if alone.grad is None or batch.grad is None:
        return 1.0
    if not bool(alone.has_gradient.all() & batch.has_gradient[0]):
        return 1.0
    size = float(batch.grad[0].norm())
    ratio = float(alone.grad[0].norm()) / size if size > 0 else 1.0
    return ratio if torch.isfinite(torch.tensor(ratio)) else 1.0
