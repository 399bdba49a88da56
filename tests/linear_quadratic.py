"""A linear-quadratic problem, x' = A x + B u with u = -K x: its loss and gradient by K from matrix recursions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
Q, R = np.diag([1.0, 0.1]), np.array([[0.05]])
START, STEPS = np.array([1.0, -0.5]), 40


def closed_form(K: Array) -> tuple[float, Array]:
    """Return the sum of x'Q x + u'R u over the steps, the last state's x'Q x included, and its gradient by K.

    Backwards, P = Q + K'R K + M'P M with M = A - B K; the loss is x'P x of the start. Forwards, the gradient is the sum
    of 2 (R K - B'P M) x x' with the P of the step after.
    """
    M, values = A - B @ K, [Q]
    for _ in range(STEPS):
        values.append(Q + K.T @ R @ K + M.T @ values[-1] @ M)
    gradient, x = np.zeros_like(K), START
    for after in reversed(values[:-1]):
        gradient += 2 * (R @ K - B.T @ after @ M) @ np.outer(x, x)
        x = M @ x
    return float(START @ values[-1] @ START), gradient
