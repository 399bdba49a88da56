"""Judge functions of known character at seven resolutions, to test whether words are right and stable.

    python -m benchmarks.words [NAME ...] [--resolutions 12 16 24 32 48 96 192] [--samples-only]

Each function lists its allowed words; any other is wrong. It also lists the words required at 96 x 96 and more samples.
A word changes if two resolutions that both resolve it disagree. The thresholds of the words were chosen on the
functions with even numbers; those with odd numbers were examined last.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import torch
from torch import Tensor

import gradscape as gs
from gradscape.landscapes.measures import verdict as words
from gradscape.landscapes.measures.discontinuities import Jumps
from gradscape.landscapes.measures.following import BIASED, EXPLODING, OPPOSITE, WORD_OF, ZERO
from gradscape.landscapes.measures.noise import noise
from gradscape.landscapes.measures.surface import EXTREME, RUGGED, SMOOTH, VERY_SMOOTH
from gradscape.landscapes.measures.verdict import Verdict
from gradscape.landscapes.objective import Evaluation, Objective, Status

RESOLUTIONS = (12, 16, 24, 32, 48, 96, 192)
FINE = 96  # samples along a side from which on the expected words have to be said
ROWS = 4096  # of points evaluated at once
GOOD, LOOSE, NOT = WORD_OF.values()
FLATS, JUMPS = words.LARGE_FLAT, words.DISCONTINUOUS
Loss = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Known:
    """A function with a known character: its allowed words (`may`), and its required ones (`must`).

    Its box is a square from `low` to `high`. `slope` makes its gradient where that is not the loss's own, `noise` [loss
    unit] is the deviation of added independent draws, and `fails` marks where it has no loss.
    """

    name: str
    loss: Loss
    may: frozenset[str]
    must: frozenset[str]
    low: float = -1.0
    high: float = 1.0
    slope: Callable[[Tensor, Tensor], Tensor] | None = None
    noise: float = 0.0
    fails: Callable[[Tensor], Tensor] | None = None


class KnownObjective(Objective):
    """Evaluate a known function and its gradient by points in rows."""

    beyond_box = True

    def __init__(self, known: Known) -> None:
        self.known, self.name = known, known.name.replace(" ", "-")
        self.space = gs.ParameterSpace.box(("x", "y"), known.low, known.high)
        self.generator = torch.Generator().manual_seed(0)

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if requested."""
        parts = [self._rows(rows, grad=grad) for rows in torch.split(x, ROWS)]
        return Evaluation.join(parts, dim=2, grad=grad)

    def _rows(self, x: Tensor, *, grad: bool) -> Evaluation:
        x = x.detach().double().requires_grad_(grad)
        loss, slope = self.known.loss(x), None
        if grad:
            (slope,) = torch.autograd.grad(loss.sum() + 0 * x.sum(), x)
            slope = self.known.slope(x.detach(), slope) if self.known.slope else slope
        loss = loss.detach()
        if self.known.noise:
            loss = loss + self.known.noise * torch.randn(len(x), generator=self.generator, dtype=torch.float64)
        fails = self.known.fails(x.detach()) if self.known.fails else torch.zeros(len(x), dtype=torch.bool)
        return Evaluation.from_results(loss, slope, torch.where(fails, Status.ERROR, Status.OK))


def judge(known: Known, resolution: int, *, samples_only: bool = False) -> Verdict:
    """Sample a known function, and describe it in words."""
    objective = KnownObjective(known)
    dataset = gs.sample(
        objective, gs.Plane.through(objective.space, objective.space.center, (0, 1), resolution=resolution)
    )
    x = objective.space.uniform(16, seed=1)
    deviation = noise(objective, x, rounding=2.0**-52).deviation
    if samples_only:
        return words.judge_samples(dataset, deviation=deviation)
    return words.judge(objective, [dataset], deviation=deviation)[0]


def _radius(x: Tensor) -> Tensor:
    return (x.square().sum(dim=1) + 1e-12).sqrt()


def _turned(x: Tensor, degrees: float) -> Tensor:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return x @ torch.tensor([[c, -s], [s, c]], dtype=torch.float64)


def _bowl(x: Tensor) -> Tensor:
    return x.square().sum(dim=1)


def _turned_bowl(x: Tensor) -> Tensor:
    turned = _turned(x, 30)
    return turned[:, 0] ** 2 + 1000 * turned[:, 1] ** 2


def _ripples(height: float, length: float) -> Loss:
    return lambda x: _bowl(x) + height * (2 * math.pi * x / length).cos().sum(dim=1)


def _rounded(x: Tensor) -> Tensor:
    return (1e4 + 1e-3 * x.sum(dim=1).sin()).float().double() + 0 * x.sum(dim=1)


def _rosenbrock(x: Tensor) -> Tensor:
    return (1 - x[:, 0]) ** 2 + 100 * (x[:, 1] - x[:, 0] ** 2) ** 2


def _himmelblau(x: Tensor) -> Tensor:
    return (x[:, 0] ** 2 + x[:, 1] - 11) ** 2 + (x[:, 0] + x[:, 1] ** 2 - 7) ** 2


def _branin(x: Tensor) -> Tensor:
    u, v = 15 * x[:, 0] - 5, 15 * x[:, 1]
    return (v - 5.1 / (4 * math.pi**2) * u**2 + 5 / math.pi * u - 6) ** 2 + 10 * (1 - 1 / (8 * math.pi)) * u.cos() + 10


def _rastrigin(x: Tensor) -> Tensor:
    return (x**2 - 10 * (2 * math.pi * x).cos() + 10).sum(dim=1)


def _ackley(x: Tensor) -> Tensor:
    far = -20 * (-0.2 * (x.square().mean(dim=1) + 1e-12).sqrt()).exp()
    return far - ((2 * math.pi * x).cos().mean(dim=1)).exp() + 20 + math.e


def _levy(x: Tensor) -> Tensor:
    w = 1 + (x - 1) / 4
    first = (math.pi * w[:, 0]).sin() ** 2 + (w[:, 0] - 1) ** 2 * (1 + 10 * (math.pi * w[:, 0] + 1).sin() ** 2)
    return first + (w[:, 1] - 1) ** 2 * (1 + (2 * math.pi * w[:, 1]).sin() ** 2)


def _brownian(hurst: float, seed: int) -> Loss:
    """Return a surface whose differences grow like the distance to the power `hurst`, down to 1/16384 of the box.

    A sum of plane waves, 48 in random directions for each octave of their frequency, with amplitudes falling like its
    power.
    """
    generator = torch.Generator().manual_seed(seed)
    octaves, each = 14, 48
    power = torch.arange(octaves).repeat_interleave(each) + torch.rand(octaves * each, generator=generator)
    angle, phase = (2 * math.pi * torch.rand(octaves * each, generator=generator).double() for _ in range(2))
    frequency = 0.5 * 2.0 ** power.double()  # in cycles over a unit, half of the box
    waves = 2 * math.pi * torch.stack([angle.cos(), angle.sin()]) * frequency
    amplitude = frequency**-hurst
    return lambda x: (x @ waves + phase).cos() @ amplitude


def _weierstrass(x: Tensor) -> Tensor:
    """Return the sum of Weierstrass's functions of both parameters, of exponent 1/2."""
    powers = 2.0 ** torch.arange(14, dtype=torch.float64)
    return ((math.pi * x[..., None] * powers).cos() * powers**-0.5).sum(dim=(1, 2))


def _fault(part: float, *, curved: bool = False) -> Loss:
    """Return a bowl with a step of this part of its range, along a line at an angle or along a circle."""
    height = 2 * part / (1 - min(part, 0.5))

    def loss(x: Tensor) -> Tensor:
        beyond = _radius(x - 0.3) - 0.63 if curved else x[:, 0] + 0.37 * x[:, 1] - 0.113
        return _bowl(x) + height * (beyond > 0)

    return loss


def _spiral(x: Tensor) -> Tensor:
    angle = torch.atan2(x[:, 1], x[:, 0] + 1e-12)
    radius = _radius(x)
    return radius.square() * (1 + 0.5 * (8 * math.pi * radius - angle).cos())


def _needles(count: int, width: float) -> Loss:
    """Return a bowl with this many narrow holes, as deep as its range, at random points."""
    places = 1.8 * torch.rand(count, 2, generator=torch.Generator().manual_seed(4)).double() - 0.9

    def loss(x: Tensor) -> Tensor:
        far = (x[:, None, :] - places).square().sum(dim=2)
        return _bowl(x) - 2 * (-far / (2 * width**2)).exp().sum(dim=1)

    return loss


def _stairs(steps: int) -> Loss:
    return lambda x: ((x[:, 0] + 1.003) / 2 * steps).floor() / steps + 0 * x.sum(dim=1)


def _plateau(x: Tensor) -> Tensor:
    return -torch.relu(0.5 - x.square().sum(dim=1))


def _no_slope(x: Tensor, slope: Tensor) -> Tensor:
    return torch.zeros_like(slope)


def _random_slope(x: Tensor, slope: Tensor) -> Tensor:
    mixed = torch.frac((x * torch.tensor([12989.8, 78233.1])).sum(dim=1).sin() * 43758.5453) * 2 * math.pi
    return torch.stack([mixed.cos(), mixed.sin()], dim=1) * slope.norm(dim=1, keepdim=True)


def _loose_slope(x: Tensor, slope: Tensor) -> Tensor:
    """Turn gradients by up to 70 degrees to either side: their mean cosine is 0.77."""
    mixed = torch.frac((x * torch.tensor([12989.8, 78233.1])).sum(dim=1).sin() * 43758.5453) * 70 * math.pi / 180
    across = torch.stack([-slope[:, 1], slope[:, 0]], dim=1)
    return slope * mixed.cos()[:, None] + across * mixed.sin()[:, None]


def _exploding_slope(x: Tensor, slope: Tensor) -> Tensor:
    chosen = torch.frac((x * torch.tensor([12989.8, 78233.1])).sum(dim=1).sin().abs() * 43758.5453) < 0.3
    return torch.where(chosen[:, None], 1e6 * slope, slope)


def _known(name: str, loss: Loss, may: Iterable[str], must: Iterable[str] = (), **more: object) -> Known:
    return Known(name, loss, frozenset(may) | frozenset(must), frozenset(must), **more)  # type: ignore[arg-type]


def _smooth_functions() -> list[Known]:
    """Return functions without a jump whose gradients are right."""
    both = {SMOOTH, RUGGED}
    return [
        _known("bowl", _bowl, (), {VERY_SMOOTH, GOOD}),
        _known("bowl, 1 : 1000", lambda x: x[:, 0] ** 2 + 1000 * x[:, 1] ** 2, (), {VERY_SMOOTH, GOOD}),
        _known("bowl, 1 : 1000, turned", _turned_bowl, (), {VERY_SMOOTH, GOOD}),
        _known("Rosenbrock", _rosenbrock, (), {VERY_SMOOTH, GOOD}, low=-2.0, high=2.0),
        _known("double well", lambda x: (x[:, 0] ** 2 - 1) ** 2 + x[:, 1] ** 2, (), {SMOOTH, GOOD}, low=-1.5, high=1.5),
        _known("Himmelblau", _himmelblau, (), {SMOOTH, GOOD}, low=-5.0, high=5.0),
        _known("Branin", _branin, (), {SMOOTH, GOOD}, low=0.0, high=1.0),
        _known("Rastrigin", _rastrigin, {GOOD, LOOSE}, {RUGGED}, low=-5.12, high=5.12),
        _known("Ackley", _ackley, {GOOD, LOOSE}, {RUGGED}, low=-5.0, high=5.0),
        _known("Levy", _levy, both | {GOOD}, {GOOD}, low=-10.0, high=10.0),
        _known("sin 50x", lambda x: (50 * x[:, 0]).sin() + 0 * x[:, 1], {GOOD, LOOSE}, {RUGGED}, low=0.0, high=1.0),
        _known(
            "eggs, 3 x 3",
            lambda x: -(3 * math.pi * x).sin().square().prod(dim=1),
            {SMOOTH, GOOD},
            {SMOOTH, GOOD},
            low=0.0,
            high=1.0,
        ),
        _known("ramp", lambda x: x[:, 0] + 0.3 * x[:, 1], (), {VERY_SMOOTH, GOOD}),
        _known("ridge", lambda x: (x[:, 0] + 0.4 * x[:, 1] - 0.1).abs(), (), {VERY_SMOOTH, GOOD}),
        _known("roof with four slopes", lambda x: -x.abs().sum(dim=1), (), {SMOOTH, GOOD}),
        _known("plateau", _plateau, {ZERO}, {VERY_SMOOTH, FLATS, GOOD}),
        _known("spiral", _spiral, {SMOOTH, RUGGED, GOOD, LOOSE}, ()),
        _known("needle in its middle", lambda x: _bowl(x) - 0.5 * (-_bowl(x) / 2e-4).exp(), (), {VERY_SMOOTH, GOOD}),
    ]


def _rough_functions() -> list[Known]:
    """Return functions that are rough, or jump."""
    rough = {NOT, OPPOSITE, EXPLODING, BIASED, LOOSE}
    steps = {NOT, ZERO, LOOSE, GOOD, BIASED}
    return [
        _known("ripples of 5 %, 1 % long", _ripples(0.05, 0.02), rough, {RUGGED}),
        _known("ripples of 0.01 %, 0.2 % long", _ripples(1e-4, 0.004), rough | {GOOD}, {VERY_SMOOTH}),
        _known("Brownian surface, 0.2", _brownian(0.2, 1), rough | {RUGGED}, {EXTREME}),
        _known("Brownian surface, 0.5", _brownian(0.5, 2), rough | {RUGGED}, {EXTREME}),
        _known("Brownian surface, 0.8", _brownian(0.8, 3), rough | {RUGGED, SMOOTH}, ()),
        _known("Weierstrass, 0.5", _weierstrass, rough | {RUGGED}, {EXTREME}),
        _known("fault of 0.5 %", _fault(0.005), {GOOD, BIASED}, {VERY_SMOOTH, GOOD}),
        _known("fault of 2 %", _fault(0.02), {GOOD, BIASED, SMOOTH}, {JUMPS, GOOD}),
        _known("fault of 10 %", _fault(0.1), {GOOD, BIASED, SMOOTH}, {JUMPS, GOOD}),
        _known("fault of 50 %", _fault(0.5), {GOOD, BIASED, SMOOTH}, {JUMPS, GOOD}),
        _known("round fault of 10 %", _fault(0.1, curved=True), {GOOD, BIASED, SMOOTH}, {JUMPS, GOOD}),
        _known(
            "step through half of the range",
            lambda x: 0.5 * x[:, 1] + (x[:, 0] > 0.1037),
            {GOOD, BIASED},
            {JUMPS, GOOD},
        ),
        _known("stairs, 5", _stairs(5), steps | {FLATS}, {JUMPS, FLATS, ZERO}),
        _known("stairs, 40", _stairs(40), steps | {EXPLODING}, {JUMPS, ZERO}),
        _known("needles", _needles(30, 0.01), {GOOD, LOOSE, NOT, SMOOTH, RUGGED, VERY_SMOOTH, BIASED}, ()),
        _known("steep but continuous", lambda x: (x[:, 0] * 300).tanh() + 0.2 * x[:, 1], {GOOD, LOOSE}, {VERY_SMOOTH}),
    ]


def _awkward_functions() -> list[Known]:
    """Return functions that are noisy, flat, failed, or have gradients that are no slopes."""
    return [
        _known("noise of 1 %", _bowl, {GOOD}, {words.NOISY, VERY_SMOOTH}, noise=0.02),
        _known("noise of 5 %", _bowl, {VERY_SMOOTH, GOOD}, {words.NOISY}, noise=0.1),
        _known("four wells, noise of 5 %", _himmelblau, {SMOOTH, GOOD}, {words.NOISY}, low=-5.0, high=5.0, noise=44.0),
        _known("failed in a fifth", _bowl, (), {VERY_SMOOTH, GOOD}, fails=lambda x: x[:, 0] > 0.6),
        _known("failed in two thirds", _bowl, (), {words.FAILS}, fails=lambda x: x[:, 0] > -0.34),
        _known("flat", lambda x: 3.0 + 0 * x.sum(dim=1), (), {words.FLAT}),
        _known("flat to rounding", _rounded, (), {words.FLAT}),
        _known("gradients of zero", _bowl, (), {VERY_SMOOTH, ZERO}, slope=_no_slope),
        _known("gradients opposite", _bowl, {NOT}, {VERY_SMOOTH, OPPOSITE}, slope=lambda x, slope: -slope),
        _known("gradients at random", _bowl, {NOT, OPPOSITE}, {VERY_SMOOTH, NOT, BIASED}, slope=_random_slope),
        _known("gradients loose", _bowl, {LOOSE}, {VERY_SMOOTH, LOOSE, BIASED}, slope=_loose_slope),
        _known("gradients exploding", _bowl, {GOOD, BIASED}, {VERY_SMOOTH, EXPLODING}, slope=_exploding_slope),
        _known(
            "gradients biased",
            lambda x: x[:, 0] + 0 * x[:, 1],
            {GOOD, NOT, LOOSE},
            {VERY_SMOOTH, BIASED},
            slope=lambda x, s: s + torch.tensor([0.0, 0.45]),
        ),
    ]


KINDS = {"smooth": _smooth_functions(), "rough": _rough_functions(), "awkward": _awkward_functions()}
FUNCTIONS = tuple(one for members in KINDS.values() for one in members)


@dataclass(frozen=True)
class Row:
    """The words of one function at each resolution, and the wrong, changing and missing ones."""

    known: Known
    verdicts: Mapping[int, Verdict]

    @property
    def wrong(self) -> list[tuple[int, str]]:
        """The words that are not allowed, with their resolutions."""
        return [(n, word) for n, one in self.verdicts.items() for word in one.words if word not in self.known.may]

    @property
    def missing(self) -> list[tuple[int, str]]:
        """The required words that are missing at fine resolutions."""
        fine = {n: one for n, one in self.verdicts.items() if n >= FINE}
        return [(n, word) for n, one in fine.items() for word in sorted(self.known.must) if word not in one.words]

    @property
    def changed(self) -> list[str]:
        """The words on which two resolutions disagree although both resolve them."""
        found = set[str]()
        for one in self.verdicts.values():
            for other in self.verdicts.values():
                found |= _disagree(one, other)
        return sorted(found)


def _disagree(one: Verdict, other: Verdict) -> set[str]:
    """Return words of the first that the second contradicts."""
    denied = set[str]()
    if one.surface.flat != other.surface.flat:
        denied.add(words.FLAT)
    surfaces = one.surface.word, other.surface.word
    if None not in surfaces and surfaces[0] != surfaces[1]:
        least = [two.surface.at_least for two in (one, other)]
        if not (any(least) and set(surfaces) == {RUGGED, EXTREME}):
            denied |= {str(surfaces[0])}
    if one.surface.large_flat is True and other.surface.large_flat is False:
        denied.add(FLATS)
    if one.jumps is not None and other.jumps is not None and one.jumps.found and _denies(one.jumps, other.jumps):
        denied.add(JUMPS)
    grades = set(WORD_OF.values())
    said = grades & set(one.words), grades & set(other.words)
    return denied | (said[0] if all(said) and said[0] != said[1] else set())


def _denies(found: Jumps, other: Jumps) -> bool:
    """Return whether a search without jumps excludes as many lines as cross one in another."""
    return not other.found and found.share.low > other.unseen


def table(rows: Sequence[Row]) -> str:
    """Return a Markdown table: the words by the number of samples along a side, and their errors."""
    lines = ["| function | words, by samples along a side | wrong | changes | missing |", "|---" * 5 + "|"]
    for row in rows:
        said = {n: ", ".join(_shown(one)) or "nothing" for n, one in row.verdicts.items()}
        wrong = ", ".join(f"{word} ({n})" for n, word in row.wrong)
        missing = ", ".join(f"{word} ({n})" for n, word in row.missing)
        lines.append(f"| {row.known.name} | {grouped(said)} | {wrong} | {', '.join(row.changed)} | {missing} |")
    return "\n".join(lines)


def grouped(said: Mapping[int, str]) -> str:
    """Write neighbouring resolutions with the same words as one range."""
    runs = [list(run) for _, run in groupby(said, key=said.__getitem__)]
    ends = [f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    return "; ".join(f"{end}: {said[run[0]]}" for end, run in zip(ends, runs, strict=True))


def _shown(one: Verdict) -> list[str]:
    return [f"{word} at least" if word == RUGGED and one.surface.at_least else word for word in one.words]


def main() -> None:
    """Judge the named functions, or all, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--resolutions", nargs="+", type=int, default=RESOLUTIONS)
    parser.add_argument("--samples-only", action="store_true")
    given = parser.parse_args()
    chosen = [one for one in FUNCTIONS if not given.names or one.name in given.names]
    rows = [Row(one, {n: judge(one, n, samples_only=given.samples_only) for n in given.resolutions}) for one in chosen]
    print(table(rows))
    for half, part in (("chosen by", rows[::2]), ("examined last", rows[1::2])):
        wrong, changed, missing = (
            sum(len(getattr(row, what)) for row in part) for what in ("wrong", "changed", "missing")
        )
        said = sum(one.surface.word is not None for row in part for one in row.verdicts.values())
        of = sum(len(row.verdicts) for row in part)
        print(
            f"\n{half}: {len(part)} functions, {wrong} wrong words, {changed} that change, {missing} missing; ", end=""
        )
        print(f"a word for the surface in {said} of {of} slices")


if __name__ == "__main__":
    main()
