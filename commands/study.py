"""A study, on the terminal: its tables, its verdicts and the refused variants."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from .terminal import SIMPLE, Console, Table, table

if TYPE_CHECKING:
    from ..landscapes.statistics import Estimate
    from ..studies.convergence import ConvergenceRecord
    from ..studies.divergence import Distributions
    from ..studies.extremes import ExtremesRecord
    from ..studies.fidelity import FidelityRecord, MeasuredVariant
    from ..studies.mixed import MixedRecord
    from ..studies.model import MeasuredPart, ModelRecord
    from ..studies.samples import Bootstrap, Comparison
    from ..studies.symmetry import SymmetryRecord
    from ..studies.updates import UpdatesRecord
    from ..studies.variants import StudyRecord

MEANING = (
    "median, 95 %: largest loss error at half and at 95 % of points, as a share of the spread (95 % interval); "
    "rank: Spearman's correlation of losses; cosine, slope: median cosine and relative error of gradients"
)


def show(found: StudyRecord, console: Console) -> None:
    """Print a study: its subject, its tables, its verdicts and the refused variants."""
    for part in SHOWN[found.kind](found):
        console.print(part, soft_wrap=found.kind == "mixed" and isinstance(part, str))  # lines of Python stay whole
    for why in dict.fromkeys(refused.why for refused in found.refused):
        names = [refused.name for refused in found.refused if refused.why == why]
        console.print(f"refused: {'; '.join(names)}: {why}")


def _show_fidelity(found: FidelityRecord) -> Iterable[str | Table]:
    from ..studies.kept import find_convergence

    failed = f"; without {found.reference_failed} points where the reference fails" if found.reference_failed else ""
    yield f"{found.env}: {found.points} points compared with {found.reference}; {_scale(found)}{failed}"
    accuracy = ("variant", "median", "95 % of points", "rank", "cosine", "slope", "failed")
    rows, best = _table(*accuracy, "ms", "with grad", "memory"), set(found.front)
    for variant in found.by_time:
        mark = " *" if variant.name in best else ""
        rows.add_row(variant.name + mark, *_variant_cells(variant, reference=variant.name == found.reference))
    yield rows
    yield f"{MEANING}; ms: per episode; *: no other variant is both faster and more accurate"
    yield from _missing((one.name, one.comparison) for one in found.variants)
    yield from found.sentences()
    if converged := find_convergence(found):
        yield from (converged.rule.sentence(), *converged.remainder_sentences())


def _variant_cells(variant: MeasuredVariant, *, reference: bool) -> list[str]:
    from ..landscapes.capacity import size

    found = variant.comparison
    costs = [f"{1e3 * seconds:.3g}" for seconds in (found.seconds.forward, found.seconds.with_gradient)]
    costs.append("" if variant.memory is None else size(variant.memory))
    return ["reference", *[""] * 5, *costs] if reference else [*_error_cells(found), _failed(found), *costs]


def _show_convergence(found: ConvergenceRecord) -> Iterable[str | Table]:
    yield f"{found.env}: {found.points} points about {found.reference}; {_scale(found)}"
    rows = _table("setting", "from", "to", "median", "95 % of points", "cosine", "slope", "points")
    for one in found.settings:
        for place, move in enumerate(one.moves):
            names = [name.removeprefix(f"{found.reference}-") for name in (move.coarse, move.fine)]
            cells = [_percent(move.median), _share(move.p95), _number(move.cosine), _number(move.relative_error)]
            rows.add_row(one.setting if place == 0 else "", *names, *cells, str(move.compared))
    yield rows
    yield MEANING
    yield from found.sentences()
    if found.distributions:
        yield _distributions(found.distributions)


def _distributions(found: Distributions) -> Table:
    rows = _table("losses over neighbourhoods", "Kolmogorov", "Wasserstein / spread", "distinguished by")
    noise = found.noise
    rows.add_row("noise: the reference twice", str(noise.kolmogorov), str(noise.wasserstein), "")
    for one in found.compared:
        cells = (str(one.distance.kolmogorov), str(one.distance.wasserstein))
        rows.add_row(one.name, *cells, ", ".join(one.told) or "neither")
    return rows


def _show_model(found: ModelRecord) -> Iterable[str | Table]:
    about = f"{found.env}: {found.points} points compared with the full model at {found.fidelity}"
    if found.parts:  # with which it was timed
        about += f", {1e3 * found.seconds.with_gradient:.3g} ms per episode with gradient"
    failed = f"; without {found.failed} points where the full model fails" if found.failed else ""
    yield f"{about}; {_scale(found)}{failed}"
    own = found.noise.comparison
    error = own.loss_error.p95_relative
    change = "not finite" if own.loss_error.p95.value is None else f"at most {_percent(error) or '0%'}"
    rank, cosine = _number(own.spearman) or "none", _number(own.gradient.cosine) or "none"
    yield f"noise (the full model run twice): loss change at 95 % of points {change}, rank {rank}, cosine {cosine}"
    titles = ("parts of the model, and the effect of changing each", "missing parts, and the effect of adding each")
    for parts, title in zip((found.present, found.missing), titles, strict=True):
        if parts:
            yield _parts(parts, title)
    yield from found.sentences()
    yield from _missing((one.name, one.comparison) for one in (*found.present, *found.missing))
    yield (
        f"{MEANING}; moved: share of points whose loss changes by more than the noise; time: change of an episode with "
        "gradient relative to the full model, timed alternately (95 % interval)"
    )


def _parts(parts: Sequence[MeasuredPart], title: str) -> Table:
    failing = any(part.comparison.diverged for part in parts)
    headings = ("part", "median", "95 %", "rank", "cosine", "slope", "moved", *(["failed"] if failing else []), "time")
    rows = _table(*headings, title=title)
    for part in parts:
        failed = [_failed(part.comparison)] if failing else []
        moved = "" if part.moved is None else f"{part.moved:.0%}"
        rows.add_row(part.name, *_error_cells(part.comparison), moved, *failed, _change(part.cost))
    return rows


def _show_mixed(found: MixedRecord) -> Iterable[str | Table]:
    measured = found.measured
    yield (
        f"{found.env}: {len(measured.variants)} variants at {found.points} points compared with {measured.reference}, "
        f"{len(found.dismissed)} dropped early, {len(measured.refused)} refused"
    )
    rows = _table("", "variant", "rank", "cosine", "95 % of points", "of allowed", "ms")
    for one in found.choices:
        today = (one.claim.name, one.today_shortfall, one.today_seconds)
        for label, chosen in (
            (f"{one.claim.name} today", today),
            ("chosen", (one.variant, one.shortfall, one.seconds)),
        ):
            rows.add_row(label, *_choice_cells(found, *chosen))
    yield rows
    yield from found.sentences()


def _choice_cells(found: MixedRecord, name: str | None, shortfall: float | None, seconds: float | None) -> list[str]:
    if name is None or seconds is None:
        return ["none", *[""] * 5]
    one = found.variant(name).comparison
    lack = "not finite" if shortfall is None else f"{shortfall:.2g}"
    ranks = (_interval(one.spearman), _interval(one.gradient.cosine), _share(one.loss_error.p95_relative))
    return [name, *ranks, lack, f"{1e3 * seconds:.3g}"]


def _show_extremes(found: ExtremesRecord) -> Iterable[str | Table]:
    about = f"{found.env}: {found.fidelity} on {found.device}, {found.points} points"
    yield f"{about}, compared with {found.reference} (accurate: within {found.tolerance:.0%} of the spread)"
    rows = _table("setting", "value now", *found.precisions)
    for first in (limit for limit in found.limits if limit.precision == found.precisions[0]):
        same = [limit for limit in found.limits if (limit.setting, limit.end) == (first.setting, first.end)]
        base = f"{first.base:.4g} {first.unit}".rstrip()
        rows.add_row(f"{first.setting}, {first.end}", base, *(limit.sentence() for limit in same))
    yield rows


def _show_symmetry(found: SymmetryRecord) -> Iterable[str | Table]:
    floor = found.floor
    scale = f"range of the loss {floor.range:.4g} {found.loss_unit}".rstrip()
    yield f"{found.env}: {found.fidelity} on {found.device} and its replicas at {found.points} points; {scale}"
    rows = _table("replica", "loss deviation", "rank", "cosine", "lower quartile", "failed")
    for one in found.replicas:
        slopes = ["" if math.isnan(cosine) else f"{cosine:z.3f}" for cosine in (one.cosine.value, one.cosine_low)]
        failed = str(one.failed) if one.failed else ""
        rows.add_row(one.name, _share(_as_bootstrap(one.apart)), _number(one.spearman), *slopes, failed)
    yield rows
    yield (
        "loss deviation: standard deviation between losses of the scene and the replica, as a share of the range (95 % "
        "interval); rank: Spearman's correlation of losses; cosine: of gradients, median and lower quartile"
    )
    yield from found.sentences()


def _show_updates(found: UpdatesRecord) -> Iterable[str | Table]:
    yield (
        f"{found.env}: {found.fidelity} on {found.device}, {found.points} updates from {found.through}; rate "
        f"{found.rate:.3g}, median length {found.length:.2g} widths of the box, gradients at points shifted by "
        f"{100 * found.noise:.3g} % of the box"
    )
    rows = _table("steps", "mean", "5 %", "25 %", "50 %", "75 %", "95 %", "worse", "left tail", "failed")
    for one in (found.along, found.random):
        shares = [_share(_as_bootstrap(each)) for each in (one.worse, one.tail)]
        failed = str(one.failed) if one.failed else ""
        rows.add_row(one.name, f"{one.mean.value:.4g}", *(f"{q:.4g}" for q in one.quantiles), *shares, failed)
    yield rows
    yield from found.sentences()


def _as_bootstrap(found: Estimate) -> Bootstrap:
    """Return an estimate as what tables show, None where it is not known."""
    from ..studies.samples import Bootstrap

    return Bootstrap(*(None if math.isnan(end) else end for end in (found.value, found.low, found.high)))


SHOWN: dict[str, Any] = {
    "fidelity": _show_fidelity,
    "convergence": _show_convergence,
    "model": _show_model,
    "mixed": _show_mixed,
    "extremes": _show_extremes,
    "symmetry": _show_symmetry,
    "updates": _show_updates,
}


def _table(*headings: str, title: str | None = None) -> Table:
    return table(*headings, title=title, box=SIMPLE, padding=(0, 1), collapse_padding=True)


def _scale(found: FidelityRecord | ConvergenceRecord | ModelRecord) -> str:
    if not found.spread:
        return "no spread"
    return f"spread of the loss (5th to 95th percentile) {found.spread:.4g} {found.loss_unit}".rstrip()


def _missing(rows: Iterable[tuple[str, Comparison]]) -> Iterable[str]:
    """Say which variants lack gradients where the reference has them, and at which share of points."""
    lacking = [f"{name} at {found.missing:.0%}" for name, found in rows if found.missing]
    return [f"points with a loss but no gradient: {', '.join(lacking)}"] if lacking else []


def _error_cells(found: Comparison) -> list[str]:
    errors = (_percent(found.loss_error.median_relative), _share(found.loss_error.p95_relative))
    return [*errors, *map(_number, (found.spearman, found.gradient.cosine, found.gradient.relative_error))]


def _failed(found: Comparison) -> str:
    one = found.failed
    return "" if one is None else f"{one.value:.0%} ({100 * one.low:.0f}-{100 * one.high:.0f})"


def _percent(found: Bootstrap) -> str:
    return "" if found.value is None else f"{100 * found.value:.2g}%"


def _share(found: Bootstrap) -> str:
    """Return a share in per cent, with its interval."""
    if found.value is None:
        return "not finite"
    low, high = ("?" if end is None else f"{100 * end:.2g}" for end in (found.low, found.high))
    return f"{_percent(found)} ({low}-{high})"


def _number(found: Bootstrap) -> str:
    return "" if found.value is None else f"{found.value:z.3f}"


def _interval(found: Bootstrap) -> str:
    if found.value is None or found.low is None or found.high is None:
        return _number(found)
    return f"{_number(found)} ({found.low:z.3f}-{found.high:z.3f})"


def _change(cost: Bootstrap) -> str:
    """Return a ratio of times as what it adds or takes away, with its interval."""
    if cost.value is None or cost.low is None or cost.high is None:
        return ""
    value, low, high = (100 * (ratio - 1) for ratio in (cost.value, cost.low, cost.high))
    return f"{value:+z.0f}% ({low:+z.0f}:{high:+z.0f})"
