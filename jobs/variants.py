"""Variants of a scene: what can be cheaper or dearer about it, one setting changed at a time."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..envs.base import Environment, Fidelity

FIDELITY = "fidelity"  # the ladder whose variants are fidelities and what is changed of them
CHANGING = (FIDELITY, "convergence")  # the ladders that are told what to change
SETTINGS = ("dt", "resolution", "particles", "precision", "stiffness", "engine", "device")
STEPS, CELLS, PARTICLES, STIFFNESSES = (0.5, 2.0, 4.0), (2 / 3, 1.5), (0.5, 2.0), (0.25, 0.5, 2.0, 4.0)
SLOWER = 1.5  # times what float32 takes, float64 is expected to take


@dataclass(frozen=True)
class Variant:
    """One way to simulate a scene: a fidelity, an engine, a device, options.

    `changed` is the setting that differs from `base`, a named fidelity of the same scene; "named" of such a one.
    """

    name: str
    changed: str
    fidelity: Fidelity
    engine: str
    device: str
    options: dict[str, Any]
    base: Variant | None = field(default=None, compare=False)

    @classmethod
    def of(cls, env: Environment) -> Variant:
        """Return the variant that an environment is."""
        return cls(env.fidelity.name, "named", env.fidelity, env.engine, env.device, asdict(env.options))

    def make(self, scene: Environment) -> Environment:
        """Make the environment of this variant of a scene.

        Raises ValueError where the scene refuses it, or would round its steps to an episode of another length.
        """
        env = scene.remake(fidelity=self.fidelity, engine=self.engine, device=self.device, **self.options)
        if self.base is not None and self.fidelity.dt != self.base.fidelity.dt:
            longer = env.length() / env.remake(fidelity=replace(self.fidelity, dt=self.base.fidelity.dt)).length()
            if abs(longer - 1) > 1e-3:
                raise ValueError(
                    f"{env.name} cuts an episode into whole steps; with dt {self.fidelity.dt:.4g} s it would be "
                    f"{longer:.3g} times as long"
                )
        return env

    def change(self, name: str, setting: str, **changes: Any) -> Variant:
        """Return this variant with one setting changed."""
        return replace(self, name=name, changed=setting, base=self, **changes)

    def key(self) -> tuple[Any, ...]:
        """Return what decides the variant's numbers."""
        same = replace(self.fidelity, name="")
        return same, self.engine, self.device, tuple(sorted(self.options.items()))


def variants(env: Environment, settings: Sequence[str]) -> list[Variant]:
    """Return the variants of a scene, the reference first, without those that only bear another name.

    `env` is the reference, the last of the named fidelities: each of them is a variant, with its engine, device and
    options, and all settings are changed of the others, but precision and device of the reference too. Raises
    ValueError for a setting that there is not.
    """
    unknown = set(settings) - set(SETTINGS)
    if unknown:
        raise ValueError(f"--variants takes {', '.join(SETTINGS)}; got {', '.join(sorted(unknown))}")
    reference = Variant.of(env)
    named = [replace(reference, name=name, fidelity=fidelity) for name, fidelity in env.fidelities.items()]
    found = [reference, *named]
    for setting in SETTINGS:
        for base in named if setting in ("precision", "device") else named[:-1]:
            found += _CHANGES[setting](base, env) if setting in settings else ()
    unique: dict[tuple[Any, ...], Variant] = {}
    for variant in found:
        unique.setdefault(variant.key(), variant)
    return list(unique.values())


def refuse_single(env: Environment) -> None:
    """Raise ValueError for a scene that has one fidelity only: nothing of it can be traded."""
    if len(env.fidelities) < 2:
        raise ValueError(
            f"{env.name} has one fidelity, {', '.join(env.fidelities)}, so there is nothing to hold against the other; "
            "name several: a function takes fidelities={'draft': {'dt': 0.02}, 'reference': {'dt': 0.001}}, and a "
            "class has `fidelities`"
        )


def refuse_ladder(ladder: str, known: Collection[str], settings: Collection[str]) -> None:
    """Raise ValueError for a ladder that there is not, and for settings to change beside one that changes none."""
    if ladder not in known:
        raise ValueError(
            f"--ladder takes {', '.join(known)}; got {ladder!r}, so choose one (--variants says what varies)"
        )
    if settings and ladder not in CHANGING:
        raise ValueError(
            f"--variants goes with --ladder {' and '.join(CHANGING)}; got it with --ladder {ladder}, leave out one of "
            "them"
        )


def expected_work(env: Environment) -> float:
    """Return what an episode is expected to cost, beside other variants of its scene."""
    return env.work().count * (SLOWER if env.fidelity.precision == "float64" else 1.0)


def _dts(base: Variant, env: Environment) -> Iterator[Variant]:
    for factor in STEPS:
        dt = env.nearest_dt(base.fidelity.dt * factor)
        fidelity = _change_fidelity(base, f"dt-x{dt / base.fidelity.dt:.3g}", dt=dt)
        yield base.change(fidelity.name, "dt", fidelity=fidelity)


def _resolutions(base: Variant, env: Environment) -> Iterator[Variant]:
    for factor in CELLS if base.fidelity.resolution else ():
        cells = 2 * round(base.fidelity.resolution * factor / 2)  # some scenes take even numbers only
        fidelity = _change_fidelity(base, f"resolution-{cells}", resolution=cells)
        yield base.change(fidelity.name, "resolution", fidelity=fidelity)


def _particles(base: Variant, env: Environment) -> Iterator[Variant]:
    if env.work().unit != "particle-substep":
        return
    for factor in PARTICLES:
        count, sampling = round(base.fidelity.particles * factor), base.fidelity.sampling * math.cbrt(factor)
        changes = {"particles": count} if count else {"sampling": round(sampling, 3)}
        fidelity = _change_fidelity(base, f"particles-x{factor:g}", **changes)
        yield base.change(fidelity.name, "particles", fidelity=fidelity)


def _precisions(base: Variant, env: Environment) -> Iterator[Variant]:
    other = "float64" if base.fidelity.precision == "float32" else "float32"
    fidelity = _change_fidelity(base, other, precision=other)
    yield base.change(fidelity.name, "precision", fidelity=fidelity)


def _stiffnesses(base: Variant, env: Environment) -> Iterator[Variant]:
    option = env.contact_stiffness
    for factor in STIFFNESSES if option else ():
        options = base.options | {option: base.options[option] * factor}
        yield base.change(f"{base.name}-{option}-x{factor:g}", "stiffness", options=options)


def _engines(base: Variant, env: Environment) -> Iterator[Variant]:
    for engine in env.engines:
        if engine != base.engine:
            yield base.change(f"{base.name} on {engine}", "engine", engine=engine)


def _devices(base: Variant, env: Environment) -> Iterator[Variant]:
    for device in env.devices:
        if device != base.device:
            yield base.change(f"{base.name} on {device}", "device", device=device)


def _change_fidelity(base: Variant, what: str, **changes: Any) -> Fidelity:
    return replace(base.fidelity, name=f"{base.fidelity.name}-{what}", **changes)


_CHANGES = {
    "dt": _dts,
    "resolution": _resolutions,
    "particles": _particles,
    "precision": _precisions,
    "stiffness": _stiffnesses,
    "engine": _engines,
    "device": _devices,
}
