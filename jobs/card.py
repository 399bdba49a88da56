"""A report card of gradients: every engine in every scene is checked and cut along one plane."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..envs.engines import installed_version
from ..envs.registry import EXTRAS, entries, environment_class, installs
from ..landscapes.capacity import require
from ..landscapes.checks.finding import FAIL, UNEXPECTED
from ..landscapes.identity import PACKAGE
from ..landscapes.measures.card import Card, CardSlice, Grade, Outcome, count_outcomes, first_finding
from ..landscapes.storage.arrays import need_of
from ..landscapes.storage.checkpoint import Checkpoint
from .check import CheckJob
from .folder import CARD, ROOT, folder_named
from .job import CheckpointedJob
from .scene import ABSENT, SceneSpec, plane_through
from .watch import Watch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..envs.base import Environment

OURS = (PACKAGE, "warp-lang")  # what our own scenes are simulated by
POINTS = 3  # that are checked
LARGEST = 400  # parameters, of a chain


@dataclass(frozen=True)
class Entrant:
    """Say which environment stands for an engine in a scene of the card, and along which parameters it is cut."""

    scene: str
    engine: str
    env: str
    dims: tuple[int | str, int | str] = ("velocity x", "velocity y")
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What its part of the study is called."""
        return "-".join([self.env, *(f"{name}-{value}" for name, value in self.options.items())])

    def spec(self, device: str) -> SceneSpec:
        """Return what makes its environment."""
        return SceneSpec(self.env, device=device, options=dict(self.options))

    @property
    def settings(self) -> str:
        """Its options as a command takes them."""
        return "".join(f" --set {name}={value}" for name, value in self.options.items())


def _newton(scene: str, env: str, *solvers: str) -> tuple[Entrant, ...]:
    return tuple(Entrant(scene, f"Newton, {solver}", env, options={"solver": solver}) for solver in solvers)


ENTRANTS = (
    Entrant("control", "torch, Branin's function", "branin", (0, 1)),  # the control: its gradient is known
    *_newton("flight", "newton-flight", "semi-implicit", "featherstone", "xpbd"),
    Entrant("drop", "MJX", "mjx-drop"),
    Entrant("drop", "MJX, one iteration", "mjx-drop", options={"iterations": 1}),
    Entrant("bounce", "gradscape", "bounce"),
    Entrant("bounce", "gradscape, time of touch", "bounce", options={"contacts": "touch"}),
    Entrant("bounce", "MJX", "mjx-bounce", ("velocity x", "velocity z")),
    *_newton("bounce", "newton-ball", "semi-implicit", "featherstone", "xpbd"),
    Entrant("slide", "MJX", "mjx-push", (0, 2)),
    Entrant("slide", "MJX, one iteration", "mjx-push", (0, 2), {"iterations": 1}),
    Entrant("chain", "gradscape", "cartpole", (201, 202)),
    Entrant("chain", "MJX", "mjx-cartpole", (201, 202)),
    *_newton("cloth", "newton-cloth", "semi-implicit", "xpbd"),
)


@dataclass(frozen=True, kw_only=True)
class CardJob(CheckpointedJob[Card]):
    """Engines in scenes to check and to cut, a part of the checkpoint for each."""

    results = CARD
    entrants: Sequence[Entrant]
    resolution: int
    device: str

    @classmethod
    def open(
        cls,
        scenes: Sequence[str] = (),
        *,
        resolution: int = 17,
        device: str = "auto",
        out: Path | None = None,
        root: Path = ROOT,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
    ) -> CardJob:
        """Continue the card in its folder, by default one under `root`, or begin it there.

        `scenes` are those of the card, by default all. Raises ValueError for a scene that it does not have,
        StoreMismatchError where the folder holds a card of other versions of the engines, or of other scenes.
        """
        known = list(dict.fromkeys(one.scene for one in ENTRANTS))
        if unknown := [one for one in scenes if one not in known]:
            raise ValueError(f"the card has no scene {unknown[0]!r}; it has {', '.join(known)}")
        require("resolution", resolution, lambda points: need_of((points, points), LARGEST, grad=True))
        chosen = [one for one in ENTRANTS if not scenes or one.scene in scenes]
        packages = dict.fromkeys([*OURS, *(package for extra in EXTRAS.values() for package in extra)])
        versions = {package: installed_version(package) for package in packages if package != PACKAGE}
        identity = {"resolution": resolution, "device": device, "versions": versions, "model_versions": _models()}
        folder = out or folder_named(["card"], identity, root)
        checkpoint = Checkpoint.open(folder, identity, what="report card", force=force)
        return cls(
            entrants=chosen, resolution=resolution, device=device, checkpoint=checkpoint, folder=folder,
            command=command, prints=prints,
        )  # fmt: skip

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.checkpoint.count()} of {len(self.entrants)} engines in scenes are kept in {self.folder}"

    def compute(self, watch: Watch) -> Card:
        """Check and cut what is missing, and return the card."""
        grades, slices, device = list[Grade](), dict[int, CardSlice](), self.device
        with watch.progress(len(self.entrants), "engines in scenes") as advance:
            for number, one in enumerate(self.entrants):
                advance(number, f"{one.scene}: {one.engine}")
                if missing := installs(entries()[one.env]):
                    grades.append(_grade(one, "not installed", missing, self.resolution))
                    continue
                arrays = self._arrays(one)
                about = json.loads(str(arrays["about"]))
                device = about["device"]
                grades.append(_graded(one, about, self.resolution))
                if arrays["loss"].size:
                    slices[number] = _slice_of(arrays, about)
            advance(len(self.entrants))
        created = datetime.now(UTC).strftime("%Y-%m-%d")
        return Card(tuple(grades), created, device, self.command, slices)

    def _arrays(self, one: Entrant) -> dict[str, NDArray[Any]]:
        """Return what is found of an entrant, from what is kept of it where that is there."""
        arrays = self.checkpoint.load(one.name)
        if arrays is not None:
            if arrays["loss"].size:
                self.checkpoint.verify(one.spec(self.device).make(), of=one.name)
            return arrays
        env, arrays = _measure(one, self.resolution, self.device)
        if arrays["loss"].size:
            self.checkpoint.verify(env, of=one.name)
        self.checkpoint.save(one.name, **arrays)
        return arrays


def _models() -> dict[str, int]:
    """Return the versions of the scenes' models, by their names."""
    kinds = {one.env: environment_class(one.env) for one in ENTRANTS}
    return {name: kind.version_on(kind.engines[0]) for name, kind in kinds.items()}


def _measure(one: Entrant, resolution: int, device: str) -> tuple[Environment, dict[str, NDArray[Any]]]:
    """Check an entrant, and sample its slice unless its evaluations are of the wrong form; return both."""
    from ..landscapes.sampling.fill import sample

    job = CheckJob.open(one.spec(device), points=POINTS)
    report, env = job.run(Watch()).record(), job.env
    plane = plane_through(env, one.dims, through="center", window=None, resolution=resolution)
    about = {name: report[name] for name in ("checks", "fidelity", "device")}
    about |= {"labels": plane.labels, "loss_unit": env.loss_unit}
    if report["checks"][0]["outcome"] == FAIL:
        return env, {"about": np.array(json.dumps(about)), "loss": np.empty((0, 0))}
    dataset = sample(env, plane)
    sides = (plane.upper - plane.lower).numpy()
    slope = plane.slope(torch.from_numpy(dataset["grad"].transpose("v", "u", "dim").to_numpy())).numpy() * sides
    axes = {name: dataset[name].to_numpy() for name in ("u", "v")}
    values = {name: dataset[name].transpose("v", "u").to_numpy() for name in ("loss", "status")}
    return env, {"about": np.array(json.dumps(about)), "slope": slope, **axes, **values}


def _slice_of(arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> CardSlice:
    kept = {name: arrays[name] for name in ("u", "v", "loss", "slope", "status")}
    first, second = about["labels"]
    return CardSlice(**kept, labels=(first, second), loss_unit=about["loss_unit"])


def _graded(one: Entrant, about: Mapping[str, Any], resolution: int) -> Grade:
    """Return the grade that an entrant's checks give it."""
    counts = count_outcomes(about["checks"])
    outcome: Outcome = "fails" if counts.keys() & {FAIL, UNEXPECTED} else "passes"
    return _grade(one, outcome, first_finding(about["checks"]), resolution, counts, about["fidelity"])


def _grade(
    one: Entrant,
    outcome: Outcome,
    finding: str,
    resolution: int,
    counts: Mapping[str, int] | None = None,
    fidelity: str = "",
) -> Grade:
    dims = " ".join(f'"{dim}"' if isinstance(dim, str) else str(dim) for dim in one.dims)
    packages = (*OURS, *EXTRAS.get(entries()[one.env].extra, ()))
    return Grade(
        scene=one.scene,
        engine=one.engine,
        env=one.env,
        fidelity=fidelity,
        options=dict(one.options),
        dims=list(map(str, one.dims)),
        versions={package: installed_version(package) or ABSENT for package in packages},
        outcome=outcome,
        finding=finding,
        counts=dict(counts or {}),
        check=f"landscape check {one.env}{one.settings} --points {POINTS}",
        slice=f"landscape slice {one.env} --dims {dims} --resolution {resolution}{one.settings}",
    )
