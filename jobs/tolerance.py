"""Choose a fidelity by how far off it may be, from what `landscape tradeoff` measured."""

from __future__ import annotations

import hashlib
import json
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from platformdirs import user_data_path

from ..envs.registry import make
from .variants import expected_work

if TYPE_CHECKING:
    from ..envs.base import Environment, Fidelity
    from .scene import SceneSpec
    from .watch import Watch

Row = Mapping[str, Any]
FARTHER = 2.0  # times the least expected work, beyond which a rung is no candidate
ENOUGH, SHORTEST = 1e6, 0.05  # work of an episode that is timed, if it can be shortened so far; least share of it


def keep(report: Mapping[str, Any]) -> Path:
    """Keep a report where `choose_fidelity` finds it, in the user's data folder, in the place of an earlier one."""
    from ..landscapes.storage.records import write_record

    identity = report["identity"]
    path = _kept(str(report["env"]), identity["options"], identity["device"])
    write_record(path, report)
    return path


def choose_fidelity(spec: SceneSpec, watch: Watch) -> Fidelity:
    """Return the quickest measured fidelity whose 95th-percentile loss error is within a tolerance, and say why.

    Looks among the user's own reports, then in the gallery's; options of the scene must be those that were measured,
    and so must the engine. Errors may be of the other device; seconds are of this one, and measured now if need be.
    """
    if spec.fidelity is not None:
        raise ValueError(f"--tolerance chooses the fidelity; got --fidelity {spec.fidelity} too, leave out one of them")
    tolerance = str(spec.tolerance)
    limit, relative = read_tolerance(tolerance)
    env = make(spec.name, device=spec.device, engine=spec.engine, **spec.options)
    name = env.name
    report, source, rows = _measured(env, spec.options)
    from ..envs.base import Fidelity
    from ..landscapes.measures.fidelity import p95

    errors = {row["name"]: off for row in rows if (off := p95(row, relative=relative)) is not None}
    within = [row for row in rows if errors.get(row["name"], float("inf")) <= limit]
    if not within:
        best = min(errors, key=lambda rung: errors[rung])
        raise ValueError(
            f"no measured fidelity of {name} is within {tolerance}; the best is {best}, "
            f"{_amount(errors[best], relative, report)} off at the 95th percentile"
        )
    row, known = _quickest(watch, env, within)
    if (ours := _code(env, report)) != (theirs := report["identity"]["code"]):
        said = f"measured with another version of the code of {name}, {theirs}, this is {ours}"
        watch.note(f"warning: {said}")
    amount = _amount(errors[row["name"]], relative, report)
    accuracy = f"its losses are {amount} off or less in 95 % of {row['compared']} points"
    if row["name"] == report["reference"]:
        accuracy = "it is what the others are held against, so that its own error is not known"
    watch.note(
        f"{row['name']}: the quickest of {len(within)} of {len(rows)} measured that are within {tolerance}; {accuracy} "
        f"({source}); {known}"
    )
    return Fidelity(**row["fidelity"])


def _quickest(watch: Watch, env: Environment, rows: Sequence[Row]) -> tuple[Row, str]:
    """Return the rung that takes least time on the environment's device, and what is known of that time."""
    if rows[0]["device"] == env.device:
        best = min(rows, key=lambda row: float(row["seconds"]["with_gradient"]))
        seconds = float(best["seconds"]["with_gradient"])
        return best, f"{seconds:.3g} s an episode with gradient on {env.device}, by `landscape tradeoff`"
    made = {row["name"]: _made(env, row) for row in rows}
    work = {name: expected_work(one) for name, one in made.items()}
    likely = [row for row in rows if work[row["name"]] <= FARTHER * min(work.values())]
    if len(likely) == 1:
        return likely[0], f"the others have {FARTHER:g} times its work and more; none was timed on {env.device}"
    with watch.busy(f"{env.name}: timing {len(likely)} fidelities on {env.device}, where none was measured"):
        timed = _timed(env, [made[row["name"]] for row in likely])
    best = min(likely, key=lambda row: timed[row["name"]])
    return best, f"{timed[best['name']]:.3g} s an episode with gradient, one alone on {env.device}, timed here"


def _made(env: Environment, row: Row) -> Environment:
    """Make the environment of a rung on the device of another."""
    from ..envs.base import Fidelity

    fidelity = Fidelity(**row["fidelity"])
    return make(env.name, fidelity=fidelity, device=env.device, engine=env.engine, **asdict(env.options))


def _timed(env: Environment, rungs: Sequence[Environment]) -> dict[str, float]:
    """Time an episode with gradient of each rung [s], by its name; what was timed before is kept.

    It is kept so that the same command chooses the same rung, and goes on with what it began.
    """
    from ..landscapes.storage.files import write_json
    from ..landscapes.storage.records import number, read_json, reading

    path = _kept(env.name, asdict(env.options), env.device).with_suffix(f".{env.engine}-{env.code}.seconds.json")
    known: dict[str, float] = {}
    if path.is_file():
        with reading(path, "delete it, and fidelities are timed anew"):
            known = {name: number(seconds) for name, seconds in read_json(path).items()}
    for rung in rungs:
        if rung.fidelity.name not in known:
            known[rung.fidelity.name] = _seconds(rung)
            write_json(path, known)
    return known


def _seconds(env: Environment) -> float:
    """Time an episode with gradient at the middle of the box, of a long one the beginning [s].

    It is run twice, since the first may compile.
    """
    whole, horizon = env.work().count, getattr(env.options, "horizon", None)
    if horizon and whole > ENOUGH:
        how = {**asdict(env.options), "horizon": horizon * max(SHORTEST, ENOUGH / whole)}
        env = make(env.name, fidelity=env.fidelity, device=env.device, engine=env.engine, **how)
    env.prepare()
    x = env.space.center[None]
    env.evaluate(x)
    began = time.perf_counter()
    env.evaluate(x)
    return (time.perf_counter() - began) * whole / env.work().count


def _code(env: Environment, report: Mapping[str, Any]) -> str:
    from ..envs.code import code_digest

    return code_digest(type(env), report["identity"]["engine"])


def kept_rung(env: Environment, device: str) -> tuple[Mapping[str, Any], Path]:
    """Return what was measured of an environment's fidelity on a device, and the file that says so."""
    found = _found(env.name, asdict(env.options), device)
    for row in _rows(found[0], env.engine, device) if found else []:
        if found and row["device"] == device and row["fidelity"] == asdict(env.fidelity):
            return row, found[1]
    raise ValueError(
        f"there is no {device} device here, and no rate of {env.name} at {env.fidelity.name} on one is kept; "
        f"`landscape tradeoff {env.name} --device {device}` measures it where there is one"
    )


def read_tolerance(text: str) -> tuple[float, bool]:
    """Return a tolerance and whether it is a share of the spread (5%) or in the loss's unit (0.05)."""
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise ValueError(f"--tolerance takes a share such as 5%, or a number in the loss's unit; got {text!r}")
    return value, text.endswith("%")


def _measured(env: Environment, options: Mapping[str, Any]) -> tuple[dict[str, Any], Path, Sequence[Mapping[str, Any]]]:
    """Return the report to choose from, the file it is in, and its rungs that solve the same problem on the engine."""
    measuring = ["landscape", "tradeoff", env.name, *(f"--set={key}={value}" for key, value in options.items())]
    found = _found(env.name, asdict(env.options), env.device)
    if found is None:
        said = f"no fidelities of {env.name} with these options are measured"
        raise ValueError(f"{said}; `{shlex.join(measuring)}` measures them")
    rows = _rows(found[0], env.engine, env.device)
    if not rows:
        measuring += ["--engine", env.engine]
        raise ValueError(f"{found[1]} holds no rung of engine {env.engine}; `{shlex.join(measuring)}` measures them")
    return *found, rows


def _kept(name: str, options: Mapping[str, Any], device: str) -> Path:
    digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()[:6]
    return user_data_path("gradscape") / "tradeoff" / f"{name}-{device}-{digest}.json"


def _found(name: str, options: dict[str, Any], device: str) -> tuple[dict[str, Any], Path] | None:
    """Return the report to choose from, and the file it is in."""
    devices = (device, *({"cpu", "cuda"} - {device}))
    gallery = Path(str(resources.files(f"{__package__}.gallery"))) / "data" / "tradeoff"
    kept = [_kept(name, options, where) for where in devices]
    for path in (*kept, *(gallery / f"{name}-{where}.json" for where in devices)):
        if path.is_file():
            report = _read(name, path)
            if report["identity"]["options"] == options:
                return report, path
    return None


def _read(name: str, path: Path) -> dict[str, Any]:
    """Return what `landscape tradeoff` left in a file, all that is needed of it at hand."""
    from ..envs.base import Fidelity
    from ..landscapes.measures.fidelity import p95
    from ..landscapes.storage.records import number, optional, read_json, reading, text

    with reading(path, f"delete it, and `landscape tradeoff {name}` measures it anew"):
        report = read_json(path)
        identity, rows = report["identity"], report["rungs"]
        for said in (report["reference"], report["loss_unit"], identity["code"], identity["engine"]):
            text(said)
        for row in rows:
            Fidelity(**row["fidelity"])
            for said in (row["name"], row["engine"], row["device"]):
                text(said)
            for found in (p95(row, relative=True), p95(row, relative=False), row["compared"]):
                optional(number, found)
            number(row["seconds"]["with_gradient"])
            dict(row["options"])
        dict(identity["options"])
    return report


def _rows(report: Mapping[str, Any], engine: str, device: str) -> Sequence[Mapping[str, Any]]:
    """Return the rungs that solve the same problem on an engine, on a device if there are any."""
    options = report["identity"]["options"]
    rows = [row for row in report["rungs"] if row["engine"] == engine and row["options"] == options]
    return [row for row in rows if row["device"] == device] or rows


def _amount(value: float, relative: bool, report: Mapping[str, Any]) -> str:
    return f"{value:.2%} of the losses' spread" if relative else f"{value:.3g} {report['loss_unit']}".rstrip()
