"""Gradients in time: growth over horizons, and a second backward pass through one graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Objective, evaluate
from .finding import Finding, one_line, skip, verdict, within
from .subject import Subject, difference, size, spread

CLEAR = 10  # times the noise is what a slope has to be, to be compared
NOTHING_TO_COMPARE = "no slope to compare", "all are flat, lost in noise, or failed"
LONGEST_STEP, PARTING = 1e-4, 1e-6  # of the box: the longest step, and how near neighbours are that may part
FINEST = 100  # times the precision is what a parameter can be changed by
GROWTH_ROWS, GROWTH_STEPS = 3, 3  # points, at most, and steps at each
TOO_STEEP = 10  # times what the loss rises: what no gradient is that is right
PARTED = 0.01  # of the losses' range: neighbours that end farther apart have parted
MOST_POINTS = 0.5  # share of the points


def second_backward(subject: Subject) -> Finding:
    """Go back twice through one graph: the second gradient must equal the first."""
    u = subject.objective.space.to_unit(subject.x[:2]).requires_grad_()
    total = _unit(subject)(u).nansum()
    first, second = (torch.autograd.grad(total, u, retain_graph=True)[0] for _ in range(2))
    apart = difference(first, second) / size(first)
    figure = f"the two differ by {apart:.1e} of the largest component"
    return within(apart, subject.tolerances[1], figure, "the first backward changes its tape")


def _unit(subject: Subject) -> Callable[[Tensor], Tensor]:
    """Return the objective as a torch function of the unit cube, losses as shares of their range."""
    objective, scale = subject.objective, subject.scale
    return lambda u: objective(objective.space.from_unit(u)) / scale


def growth_episodes(horizons: int) -> tuple[int, int]:
    """Return the numbers of losses alone and with gradients that `check_growth` takes over this many horizons."""
    return horizons * GROWTH_ROWS * 2 * GROWTH_STEPS, horizons * GROWTH_ROWS


def check_growth(subject: Subject, horizons: Mapping[float, Callable[[], Objective]]) -> Finding:
    """Compare |gradient| with the rise of the loss along it, in episodes of several lengths.

    A truncated tape, or a solver's own differentiation rule, can be right for a short episode but grow without bounds
    in a longer one although the motion stays tame. Where neighbouring motions diverge, large gradients are right. A
    gradient is too steep if the loss rises along it by less than a tenth of its prediction. That has to happen over the
    shortest step that could show it, over ten times that step and over 1e-6 of the box, while neighbours stay within a
    hundredth of the losses' range. The check fails where most points are too steep at one length. `horizons` makes the
    objective for a factor of its length.
    """
    if not horizons:
        return skip("n/a", "it has no option `horizon`")
    space = subject.objective.space
    x = space.from_unit(space.to_unit(subject.x[:GROWTH_ROWS]).clamp(LONGEST_STEP, 1 - LONGEST_STEP))
    table, refused = [], ""
    for factor, make in horizons.items():
        try:
            row = _measure(replace(subject, objective=make()), x)
        except ValueError as refusal:
            refused = f"{factor:g}x is refused: {one_line(refusal)}"
            continue
        if row is None:
            return skip("no gradient")
        table.append({"horizon": factor, **row})
    judged = [row for row in table if row["judged"]]
    if not judged:
        return skip(NOTHING_TO_COMPARE[0], refused or NOTHING_TO_COMPARE[1])
    told = ", ".join(f"{row['gradient']:.2g} at {row['horizon']:g}x" for row in judged)
    rises = ", ".join(f"{row['slope']:.2g}" for row in judged)
    figure = f"|gradient| {told} the length; the loss rises along it by {rises}"
    steep = [row for row in judged if row["steep"] > MOST_POINTS * row["judged"]]
    said = [f"{row['steep']:.0f} of {row['judged']:.0f} points at {row['horizon']:g}x" for row in steep]
    why = f"gradients grow although motions do not diverge: too steep at {', '.join(said)}"
    found = verdict(not steep, figure, why, judged[-1])
    return replace(found, why="; ".join(filter(None, (found.why, refused))))


def _measure(subject: Subject, x: Float[Tensor, "batch dim"]) -> dict[str, float] | None:
    """Measure the medians of |gradient| and of the loss's rise along it, and count the points where it is too steep."""
    space = subject.objective.space
    here = subject.evaluate(x)
    if here.grad is None:
        return None
    slopes = here.grad * (space.upper - space.lower)
    length = slopes.norm(dim=1)
    direction = (slopes / length[:, None]).nan_to_num()
    blur = subject.blur(here.loss)
    finest = FINEST * subject.eps
    shortest = (CLEAR**2 * blur / (2 * length)).nan_to_num(LONGEST_STEP).clamp(finest, LONGEST_STEP)
    steps = torch.stack(
        [shortest, (CLEAR * shortest).clamp(max=LONGEST_STEP), torch.full_like(shortest, max(PARTING, finest))]
    )
    offset = steps[:, :, None] * direction
    ends = space.to_unit(x) + torch.stack([offset, -offset])  # side, step, point, parameter
    loss = evaluate(subject.objective, space.from_unit(ends.view(-1, space.dim)), grad=False).loss
    ahead, behind = loss.view(2, GROWTH_STEPS, -1)
    rise, told = (ahead - behind).abs(), 2 * steps * length
    known = (told > CLEAR * blur) & rise.isfinite() & told.isfinite()
    judged = known.any(dim=0)
    steep = judged & ((told > TOO_STEEP * rise) | ~known).all(dim=0) & (rise[-1] < PARTED * spread(here.loss))
    slope = (rise / (2 * steps)).masked_fill(~known, torch.nan).nanquantile(0.5, dim=0)
    return {
        "gradient": _median(length[judged]),
        "slope": _median(slope[judged]),
        "judged": float(judged.sum()),
        "steep": float(steep.sum()),
    }


def _median(values: Float[Tensor, " point"]) -> float:
    return float(values.quantile(0.5)) if len(values) else torch.nan
