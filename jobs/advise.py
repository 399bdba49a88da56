"""Advice on how to begin a search: measures of the landscape, and the methods that helped in similar landscapes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ..landscapes.capacity import require
from ..landscapes.cost import duration
from ..landscapes.measures.character import GRADIENT_EVERY, Character, Measured, measure_character
from ..landscapes.objective import LossesOnly
from ..landscapes.storage.files import until_full
from ..optim.advice import EVALUATIONS, Choice, choose, raced_methods
from ..optim.memory import run_need
from ..optim.registry import optimizer_class
from ..studies.kept import find_fidelity
from .folder import ADVICE, IDENTITY
from .job import Job
from .scene import first_line
from .search import BestRecord, divide_methods, points_within
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from ..envs.base import Environment

TENTH = 10
TOLERANCE = 0.05  # of the spread of losses, within which a cheap fidelity is good enough to begin with
FILE = ADVICE.files[0]


@dataclass(frozen=True)
class Advice:
    """Record how to begin a search of `budget` episodes, of which `evaluations` were spent on measuring.

    `choice` is the method with its evidence. `unable` gives the reason for each method that cannot run here.
    `fidelity_advice` and `remedy_advice` say in words what was measured of these, or which command measures it.
    `gradient_cost` is about the cost of an episode with gradient, in episodes without, NaN if unknown. `best` is the
    best evaluated point.
    """

    env: str
    fidelity: str
    device: str
    loss_unit: str
    budget: int
    evaluations: int
    seed: int
    character: Character
    choice: Choice
    unable: Mapping[str, str]
    gradient_cost: float
    fidelity_advice: str
    remedy_advice: str
    best: BestRecord | None
    command: str = ""

    derived = ("method", "sentence")

    @property
    def method(self) -> str:
        """The method to begin with."""
        return self.choice.method

    @property
    def sentence(self) -> str:
        """Say which method to begin with, and why."""
        return f"begin with {self.method}: {self.choice.reason}"


@dataclass(frozen=True, kw_only=True)
class AdviseJob(Job[Advice]):
    """Measure an environment at a tenth of a budget at most, and advise; with a `folder` to keep it, or none."""

    results = ADVICE
    folder: Path = field(default=Path())
    env: Environment
    budget: int
    seed: int
    identity: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        env: Environment,
        *,
        budget: int,
        seed: int = 0,
        out: Path | None = None,
        force: bool = False,
        command: str = "",
    ) -> AdviseJob:
        """Return the job for an environment; nothing is kept of it without a folder `out`.

        Raises ValueError for a budget whose tenth is too little, TooLargeError for a search that would not fit here,
        and StoreMismatchError where the folder holds other advice, which `force` replaces.
        """
        require("budget", budget, lambda rows: run_need(env.space.dim, rows))
        identity = {**env.identity(), "budget": budget, "seed": seed}
        if out is not None:
            ADVICE.check(out)
            if not force:
                ADVICE.refuse_another(out, identity)
        return cls(env=env, budget=budget, seed=seed, identity=identity, folder=out or Path(), command=command)

    @property
    def evaluations(self) -> int:
        """The number of points that are evaluated."""
        return min(EVALUATIONS, points_within(self.env, self.budget) // TENTH)

    def work(self) -> list[Work]:
        """Return the points that are evaluated."""
        gradients = self.evaluations // GRADIENT_EVERY
        return [Work(self.env, self.evaluations - gradients, gradients)]

    def compute(self, watch: Watch) -> Advice:
        """Measure the landscape, and advise."""
        env, count = self.env, self.evaluations
        with watch.busy(f"{env.name}: {PREPARING}"):
            env.prepare()
        watch.note(f"{first_line(env.identity())}: measuring takes {count} of {self.budget} episodes")
        with watch.busy(f"{env.name}: measuring the landscape"):
            try:
                found, sloped = measure_character(env, evaluations=count, seed=self.seed), True
            except ValueError:  # it has losses alone, which the first point told
                found, sloped = measure_character(LossesOnly(env), evaluations=count - 1, seed=self.seed), False
        able, unable = divide_methods(env, raced_methods())
        methods = [one for one in able if sloped or not optimizer_class(one).needs_grad]
        return Advice(
            env=env.name,
            fidelity=env.fidelity.name,
            device=env.device,
            loss_unit=env.loss_unit,
            budget=self.budget,
            evaluations=count,
            seed=self.seed,
            character=found.character,
            choice=choose(found.character, methods),
            unable=unable,
            gradient_cost=found.gradient_cost if sloped else math.nan,
            fidelity_advice=advise_fidelity(env),
            remedy_advice=f"not measured; `landscape remedy {env.name}` measures which remedy helps a search",
            best=_best(env, found),
            command=self.command,
        )

    def holding(self, watch: Watch) -> AbstractContextManager[None]:
        """Let a full disk end it; what is stopped begins again."""
        return until_full(lambda: "the advice is not saved")

    def record(self, found: Advice) -> Any:
        """Return what is written of it, with what was measured."""
        return {**super().record(found), IDENTITY: self.identity}

    def outcome(self, found: Advice) -> str:
        """Say in a line what came out."""
        return found.sentence


def _best(env: Environment, found: Measured) -> BestRecord | None:
    """Return the best point that was measured, None where none has a loss."""
    if not bool(found.loss.isfinite().any()):
        return None
    row = int(found.loss.nan_to_num(torch.inf).argmin())
    return BestRecord(float(found.loss[row]), row + 1, env.space.to_values(found.x[row]).tolist())


def advise_fidelity(env: Environment) -> str:
    """Say which fidelity to begin with: the quickest whose measured errors are small, else the cheapest."""
    names = list(env.fidelities)
    if len(names) == 1:
        return f"{names[0]}, the only one"
    known = find_fidelity(env, env.device)
    if known is None:
        return f"{names[0]}, the cheapest; `landscape study fidelity {env.name}` measures its errors"
    named = [one for one in known[0].by_time if one.name in names]
    good = [one for one in named if (off := one.p95(relative=True)) is not None and off <= TOLERANCE]
    if not good:
        return f"{known[0].reference}: no other is within {TOLERANCE:.0%} of the spread of losses ({known[1].name})"
    one = good[0]
    error, seconds = one.p95(relative=True) or 0.0, duration(one.seconds)
    return (
        f"{one.name}: 95 % of its losses are within {error:.1%} of the spread, and an episode with gradient takes "
        f"{seconds} on {known[0].device} ({known[1].name})"
    )
