"""Choose a fidelity by how far off it may be, from what `landscape tradeoff` measured."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from platformdirs import user_data_path

from .. import __version__
from ..envs.registry import make
from ..landscapes.identity import MODEL_VERSION
from ..landscapes.plain import digest
from ..landscapes.storage.disk import moved_by

if TYPE_CHECKING:
    from ..envs.base import Environment, Fidelity
    from ..landscapes.measures.convergence_record import Convergence
    from ..landscapes.measures.tradeoff import MeasuredVariant, Tradeoff
    from .scene import SceneSpec
    from .watch import Watch

CONVERGED = ".convergence.json"  # how the file of a study of convergence ends, beside the trade-off's
FARTHER = 2.0  # times the least expected work, beyond which a variant is no candidate
ENOUGH, SHORTEST = 1e6, 0.05  # work of an episode that is timed, if it can be shortened so far; least share of it


def keep(found: Tradeoff) -> Path | None:
    """Keep a trade-off where `choose_fidelity` finds it, in the user's data folder, which replaces an earlier one.

    That of a function is not kept: nothing would say when the function has changed.
    """
    from ..landscapes.storage.records import write_record

    if not found.identity.get("model_version"):
        return None
    path = _place(found.env, found.identity["options"], found.identity["device"])
    with moved_by("XDG_DATA_HOME", "what was measured"):
        write_record(path, found.record())
    return path


def keep_convergence(found: Convergence) -> Path | None:
    """Keep a study of convergence beside the trade-off of the same scene, as `keep` does."""
    from ..landscapes.storage.records import write_record

    if not found.identity.get("model_version"):
        return None
    path = _place(found.env, found.identity["options"], found.identity["device"]).with_suffix(CONVERGED)
    with moved_by("XDG_DATA_HOME", "what was measured"):
        write_record(path, found.record())
    return path


def find_convergence(found: Tradeoff) -> Convergence | None:
    """Return the study of convergence that is kept of a trade-off's scene, None where none is of the same model.

    Looks among the user's own studies, then in the gallery's; raises DamagedError where one cannot be read.
    """
    from ..landscapes.measures.convergence_record import Convergence
    from ..landscapes.storage.records import read_json, reading

    about = found.identity
    devices = (about["device"], *({"cpu", "cuda"} - {about["device"]}))
    places = [_place(found.env, about["options"], where) for where in devices]
    gallery = Path(str(resources.files("gradscape.gallery"))) / "data" / "tradeoff"
    for path in (*places, *(gallery / f"{found.env}-{where}.json" for where in devices)):
        if (file := path.with_suffix(CONVERGED)).is_file():
            with reading(
                file, f"delete it, and `landscape tradeoff {found.env} --ladder convergence` measures it anew"
            ):
                study = Convergence.of_record(read_json(file))
            if all(study.identity[key] == about[key] for key in (MODEL_VERSION, "engine", "options")):
                return study
    return None


def choose_fidelity(spec: SceneSpec, watch: Watch) -> Fidelity:
    """Return the quickest measured fidelity whose 95th-percentile loss error is within a tolerance, and say why.

    Looks among the user's own trade-offs, then in the gallery's; options of the scene must be those that were measured,
    and so must the engine. Errors may be of the other device; seconds are of this one, and measured now if need be.

    Raises ValueError where the spec names a fidelity too, where its tolerance cannot be read, where nothing was
    measured of the scene with these options, and where no measured fidelity is within the tolerance.
    """
    tolerance = str(spec.tolerance)
    limit, relative = tolerance_of(spec)
    env = make(spec.name, device=spec.device, engine=spec.engine, **spec.options)
    name = env.name
    if not env.model_version:
        raise ValueError(
            f"--tolerance chooses among stored measurements, and nothing says whether {name} is still what was "
            f"measured; name a fidelity, {', '.join(env.fidelities)}"
        )
    found, source, rows = _candidates(env, spec.options)
    from ..envs.base import Fidelity

    errors = {row.name: off for row in rows if (off := row.comparison.p95(relative=relative)) is not None}
    within = [row for row in rows if errors.get(row.name, float("inf")) <= limit]
    if not within:
        best = min(errors, key=lambda name: errors[name])
        raise ValueError(
            f"no measured fidelity of {name} is within {tolerance}; the best is {best}, "
            f"{_amount(errors[best], relative, found)} off at the 95th percentile"
        )
    row, known = _quickest(watch, env, within)
    theirs, ours = found.identity[MODEL_VERSION], env.version_on(found.identity["engine"])
    if theirs != ours:
        watch.note(f"warning: measured by {name} model {theirs}; this is model {ours}")
    amount = _amount(errors[row.name], relative, found)
    accuracy = f"its losses are {amount} off or less in 95 % of {row.comparison.compared} points"
    if row.name == found.reference:
        accuracy = "it is what the others are held against, so that its own error is not known"
    watch.note(
        f"{row.name}: the quickest of {len(within)} of {len(rows)} measured that are within {tolerance}; {accuracy} "
        f"({source}); {known}"
    )
    return Fidelity(**row.fidelity)


def _quickest(watch: Watch, env: Environment, rows: Sequence[MeasuredVariant]) -> tuple[MeasuredVariant, str]:
    """Return the variant that takes least time on the environment's device, and what is known of that time."""
    if rows[0].device == env.device:
        best = min(rows, key=lambda row: row.seconds)
        return best, f"{best.seconds:.3g} s an episode with gradient on {env.device}, by `landscape tradeoff`"
    made = {row.name: _make(env, row) for row in rows}
    from .variants import expected_work

    work = {name: expected_work(one) for name, one in made.items()}
    likely = [row for row in rows if work[row.name] <= FARTHER * min(work.values())]
    if len(likely) == 1:
        return likely[0], f"the others have {FARTHER:g} times its work and more; none was timed on {env.device}"
    with watch.busy(f"{env.name}: timing {len(likely)} fidelities on {env.device}, where none was measured"):
        timed = _time(env, [made[row.name] for row in likely])
    best = min(likely, key=lambda row: timed[row.name])
    return best, f"{timed[best.name]:.3g} s an episode with gradient, one alone on {env.device}, timed here"


def _make(env: Environment, row: MeasuredVariant) -> Environment:
    """Make the environment of a variant on the device of another."""
    from ..envs.base import Fidelity

    fidelity = Fidelity(**row.fidelity)
    return env.remake(fidelity=fidelity)


def _time(env: Environment, variants: Sequence[Environment]) -> dict[str, float]:
    """Time an episode with gradient of each variant [s], by its name; what was timed before is kept.

    It is kept so that the same command chooses the same variant, and goes on with what it began.
    """
    from ..landscapes.plain import number
    from ..landscapes.storage.files import write_json
    from ..landscapes.storage.records import read_json, reading

    of = f"{env.engine}-{env.version_on(env.engine)}-{__version__}"  # another release may take another time
    path = _place(env.name, asdict(env.options), env.device).with_suffix(f".{of}.seconds.json")
    known: dict[str, float] = {}
    if path.is_file():
        with reading(path, "delete it, and fidelities are timed anew"):
            known = {name: number(seconds) for name, seconds in read_json(path).items()}
    timed = {}
    for variant in variants:
        key = f"{variant.fidelity.name} {digest(variant.fidelity.record())}"
        if key not in known:
            known[key] = seconds_with_gradient(variant)
            write_json(path, known)
        timed[variant.fidelity.name] = known[key]
    return timed


def seconds_with_gradient(env: Environment) -> float:
    """Time an episode with gradient [s]; of a long one only the beginning is simulated."""
    whole = env.work().count
    if env.horizon and whole > ENOUGH:
        env = env.with_horizon(env.horizon * max(SHORTEST, ENOUGH / whole))
    from ..landscapes.cost import episode_cost

    return episode_cost(env).gradient * whole / env.work().count


def find_variant(env: Environment, device: str) -> tuple[MeasuredVariant, Path]:
    """Return what was measured of an environment's fidelity on a device, and the file that says so.

    Raises ValueError where nothing was.
    """
    found = _find(env.name, asdict(env.options), device)
    for row in _rows(found[0], env, device) if found else []:
        if found and row.device == device and row.fidelity == env.fidelity.record():
            return row, found[1]
    raise ValueError(
        f"there is no {device} device here, and no rate of {env.name} at {env.fidelity.name} on one is kept; "
        f"`landscape tradeoff {env.name} --device {device}` measures it where there is one"
    )


def tolerance_of(spec: SceneSpec) -> tuple[float, bool]:
    """Return the tolerance of a scene as `read_tolerance` does. Raises ValueError where it names a fidelity, too."""
    if spec.fidelity is not None:
        raise ValueError(f"--tolerance chooses the fidelity; got --fidelity {spec.fidelity} too, leave out one of them")
    return read_tolerance(str(spec.tolerance))


def read_tolerance(text: str) -> tuple[float, bool]:
    """Return a tolerance and whether it is a share of the spread (5%) or in the loss's unit (0.05).

    Raises ValueError where it is neither.
    """
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise ValueError(f"--tolerance takes a share such as 5%, or a number in the loss's unit; got {text!r}")
    return value, text.endswith("%")


def _candidates(env: Environment, options: Mapping[str, Any]) -> tuple[Tradeoff, Path, Sequence[MeasuredVariant]]:
    """Return the trade-off to choose from, its file, and its variants that solve the same problem on the engine."""
    measuring = ["landscape", "tradeoff", env.name, *(f"--set={key}={value}" for key, value in options.items())]
    found = _find(env.name, asdict(env.options), env.device)
    if found is None:
        said = f"no fidelities of {env.name} with these options are measured"
        raise ValueError(f"{said}; `{shlex.join(measuring)}` measures them")
    rows = _rows(found[0], env, env.device)
    if not rows:
        measuring += ["--engine", env.engine]
        raise ValueError(f"{found[1]} holds no variant of engine {env.engine}; `{shlex.join(measuring)}` measures them")
    return *found, rows


def _place(name: str, options: Mapping[str, Any], device: str) -> Path:
    return user_data_path("gradscape") / "tradeoff" / f"{name}-{device}-{digest(options)}.json"


def _find(name: str, options: dict[str, Any], device: str) -> tuple[Tradeoff, Path] | None:
    """Return the trade-off to choose from, and the file it is in."""
    devices = (device, *({"cpu", "cuda"} - {device}))
    gallery = Path(str(resources.files("gradscape.gallery"))) / "data" / "tradeoff"
    kept = [_place(name, options, where) for where in devices]
    for path in (*kept, *(gallery / f"{name}-{where}.json" for where in devices)):
        if path.is_file():
            found = _read(name, path)
            if found.identity["options"] == options:
                return found, path
    return None


def _read(name: str, path: Path) -> Tradeoff:
    """Return what `landscape tradeoff` left in a file, whose fidelities can be made."""
    from ..envs.base import Fidelity
    from ..landscapes.measures.tradeoff import Tradeoff
    from ..landscapes.storage.records import read_json, reading

    todo = f"delete it, and `landscape tradeoff {name}` measures it anew"
    with reading(path, todo):
        found = Tradeoff.of_record(read_json(path))
        for row in found.variants:
            Fidelity(**row.fidelity)
    return found


def _rows(found: Tradeoff, env: Environment, device: str) -> Sequence[MeasuredVariant]:
    """Return the variants that solve the same problem on the engine, on a device if there are any.

    What had the name of a fidelity whose settings have changed since is left out.
    """
    options, named = found.identity["options"], {name: one.record() for name, one in env.fidelities.items()}
    rows = [row for row in found.variants if row.engine == env.engine and row.options == options]
    rows = [row for row in rows if named.get(row.name, row.fidelity) == row.fidelity]
    return [row for row in rows if row.device == device] or rows


def _amount(value: float, relative: bool, found: Tradeoff) -> str:
    return f"{value:.2%} of the losses' spread" if relative else f"{value:.3g} {found.loss_unit}".rstrip()
