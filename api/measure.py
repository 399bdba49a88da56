"""`gs.report`, `gs.check`, `gs.card`, `gs.extremes`, `gs.pairs`: what a landscape is like, and what a scene allows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

from ..jobs.watch import Watch
from .progress import default_watch
from .scene import Scene, SceneKeywords, environment, say_call, spec_of

if TYPE_CHECKING:
    from ..jobs.check import CheckReport
    from ..jobs.pairs import PairRanking
    from ..jobs.report import ReportedSlice
    from ..jobs.report_record import Report
    from ..landscapes.measures.card import Card
    from ..landscapes.measures.census_record import Census
    from ..landscapes.measures.extremes import Extremes
    from ..landscapes.slice import Slice


def report(
    what: Slice | Path | Scene,
    *,
    points: int = 6,
    seed: int = 0,
    env: Scene = None,
    out: str | Path | None = None,
    **keywords: Unpack[SceneKeywords],
) -> Report:
    """Say what a landscape is like: minima, flatness, jumps, correlation, gradient quality, and the verdict in words.

    `what` is a slice, a slice's folder, or a scene, of which a slice over its first two parameters is sampled first.
    Gradients are tested by new evaluations at `points` places along each axis; of the `keywords`, those but `device`
    are for a scene alone; `env` is the simulator of a slice, where it is not registered by its name. The report's files
    lie in `out`, by default a folder under out/ named after it: the same call reads them again.

    Raises ValueError for a slice without gradients or on no disk, for what the scene does not have, and where the
    folder holds something else or another report; Stopped where it is interrupted.
    """
    from ..jobs.report import ReportJob

    watch, command = default_watch(), say_call("report", what, points=points, seed=seed, **keywords)
    subject, env = _subject(what, env, points, watch, keywords)
    job = ReportJob.open(
        [subject], what=subject.name, single=True, out=_path(out), points=points, seed=seed,
        device=keywords.get("device", "auto"), env=env, command=command,
    )  # fmt: skip
    return job.run(watch).reports[0]


def check(scene: Scene, *, points: int = 4, seed: int = 0, **keywords: Unpack[SceneKeywords]) -> CheckReport:
    """Check that an environment keeps what every environment promises, and that it answers at the extremes.

    Checks are made at `points` random points of its box, two or more. The record says whether it `passed`, its
    `findings` one by one, and shows them as a `table()`.

    Raises ValueError for what the scene does not have, TooLargeError for more points than there is memory for, and
    Stopped where it is interrupted.
    """
    from ..jobs.check import CheckJob

    watch = default_watch()
    spec = spec_of(scene, keywords).resolve(watch)
    command = say_call("check", scene, points=points, seed=seed, **keywords)
    return CheckJob.open(spec, points=points, seed=seed, command=command).run(watch)


def card(
    scenes: Sequence[str] = (),
    *,
    resolution: int = 17,
    device: str = "auto",
    out: str | Path | None = None,
    force: bool = False,
) -> Card:
    """Check the gradients of several engines in the same scenes, and cut their landscapes along one small plane.

    `scenes` are those of the card ("flight", "drop", "bounce" ...), by default all; an engine that is not
    installed is said to be that. The card lies in the folder `out`, by default one under out/: the same call goes on
    there. It has `grades`, a `table()` and `plot()`.

    Raises ValueError for a scene that the card does not have, StoreMismatchError where the folder holds a card of other
    versions, which `force` replaces; Stopped where it is interrupted.
    """
    from ..jobs.card import CardJob

    how = {"resolution": resolution, "device": device}
    command = say_call("card", list(scenes), **how)
    return CardJob.open(scenes, **how, out=_path(out), force=force, command=command).run(default_watch())  # type: ignore[arg-type] # each of its kind


def extremes(
    scene: Scene,
    *,
    points: int = 16,
    seed: int = 0,
    knobs: Sequence[str] = (),
    pairs: Sequence[str] | None = None,
    precisions: Sequence[str] = (),
    grid: int = 8,
    width: float = 0.05,
    accuracy: float = 0.1,
    against: str | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Extremes:
    """Find how far a scene's knobs can be turned before it fails: step, grid, stiffness, controls, length.

    `knobs` are dt, resolution, box, horizon and options that are numbers above 0; `pairs` of them ("dt:ke") are mapped
    on a `grid`. Limits are bisected to a relative `width`. Corners of the box and Sobol points decide, `points` in all;
    finite losses are right where those of the fidelity `against`, by default the last, are within `accuracy` of their
    spread. The fidelity is standard unless another is given. The study lies in `out`, by default a folder under out/
    named after it: the same call goes on there. The record has `limits`, `maps`, `table()` and `plot()`.

    Raises ValueError for what the scene does not have, StoreMismatchError where the folder holds another study, which
    `force` replaces; Stopped where it is interrupted.
    """
    from ..jobs.extremes import ExtremesJob
    from ..jobs.margins import keep

    how = {"points": points, "seed": seed, "knobs": knobs, "pairs": pairs, "precisions": precisions, "grid": grid}
    how |= {"width": width, "accuracy": accuracy}
    command = say_call("extremes", scene, **how, against=against, **keywords)
    spec = spec_of(scene, keywords)
    job = ExtremesJob.open(spec, **how, reference=against, out=_path(out), force=force, command=command)  # type: ignore[arg-type] # each of its kind
    found = job.run(default_watch())
    keep(found)
    return found


def pairs(
    scene: Scene,
    *,
    samples: int | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> PairRanking:
    """Rank pairs of parameters by sensitivity, ruggedness and misleading gradients: which slices to look at.

    `samples` base points are taken, each of 1 + 5 x dim + 28 episodes (fewer below 8 parameters). The study lies in
    `out`, by default a folder under out/ named after it: the same call goes on there.

    Raises ValueError where the scene has one parameter, StoreMismatchError where the folder holds another study, which
    `force` replaces; Stopped where it is interrupted.
    """
    from ..jobs.pairs import PairsJob

    watch, spec = default_watch(), spec_of(scene, keywords)
    command = say_call("pairs", scene, samples=samples, seed=seed, **keywords)
    job = PairsJob.open(spec.resolve(watch), samples=samples, seed=seed, out=_path(out), force=force, command=command)
    return job.run(watch)


def census(
    scene: Scene,
    *,
    slices: int = 64,
    resolution: int = 24,
    gradients: int = 1,
    along: Literal["pairs", "random"] = "pairs",
    also: str | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Census:
    """Sample many slices through random points along random cuts, measure each, and say what they have in common.

    Slices are of every one of some random base points along every one of as many cuts: `along` pairs of parameters or
    random directions, with `resolution` points per axis, of which every so many have `gradients`, too. One slice of
    each base point is measured at the fidelity `also`, too. The census lies in `out`, by default a folder under out/
    named after it: the same call goes on there.

    Raises ValueError where the scene has one parameter, StoreMismatchError where the folder holds another census, which
    `force` replaces; Stopped where it is interrupted.
    """
    from ..jobs.census import CensusJob

    watch, spec = default_watch(), spec_of(scene, keywords)
    how: dict[str, Any] = {"slices": slices, "resolution": resolution, "gradients": gradients, "along": along}
    how |= {"also": also, "seed": seed}
    command = say_call("census", scene, **how, **keywords)
    return CensusJob.open(spec.resolve(watch), **how, out=_path(out), force=force, command=command).run(watch)


def _subject(
    what: Slice | Path | Scene, env: Scene, points: int, watch: Watch, keywords: SceneKeywords
) -> tuple[ReportedSlice, Scene]:
    """Return the slice to report on, which is sampled now where a simulator is given, and its simulator if known."""
    from ..jobs.report import ReportedSlice, sample_subject
    from ..landscapes.slice import Slice

    if isinstance(what, Slice):
        if what.folder is None:
            raise ValueError("report takes a slice on disk; this one is in memory alone, so use its own report()")
        return ReportedSlice.of(what.folder), env or (what.remake() if what.remake else None)
    if isinstance(what, Path) or (isinstance(what, str) and Path(what).exists()):
        return ReportedSlice.of(Path(what)), env
    env = environment(what, keywords, watch)
    return sample_subject(env, points, say_call("report", what, **keywords), watch), env


def _path(out: str | Path | None) -> Path | None:
    return None if out is None else Path(out)
