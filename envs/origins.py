"""Find where a gradient first is not finite: the operation and the line that calls it; here for torch."""

from __future__ import annotations

import contextlib
import functools
import linecache
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

MAX_CODE = 80  # characters of a line of code that are shown
Place = tuple[str, int]  # a file and the number of a line in it
_PYTHON = (contextlib.__file__, functools.__file__)


def describe_origin(operation: str, place: Place | None) -> str:
    """Return a sentence's end such as `sqrt in line 12 of my.py ("jnp.sqrt(p[0])")`."""
    if place is None:
        return operation
    file, number = place
    code = linecache.getline(file, number).strip()
    code = code if len(code) <= MAX_CODE else f"{code[:MAX_CODE]}..."
    return f"{operation} in line {number} of {Path(file).name}" + (f' ("{code}")' if code else "")


def callers_line(frames: Iterable[Place], library: str) -> Place | None:
    """Return the first call site outside a library's folder; sites start from the innermost."""
    known = list(frames)
    own = (place for place in known if not in_library(place[0], library) and place[0] not in _PYTHON)
    return next(own, known[0] if known else None)


def in_library(file: str, library: str) -> bool:
    """Say whether a file lies in a library's folder, given by the file of the library's package."""
    return Path(library).parent in Path(file).parents


def torch_origin(losses: Callable[[Tensor], Tensor], x: Float[Tensor, "one dim"]) -> str:
    """Return the operation whose derivative is the first, backwards from the losses, that is not finite.

    Empty where all are finite.
    """
    points = x.detach().clone().requires_grad_()
    with _lines_recorded():
        loss = losses(points)
    seen: list[int] = []  # by number: a hook that held its node would keep the whole graph
    nodes = list(_graph(loss.grad_fn))
    handles = [node.register_hook(functools.partial(_look, seen, number)) for number, node in enumerate(nodes)]
    try:
        torch.autograd.grad(loss.sum(), points, allow_unused=True)
    finally:
        for handle in handles:
            handle.remove()
    return _describe_node(nodes[seen[0]]) if seen else ""


def _look(
    seen: list[int], number: int, produced: tuple[Tensor | None, ...], arrived: tuple[Tensor | None, ...]
) -> None:
    """Remember a node that receives finite derivatives and returns derivatives that are not."""
    if not seen and _finite(arrived) and not _finite(produced):
        seen.append(number)


def _finite(values: Iterable[Tensor | None]) -> bool:
    return all(bool(one.isfinite().all()) for one in values if one is not None)


@contextmanager
def _lines_recorded() -> Iterator[None]:
    """Let torch record the call site of each operation; `detect_anomaly` does so too, but prints."""
    before = torch.is_anomaly_enabled(), torch.is_anomaly_check_nan_enabled()
    torch.autograd.set_detect_anomaly(True, check_nan=False)
    try:
        yield
    finally:
        torch.autograd.set_detect_anomaly(*before)


def _graph(last: Any) -> Iterator[Any]:
    """Yield the nodes of torch's graph that lead to the last one."""
    known, ahead = set(), [last]
    while ahead:
        node = ahead.pop()
        if node is not None and node not in known:
            known.add(node)
            ahead += [before for before, _ in node.next_functions]
            yield node


def _describe_node(node: Any) -> str:
    """Return a node's operation and its call site: SqrtBackward0 is torch's `sqrt`."""
    name, _, number = node.name().partition("Backward")
    if number:  # torch's own
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    said = "".join(node.metadata.get("traceback_", ()))
    frames = [(file, int(line)) for file, line in re.findall(r'File "(.*)", line (\d+)', said)]
    return describe_origin(name, callers_line(reversed(frames), torch.__file__))
