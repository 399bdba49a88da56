"""What `landscape check` does and prints: what it will cost, then a line for each check."""

from __future__ import annotations

import json
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from .console import duration, read_settings
from .envs.registry import make
from .landscapes.capacity import Need, require
from .tables import table
from .terminal import Console

if TYPE_CHECKING:
    from .envs.base import Environment
    from .landscapes.extremes import Variant
    from .landscapes.finding import Finding

FACTORS = (1, 2, 4, 8)  # of the fidelity's time step, and of the scene's horizon
STYLES = {"pass": "green", "fail": "bold red", "skip": "dim", "known": "yellow", "unexpected": "bold red"}


def check(
    name: str,
    *,
    fidelity: str | None,
    device: str,
    engine: str,
    settings: Sequence[str],
    points: int,
    seed: int,
    as_json: bool,
) -> None:
    """Check an environment, print what was found, and leave with 0 where it passes, 1 where it fails."""
    aside, options = Console(stderr=True, soft_wrap=True, highlight=False), read_settings(settings)
    console = aside if as_json else Console(soft_wrap=True, highlight=False)
    scene = Scene(name, make(name, fidelity=fidelity, device=device, engine=engine, **options), options)
    require("points", points, partial(_need, scene.env.space.dim))
    found: list[Finding] = []
    try:
        with aside.status(f"{name}: preparing (kernels are compiled once, then kept)") as status:
            aside.print(_announcement(scene.env, points), markup=False)
            for finding in _findings(scene, points, seed, lambda what: status.update(f"{name}: {what}")):
                found.append(finding)
                status.stop()  # it would be drawn into the line
                _show(finding, console)
                status.start()
    except KeyboardInterrupt:
        aside.print(f"stopped after {len(found)} checks; nothing is kept, the same command begins again")
        sys.exit(130)
    passed = not any(finding.bad for finding in found)
    _conclude(found, passed, console)
    if as_json:
        print(json.dumps(_report(scene.env, found, passed, points, seed)))
    sys.exit(0 if passed else 1)


@dataclass(frozen=True)
class Scene:
    """An environment, by the name it is registered under, and the options it was made with."""

    name: str
    env: Environment
    options: dict[str, Any]

    def remade(self, **changes: Any) -> Environment:
        """Return the environment with another fidelity or with other options."""
        settings = {"fidelity": self.env.fidelity, "device": self.env.device, "engine": self.env.engine}
        return make(self.name, **{**settings, **self.options, **changes})


def _findings(scene: Scene, points: int, seed: int, follow: Callable[[str], None]) -> Iterator[Finding]:
    from .landscapes.conformance import check as conformance

    return conformance(
        scene.env,
        points=points,
        seed=seed,
        precision=scene.env.fidelity.precision,
        twin=_twin(scene),
        variants=[*_time_steps(scene), *_materials(scene), *_horizons(scene)],
        expected=scene.env.known_failures.get(scene.env.fidelity.name),
        follow=follow,
    )


def _need(dim: int, points: int) -> Need:
    """Return what the points and gradients of all checks take, a copy of each included."""
    from .landscapes.conformance import episodes

    return Need(4.0 * 8 * dim * sum(episodes(dim, points)))


def _announcement(env: Environment, points: int) -> str:
    """Return what is checked and how long it will take, by the time of two episodes."""
    from .landscapes.conformance import episodes

    env.prepare()
    point = env.space.center[None]
    env.evaluate(point)  # the first one may compile
    costs = []
    for grad in (False, True):
        start = time.perf_counter()
        env.evaluate(point, grad=grad)
        costs.append(time.perf_counter() - start)
    plain, sloped = episodes(env.space.dim, points)
    sloped += 2 * (sum(FACTORS) + 4)  # two points over longer horizons, time steps and materials
    seconds = (plain * costs[0] + sloped * costs[1]) / env.threads
    subject = f"{env.name} · {env.fidelity.name} · {env.device} · {env.engine} · {points} points"
    return f"{subject}: some {plain} episodes and {sloped} with gradients, about {duration(seconds)}"


def _twin(scene: Scene) -> Callable[[], Environment] | None:
    """Return what makes the environment in the other precision, if it has one."""
    own = scene.env.fidelity
    if not own.dt:  # a formula, not a simulation
        return None
    other = "float32" if own.precision == "float64" else "float64"
    make = partial(scene.remade, fidelity=replace(own, name=f"{own.name} in {other}", precision=other))
    with suppress(ValueError):  # refused: it computes in its own precision only
        make()
        return make
    return None


def _time_steps(scene: Scene) -> list[Variant]:
    from .landscapes.extremes import Variant

    if not scene.env.fidelity.dt:
        return [Variant("dt 1x to 8x", why="it has no time step")]
    found: list[Variant] = []
    taken: dict[float, int] = {}
    for factor in FACTORS:
        dt = scene.env.nearest_dt(factor * scene.env.fidelity.dt)
        if dt in taken:
            why = f"the nearest step that fits into a control step is that of dt {taken[dt]}x"
            found.append(Variant(f"dt {factor}x", why=why))
        else:
            found.append(_time_step(scene, factor, dt))
            taken[dt] = factor
    return found


def _time_step(scene: Scene, factor: int, dt: float) -> Variant:
    from .landscapes.extremes import Variant

    if factor == 1:
        return Variant("dt 1x", lambda: scene.env)
    own = scene.env.fidelity
    fidelity = replace(own, name=f"{own.name}, dt {factor}x", dt=dt)
    made, note = partial(scene.remade, fidelity=fidelity), ""
    if abs(dt - factor * own.dt) > 1e-6 * dt:
        note = f"{dt / own.dt:.3g}x, the nearest step that fits into a control step"
    with suppress(Exception):  # the check itself will meet it, and say so
        work, before = made().work().count, scene.env.work().count
        longer = dt / own.dt * work / before
        if work != before and abs(longer - 1) > 1e-3:
            note = f"its steps are rounded: an episode is {longer:.3g} times as long"
    return Variant(f"dt {factor}x", made, why=note)


def _materials(scene: Scene) -> list[Variant]:
    """Return the softest and the stiffest of what a scene is made of, by its options or its parameters."""
    from .landscapes.extremes import Variant

    if (ends := scene.env.material_range) is not None:
        values = (ends.softest, ends.stiffest)
        return [Variant(f"{ends.option} {value:g}", partial(scene.remade, **{ends.option: value})) for value in values]
    space = scene.env.space
    stiff = [space.names.index(name) for name in scene.env.stiffness_parameters]
    if not stiff:
        return [Variant("softest and stiffest", why="it offers no stiffness to set")]
    found = []
    for name, bound in (("softest", space.lower), ("stiffest", space.upper)):
        x = space.center[None].clone()
        x[0, stiff] = bound[stiff]
        found.append(Variant(name, lambda: scene.env, x=x))
    return found


def _horizons(scene: Scene) -> list[Variant]:
    from .landscapes.extremes import Variant

    if "horizon" not in {field.name for field in fields(scene.env.options)}:
        return [Variant("horizon 1x to 8x", why="it has no option `horizon`")]
    own = scene.env.options.horizon
    longer = [Variant(f"horizon {factor}x", partial(scene.remade, horizon=factor * own)) for factor in FACTORS[1:]]
    return [Variant("horizon 1x", lambda: scene.env), *longer]


def _show(finding: Finding, console: Console) -> None:
    line = Text(f"{finding.outcome:10}", STYLES[finding.outcome])
    line.append(f"{finding.check:25} {finding.figure}", "")
    if finding.why:
        line.append(f" ({finding.why})", STYLES[finding.outcome])
    console.print(line)
    if finding.table:
        console.print(_table(finding))


def _table(finding: Finding) -> Table:
    headings = ("compared", "failed", "cosine", "sign right", "relative error, median")
    found = table("step [of the box]", *headings, box=SIMPLE)
    for column in found.columns[1:]:
        column.justify = "right"
    formats = {"compared": ".0f", "failed": ".0f", "cosine": ".4f", "sign": ".0%", "error": ".1e"}
    for row in finding.table:
        cells = ("-" if row[key] is None else format(row[key], form) for key, form in formats.items())
        found.add_row(f"{row['step']:.0e}", *cells)
    return found


def _conclude(found: Sequence[Finding], passed: bool, console: Console) -> None:
    counts = {kind: sum(finding.outcome == kind for finding in found) for kind in STYLES}
    said = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    console.print(Text(f"{'passes' if passed else 'fails'}: {said}", STYLES["pass" if passed else "fail"]))


def _report(env: Environment, found: Sequence[Finding], passed: bool, points: int, seed: int) -> dict[str, Any]:
    return {
        "env": env.name,
        "fidelity": env.fidelity.name,
        "settings": asdict(env.fidelity),
        "options": asdict(env.options),
        "device": env.device,
        "engine": env.engine,
        "points": points,
        "seed": seed,
        "passed": passed,
        "checks": [_record(finding) for finding in found],
        "command": shlex.join(["landscape", *sys.argv[1:]]),
    }


def _record(finding: Finding) -> dict[str, Any]:
    """Return a finding as JSON has it, which knows no infinity."""

    def plain(numbers: Mapping[str, float | None]) -> dict[str, float | None]:
        return {name: value if value is not None and math.isfinite(value) else None for name, value in numbers.items()}

    record = {name: getattr(finding, name) for name in ("check", "outcome", "figure", "why")}
    return {**record, "numbers": plain(finding.numbers or {}), "table": [plain(row) for row in finding.table]}
