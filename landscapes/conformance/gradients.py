"""Checks of gradients: against central differences over several steps, by gradcheck, and by two backward passes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError

from ..objective import Objective, Status, evaluate
from .finding import PASS, SKIP, WARN, Finding, verdict
from .subject import Subject, difference, size

DIFFERENCE_STEPS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # steps, as shares of the box
OPTIMISER_STEP = 1e-2  # of the box: what a step of a search is long
FINER_STEPS = (1e-8, 1e-7)  # in float64, where no other agrees: a loss that jumps often needs a step between its jumps
GRADCHECK_STEPS = (1e-6, 1e-7, 1e-8, 1e-9, 1e-10)  # of gradcheck, which has to agree at every point at once
ALONG_RANDOM, ALONG_AXES = 2, 1  # directions at each point
SLOPES = ALONG_RANDOM + ALONG_AXES
SIGNS = 0.75  # share of slopes whose sign has to agree
CLEAR = 10  # times the noise is what a slope has to be, to be compared
USEFUL = 0.5  # what the median relative error of slopes may be over an optimiser's step
LEAST_SHARE = 0.25  # share of slopes to compare for a step to be judged by
Function = Callable[[Tensor], Tensor]
Row = dict[str, float | None]


def check_slopes(subject: Subject, name: str) -> Finding:
    """Compare slopes along random directions and axes with central differences, one row of the table for each step.

    What passes is the agreement at the best step: a median relative error of at most ten times the third root of the
    precision, where central differences are exact to its two thirds. A slope that its loss's noise hides is left out.
    """
    slopes = _slopes(subject)
    if slopes is None:
        return Finding(name, SKIP, "no gradient")
    limit, count = 10 * subject.eps ** (1 / 3), len(slopes[0])
    table = [_step(subject, *slopes, step) for step in DIFFERENCE_STEPS]
    if subject.precision == "float64" and _best(table, limit, count)[1] is False:
        table = [_step(subject, *slopes, step) for step in FINER_STEPS] + table
    best, agrees = _best(table, limit, count)
    if best is None:
        return Finding(name, SKIP, "no slope to compare", "all are flat, lost in noise, or failed", table=tuple(table))
    figure = (
        f"in {subject.precision}, best at {best['step']:.0e} of the box: median relative error {best['error']:.1e}, "
        f"sign right {best['sign']:.0%}, cosine {best['cosine']:z.4f}"
    )
    found = verdict(name, agrees, figure, f"wanted: error {limit:.0e}, sign right {SIGNS:.0%}")
    return replace(found, numbers={**best, "limit": limit}, table=tuple(table))


def check_usefulness(subject: Subject, name: str) -> Finding:
    """Compare the same slopes with differences over a hundredth of the box, which is what an optimiser steps.

    A gradient may be right and yet say nothing of the loss so far away, where it is rugged or jumps: that is a warning
    and no failure, as it is the landscape's and not the gradient's.
    """
    slopes = _slopes(subject)
    if slopes is None:
        return Finding(name, SKIP, "no gradient")
    row = _step(subject, *slopes, OPTIMISER_STEP)
    if (row["compared"] or 0) < LEAST_SHARE * len(slopes[0]):
        return Finding(name, SKIP, "no slope to compare", "all are flat, lost in noise, or failed")
    sign, error = _number(row["sign"]), _number(row["error"])
    useful = sign >= SIGNS and error <= USEFUL
    figure = f"over {OPTIMISER_STEP:g} of the box: sign right {sign:.0%}, median relative error {error:.2g}"
    why = f"slopes do not hold that far: wanted are sign right {SIGNS:.0%} and an error of {USEFUL:g} for a search"
    return Finding(name, PASS if useful else WARN, figure, "" if useful else why, row)


def _best(table: Sequence[Row], limit: float, slopes: int) -> tuple[Row | None, bool]:
    """Return the row that agrees best among those that see enough slopes, if any, and whether that is enough."""
    judged = [row for row in table if (row["compared"] or 0) >= LEAST_SHARE * slopes]
    agreeing = [row for row in judged if _number(row["error"]) <= limit and _number(row["sign"]) >= SIGNS]
    best = min(agreeing or judged, key=lambda row: _number(row["error"]), default=None)
    return best, bool(agreeing)


def _number(value: float | None) -> float:
    return torch.nan if value is None else value


def _slopes(subject: Subject) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return points and directions in the unit cube, and the slope that the gradient gives there, a row for each slope.

    Axes are drawn in turn from all of them. None where there is no gradient.
    """
    space = subject.objective.space
    points = 0.1 + 0.8 * space.to_unit(subject.x)  # so that the longest step stays within the box
    here = subject.evaluate(space.from_unit(points))
    if here.grad is None:
        return None
    count, dim = points.shape
    generator = torch.Generator().manual_seed(subject.seed)
    base = points.repeat_interleave(SLOPES, dim=0)
    direction = torch.randn(base.shape, generator=generator, dtype=torch.float64)
    direction = direction / direction.norm(dim=1, keepdim=True)
    rows = torch.arange(len(base)).view(count, -1)[:, ALONG_RANDOM:].flatten()
    axes = torch.randperm(dim, generator=generator).repeat(-(-len(rows) // dim))[: len(rows)]
    direction[rows] = torch.eye(dim, dtype=torch.float64)[axes]
    slopes = (here.grad * (space.upper - space.lower)).repeat_interleave(SLOPES, dim=0)
    return base, direction, (slopes * direction).sum(dim=1)


def _step(subject: Subject, base: Tensor, direction: Tensor, exact: Tensor, step: float) -> Row:
    """Compare slopes with central differences over one step; `compared` of them are clear of the noise and finite.

    What the noise between repeats explains of a difference is no error.
    """
    ends = torch.cat([base + step * direction, base - step * direction])
    loss = evaluate(subject.objective, subject.objective.space.from_unit(ends), grad=False).loss
    ahead, behind = loss.chunk(2)
    slope = (ahead - behind) / (2 * step)
    noise = subject.noise[0] * subject.scale / step
    rounding = subject.eps * float(ahead.abs().nan_to_num().max()) / step
    above = torch.maximum(slope.abs(), exact.abs()) > CLEAR * max(noise, rounding)
    seen = slope.isfinite() & exact.isfinite() & above
    lost = float((~slope.isfinite() | ~exact.isfinite()).sum())
    row: Row = {"step": step, "compared": float(seen.sum()), "failed": lost}
    if not bool(seen.any()):
        return {**row, "cosine": None, "sign": None, "error": None}
    a, d = exact[seen], slope[seen]
    error = ((a - d).abs() - noise).clamp(min=0.0) / torch.maximum(a.abs(), d.abs())
    return {
        **row,
        "cosine": float(torch.nn.functional.cosine_similarity(a, d, dim=0)),
        "sign": float((a.sign() == d.sign()).double().mean()),
        "error": float(error.quantile(0.5)),
    }


def gradcheck(double: Subject, name: str) -> Finding:
    """Hold gradients in float64 against torch's own check, at finer and finer steps until one agrees."""
    if max(double.noise) > 0:
        return Finding(name, SKIP, "not checked", "repeats differ, and a pointwise check would measure that")
    rows = (double.first.status == Status.OK).nonzero().flatten()[:2]
    if not len(rows):
        return Finding(name, SKIP, "not checked", "no point has a gradient")
    room = 2 * GRADCHECK_STEPS[0]  # so that the longest step stays within the box
    function, u = _unit(double), double.objective.space.to_unit(double.x[rows]).clamp(room, 1 - room)
    said = ""
    for step in GRADCHECK_STEPS:
        agreement: dict[str, Any] = {"eps": step, "atol": 1e-4, "rtol": 1e-3, "nondet_tol": torch.inf}
        try:
            torch.autograd.gradcheck(function, (u.clone().requires_grad_(),), fast_mode=True, **agreement)
        except GradcheckError as error:
            said = said or " ".join(str(error).split())[:160]
        else:
            return verdict(name, True, f"agrees at {len(rows)} points in float64 over {step:.0e} of the box")
    return verdict(
        name, False, f"disagrees over {', '.join(f'{step:.0e}' for step in GRADCHECK_STEPS)} of the box", said
    )


def second_backward(subject: Subject, name: str) -> Finding:
    """Go back twice through one graph: the second gradient is the first."""
    u = subject.objective.space.to_unit(subject.x[:2]).requires_grad_()
    total = _unit(subject)(u).nansum()
    first, second = (torch.autograd.grad(total, u, retain_graph=True)[0] for _ in range(2))
    apart, limit = difference(first, second) / size(first), subject.tolerances[1]
    figure = "same bits" if apart == 0 else f"{apart:.1e} of the largest component apart"
    return verdict(name, apart <= limit, figure, f"at most {limit:.0e} is wanted: the first backward changes its tape")


def _unit(subject: Subject) -> Function:
    """Return the objective as a torch function of the unit cube, losses as shares of their range."""
    objective, scale = subject.objective, subject.scale
    function: Function = objective if callable(objective) else _Bridge.of(objective)
    return lambda u: function(objective.space.from_unit(u)) / scale


class _Bridge(torch.autograd.Function):
    """Make an objective one node of torch's graph; its backward evaluates anew, so a second one is a second look."""

    @classmethod
    def of(cls, objective: Objective) -> Function:
        return lambda x: cls.apply(x, objective)  # type: ignore[no-untyped-call]

    @staticmethod
    def forward(ctx: Any, x: Float[Tensor, "batch dim"], objective: Objective) -> Float[Tensor, " batch"]:
        ctx.objective = objective
        ctx.save_for_backward(x)
        with torch.enable_grad():  # torch switches it off around `forward` and `backward`
            return evaluate(objective, x.detach(), grad=False).loss

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_loss: Float[Tensor, " batch"]) -> tuple[Tensor, None]:
        (x,) = ctx.saved_tensors
        with torch.enable_grad():
            grad = evaluate(ctx.objective, x.detach(), grad=True).grad
        return grad_loss[:, None] * (x.new_zeros(x.shape) if grad is None else grad), None
