"""The study `symmetry`: the parts of losses and gradients due to the scene, and due to its numerics.

The same points are evaluated under every replica of a scene, which computes the same physics differently.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from ..envs.registry import as_environment
from ..landscapes.measures.floor import Floor, floor_between, format_cosine, refuse_other_space, replica_cosines
from ..landscapes.objective import Evaluation
from ..landscapes.statistics import Estimate, spearman
from .samples import Bootstrap, Sample, interval_columns, percent
from .variants import Expected, StudyRecord, Variant, VariantStudy, part_name, samples_of

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.watch import Watch
    from .variants import StudyOptions

OWN, REPLICA = "the scene itself", "replica"
HOOK = (
    "a function takes replicas={'other grid': fn}, and a class a method `replicas` that returns environments by the "
    "name of the change (docs/measures.md)"
)


@dataclass(frozen=True)
class MeasuredReplica:
    """The comparison of one replica with the scene itself.

    `apart` is the root mean square over points of the standard deviation between both losses, as a share of the range;
    `spearman` the rank correlation of losses; `cosine` the median of gradients' cosines, `cosine_low` their lower
    quartile. At `failed` points one of both has no loss.
    """

    name: str
    apart: Estimate
    spearman: Bootstrap
    cosine: Estimate
    cosine_low: float
    failed: int


@dataclass(frozen=True, kw_only=True)
class SymmetryRecord(StudyRecord):
    """The replicas of a scene at the same points, each compared with the scene itself, and their joint floor."""

    kind: ClassVar[str] = "symmetry"
    read_elsewhere: ClassVar[bool] = False

    fidelity: str
    floor: Floor
    replicas: tuple[MeasuredReplica, ...]

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each replica.

        Columns: `apart`, the standard deviation between its losses and the scene's as a share of their range, with the
        ends of the 95 % interval; `spearman`; `cosine` and `cosine_low`, median and lower quartile; `failed`, points.
        """
        for one in self.replicas:
            yield {
                **{"name": one.name, **interval_columns("apart", one.apart), "spearman": one.spearman.value},
                **{"cosine": one.cosine.value, "cosine_low": one.cosine_low, "failed": one.failed},
            }

    def sentences(self) -> list[str]:
        """Return the numerical floor with its intervals, and the replica with the largest difference."""
        found = self.floor
        said = [f"{found.sentence()}{self._intervals()}"]
        known = [one for one in self.replicas if one.apart.value > 0]
        if len(known) > 1:
            farthest = max(known, key=lambda one: one.apart.value)
            said.append(
                f"largest difference from the scene itself: {farthest.name}, {percent(farthest.apart.value)} of the "
                "range"
            )
        if found.failed:
            said.append(f"{found.failed} of {self.points} points left out, because the scene or a replica fails there")
        return said

    def _intervals(self) -> str:
        """Return the ends of both 95 % intervals, in brackets; empty where points are too few."""
        share, cosine = self.floor.share, self.floor.cosine
        if not math.isfinite(share.low):
            return ""
        slopes = ""
        if cosine is not None and math.isfinite(cosine.low):
            slopes = f" and {format_cosine(cosine.low)} to {format_cosine(cosine.high)}"
        return f" (95 % intervals {percent(share.low)} to {percent(share.high)}{slopes})"


class SymmetryStudy(VariantStudy):
    """A scene and its replicas."""

    kind = "symmetry"
    what = "replicas"
    about_last = False
    default_points = 32
    advice = "plus compiling kernels; fewer --points or a cheaper --fidelity take less"

    def __init__(self, env: Environment, options: StudyOptions) -> None:
        self._replicas = {name: as_environment(one) for name, one in env.replicas().items()}
        if not self._replicas:
            raise ValueError(f"{env.name} has no replicas, which compute the same physics differently: {HOOK}")
        for name, one in self._replicas.items():
            refuse_other_space(env, name, one)
        super().__init__(env, options)

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers, as plain JSON; a study of other replicas is not continued."""
        return {**super().identity(), "replicas": {name: one.identity() for name, one in self._replicas.items()}}

    @cached_property
    def variants(self) -> list[Variant]:
        """The scene itself, and each of its replicas."""
        own = replace(Variant.of(self.env), name=OWN, changed="")
        return [own, *(replace(own, name=name, changed=REPLICA) for name in self._replicas)]

    def part(self, variant: Variant) -> str:
        """Return the name of a variant's part of the checkpoint."""
        return "own" if variant.changed != REPLICA else part_name("replica", variant.name, variant.name)

    def _make(self, variant: Variant) -> Environment:
        return self._replicas[variant.name] if variant.changed == REPLICA else self.env

    def _expect(self, variant: Variant, env: Environment) -> Expected:
        return Expected(variant.name, self.env, len(self.x))  # as much work, whatever a replica counts it in

    def run(self, watch: Watch, provenance: Mapping[str, Any], command: str) -> SymmetryRecord:
        """Measure the missing parts and return the record.

        Raises ValueError where neither the scene itself nor any replica can be measured.
        """
        found = {name: _evaluation(one) for name, one in samples_of(self.measure_all(watch)).items()}
        own = found.pop(OWN)
        if not found:
            raise ValueError(f"no replica of {self.env.name} can be measured: {next(iter(self.refused.values()))}")
        return SymmetryRecord(
            **self.about(provenance, command),
            fidelity=self.env.fidelity.name,
            floor=floor_between(own, found, seed=self.seed),
            replicas=tuple(_measure(name, own, one, self.seed) for name, one in found.items()),
        )


def _evaluation(sample: Sample) -> Evaluation:
    """Return the content of a sample; its gradients are already per width of the box."""
    return Evaluation(torch.from_numpy(sample.loss), torch.from_numpy(sample.grad), torch.from_numpy(sample.status))


def _measure(name: str, own: Evaluation, replica: Evaluation, seed: int) -> MeasuredReplica:
    """Compare a replica with the scene itself."""
    found = floor_between(own, {name: replica}, seed=seed)
    both = (own.has_loss & replica.has_loss).numpy()
    cosines = replica_cosines(own, replica)
    known = cosines[np.isfinite(cosines)]
    return MeasuredReplica(
        name=name,
        apart=found.share,
        spearman=Bootstrap.of(spearman, own.loss.numpy()[both], replica.loss.numpy()[both], seed=seed),
        cosine=found.cosine or Estimate(math.nan, math.nan, math.nan),
        cosine_low=float(np.quantile(known, 0.25)) if len(known) else math.nan,
        failed=found.failed,
    )
