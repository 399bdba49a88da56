"""Choose a fidelity by how far off it may be, from what `landscape tradeoff` measured."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from platformdirs import user_data_path

from .envs.registry import code_digest, environment_class, make

if TYPE_CHECKING:
    from rich.console import Console

    from .envs.base import Environment, Fidelity


def keep(report: Mapping[str, Any]) -> Path:
    """Keep a report where `chosen` finds it, in the user's data folder, in the place of an earlier one."""
    from .landscapes.files import write_json

    identity = report["identity"]
    path = _kept(str(report["env"]), identity["options"], identity["device"])
    write_json(path, report)
    return path


def chosen(
    console: Console,
    name: str,
    tolerance: str,
    *,
    fidelity: str | None,
    device: str,
    engine: str,
    options: Mapping[str, Any],
) -> Fidelity:
    """Return the cheapest measured fidelity whose 95th-percentile loss error is within a tolerance, and say why.

    Looks among the user's own reports, then in the gallery's; options of the scene must be those that were measured.
    Rungs of the same engine and device count, and of the other device where there are none.
    """
    if fidelity is not None:
        raise ValueError(f"--tolerance chooses the fidelity; got --fidelity {fidelity} too, leave out one of them")
    limit, relative = read_tolerance(tolerance)
    env = make(name, device=device, engine=engine, **options)
    report, source, rows = _measured(env, options)
    from .envs.base import Fidelity
    from .landscapes.tradeoff import cheapest, p95

    row = cheapest(rows, limit, relative=relative)
    if row is None:
        best = min((off, row["name"]) for row in rows if (off := p95(row, relative=relative)) is not None)
        raise ValueError(
            f"no measured fidelity of {name} is within {tolerance}; the best is {best[1]}, "
            f"{_amount(best[0], relative, report)} off at the 95th percentile"
        )
    for warning in _warnings(report, row, code_digest(environment_class(name)), env.device):
        console.print(f"warning: {warning}", markup=False)
    console.print(
        f"{row['name']}: the quickest of {len(rows)} measured that is within {tolerance}; its losses are "
        f"{_amount(p95(row, relative=relative) or 0.0, relative, report)} off or less in 95 % of {row['compared']} "
        f"points, {row['seconds']['with_gradient']:.3g} s an episode with gradient ({source})",
        markup=False,
    )
    return Fidelity(**row["fidelity"])


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
            report: dict[str, Any] = json.loads(path.read_text())
            if report["identity"]["options"] == options:
                return report, path
    return None


def _rows(report: Mapping[str, Any], engine: str, device: str) -> Sequence[Mapping[str, Any]]:
    """Return the rungs that solve the same problem on an engine, on a device if there are any."""
    options = report["identity"]["options"]
    rows = [row for row in report["rungs"] if row["engine"] == engine and row["options"] == options]
    return [row for row in rows if row["device"] == device] or rows


def _amount(value: float, relative: bool, report: Mapping[str, Any]) -> str:
    return f"{value:.2%} of the losses' spread" if relative else f"{value:.3g} {report['loss_unit']}".rstrip()


def _warnings(report: Mapping[str, Any], row: Mapping[str, Any], code: str, device: str) -> list[str]:
    found = []
    if report["identity"]["code"] != code:
        found.append(f"measured with another version of the code, {report['identity']['code']}, this is {code}")
    if row["device"] != device:
        found.append(f"measured on {row['device']}; on {device} another fidelity may be the quickest")
    return found
