"""Discontinuities of a loss: jumps between neighbouring samples that remain at a finer resolution.

A jump counts from a fixed part of the range, whatever the resolution. Its trace is a difference between two neighbours
that neither their gradients nor the differences around it explain. Every line of a slice, row or column, is in one of
three states before anything is evaluated or drawn:

- It has no trace of half a jump: the samples clear it.
- Its strongest trace is among the strongest of the slice, which are examined, and is a jump.
- Neither. Some of these lines are drawn at random. That gives the interval of the share of lines that cross a jump.
  If no trace of the drawn lines is a jump, it gives the power of the search.

A trace is bisected towards the larger unexplained difference: a jump keeps its height, a slope loses half of it each
time. The remaining difference must exceed the variation of the losses on either side, so that neither noise nor a
fractal surface jumps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..identity import plane_of
from ..objective import Objective, evaluate
from ..plane import Plane
from ..statistics import UNKNOWN, Estimate, Values, share, upper_bound
from .ruggedness import lines_along, losses_of, span, step_slopes

LEAST = 0.01  # of the slice's range, from which on a difference is a jump
HALVINGS = 12  # a gap between samples is looked into down to 1/4096 of it
ALIKE = 3  # halvings running in which both halves change alike, after which it is a slope
SIDES = (1, 2, 4, 8, 16, 32)  # widths of what is left of a gap, at which both sides of it are evaluated
EVALUATIONS_PER_PAIR = 2 + HALVINGS + 2 * (1 + len(SIDES))  # at most
APART = 2  # times what the losses vary on one side of a jump is its height at least
GUIDED = 1 / 2  # of the pairs that are looked into are those with the strongest traces
BELIEVED = 2  # times the differences here and around is what gradients that explain one say at most
AROUND = (-2, -1, 1, 2)  # neighbouring differences along a line whose median explains one
Count = Callable[[Tensor], Mapping[str, Tensor]]


@dataclass(frozen=True)
class Jump:
    """The position of a jump [plane units] and its height [loss unit].

    `event`: whether some event happens more or less often on its other side, None where the objective counts none.
    """

    place: tuple[float, ...]
    height: float
    event: bool | None


@dataclass(frozen=True)
class Jumps:
    """The jumps `found` in a slice, the highest first, and how many of its lines cross one.

    A jump is at least `least` high [loss unit], and the losses have a `range`. Of the slice's `lines`, its rows and
    columns, `crossed` cross a found jump. `settled` lines are decided without chance, by the samples or by their
    strongest traces. Of the others, `drawn` were drawn at random: `hit` of these cross a jump, and `clear` have none.
    In total `checked` pairs of neighbours were examined; `undecided` of them could not be, because an evaluation failed
    there.
    """

    derived: ClassVar = ("share", "unseen", "largest", "explained_by_events", "sentence")

    found: tuple[Jump, ...]
    least: float
    range: float
    lines: int
    crossed: int
    settled: int
    drawn: int
    hit: int
    clear: int
    checked: int
    undecided: int
    evaluations: int

    @property
    def share(self) -> Estimate:
        """Share of the lines that cross a jump; drawn lines that are neither hit nor clear are undecided."""
        if not self.lines:
            return UNKNOWN
        others, most = self.lines - self.settled, self.drawn - self.clear
        if self.drawn == others:  # no chance is left
            rest = Estimate(self.hit, self.hit, most)
        elif self.drawn:
            low, high = share(self.hit, self.drawn), share(most, self.drawn)
            rest = Estimate(others * low.value, others * low.low, others * high.high)
        else:
            rest = Estimate(0, 0, others)
        parts = (self.crossed - self.hit + part for part in (rest.value, rest.low, rest.high))
        return Estimate(*(part / self.lines for part in parts))

    @property
    def unseen(self) -> float:
        """Share of the lines that could have a jump although none was found: a one-sided 95 % bound."""
        if not self.lines or self.crossed:
            return math.nan
        others, unknown = self.lines - self.settled, self.drawn - self.clear
        if self.drawn == others:
            return unknown / self.lines
        return others / self.lines * upper_bound(unknown, self.drawn)

    @property
    def largest(self) -> float:
        """The height of the highest jump over the range of the losses, 0 where none was found."""
        return self.found[0].height / self.range if self.found else 0.0

    @property
    def explained_by_events(self) -> Estimate | None:
        """Share of the jumps across which an event count changes, None where there is no jump or no event."""
        explained = [jump.event for jump in self.found]
        return share(sum(map(bool, explained)), len(explained)) if explained and None not in explained else None

    @property
    def sentence(self) -> str:
        """Give the height of jumps and the share of lines that cross one, or that could have an undetected one."""
        if not self.found:
            part = self.least / self.range if self.range > 0 else math.inf
            said = f"none of {_percent(part)} of the range or more" if part < 1 else "none above the noise"
            unseen = f"; up to {math.ceil(100 * self.unseen)} % of lines could have one" if self.unseen > 0 else ""
            return said + unseen
        value, low, high = (round(100 * part) for part in (self.share.value, self.share.low, self.share.high))
        known = self.drawn == self.hit + self.clear and (self.drawn or self.settled == self.lines)
        interval = f"{low} to {high} %" if not known else f"{value} %" + (f" ({low} to {high})" if low < high else "")
        return f"jumps up to {_percent(self.largest)} of the range; {interval} of lines cross one"


def _percent(part: float) -> str:
    return f"{100 * part:.0f} %" if part >= 0.0995 else f"{100 * part:.2g} %"


def find_jumps(
    objective: Objective,
    datasets: Sequence[xr.Dataset],
    *,
    least: Sequence[float] | None = None,
    most: int = 64,
    seed: int = 0,
    events: Count | None = None,
) -> list[Jumps]:
    """Search for jumps between neighbouring samples of slices, by new evaluations of all slices in one batch.

    A jump is at least `LEAST` of its slice's range, and at least the slice's floor in `least` [loss unit], by default
    0. At most `most` pairs of a slice are examined: first those with the strongest traces, then those of lines drawn at
    random.
    """
    floors = [0.0] * len(datasets) if least is None else least
    slices = [_Search(*one, most, seed) for one in zip(datasets, floors, strict=True)]
    for choose in (_Search.strongest, _Search.draw):
        _look(objective, slices, [choose(one) for one in slices])
    return [one.conclude(events) for one in slices]


UNSEEN, FAILED, NO_JUMP, JUMP = range(4)  # what is known of a trace


class _Search:
    """The traces of jumps in a slice: pairs of neighbours with an unexplained difference.

    `ends` are their positions [plane units], shape (trace, end, rank), `trend` is the explained part of their
    difference [loss unit], `line` the number of their row or column. The strongest come first.
    """

    def __init__(self, dataset: xr.Dataset, floor: float, most: int, seed: int) -> None:
        loss = losses_of(dataset)
        self.plane, self.range, self.most = plane_of(dataset), float(np.nan_to_num(span(loss))), most
        self.least = max(float(floor), LEAST * self.range)
        self.generator = np.random.default_rng(seed)
        self._find_traces(loss, step_slopes(dataset) if "grad" in dataset else None)
        self.low, self.high = self.ends[:, 0].copy(), self.ends[:, 1].copy()
        self.state, self.height = np.full(len(self.line), UNSEEN, np.int8), np.zeros(len(self.line))
        self.open = self.drawn = np.zeros(0, np.intp)
        self.evaluations = 0

    def _find_traces(self, loss: Values, slopes: Values | None) -> None:
        axes = [axis.numpy() for axis in self.plane.axes()]
        places = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], axis=-1)
        found, self.lines = list[tuple[Values, Values, Values, NDArray[np.intp]]](), 0
        for axis in range(loss.ndim):
            rows, at = (lines_along(values, axis, loss.ndim) for values in (loss, places))
            slope = None if slopes is None else lines_along(slopes[..., axis], axis)
            difference = np.diff(rows, axis=1)
            trend = _trend(difference, slope)
            trace = np.abs(difference - trend)
            line, step = np.nonzero((trace >= self.least / 2) & (trace > 0))
            known = np.isfinite(difference).any(axis=1)
            number = self.lines + np.cumsum(known)[line] - 1
            ends = np.stack([at[line, step], at[line, step + 1]], axis=1)
            found.append((trace[line, step], ends, trend[line, step], number))
            self.lines += int(known.sum())
        trace, ends, trend, number = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.argsort(-trace, kind="stable")
        self.ends, self.trend, self.line = ends[order], trend[order], number[order]

    def strongest(self) -> NDArray[np.intp]:
        """Return the pairs with the strongest traces, one of each line before a second one of any."""
        whole = len(self.line) <= self.most or self.lines == 1
        return self._first(np.arange(len(self.line)), self.most if whole else round(GUIDED * self.most))

    def draw(self) -> NDArray[np.intp]:
        """Draw undecided lines, and return the pairs to examine there.

        If jumps were found, that is the strongest trace of as many lines as possible, because it will be another jump.
        Otherwise it is all traces of fewer lines.
        """
        unseen = self.state == UNSEEN
        pending = np.unique(self.line[unseen | (self.state == FAILED)])
        self.open = np.setdiff1d(pending, self.line[self.state == JUMP])
        order = self.generator.permutation(self.open)
        left = self.most - int((~unseen).sum())
        each = np.bincount(self.line[unseen], minlength=self.lines)[order]
        self.drawn = order[:left] if (self.state == JUMP).any() else order[np.cumsum(each) <= left]
        if len(self.drawn):
            return self._first(np.flatnonzero(unseen & np.isin(self.line, self.drawn)), left)
        return np.sort(self.generator.permutation(np.flatnonzero(unseen))[:left])  # no line fits: traces at random

    def _first(self, pairs: NDArray[np.intp], most: int) -> NDArray[np.intp]:
        """Return this many pairs: the strongest of each line, then the second of each, and so on."""
        place = np.zeros(len(pairs), int)
        by_line = np.argsort(self.line[pairs], kind="stable")
        starts = np.flatnonzero(np.diff(self.line[pairs][by_line], prepend=-1))
        place[by_line] = np.arange(len(pairs)) - np.repeat(starts, np.diff(starts, append=len(pairs)))
        return pairs[np.sort(np.argsort(place, kind="stable")[:most])]

    def conclude(self, events: Count | None) -> Jumps:
        """Return the found jumps, and the states of the lines."""
        found = np.flatnonzero(self.state == JUMP)
        found = found[np.argsort(-self.height[found], kind="stable")]
        low, high = (torch.from_numpy(one[found]) for one in (self.low, self.high))
        counted = _differ(events, self.plane.lift(low), self.plane.lift(high)) if events and len(found) else None
        each = [None] * len(found) if counted is None else counted.tolist()
        places = ((low + high) / 2).tolist()
        crossed = np.unique(self.line[found])
        unclear = np.union1d(self.line[self.state != NO_JUMP], crossed)
        return Jumps(
            found=tuple(map(Jump, map(tuple, places), self.height[found].tolist(), each)),
            least=self.least,
            range=self.range,
            lines=self.lines,
            crossed=len(crossed),
            settled=self.lines - len(self.open),
            drawn=len(self.drawn),
            hit=len(np.intersect1d(self.drawn, crossed)),
            clear=len(np.setdiff1d(self.drawn, unclear)),
            checked=int((self.state != UNSEEN).sum()),
            undecided=int((self.state == FAILED).sum()),
            evaluations=self.evaluations,
        )


def _trend(difference: Float[Values, "line step"], slope: Float[Values, "line sample"] | None) -> Values:
    """Return the explained differences along lines: by the gradients around, or else by the median difference around.

    `slope` is the derivative by a step. The prediction is the trapezoid of both ends or the cubic through four samples,
    whichever is nearer, unless it exceeds twice the change of the losses here and around.
    """
    padded, count = np.pad(difference, ((0, 0), (2, 2)), constant_values=np.nan), difference.shape[1]
    around = np.sort(np.stack([padded[:, 2 + off : 2 + off + count] for off in AROUND]), axis=0)  # NaN comes last
    known = np.isfinite(around).sum(axis=0)
    middle = [np.take_along_axis(around, np.maximum(at, 0)[None], axis=0)[0] for at in ((known - 1) // 2, known // 2)]
    trend = np.where(known > 0, (middle[0] + middle[1]) / 2, 0.0)
    largest = np.maximum(np.abs(difference), np.nan_to_num(np.abs(around)).max(axis=0))
    with np.errstate(over="ignore", invalid="ignore"):  # gradients may be as large as numbers are
        for nearer, told in enumerate(() if slope is None else _integrals(slope)):
            believed = np.abs(told) <= BELIEVED * largest
            if nearer:
                believed &= np.abs(difference - told) < np.abs(difference - trend)
            trend = np.where(believed, told, trend)
    return trend


def _integrals(slope: Float[Values, "line sample"]) -> tuple[Values, Values]:
    """Return the integrals of derivatives over each step, linear and cubic between samples."""
    linear = (slope[:, :-1] + slope[:, 1:]) / 2
    if slope.shape[1] < 3:
        return linear, linear
    first, last = (3 * (near - middle) + far for near, middle, far in (slope[:, :3].T, slope[:, :-4:-1].T))
    wide = np.concatenate([first[:, None], slope, last[:, None]], axis=1)
    return linear, (13 * (wide[:, 1:-2] + wide[:, 2:-1]) - wide[:, :-3] - wide[:, 3:]) / 24


def _look(objective: Objective, slices: Sequence[_Search], chosen: Sequence[NDArray[np.intp]]) -> None:
    """Examine pairs of all slices, given by their numbers: bisect them, and compare both sides of the remaining step.

    The results of a pair are stored in its slice: its last ends, its state and its height.
    """
    several = list(zip(slices, chosen, strict=True))
    owner = np.repeat(np.arange(len(slices)), [len(pairs) for pairs in chosen])
    asked = _Batch(objective, [one.plane for one in slices], owner)
    ends, trend = (np.concatenate([getattr(one, name)[pairs] for one, pairs in several]) for name in ("ends", "trend"))
    least = np.array([one.least for one in slices])[owner]
    low, high, open_, failed = _bisect(asked, ends, trend, least)
    reach = np.array([0, *SIDES])[:, None] * (high - low)[:, None]
    sides = np.stack([low[:, None] - reach, high[:, None] + reach], axis=1)  # (pair, side, place, rank)
    around = asked.losses(np.clip(sides, ends.min(axis=1)[:, None, None], ends.max(axis=1)[:, None, None]), open_)
    failed |= open_ & ~np.isfinite(around).all(axis=(1, 2))
    height = np.abs(np.diff(np.median(around, axis=-1), axis=1))[:, 0]
    within = np.ptp(around, axis=-1).max(axis=1)
    jump = open_ & ~failed & (height >= least) & (height > APART * within)
    state = np.where(failed, FAILED, np.where(jump, JUMP, NO_JUMP)).astype(np.int8)
    for number, (one, pairs) in enumerate(several):
        at = owner == number
        one.low[pairs], one.high[pairs], one.state[pairs], one.height[pairs] = low[at], high[at], state[at], height[at]
        one.evaluations += int(asked.counts[number])


def _bisect(
    asked: _Batch, ends: Float[Values, "pair end rank"], trend: Float[Values, " pair"], least: Float[Values, " pair"]
) -> tuple[Values, Values, NDArray[np.bool_], NDArray[np.bool_]]:
    """Halve pairs towards the larger unexplained difference; return their last ends, which persist, which failed.

    A pair is dropped if neither half has half a jump, or if both halves change alike for the third time in a row. A
    jump is in one of them, and only steps in a regular row are alike so often.
    """
    low, high = ends[:, 0], ends[:, 1]
    below, above = asked.losses(ends, np.ones(len(ends), bool)).T  # again: a slice may come from another device
    failed = ~np.isfinite(above - below)
    open_, alike = np.abs(above - below - trend) >= least / 2, np.zeros(len(ends), int)
    for _ in range(HALVINGS):
        middle, trend = (low + high) / 2, trend / 2
        between = asked.losses(middle, open_)
        failed |= open_ & ~np.isfinite(between)
        gaps = np.abs(between - below - trend), np.abs(above - between - trend)
        alike = np.where(np.abs(above + below - 2 * between) < least / 2, alike + 1, 0)
        left, right = open_ & (gaps[0] >= gaps[1]), open_ & (gaps[0] < gaps[1])
        high, above = np.where(left[:, None], middle, high), np.where(left, between, above)
        low, below = np.where(right[:, None], middle, low), np.where(right, between, below)
        open_ &= (np.maximum(*gaps) >= least / 2) & (alike < ALIKE)
    return low, high, open_, failed


class _Batch:
    """Evaluate positions of pairs on several planes in one batch, and count them by plane.

    `owner` is the number of each pair's plane, ascending.
    """

    def __init__(self, objective: Objective, planes: Sequence[Plane], owner: NDArray[np.intp]) -> None:
        self.objective, self.planes, self.owner = objective, planes, owner
        self.counts = np.zeros(len(planes), int)

    def losses(self, u: Float[Values, "pair *places rank"], wanted: NDArray[np.bool_]) -> Values:
        """Return the losses of some of the pairs, shape (pair, *places), NaN for the others.

        An engine that compiles for each size of batch evaluates all of them.
        """
        found = np.full(u.shape[:-1], np.nan)
        rows = np.ones_like(wanted) if self.objective.own_programs else wanted
        if wanted.any():
            numbers = np.unique(self.owner[rows])
            parts = [(self.planes[one], u[rows & (self.owner == one)].reshape(-1, u.shape[-1])) for one in numbers]
            x = torch.cat([plane.lift(torch.from_numpy(part)) for plane, part in parts])
            found[rows] = evaluate(self.objective, x, grad=False).loss.numpy().reshape(found[rows].shape)
            self.counts += np.bincount(self.owner[rows], minlength=len(self.planes)) * math.prod(u.shape[1:-1])
        return np.where(wanted.reshape(-1, *(1,) * (found.ndim - 1)), found, np.nan)


def _differ(events: Count, low: Float[Tensor, "jumps dim"], high: Float[Tensor, "jumps dim"]) -> Tensor | None:
    before, after = events(low), events(high)
    if not before:
        return None
    return torch.stack([before[name].cpu() != after[name].cpu() for name in before]).any(dim=0)
