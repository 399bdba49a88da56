"""The rungs of `landscape tradeoff`: what can be cheaper or dearer about a scene, one knob at a time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from .envs.base import Environment, Fidelity
from .envs.registry import make

LADDERS = ("dt", "resolution", "particles", "precision", "stiffness", "engine", "device")
STEPS, CELLS, PARTICLES, STIFFNESSES = (0.5, 2.0, 4.0), (2 / 3, 1.5), (0.5, 2.0), (0.25, 0.5, 2.0, 4.0)
SLOWER = 1.5  # times what float32 takes, float64 is expected to take


@dataclass(frozen=True)
class Rung:
    """One way to simulate a scene: a fidelity, an engine, a device, options; `ladder` is the knob that was turned.

    `base` is the rung of the same scene that the knob was turned on.
    """

    name: str
    ladder: str
    fidelity: Fidelity
    engine: str
    device: str
    options: dict[str, Any]
    base: Rung | None = field(default=None, compare=False)

    @classmethod
    def of(cls, env: Environment) -> Rung:
        """Return the rung that an environment is."""
        return cls(env.fidelity.name, "named", env.fidelity, env.engine, env.device, asdict(env.options))

    def make(self, scene: str) -> Environment:
        """Make the environment of this rung.

        Raises ValueError where the scene refuses it, or would round its steps to an episode of another length.
        """
        settings: dict[str, Any] = {"engine": self.engine, "device": self.device, **self.options}
        env = make(scene, fidelity=self.fidelity, **settings)
        if self.ladder == "dt" and self.base is not None:
            longer = _length(env) / _length(self.base.make(scene))
            if abs(longer - 1) > 1e-3:
                raise ValueError(
                    f"{scene} cuts an episode into whole steps; with dt {self.fidelity.dt:.4g} s it would be "
                    f"{longer:.3g} times as long"
                )
        return env

    def turned(self, name: str, ladder: str, **changes: Any) -> Rung:
        """Return this rung with a knob turned."""
        return replace(self, name=name, ladder=ladder, base=self, **changes)

    def key(self) -> tuple[Any, ...]:
        """Return what decides the rung's numbers."""
        same = replace(self.fidelity, name="")
        return same, self.engine, self.device, tuple(sorted(self.options.items()))


def rungs(env: Environment, ladders: Sequence[str]) -> list[Rung]:
    """Return the rungs of a scene, the reference first, without those that only bear another name.

    `env` is the reference, the last of the named fidelities: each of them is a rung, with its engine, device and
    options, and all knobs are turned on the others, but precision and device on the reference too.
    """
    unknown = set(ladders) - set(LADDERS)
    if unknown:
        raise ValueError(f"--ladder takes {', '.join(LADDERS)}; got {', '.join(sorted(unknown))}")
    reference = Rung.of(env)
    named = [replace(reference, name=name, fidelity=fidelity) for name, fidelity in env.fidelities.items()]
    found = [reference, *named]
    for ladder in LADDERS:
        for base in named if ladder in ("precision", "device") else named[:-1]:
            found += _TURNS[ladder](base, env) if ladder in ladders else ()
    unique: dict[tuple[Any, ...], Rung] = {}
    for rung in found:
        unique.setdefault(rung.key(), rung)
    return list(unique.values())


def refuse_single(env: Environment) -> None:
    """Refuse a scene that has one fidelity only: nothing of it can be traded."""
    if len(env.fidelities) < 2:
        raise ValueError(f"{env.name} has fidelity {', '.join(env.fidelities)} only; there is nothing to trade")


def expected_work(env: Environment) -> float:
    """Return what an episode is expected to cost, beside other rungs of its scene."""
    return env.work().count * (SLOWER if env.fidelity.precision == "float64" else 1.0)


def _length(env: Environment) -> float:
    """Return what is proportional to the time an episode simulates, at fixed size of the scene."""
    return env.work().count * env.fidelity.dt


def _dts(base: Rung, env: Environment) -> Iterator[Rung]:
    for factor in STEPS:
        dt = env.nearest_dt(base.fidelity.dt * factor)
        fidelity = _changed(base, f"dt-x{dt / base.fidelity.dt:.3g}", dt=dt)
        yield base.turned(fidelity.name, "dt", fidelity=fidelity)


def _resolutions(base: Rung, env: Environment) -> Iterator[Rung]:
    for factor in CELLS if base.fidelity.resolution else ():
        cells = 2 * round(base.fidelity.resolution * factor / 2)  # some scenes take even numbers only
        fidelity = _changed(base, f"resolution-{cells}", resolution=cells)
        yield base.turned(fidelity.name, "resolution", fidelity=fidelity)


def _particles(base: Rung, env: Environment) -> Iterator[Rung]:
    if env.work().unit != "particle-substep":
        return
    for factor in PARTICLES:
        count, sampling = round(base.fidelity.particles * factor), base.fidelity.sampling * math.cbrt(factor)
        changes = {"particles": count} if count else {"sampling": round(sampling, 3)}
        fidelity = _changed(base, f"particles-x{factor:g}", **changes)
        yield base.turned(fidelity.name, "particles", fidelity=fidelity)


def _precisions(base: Rung, env: Environment) -> Iterator[Rung]:
    other = "float64" if base.fidelity.precision == "float32" else "float32"
    fidelity = _changed(base, other, precision=other)
    yield base.turned(fidelity.name, "precision", fidelity=fidelity)


def _stiffnesses(base: Rung, env: Environment) -> Iterator[Rung]:
    option = env.contact_stiffness
    for factor in STIFFNESSES if option else ():
        options = base.options | {option: base.options[option] * factor}
        yield base.turned(f"{base.name}-{option}-x{factor:g}", "stiffness", options=options)


def _engines(base: Rung, env: Environment) -> Iterator[Rung]:
    for engine in env.engines:
        if engine != base.engine:
            yield base.turned(f"{base.name} on {engine}", "engine", engine=engine)


def _devices(base: Rung, env: Environment) -> Iterator[Rung]:
    for device in env.devices:
        if device != base.device:
            yield base.turned(f"{base.name} on {device}", "device", device=device)


def _changed(base: Rung, what: str, **changes: Any) -> Fidelity:
    return replace(base.fidelity, name=f"{base.fidelity.name}-{what}", **changes)


_TURNS = {
    "dt": _dts,
    "resolution": _resolutions,
    "particles": _particles,
    "precision": _precisions,
    "stiffness": _stiffnesses,
    "engine": _engines,
    "device": _devices,
}
