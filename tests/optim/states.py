"""What becomes of an optimiser that is written and read."""

from typing import TypeVar

from gradscape.landscapes.objective import Objective
from gradscape.optim.base import Optimizer
from gradscape.optim.runs.state import decode, encode

T = TypeVar("T", bound=Optimizer)


def restored(optimizer: T, objective: Objective) -> T:
    """Return the optimiser that is read from what is written of this one."""
    return type(optimizer).from_state(objective, decode(encode(optimizer.state())))
