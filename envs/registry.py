"""Find environments by name; import them only when one is made.

Another package registers its own by an entry point of the group `gradscape.environments`:

    [project.entry-points."gradscape.environments"]
    my-arm = "my_package.arm:Arm"

A program or a notebook registers a class by `register`, and the command takes a class from a file as `FILE.py:Class`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, TypeVar

from ..landscapes.storage.files import resolve
from .importing import IN_FILE, import_named
from .installed import install_line, is_installed

if TYPE_CHECKING:
    from .base import Environment, Fidelity

Kind = TypeVar("Kind", bound="Environment")
GROUP = "gradscape.environments"
EXTRAS = {"mjx": ("mujoco", "mujoco-mjx", "jax"), "newton": ("newton",)}  # of this package, and what each brings
SCENE = ("draft", "standard", "reference")


@dataclass(frozen=True)
class Entry:
    """Say what an environment is without importing it.

    `target` is "module:Class", "FILE.py:Class" or the class itself. What another package's entry point cannot say is
    empty; `complete_entry` asks the class. An environment whose engine is not always installed comes with an `extra`
    of this package.
    """

    name: str
    target: str | type[Environment]
    dim: str = ""
    parameters: str = ""
    model: str = ""
    fidelities: tuple[str, ...] = ()
    extra: str = ""


def _mjx_entry(name: str, target: str, dim: str, parameters: str, model: str) -> Entry:
    return Entry(name, f"gradscape.envs.mjx.scenes:{target}", dim, parameters, f"MuJoCo in JAX: {model}", SCENE, "mjx")


def _newton_entry(name: str, target: str, model: str) -> Entry:
    where, parameters = f"gradscape.envs.newton.scenes:{target}", "initial velocity x, y, z [m/s]"
    return Entry(name, where, "3", parameters, f"Newton: {model}", SCENE[:2], "newton")


def _function_entry(name: str, target: str, model: str, dim: str = "2") -> Entry:
    return Entry(name, f"gradscape.envs.functions:{target}", dim, "x0, x1, ... (no unit)", model, ("exact",))


def _plasticine_entry(name: str, target: str, dim: str, tools: str, task: str) -> Entry:
    parameters = f"5 x ({tools}{'' if ':' in tools else ': x, y, z'}), shares (no unit)"
    model = f"MLS-MPM: von Mises plasticine, tools; {task}"
    return Entry(name, f"gradscape.envs.mpm.plasticine_scenes:{target}", dim, parameters, model, SCENE)


BUILTIN = (
    Entry(
        "bounce",
        "gradscape.envs.bounce:Bounce",
        "3",
        "initial velocity x, y, z [m/s]",
        "one ball, penalty contact with friction",
        SCENE,
    ),
    Entry(
        "cartpole",
        "gradscape.envs.cartpole:Cartpole",
        "400",
        "100 x (cart velocity [m/s], torque at three joints [N m])",
        "three-link chain on a cart, generalised coordinates",
        SCENE,
    ),
    Entry(
        "fluid",
        "gradscape.envs.mpm.fluid:Fluid",
        "10",
        "5 x (ladle speed x, ladle speed y) [· 0.2 m/s]",
        "MLS-MPM: viscous fluid, elastic cube, moving ladle",
        SCENE,
    ),
    Entry(
        "pinball-2",
        "gradscape.envs.pinball:Pinball2",
        "2",
        "angles of 1 x 2 colliders [rad]",
        "planar rigid ball, hard contacts with restitution",
        SCENE,
    ),
    Entry(
        "pinball-16",
        "gradscape.envs.pinball:Pinball16",
        "16",
        "angles of 4 x 4 colliders, row by row [rad]",
        "planar rigid ball, hard contacts with restitution",
        SCENE,
    ),
    Entry(
        "swing-velocity",
        "gradscape.envs.sheets.swing:SwingVelocity",
        "3",
        "initial velocity x, y, z [m/s]",
        "mass-spring cloth, held at two corners, over a floor",
        SCENE,
    ),
    Entry(
        "swing-stiffness",
        "gradscape.envs.sheets.swing:SwingStiffness",
        "16",
        "stiffness of 4 x 4 patches [N/m]",
        "mass-spring cloth, held at two corners, over a floor",
        SCENE,
    ),
    Entry(
        "flip",
        "gradscape.envs.sheets.flip:Flip",
        "15",
        "5 x (pan x [m], pan y [m], tilt [rad])",
        "mass-spring disc, moving pan",
        SCENE,
    ),
    _plasticine_entry("assembly", "Assembly", "30", "2 spheres", "lift a ball onto a box"),
    _plasticine_entry("pinch", "Pinch", "15", "sphere", "dent a cube"),
    _plasticine_entry("rolling-pin", "RollingPin", "15", "pin: roll, turn, height", "roll a slab flat"),
    _plasticine_entry("rope", "Rope", "30", "2 spheres", "bend a rope around a post"),
    _plasticine_entry("table", "Table", "15", "sphere", "bend a table's leg"),
    _plasticine_entry("torus", "Torus", "15", "ring", "press a ring into a slab"),
    _plasticine_entry("triple-move", "TripleMove", "90", "6 spheres", "carry three blocks"),
    _plasticine_entry("writer", "Writer", "15", "pen", "write into a slab"),
    _mjx_entry("mjx-drop", "Drop", "3", "initial velocity x, y, z [m/s]", "a ball on a plane"),
    _mjx_entry("mjx-bounce", "MjxBounce", "3", "initial velocity x, y, z [m/s]", "bounce's ball and target"),
    _mjx_entry(
        "mjx-cartpole",
        "MjxCartpole",
        "400",
        "100 x (cart velocity [m/s], 3 torques [N m])",
        "cartpole's chain",
    ),
    _mjx_entry("mjx-push", "Push", "10", "5 x (ball velocity x, y) [m/s]", "a box pushed across friction"),
    _newton_entry("newton-flight", "Flight", "a sphere in free flight"),
    _newton_entry("newton-ball", "Ball", "bounce's ball and target"),
    _newton_entry("newton-cloth", "ClothThrow", "a cloth that bounces off a floor"),
    _function_entry("ackley", "Ackley", "many shallow minima around a funnel", "any"),
    _function_entry("beale", "Beale", "flat plain with sharp corner peaks"),
    _function_entry("branin", "Branin", "three equal minima in a smooth valley"),
    _function_entry("griewank", "Griewank", "regular ripples on a bowl", "any"),
    _function_entry("levy", "Levy", "wavy steps", "any"),
    _function_entry("rastrigin", "Rastrigin", "a lattice of minima on a bowl", "any"),
    _function_entry("rosenbrock", "Rosenbrock", "a bent, narrow valley", "any"),
    _function_entry("six-hump-camel", "SixHumpCamel", "six minima, two of them global"),
    _function_entry("styblinski-tang", "StyblinskiTang", "two minima along each axis", "any"),
)


@cache
def entries() -> dict[str, Entry]:
    """Return every registered environment by name, ours before other packages'.

    Raises ValueError where two packages register the same name.
    """
    found = {entry.name: entry for entry in BUILTIN}
    for point in entry_points(group=GROUP):
        if point.name in found:
            raise ValueError(
                f"two environments are called {point.name!r}: {found[point.name].target} and {point.value}; "
                "uninstall one of the packages or rename its entry point"
            )
        package = point.dist.name if point.dist else "another package"
        found[point.name] = Entry(point.name, point.value, model=f"registered by {package}")
    return found


def register(kind: type[Kind]) -> type[Kind]:
    """Let an environment's class be found by its `name` in this process, and return it (so it can be a decorator).

    Raises ValueError where another environment has that name. A class that is run again, as in a notebook, takes the
    place of the earlier one.
    """
    from .base import Environment

    if not (isinstance(kind, type) and issubclass(kind, Environment)):
        raise ValueError(f"register takes a class derived from Environment; got {kind!r}")
    taken = entries().get(kind.name)
    if taken and not (isinstance(taken.target, type) and taken.target.__qualname__ == kind.__qualname__):
        raise ValueError(
            f"an environment called {kind.name!r} exists already ({taken.model}); give the class another name"
        )
    entries()[kind.name] = Entry(kind.name, kind, model="registered by this program")
    return kind


def installs(entry: Entry) -> str:
    """Return the line that installs what an environment needs, empty where that is there."""
    return "" if all(is_installed(package) for package in EXTRAS.get(entry.extra, ())) else install_line(entry.extra)


def complete_entry(entry: Entry) -> Entry:
    """Return an entry with what its class says of itself, which is imported for that."""
    if entry.dim:
        return entry
    try:
        env = make(entry.name, device="cpu")
    except Exception as error:  # another package's: whatever it raises, the others are to be listed
        return replace(entry, model=f"{entry.model}; it cannot be made: {error}")
    labels = ", ".join(env.space.labels[:3]) + (", ..." if env.space.dim > 3 else "")
    about = " ".join(env.about().partition("\n\n")[0].split()) or "says nothing of itself"
    return replace(
        entry,
        dim=str(env.space.dim),
        parameters=labels,
        model=f"{about} ({entry.model})",
        fidelities=tuple(env.fidelities),
    )


def environment_class(name: str) -> type[Environment]:
    """Import and return the class of a registered environment, or of `FILE.py:Class`, which is registered by that.

    Raises ValueError where no environment has that name, or its module or file cannot be imported.
    """
    if IN_FILE.fullmatch(name):
        return _import_from_file(name)
    known = entries()
    if name not in known:
        close = get_close_matches(name, known, n=1)
        hint = f"; did you mean {close[0]}?" if close else ";"
        raise ValueError(f"no environment is called {name!r}{hint} `landscape envs` lists all {len(known)}")
    target = known[name].target
    if isinstance(target, type):
        return target
    module, _, attribute = target.rpartition(":")
    try:
        found: type[Environment] = getattr(import_named(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{name} is registered as {target}, which cannot be imported: {error}") from error
    return found


def source_of(env: Environment) -> str | type[Environment]:
    """Return what makes such an environment in another process, where not all that is registered here may be."""
    entry = entries().get(env.name)
    if entry is None or isinstance(entry.target, type):
        return type(env)
    return entry.target if IN_FILE.fullmatch(entry.target) else env.name


def _import_from_file(text: str) -> type[Environment]:
    """Import a class from a file and register it under its name."""
    from .base import Environment

    path, _, attribute = text.rpartition(":")
    file = resolve(path)
    if not file.is_file():
        raise ValueError(f"there is no file {path} to take {attribute} from")
    module = import_named(str(file))
    kind = getattr(module, attribute, None)
    if not (isinstance(kind, type) and issubclass(kind, Environment)):
        there = [one.__name__ for one in vars(module).values() if _is_scene_of(one, module.__name__)]
        raise ValueError(f"{path} holds no environment {attribute}; it has {', '.join(there) or 'none'}")
    taken = entries().get(kind.name)
    target = f"{file}:{attribute}"
    if taken and taken.target not in (target, kind):  # a file may register its class itself
        raise ValueError(f"{text} is called {kind.name!r}, and so is {taken.target}; give the class another name")
    entries()[kind.name] = Entry(kind.name, target, model=f"of {path}")
    return kind


def _is_scene_of(value: object, module: str) -> bool:
    from .base import Environment

    return isinstance(value, type) and issubclass(value, Environment) and value.__module__ == module


def make(
    name: str | type[Environment],
    /,
    *,
    fidelity: str | Fidelity | None = None,
    device: str = "auto",
    engine: str | None = None,
    deterministic: bool = False,
    **options: Any,
) -> Environment:
    """Make an environment by its registered name, by FILE.py:Class, or of a class.

    `fidelity` defaults to its cheapest, `engine` to its first; `device` is auto, cpu or cuda. Raises ValueError where
    the environment does not exist, or has no such fidelity, device, engine or option, or where the engine does not give
    the same bits every time and they are to be `deterministic`.
    """
    kind = name if isinstance(name, type) else environment_class(name)
    settings: dict[str, Any] = {"fidelity": fidelity, "device": device, "engine": engine}
    return kind(**settings, deterministic=deterministic, **options)
