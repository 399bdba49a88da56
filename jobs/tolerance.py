"""Choose a fidelity by how far off it may be, from what `landscape study fidelity` measured."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..envs.registry import make
from ..landscapes.identity import MODEL_VERSION
from ..landscapes.plain import digest
from ..landscapes.storage.disk import moved_by
from ..studies.kept import find_fidelity, own_folder

if TYPE_CHECKING:
    from ..envs.base import Environment, Fidelity
    from ..studies.fidelity import FidelityRecord, MeasuredVariant
    from .scene import SceneSpec
    from .watch import Watch

MAX_WORK_RATIO = 2.0  # times the least expected work, beyond which a variant is no candidate


def choose_fidelity(spec: SceneSpec, watch: Watch) -> Fidelity:
    """Return the quickest measured fidelity whose 95th-percentile loss error is within a tolerance, and say why.

    Looks among the user's own studies, then in the gallery's; options of the scene must be those that were measured,
    and so must the engine. Errors may be of the other device; seconds are of this one, and measured now if need be.

    Raises ValueError where the spec names a fidelity too, where its tolerance cannot be read, where nothing was
    measured of the scene with these options, and where no measured fidelity is within the tolerance.
    """
    limit = tolerance_of(spec)
    env = make(spec.name, device=spec.device, engine=spec.engine, **spec.options)
    name = env.name
    if not env.model_version:
        raise ValueError(
            f"--tolerance chooses among stored measurements, and nothing says whether {name} is still what was "
            f"measured; name a fidelity, {', '.join(env.fidelities)}"
        )
    found, source, rows = _candidates(env, spec.options)
    errors = {row.name: off for row in rows if (off := row.p95(relative=True)) is not None}
    within = [row for row in rows if errors.get(row.name, float("inf")) <= limit]
    if not errors:
        raise ValueError(f"the losses of {name} that were measured have no spread to be within a share of ({source})")
    if not within:
        best = min(errors, key=lambda name: errors[name])
        raise ValueError(
            f"no measured fidelity of {name} is within {limit:.3g} of the losses' spread; the best is {best}, "
            f"{errors[best]:.2%} off at the 95th percentile"
        )
    row, known = _quickest(watch, env, within)
    theirs, ours = found.identity[MODEL_VERSION], env.version_on(found.identity["engine"])
    if theirs != ours:
        watch.note(f"warning: measured by {name} model {theirs}; this is model {ours}")
    accuracy = (
        f"its losses are {errors[row.name]:.2%} of their spread off or less in 95 % of {row.comparison.compared} points"
    )
    if row.name == found.reference:
        accuracy = "the others are compared with it, so that its own error is not known"
    watch.note(
        f"{row.name}: the quickest of {len(within)} of {len(rows)} measured that are within {limit:.3g} of the losses' "
        f"spread; {accuracy} ({source}); {known}"
    )
    return row.fidelity


def _quickest(watch: Watch, env: Environment, rows: Sequence[MeasuredVariant]) -> tuple[MeasuredVariant, str]:
    """Return the variant that takes least time on the environment's device, and what is known of that time."""
    from ..studies.variants import expected_work

    if rows[0].device == env.device:
        best = min(rows, key=lambda row: row.seconds)
        return best, f"{best.seconds:.3g} s an episode with gradient on {env.device}, by `landscape study fidelity`"
    made = {row.name: env.remake(fidelity=row.fidelity) for row in rows}
    work = {name: expected_work(one) for name, one in made.items()}
    likely = [row for row in rows if work[row.name] <= MAX_WORK_RATIO * min(work.values())]
    if len(likely) == 1:
        return likely[0], f"the others have {MAX_WORK_RATIO:g} times its work and more; none was timed on {env.device}"
    with watch.busy(f"{env.name}: timing {len(likely)} fidelities on {env.device}, where none was measured"):
        timed = _time(env, [made[row.name] for row in likely])
    best = min(likely, key=lambda row: timed[row.name])
    return best, f"{timed[best.name]:.3g} s an episode with gradient, one alone on {env.device}, timed here"


def _time(env: Environment, variants: Sequence[Environment]) -> dict[str, float]:
    """Time an episode with gradient of each variant [s], by its name; what was timed before is kept.

    It is kept so that the same command chooses the same variant, and continues what it began.
    """
    from dataclasses import asdict

    from ..landscapes.plain import number
    from ..landscapes.storage.files import write_json
    from ..landscapes.storage.records import read_json, reading
    from ..studies import variants as timing

    of = digest([asdict(env.options), env.engine, env.version_on(env.engine), __version__])  # others take another time
    path = own_folder() / f"{env.name}-{env.device}-{of}.seconds.json"
    known: dict[str, float] = {}
    if path.is_file():
        with reading(path, "delete it, and fidelities are timed again"):
            known = {name: number(seconds) for name, seconds in read_json(path).items()}
    timed = {}
    for variant in variants:
        key = f"{variant.fidelity.name} {digest(variant.fidelity.record())}"
        if key not in known:
            known[key] = timing.seconds_with_gradient(variant)
            with moved_by("XDG_DATA_HOME", "what was measured"):
                write_json(path, known)
        timed[variant.fidelity.name] = known[key]
    return timed


def find_variant(env: Environment, device: str) -> tuple[MeasuredVariant, Path]:
    """Return what was measured of an environment's fidelity on a device, and the file that says so.

    Raises ValueError where nothing was.
    """
    found = find_fidelity(env, device)
    for row in _rows(found[0], env, device) if found else []:
        if found and row.device == device and row.fidelity == env.fidelity:
            return row, found[1]
    raise ValueError(
        f"there is no {device} device here, and no rate of {env.name} at {env.fidelity.name} on one is kept; "
        f"`landscape study fidelity {env.name} --device {device}` measures it where there is one"
    )


def tolerance_of(spec: SceneSpec) -> float:
    """Return the tolerance of a scene. Raises ValueError where it is no share, and where a fidelity is named too."""
    if spec.fidelity is not None:
        raise ValueError(f"--tolerance chooses the fidelity; got --fidelity {spec.fidelity} too, leave out one of them")
    return read_tolerance(spec.tolerance)


def read_tolerance(given: object) -> float:
    """Return a share of the losses' spread given as 5% or 0.05. Raises ValueError where it is neither."""
    text = str(given).strip()
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise ValueError(f"--tolerance takes a share of the losses' spread such as 5% or 0.05; got {text!r}")
    return value


def _candidates(env: Environment, options: Mapping[str, Any]) -> tuple[FidelityRecord, Path, Sequence[MeasuredVariant]]:
    """Return the study to choose from, its file, and its variants that solve the same problem on the engine."""
    measuring = [
        "landscape",
        "study",
        "fidelity",
        env.name,
        *(f"--set={key}={value}" for key, value in options.items()),
    ]
    found = find_fidelity(env, env.device)
    if found is None:
        said = f"no fidelities of {env.name} with these options are measured"
        raise ValueError(f"{said}; `{shlex.join(measuring)}` measures them")
    rows = _rows(found[0], env, env.device)
    if not rows:
        measuring += ["--engine", env.engine]
        raise ValueError(f"{found[1]} holds no variant of engine {env.engine}; `{shlex.join(measuring)}` measures them")
    return *found, rows


def _rows(found: FidelityRecord, env: Environment, device: str) -> Sequence[MeasuredVariant]:
    """Return the variants that solve the same problem on the engine, on a device if there are any.

    What had the name of a fidelity whose settings have changed since is left out.
    """
    options = found.identity["options"]
    rows = [row for row in found.variants if row.engine == env.engine and row.options == options]
    rows = [row for row in rows if env.fidelities.get(row.name, row.fidelity) == row.fidelity]
    return [row for row in rows if row.device == device] or rows
