"""Conclude what is wrong with gradients from the measurements: a diagnosis for each kind of finding."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from . import evidence as numbers_of
from .causes import recognise
from .diagnosis import CERTAINTIES, Diagnosis, Region
from .evidence import Evidence, Samples
from .examination import Examination, percent
from .finding import FAIL
from .horizons import FirstWrong
from .memory import MemoryGrowth
from .parameters import AGREES, WRONG
from .slopes import UNJUDGED, Kind
from .usefulness import Usefulness

OVERWRITES = "writes to what it has read"  # how a simulator says so
NAMED = 6  # parameters that are named, at most
MANY_LINES = 20  # from which an average is told
CLEAR_ERRORS = 3  # standard errors
AVERAGE_TOLERANCE = 2e-3  # relative error of the average length of gradients that is no defect
UNCLEAR = 0.05  # relative error of a slope that counts for the average
FEWEST_CONTROLS = 3  # parameters, wrong and right ones, from which it is told that the first are wrong


OF_CALLS = ("leaks", "depends", "random", "hidden")  # which count as 0 where nothing was asked
Texts = dict[str, str]


@dataclass(frozen=True)
class Further:
    """Further questions about a point whose gradient is NaN or wrong.

    `nan_origin` and `wrong_origin` return where that begins. `first_wrong` returns the first wrong length of an
    episode, at a random point or, numbered from -1 down, at a special place. `has_length`: episodes have a length.
    """

    nan_origin: Callable[[int], str] = lambda row: ""
    wrong_origin: Callable[[int], str] = lambda row: ""
    first_wrong: Callable[[Sequence[int]], FirstWrong | None] = lambda rows: None
    has_length: bool = False


def conclude(seen: Examination, calls: Evidence, further: Further | None = None) -> tuple[Diagnosis, ...]:
    """Return a diagnosis for each kind of finding, failures and the most certain first."""
    further, calls = further or Further(), dict.fromkeys(OF_CALLS, 0.0) | calls
    found = [one for judge in (_of_calls, _of_grain) for one in judge(seen, calls)]
    explained = any(one.outcome == FAIL for one in found)
    found += list(_of_nan(seen, further))
    if not explained:
        found += list(_of_wrong(seen, calls, further))
    found += [*_of_zero(seen), *_of_length(seen)]
    if not any(one.outcome == FAIL for one in found):  # nothing is the landscape's while a gradient is wrong
        found += [*_of_steep(seen), *_of_noise(seen)]
    return tuple(sorted(found, key=lambda one: (one.outcome != FAIL, CERTAINTIES.index(one.certainty))))


def _recognised(
    of: str, evidence: Evidence, texts: Texts, names: tuple[str, ...] = (), region: Region | None = None
) -> tuple[Diagnosis, ...]:
    """Return the diagnosis of a kind of finding, none where no known cause fits."""
    if (known := recognise(of, evidence)) is None:
        return ()
    cause, signature = known
    what, remedy = (text.format_map({**evidence, **texts}) for text in (cause.says, cause.remedy))
    numbers = dict(evidence)
    return (
        Diagnosis(cause.name, signature.outcome, signature.certainty, what, remedy, names, region, numbers=numbers),
    )


def _named(seen: Examination, axes: set[int] | None) -> tuple[str, ...]:
    return () if axes is None else tuple(seen.names[axis] for axis in sorted(axes))


def _by(names: tuple[str, ...]) -> str:
    if not names:
        return ""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f" by {', '.join(names[:NAMED])}{more}"


def _where(region: Region | None) -> str:
    if region is None:
        return ""
    return f", {'all' if region.error == 0 else 'nearly all'} with {region.rule}"


def _of_calls(seen: Examination, calls: Evidence) -> Iterator[Diagnosis]:
    how = "they add up from call to call" if calls.get("grows") else "a call returns the gradient of the one before"
    short = f"{calls.get('batch', 1.0):.3g} times shorter"
    what = "the loss" if calls.get("leaks") else "the gradient"
    how_batch = "all rows have the same gradient" if calls.get("alike") else short
    yield from _recognised("calls", calls, {"how": how, "how_batch": how_batch, "what": what})


def _of_grain(seen: Examination, calls: Evidence) -> Iterator[Diagnosis]:
    probe, loss = seen.probe, seen.found.loss[seen.found.loss.isfinite()]
    if not probe.single or not probe.grain or not len(loss):
        return
    grad = seen.found.grad
    zero = float((grad[seen.found.has_gradient] == 0).all(dim=1).double().mean()) if grad is not None else 0.0
    evidence = {
        "grain": probe.grain,
        "levels": float(loss.max() - loss.min()) / max(probe.grain, probe.eps / 2 * float(loss.abs().median())),
        "zero_gradients": zero if math.isfinite(zero) else 0.0,
        "limit": _limit(seen),
        **(numbers_of.roughness(probe, seen.u[:16]) if seen.rows(Kind.WRONG) else {}),
    }
    consequence = f": gradients cannot be judged below {percent(evidence['limit'])} of the slope"
    if evidence["zero_gradients"] >= 0.5 or evidence.get("rough", 0) > 0.01:
        consequence = ": differences over small steps are 0, or multiples of it"
    exponent = round(math.log2(probe.grain))
    yield from _recognised("grain", evidence, {"grain_text": f"2^{exponent}", "consequence": consequence})


def _limit(seen: Examination) -> float:
    """Return the relative error of a gradient that would be detected at half of the points."""
    limits = [one.limit for one in seen.random.judged if math.isfinite(one.limit) and one.kind not in UNJUDGED]
    return float(np.median(limits)) if limits else 1.0


def _of_nan(seen: Examination, further: Further) -> Iterator[Diagnosis]:
    rows = seen.rows(Kind.NAN)
    names, ladder = seen.places
    places = ladder.rows(Kind.NAN)
    if not rows and not places:
        return
    region = seen.region if rows else None
    evidence = {
        "nan_points": float(len(rows)),
        "nan_places": float(len({names[row] for row in places})),
        "region": float(region is not None),
        "loss": float(ladder.lines.loss[places[0]]) if places else math.nan,
    }
    begins = further.nan_origin(rows[0] if rows else -1 - places[0])
    texts = {
        "share": seen.share.describe().partition(" of ")[0],
        "where": _where(region),
        "where_place": " and ".join(dict.fromkeys(names[row] for row in places)),
        "origin": f"; the first NaN comes from {begins}" if begins else "",
    }
    yield from _recognised("nan", evidence, texts, region.parameters if region else (), region)


def _of_wrong(seen: Examination, calls: Evidence, further: Further) -> Iterator[Diagnosis]:
    rows = seen.rows(Kind.WRONG)
    if not rows and not seen.axes.rows(Kind.WRONG):
        for place in seen.places[1].rows(Kind.WRONG)[:1]:
            remedy = "Look for a division by zero or a branch at this point."
            yield Diagnosis("", FAIL, "certain", seen.describe_place(place), remedy)
        return
    names = _named(seen, seen.blamed)
    region = seen.region if rows and not seen.rows(Kind.NAN) else None
    evidence = {"second_backward": 0.0} | _wrong_numbers(seen) | calls
    begins, late = further.wrong_origin(rows[0]) if rows else "", further.first_wrong(rows)
    early = _early(seen) if seen.blamed is None else set()
    names = names or _named(seen, early)
    evidence |= {"overwrites": float(OVERWRITES in begins), "early": float(bool(early))}
    evidence |= {"horizon": float(further.has_length)}
    when = f"; it begins in {begins}" if begins else ""
    if late is not None and late.right is not None:
        evidence |= {"right_until": late.right, "first_wrong": late.length}
        when = f"; it is right in episodes up to a length of {late.right:g}, and wrong from {late.length:g} on{when}"
    texts = {
        "by": _by(names),
        "where": _where(region),
        "unit_text": "its ratio to the slope is the range of each parameter, or one over it"
        if evidence.get("units", 0) > 0.5
        else f"it is {evidence.get('ratio', 1):.4g} times the slope",
        "moved_text": percent(evidence.get("moved", 0.0)),
    }
    if not names and evidence.get("zero", 0.0) == 1:
        names = tuple(row.parameter for row in seen.parameters() if row.zero == 1)
    what = f"the gradient{texts['by']} is not the slope of the loss{texts['where']}; no known cause fits"
    found = _recognised("wrong", evidence, texts, names, region)
    found = found or (Diagnosis("", FAIL, "certain", what, REMEDY, names, region, evidence),)
    yield replace(found[0], what=found[0].what + when)


def _early(seen: Examination) -> set[int]:
    """Return the first parameters, if the gradient is wrong by all tested ones of them and right by the others.

    They can be the controls of the first steps. Empty otherwise.
    """
    verdicts = [row.verdict for row in seen.parameters()]
    wrong = [axis for axis, one in enumerate(verdicts) if one in WRONG]
    right = [axis for axis, one in enumerate(verdicts) if one == AGREES]
    if min(len(wrong), len(right)) < FEWEST_CONTROLS or max(wrong) > min(right):
        return set()
    return set(range(max(wrong) + 1))


REMEDY = "Compare the gradient with differences along one parameter, at one of these points, step by step."


def _wrong_numbers(seen: Examination) -> Evidence:
    """Return the common features of wrong gradients: along axes where these are known, else along all at once."""
    axes = seen.at_wrong or seen.axes
    wrong, known = Samples.of(axes, wrong=True), Samples.of(axes, wrong=False)
    space, dim = seen.probe.objective.space, len(seen.names)
    single = seen.probe.single
    found: Evidence = {"single": float(single), "best_step": 1e-3 if single else 1e-5}
    if not len(wrong):
        return found | numbers_of.of_lines(seen.random.judged)
    found |= numbers_of.ratios(wrong.exact, wrong.slope, wrong.error) | numbers_of.per_parameter(wrong, space)
    exact, slope = known.matrix(dim)
    found |= numbers_of.exchanged(exact, slope) | numbers_of.cosine(exact, slope)
    found |= numbers_of.cut_off(seen.probe, wrong, Samples.of(seen.axes, wrong=False))
    if seen.found.grad is not None:
        found |= numbers_of.same_length(seen.found.grad[seen.found.has_gradient])
    lines = axes.rows(Kind.WRONG)
    if found.get("zero", 0) < 1:
        found |= numbers_of.as_difference(seen.probe, axes, lines)
        found |= numbers_of.roughness(seen.probe, seen.u[:16])
    noisy = [(row, one) for row, one in enumerate(seen.random.judged) if math.isfinite(one.noise)]
    noise = [one.noise / (seen.probe.eps * abs(float(seen.found.loss[row])) or 1) for row, one in noisy]
    return found | ({"noise_ratio": float(np.median(noise))} if noise else {})


def _of_zero(seen: Examination) -> Iterator[Diagnosis]:
    if not seen.stepped:
        return
    names = _named(seen, seen.stepped)
    others = {axis for axis, row in enumerate(seen.parameters()) if row.zero < 1}
    evidence = {"others_move": float(bool(others)), "stepped": float(len(names))}
    yield from _recognised("zero", evidence, {"parameters": _by(names).removeprefix(" by ")}, names)


def _of_steep(seen: Examination) -> Iterator[Diagnosis]:
    steep = seen.rows(Kind.STEEP)
    evidence = {"steep_share": len(steep) / max(1, len(seen.random.judged))}
    if steep:
        slopes = np.abs([seen.random.judged[row].exact for row in steep])
        evidence |= {"gradient": float(np.median(slopes))}
        loss = seen.found.loss[seen.found.loss.isfinite()]
        evidence["reach"] = float(loss.max() - loss.min()) / evidence["gradient"] if evidence["gradient"] else 0.0
    yield from _recognised("steep", evidence, {"share": percent(evidence["steep_share"])})


def _of_noise(seen: Examination) -> Iterator[Diagnosis]:
    noises = [one.noise for one in seen.random.judged if math.isfinite(one.noise)]
    if not noises:
        return
    loss = float(seen.found.loss[seen.found.loss.isfinite()].abs().median())
    noise = float(np.median(noises))
    evidence = {
        "single": float(seen.probe.single),
        "noise": noise,
        "noise_ratio": noise / (seen.probe.eps * loss) if loss else 0.0,
        "noise_share": len(seen.rows(Kind.NOISE)) / len(seen.random.judged),
        "limit": _limit(seen),
    }
    yield from _recognised("noise", evidence, {})


def conclude_physics(evidence: Evidence) -> tuple[Diagnosis, ...]:
    """Conclude that gradients are right for the program but wrong for the physics."""
    texts = {"physics_text": percent(evidence.get("physics", 0.0)), "finest_text": percent(evidence.get("at_4", 0.0))}
    return _recognised("physics", evidence, texts)


def conclude_memory(growth: MemoryGrowth) -> tuple[Diagnosis, ...]:
    """Conclude that memory grows with every evaluation."""
    evidence = {"growth": growth.per_evaluation if growth.grows else 0.0, "evaluations": float(growth.evaluations)}
    return _recognised("memory", evidence, {"growth_text": f"{growth.per_evaluation:,.0f} bytes"})


def conclude_jumps(curve: Sequence[Usefulness]) -> tuple[Diagnosis, ...]:
    """Conclude that regular jumps of the loss make means of gradients differ from the slope of the smoothed loss."""
    for one in sorted(curve, key=lambda one: -one.step):
        evidence = {"step": one.step, "bias": one.bias.value, "low": one.bias.low, "high": one.bias.high}
        evidence["least_bias"] = max(one.bias.low, -one.bias.high)
        interval = f"{percent(one.bias.low, bare=True)} to {percent(one.bias.high)}"
        texts = {"lacks": percent(one.bias.value), "interval": interval, "width": percent(one.step)}
        if found := _recognised("jumps", evidence, texts):
            return found
    return ()


def _of_length(seen: Examination) -> Iterator[Diagnosis]:
    """Conclude that gradients are too long or too short on average, although no single point shows it."""
    lines = [one for one in seen.random.judged if one.slope is not None and one.kind in (Kind.AGREES, Kind.WRONG)]
    clear = [one for one in lines if one.slope and abs(one.slope.error) < UNCLEAR * abs(one.slope.value)]
    if len(clear) < MANY_LINES or any(one.kind == Kind.WRONG for one in lines):
        return
    ratio = np.array([one.exact / one.slope.value for one in clear if one.slope])
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle))) * 1.2533 / math.sqrt(len(ratio))
    evidence = {
        "length": middle,
        "length_low": middle - 2 * spread,
        "length_high": middle + 2 * spread,
        "length_off": abs(middle - 1) - AVERAGE_TOLERANCE - CLEAR_ERRORS * spread,
    }
    yield from _recognised("length", evidence, {})
