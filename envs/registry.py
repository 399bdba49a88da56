"""Find environments by name; import them only when one is made.

Another package registers its own by an entry point of the group `gradscape.environments`:

    [project.entry-points."gradscape.environments"]
    my-arm = "my_package.arm:Arm"
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .base import Environment, Fidelity

GROUP = "gradscape.environments"
SCENE = ("draft", "standard", "reference")


@dataclass(frozen=True)
class Entry:
    """Say what an environment is without importing it; `target` is "module:Class"."""

    name: str
    target: str
    dim: str = "?"
    parameters: str = "?"
    model: str = "?"
    fidelities: tuple[str, ...] = ()


def _function(name: str, target: str, model: str, dim: str = "2") -> Entry:
    return Entry(name, f"gradscape.envs.functions:{target}", dim, "x0, x1, ... (no unit)", model, ("exact",))


def _plasticine(name: str, target: str, dim: str, tools: str, task: str) -> Entry:
    parameters = f"5 x ({tools}{'' if ':' in tools else ': x, y, z'}), shares (no unit)"
    model = f"MLS-MPM: von Mises plasticine, tools; {task}"
    return Entry(name, f"gradscape.envs.plasticine_scenes:{target}", dim, parameters, model, SCENE)


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
        "gradscape.envs.fluid:Fluid",
        "10",
        "5 x (ladle speed x, ladle speed y) [m/s]",
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
        "gradscape.envs.swing:SwingVelocity",
        "3",
        "initial velocity x, y, z [m/s]",
        "mass-spring cloth, held at two corners, over a floor",
        SCENE,
    ),
    Entry(
        "swing-stiffness",
        "gradscape.envs.swing:SwingStiffness",
        "16",
        "stiffness of 4 x 4 patches [N/m]",
        "mass-spring cloth, held at two corners, over a floor",
        SCENE,
    ),
    Entry(
        "flip",
        "gradscape.envs.flip:Flip",
        "15",
        "5 x (pan x [m], pan y [m], tilt [rad])",
        "mass-spring disc, moving pan",
        SCENE,
    ),
    _plasticine("assembly", "Assembly", "30", "2 spheres", "lift a ball onto a box"),
    _plasticine("pinch", "Pinch", "15", "sphere", "dent a cube"),
    _plasticine("rolling-pin", "RollingPin", "15", "pin: roll, turn, height", "roll a slab flat"),
    _plasticine("rope", "Rope", "30", "2 spheres", "bend a rope around a post"),
    _plasticine("table", "Table", "15", "sphere", "bend a table's leg"),
    _plasticine("torus", "Torus", "15", "ring", "press a ring into a slab"),
    _plasticine("triple-move", "TripleMove", "90", "6 spheres", "carry three blocks"),
    _plasticine("writer", "Writer", "15", "pen", "write into a slab"),
    _function("ackley", "Ackley", "many shallow minima around a funnel", "any"),
    _function("beale", "Beale", "flat plain with sharp corner peaks"),
    _function("branin", "Branin", "three equal minima in a smooth valley"),
    _function("griewank", "Griewank", "regular ripples on a bowl", "any"),
    _function("levy", "Levy", "wavy steps", "any"),
    _function("rastrigin", "Rastrigin", "a lattice of minima on a bowl", "any"),
    _function("rosenbrock", "Rosenbrock", "a bent, narrow valley", "any"),
    _function("six-hump-camel", "SixHumpCamel", "six minima, two of them global"),
    _function("styblinski-tang", "StyblinskiTang", "two minima along each axis", "any"),
)


@cache
def entries() -> dict[str, Entry]:
    """Return every registered environment by name, ours before other packages'."""
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


def environment_class(name: str) -> type[Environment]:
    """Import and return the class of a registered environment."""
    known = entries()
    if name not in known:
        close = get_close_matches(name, known, n=1)
        hint = f"; did you mean {close[0]}?" if close else ";"
        raise ValueError(f"no environment is called {name!r}{hint} `landscape envs` lists all {len(known)}")
    module, _, attribute = known[name].target.partition(":")
    try:
        found: type[Environment] = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{name} is registered as {known[name].target}, which cannot be imported: {error}") from error
    return found


def make(
    name: str,
    *,
    fidelity: str | Fidelity | None = None,
    device: str = "auto",
    engine: str = "warp",
    deterministic: bool = False,
    **options: Any,
) -> Environment:
    """Make a registered environment; `fidelity` defaults to its cheapest, `device` is auto, cpu or cuda."""
    settings: dict[str, Any] = {"fidelity": fidelity, "device": device, "engine": engine}
    return environment_class(name)(**settings, deterministic=deterministic, **options)
