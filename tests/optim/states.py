"""What becomes of an optimiser that is written and read, and what a surrogate knows and proposes."""

from typing import TypeVar

import numpy as np
from botorch.models import SingleTaskGP

from gradscape.landscapes.objective import Objective
from gradscape.optim.base import Optimizer, Points
from gradscape.optim.lockstep import answer_alone
from gradscape.optim.methods.surrogate import Surrogate, exclusive
from gradscape.optim.runs.store import decode, encode

T = TypeVar("T", bound=Optimizer)


def restored(optimizer: T, objective: Objective) -> T:
    """Return the optimiser that is read from what is written of this one."""
    return type(optimizer).from_state(objective, decode(encode(optimizer.state())))


def model_of(surrogate: Surrogate) -> SingleTaskGP:
    """Return BoTorch's model of what a surrogate's process is of, its hyper-parameters fitted if that is due."""
    with exclusive():
        return surrogate._condition(surrogate._learn()).eval()


def proposal_of(surrogate: Surrogate, seed: int | np.random.Generator = 0) -> Points:
    """Return where the bound of a surrogate is least, or a random point where it is not informed."""
    return answer_alone(surrogate.minimise(np.random.default_rng(seed)), None)
