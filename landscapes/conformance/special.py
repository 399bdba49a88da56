"""Gradients at places where random points never are: the centre, where parameters are exactly zero, corners.

A contact that does not slide, a distance of zero, a tie: there a rule of differentiation may divide by zero, or choose
a branch, while beside it all is right. A gradient there must lie between the slopes of the loss to either side.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Status, evaluate
from ..space import ParameterSpace
from .finding import SKIP, Finding, verdict
from .gradients import CLEAR
from .subject import Subject

STEPS = (1e-6, 1e-5, 1e-4, 1e-3)  # as shares of the box
AXES = 4  # at each place, drawn from all
INSIDE = 2e-3  # how far from the corner of the box, so that the longest step stays within it
APART = 0.05  # of the larger of gradient and slopes: how far outside the slopes a gradient is wrong


def places(space: ParameterSpace, seed: int) -> dict[str, Float[Tensor, " dim"]]:
    """Return the places by name, in the unit cube: those that are there, and differ."""
    zero = space.to_unit(torch.zeros(space.dim, dtype=torch.float64))
    inside = (zero > INSIDE) & (zero < 1 - INSIDE)
    drawn = space.to_unit(space.uniform(1, seed=seed)[0])
    signs = torch.rand(space.dim, generator=torch.Generator().manual_seed(seed)) < 0.5
    found = {"the centre": torch.full_like(zero, 0.5), "a corner": torch.where(signs, INSIDE, 1 - INSIDE).double()}
    if bool(inside.any()):
        found["zero"] = torch.where(inside, zero, drawn)
        found["a zero"] = torch.where(torch.arange(space.dim) == int(inside.nonzero()[0]), zero, drawn)
    return {name: u for name, u in found.items() if name != "zero" or bool((u != 0.5).any())}


def episodes(dim: int) -> int:
    """Return how many losses `check_special_places` takes, at most."""
    return 4 * min(AXES, dim) * 2 * len(STEPS)


def check_special_places(subject: Subject, name: str) -> Finding:
    """Hold gradients at special places against the slopes to either side, along some axes.

    A gradient is wrong that is outside these slopes over every step from 1e-6 to 1e-3 of the box, by more than a
    twentieth of the larger; where the noise hides them it is left out. A kink is none: one of its slopes is as good.
    """
    space = subject.objective.space
    where = places(space, subject.seed)
    base = torch.stack(list(where.values()))
    here = subject.evaluate(space.from_unit(base))
    if here.grad is None:
        return Finding(name, SKIP, "no gradient")
    if missing := _name_missing(where, here):
        return verdict(name, False, f"{len(missing)} of {len(where)} places have no gradient", "; ".join(missing))
    generator = torch.Generator().manual_seed(subject.seed)
    axes = torch.randperm(space.dim, generator=generator)[:AXES].sort().values
    exact = (here.grad * (space.upper - space.lower))[:, axes]
    beside = torch.stack([_slopes(subject, base, here.loss, axes, step) for step in STEPS])  # step, side, place, axis
    low, high = beside.amin(dim=1), beside.amax(dim=1)
    largest = torch.maximum(beside.abs().amax(dim=1), exact.abs())
    outside = torch.maximum(low - exact, exact - high) > APART * largest
    noise = torch.tensor([_noise(subject, here.loss, step) for step in STEPS], dtype=torch.float64)
    flat = subject.flat(here.loss)
    seen = beside.isfinite().all(dim=1) & exact.isfinite() & (largest > (CLEAR * noise).clamp(min=flat)[:, None, None])
    wrong = seen.any(dim=0) & (outside | ~seen).all(dim=0)
    if not bool(seen.any()):
        return Finding(name, SKIP, "no slope to compare", "all are flat, lost in noise, or failed")
    count = f"{int(seen.any(dim=0).sum())} slopes at {', '.join(where)}"
    if not bool(wrong.any()):
        return verdict(name, True, f"{count}: between those to either side")
    place, axis = wrong.nonzero()[0].tolist()
    step = int(seen[:, place, axis].nonzero()[0])
    left, right = beside[step, :, place, axis].tolist()
    figure = (
        f"{int(wrong.sum())} of {count} are wrong: at {[*where][place]}, by {space.names[int(axes[axis])]}, the "
        f"gradient is {float(exact[place, axis]):.3g} and the loss rises by {left:.3g} and {right:.3g} to either side"
    )
    found = verdict(name, False, figure, "a gradient has to lie between the slopes to either side")
    return replace(found, numbers={"wrong": float(wrong.sum()), "compared": float(seen.any(dim=0).sum())})


def _name_missing(where: Iterable[str], found: Evaluation) -> list[str]:
    """Say at which places the gradient is NaN beside a finite loss."""
    missing = found.status == Status.NO_GRADIENT
    rows = zip(where, found.loss.tolist(), missing.tolist(), strict=True)
    return [f"the gradient is NaN at {place}, where the loss is {loss:.4g}" for place, loss, none in rows if none]


def _slopes(subject: Subject, base: Tensor, loss: Tensor, axes: Tensor, step: float) -> Float[Tensor, "2 place axis"]:
    """Return the slopes over one step to either side of each place along each axis [loss unit per side of the box]."""
    space = subject.objective.space
    offset = step * torch.eye(space.dim, dtype=torch.float64)[axes]
    ends = torch.stack([base[:, None] - offset, base[:, None] + offset])
    found = evaluate(subject.objective, space.from_unit(ends.reshape(-1, space.dim)), grad=False).loss
    behind, ahead = found.reshape(2, len(base), len(axes))
    return torch.stack([(loss[:, None] - behind) / step, (ahead - loss[:, None]) / step])


def _noise(subject: Subject, loss: Tensor, step: float) -> float:
    """Return what noise and rounding make of a slope over a step."""
    rounding = subject.eps * float(loss.abs().nan_to_num().max())
    return (subject.noise[0] * subject.scale + rounding) / step
