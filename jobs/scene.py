"""Which scene a job simulates, and how: the record that passes whole through every verb; and who made a result."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..envs.engines import installed_version
from ..envs.registry import find_environment, make, registered_environment, source_of
from ..landscapes.identity import (
    EPISODES_PER_POINT,
    MODEL_VERSION,
    PACKAGE,
    POLICY,
    REMEDY,
    VERSIONS,
    simulator_parts,
    stored_identity,
)
from ..landscapes.options import record_options
from ..landscapes.plain import digest, number, plain_json, read_share
from ..landscapes.storage.files import moved_by, write_json
from ..landscapes.storage.records import read_json, reading
from .watch import Watch

if TYPE_CHECKING:
    import xarray as xr
    from torch import Tensor

    from ..envs.base import Environment, Fidelity
    from ..landscapes.objective import Objective
    from ..landscapes.plane import Plane
    from ..studies.fidelity import FidelityRecord, MeasuredVariant

PACKAGES = (
    *("numpy", "torch", "warp-lang", "taichi", "xarray", "zarr", "matplotlib"),
    *("pyvista", "rerun-sdk", "botorch", "gpytorch", "cma", "cyclopts", "cattrs", "rich"),
)
AT = "@"  # between a scene and its fidelity
ABSENT = "not installed"  # instead of a version
MAX_WORK_RATIO = 2.0  # times the least expected work, beyond which a variant is no candidate


@dataclass(frozen=True)
class SceneSpec:
    """Record which scene to simulate, and how.

    `name` is a registered name, FILE.py:NAME, an environment's class, or an environment. `fidelity` is a name or a
    record, by default the cheapest. `tolerance` chooses it by measured loss errors instead ("5%" or "0.05" of the
    spread of losses). `device` is auto, cpu or cuda. `engine` is one of the scene's engines, by default its first, and
    `options` are the scene's own. `policy`, such as mlp:32x32, controls the scene, and its weights are the parameters.
    `remedy` changes the landscape, such as smooth:2% (`envs.remedies`).
    """

    name: str | type[Environment] | Environment
    fidelity: str | Fidelity | None = None
    tolerance: str | None = None
    device: str = "auto"
    engine: str | None = None
    deterministic: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    policy: str | None = None
    remedy: str | None = None

    @classmethod
    def of(cls, env: Environment) -> SceneSpec:
        """Return what makes an environment such as this one again."""
        return cls(
            source_of(env), env.fidelity, None, env.device, env.engine, env.deterministic, asdict(env.options),
            *made_with(env.identity()),
        )  # fmt: skip

    @property
    def kind(self) -> type[Environment] | Environment:
        """The environment or its class. Raises ValueError if there is none of that name."""
        return find_environment(self.name)

    def resolve(self, watch: Watch) -> SceneSpec:
        """Return the spec with the fidelity that its tolerance chooses.

        Raises ValueError if both are given, or if no measured fidelity is within the tolerance.
        """
        if self.tolerance is None:
            return self
        return replace(self, tolerance=None, fidelity=choose_fidelity(self, watch))

    def make(self, watch: Watch | None = None, **changes: Any) -> Environment:
        """Make the environment with its options and `changes`. Raises ValueError if the scene does not have one."""
        spec = self.resolve(watch or Watch())
        made = make(
            spec.name, fidelity=spec.fidelity, device=spec.device, engine=spec.engine,
            deterministic=spec.deterministic, **{**spec.options, **changes},
        )  # fmt: skip
        return made_over(made, spec.policy, spec.remedy)


def made_with(identity: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """Return the policy and the remedies that the environment of an identity has."""
    return identity.get(POLICY), identity.get(REMEDY)


def made_over(env: Environment, policy: str | None, remedy: str | None) -> Environment:
    """Return an environment over the weights of a policy (mlp:32x32), with remedies (smooth:2%,clip:1), or itself.

    Raises ValueError for what is no policy or no remedy, and for a policy where there are no decisions to take.
    """
    if policy:
        from ..envs.policies import with_policy

        env = with_policy(env, policy)
    if remedy:
        from ..envs.remedies import remedied

        env = remedied(env, remedy)
    return env


def first_line(identity: Mapping[str, Any], *parts: object) -> str:
    """Return the first line of a job: the simulator, its remedy and what that costs, the device, and more `parts`."""
    times = identity.get(EPISODES_PER_POINT, 1)
    more = [f"each episode runs the simulator {times} times"] if times > 1 else []
    more += [identity["device"]] if "device" in identity else []
    return " · ".join(map(str, [*simulator_parts(identity), *more, *parts]))


def provenance(objective: Objective, command: str) -> dict[str, Any]:
    """Return what else is worth keeping with results: how they came about, when, and with which versions."""
    return {
        "command": command,
        "created": datetime.now(UTC).strftime("%Y-%m-%d"),
        VERSIONS: {PACKAGE: __version__, **{one: _version(one) for one in (*PACKAGES, *objective.packages)}},
        "loss_unit": objective.loss_unit,
    }


@cache  # reading the metadata of fifteen packages takes longer than a small job
def _version(package: str) -> str:
    return installed_version(package) or ABSENT


def environment_of(dataset: xr.Dataset, device: str, env: Any = None) -> Environment:
    """Return the environment that a slice or a run was evaluated in, with its settings, on a device.

    It is the one that is registered by its name, or `env`: FILE.py:NAME, a class, an environment or an object of one's
    own. Nothing that a result says of itself is run.

    Raises ValueError where there is none, where it has other settings, and where the slice is none of an environment.
    """
    from ..envs.base import Fidelity

    identity = stored_identity(dataset)
    if missing := {"objective", "settings", "engine", "options", "deterministic"} - set(identity):
        raise ValueError(
            f"the slice does not belong to an environment: its identity lacks {', '.join(sorted(missing))}; "
            "`landscape slice ENV` samples one that does"
        )
    policy, remedy = made_with(identity)
    name = str(identity["objective"]).removesuffix(f" with policy {policy}")
    try:
        found = registered_environment(name) if env is None else find_environment(env)
    except ValueError as error:
        if env is not None:
            raise
        raise ValueError(
            f"{name} is not registered here, and it is needed to evaluate more points; give --env FILE.py:NAME, or "
            "env= in Python"
        ) from error
    made = make(
        found, fidelity=Fidelity(**identity["settings"]), device=device, engine=identity["engine"],
        deterministic=identity["deterministic"], **identity["options"],
    )  # fmt: skip
    return made_over(made, policy, remedy)


def point_of(env: Environment, text: str) -> Tensor:
    """Return the parameters that `text` names: a point, as `envs.points` has it, or best:RUN, the best of a run.

    Without a run it is the best of all that are known of the same options: those under out/, and the gallery league's.
    Raises ValueError where there is no such point, or where the run searched another environment.
    """
    from ..landscapes.overlay import best_point

    kind, colon, run = text.partition(":")
    if kind != "best":
        from ..envs.points import point

        return point(env, text)
    if colon and not run:
        raise ValueError("best:RUN takes the folder of a run, and best alone the best of all; got 'best:'")
    if run:
        return best_point(runs_in(env, run))[0]
    kept = best_of_league(env)
    runs = _known_runs(env, needed=kept is None)
    if kept is None:
        return best_point(runs)[0]
    found = [kept, *([best_point(runs)] if any(table["loss"].notnull().any() for table in runs) else [])]
    return min(found, key=lambda one: one[1])[0]


def _known_runs(env: Environment, *, needed: bool) -> list[xr.Dataset]:
    """Return all runs of an environment with these options under the default folder."""
    from .folder import LEAGUE, ROOT

    found = list[Any]()
    races = ROOT.glob(f"{LEAGUE.kind}-*/*")  # of leagues, one folder deeper than others
    for folder in sorted(path for path in (*ROOT.glob("*"), *races) if path.is_dir()):
        try:
            runs = runs_in(env, str(folder))
        except ValueError:
            continue  # no run, or one of another environment
        found += [run for run in runs if has_options(stored_identity(run), env)]
    if needed and not found:
        raise ValueError(
            f"there is no run of {env.name} with these options in {ROOT}/; `landscape optimize {env.name}` makes one"
        )
    return found


def plane_through(
    objective: Objective,
    dims: Sequence[int | str],
    *,
    through: str | Tensor,
    window: float | tuple[float, float] | None,
    resolution: int | Sequence[int],
) -> Plane:
    """Return the line or plane along one or two parameters through a point, which an environment may name.

    Raises ValueError for parameters, points and windows that the objective's space does not have.
    """
    from ..landscapes.plane import Plane

    point = named_point(objective, through) if isinstance(through, str) else through
    return Plane.through(objective.space, point, dims, resolution=resolution, window=window)


def runs_in(objective: Objective, run: str) -> list[xr.Dataset]:
    """Return the runs in a folder. Raises ValueError where they searched another environment."""
    from .folder import run_tables

    tables, name = run_tables([run]), objective.name
    searched = {str(stored_identity(table).get("objective")) for table in tables}
    if searched != {name}:
        raise ValueError(f"the runs have to be of {name} only; {run} contains runs of {', '.join(sorted(searched))}")
    return tables


def named_point(objective: Objective, text: str) -> Tensor:
    """Return the point that `text` names, of any objective. Raises ValueError where there is no such point."""
    from ..envs.base import Environment
    from ..landscapes.foreign import table_point

    if (found := table_point(objective.space, text)) is not None:
        return found
    if isinstance(objective, Environment):
        return point_of(objective, text)
    kind, _, seed = text.partition(":")
    if text == "center":
        return objective.space.center
    if kind == "random" and seed.isdecimal():
        return objective.space.uniform(1, seed=int(seed))[0]
    forms = "center, random:SEED, a table (.csv, .parquet) or a tensor"
    raise ValueError(f"a slice of {objective.name} can go through {forms}; got {text!r}")


def given_point(objective: Objective, through: Any, who: str) -> Tensor:
    """Return the point that is named or given. Raises ValueError, of `who` asks, where it is none of the space."""
    from ..landscapes.objective import check_points
    from ..landscapes.space import as_tensor

    if isinstance(through, str):
        return named_point(objective, through)
    return check_points(as_tensor(through, who)[None], objective.space, objective.name)[0]


def read_scene(text: str, scene: SceneSpec) -> SceneSpec:
    """Return a scene given as ENV or ENV@FIDELITY, else as `scene` has it."""
    name, at, fidelity = text.rpartition(AT)
    if not at or "/" in fidelity or ":" in fidelity:
        return replace(scene, name=text)
    return replace(scene, name=name, fidelity=fidelity)


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
            f"--tolerance uses stored measurements, but {name} has no version to show that it has not changed since; "
            f"choose a fidelity instead: {', '.join(env.fidelities)}"
        )
    found, source, rows = _candidates(env, spec.options)
    errors = {row.name: off for row in rows if (off := row.p95(relative=True)) is not None}
    within = [row for row in rows if errors.get(row.name, float("inf")) <= limit]
    if not errors:
        raise ValueError(f"the measured losses of {name} have no spread, so --tolerance cannot choose ({source})")
    if not within:
        best = min(errors, key=lambda name: errors[name])
        raise ValueError(
            f"no measured fidelity of {name} is within {limit:.3g} of the spread of losses; the best is {best}, with "
            f"an error of {errors[best]:.2%} at the 95th percentile"
        )
    row, known = _quickest(watch, env, within)
    theirs, ours = found.identity[MODEL_VERSION], env.version_on(found.identity["engine"])
    if theirs != ours:
        watch.note(f"warning: the errors were measured by {name} model {theirs}; this is model {ours}")
    accuracy = f"its loss error is at most {errors[row.name]:.2%} at 95 % of {row.comparison.compared} points"
    if row.name == found.reference:
        accuracy = "it is the reference, so its own error is not known"
    watch.note(
        f"{row.name}: the fastest of {len(within)} fidelities, out of {len(rows)} measured, within {limit:.3g} of the "
        f"spread of losses; {accuracy} ({source}); {known}"
    )
    return row.fidelity


def _quickest(watch: Watch, env: Environment, rows: Sequence[MeasuredVariant]) -> tuple[MeasuredVariant, str]:
    """Return the variant that takes least time on the environment's device, and what is known of that time."""
    from ..studies.variants import expected_work

    if rows[0].device == env.device:
        best = min(rows, key=lambda row: row.seconds)
        return best, f"{best.seconds:.3g} s per episode with gradient on {env.device}, by `landscape study fidelity`"
    made = {row.name: env.remake(fidelity=row.fidelity) for row in rows}
    work = {name: expected_work(one) for name, one in made.items()}
    likely = [row for row in rows if work[row.name] <= MAX_WORK_RATIO * min(work.values())]
    if len(likely) == 1:
        return likely[0], f"the others take over {MAX_WORK_RATIO:g} times its work; none was timed on {env.device}"
    with watch.busy(f"{env.name}: timing {len(likely)} fidelities on {env.device}, where none was measured"):
        timed = _time(env, [made[row.name] for row in likely])
    best = min(likely, key=lambda row: timed[row.name])
    return best, f"{timed[best.name]:.3g} s per episode with gradient, one at a time on {env.device}, timed here"


def _time(env: Environment, variants: Sequence[Environment]) -> dict[str, float]:
    """Time an episode with gradient of each variant [s], by its name; what was timed before is kept.

    It is kept so that the same command chooses the same variant, and continues what it began.
    """
    from ..studies import variants as timing
    from ..studies.own_folder import own_folder

    # Others take another time.
    of = digest([record_options(env.options), env.engine, env.version_on(env.engine), __version__])
    path = own_folder() / f"{env.name}-{env.device}-{of}.seconds.json"
    known: dict[str, float] = {}
    if path.is_file():
        with reading(path, "delete it to time the fidelities again"):
            known = {name: number(seconds) for name, seconds in read_json(path).items()}
    timed = {}
    for variant in variants:
        key = f"{variant.fidelity.name} {digest(variant.fidelity.record())}"
        if key not in known:
            known[key] = timing.seconds_with_gradient(variant)
            with moved_by("XDG_DATA_HOME", "the measured times"):
                write_json(path, known)
        timed[variant.fidelity.name] = known[key]
    return timed


def find_variant(env: Environment, device: str) -> tuple[MeasuredVariant, Path]:
    """Return what was measured of an environment's fidelity on a device, and the file that says so.

    Raises ValueError where nothing was.
    """
    from ..studies.kept import find_fidelity

    found = find_fidelity(env, device)
    for row in _rows(found[0], env, device) if found else []:
        if found and row.device == device and row.fidelity == env.fidelity:
            return row, found[1]
    raise ValueError(
        f"this machine has no {device} device, and no rate of {env.name} at {env.fidelity.name} on one is stored; "
        f"run `landscape study fidelity {env.name} --device {device}` on a machine that has one"
    )


def tolerance_of(spec: SceneSpec) -> float:
    """Return the tolerance of a scene. Raises ValueError where it is no share, and where a fidelity is named too."""
    if spec.fidelity is not None:
        raise ValueError(f"--tolerance chooses the fidelity; got --fidelity {spec.fidelity} too, so leave out one")
    return read_tolerance(spec.tolerance)


def read_tolerance(given: object) -> float:
    """Return a share of the losses' spread given as 5% or 0.05. Raises ValueError where it is neither."""
    text = str(given).strip()
    try:
        value = read_share(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise ValueError(f"--tolerance takes a share of the spread of losses such as 5% or 0.05; got {text!r}")
    return value


def _candidates(env: Environment, options: Mapping[str, Any]) -> tuple[FidelityRecord, Path, Sequence[MeasuredVariant]]:
    """Return the study to choose from, its file, and its variants that solve the same problem on the engine."""
    from ..studies.kept import find_fidelity

    settings = (f"--set={key}={value}" for key, value in options.items())
    measuring = ["landscape", "study", "fidelity", env.name, *settings]
    found = find_fidelity(env, env.device)
    if found is None:
        said = f"no fidelity of {env.name} with these options is measured yet"
        raise ValueError(f"{said}; `{shlex.join(measuring)}` measures them")
    rows = _rows(found[0], env, env.device)
    if not rows:
        measuring += ["--engine", env.engine]
        raise ValueError(f"{found[1]} has no variant of engine {env.engine}; `{shlex.join(measuring)}` measures them")
    return *found, rows


def _rows(found: FidelityRecord, env: Environment, device: str) -> Sequence[MeasuredVariant]:
    """Return the variants that solve the same problem on the engine, on a device if there are any.

    What had the name of a fidelity whose settings have changed since is left out.
    """
    options = found.identity["options"]
    rows = [row for row in found.variants if row.engine == env.engine and row.options == options]
    rows = [row for row in rows if env.fidelities.get(row.name, row.fidelity) == row.fidelity]
    return [row for row in rows if row.device == device] or rows


def best_of_league(env: Environment) -> tuple[Tensor, float] | None:
    """Return the best point that the gallery's league found in an environment of the same options, and its loss.

    It is None where there is none, or one of another fidelity's number of parameters. Raises DamagedError where the
    file is not what was written.
    """
    import torch

    from ..landscapes.convert import from_json
    from ..optim.league import SceneStandings

    path = league_file(env.name)
    if not path.is_file():
        return None
    with reading(path, "delete it and run `landscape gallery compute --part league` to make it again"):
        found = from_json(SceneStandings, read_json(path))
    if found.best is None or not has_options(found.identity, env) or len(found.best.x) != env.space.dim:
        return None
    return torch.tensor(found.best.x, dtype=torch.float64), found.best.loss


def has_options(identity: Mapping[str, Any], env: Environment) -> bool:
    """Say whether what has this identity was made with the environment's options."""
    return bool(identity.get("options") == plain_json(record_options(env.options), "options"))


def league_file(env: str) -> Path:
    """Return where the gallery keeps the race in an environment."""
    return Path(str(resources.files("gradscape.gallery"))) / "data" / "league" / f"{env}.json"
