"""The league of the gallery: a race of nine methods in every scene, stored compactly, and slices of the searches.

For every run it keeps the episodes that lowered the best loss, the cost up to each of them, and the best point in full.
For the median run of each method, by final loss, it also keeps the points of these episodes, each parameter as one of
65 536 values in its range, which is finer than any picture. It keeps no gradients.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..envs.base import cores
from ..jobs.folder import SUMMARY
from ..jobs.league import LeagueJob, LeagueScene
from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch
from ..landscapes.convert import from_json, to_json
from ..landscapes.identity import MODEL_VERSION
from ..landscapes.objective import Status
from ..landscapes.overlay import IMPROVEMENTS_OF, lowered, overlay
from ..landscapes.storage.arrays import flags
from ..landscapes.storage.files import make_folder, replacing
from ..landscapes.storage.paths import is_finished
from ..landscapes.storage.records import read_json, reading, write_record
from ..optim.base import Kind
from ..optim.league import League, SceneStandings
from ..optim.race import Race
from ..optim.runs.run import Run
from ..optim.statistics import best_so_far
from .figures import read_figures
from .files import LEAGUE, PICTURE, REMAKE, STORE, LeagueFiles, dark_name
from .parts import FigurePart, kept_key
from .records import read_if_sound

if TYPE_CHECKING:
    from ..landscapes.draw.figures.page import Picture

METHODS = (
    *("random", "cma-es", "descents", "bo-descents", "bo-leap"),  # the paper's
    *("l-bfgs-b", "adam", "cma-es-gradient", "turbo"),
)
BUDGET, SEEDS = 1000, 10  # the paper's
PLACES = 65_535  # of a parameter in its box, less one
RESOLUTION = 48  # points along each axis of a slice through a best point
ABOUT_MEDIANS = ("env", "method", "seed", "budget", "fidelity", "loss_unit", "identity", "provenance", IMPROVEMENTS_OF)


class LeaguePart(FigurePart):
    """The race in the figure's environment with its default options; all figures of the environment share it.

    Its runs stay in the folder of `landscape league` on this device, under out/. Either command continues the other.
    """

    of_environment = True

    def label(self) -> str:
        """Return the command that runs the race elsewhere."""
        how = f"--methods {','.join(METHODS)} --budget {BUDGET} --seeds {SEEDS} --device {self.device}"
        return f"landscape league {LeagueScene.of(self._own_scene, self.root)} {how}"

    def count_left(self) -> int:
        """Return 1 if no race of these methods, seeds and episodes at this fidelity is stored, else 0."""
        files = self._files
        kept = read_if_sound(read_standings, files.record)
        there = files.there() and files.dark.is_file()
        if kept is None or read_if_sound(KeptRuns.read, files.runs) is None or not there:
            return 1
        known = {*kept.methods, *kept.left_out}
        whole = known >= set(METHODS) and kept.budget >= BUDGET and kept.seeds >= SEEDS
        return int(not whole or kept.fidelity != self._job.scenes[0].fidelity)

    def seconds_each(self) -> float:
        """Estimate the remaining simulation time of the race, without the time of the methods themselves."""
        job = self._job
        return job.forecast(job.scenes[0], Watch())

    def make(self, watch: Watch) -> str:
        """Run or continue the race, and store the reduced runs."""
        job, files = self._job, self._files
        race, left_out = job.run_race(job.scenes[0], watch)
        found = SceneStandings.of(race, left_out=left_out, command=self.label())
        make_folder(files.record.parent)
        files.record.unlink(missing_ok=True)  # which says that the others are whole
        keep_both(race.plot(), files.picture)
        KeptRuns.of(race).write(files.runs)
        write_record(files.record, to_json(found))
        return f"{len(found.methods)} methods, {found.seeds} seeds: {found.describe_lead()}"

    @property
    def _files(self) -> LeagueFiles:
        return LeagueFiles.of(self.root, self.figure.env)

    @property
    def _job(self) -> LeagueJob:
        return LeagueJob.of(
            [self._own_scene],
            METHODS,
            budget=BUDGET,
            seeds=SEEDS,
            command=self.label(),
            workers=cores(),
            executor=self.executor,
        )

    @property
    def _own_scene(self) -> SceneSpec:
        """The figure's scene with its default options."""
        return replace(self.scene(), options={})


class LeagueSlicePart(FigurePart):
    """Losses around the best point of the league in the figure's environment, and median runs over them.

    The runs are drawn by their improvements. Losses are at the fidelity of the league, along the dims of the first
    plane among the environment's figures, which share the slice. Without a stored league there is none.
    """

    of_environment = True

    def label(self) -> str:
        """Return the command that samples the slice."""
        standings = self._standings()
        fidelity = standings.fidelity if standings else self.figure.fidelity
        dims = " ".join(map(str, self._dims))
        how = f"--resolution {RESOLUTION} --fidelity {fidelity} --through best --no-gradients --device {self.device}"
        return f"landscape slice {self.figure.env} --dims {dims} {how}"

    def count_left(self) -> int:
        """Return the number of episodes if the slice through the stored best point is missing, else 0."""
        standings, files = self._standings(), self._files.slice
        if standings is None or standings.best is None:
            return 0
        there = files.there() and files.dark.is_file() and is_finished(files.record.parent)
        return 0 if there and kept_key(files.record) == self._key(standings) else RESOLUTION**2

    def make(self, watch: Watch) -> str:
        """Sample the slice and draw it with the median runs."""
        import torch

        from ..jobs.slice import SliceJob
        from ..landscapes.draw.figures.overlay import overlay_figure
        from ..landscapes.plane import Plane
        from ..landscapes.storage.store import open_slice

        standings, files = self._standings(), self._files.slice
        assert standings is not None  # or nothing is left to make
        assert standings.best is not None
        env = SceneSpec(self.figure.env, standings.fidelity, device=self.device).make()
        best = torch.tensor(standings.best.x, dtype=torch.float64)
        plane = Plane.through(env.space, best, self._dims, resolution=RESOLUTION)
        folder = files.record.parent
        files.record.unlink(missing_ok=True)  # which says that the others are whole
        job = SliceJob.of(env, plane, gradients=0, command=self.label(), out=folder, force=True, executor=self.executor)
        outcome = job.run(watch)
        for left in (PICTURE, SUMMARY):  # the map is drawn with the runs, and its page says the rest
            (folder / left).unlink()
        runs = list(KeptRuns.read(self._files.runs).medians.values())
        dataset = open_slice(folder / STORE)
        keep_both(overlay_figure(dataset, overlay(dataset, runs)), files.picture)
        write_record(files.record, {"key": self._key(standings), "command": self.label(), "device": env.device})
        return outcome.outcome()

    @property
    def _files(self) -> LeagueFiles:
        return LeagueFiles.of(self.root, self.figure.env)

    @property
    def _dims(self) -> tuple[int, ...]:
        """Return the dims of the environment's first plane; an environment can have lines only."""
        planes = [one.dims for one in read_figures() if one.env == self.figure.env and len(one.dims) == 2]
        return planes[0] if planes else (0, 1)

    def _key(self, standings: SceneStandings) -> dict[str, Any]:
        """Return the key that decides the slice and its picture."""
        assert standings.best is not None
        about = {MODEL_VERSION: standings.identity[MODEL_VERSION], "fidelity": standings.fidelity}
        about |= {"methods": list(standings.methods), "best": list(standings.best.x)}
        return about | {"dims": list(self._dims), "resolution": RESOLUTION}

    def _standings(self) -> SceneStandings | None:
        return read_if_sound(read_standings, self._files.record)


@dataclass(frozen=True, eq=False)
class KeptRun:
    """A reduced run: improvements, shapes (improvement,), the whole cost, and the best point, shape (dim,).

    `episode` counts from 1 and `forwards` in forward equivalents; `loss` falls down to the final loss of
    the run. A run without success has no improvement, and its best point is NaN.
    """

    method: str
    seed: int
    episode: NDArray[np.int64]
    forwards: NDArray[np.float64]
    loss: NDArray[np.float64]
    episodes: int
    spent: float
    best: NDArray[np.float64]

    @classmethod
    def of(cls, run: Run, budget: int) -> KeptRun:
        """Reduce the first `budget` episodes of a run."""
        data = run.data.isel(evaluation=slice(budget))
        loss, x = data["loss"].to_numpy(), data["x"].to_numpy()
        rows = lowered(best_so_far(loss))
        spent = data["forwards"].to_numpy()
        last = x[rows[-1]] if len(rows) else np.full(x.shape[1], np.nan)
        return cls(run.method, run.seed, rows + 1, spent[rows], loss[rows], len(loss), float(spent[-1]), last)


@dataclass(frozen=True, eq=False)
class MedianRun:
    """The improvements of a method's median run: quantised points, losses, kinds, and episode numbers.

    Shapes are (improvement, dim) and (improvement,). `about` holds the attributes of its table as JSON.
    """

    places: NDArray[np.uint16]
    losses: NDArray[np.float32]
    kind: NDArray[np.int8]
    episode: NDArray[np.int64]
    about: str

    @classmethod
    def of(cls, members: Sequence[Run], budget: int) -> MedianRun:
        """Return the improvements of the run with the median final loss, or of the better of the two middle ones."""
        final = np.array([best_so_far(run.data["loss"].to_numpy()[:budget])[-1] for run in members])
        order = np.argsort(np.where(np.isfinite(final), final, np.inf), kind="stable")
        whole = members[order[(len(members) - 1) // 2]].data.isel(evaluation=slice(budget))
        rows = lowered(best_so_far(whole["loss"].to_numpy()))
        data = whole.isel(evaluation=rows).assign_attrs({IMPROVEMENTS_OF: whole.sizes["evaluation"]})
        lower, upper = (np.asarray(data.attrs[side], float) for side in ("lower", "upper"))
        share = np.clip((data["x"].to_numpy() - lower) / (upper - lower), 0, 1)
        about = {name: data.attrs[name] for name in ABOUT_MEDIANS}
        names = {name: [str(one) for one in data[name].to_numpy()] for name in ("dim", "unit")}
        about |= {"lower": lower.tolist(), "upper": upper.tolist(), "names": names}
        places, losses = np.round(share * PLACES).astype(np.uint16), data["loss"].to_numpy().astype(np.float32)
        return cls(places, losses, data["kind"].to_numpy(), rows + 1, json.dumps(about))

    def table(self) -> xr.Dataset:
        """Return the columns of a run, without seconds and with NaN gradients."""
        about = json.loads(str(self.about))
        lower, upper = np.array(about["lower"]), np.array(about["upper"])
        x = lower + self.places / PLACES * (upper - lower)
        columns = {
            "x": (("evaluation", "dim"), x),
            "grad": (("evaluation", "dim"), np.full_like(x, np.nan)),
            "loss": ("evaluation", self.losses.astype(float)),
            "kind": ("evaluation", self.kind.astype(np.int8), flags(Kind)),
            "status": ("evaluation", np.full(len(self.losses), Status.OK, np.int8), flags(Status)),
            "episodes": ("evaluation", self.episode),
        }
        coords = {name: ("dim", values) for name, values in about.pop("names").items()}
        return xr.Dataset(columns, coords, about)


EACH = ("method", "seed", "episodes", "spent", "best")  # arrays of a number, or a point, for each run
JOINED = ("episode", "forwards", "loss")  # arrays of improvements, those of one run after those of the other


@dataclass(frozen=True, eq=False)
class KeptRuns:
    """A reduced race: the improvements of every run, and the median run of each method."""

    runs: Sequence[KeptRun]
    packed: Mapping[str, MedianRun]

    @classmethod
    def of(cls, race: Race) -> KeptRuns:
        """Reduce a race."""
        runs = [KeptRun.of(run, race.budget) for members in race.runs.values() for run in members]
        return cls(runs, {method: MedianRun.of(members, race.budget) for method, members in race.runs.items()})

    @property
    def medians(self) -> dict[str, xr.Dataset]:
        """The tables of the median runs, by method."""
        return {method: run.table() for method, run in self.packed.items()}

    def write(self, path: Path) -> None:
        """Write the runs as one file, whole or not at all."""
        arrays: dict[str, Any] = {name: np.array([getattr(one, name) for one in self.runs]) for name in EACH}
        arrays["count"] = np.array([len(one.loss) for one in self.runs])
        arrays |= {name: np.concatenate([getattr(one, name) for one in self.runs]) for name in JOINED}
        for method, run in self.packed.items():
            arrays |= {f"{one.name} {method}": np.array(getattr(run, one.name)) for one in fields(run)}
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def read(cls, path: Path) -> KeptRuns:
        """Read a file of `write`. Raises ValueError, naming the file, if it is damaged."""
        with reading(path, REMAKE.format("league")), np.load(path, allow_pickle=False) as found:
            arrays = dict(found)
            ends = np.cumsum(arrays["count"])
            if any(len(arrays[name]) != ends[-1] for name in JOINED):
                raise ValueError("the number of improvements does not match its runs")
            parts = {name: np.split(arrays[name], ends[:-1]) for name in JOINED}
            each = {name: arrays[name] if name == "best" else arrays[name].tolist() for name in EACH}
            runs = [KeptRun(**{name: one[row] for name, one in (each | parts).items()}) for row in range(len(ends))]
            packed = {
                method: MedianRun(**{one.name: arrays[f"{one.name} {method}"] for one in fields(MedianRun)})
                for method in dict.fromkeys(each["method"])
            }
            for run in packed.values():
                run.table()  # fails where it is damaged
            return cls(runs, packed)


def read_standings(path: Path) -> SceneStandings:
    """Read the stored standings of a scene. Raises ValueError, naming the file, if it is damaged."""
    with reading(path, REMAKE.format("league")):
        return from_json(SceneStandings, read_json(path))


def read_league(root: Path) -> League | None:
    """Return the league of the scenes stored in the gallery's data, or None if there are none.

    Raises ValueError, naming the file, if one is damaged.
    """
    scenes = [read_standings(path) for path in sorted((root / LEAGUE).glob("*.json"))]
    return League(scenes, {}, "landscape gallery compute --part league") if scenes else None


def keep_both(picture: Picture, path: Path) -> None:
    """Write the pictures of `save_both` in fewer bytes, because they go into the repository."""
    from ..landscapes.draw.film import lighten

    save_both(picture, path)
    for file in (path, path.with_name(dark_name(path.name))):
        lighten(file)


def save_both(picture: Picture, path: Path) -> None:
    """Write a picture, and next to it its variant for dark pages."""
    from ..landscapes.draw.figures.dark import darken
    from ..landscapes.draw.figures.page import save

    save(picture, path)
    darken(picture)
    save(picture, path.with_name(dark_name(path.name)))
