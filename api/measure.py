"""`gs.report`, `gs.check`, `gs.tradeoff`, `gs.pairs`: what a scene's landscape is like, and what may be asked of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from ..jobs.scene import SceneSpec
from ..jobs.watch import Watch, resumable
from .progress import default_watch
from .scene import SceneKeywords, environment, spec_of

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..jobs.check import CheckReport
    from ..jobs.pairs import PairRanking
    from ..jobs.report import Report, Subject
    from ..landscapes.measures.tradeoff import Tradeoff
    from ..landscapes.slice import Slice

    Scene = str | type[Environment] | Environment | SceneSpec


def report(
    what: Slice | Path | Scene,
    *,
    points: int = 6,
    seed: int = 0,
    out: str | Path | None = None,
    **keywords: Unpack[SceneKeywords],
) -> Report:
    """Say what a landscape is like: minima, flatness, jumps, correlation, gradient quality, and the verdict in words.

    `what` is a slice, a slice's folder, or a scene, of which a slice over its first two parameters is sampled first.
    Gradients are tested by new evaluations at `points` places along each axis; of the `keywords`, those but `device`
    are for a scene alone. The report's files lie in `out`, by default a folder under out/ named after it: the same call
    reads them again.

    Raises ValueError for a slice without gradients or on no disk, for what the scene does not have, and where the
    folder holds something else or another report; Stopped where it is interrupted.
    """
    from ..jobs.report import ReportJob

    watch, command = default_watch(), f"gradscape.report({what!r}, points={points}, seed={seed})"
    subject = _subject(what, points, watch, keywords)
    job = ReportJob.open(
        [subject], what=subject.name, single=True, out=_path(out), points=points, seed=seed,
        device=keywords.get("device", "auto"), command=command,
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
    command = f"gradscape.check({scene!r}, points={points}, seed={seed})"
    return CheckJob.open(spec, points=points, seed=seed, command=command).run(watch)


def tradeoff(
    scene: Scene,
    *,
    points: int = 64,
    seed: int = 0,
    variants: Sequence[str] = (),
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Tradeoff:
    """Measure accuracy against speed: the same points in several variants of a scene, each against the reference.

    `variants` names what is changed beside the scene's fidelities: dt, resolution, particles, precision, stiffness,
    engine, device; by default all that the scene has. The scene's own fidelity does not matter: its last one is the
    reference. The study lies in `out`, by default a folder under out/ named after it: the same call goes on there. What
    is found is also kept for `tolerance`. The record has `front`, `table()` and `plot()`.

    Raises ValueError where the scene has one fidelity only, StoreMismatchError where the folder holds another study,
    which `force` replaces; Stopped where it is interrupted.
    """
    command = f"gradscape.tradeoff({scene!r}, points={points}, seed={seed})"
    how = {"points": points, "seed": seed, "settings": variants, "out": _path(out), "force": force}
    return measure_tradeoff(spec_of(scene, keywords), **how, command=command, watch=default_watch()).tradeoff


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
    command = f"gradscape.pairs({scene!r}, samples={samples}, seed={seed})"
    spec, how = spec_of(scene, keywords), {"samples": samples, "seed": seed, "out": _path(out), "force": force}
    return rank_pairs(spec, **how, command=command, watch=default_watch())[1]


@dataclass(frozen=True)
class TradeoffFiles:
    """Say what a trade-off left: `files` in its `folder`, and a copy `kept` for `tolerance`."""

    tradeoff: Tradeoff
    folder: Path
    files: tuple[str, ...]
    kept: Path


def measure_tradeoff(
    scene: SceneSpec,
    *,
    points: int,
    seed: int,
    settings: Sequence[str],
    out: Path | None,
    force: bool,
    command: str,
    watch: Watch,
    prints: Sequence[float] = (),
) -> TradeoffFiles:
    """Measure a trade-off as `tradeoff` does, and say where it is; what more there is belongs to the command."""
    from ..jobs.tolerance import keep
    from ..jobs.tradeoff import PICTURE, RECORD, TradeoffJob

    job = TradeoffJob.open(
        scene, points=points, seed=seed, settings=settings, out=out, force=force, prints=prints, command=command
    )
    found = job.run(watch)
    printed = job.print(found)
    with resumable(job.kept):
        return TradeoffFiles(found, job.folder, (PICTURE, *printed, RECORD), keep(found))


def rank_pairs(
    scene: SceneSpec,
    *,
    samples: int | None,
    seed: int,
    out: Path | None,
    force: bool,
    command: str,
    watch: Watch,
) -> tuple[Path, PairRanking]:
    """Rank pairs as `pairs` does, and return the folder and the ranking."""
    from ..jobs.pairs import PairsJob

    env, options = scene.make(watch), scene.options
    job = PairsJob.of(env, samples=samples, seed=seed, options=options, out=out, force=force, command=command)
    return job.folder, job.run(watch)


def sample_for_report(env: Environment, points: int, command: str, watch: Watch) -> Subject:
    """Sample the slice that a scene without any is reported on by: its first two parameters, through the centre."""
    from ..jobs.report import RESOLUTION, Subject, refuse_too_many
    from .slice import sample

    dims = list(range(min(2, env.space.dim)))
    refuse_too_many(points, len(dims), env.space.dim)
    found, summary = sample(
        env, dims, resolution=RESOLUTION, through="center", extent=None, grad=True, out=None, force=False,
        command=command, watch=watch,
    )  # fmt: skip
    if found.folder is None:
        raise ValueError("a slice that is to be reported on lies on disk; this one does not")
    watch.note(f"{summary.outcome()}\n{found.folder}: {', '.join(summary.files)}")
    return Subject.of(found.folder)


def _subject(what: Slice | Path | Scene, points: int, watch: Watch, keywords: SceneKeywords) -> Subject:
    from ..jobs.report import Subject
    from ..landscapes.slice import Slice

    if isinstance(what, Slice):
        if what.folder is None:
            raise ValueError("report takes a slice on disk; this one is in memory alone, so use its own report()")
        return Subject.of(what.folder)
    if isinstance(what, Path) or (isinstance(what, str) and Path(what).exists()):
        return Subject.of(Path(what))
    return sample_for_report(environment(what, keywords, watch), points, f"gradscape.report({what!r})", watch)


def _path(out: str | Path | None) -> Path | None:
    return None if out is None else Path(out)
