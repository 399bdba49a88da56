"""Discontinuities of a loss: jumps between neighbouring samples that do not vanish on a finer look.

A jump counts from a fixed part of the range on, whatever the samples are. Its trace is a difference between two
neighbours that neither their gradients nor the differences around it explain. Every line of a slice, row or column, is
in one of three states before anything is evaluated or drawn:

- it has no trace of half a jump: the samples clear it;
- its strongest trace is among the strongest of the slice: all of these are looked into;
- neither: some of these lines are drawn at random, and every trace on them is looked into. That gives the interval of
  the share of lines that cross a jump, and the power of a search that finds none.

A trace is bisected towards the larger unexplained difference: a jump keeps its height, a slope loses half of it every
time. What is left must be apart by more than the losses on either side of it vary among themselves, so that neither
noise nor a fractal surface jumps.
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
from ..statistics import CONFIDENCE, Estimate, Values, share
from .ruggedness import box_slopes, span

LEAST = 0.01  # of the slice's range, from which on a difference is a jump
HALVINGS = 12  # a gap between samples is looked into down to 1/4096 of it
SIDES = (1, 2, 4, 8)  # widths of what is left of a gap, at which both sides of it are evaluated
EVALUATIONS_PER_PAIR = 2 + HALVINGS + 2 * len(SIDES)  # at most
APART = 2  # times what the losses vary on one side of a jump is its height at least
GUIDED = 1 / 2  # of the pairs that are looked into are those with the strongest traces
AROUND = (-2, -1, 1, 2)  # neighbouring differences along a line whose median explains one
Count = Callable[[Tensor], Mapping[str, Tensor]]


@dataclass(frozen=True)
class Jump:
    """Hold where a jump is [plane units] and its height [loss unit].

    `event` says whether some event happens more or less often on its other side, None where the objective counts none.
    """

    place: tuple[float, ...]
    height: float
    event: bool | None


@dataclass(frozen=True)
class Jumps:
    """Hold the jumps of a slice that were `found`, the highest first, and how many of its lines cross one.

    A jump is at least `least` high [loss unit], and the losses have a `range`. Of the slice's `lines`, its rows and
    columns, `crossed` cross a found jump. So many are `settled`: without chance, by the samples or by what their
    strongest traces led to. Of the others `drawn` were looked into, and `hit` of these cross a jump. In all `checked`
    pairs of neighbours were looked into, of which `undecided` could not be, as an evaluation there failed.
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
    checked: int
    undecided: int
    evaluations: int

    @property
    def share(self) -> Estimate:
        """Share of the lines that cross a jump; no interval where every line was looked into."""
        if not self.lines:
            return Estimate(math.nan, math.nan, math.nan)
        sure, others = self.crossed - self.hit, self.lines - self.settled
        if self.drawn == others:
            return Estimate(*(self.crossed / self.lines,) * 3)
        rest = share(self.hit, self.drawn) if self.drawn else Estimate(math.nan, 0.0, 1.0)
        value, low, high = ((sure + others * part) / self.lines for part in (rest.value, rest.low, rest.high))
        return Estimate(self.crossed / self.lines if math.isnan(value) else value, low, high)

    @property
    def unseen(self) -> float:
        """Share of the lines that could have a jump though none was found: the upper end of one-sided 95 %."""
        if not self.lines or self.crossed:
            return math.nan
        others = self.lines - self.settled
        if self.drawn == others:
            return 0.0
        return others / self.lines * (1 - (1 - CONFIDENCE) ** (1 / self.drawn) if self.drawn else 1.0)

    @property
    def largest(self) -> float:
        """The height of the highest jump over the range of the losses, 0 where none was found."""
        return self.found[0].height / self.range if self.found else 0.0

    @property
    def explained_by_events(self) -> Estimate | None:
        """Share of the jumps across which an event is counted differently, None where there is no jump or no event."""
        explained = [jump.event for jump in self.found]
        return share(sum(map(bool, explained)), len(explained)) if explained and None not in explained else None

    @property
    def sentence(self) -> str:
        """Say how high jumps are and how many lines cross one, or how many could have one that was not found."""
        part = 100 * self.least / self.range if self.range > 0 else math.nan
        if not self.found:
            said = f"none of {part:.2g} % of the range or more" if part <= 100 else "none above the noise"
            unseen = f"; up to {math.ceil(100 * self.unseen)} % of lines could have one" if self.unseen > 0 else ""
            return said + unseen
        value, low, high = (round(100 * part) for part in (self.share.value, self.share.low, self.share.high))
        interval = f" ({low} to {high})" if low < high else ""
        return f"jumps up to {100 * self.largest:.2g} % of the range; {value} %{interval} of lines cross one"
