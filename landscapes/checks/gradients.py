"""Checks of gradients: by central differences, gradcheck and two backward passes, at special places, over horizons."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError

from ..objective import Evaluation, Objective, Status, evaluate
from ..space import ParameterSpace
from .finding import PASS, WARN, Finding, one_line, skip, verdict, within
from .subject import Subject, difference, size, spread

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
Row = dict[str, float | None]
NOTHING_TO_COMPARE = "no slope to compare", "all are flat, lost in noise, or failed"

PLACE_STEPS = (1e-6, 1e-5, 1e-4, 1e-3)  # as shares of the box
AXES = 4  # at each place, drawn from all
INSIDE = 2e-3  # how far from the corner of the box, so that the longest step stays within it
OUTSIDE_SLOPES = 0.05  # of the larger of gradient and slopes: how far outside the slopes a gradient is wrong

LONGEST_STEP, PARTING = 1e-4, 1e-6  # of the box: the longest step, and how near neighbours are that may part
FINEST = 100  # times the precision is what a parameter can be changed by
GROWTH_ROWS, GROWTH_STEPS = 3, 3  # points, at most, and steps at each
TOO_STEEP = 10  # times what the loss rises: what no gradient is that is right
PARTED = 0.01  # of the losses' range: neighbours that end farther apart have parted
MOST_POINTS = 0.5  # share of the points


def check_slopes(subject: Subject) -> Finding:
    """Compare slopes along random directions and axes with central differences, one row of the table for each step.

    What passes is the agreement at the best step: a median relative error of at most ten times the third root of the
    precision, where central differences are exact to its two thirds. A slope that its loss's noise hides is left out.
    """
    slopes = _slopes(subject)
    if slopes is None:
        return skip("no gradient")
    limit, count = 10 * subject.eps ** (1 / 3), len(slopes[0])
    table = [_step(subject, *slopes, step) for step in DIFFERENCE_STEPS]
    if subject.precision == "float64" and _best(table, limit, count)[1] is False:
        table = [_step(subject, *slopes, step) for step in FINER_STEPS] + table
    best, agrees = _best(table, limit, count)
    if best is None:
        return skip(*NOTHING_TO_COMPARE, table=tuple(table))
    figure = (
        f"in {subject.precision}, best at {best['step']:.0e} of the box: median relative error {best['error']:.1e}, "
        f"sign right {best['sign']:.0%}, cosine {best['cosine']:z.4f}"
    )
    why = f"wanted: error {limit:.0e}, sign right {SIGNS:.0%}"
    return verdict(agrees, figure, why, {**best, "limit": limit}, tuple(table))


def check_usefulness(subject: Subject) -> Finding:
    """Compare the same slopes with differences over a hundredth of the box, which is what an optimiser steps.

    A gradient may be right and yet say nothing of the loss so far away, where it is rugged or jumps: that is a warning
    and no failure, as it is the landscape's and not the gradient's.
    """
    slopes = _slopes(subject)
    if slopes is None:
        return skip("no gradient")
    row = _step(subject, *slopes, OPTIMISER_STEP)
    if (row["compared"] or 0) < LEAST_SHARE * len(slopes[0]):
        return skip(*NOTHING_TO_COMPARE)
    sign, error = _number(row["sign"]), _number(row["error"])
    useful = sign >= SIGNS and error <= USEFUL
    figure = f"over {OPTIMISER_STEP:g} of the box: sign right {sign:.0%}, median relative error {error:.2g}"
    why = f"slopes do not hold that far: wanted are sign right {SIGNS:.0%} and an error of {USEFUL:g} for a search"
    return Finding("", PASS if useful else WARN, figure, "" if useful else why, row)


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


def gradcheck(double: Subject) -> Finding:
    """Hold gradients in float64 against torch's own check, at finer and finer steps until one agrees."""
    if max(double.noise) > 0:
        return skip("not checked", "repeats differ, and a pointwise check would measure that")
    rows = (double.first.status == Status.OK).nonzero().flatten()[:2]
    if not len(rows):
        return skip("not checked", "no point has a gradient")
    room = 2 * GRADCHECK_STEPS[0]  # so that the longest step stays within the box
    function, u = _unit(double), double.objective.space.to_unit(double.x[rows]).clamp(room, 1 - room)
    said = ""
    for step in GRADCHECK_STEPS:
        agreement: dict[str, Any] = {"eps": step, "atol": 1e-4, "rtol": 1e-3, "nondet_tol": torch.inf}
        try:
            torch.autograd.gradcheck(function, (u.clone().requires_grad_(),), fast_mode=True, **agreement)
        except GradcheckError as error:
            said = said or one_line(error)[:160]
        else:
            return verdict(True, f"agrees at {len(rows)} points in float64 over {step:.0e} of the box")
    steps = ", ".join(f"{step:.0e}" for step in GRADCHECK_STEPS)
    return verdict(False, f"disagrees over {steps} of the box", said)


def second_backward(subject: Subject) -> Finding:
    """Go back twice through one graph: the second gradient is the first."""
    u = subject.objective.space.to_unit(subject.x[:2]).requires_grad_()
    total = _unit(subject)(u).nansum()
    first, second = (torch.autograd.grad(total, u, retain_graph=True)[0] for _ in range(2))
    apart = difference(first, second) / size(first)
    figure = f"{apart:.1e} of the largest component apart"
    return within(apart, subject.tolerances[1], figure, "the first backward changes its tape")


def _unit(subject: Subject) -> Callable[[Tensor], Tensor]:
    """Return the objective as a torch function of the unit cube, losses as shares of their range."""
    objective, scale = subject.objective, subject.scale
    return lambda u: objective(objective.space.from_unit(u)) / scale


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


def place_episodes(dim: int) -> int:
    """Return how many losses `check_special_places` takes, at most."""
    return 4 * min(AXES, dim) * 2 * len(PLACE_STEPS)


def check_special_places(subject: Subject) -> Finding:
    """Hold gradients at special places against the slopes to either side, along some axes.

    Random points never meet the centre, parameters that are exactly zero, and corners. A contact that does not slide, a
    distance of zero, a tie: there a rule of differentiation may divide by zero, or choose a branch.

    A gradient is wrong that is outside these slopes over every step from 1e-6 to 1e-3 of the box, by more than a
    twentieth of the larger; where the noise hides them it is left out. A kink is none: one of its slopes is as good.
    """
    space = subject.objective.space
    where = places(space, subject.seed)
    base = torch.stack(list(where.values()))
    here = subject.evaluate(space.from_unit(base))
    if here.grad is None:
        return skip("no gradient")
    if missing := _name_missing(where, here):
        return verdict(False, f"{len(missing)} of {len(where)} places have no gradient", "; ".join(missing))
    generator = torch.Generator().manual_seed(subject.seed)
    axes = torch.randperm(space.dim, generator=generator)[:AXES].sort().values
    exact = (here.grad * (space.upper - space.lower))[:, axes]
    slopes = [_side_slopes(subject, base, here.loss, axes, step) for step in PLACE_STEPS]
    sides = torch.stack(slopes)  # step, side, place, axis
    low, high = sides.amin(dim=1), sides.amax(dim=1)
    largest = torch.maximum(sides.abs().amax(dim=1), exact.abs())
    outside = torch.maximum(low - exact, exact - high) > OUTSIDE_SLOPES * largest
    noise = torch.tensor([subject.blur(here.loss) / step for step in PLACE_STEPS], dtype=torch.float64)
    flat = subject.flat(here.loss)
    seen = sides.isfinite().all(dim=1) & exact.isfinite() & (largest > (CLEAR * noise).clamp(min=flat)[:, None, None])
    wrong = seen.any(dim=0) & (outside | ~seen).all(dim=0)
    if not bool(seen.any()):
        return skip(*NOTHING_TO_COMPARE)
    count = f"{int(seen.any(dim=0).sum())} slopes at {', '.join(where)}"
    if not bool(wrong.any()):
        return verdict(True, f"{count}: between those to either side")
    place, axis = wrong.nonzero()[0].tolist()
    step = int(seen[:, place, axis].nonzero()[0])
    left, right = sides[step, :, place, axis].tolist()
    figure = (
        f"{int(wrong.sum())} of {count} are wrong: at {[*where][place]}, by {space.names[int(axes[axis])]}, the "
        f"gradient is {float(exact[place, axis]):.3g} and the loss rises by {left:.3g} and {right:.3g} to either side"
    )
    numbers: Row = {"wrong": float(wrong.sum()), "compared": float(seen.any(dim=0).sum())}
    return verdict(False, figure, "a gradient has to lie between the slopes to either side", numbers)


def _name_missing(where: Iterable[str], found: Evaluation) -> list[str]:
    """Say at which places the gradient is NaN though the loss is finite."""
    missing = found.status == Status.NO_GRADIENT
    rows = zip(where, found.loss.tolist(), missing.tolist(), strict=True)
    return [f"the gradient is NaN at {place}, where the loss is {loss:.4g}" for place, loss, none in rows if none]


def _side_slopes(
    subject: Subject, base: Tensor, loss: Tensor, axes: Tensor, step: float
) -> Float[Tensor, "2 place axis"]:
    """Return the slopes over one step to either side of each place along each axis [loss unit per side of the box]."""
    space = subject.objective.space
    offset = step * torch.eye(space.dim, dtype=torch.float64)[axes]
    ends = torch.stack([base[:, None] - offset, base[:, None] + offset])
    found = evaluate(subject.objective, space.from_unit(ends.reshape(-1, space.dim)), grad=False).loss
    behind, ahead = found.reshape(2, len(base), len(axes))
    return torch.stack([(loss[:, None] - behind) / step, (ahead - loss[:, None]) / step])


def growth_episodes(horizons: int) -> tuple[int, int]:
    """Return how many losses, and losses with gradients, `check_growth` takes over so many horizons."""
    return horizons * GROWTH_ROWS * 2 * GROWTH_STEPS, horizons * GROWTH_ROWS


def check_growth(subject: Subject, horizons: Mapping[float, Callable[[], Objective]]) -> Finding:
    """Hold |gradient| against the rise of the loss along it, in episodes of several lengths.

    A tape that keeps too little, or a solver's rule of differentiation, may be right for a short episode and grow
    without bounds in a longer one, in which the motion stays tame. Where neighbours part, large gradients are true.

    A gradient is too steep where the loss rises along it by less than a tenth of what it says, over the shortest step
    at which that would be seen, over ten times that step and over 1e-6 of the box, while neighbours stay within a
    hundredth of the losses' range. It fails where most points are too steep at one length. `horizons` makes the
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
    why = f"gradients grow where motions do not part: too steep at {', '.join(said)}"
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
