"""Ask every environment at and far beyond the corners of its box: what is called OK is finite, and was simulated there.

    python -m benchmarks.corners [--env fluid] [--fidelity draft] [--horizon 0.1] [--json]

Corners are those that `landscape check` takes; each is moved outward by shares of the box, up to numbers that no
float32 holds. An environment answers with a status for each point or refuses it in a line. A loss that is not finite
and called OK is wrong, so is a finite one of an episode that failed, and so is one that is OK at parameters which its
precision made infinite. Exit code 1 says that there was one.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gradscape.envs.registry import entries, environment_class, make
from gradscape.landscapes.conformance.extremes import corners
from gradscape.landscapes.objective import Evaluation, Status

OUTWARD = (0.0, 1e-12, 0.01, 0.1, 1.0, 1e3, 1e9, 1e30, 1e38, 1e39, 1e300)  # shares of the box
MOST = 16  # corners of one environment
HOLDS = {"float32": torch.finfo(torch.float32).max, "float64": torch.finfo(torch.float64).max}
GOOD = ("ok", "failed", "refused", "infinite")  # the last is a point that is no number and so none to ask


@dataclass(frozen=True)
class Answer:
    """What one environment said of one point."""

    env: str
    outward: float
    x: tuple[float, ...]
    outcome: str
    said: str = ""


def small(name: str, fidelity: str | None = None, horizon: float = 0.1) -> Any:
    """Make an environment at its first fidelity, or another, with short episodes where it has any."""
    kind = environment_class(name)
    options = {"horizon": horizon} if hasattr(kind.Options, "horizon") else {}
    known = fidelity if fidelity in kind.fidelities else next(iter(kind.fidelities))
    return make(name, fidelity=known, device="cpu", **options)


def answers(env: Any, outward: tuple[float, ...] = OUTWARD, most: int = MOST) -> Iterator[Answer]:
    """Yield what an environment says of its corners, with gradients and without."""
    ends = corners(env.space.dim)[:most]
    for share in outward:
        x = env.space.from_unit(ends + share * (2 * ends - 1))
        rows = x[x.isfinite().all(dim=1)]
        yield from (Answer(env.name, share, tuple(row.tolist()), "infinite") for row in x[~x.isfinite().all(dim=1)])
        for grad in (True, False):
            if len(rows):
                yield from _asked(env, share, rows, grad=grad)


def _asked(env: Any, share: float, x: Tensor, *, grad: bool) -> Iterator[Answer]:
    try:
        found = env.evaluate(x, grad=grad)
    except ValueError as refusal:
        yield from (Answer(env.name, share, tuple(row.tolist()), "refused", str(refusal)) for row in x)
        return
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
        yield from (Answer(env.name, share, tuple(row.tolist()), "raised", said) for row in x)
        return
    held = (x.abs() <= HOLDS[env.fidelity.precision]).all(dim=1)
    for number, row in enumerate(x):
        yield Answer(env.name, share, tuple(row.tolist()), _judged(found, number, held=bool(held[number])))


def _judged(found: Evaluation, row: int, *, held: bool) -> str:
    """Say in a word what one row's answer is."""
    ok = int(found.status[row]) == Status.OK
    finite = bool(found.loss[row].isfinite()) and (found.grad is None or bool(found.grad[row].isfinite().all()))
    if not Status.MISSING < int(found.status[row]) <= max(Status):
        return "no status"
    if ok and not finite:
        return "OK and not finite"
    if ok and not held:
        return "OK beyond its precision"
    return "ok" if ok else "failed with a loss" if bool(found.loss[row].isfinite()) else "failed"


def main() -> None:
    """Print what environments said, and every answer that is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", action="append", choices=list(entries()))
    parser.add_argument("--fidelity")
    parser.add_argument("--horizon", type=float, default=0.1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    found, told = list[Answer](), set[tuple[str, float, str]]()
    for name in given.env or list(entries()):
        for answer in answers(small(name, given.fidelity, given.horizon)):
            found.append(answer)
            what = (name, answer.outward, answer.outcome)
            if answer.outcome not in GOOD and what not in told:
                told.add(what)
                print(f"{answer.outcome}: {name}, {answer.outward:g} of the box outward: x = {list(answer.x)[:12]}"
                      f"{' ' + answer.said if answer.said else ''}", file=sys.stderr, flush=True)  # fmt: skip
    bad = sorted({answer.outcome for answer in found} - set(GOOD))
    if given.json:
        print(json.dumps([answer.__dict__ for answer in found]))
    else:
        counts = Counter((answer.env, answer.outcome) for answer in found)
        print(
            f"{len(found)} points\n\n| environment | {' | '.join([*GOOD, *bad])} |\n|---|{'---|' * len([*GOOD, *bad])}"
        )
        for name in dict.fromkeys(answer.env for answer in found):
            print(f"| {name} | {' | '.join(str(counts[name, one]) for one in [*GOOD, *bad])} |")
    sys.exit(int(bool(bad)))


if __name__ == "__main__":
    main()
