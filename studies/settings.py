"""The numeric settings of a scene: their possible values, and the environments with them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from .stability import Axis

if TYPE_CHECKING:
    from ..envs.base import Environment

DT, RESOLUTION, BOX, HORIZON = "dt", "resolution", "box", "horizon"
FACTORS = {DT: 2.0, RESOLUTION: math.sqrt(2.0), BOX: 2.0, HORIZON: 2.0}  # from value to value; else of an option:
OPTION_FACTOR = 4.0
COUNTS = {DT: 6, RESOLUTION: 4, BOX: 6, HORIZON: 3}  # beyond the base; else of an option:
OPTION_COUNT = 7
MAX_WORK = 16.0  # times the work of the base, beyond which a setting is left out
ROUNDING = 1e-6  # of an episode's length, by which one of rounded steps may differ

PRECISIONS = ("float32", "float64")
Values = Mapping[str, float]
Pair = tuple[str, str]


@dataclass(frozen=True)
class Setting:
    """A numeric setting with its default, `base`, and its allowed range.

    `ends` are the directions to search: largest, smallest, or both. A setting whose range begins at zero is `linear`.
    """

    name: str
    unit: str
    base: float
    ends: tuple[str, ...]
    least: float = 0.0
    most: float = math.inf
    linear: bool = False

    def grid(self, end: str) -> list[float]:
        """Return the values to try towards an end, from the base on."""
        if self.linear:
            goal = self.most if end == "largest" else self.least
            return [self.base + share * (goal - self.base) for share in (0, 0.25, 0.5, 0.75, 1)]
        factor, count = FACTORS.get(self.name, OPTION_FACTOR), COUNTS.get(self.name, OPTION_COUNT)
        factor = factor if end == "largest" else 1 / factor
        return [min(self.most, max(self.least, self.base * factor**k)) for k in range(count + 1)]


@dataclass(frozen=True)
class SceneSettings:
    """The numeric settings of a scene at a fidelity, its `base`, and their possible values."""

    base: Environment
    _known: dict[tuple[str, float], float] = field(default_factory=dict)
    _works: dict[float, float] = field(default_factory=dict)

    @cached_property
    def all(self) -> dict[str, Setting]:
        """Every setting of the scene by name: dt, resolution, options that are positive numbers, box, horizon."""
        env, fidelity = self.base, self.base.fidelity
        found = []
        if fidelity.dt:
            found.append(Setting(DT, "s", fidelity.dt, ("largest",), most=env.control_step or math.inf))
        if fidelity.resolution:
            found.append(Setting(RESOLUTION, "cells", fidelity.resolution, ("largest", "smallest"), least=2))
        found += [setting for one in fields(env.options) if (setting := self._option(one.name))]
        if env.beyond_box:
            found.append(Setting(BOX, "\N{MULTIPLICATION SIGN} the box", 1.0, ("largest",)))
        if env.horizon:
            known = {one.name for one in fields(env.options)}
            most = _most(env.options, env.horizon_option) if env.horizon_option in known else math.inf
            unit = "\N{MULTIPLICATION SIGN} the episode" if env.model_version else ""
            found.append(Setting(HORIZON, unit, env.horizon, ("largest",), most=most))
        return {setting.name: setting for setting in found}

    @cached_property
    def usual(self) -> list[str]:
        """The settings changed by default: not every option is a stiffness."""
        stiff = {self.base.contact_stiffness, *([self.base.material_range.option] if self.base.material_range else [])}
        return [name for name in self.all if name in {DT, RESOLUTION, BOX, HORIZON} | stiff]

    @property
    def usual_pairs(self) -> list[Pair]:
        """The pairs mapped by default: the step against the settings that limit it, three at most."""
        if DT not in self.all:
            return []
        others = [name for name in self.usual if name not in (DT, HORIZON)]
        options = [name for name in others if name not in FACTORS]
        last = [name for name in self.usual if name == HORIZON and len(others) < 2]
        return [(DT, name) for name in [*options, *(name for name in others if name in FACTORS), *last][:3]]

    def pick(self, names: Sequence[str]) -> list[Setting]:
        """Return the settings with these names, or the usual ones. Raises ValueError for an unknown one."""
        if unknown := [name for name in names if name not in self.all]:
            raise ValueError(f"{self.base.name} has settings {', '.join(self.all) or 'none'}; got {', '.join(unknown)}")
        return [self.all[name] for name in names or self.usual]

    def pick_pairs(self, pairs: Sequence[str]) -> list[Pair]:
        """Return pairs of settings given as a:b. Raises ValueError for an invalid pair."""
        found = list[Pair]()
        for pair in pairs:
            first, _, second = pair.partition(":")
            if pair != "none":
                if not second or first == second:
                    raise ValueError(f"--pairs takes two settings, such as dt:{BOX}, or none; got {pair!r}")
                found.append((self.pick([first])[0].name, self.pick([second])[0].name))
        return found

    def pick_precisions(self, names: Sequence[str]) -> list[str]:
        """Return the precisions with these names, or all, the base's own first.

        Raises ValueError for an unknown one.
        """
        if unknown := [name for name in names if name not in PRECISIONS]:
            raise ValueError(f"--precisions takes {', '.join(PRECISIONS)}; got {', '.join(unknown)}")
        own = self.base.fidelity
        if names or not own.dt:
            return list(names) or [own.precision]
        return [own.precision, *(one for one in PRECISIONS if one != own.precision and self._makes(one))]

    def make(self, values: Values, precision: str, fidelity: str | None = None) -> Environment:
        """Make the environment with these values, at the base's fidelity or a named one.

        A named one is only used if no setting is part of the fidelity. Raises ValueError where the scene refuses it.
        """
        own = self.base.fidelity
        if fidelity is None:
            changes = {name: values[name] for name in (DT, RESOLUTION) if name in values}
            if RESOLUTION in changes:
                changes[RESOLUTION] = round(changes[RESOLUTION])
            name = "-".join([own.name, precision, *(f"{key}-{value:.6g}" for key, value in changes.items())])
            own = replace(own, name=name, precision=precision, **changes)  # type: ignore[arg-type] # each of its kind
        else:
            own = self.base.fidelities[fidelity]
        options: dict[str, Any] = {name: value for name, value in values.items() if name not in FACTORS}
        env = self.base.remake(fidelity=own, **options)
        return env.with_horizon(values[HORIZON]) if HORIZON in values else env

    def axis(self, setting: Setting) -> Axis:
        """Return the scale of a setting."""
        near = {DT: self._settle_dt, RESOLUTION: self._settle_resolution}.get(setting.name, float)

        def settle(value: float) -> float:
            if (setting.name, value) not in self._known:
                found = near(value)
                same = math.isclose(found, setting.base, rel_tol=ROUNDING)
                self._known[setting.name, value] = setting.base if same else found
            return self._known[setting.name, value]

        return Axis(settle, span=setting.most - setting.least if setting.linear else 0.0)

    def work(self, setting: Setting, value: float) -> float:
        """Return the work of an episode relative to the base, with one changed setting."""
        if setting.name in (DT, HORIZON):
            return (setting.base / value) if setting.name == DT else value / setting.base
        if setting.name != RESOLUTION:
            return 1.0
        if value not in self._works:
            self._works[value] = 0.0  # of what is refused
            with suppress(ValueError):
                made = self.make({RESOLUTION: value}, self.base.fidelity.precision)
                self._works[value] = made.work().count / self.base.work().count
        return self._works[value]

    def _makes(self, precision: str) -> bool:
        try:
            self.make({}, precision)
        except ValueError:
            return False
        return True

    def _option(self, name: str) -> Setting | None:
        """Return an option as a setting: a number above zero, or the scene's material range."""
        value, ends = getattr(self.base.options, name), self.base.material_range
        if ends is not None and ends.option == name and not ends.softest > 0:
            return Setting(name, "", value, ("largest", "smallest"), ends.softest, ends.stiffest, linear=True)
        if name == self.base.horizon_option or isinstance(value, bool) or not isinstance(value, float) or not value > 0:
            return None
        return Setting(name, "", value, ("largest", "smallest"), most=_most(self.base.options, name))

    def _settle_dt(self, dt: float) -> float:
        """Return the nearest step that divides an episode, and a control step where controls are constant."""
        if self.base.control_step:
            return self.base.nearest_dt(dt)
        with suppress(ValueError):  # refused: whoever tries it will say so
            made = self.make({DT: dt}, self.base.fidelity.precision)
            if made.work().count != self.base.work().count:  # or its work says nothing of its steps
                own = self.base.work().count * self.base.fidelity.dt
                return own / made.work().count
        return dt

    def _settle_resolution(self, cells: float) -> float:
        """Return the nearest even number of cells, which all scenes accept; the base stays."""
        base = self.base.fidelity.resolution
        return float(base) if round(cells) == base else float(max(2, 2 * round(cells / 2)))


def values_key(values: Values) -> list[tuple[str, str]]:
    """Return values of settings as text, in a fixed order."""
    return sorted((name, f"{value:.12g}") for name, value in values.items())


def _most(options: Any, name: str) -> float:
    """Return the largest allowed value of an option."""
    (found,) = (one for one in fields(options) if one.name == name)
    return float(found.metadata.get("most") or math.inf)
