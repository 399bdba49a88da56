"""Losses of any size, for models that square and add them."""

from __future__ import annotations

import numpy as np

from ..base import Points

LARGE = 1e100  # the squares of a billion of them still have a sum


def tame(loss: Points) -> Points:
    """Return finite losses as they are, or all divided by one power of two if the squares of some had no sum."""
    largest = float(np.abs(loss).max())
    return loss if largest < LARGE else np.ldexp(loss, -int(np.frexp(largest)[1]))
