"""Find the kernel that makes a gradient of Warp wrong, by examining a tape launch by launch.

A gradient that is not finite is traced by playing the tape backwards. A finite wrong one comes from a kernel whose
adjoint is not its derivative: a loop that overwrites a variable, an array overwritten in place, or a custom adjoint.
Each launch is a function f of the arrays before it. Along random directions v and w, w f'(x) v by differences is
compared with v times the adjoint of w.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp


def warp_origin(tape: Any, losses: Any) -> str:
    """Return the kernel whose adjoint is the first, backwards from the losses, that is not finite, and by what.

    Empty where all are finite.
    """
    grads: Any = {losses: wp.ones_like(losses, requires_grad=False)}
    launches = tape.launches
    try:
        for launch in reversed(launches):
            tape.launches = [launch]
            tape.backward(grads=grads)
            grads = None
            if said := _broken(tape, launch):
                return said
    finally:
        tape.launches = launches
    return ""


def _broken(tape: Any, launch: Any) -> str:
    """Return the launch where a derivative by one of its arguments is not finite, and which; else nothing."""
    if callable(launch):  # such as a copy
        broken = any(not _finite(array) for array in list(tape.gradients) if isinstance(array, wp.array))
        return "a function that the tape has recorded, or a copy" if broken else ""
    kernel, values = launch[0], (*launch[3], *launch[4])
    for value, argument in zip(values, kernel.adj.args, strict=True):
        for part, array in _arrays(value, argument.label):
            if not _finite(array):
                return f"{_describe_kernel(kernel)}, by its argument {part}"
    return ""


def _describe_kernel(kernel: Any) -> str:
    """Return a kernel's name and where it is defined."""
    adjoint = kernel.adj
    return f"kernel {adjoint.fun_name} in line {adjoint.fun_lineno} of {Path(adjoint.filename).name}"


def _arrays(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the arrays in an argument: itself, or those of a struct, with their names."""
    if isinstance(value, wp.array):
        yield name, value
    elif (kind := getattr(value, "_cls", None)) is not None:
        for part in kind.vars:
            yield from _arrays(getattr(value, part), f"{name}.{part}")


def _finite(array: Any) -> bool:
    return array.grad is None or bool(np.isfinite(_numbers(array.grad)).all())


def _numbers(array: Any) -> Any:
    """Return the numbers of an array of floating-point numbers, vectors or matrices."""
    return np.asarray(array.numpy(), dtype=np.float64)


STEPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)  # of differences, in shares of the numbers in an array
DIRECTIONS, MOST_WRONG = 3, 2  # that are tried, and of them those that a kernel is named for
AGREE, DIFFER = 0.02, 0.05  # relative differences: of differences over two steps, and of those from the adjoint
Arrays = dict[int, Any]  # by the identity of an argument's array


def wrong_kernel(tape: Any) -> str:
    """Return the first kernel of a tape whose adjoint is finite but differs from differences; "" where none does.

    The first and the last launch of each kernel are examined.
    """
    launches: dict[Any, list[Any]] = {}
    for launch in tape.launches:
        if not callable(launch):
            launches.setdefault(launch[0], []).append(launch)
    for kernel, own in launches.items():
        for launch in own if len(own) == 1 else (own[0], own[-1]):
            if _Probe(launch).is_wrong():
                return _describe_kernel(kernel)
    return ""


class _Probe:
    """A launch as a function of the arrays before it: its results from copies of them."""

    def __init__(self, launch: Any) -> None:
        self.launch, self.arguments = launch, (*launch[3], *launch[4])
        self.arrays: Arrays = {}
        for value in self.arguments:
            self.arrays |= {id(array): array for _, array in _arrays(value)}
        self.free = [key for key, array in self.arrays.items() if array.requires_grad]
        self.base = {key: _numbers(self.arrays[key]) for key in self.free}
        self.random = np.random.default_rng(0)

    def is_wrong(self) -> bool:
        """Say whether the adjoint differs from differences along most directions."""
        after = self._run(self.base)
        moved = {key: base + self._direction(base) for key, base in self.base.items()}
        kept = [key for key, base in self.base.items() if not self._is_overwritten(key, moved[key], after[key])]
        return sum(self._differs(kept) for _ in range(DIRECTIONS)) >= MOST_WRONG if kept else False

    def _is_overwritten(self, key: int, moved: Any, after: Any) -> bool:
        """Say whether the launch writes to an array without regard to what it held: its adjoint is left as it was."""
        found = self._run(self.base | {key: moved})[key]
        return bool(((found == after) & (moved != self.base[key])).any())

    def _differs(self, kept: list[int]) -> bool:
        v = {key: self._direction(self.base[key]) for key in kept}
        w = {key: self.random.standard_normal(base.shape) for key, base in self.base.items()}
        adjoint = self._pull(w)
        exact = sum(float((v[key] * adjoint[key]).sum()) for key in kept)
        slopes = [self._difference(v, w, step) for step in STEPS]
        pairs = [(one, other) for one, other in pairwise(slopes) if _apart(one, other) < AGREE]
        return bool(pairs) and np.isfinite(exact) and all(_apart(one, exact) > DIFFER for pair in pairs for one in pair)

    def _direction(self, base: Any) -> Any:
        """Return random numbers of the size of those in an array."""
        scale = float(np.abs(base[np.isfinite(base)]).mean()) if base.size else 1.0
        return self.random.standard_normal(base.shape) * np.maximum(np.abs(base), scale or 1.0)

    def _difference(self, v: Arrays, w: Arrays, step: float) -> float:
        """Return the central difference of what comes out, weighted by w, along v."""
        ends = (self._run(self.base | {key: self.base[key] + sign * step * v[key] for key in v}) for sign in (1, -1))
        up, down = ends
        total = sum(float((w[key] * (up[key] - down[key])).sum()) for key in w)
        return total / (2 * step)

    def _run(self, values: Arrays) -> Arrays:
        """Return what arrays hold after a launch from such values."""
        copies = self._copies(values)
        self._launch(copies)
        return {key: _numbers(copies[key]) for key in self.free}

    def _pull(self, w: Arrays) -> Arrays:
        """Return the derivatives by what arrays hold before the launch, by those of what they hold after it."""
        copies = self._copies(self.base)
        for key, weights in w.items():
            copies[key].grad.assign(weights)
        tape = wp.Tape()
        tape.launches = [self._launch(copies)]
        tape.backward()
        return {key: _numbers(copies[key].grad) for key in self.free}

    def _copies(self, values: Arrays) -> Arrays:
        copies = {key: wp.clone(array, requires_grad=array.requires_grad) for key, array in self.arrays.items()}
        for key, numbers in values.items():
            copies[key].assign(numbers)
        return copies

    def _launch(self, copies: Arrays) -> list[Any]:
        """Launch the kernel on copies, and return the launch as a tape has it."""
        own = [_with_copies(value, copies) for value in self.arguments]
        with wp.Tape() as tape:
            wp.launch(self.launch[0], self.launch[1], inputs=own, device=self.launch[5])
        (recorded,) = tape.launches
        return list(recorded)


def _apart(one: float, other: float) -> float:
    """Return the relative difference of two numbers, 0 of two zeros."""
    return abs(one - other) / (max(abs(one), abs(other)) or 1.0)


def _with_copies(value: Any, copies: Arrays) -> Any:
    """Return an argument with copies of its arrays."""
    if isinstance(value, wp.array):
        return copies[id(value)]
    kind = getattr(value, "_cls", None)
    if kind is None:
        return value
    copied = kind()
    for part in kind.vars:
        setattr(copied, part, _with_copies(getattr(value, part), copies))
    return copied
