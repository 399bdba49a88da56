"""A report card of gradients: every engine in every scene is checked and cut along one plane."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..envs.engines import installed_version
from ..envs.registry import EXTRAS, entries, environment_class, installs
from ..landscapes.capacity import require
from ..landscapes.checks.diagnosis import Diagnosis
from ..landscapes.checks.examination import Share
from ..landscapes.checks.suite import POWER
from ..landscapes.convert import from_json, to_json
from ..landscapes.identity import PACKAGE
from ..landscapes.measures.card import Card, CardSlice, ClosedFormError, FailedCheck, Grade
from ..landscapes.storage.arrays import need_of
from ..landscapes.storage.checkpoint import Checkpoint
from ..landscapes.storage.files import replacing
from ..landscapes.storage.records import read_json
from .check import CheckJob
from .folder import CARD, ROOT, folder_named
from .job import CheckpointedJob
from .scene import ABSENT, SceneSpec, plane_through
from .watch import Watch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..envs.base import Environment

LIBRARIES = {"warp": ("warp-lang",), "torch": ("torch",), "newton": ("newton", "warp-lang")}  # by engine
CLOSED_FORM_POINTS = 63  # at random, at which gradients are held against a closed form, and the centre
LARGEST = 400  # parameters, of a chain
PAGE, SLICES = "card.html", "card.npz"
SAMPLED = ("u", "v", "loss", "slope", "status")  # arrays of a slice
SPEEDS = ("velocity x", "velocity y")


@dataclass(frozen=True)
class Entrant:
    """Record the environment that represents an engine in a scene of the card, and the parameters of its slice."""

    scene: str
    engine: str
    env: str
    dims: tuple[int | str, int | str] = SPEEDS
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

    @property
    def packages(self) -> tuple[str, ...]:
        """The packages that its environment is simulated by."""
        extra = entries()[self.env].extra
        engine = "torch" if self.scene == CONTROL else environment_class(self.env).engines[0]
        libraries = LIBRARIES.get(engine, EXTRAS.get(extra, ()))
        return libraries if extra else (PACKAGE, *libraries)


CONTROL = "control"


def _newton(scene: str, env: str, *solvers: str, dims: tuple[str, str] = SPEEDS) -> tuple[Entrant, ...]:
    return tuple(Entrant(scene, f"Newton, {solver}", env, dims, {"solver": solver}) for solver in solvers)


def _ours(scene: str, env: str, dims: tuple[str, str]) -> tuple[Entrant, ...]:
    """Return our scene of a closed form, by the three ways of meeting a touch."""
    said = {"touch": "time of touch", "shift": "places shifted", "step": "whole steps"}
    return tuple(Entrant(scene, f"gradscape, {name}", env, dims, {"contacts": how}) for how, name in said.items())


HEIGHTS, LIFTED = ("position y", "velocity y"), ("position z", "velocity z")
PUSHES = ("push x", "push y")
ENTRANTS = (
    Entrant(CONTROL, "torch, Branin's function", "branin", (0, 1)),  # its gradient is known
    *_newton("flight", "newton-flight", "semi-implicit", "featherstone", "xpbd"),
    *_ours("bounce once", "bounce-once", HEIGHTS),
    Entrant("bounce once", "MJX", "mjx-bounce-once", LIFTED),
    *_newton("bounce once", "newton-bounce-once", "semi-implicit", "xpbd", dims=HEIGHTS),
    *_ours("ground and wall", "ground-wall", SPEEDS),
    Entrant("ground and wall", "MJX", "mjx-ground-wall", ("velocity x", "velocity z")),
    *_newton("ground and wall", "newton-ground-wall", "semi-implicit", "xpbd"),
    *_ours("two balls", "two-balls", PUSHES),
    Entrant("two balls", "MJX", "mjx-two-balls", PUSHES),
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
        packages = dict.fromkeys(package for one in ENTRANTS for package in one.packages)
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
        return f"{self.checkpoint.count()} of {len(self.entrants)} engine checks are kept in {self.folder}"

    def compute(self, watch: Watch) -> Card:
        """Check and cut what is missing, and return the card."""
        grades, slices, device = list[Grade](), dict[int, CardSlice](), self.device
        with watch.progress(len(self.entrants), "engine checks") as advance:
            for number, one in enumerate(self.entrants):
                advance(number, f"{one.scene}: {one.engine}")
                if missing := installs(entries()[one.env]):
                    grades.append(_grade(one, None, self.resolution, missing))
                    continue
                arrays = self._arrays(one)
                about = from_json(Measured, json.loads(str(arrays["about"])))
                device = about.device
                grades.append(_grade(one, about, self.resolution))
                if arrays["loss"].size:
                    slices[number] = _slice_of(arrays, about)
            advance(len(self.entrants))
        created = datetime.now(UTC).strftime("%Y-%m-%d")
        return Card(tuple(grades), created, device, self.command, slices)

    def write(self, found: Card) -> list[str]:
        """Draw and write the card, its page, and the slices, by which the page's panels are drawn elsewhere."""
        from ..landscapes.draw.pages.card import card_page

        with replacing(self.folder / PAGE) as partial:
            partial.write_text(card_page(found), encoding="utf-8")
        save_slices(self.folder / SLICES, found.slices)
        return super().write(found)

    def outcome(self, found: Card) -> str:
        """Say how many engines in scenes have which verdict."""
        return found.tally()

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


@dataclass(frozen=True)
class Measured:
    """What the check of an entrant came to, what its slice is drawn with, and how long the check took [s]."""

    fidelity: str
    device: str
    power: float
    seconds: float
    share: Share | None
    failed: tuple[FailedCheck, ...]
    diagnosis: Diagnosis | None
    closed_form: ClosedFormError | None
    labels: tuple[str, str]
    loss_unit: str


def _measure(one: Entrant, resolution: int, device: str) -> tuple[Environment, dict[str, NDArray[Any]]]:
    """Check an entrant, and sample its slice unless its evaluations are of the wrong form; return both."""
    from ..landscapes.sampling.fill import sample

    began = perf_counter()
    job = CheckJob.open(one.spec(device))
    report, env = job.run(Watch()), job.env
    seconds = perf_counter() - began
    plane = plane_through(env, one.dims, through="center", window=None, resolution=resolution)
    about = Measured(
        fidelity=report.fidelity,
        device=report.device,
        power=report.power,
        seconds=seconds,
        share=report.share,
        failed=tuple(FailedCheck(bad.check, bad.figure, bad.why) for bad in report.findings if bad.bad),
        diagnosis=next(iter(report.diagnoses), None),
        closed_form=_against_closed_form(env),
        labels=(plane.labels[0], plane.labels[1]),
        loss_unit=env.loss_unit,
    )
    kept = {"about": np.array(json.dumps(to_json(about)))}
    if report.findings[0].bad:
        return env, {**kept, "loss": np.empty((0, 0))}
    dataset = sample(env, plane)
    sides = (plane.upper - plane.lower).numpy()
    slope = plane.slope(torch.from_numpy(dataset["grad"].transpose("v", "u", "dim").to_numpy())).numpy() * sides
    axes = {name: dataset[name].to_numpy() for name in ("u", "v")}
    values = {name: dataset[name].transpose("v", "u").to_numpy() for name in ("loss", "status")}
    return env, {**kept, "slope": slope, **axes, **values}


def _against_closed_form(env: Environment) -> ClosedFormError | None:
    x = torch.cat([env.space.center[None], env.space.uniform(CLOSED_FORM_POINTS, seed=0)])
    exact = env.closed_form(x)
    return None if exact is None else ClosedFormError.of(env.evaluate(x), exact)


def _slice_of(arrays: Mapping[str, NDArray[Any]], about: Measured) -> CardSlice:
    kept = {name: arrays[name] for name in SAMPLED}
    return CardSlice(**kept, labels=about.labels, loss_unit=about.loss_unit)


def _grade(one: Entrant, about: Measured | None, resolution: int, missing: str = "") -> Grade:
    """Return the grade of an entrant, by what its check came to; None where it is not installed."""
    dims = " ".join(f'"{dim}"' if isinstance(dim, str) else str(dim) for dim in one.dims)
    return Grade(
        scene=one.scene,
        engine=one.engine,
        env=one.env,
        fidelity=about.fidelity if about else "",
        options=dict(one.options),
        dims=list(map(str, one.dims)),
        versions={package: installed_version(package) or ABSENT for package in one.packages},
        missing=missing,
        power=about.power if about else POWER,
        share=about.share if about else None,
        failed=about.failed if about else (),
        diagnosis=about.diagnosis if about else None,
        closed_form=about.closed_form if about else None,
        seconds=about.seconds if about else 0.0,
        check=f"landscape check {one.env}{one.settings}",
        slice=f"landscape slice {one.env} --dims {dims} --resolution {resolution}{one.settings}",
    )


# ---- The slices of a card in a file beside it.


def save_slices(path: Path, slices: Mapping[int, CardSlice]) -> None:
    """Write slices as arrays by number and name; what they are called is in them too."""
    arrays: dict[str, Any] = {}
    for number, cut in slices.items():
        arrays |= {f"{number} {name}": np.asarray(getattr(cut, name), np.float32) for name in SAMPLED}
        arrays[f"{number} said"] = np.array([*cut.labels, cut.loss_unit])
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_card(record: Path) -> Card:
    """Return a card with its slices, of the folder that holds its record.

    Raises an error of any kind for what is no such record, or no such slices.
    """
    card, slices = from_json(Card, read_json(record)), dict[int, CardSlice]()
    with np.load(record.with_name(SLICES)) as kept:
        for number in sorted({int(name.split()[0]) for name in kept.files}):
            first, second, unit = kept[f"{number} said"].tolist()
            arrays = {name: kept[f"{number} {name}"] for name in SAMPLED}
            slices[number] = CardSlice(**arrays, labels=(first, second), loss_unit=unit)
    return replace(card, slices=slices)
