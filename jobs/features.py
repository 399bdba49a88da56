"""Landscape features over all parameters, which a report may hold in addition to those of its slice."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..landscapes.capacity import peak_memory, require, size
from ..landscapes.cost import duration
from ..landscapes.measures.features import Features, effort, measure_features, need_of, own_seconds
from ..landscapes.verification import LAST_PLACE
from .plan import simulation_seconds
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from ..envs.base import Environment


def features_work(env: Environment) -> Work:
    """Return what the features of an environment evaluate."""
    losses, gradients = effort(env.space.dim)
    return Work(env, losses, gradients, memory=need_of(env.space.dim).memory)


def features_of(env: Environment, seed: int, watch: Watch) -> Features:
    """Announce what the features of an environment cost, and measure them.

    Raises TooLargeError for more parameters than this machine has memory for.
    """
    dim = env.space.dim
    require("parameters", dim, need_of)
    losses, gradients = effort(dim)
    with watch.busy(f"{env.name}: {PREPARING}"):
        seconds = simulation_seconds(env, losses, gradients, losses + gradients)
    memory = peak_memory() + need_of(dim).memory + env.memory() * env.preferred_batch
    watch.announce(
        f"{env.name} · features over all {dim} parameters: {losses} episodes and {gradients} with gradients: "
        f"about {duration(seconds)}, plus {duration(own_seconds(dim))} to measure them; {size(memory)} of memory",
        seconds + own_seconds(dim),
    )
    with watch.progress(losses + gradients, "episodes of features") as advance:
        return measure_features(env, seed=seed, rounding=LAST_PLACE[env.fidelity.precision], follow=advance)
