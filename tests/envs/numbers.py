"""Stored losses and gradients of every scene by its model's version, which say when numbers have moved.

    python -m tests.envs.numbers [SCENE ...]     # writes those of a version that has none yet

`numbers.json` holds them by scene and version, and within a version by engine and by what they are of: `draft`, or
what the contract's tests (`tiny`) and those of two engines (`compared`) evaluate anyway. A gradient is kept as its
components along a few fixed directions. Beside the numbers stands how much they move where the points are moved by
rounding; another processor moves them by some times as much, another model by more than `FACTOR` times.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from gradscape.envs.base import Environment
from gradscape.envs.mjx.scene import MjxScene
from gradscape.envs.registry import environment_class, make
from gradscape.landscapes.objective import Evaluation

from .scenes import REGISTERED, SETTINGS, SHORT, TAICHI, made

STORED = Path(__file__).with_name("numbers.json")
FACTOR = 300.0  # times the change by rounding: losses of a GPU are off by up to 72 times as much
KEPT = 2  # of the points of each, those that rounding changes least
MOVES = 8  # for each point, by rounding
DIRECTIONS = 4
ROUNDING = {
    "float32": 2.0**-24,
    "float64": 2.0**-42,
}  # of float64 that of some thousand steps
POINTS = {"draft": (8, 2), "tiny": (5, 1), "compared": (3, 5)}  # how many, and their seed


@dataclass(frozen=True)
class Numbers:
    """Hold losses and slopes of a few rows of a batch, and how much each kind moves by rounding."""

    rows: list[int]
    loss: list[float]
    slopes: list[list[float]]
    rounding: dict[str, float]

    @property
    def kinds(self) -> dict[str, Tensor]:
        """The numbers by kind."""
        both = {"loss": self.loss, "slope": self.slopes}
        return {kind: torch.tensor(values, dtype=torch.float64) for kind, values in both.items()}


def points_of(env: Environment, of: str) -> Tensor:
    """Return the points of which numbers are kept."""
    count, seed = POINTS[of]
    return env.space.uniform(count, seed=seed)


def slopes(grad: Tensor) -> Tensor:
    """Return components of gradients along fixed directions, shape (batch, direction)."""
    dim = grad.shape[1]
    if dim <= DIRECTIONS:
        return grad
    along = torch.cos(torch.arange(1.0, DIRECTIONS + 1)[:, None] * torch.arange(dim, dtype=torch.float64))
    return grad @ along.T.to(grad)


def moved(env: Environment, of: str, found: Evaluation | None = None) -> str:
    """Say that numbers are not those stored of an environment's model version, nothing where they are.

    `found` is what it computes at its points; without that it is asked for those that are kept.
    """
    version, key = env.version_on(env.engine), f"{env.engine} {of}"
    kept = stored().get(env.name, {}).get(str(version), {}).get(key)
    if kept is None:
        write = f"`python -m tests.envs.numbers {env.name}` writes them"
        return f"{env.name} has no stored numbers of model {version} ({key}): {write}"
    rows = kept.rows if found else slice(None)
    found = found or env.evaluate(points_of(env, of)[kept.rows])
    assert found.grad is not None
    for kind, ours in {"loss": found.loss[rows], "slope": slopes(found.grad)[rows]}.items():
        off = (ours - kept.kinds[kind]).abs()
        if not bool((off <= FACTOR * kept.rounding[kind]).all()):  # NaN is none
            worst = int(off.nan_to_num(torch.inf).argmax())
            then, now = float(kept.kinds[kind].flatten()[worst]), float(ours.flatten()[worst])
            change = f"{kind} {then:.6g} stored, {now:.6g} now; {key}"
            return f"numbers of {env.name} moved ({change}): raise model_version or revert"
    return ""


@cache
def stored() -> dict[str, dict[str, dict[str, Numbers]]]:
    """Return the stored numbers by scene, version, and engine and fidelity."""
    found = json.loads(STORED.read_text()) if STORED.exists() else {}
    return {
        name: {version: {key: Numbers(**one) for key, one in numbers.items()} for version, numbers in versions.items()}
        for name, versions in found.items()
    }


def subjects(name: str) -> Iterator[tuple[Environment, str]]:
    """Yield of what the numbers of a scene are kept."""
    if not issubclass(environment_class(name), MjxScene):  # which take a minute to compile
        yield make(name, device="cpu"), "draft"
    yield made(name), "tiny"
    if name in TAICHI:
        yield make(name, engine="taichi", device="cpu", **SETTINGS[name], **SHORT.get(name, {})), "compared"


def measure(env: Environment, x: Tensor) -> Numbers:
    """Return the numbers of the points that rounding changes least, and how much it changes them."""
    epsilon = ROUNDING[env.fidelity.precision]
    width, draw = env.space.upper - env.space.lower, torch.Generator().manual_seed(0)
    found = env.evaluate(x)
    assert found.grad is not None
    whole = {"loss": found.loss[:, None], "slope": slopes(found.grad)}
    change = {kind: epsilon * value.abs().amax(dim=1) for kind, value in whole.items()}
    for _ in range(MOVES):
        signs = torch.randn(x.shape, generator=draw, dtype=torch.float64).sign()
        near = env.evaluate((x + epsilon * width * signs).clamp(env.space.lower, env.space.upper))
        assert near.grad is not None
        for kind, value in {"loss": near.loss[:, None], "slope": slopes(near.grad)}.items():
            change[kind] = torch.maximum(change[kind], (value - whole[kind]).abs().amax(dim=1))
    share = torch.stack([change[kind] / value.abs().amax(dim=1) for kind, value in whole.items()]).amax(dim=0)
    rows = sorted(share.nan_to_num(torch.inf).argsort()[:KEPT].tolist())  # those without a slope last
    return Numbers(
        rows,
        found.loss[rows].tolist(),
        slopes(found.grad)[rows].tolist(),
        {kind: float(f"{float(value[rows].max()):.3g}") for kind, value in change.items()},
    )


def write(names: list[str]) -> None:
    """Write numbers of scenes' versions that have none, and name those that moved."""
    for name in names or REGISTERED:
        for env, of in subjects(name):
            versions = stored().setdefault(name, {}).setdefault(str(env.version_on(env.engine)), {})
            if (key := f"{env.engine} {of}") in versions:
                print(moved(env, of) or f"{name} ({key}): as stored", flush=True)
            else:
                versions[key] = measure(env, points_of(env, of))
                print(f"{name} ({key}): written", flush=True)
            STORED.write_text(json.dumps(stored(), default=asdict, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    write(sys.argv[1:])
