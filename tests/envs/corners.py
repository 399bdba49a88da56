"""What an environment says at the corners of its box and beyond, and what is wrong with that."""

from collections.abc import Iterator
from typing import Any

import torch

from gradscape.envs.registry import environment_class, make
from gradscape.landscapes.checks.extremes import corners
from gradscape.landscapes.objective import Status

OUTWARD = (0.0, 1e-12, 0.01, 0.1, 1.0, 1e3, 1e9, 1e30, 1e38, 1e39, 1e300)  # shares of the box
HOLDS = {"float32": torch.finfo(torch.float32).max, "float64": torch.finfo(torch.float64).max}


def small(name: str) -> Any:
    """Make an environment at its first fidelity, with short episodes where it has any."""
    kind = environment_class(name)
    options = {"horizon": 0.1} if hasattr(kind.Options, "horizon") else {}
    return make(name, fidelity=next(iter(kind.fidelities)), device="cpu", **options)


def faults(env: Any, outward: tuple[float, ...], max_corners: int) -> Iterator[str]:
    """Yield what is wrong with the answers at corners moved outward by shares of the box, with gradients and without.

    An OK loss has to be finite, with its gradient, and its parameters finite in the precision of the simulation; a
    failed episode has no loss. A ValueError refuses the points.
    """
    ends = corners(env.space.dim)[:max_corners]
    for share in outward:
        x = env.space.from_unit(ends + share * (2 * ends - 1))
        x = x[x.isfinite().all(dim=1)]
        for grad in (True, False) if len(x) else ():
            try:
                found = env.evaluate(x, grad=grad)
            except ValueError:
                continue
            ok, finite = found.status == Status.OK, found.loss.isfinite()
            sound = finite if found.grad is None else finite & found.grad.isfinite().all(dim=1)
            held = (x.abs() <= HOLDS[env.fidelity.precision]).all(dim=1)
            unknown = (found.status <= Status.MISSING) | (found.status > max(Status))
            for fault, rows in {
                "no status": unknown,
                "OK and not finite": ok & ~sound,
                "OK beyond its precision": ok & ~held,
                "failed with a loss": ~ok & (found.status != Status.NO_GRADIENT) & finite,
            }.items():
                yield from (f"{fault}: {env.name}, {share:g} outward, x = {row[:12].tolist()}" for row in x[rows])
