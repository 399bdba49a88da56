"""What each part of a scene's model is for: every part left out, or put in, at the same points as the full model."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ..landscapes.capacity import Need, require
from ..landscapes.cost import duration, seconds_per_episode
from ..landscapes.plain import digest
from ..landscapes.storage.files import tidy
from ..landscapes.storage.records import write_record
from .folder import MODEL, ROOT, folder_named
from .scene import SceneSpec, provenance
from .studies import going_on
from .watch import PREPARING, Advance, Watch, resumable

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment
    from ..envs.records import ModelPart
    from ..landscapes.measures.fidelity import Sample
    from ..landscapes.measures.model import MeasuredPart, ModelStudy, Noise
    from ..landscapes.measures.turns import Answers, Turns
    from ..landscapes.storage.checkpoint import Checkpoint

COPIES = 50  # of the points: a loss and a gradient there by every variant
REPEATS = 3  # of the full model, which say how noisy it is
FULL, AGAIN = "full", "full-again"  # the pieces of the full model, and of its repeats
RECORD, PICTURE = MODEL.files


@dataclass(frozen=True)
class MeasuredChange:
    """Hold what the model says with a part changed, and its times in turn with the full model."""

    answers: Answers
    turns: Turns


@dataclass(frozen=True)
class ModelJob:
    """The parts of a scene's model to change one at a time, at the points `x`, shape (point, dim).

    `env` is the full model. There is a piece on disk for it, for its repeats and for each part. `refused` gathers the
    parts that cannot be measured, and why. `prints` are widths of pages [mm] that it is also drawn for; `command` is
    how it is made again.
    """

    env: Environment
    x: Tensor
    seed: int
    pieces: Checkpoint
    refused: dict[str, str]
    command: str
    prints: Sequence[float] = ()

    @classmethod
    def open(
        cls,
        scene: SceneSpec,
        *,
        points: int = 64,
        seed: int = 0,
        out: Path | None = None,
        root: Path = ROOT,
        force: bool = False,
        prints: Sequence[float] = (),
        command: str = "",
    ) -> ModelJob:
        """Go on with the study in its folder, by default one named after it under `root`, or begin it there.

        Raises ValueError where the scene names no parts of its model, TooLargeError for more points than there is
        memory for, StoreMismatchError where the folder holds another study.
        """
        from ..landscapes.storage.checkpoint import Checkpoint

        env = scene.make()
        if not env.model_parts:
            raise ValueError(f"{env.name} names no parts of its model; its class lists them as `model_parts`")
        require("points", points, lambda count: Need(8.0 * COPIES * (1 + env.space.dim) * count))
        identity = {**env.identity(), "points": points, "seed": seed}
        folder = out or folder_named(["model", env.name, points], identity, root)
        pieces = Checkpoint.open(folder, identity, what="model study", force=force)
        return cls(env, env.space.sobol(points, seed=seed), seed, pieces, {}, command, prints)

    @property
    def folder(self) -> Path:
        """Where it is kept."""
        return self.pieces.folder

    @property
    def parts(self) -> Sequence[ModelPart]:
        """The parts to measure."""
        return self.env.model_parts

    def run(self, watch: Watch | None = None) -> ModelStudy:
        """Measure what is missing, the full model first; draw, write and return the study.

        Raises RuntimeError and ValueError where the full model cannot be simulated, Stopped where it is interrupted,
        and DiskFullError; the same job goes on from what is kept then.
        """
        from ..landscapes.draw.figures.page import save

        watch = watch or Watch()
        with going_on(self.pieces, lambda: self.env, self.say_kept, watch):
            self._announce(watch)
            found = self._conclude(*self._measure(watch))
            save(found.plot(), self.folder / PICTURE)
            write_record(self.folder / RECORD, found.record())
            tidy(self.folder)
        return found

    def say_kept(self) -> str:
        """Say how much of it is on disk."""
        kept = len(self.parts) - len(self.parts_left())
        return f"{kept} of {len(self.parts)} parts are kept in {self.folder}"

    def parts_left(self) -> list[ModelPart]:
        """Return the parts that are not measured yet."""
        return [part for part in self.parts if self.pieces.load(_piece(part)) is None]

    def estimate(self) -> float:
        """Return the seconds that what is left should take, by an episode of the full model and by the parts' work."""
        from ..landscapes.measures.turns import ENOUGH, LASTING, ROUNDS
        from .variants import expected_work

        self.env.prepare()
        each = seconds_per_episode(self.env, self.x[: self.env.preferred_batch], grad=True)
        seconds = 0.0
        if self.pieces.load(AGAIN) is None:
            seconds += (1 + REPEATS) * len(self.x) * each
        for part in self.parts_left():
            with suppress(ValueError, RuntimeError):  # it is refused when it is its turn
                own = each * expected_work(self._changed(part)) / expected_work(self.env)
                round_ = max(4 / 3 * max(1, self.env.threads) * (each + own), 8 * ENOUGH)  # both, both ways
                seconds += len(self.x) * own + max(LASTING, ROUNDS * round_) + 2 * round_
        return seconds

    @property
    def _rounding(self) -> float:
        return float(torch.finfo(getattr(torch, self.env.fidelity.precision)).eps)

    def _changed(self, part: ModelPart) -> Environment:
        """Make the model with a part changed; raises ValueError where that is the full model, or the scene refuses."""
        env = self.env.remake(**part.options)
        if env.options == self.env.options:
            raise ValueError(f"the full model's options are those of {part.change!r} already")
        return env

    @contextmanager
    def _refusing(self, name: str) -> Iterator[None]:
        """Note of a part that the scene or its engine refuses, and why."""
        try:
            yield
        except (ValueError, RuntimeError) as error:
            self.refused[name] = " ".join(str(error).split())

    def _announce(self, watch: Watch) -> None:
        """Say what is left to measure and about how long that takes."""
        left = self.parts_left()
        kept = f", {len(self.parts) - len(left)} are there already" if len(left) < len(self.parts) else ""
        where = f"{self.env.device} · {self.env.engine} · {self.env.fidelity.name}"
        watch.note(f"{self.env.name} · {where} · {self.folder}")
        watch.note(f"{len(left)} parts of the model to measure at {len(self.x)} points{kept}")
        if not left and self.pieces.load(AGAIN) is not None:
            return
        with watch.busy(f"{self.env.name}: {PREPARING}"):
            seconds = self.estimate()
        watch.note(
            f"about {duration(seconds)}, by the work of an episode; compiling kernels comes on top; --points and a "
            "cheaper --fidelity lower it"
        )

    def _measure(self, watch: Watch) -> tuple[Answers, Answers, dict[str, MeasuredChange]]:
        """Return what the full model says, what it says again, and what it says with each part changed."""
        found: dict[str, MeasuredChange] = {}
        with watch.progress(2 + len(self.parts), "models") as advance:
            advance(0, "full model")
            full = self._answers(FULL, self.x)
            advance(1, "full model again")
            again = self._answers(AGAIN, self._moved())
            self._make_room(self.env)
            for number, part in enumerate(self.parts, start=2):
                advance(number, part.name)
                with self._refusing(part.name):
                    found[part.name] = self._load_or_change(part, advance, number)
            advance(2 + len(self.parts))
        return full, again, found

    def _answers(self, name: str, x: Tensor) -> Answers:
        """Return what the full model says at some points."""
        from ..landscapes.measures.turns import Answers, ask

        if (arrays := self.pieces.load(name)) is None:
            self.env.prepare()
            arrays = vars(ask(self.env, x))
            self.pieces.save(name, **arrays)
        return Answers(**arrays)

    def _moved(self) -> Tensor:
        """Return the points again and again, each moved within its last digit, so that rounding goes other ways."""
        generator, box = torch.Generator().manual_seed(self.seed), self.env.space
        x = self.x.repeat(REPEATS, 1)
        moves = 2 * torch.rand(x.shape, generator=generator, dtype=torch.float64) - 1
        return torch.clamp(x + moves * self._rounding * (box.upper - box.lower), box.lower, box.upper)

    def _make_room(self, env: Environment) -> None:
        """Let an environment take no more rows than are timed: two share a GPU, whose memory a solver takes whole."""
        if env.device == "cuda":
            env.shrink(max(1, min(len(self.x), env.preferred_batch // 2)))

    def _load_or_change(self, part: ModelPart, advance: Advance, number: int) -> MeasuredChange:
        from ..landscapes.measures.turns import Answers, Turns

        if (arrays := self.pieces.load(_piece(part))) is None:
            arrays = self._change(part, lambda done: advance(number, f"{part.name}, {done} of {len(self.x)} points"))
            self.pieces.save(_piece(part), **arrays)
        turns = Turns(arrays.pop("first"), arrays.pop("second"), int(arrays.pop("batch")))
        return MeasuredChange(Answers(**arrays), turns)

    def _change(self, part: ModelPart, follow: Callable[[int], None]) -> dict[str, Any]:
        """Simulate the model with a part changed, once the one before is gone; time it in turn with the full one."""
        from ..landscapes.measures.turns import ask, take_turns
        from ..landscapes.sampling.memory import free_memory

        free_memory()
        env = self._changed(part)
        env.prepare()
        answers = ask(env, self.x, follow=follow)
        self._make_room(env)
        for one in (self.env, env):
            one.prepare()
        return {**vars(answers), **vars(take_turns(self.env, env, self.x))}

    def _conclude(self, full: Answers, again: Answers, changes: dict[str, MeasuredChange]) -> ModelStudy:
        from ..landscapes.measures.fidelity import Seconds, spread
        from ..landscapes.measures.model import ModelStudy, Noise
        from ..landscapes.measures.tradeoff import RefusedVariant
        from ..landscapes.objective import failed

        whole = full.sample()
        noise = Noise.of(again.sample(), full.again(REPEATS).sample(), rounding=self._rounding, seed=self.seed)
        times = [change.turns.first.min(axis=1) for change in changes.values()]
        return ModelStudy(
            env=self.env.name,
            fidelity=self.env.fidelity.name,
            points=len(self.x),
            seed=self.seed,
            loss_unit=self.env.loss_unit,
            spread=spread(whole),
            failed=int(failed(full.status).sum()),
            seconds=Seconds(*(min((float(one[way]) for one in times), default=0.0) for way in (0, 1))),
            noise=noise,
            parts=tuple(self._judge(p, changes[p.name], whole, noise) for p in self.parts if p.name in changes),
            refused=tuple(RefusedVariant(name, why) for name, why in self.refused.items()),
            identity=self.env.identity(),
            provenance=provenance(self.env, self.command),
            command=self.command,
        )

    def _judge(self, part: ModelPart, change: MeasuredChange, full: Sample, noise: Noise) -> MeasuredPart:
        from ..landscapes.measures.fidelity import compare
        from ..landscapes.measures.model import MeasuredPart, judge_effect, judge_price, share_moved

        sample = change.answers.sample(change.turns)
        found, moved = compare(sample, full, seed=self.seed), share_moved(sample, full, noise)
        forward, cost = (change.turns.ratio(grad=grad, seed=self.seed) for grad in (False, True))
        return MeasuredPart(
            name=part.name,
            change=part.change,
            options=dict(part.options),
            missing=part.missing,
            comparison=found,
            moved=moved,
            cost=cost,
            cost_forward=forward,
            effect=judge_effect(found, noise, moved),
            price=judge_price(cost),
        )

    def print(self, found: ModelStudy) -> list[str]:
        """Draw it for pages, too, and return the names of the files. Raises DiskFullError."""
        from ..landscapes.draw.figures.page import save_prints

        with resumable(self.say_kept):
            return save_prints(lambda width: found.plot(width), self.folder / PICTURE, self.prints)


def _piece(part: ModelPart) -> str:
    """Return the name of a part's piece: another change of the same part is another piece."""
    slug = re.sub(r"[^a-z0-9]+", "-", part.name.lower()).strip("-")
    return f"part-{slug}-{digest(dict(part.options))}"
