"""Find environments by name; import each only when it is made.

Another package registers its own environment by an entry point of the group `gradscape.environments`:

    [project.entry-points."gradscape.environments"]
    my-arm = "my_package.arm:Arm"

A program or a notebook registers a class by `register`. Commands also take any simulator in a file, as `FILE.py:NAME`.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from ..landscapes import registry
from ..landscapes.storage.files import resolve
from .engines import ENGINES, install_line, is_installed
from .engines import EXTRAS as EXTRAS
from .records import unknown_fidelity

if TYPE_CHECKING:
    from .base import Environment, Fidelity

# ---- Import what an environment's class is in: a module by its name, or somebody's file by its path.

IN_FILE = re.compile(r".+\.py:\w+", re.DOTALL)  # FILE.py:NAME
ALL_IN_FILE = re.compile(r".+\.py:\*", re.DOTALL)


def import_named(name: str) -> ModuleType:
    """Import a module by its name, or a file by its path, once; errors in a file are reported with its name.

    A file can import modules from its own folder, as a program can. Raises ImportError for a module and ValueError for
    a file.
    """
    if not name.endswith(".py"):
        return import_module(name)
    known = f"gradscape_file_{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    if known not in sys.modules:
        try:
            sys.modules[known] = _load_file(known, name)
        except SystemExit as error:
            raise ValueError(
                f"{name} called sys.exit({'' if error.code is None else repr(error.code)}) while it was imported; move "
                'that call under `if __name__ == "__main__":`'
            ) from error
        except Exception as error:
            raise ValueError(f"{name} cannot be imported: {type(error).__name__}: {error}") from error
    return sys.modules[known]


def _load_file(known: str, path: str) -> ModuleType:
    spec = spec_from_file_location(known, path)
    assert spec is not None  # of a path that ends in .py there is one,
    assert spec.loader is not None  # which is loaded
    module = module_from_spec(spec)
    if (folder := str(Path(path).parent)) not in sys.path:
        sys.path.append(folder)
    sys.modules[known] = module  # dataclasses look there for their own module
    kept = sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # bytecode hides an edit of the same length within the same second
    try:
        spec.loader.exec_module(module)
    finally:
        sys.dont_write_bytecode = kept
        del sys.modules[known]
    return module


Kind = TypeVar("Kind", bound="type[Environment] | Environment")
GROUP = "gradscape.environments"
SCENE = ("draft", "standard", "reference")
DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True)
class Entry:
    """Describe an environment without importing it.

    `target` is "module:Class", "FILE.py:NAME", a class or an environment. Fields that another package's entry point
    cannot give are empty; `complete_entry` asks the class. `extra` names the extra of this package that installs an
    optional engine.
    """

    name: str
    target: str | type[Environment] | Environment
    dim: str = ""
    parameters: str = ""
    model: str = ""
    fidelities: tuple[str, ...] = ()
    extra: str = ""


VELOCITY, CLOTH = "initial velocity x, y, z [m/s]", "mass-spring cloth, held at two corners, over a floor"
STARTED = "initial position x, y [m], velocity x, y [m/s]"
THROWN = "initial position x, z [m], velocity x, z [m/s]"
PUSHED = "two initial positions [m] and velocities [m/s], a push x, y [m/s²]"
START = "initial position x, y [m], velocity x, y [m/s], first push x, y [m/s²]"
BALL = "planar rigid ball, hard contacts with restitution"


def _scene(name: str, target: str, dim: str, parameters: str, model: str) -> Entry:
    return Entry(name, f"gradscape.envs.{target}", dim, parameters, model, SCENE)


def _plasticine(name: str, target: str, dim: str, tools: str, task: str) -> Entry:
    parameters = f"5 x ({tools}{'' if ':' in tools else ': x, y, z'}), shares (no unit)"
    model = f"MLS-MPM: von Mises plasticine, tools; {task}"
    return _scene(name, f"mpm.plasticine_scenes:{target}", dim, parameters, model)


def _mjx(name: str, target: str, dim: str, parameters: str, model: str) -> Entry:
    return replace(_scene(name, f"mjx.scenes:{target}", dim, parameters, f"MuJoCo in JAX: {model}"), extra="mjx")


def _newton(name: str, target: str, model: str, parameters: str = VELOCITY) -> Entry:
    dim = "3" if parameters == VELOCITY else "4"
    found = _scene(name, f"newton.scenes:{target}", dim, parameters, f"Newton: {model}")
    return replace(found, fidelities=SCENE[:2], extra="newton")


def _collision(name: str, target: str, dim: str, parameters: str, model: str) -> Entry:
    return replace(_scene(name, f"collisions:{target}", dim, parameters, model), fidelities=("standard",))


def _function(name: str, target: str, model: str, dim: str = "2") -> Entry:
    return replace(_scene(name, f"functions:{target}", dim, "x0, x1, ... (no unit)", model), fidelities=("exact",))


BUILTIN = (
    _scene("bounce", "bounce:Bounce", "3", VELOCITY, "one ball, penalty contact with friction"),
    _scene(
        "cartpole", "cartpole:Cartpole", "400", "100 x (cart velocity [m/s], torque at three joints [N m])",
        "three-link chain on a cart, generalised coordinates",
    ),
    _scene(
        "fluid", "mpm.fluid:Fluid", "10", "5 x (ladle speed x, ladle speed y) [m/s]",
        "MLS-MPM: viscous fluid, elastic cube, moving ladle",
    ),
    _scene("pinball-2", "pinball:Pinball2", "2", "angles of 1 x 2 colliders [rad]", BALL),
    _scene("pinball-16", "pinball:Pinball16", "16", "angles of 4 x 4 colliders, row by row [rad]", BALL),
    _collision("bounce-once", "BounceOnce", "6", START, "one elastic impact on the ground, in closed form"),
    _collision("ground-wall", "GroundWall", "6", START, "a ball off the ground and a wall, in closed form"),
    _collision(
        "two-balls", "TwoBalls", "10", PUSHED, "an elastic impact of two balls, in closed form",
    ),
    _scene("swing-velocity", "sheets.swing:SwingVelocity", "3", VELOCITY, CLOTH),
    _scene("swing-stiffness", "sheets.swing:SwingStiffness", "16", "stiffness of 4 x 4 patches [N/m]", CLOTH),
    _scene("flip", "sheets.flip:Flip", "15", "5 x (pan x [m], pan y [m], tilt [rad])", "mass-spring disc, moving pan"),
    _plasticine("assembly", "Assembly", "30", "2 spheres", "lift a ball onto a box"),
    _plasticine("pinch", "Pinch", "15", "sphere", "dent a cube"),
    _plasticine("rolling-pin", "RollingPin", "15", "pin: roll, turn, height", "roll a slab flat"),
    _plasticine("rope", "Rope", "30", "2 spheres", "bend a rope around a post"),
    _plasticine("table", "Table", "15", "sphere", "bend a table's leg"),
    _plasticine("torus", "Torus", "15", "ring", "press a ring into a slab"),
    _plasticine("triple-move", "TripleMove", "90", "6 spheres", "carry three blocks"),
    _plasticine("writer", "Writer", "15", "pen", "write into a slab"),
    _mjx("mjx-drop", "Drop", "3", VELOCITY, "a ball on a plane"),
    _mjx("mjx-bounce", "MjxBounce", "3", VELOCITY, "bounce's ball and target"),
    _mjx("mjx-cartpole", "MjxCartpole", "400", "100 x (cart velocity [m/s], 3 torques [N m])", "cartpole's chain"),
    _mjx("mjx-push", "Push", "10", "5 x (ball velocity x, y) [m/s]", "a box pushed across friction"),
    _mjx("mjx-bounce-once", "MjxBounceOnce", "4", THROWN, "bounce-once's ball and ground"),
    _mjx("mjx-ground-wall", "MjxGroundWall", "4", THROWN, "ground-wall's ball, ground and wall"),
    _mjx("mjx-two-balls", "MjxTwoBalls", "10", PUSHED, "two-balls' balls and push"),
    _newton("newton-flight", "Flight", "a sphere in free flight"),
    _newton("newton-ball", "Ball", "bounce's ball and target"),
    _newton("newton-cloth", "ClothThrow", "a cloth that bounces off a floor"),
    _newton("newton-bounce-once", "NewtonBounceOnce", "bounce-once's ball and ground", STARTED),
    _newton("newton-ground-wall", "NewtonGroundWall", "ground-wall's ball, ground and wall", STARTED),
    _function("ackley", "Ackley", "many shallow minima around a funnel", "any"),
    _function("beale", "Beale", "flat plain with sharp corner peaks"),
    _function("branin", "Branin", "three equal minima in a smooth valley"),
    _function("griewank", "Griewank", "regular ripples on a bowl", "any"),
    _function("levy", "Levy", "wavy steps", "any"),
    _function("rastrigin", "Rastrigin", "a lattice of minima on a bowl", "any"),
    _function("rosenbrock", "Rosenbrock", "a bent, narrow valley", "any"),
    _function("six-hump-camel", "SixHumpCamel", "six minima, two of them global"),
    _function("styblinski-tang", "StyblinskiTang", "two minima along each axis", "any"),
)  # fmt: skip


@cache
def entries() -> dict[str, Entry]:
    """Return every registered environment by name, ours before those of other packages.

    Raises ValueError where two packages register the same name.
    """
    return registry.collect(BUILTIN, GROUP, "environment", lambda name, target, by: Entry(name, target, model=by))


def register(what: Kind) -> Kind:
    """Make an environment, or a class of one, available by its `name` in this process, and return it.

    It can be a decorator. Raises ValueError where another environment has that name. Registering the same class again,
    as in a notebook, replaces the earlier one.
    """
    from .base import Environment

    if not (isinstance(what, Environment) or (isinstance(what, type) and issubclass(what, Environment))):
        raise ValueError(f"register takes an environment, or a class derived from Environment; got {what!r}")
    taken = entries().get(what.name)
    if taken and (isinstance(taken.target, str) or _origin(taken.target) != _origin(what)):
        raise ValueError(f"an environment called {what.name!r} already exists ({taken.model}); choose another name")
    entries()[what.name] = Entry(what.name, what, model="registered by this program")
    return what


def _origin(what: type[Environment] | Environment) -> str:
    """Return the module and name of a class, or of an environment's class."""
    return what.__qualname__ if isinstance(what, type) else type(what).__qualname__


def installs(entry: Entry) -> str:
    """Return the line that installs the packages an environment needs, empty if they are installed."""
    return "" if all(is_installed(package) for package in EXTRAS.get(entry.extra, ())) else install_line(entry.extra)


def complete_entry(entry: Entry) -> Entry:
    """Return an entry completed by its class, which is imported for that."""
    if entry.dim:
        return entry
    try:
        env = make(entry.name, device="cpu")
    except Exception as error:  # another package's: whatever it raises, the others are to be listed
        return replace(entry, model=f"{entry.model}; it cannot be made: {error}")
    labels = ", ".join(env.space.labels[:3]) + (", ..." if env.space.dim > 3 else "")
    about = " ".join(env.about().partition("\n\n")[0].split()) or "no description"
    return replace(
        entry,
        dim=str(env.space.dim),
        parameters=labels,
        model=f"{about} ({entry.model})",
        fidelities=tuple(env.fidelities),
    )


def find_environment(what: Any) -> type[Environment] | Environment:
    """Return the environment, or its class, for a name or an object.

    `what` is a registered name, FILE.py:NAME, a class, an environment, or an object with `space` and `evaluate`. Raises
    ValueError for anything else, and where a module or a file cannot be imported.
    """
    from .base import Environment

    if isinstance(what, str):
        return _import_from_file(what) if IN_FILE.fullmatch(what) else registered_environment(what)
    if isinstance(what, Environment) or (isinstance(what, type) and issubclass(what, Environment)):
        return what
    from .adapters import GivenEnvironment

    if isinstance(what, FunctionType | BuiltinFunctionType | MethodType):
        raise ValueError(
            f"{what.__name__} is a function without a parameter space; make it an environment with "
            f"gs.from_torch({what.__name__}, space), from_jax, from_numpy or from_warp"
        )
    return GivenEnvironment.of(what() if isinstance(what, type) else what)


def environment_class(name: str) -> type[Environment]:
    """Return the class of a registered environment. Raises ValueError as `registered_environment` does."""
    found = registered_environment(name)
    return found if isinstance(found, type) else type(found)


def as_environment(what: Any) -> Environment:
    """Return the environment for a name or an object. Raises ValueError as `find_environment` does."""
    found = find_environment(what)
    return found() if isinstance(found, type) else found


def refuse_unknown(
    what: str,
    *,
    fidelity: str | Fidelity | None = None,
    device: str = "auto",
    engine: str | None = None,
    dims: Sequence[str] = (),
) -> None:
    """Raise ValueError for settings that are wrong without importing the scene or running its file.

    Making the environment checks the others, after an import that takes seconds. `dims` are parameters. Their
    numbers are compared with the number of parameters, where that is fixed.
    """
    if IN_FILE.fullmatch(what):
        _place_in_file(what)
        return
    entry = _find_entry(what)
    if not entry.fidelities:
        return  # registered by others: their class knows
    if isinstance(fidelity, str) and fidelity not in entry.fidelities:
        raise unknown_fidelity(what, entry.fidelities, fidelity)
    if device not in DEVICES:
        raise ValueError(f"{what} runs on {', '.join(DEVICES[:-1])} or {DEVICES[-1]}; got device {device!r}")
    if engine is not None and engine not in ENGINES:
        raise ValueError(f"{what} has no engine {engine!r}; the engines are {', '.join(ENGINES)}")
    for number in map(int, filter(str.isdecimal, dims)):
        if entry.dim.isdecimal() and number >= int(entry.dim):
            raise ValueError(f"{what} has parameters numbered 0 to {int(entry.dim) - 1}; got {number}")


def registered_environment(name: str) -> type[Environment] | Environment:
    """Return the environment registered by a name, without running any file.

    Raises ValueError where no environment has that name, or its module cannot be imported.
    """
    target = _find_entry(name).target
    if not isinstance(target, str):
        return target
    found: type[Environment] | Environment = registry.load(name, target, import_named)
    return found


def _find_entry(name: str) -> Entry:
    """Return the entry of a name. Raises ValueError, with a similar name, for an unknown one."""
    known = entries()
    there = f"`landscape envs` lists all {len(known)}; name one in your own file as FILE.py:NAME"
    return registry.find(known, name, "environment", there)


def source_of(env: Environment) -> str | type[Environment] | Environment:
    """Return what another process needs to make this environment, since its registry can differ.

    A class is enough where settings make the environment again; a function is sent itself.
    """
    from .adapters import FunctionEnvironment, GivenEnvironment

    env = env.without()
    entry = entries().get(env.name)
    if entry is not None and isinstance(entry.target, str):
        return entry.target if IN_FILE.fullmatch(entry.target) else env.name
    return env if isinstance(env, FunctionEnvironment | GivenEnvironment) else type(env)


def _import_from_file(text: str) -> type[Environment] | Environment:
    """Return the environment, or its class, with this name in a file, and register it by its own name."""
    file, path, attribute = _place_in_file(text)
    module = import_named(str(file))
    if attribute not in vars(module):
        there = ", ".join(name for name, one in vars(module).items() if _is_offered(name, one, module.__name__))
        raise ValueError(f"{path} has no {attribute}; it has {there or 'no simulator'}")
    try:
        found = _named(find_environment(vars(module)[attribute]), attribute)
    except ValueError as error:
        raise ValueError(f"{text}: {error}") from None
    taken, target = entries().get(found.name), f"{file}:{attribute}"
    if taken and taken.target not in (target, found):  # a file may register its class itself
        raise ValueError(f"{text} and {taken.target} are both called {found.name!r}; give one of them another name")
    entries()[found.name] = Entry(found.name, target, model=f"of {path}")
    return found


def names_in_file(what: str) -> list[str]:
    """Return FILE.py:NAME for each simulator in a file given as FILE.py:*; return any other text unchanged.

    Raises ValueError where there is no such file, it cannot be imported, or it has no simulator.
    """
    if not ALL_IN_FILE.fullmatch(what):
        return [what]
    file, path, _ = _place_in_file(what)
    module = import_named(str(file))
    offered = {id(one): name for name, one in reversed(vars(module).items()) if _is_offered(name, one, module.__name__)}
    if not offered:
        raise ValueError(
            f"{path} has no simulator; define an environment, a class of one, or an object with `space` and `evaluate`"
        )
    return [f"{path}:{name}" for name in reversed(offered.values())]  # each once, by its first name


def _place_in_file(text: str) -> tuple[Path, str, str]:
    """Return the path of FILE.py:NAME, the path as given, and the name. Raises ValueError where there is no file."""
    path, _, name = text.rpartition(":")
    if not (file := resolve(path)).is_file():
        raise ValueError(f"there is no file {path}, so {name} cannot be loaded from it")
    return file, path, name


def _named(found: type[Environment] | Environment, attribute: str) -> type[Environment] | Environment:
    """Return a function with the name it has in its file, unless it has its own."""
    from .adapters import FunctionEnvironment
    from .user_functions import NAMELESS

    return found.named(attribute) if isinstance(found, FunctionEnvironment) and found.name == NAMELESS else found


def _is_offered(name: str, value: object, module: str) -> bool:
    """Say whether a value of a file is a simulator: an environment, a class of one, or an object like one."""
    from .base import Environment

    if isinstance(value, type) and value.__module__ != module:  # imported there
        return False
    is_class = isinstance(value, type) and issubclass(value, Environment)
    return is_class or (not name.startswith("_") and hasattr(value, "space") and hasattr(value, "evaluate"))


def make(
    what: Any,
    /,
    *,
    fidelity: str | Fidelity | None = None,
    device: str = "auto",
    engine: str | None = None,
    deterministic: bool = False,
    preset: str | None = None,
    **options: Any,
) -> Environment:
    """Make an environment from a registered name, FILE.py:NAME, a class, an environment or an object, with settings.

    `fidelity` defaults to the cheapest and `engine` to the first. If an environment is given, they and the options
    default to those of that environment. `device` is auto, cpu or cuda. `preset` names a set of options; options given
    explicitly win. Raises ValueError where the environment does not exist, or has no such fidelity, device, engine,
    preset or option. With `deterministic`, it also raises where the engine does not give the same bits every time.
    """
    found = find_environment(what)
    if preset is not None:
        options = {**found.preset_options(preset), **options}
    if isinstance(found, type):
        return found(fidelity=fidelity, device=device, engine=engine, deterministic=deterministic, **options)
    if not (fidelity or engine or deterministic or options) and device in ("auto", found.device):
        return found
    chosen = None if device == "auto" else device
    return found.remake(
        fidelity=fidelity, device=chosen, engine=engine, deterministic=deterministic or found.deterministic, **options
    )
