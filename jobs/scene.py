"""Which scene a job simulates, and how: the record that passes whole through every verb; and who made a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..envs.installed import installed_version
from ..envs.registry import find_environment, make, registered_environment
from ..landscapes.identity import PACKAGE, VERSIONS
from .watch import Watch

if TYPE_CHECKING:
    import xarray as xr
    from torch import Tensor

    from ..envs.base import Environment, Fidelity
    from ..landscapes.objective import Objective
    from ..landscapes.plane import Plane

PACKAGES = (
    *("numpy", "torch", "warp-lang", "taichi", "xarray", "zarr", "matplotlib"),
    *("pyvista", "rerun-sdk", "botorch", "gpytorch", "cma", "typer", "rich"),
)
AT = "@"  # between a scene and its fidelity
ABSENT = "not installed"  # in the place of a version


@dataclass(frozen=True)
class SceneSpec:
    """Say which scene is simulated, and how.

    `name` is a registered name, FILE.py:NAME, an environment's class, or an environment. `fidelity` is a name or a
    record, by default the cheapest; `tolerance` chooses it by measured loss errors instead ("5%" of the losses' spread,
    or "0.05" in their unit). `device` is auto, cpu or cuda, `engine` one of the scene's, by default its first, and
    `options` are the scene's own.
    """

    name: str | type[Environment] | Environment
    fidelity: str | Fidelity | None = None
    tolerance: str | None = None
    device: str = "auto"
    engine: str | None = None
    deterministic: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, env: Environment) -> SceneSpec:
        """Return what makes an environment such as this one again."""
        from dataclasses import asdict

        from ..envs.registry import source_of

        return cls(source_of(env), env.fidelity, None, env.device, env.engine, env.deterministic, asdict(env.options))

    @property
    def kind(self) -> type[Environment] | Environment:
        """The environment, or the class of one. Raises ValueError where there is none of that name."""
        return find_environment(self.name)

    def resolve(self, watch: Watch) -> SceneSpec:
        """Return the spec with the fidelity that its tolerance chooses.

        Raises ValueError where both are given, and where no measured fidelity is within the tolerance.
        """
        if self.tolerance is None:
            return self
        from .tolerance import choose_fidelity

        return replace(self, tolerance=None, fidelity=choose_fidelity(self, watch))

    def make(self, watch: Watch | None = None, **changes: Any) -> Environment:
        """Make the environment; `changes` are other options. Raises ValueError for what the scene does not have."""
        spec = self.resolve(watch or Watch())
        how: dict[str, Any] = {"fidelity": spec.fidelity, "device": spec.device, "engine": spec.engine}
        return make(spec.name, **how, deterministic=spec.deterministic, **{**spec.options, **changes})


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


def with_policy(env: Environment, policy: str | None) -> Objective:
    """Return an environment over the weights of a policy (mlp:32x32), itself where there is none.

    Raises ValueError for what is no policy, and for an environment without decisions to take.
    """
    if policy is None:
        return env
    from ..landscapes.policies import PolicyObjective

    return PolicyObjective(env, policy)


def environment_of(dataset: xr.Dataset, device: str, env: Any = None) -> Environment:
    """Return the environment that a slice or a run was evaluated in, with its settings, on a device.

    It is the one that is registered by its name, or `env`: FILE.py:NAME, a class, an environment or an object of one's
    own. Nothing that a result says of itself is run.

    Raises ValueError where there is none, where it has other settings, and where the slice is none of an environment.
    """
    from ..envs.base import Fidelity
    from ..landscapes.identity import stored_identity

    identity = stored_identity(dataset)
    if "policy" in identity:
        raise ValueError(f"the slice is over the weights of a policy, {identity['objective']}, which is not made again")
    if missing := {"objective", "settings", "engine", "options", "deterministic"} - set(identity):
        raise ValueError(
            f"the slice is not one of an environment, its identity lacks {', '.join(sorted(missing))}; "
            "`landscape slice ENV` samples one"
        )
    name = str(identity["objective"])
    try:
        found = registered_environment(name) if env is None else find_environment(env)
    except ValueError as error:
        if env is not None:
            raise
        raise ValueError(
            f"{name} is not registered here, and evaluating it anew needs it: say where it is, --env FILE.py:NAME, or "
            "env= in Python"
        ) from error
    return make(
        found, fidelity=Fidelity(**identity["settings"]), device=device, engine=identity["engine"],
        deterministic=identity["deterministic"], **identity["options"],
    )  # fmt: skip


def point_of(env: Environment, text: str) -> Tensor:
    """Return the parameters that `text` names: a point, as `envs.points` has it, or best:RUN, the best of a run.

    Without a run it is the best of all that are known of an environment of the same options: those under out/, and the
    one that the gallery's league found. Raises ValueError where there is no such point, or where the run searched
    another environment.
    """
    kind, colon, run = text.partition(":")
    if kind != "best":
        from ..envs.points import point

        return point(env, text)
    if colon and not run:
        raise ValueError("best:RUN takes the folder of a run, and best alone the best of all; got 'best:'")
    from ..landscapes.overlay import best_point

    if run:
        return best_point(runs_in(env, run))[0]
    from .known import best_of_league

    kept = best_of_league(env)
    runs = _known_runs(env, needed=kept is None)
    if kept is None:
        return best_point(runs)[0]
    found = [kept, *([best_point(runs)] if any(table["loss"].notnull().any() for table in runs) else [])]
    return min(found, key=lambda one: one[1])[0]


def _known_runs(env: Environment, *, needed: bool) -> list[xr.Dataset]:
    """Return all runs of an environment with these options under the default folder.

    Raises ValueError for none, if it is `needed`.
    """
    from ..landscapes.identity import stored_identity
    from .folder import LEAGUE, ROOT
    from .known import has_options

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
            f"no run of {env.name} with these options is known under {ROOT}/; `landscape optimize {env.name}` makes one"
        )
    return found


def plane_through(
    objective: Objective,
    dims: Sequence[int | str],
    *,
    through: str | Tensor,
    extent: float | tuple[float, float] | None,
    resolution: int | Sequence[int],
) -> Plane:
    """Return the line or plane along one or two parameters through a point, which an environment may name.

    Raises ValueError for parameters, points and extents that the objective's space does not have.
    """
    from ..landscapes.plane import Plane

    point = named_point(objective, through) if isinstance(through, str) else through
    return Plane.through(objective.space, point, dims, resolution=resolution, extent=extent)


def runs_in(objective: Objective, run: str) -> list[xr.Dataset]:
    """Return the runs in a folder. Raises ValueError where they searched another environment."""
    from ..landscapes.identity import stored_identity
    from .folder import run_tables

    tables, name = run_tables([run]), objective.name
    searched = {str(stored_identity(table).get("objective")) for table in tables}
    if searched != {name}:
        raise ValueError(f"{run} holds no runs of {name} alone; it holds those of {', '.join(sorted(searched))}")
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
    raise ValueError(f"{objective.name} can be cut through {forms}; got {text!r}")


def read_scene(text: str, scene: SceneSpec) -> SceneSpec:
    """Return a scene given as ENV or ENV@FIDELITY, else as `scene` has it."""
    name, at, fidelity = text.rpartition(AT)
    if not at or "/" in fidelity or ":" in fidelity:
        return replace(scene, name=text)
    return replace(scene, name=name, fidelity=fidelity)
