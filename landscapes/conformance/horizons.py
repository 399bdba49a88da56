"""Growth of gradients with the length of an episode, held against how far neighbours part.

A tape that keeps too little, or a solver's rule of differentiation, may be right for a short episode and grow without
bounds in a longer one, in which the motion stays tame. Where neighbours part themselves, large gradients are true.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Objective, evaluate
from .finding import SKIP, Finding, verdict
from .gradients import CLEAR
from .subject import Subject, spread

LONGEST, PARTING = 1e-4, 1e-6  # of the box: the longest step, and how near neighbours are that may part
FINEST = 100  # times the precision is what a parameter can be changed by
ROWS, STEPS = 3, 3  # points, at most, and steps at each
TOO_STEEP = 10  # times what the loss rises: what no gradient is that is right
PARTED = 0.01  # of the losses' range: neighbours that end farther apart have parted
HALF = 0.5  # share of the points


def episodes(horizons: int) -> tuple[int, int]:
    """Return how many losses, and losses with gradients, `check_growth` takes over so many horizons."""
    return horizons * ROWS * 2 * STEPS, horizons * ROWS


def check_growth(subject: Subject, name: str, horizons: Mapping[float, Callable[[], Objective]]) -> Finding:
    """Hold |gradient| against the rise of the loss along it, in episodes of several lengths.

    A gradient is too steep where the loss rises along it by less than a tenth of what it says, over the shortest step
    at which that would be seen, over ten times that step and over 1e-6 of the box, while neighbours stay within a
    hundredth of the losses' range. It fails where most points are too steep at one length. `horizons` makes the
    objective for a factor of its length.
    """
    if not horizons:
        return Finding(name, SKIP, "n/a", "it has no option `horizon`")
    space = subject.objective.space
    x = space.from_unit(space.to_unit(subject.x[:ROWS]).clamp(LONGEST, 1 - LONGEST))
    table, refused = [], ""
    for factor, make in horizons.items():
        try:
            row = _measure(replace(subject, objective=make()), x)
        except ValueError as refusal:
            refused = f"{factor:g}x is refused: {' '.join(str(refusal).split())}"
            continue
        if row is None:
            return Finding(name, SKIP, "no gradient")
        table.append({"horizon": factor, **row})
    judged = [row for row in table if row["judged"]]
    if not judged:
        return Finding(name, SKIP, "no slope to compare", refused or "all are flat, lost in noise, or failed")
    told = ", ".join(f"{row['gradient']:.2g} at {row['horizon']:g}x" for row in judged)
    rises = ", ".join(f"{row['slope']:.2g}" for row in judged)
    figure = f"|gradient| {told} the length; the loss rises along it by {rises}"
    steep = [row for row in judged if row["steep"] > HALF * row["judged"]]
    said = [f"{row['steep']:.0f} of {row['judged']:.0f} points at {row['horizon']:g}x" for row in steep]
    why = f"gradients grow where motions do not part: too steep at {', '.join(said)}"
    found = verdict(name, not steep, figure, why)
    return replace(found, why="; ".join(filter(None, (found.why, refused))), numbers=judged[-1])


def _measure(subject: Subject, x: Float[Tensor, "batch dim"]) -> dict[str, float] | None:
    """Measure the medians of |gradient| and of the loss's rise along it, and count the points where it is too steep."""
    space = subject.objective.space
    here = subject.evaluate(x)
    if here.grad is None:
        return None
    slopes = here.grad * (space.upper - space.lower)
    length = slopes.norm(dim=1)
    direction = (slopes / length[:, None]).nan_to_num()
    blur = subject.noise[0] * subject.scale + subject.eps * float(here.loss.abs().nan_to_num().max())
    finest = FINEST * subject.eps
    shortest = (CLEAR**2 * blur / (2 * length)).nan_to_num(LONGEST).clamp(finest, LONGEST)
    steps = torch.stack(
        [shortest, (CLEAR * shortest).clamp(max=LONGEST), torch.full_like(shortest, max(PARTING, finest))]
    )
    offset = steps[:, :, None] * direction
    ends = space.to_unit(x) + torch.stack([offset, -offset])  # side, step, point, parameter
    loss = evaluate(subject.objective, space.from_unit(ends.view(-1, space.dim)), grad=False).loss
    ahead, behind = loss.view(2, STEPS, -1)
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
