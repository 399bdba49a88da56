"""Compare the slopes of gradients with differences of losses, by a model of the error of each difference.

A difference over a step h of losses known to +-noise has the error noise / h, plus its truncation error. The next
larger step shows the latter: over a ladder of steps, differences form a plateau, where consecutive ones agree within
both errors. A gradient is wrong if the plateau of the smallest steps differs from it by more than its error. Steps are
fractions of the box, slopes [loss unit per side of the box].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from .probe import EPS, Lines, Probe

STEPS = (1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 3e-1)
BETWEEN_STEPS = (1e-7, 3e-6, 3e-5, 3e-4, 3e-3, 3e-2)  # for slopes that the others leave undecided
FINER_STEPS = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)  # where the gradient says that losses change within the smallest step
TOLERANCE = 5e-3  # relative error of a gradient that is no defect
ROUNDED = 1e3  # times the precision is what rounding makes of a gradient's components
CLEAR = 0.02  # of the larger slope is what the error of a clear plateau is at most
LONGEST_STEP = 0.02  # of the box, whose plateau contradicts a gradient: beyond it curvature looks like one
SMALL, MANY = 0.05, 0.25  # relative disagreement in float32, and the share of lines from which it is believed
UNLIKE, FEWEST_OTHERS = 0.1, 5  # share of other lines, and of their slopes, that differences are off over such steps
LONGER_STEPS, TOLERATED = 3, 1e-6  # steps over which a gradient holds, and by which share of the loss it may fail below
PLATEAU = 0.2  # of the larger is what two differences that agree may be apart
WIDE, HALF, TWICE = 5, 0.5, 2.0  # times a step is the next; then half of the difference is the truncation, else twice
RELIABLE = 0.1  # of the larger of both slopes is what the error of a difference may be, to be judged by
HIGH, HIGH_MARGIN, MOST_MARGIN = 0.9, 1.5, 10  # times this quantile, and at most so many times the median, is the same
NOISE_MARGIN = 3  # times the typical noise is what one difference may show
ROUGH = 100  # times rounding is what losses change between neighbours where they are rough, not rounded
MOST_FINER = 24  # lines, at most, that are walked over finer steps
BEYOND = 10  # times what losses change is what a gradient says where it is too steep to be judged
CURVED = 1.5  # times the second difference that a larger step foresees may be that of a curved loss
SATURATED = 0.02  # of the largest change that of the smallest step is where losses of neighbours have nothing in common
UNEVEN = 0.003  # of what neighbours differ by is what a gradient foresees at most, where that is noise
ROUNDED_BY = 16  # times the spacing of losses is the most that rounding changes them by, in one step
SMALL_GRAIN = 1e-4  # of the box: losses that do not change over longer steps are flat there, and not rounded
FLAT = 1e-6  # of the typical slope along such lines is none


class Kind(StrEnum):
    """The result of comparing the gradient's slope along a line with differences of losses."""

    AGREES = "agrees"
    KINK = "kink"  # slopes to both sides differ, and the gradient is one of them or between
    JUMP = "jump"  # the loss jumps here, and the gradient is the slope to one side
    FLAT = "flat"  # neither shows a slope
    ZERO = "exactly zero"  # the gradient is 0, and losses do not change over the smallest steps
    NOISE = "lost in noise"  # no step shows a slope that could be compared
    STEEP = "too steep to judge"  # losses change by less than the gradient says over the smallest step, and not evenly
    NAN = "NaN"  # the loss is finite, and the gradient is not
    WRONG = "wrong"
    FAILED = "failed"  # there is no loss


BAD = (Kind.WRONG, Kind.NAN)
UNJUDGED = (Kind.NOISE, Kind.STEEP, Kind.FAILED)


class Slope(NamedTuple):
    """A slope by differences: over a step, and its error."""

    step: float
    value: float
    error: float


@dataclass(frozen=True)
class Judgement:
    """The result for a line: the slope by differences, its error and step, and the one-sided slopes.

    `moves`: the loss changes along the line by more than its noise. `limit` is the smallest error that would be found.
    """

    kind: Kind
    exact: float
    slope: Slope | None = None
    behind: Slope | None = None
    ahead: Slope | None = None
    moves: bool = False
    limit: float = np.nan
    noise: float = np.nan


@dataclass(frozen=True, eq=False)
class Ladder:
    """Losses along lines over a ladder of steps: `walked` has shape (2, step, line), ahead first."""

    lines: Lines
    steps: tuple[float, ...]
    walked: Float[Tensor, "2 step line"]
    judged: tuple[Judgement, ...]

    @property
    def axis(self) -> Int[Tensor, " line"]:
        """The parameter that moves most along each line: the only one along an axis."""
        return self.lines.direction.abs().argmax(dim=1)

    def rows(self, *kinds: Kind) -> list[int]:
        """Return the lines of some kinds."""
        return [row for row, one in enumerate(self.judged) if one.kind in kinds]

    def along(self, axis: int) -> list[Judgement]:
        """Return the results of the lines along one parameter."""
        return [self.judged[row] for row in (self.axis == axis).nonzero().flatten().tolist()]

    @property
    def differences(self) -> Float[Tensor, "step line"]:
        """Central differences, one-sided at the ends of the box, NaN where neither exists."""
        steps = torch.tensor(self.steps, dtype=torch.float64)[:, None]
        ahead, behind = (self.walked[0] - self.lines.loss) / steps, (self.lines.loss - self.walked[1]) / steps
        central = (ahead + behind) / 2
        return torch.where(central.isfinite(), central, torch.where(ahead.isfinite(), ahead, behind))

    def on(self, steps: tuple[float, ...]) -> Float[Tensor, "2 step line"]:
        """Return the losses on a ladder of more steps, NaN where not evaluated."""
        walked = torch.full((2, len(steps), len(self.lines)), torch.nan, dtype=torch.float64)
        walked[:, [steps.index(step) for step in self.steps]] = self.walked
        return walked

    def with_kind(self, rows: Sequence[int], kind: Kind) -> Ladder:
        """Return this ladder with a given kind for some of its lines."""
        judged = list(self.judged)
        for row in rows:
            judged[row] = replace(judged[row], kind=kind)
        return replace(self, judged=tuple(judged))


def measure(probe: Probe, lines: Lines, steps: Sequence[float] = STEPS) -> Ladder:
    """Walk along lines over a ladder of steps, and over more where a line stays undecided, and judge them."""
    ladder = _judge(probe, lines, tuple(steps), lines.walk(probe, list(steps)))
    open_ = [one for one, found in enumerate(ladder.judged) if _undecided(found)]
    further = [step for step in BETWEEN_STEPS if step not in steps]
    if open_ and further:
        ladder = _extend(probe, ladder, open_, further)
    rough = [one for one, found in enumerate(ladder.judged) if _needs_finer(found, probe, lines, one, ladder.steps[0])]
    if rough:
        ladder = _extend(probe, ladder, rough[:MOST_FINER], list(FINER_STEPS))
        ladder = ladder.with_kind(rough[MOST_FINER:], Kind.STEEP)
    ladder = _distrust(ladder)
    return _forgive_few(ladder) if probe.single else ladder


def _forgive_few(ladder: Ladder) -> Ladder:
    """Treat few small disagreements in float32 as noise: losses that jump between time steps hide below rounding."""
    wrong = [(row, ladder.judged[row]) for row in ladder.rows(Kind.WRONG)]
    small = [row for row, one in wrong if one.slope is not None and _alike(one.slope.value, one.exact, SMALL)]
    return ladder.with_kind(small, Kind.NOISE) if len(small) < MANY * len(ladder.judged) else ladder


def _distrust(ladder: Ladder) -> Ladder:
    """Let no plateau contradict a gradient at steps where differences fail on other lines, too.

    The noise can be larger than seen. Losses that jump between time steps have slopes below the jumps, which float32
    can miss, and other slopes above.
    """
    differences, distrusted = ladder.differences.numpy(), list[int]()
    agreeing = [(row, ladder.judged[row]) for row in ladder.rows(Kind.AGREES)]
    right = [(row, one.slope.step, one.exact) for row, one in agreeing if one.slope]
    for row in ladder.rows(Kind.WRONG):
        if (one := ladder.judged[row]).slope is None:
            continue
        level = ladder.steps.index(one.slope.step)
        others = [(differences[level, other], exact) for other, step, exact in right if step != one.slope.step]
        off = [not _alike(value, exact, UNLIKE) for value, exact in others if np.isfinite(value)]
        if len(off) >= FEWEST_OTHERS and np.mean(off) > UNLIKE:
            distrusted.append(row)
    return ladder.with_kind(distrusted, Kind.NOISE)


def _alike(one: float, other: float, share: float) -> bool:
    """Return whether two slopes differ by at most a share of the larger."""
    return abs(one - other) <= share * max(abs(one), abs(other))


def _undecided(found: Judgement) -> bool:
    """Return whether more steps could help: no plateau was found, or the contradicting one is unclear."""
    if found.kind != Kind.WRONG or found.slope is None:
        return found.kind in (Kind.NOISE, Kind.STEEP)
    return found.slope.error > CLEAR * max(abs(found.slope.value), abs(found.exact))


def _needs_finer(found: Judgement, probe: Probe, lines: Lines, row: int, smallest: float) -> bool:
    """Return whether a disagreement could come from losses that change within the smallest step."""
    rounding = _rounding(probe.eps, lines, row)
    rough = found.noise > ROUGH * rounding
    return (
        rough and found.kind in (Kind.WRONG, Kind.NOISE, Kind.STEEP) and abs(found.exact) * smallest > ROUGH * rounding
    )


def _rounding(eps: float, lines: Lines, row: int) -> float:
    return eps * abs(float(lines.loss[row]))


def _extend(probe: Probe, ladder: Ladder, rows: Sequence[int], more: Sequence[float]) -> Ladder:
    """Walk along some of the lines over further steps, and judge these again."""
    chosen = torch.tensor(rows)
    part, walked = ladder.lines.rows(chosen), ladder.on(steps := tuple(sorted({*ladder.steps, *more})))
    added = torch.tensor([steps.index(step) for step in more])
    walked[:, added[:, None], chosen[None]] = part.walk(probe, list(more))
    again = _judge(probe, part, steps, walked[:, :, chosen])
    judged = list(ladder.judged)
    for row, found in zip(rows, again.judged, strict=True):
        judged[row] = found
    return Ladder(ladder.lines, steps, walked, tuple(judged))


def _judge(probe: Probe, lines: Lines, steps: tuple[float, ...], walked: Float[Tensor, "2 step line"]) -> Ladder:
    """Judge lines from their losses."""
    loss, slope = lines.loss.numpy(), lines.slope.numpy()
    rounding = _rounding_of(probe, lines)
    usual = _typical_noise(steps, loss, walked.numpy()) + NOISE_MARGIN * probe.repeats
    moved = lines.direction.abs().sum(dim=1).numpy() * float(lines.grad.abs().nan_to_num().max())
    allowed = ROUNDED * probe.eps * lines.parts.numpy() + FLAT * _typical_slope(slope, lines)
    allowed += NOISE_MARGIN * probe.gradient_repeats * moved
    judged, eps = [], probe.eps
    for row in range(len(lines)):
        found = walked[:, :, row].numpy()
        known = np.isfinite(found).any(axis=0)
        numbers = (float(one[row]) for one in (loss, slope, rounding, usual, allowed))
        line = _Line(np.array(steps)[known], found[:, known], eps, *numbers)
        judged.append(Judgement(Kind.NAN, np.nan) if bool(lines.missing[row]) else line.judge())
    return Ladder(lines, steps, walked, tuple(judged))


def _rounding_of(probe: Probe, lines: Lines) -> NDArray[np.float64]:
    """Return the change of each loss by rounding of the loss, and of the point [loss unit]."""
    space = probe.objective.space
    places = (lines.u + space.lower / probe.width).abs() + 1
    parts = torch.where(lines.direction == 0, 0.0, (lines.grad * places).abs()).nan_to_num().sum(dim=1)
    point = EPS["float32"] if probe.precision == "float32" else EPS["float64"]
    found: NDArray[np.float64] = (probe.eps * lines.loss.abs() + point * parts).numpy()
    return found


def _unexplained(
    steps: NDArray[np.float64], walked: NDArray[np.float64], loss: NDArray[np.float64] | float
) -> NDArray[np.float64]:
    """Return half of the second difference over the smallest step, minus the part that the next step explains.

    Second differences of a smooth loss fall as the square of the step, those of a noisy one do not.
    """
    halves = np.abs(walked.sum(axis=0) - 2 * loss) / 2
    curved = CURVED * halves[1] * (steps[0] / steps[1]) ** 2 if len(steps) > 1 else 0.0
    found: NDArray[np.float64] = np.clip(halves[0] - np.nan_to_num(curved), 0.0, None)
    return found


def _typical_noise(
    steps: Sequence[float], loss: NDArray[np.float64], walked: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the typical noise among lines: half of a second difference over the smallest step.

    By size and as a share of the loss: for losses of several decades, and for small differences of large numbers.
    """
    second = _unexplained(np.array(steps), walked, loss)
    known = np.isfinite(second)
    if not known.any():
        return np.zeros(len(loss))
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = (second / np.abs(loss))[known & (loss != 0)]
    usual = _spread_of(second[known])
    share = _spread_of(shares) if len(shares) else 0.0
    found: NDArray[np.float64] = np.minimum(usual, share * np.abs(loss))
    return found


def _spread_of(values: NDArray[np.float64]) -> float:
    """Return an upper limit of nearly all values, estimated from the middle ones and not from a few large ones."""
    middle = float(np.median(values))
    high = HIGH_MARGIN * float(np.quantile(values, HIGH))
    return min(max(high, NOISE_MARGIN * middle), MOST_MARGIN * middle)


def _typical_slope(slope: NDArray[np.float64], lines: Lines) -> NDArray[np.float64]:
    """Return the median |slope| among lines along the same parameter, or among those along several."""
    moved = (lines.direction != 0).sum(dim=1).numpy()
    axis = np.where(moved == 1, lines.direction.abs().argmax(dim=1).numpy(), -1)
    found = np.zeros(len(slope))
    for one in np.unique(axis):
        sizes = np.abs(slope[(axis == one) & np.isfinite(slope)])
        found[axis == one] = np.median(sizes) if len(sizes) else 0.0
    return found


@dataclass(frozen=True, eq=False)
class _Line:
    """One line: losses ahead and behind over steps, smallest first, NaN where there is none."""

    steps: NDArray[np.float64]
    walked: NDArray[np.float64]
    eps: float
    loss: float
    exact: float
    rounding: float
    usual: float
    allowed: float

    @cached_property
    def rises(self) -> NDArray[np.float64]:
        """The rise of losses ahead and behind, shape (2, step)."""
        found: NDArray[np.float64] = self.walked - self.loss
        return found

    @cached_property
    def change(self) -> NDArray[np.float64]:
        """The larger of both changes over each step."""
        found: NDArray[np.float64] = np.fmax(*np.abs(self.rises))
        return found

    @cached_property
    def central(self) -> NDArray[np.float64]:
        """Central differences over each step."""
        ahead, behind = self.rises
        with np.errstate(invalid="ignore"):
            found: NDArray[np.float64] = (ahead - behind) / (2 * self.steps)
        return found

    def judge(self) -> Judgement:
        """Compare the gradient's slope with the plateaus of differences: central ones, and to both sides."""
        if not np.isfinite(self.loss) or not len(self.steps):
            return Judgement(Kind.FAILED, self.exact)
        if not np.isfinite(self.exact):
            return Judgement(Kind.NAN, self.exact)
        (ahead, behind), error = self.rises, self.noise / self.steps
        central = self._plateau(zip(self.steps, self.central, error, strict=True))
        front = self._plateau(zip(self.steps, ahead / self.steps, 2 * error, strict=True))
        back = self._plateau(zip(self.steps, -behind / self.steps, 2 * error, strict=True))
        moves = bool(np.nanmax(self.change) > max(NOISE_MARGIN * self.noise, self.rounding))
        kind, slope = self._compare(central, front, back)
        if kind == Kind.WRONG and slope is not None:
            kind = self._doubt(slope)
        limit = np.nan
        if slope is not None and (size := max(abs(slope.value), abs(self.exact))) > 0:
            limit = self._margin(slope) / size
        return Judgement(kind, self.exact, slope, back, front, moves, limit, self.noise)

    @cached_property
    def noise(self) -> float:
        """The noise of losses at this line.

        It is the typical noise, or half of the second difference over the smallest step. Where losses do not change at
        all over smaller steps, as rounded numbers do, it is the first change.
        """
        moved = np.flatnonzero(self.change > 0)
        first = int(moved[0]) if len(moved) else 0
        grain = float(self.change[first]) if first and self._is_grain() else 0.0
        return max(self.usual, self._unevenness(), grain, self.rounding)

    def _unevenness(self) -> float:
        """Return the unevenness of losses over the smallest step that is not curvature."""
        found = float(_unexplained(self.steps, self.walked, self.loss))
        return found if np.isfinite(found) else 0.0

    def _is_grain(self) -> bool:
        """Return whether the first change along a line comes from rounded losses or points, not from a real step."""
        moved = np.flatnonzero(self.change > 0)
        if not len(moved):
            return False
        first = int(moved[0])
        return bool(self.steps[first] <= SMALL_GRAIN or self.change[first] <= ROUNDED_BY * self.eps * abs(self.loss))

    def _doubt(self, slope: Slope) -> Kind:
        """Return the kind of a gradient that a plateau contradicts: wrong, unless there is doubt about the plateau."""
        if not self._holds(slope):
            return Kind.STEEP if abs(self.exact) > BEYOND * abs(slope.value) else Kind.NOISE
        if slope.step > LONGEST_STEP:
            return Kind.NOISE
        return Kind.AGREES if self._agrees_beyond(slope) else Kind.WRONG

    def _agrees_beyond(self, slope: Slope) -> bool:
        """Return whether the gradient is the slope over longer steps, and below differs less than any solver tolerates.

        Adaptive time steps of a solver make losses uneven there.
        """
        ahead, behind = self.rises
        with np.errstate(invalid="ignore"):
            near = np.abs(self.central - self.exact) <= TOLERANCE * abs(self.exact)
            off = np.fmax(np.abs(ahead - self.exact * self.steps), np.abs(behind + self.exact * self.steps))
        longer = np.flatnonzero(near & (self.steps > slope.step))
        if len(longer) < LONGER_STEPS:
            return False
        return bool(off[: longer[0]].max() <= TOLERATED * max(abs(self.loss), float(np.nanmax(self.change))))

    def _holds(self, slope: Slope) -> bool:
        """Return whether differences over smaller steps agree with a plateau, within their noise."""
        smaller = self.steps < slope.step
        (ahead, behind), steps, central = self.rises[:, smaller], self.steps[smaller], self.central[smaller]
        found = np.where(np.isfinite(central), central, np.where(np.isfinite(ahead), ahead, -behind) / steps)
        allowed = 2 * (2 * self.noise / steps + slope.error) + PLATEAU * abs(slope.value)
        return bool((np.abs(found - slope.value) <= allowed).all())

    def _plateau(self, found: Iterator[tuple[float, float, float]]) -> Slope | None:
        """Return the slope by the smallest steps whose differences agree, refined by larger ones."""
        known = [Slope(*map(float, one)) for one in found if np.isfinite(one[1])]
        best: Slope | None = None
        for small, large in pairwise(known):
            apart = abs(small.value - large.value)
            size = max(abs(small.value), abs(large.value), abs(self.exact))
            error = small.error + apart * (HALF if large.step > WIDE * small.step else TWICE)
            if apart > small.error + large.error + PLATEAU * size or error > RELIABLE * size:
                if best is not None and error <= RELIABLE * size:
                    break
                continue
            if best is None:
                best = Slope(small.step, small.value, error)
            elif small.step > LONGEST_STEP or abs(small.value - best.value) > error + best.error:
                break
            elif error < best.error:
                best = Slope(small.step, small.value, error)
        return best

    def _margin(self, slope: Slope) -> float:
        size = max(abs(slope.value), abs(self.exact))
        return 2 * slope.error + TOLERANCE * size + self.allowed

    def _agrees(self, slope: Slope | None) -> bool:
        return slope is not None and abs(slope.value - self.exact) <= self._margin(slope)

    def _compare(self, central: Slope | None, front: Slope | None, back: Slope | None) -> tuple[Kind, Slope | None]:
        first, noise = float(self.change[0]), self.noise
        if self.exact == 0 and first == 0 and not self._is_grain():
            return Kind.ZERO, central
        if self._agrees(central):
            return Kind.AGREES, central
        if kind := self._one_sided(front, back):
            return kind, central
        if np.nanmax(self.change) <= NOISE_MARGIN * noise and abs(self.exact) * self.steps[-1] <= NOISE_MARGIN * noise:
            return Kind.FLAT, central
        sides = [one for one in (front, back) if one is not None]
        found = central or (min(sides, key=lambda one: one.error) if sides else None)
        if self._is_rough():
            return Kind.STEEP, found
        if found is None:
            flat = abs(self.exact) <= self.allowed and first <= self.allowed * self.steps[0] + NOISE_MARGIN * noise
            return (Kind.FLAT if flat else Kind.NOISE), None
        return Kind.WRONG, found

    def _one_sided(self, front: Slope | None, back: Slope | None) -> Kind | None:
        """Return the kind of a line whose gradient is the slope to one side, or between both."""
        noise = self.noise if np.isfinite(self.noise) else 0.0
        jumps = self.change[0] > BEYOND * noise + BEYOND * abs(self.exact) * self.steps[0]
        if front is not None and back is not None:
            low, high = sorted((front, back), key=lambda one: one.value)
            apart = high.value - low.value > low.error + high.error
            within = low.value - self._margin(low) <= self.exact <= high.value + self._margin(high)
            return Kind.KINK if apart and within else None
        if self._agrees(front) or self._agrees(back):
            missing = self.walked[1 if front else 0, 0]
            return Kind.JUMP if jumps and np.isfinite(missing) else Kind.KINK if np.isfinite(missing) else Kind.AGREES
        return None

    def _is_rough(self) -> bool:
        """Return whether losses change unevenly over the smallest step, where the gradient predicts more."""
        change, next_ = self.change, min(1, len(self.steps) - 1)
        saturated = (
            change[0] > SATURATED * np.nanmax(change) and abs(self.exact) * self.steps[0] > SATURATED * change[0]
        )
        uneven, steepness = max(self.usual, self._unevenness()), change[next_] / self.steps[next_]
        rounding = self.eps * (abs(self.loss) + float(steepness))
        rough = uneven > ROUGH * rounding and abs(self.exact) * self.steps[0] > UNEVEN * uneven
        return bool(rough or saturated)


def counts(judged: Sequence[Judgement]) -> dict[Kind, int]:
    """Count lines by kind."""
    kinds = [one.kind for one in judged]
    return {kind: kinds.count(kind) for kind in Kind}


def directions(
    dim: int, u: Float[Tensor, "line dim"], sensitivity: Float[Tensor, " dim"], seed: int
) -> Float[Tensor, "line dim"]:
    """Draw a direction through each point, all parameters at once, into the box, with no component above one.

    In every other direction, parameters with a strong effect on the loss move less, so that all count alike.
    """
    generator = torch.Generator().manual_seed(seed)
    signs = torch.randint(0, 2, u.shape, generator=generator, dtype=torch.float64) * 2 - 1
    signs = torch.where(u < 0.3, 1.0, torch.where(u > 0.7, -1.0, signs))
    sizes = 0.5 + 0.5 * torch.rand(u.shape, generator=generator, dtype=torch.float64)
    live = sensitivity[sensitivity > 0]
    if len(live) and dim > 1:
        weight = torch.where(sensitivity > 0, float(live.median()) / sensitivity.clamp(min=1e-300), 1.0)
        sizes[1::2] *= weight.clamp(1e-3, 1e3) / weight.clamp(1e-3, 1e3).max()
    return signs * sizes
