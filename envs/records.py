"""Records of a scene: its accuracy, its amount of computation, its material."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Fidelity:
    """Say how accurately a scene is simulated.

    `dt` is the time step [s]. `resolution` is the number of grid cells (or mesh edges) across the scene, 0 where it has
    none. `sampling` is the number of particles per cell along each axis, and `precision` that of the engine: float32 or
    float64. `particles` is their number, in scenes that count them instead. `settings` are further keyword arguments of
    a function, name -> value.
    """

    name: str
    dt: float
    precision: str = "float32"
    resolution: int = 0
    sampling: float = 2.0
    particles: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON that `Fidelity(**record)` takes."""
        known = asdict(self)
        return known if self.settings else {name: value for name, value in known.items() if name != "settings"}

    def changes_from(self, known: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
        """Return the settings that differ from a record of this fidelity: the recorded and the present ones."""
        now = self.record()
        return {name: (value, now.get(name)) for name, value in known.items() if value != now.get(name)}


@dataclass(frozen=True)
class Work:
    """Say how much an episode computes: `count` of a `unit`, such as one particle in one substep."""

    count: int
    unit: str


@dataclass(frozen=True)
class MaterialRange:
    """Name the option that makes a scene's material soft or stiff, and the smallest and largest value to try."""

    option: str
    softest: float
    stiffest: float


@dataclass(frozen=True)
class ModelPart:
    """Name a part of a scene's model, and the `options` of the scene that change it.

    `change` describes the change in a few words ("no friction", "a rigid cube"). A `missing` part is one that the scene
    leaves out by default: its options add it.
    """

    name: str
    options: Mapping[str, Any]
    change: str
    missing: bool = False


MLP = re.compile(r"mlp:([1-9]\d{0,8}(?:x[1-9]\d{0,8})*)")


def hidden_layers(policy: str) -> list[int]:
    """Return the sizes of a policy's hidden layers. Raises ValueError for another form."""
    found = MLP.fullmatch(policy)
    if found is None:
        raise ValueError(f"--policy takes mlp and the sizes of its hidden layers, such as mlp:32x32; got {policy!r}")
    return [int(size) for size in found[1].split("x")]


def unknown_fidelity(name: str, known: Iterable[str], given: str) -> ValueError:
    """Return the error for an unknown fidelity of a scene."""
    return ValueError(f"{name} has fidelities {', '.join(known)}; got {given!r}")


# ---- The option that every simulated scene has.


@dataclass(frozen=True)
class EpisodeOptions:
    """`horizon`: how long an episode lasts, as a multiple of the scene's own duration.

    Steps and controls keep their lengths and times. In a shorter episode, controls after its end have no effect and no
    gradient. In a longer one, tools, pan, cart and joints rest after the last control, and bodies continue. The loss is
    that of the state at the end of the episode, or of all its steps. Targets made by a demonstration stay those of
    horizon 1.
    """

    horizon: float = field(default=1.0, kw_only=True, metadata={"most": 8.0})

    def count_steps(self, steps: int) -> int:
        """Return the number of steps of an episode, from the number of steps of the scene's own duration."""
        return max(1, round(self.horizon * steps))
