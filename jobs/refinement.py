"""What of a scene is refined to see whether its reference is one: levels of each knob, from coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ..landscapes.measures.self_convergence import JOINT, PRECISION
from .variants import Variant

if TYPE_CHECKING:
    from ..envs.base import Environment, Fidelity

KNOBS = ("dt", "resolution", "particles", JOINT, PRECISION)
STEPS = (0.25, 0.5, 2.0, 4.0)  # how many times finer than the reference's
CELLS = (2 / 3, 1.5, 2.0)
PARTICLES = (0.5, 2.0, 4.0)


@dataclass(frozen=True)
class Refinement:
    """Hold the variants of a knob with their widths, from coarse to fine; one of them is the reference."""

    knob: str
    levels: tuple[tuple[Variant, float], ...]


def find_refinements(env: Environment, knobs: Sequence[str] = ()) -> list[Refinement]:
    """Return what can be refined of a scene at its reference, by default every knob that it has.

    Steps that do not fill a control step, and grids that the scene has no other of, are left out. Raises ValueError for
    a knob that there is not, and where the scene has none of those asked for.
    """
    if unknown := set(knobs) - set(KNOBS):
        raise ValueError(
            f"--variants takes {', '.join(KNOBS)} with --ladder convergence; got {', '.join(sorted(unknown))}"
        )
    reference = Variant.of(env)
    found = [Refinement(knob, _sorted(reference, _LEVELS[knob](reference, env), knob)) for knob in knobs or KNOBS]
    found = [one for one in found if len(one.levels) > 1]
    if not found:
        raise ValueError(f"{env.name} has nothing of {', '.join(knobs or KNOBS)} to refine")
    return found


def _sorted(reference: Variant, others: Iterator[Variant], knob: str) -> tuple[tuple[Variant, float], ...]:
    every = {variant.key(): variant for variant in (*others, reference)}
    levels = [(variant, _width(variant.fidelity, reference.fidelity, knob)) for variant in every.values()]
    return tuple(sorted(levels, key=lambda level: -level[1]))


def _width(fidelity: Fidelity, reference: Fidelity, knob: str) -> float:
    """Return the time step [s], or the width of a cell or the distance of particles as a share of the reference's."""
    if knob == "dt":
        return fidelity.dt
    if knob == PRECISION:
        return 2.0**-52 if fidelity.precision == "float64" else 2.0**-23
    if knob == "particles":
        fewer = reference.particles / fidelity.particles if fidelity.particles else 1.0
        return reference.sampling / fidelity.sampling * math.cbrt(fewer)
    return reference.resolution / fidelity.resolution if fidelity.resolution else 1.0


def _dts(base: Variant, env: Environment) -> Iterator[Variant]:
    for finer in STEPS if base.fidelity.dt else ():
        dt = base.fidelity.dt / finer
        if _fits(env, dt):
            yield _change(base, "dt", f"dt-x{1 / finer:g}", dt=dt)


def _resolutions(base: Variant, env: Environment) -> Iterator[Variant]:
    for finer in CELLS if base.fidelity.resolution else ():
        cells = _cells(base, finer)
        yield _change(base, "resolution", f"resolution-{cells}", resolution=cells)


def _particles(base: Variant, env: Environment) -> Iterator[Variant]:
    if env.work().unit == "particle-substep":
        for more in PARTICLES:
            yield _change(base, "particles", f"particles-x{more:g}", **_crowd(base.fidelity, more))


def _joint(base: Variant, env: Environment) -> Iterator[Variant]:
    """Refine grid, step and particles together, so that a wave crosses as many cells in a step (Courant's number)."""
    for finer in CELLS if base.fidelity.resolution and base.fidelity.dt else ():
        cells = _cells(base, finer)
        ratio = cells / base.fidelity.resolution
        dt = env.nearest_dt(base.fidelity.dt / finer)
        counted = {"particles": round(base.fidelity.particles * ratio**3)} if base.fidelity.particles else {}
        yield _change(base, JOINT, f"joint-x{finer:.3g}", resolution=cells, dt=dt, **counted)


def _precisions(base: Variant, env: Environment) -> Iterator[Variant]:
    other = "float64" if base.fidelity.precision == "float32" else "float32"
    yield _change(base, PRECISION, other, precision=other)


def _fits(env: Environment, dt: float) -> bool:
    return abs(env.nearest_dt(dt) - dt) < 1e-6 * dt


def _cells(base: Variant, finer: float) -> int:
    return 2 * round(base.fidelity.resolution * finer / 2)  # some scenes take even numbers only


def _crowd(fidelity: Fidelity, more: float) -> Mapping[str, float]:
    if fidelity.particles:
        return {"particles": round(fidelity.particles * more)}
    return {"sampling": round(fidelity.sampling * math.cbrt(more), 3)}


def _change(base: Variant, knob: str, what: str, **changes: float | str) -> Variant:
    fidelity = replace(base.fidelity, name=f"{base.fidelity.name}-{what}", **changes)  # type: ignore[arg-type]
    return base.change(fidelity.name, knob, fidelity=fidelity)


_LEVELS = {"dt": _dts, "resolution": _resolutions, "particles": _particles, JOINT: _joint, PRECISION: _precisions}
