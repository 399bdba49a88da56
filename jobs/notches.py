"""The neighbours of a variant: what it would be one notch finer or coarser in a single setting.

A setting's notches are a geometric series through the value of the scene's standard, so that from wherever the same
notch is reached it is the same variant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from ..envs.base import Environment, Fidelity
from ..landscapes.measures.choice import CLAIMS, Claim
from .variants import Variant

STEPS, CELLS, PARTICLES, STIFFNESS = 1.5, 1.25, 2.0, 2.0  # ratios of one notch to the next
SAME = 0.1  # two values that differ by less than this share are no notch apart
FEWEST_CELLS, FEWEST_PARTICLES, WIDEST = 4, 50, 8.0  # ends of notches; of a stiffness, times its default
MIXED = "mixed"  # what changes of such a variant: several settings together


def neighbours(of: Variant, standard: Variant, env: Environment) -> list[Variant]:
    """Return the variants that differ from one by a notch in one setting; `env` is any environment of the scene."""
    found = [
        _named(of, standard, fidelity, of.options) for fidelity in _fidelities(of.fidelity, standard.fidelity, env)
    ]
    found += [_named(of, standard, of.fidelity, options) for options in _options(of.options, standard.options, env)]
    return found


def fidelity_line(fidelity: Fidelity, name: str, control_step: float) -> str:
    """Return the line of Python that makes a fidelity under a name."""
    unit = control_step or 1.0
    steps = round(unit / fidelity.dt)
    exact = steps > 0 and math.isclose(unit / steps, fidelity.dt, rel_tol=1e-12)
    words = [f'"{name}"', f"dt={unit:.12g} / {steps}" if exact else f"dt={fidelity.dt!r}"]
    words += [f"resolution={fidelity.resolution}"] if fidelity.resolution else []
    words += [f"sampling={fidelity.sampling:g}"] if fidelity.sampling != Fidelity("", 0.0).sampling else []
    words += [f"particles={fidelity.particles:_}"] if fidelity.particles else []
    words += [f'precision="{fidelity.precision}"'] if fidelity.precision != "float32" else []
    return f'"{name}": Fidelity({", ".join(words)}),'


def named_variant(env: Environment, claim: Claim) -> Variant:
    """Return the variant that bears a claim's name. Raises ValueError where there is none beside the reference."""
    if claim.name not in env.fidelities or claim.name == env.fidelity.name:
        raise ValueError(
            f"a search of mixed variants is for scenes with {' and '.join(one.name for one in CLAIMS)} beside their "
            f"reference; {env.name} has {', '.join(env.fidelities)}"
        )
    return replace(Variant.of(env), name=claim.name, fidelity=env.fidelities[claim.name])


def _named(of: Variant, standard: Variant, fidelity: Fidelity, options: dict[str, Any]) -> Variant:
    """Name a variant by its settings, which are all that it is."""
    words = [f"dt {1e3 * fidelity.dt:.4g} ms"]
    words += [f"{fidelity.resolution} cells"] if fidelity.resolution else []
    words += [f"{fidelity.particles} particles"] if fidelity.particles else []
    words += [f"sampling {fidelity.sampling:g}"] if fidelity.sampling != standard.fidelity.sampling else []
    words += [fidelity.precision] if fidelity.precision != standard.fidelity.precision else []
    words += [f"{name} {value:g}" for name, value in options.items() if value != standard.options[name]]
    name = ", ".join(words)
    return standard.change(name, MIXED, fidelity=replace(fidelity, name=name), options=options)


def _fidelities(of: Fidelity, standard: Fidelity, env: Environment) -> Iterator[Fidelity]:
    unit = env.control_step or 1.0
    whole = round if env.control_step else _two_digits
    for steps in beside(unit / of.dt, unit / standard.dt, STEPS, whole, least=1):
        yield replace(of, dt=env.nearest_dt(unit / steps))
    for cells in beside(of.resolution, standard.resolution, CELLS, _even, least=FEWEST_CELLS):
        yield replace(of, resolution=int(cells))
    if env.work().unit == "particle-substep" and of.particles:
        for count in beside(of.particles, standard.particles, PARTICLES, _two_digits, least=FEWEST_PARTICLES):
            yield replace(of, particles=int(count))
    elif env.work().unit == "particle-substep":
        ratio = math.cbrt(PARTICLES)
        for sampling in beside(of.sampling, standard.sampling, ratio, lambda value: round(value, 2), least=1.0):
            yield replace(of, sampling=sampling)
    yield replace(of, precision="float64" if of.precision == "float32" else "float32")


def _options(of: dict[str, Any], standard: dict[str, Any], env: Environment) -> Iterator[dict[str, Any]]:
    """Yield the options of which one, that makes a scene stiff, is a notch further up or down."""
    if option := env.contact_stiffness:
        middle = standard[option]
        for value in beside(of[option], middle, STIFFNESS, float, least=middle / WIDEST, most=middle * WIDEST):
            yield of | {option: value}
    for option, listed in env.accuracy_options.items():
        values = sorted({*listed, standard[option]})
        below = [value for value in values if value < of[option]][-1:]
        above = [value for value in values if value > of[option]][:1]
        yield from (of | {option: value} for value in below + above)


def beside(
    value: float,
    middle: float,
    ratio: float,
    tidy: Callable[[float], float],
    *,
    least: float,
    most: float = math.inf,
) -> list[float]:
    """Return the notches next to a value, below and above, of the series middle x ratio^k; none of a setting at 0."""
    if not value or not middle:
        return []
    at = math.floor(math.log(value / middle, ratio))
    near = [tidy(middle * ratio**k) if k else middle for k in range(at - 2, at + 4)]
    below = [notch for notch in near if least <= notch < value * (1 - SAME)][-1:]
    above = [notch for notch in near if most >= notch > value * (1 + SAME)][:1]
    return below + above


def _two_digits(value: float) -> int:
    """Round to two digits: so many steps per second fill an episode whose length is a round number."""
    size = 10 ** max(0, math.floor(math.log10(value)) - 1) if value >= 1 else 1
    return round(value / size) * size


def _even(value: float) -> int:
    return 2 * round(value / 2)  # some scenes take even numbers only
