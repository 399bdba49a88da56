"""`gs.report`: measures of a landscape, with a verdict in words and the paper's words."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from cyclopts import Parameter

from .call import current, verb
from .options import ARGUMENT, Data, FigureWidth, Names, Of, Out, Scene, SceneKeywords, Seed, at_least
from .scene import environment, spec_of
from .values import as_names, as_path, as_widths

if TYPE_CHECKING:
    from ..jobs.report import Report, ReportedSlice, Reports


@verb
def report(
    what: Annotated[Any, ARGUMENT] = None,
    *,
    env: Of = None,
    all: Annotated[bool, Parameter(name="--all")] = False,
    points_per_axis: Annotated[int, at_least(2)] = 6,
    features: bool = False,
    html: bool = False,
    include: Names = (),
    seed: Seed = 0,
    data: Data = None,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    **keywords: Unpack[SceneKeywords],
) -> Report | Reports:
    """Measure one landscape: minima, flatness, jumps, correlation and gradient quality, with a verdict in words.

    The folder then contains report.json, measures.json, gradient-quality.png and gradient-quality.npz (the data of the
    picture). With --html it also contains report.html. For several slices it contains a folder for each, and
    report.json and the table report.md for all. Stop at any time: the same command continues with the next slice. With
    --all it lists failed slices at the end, and the exit code is then 1. docs/measures.md explains each number.

    Raises ValueError if the slice has no gradients or is not on disk, if the environment does not support a keyword, or
    if the folder contains something else or another report. Raises Stopped when it is interrupted.

    Example: landscape report out/fluid-6-8-draft-24x24-4e5ab2

    Parameters
    ----------
    what
        Folder of a slice, the slice itself, or an environment. For an environment it takes the sampled figures of the
        gallery, or else samples a slice.
    all
        Report on every figure of the gallery that is sampled.
    points_per_axis
        Number of points along each axis at which new evaluations test gradients.
    features
        Also measure landscape features over all parameters, from 50 new points per parameter. They are added to an
        existing report.
    html
        Also write report.html, one page with all results, which opens without a network.
    include
        Folder of a run, a race or a check that the page also shows. It can be repeated.
    """
    _refuse_words(what, all, keywords, env)
    from ..gallery.files import data_folder
    from ..gallery.paper import read_paper
    from ..jobs.folder import REPORT, REPORTS
    from ..jobs.report import ReportJob

    call, root = current(), data_folder(data)
    subjects, env = (
        (_figures(root), env) if what is None else _subjects(what, root, env, points_per_axis, features, keywords)
    )
    single = what is not None and len(subjects) == 1
    name = subjects[0].name if single else Path(str(what or "all")).name
    job = ReportJob.open(
        subjects, what=name, single=single, out=as_path(out), points=points_per_axis, seed=seed,
        device=keywords.get("device", "auto"), prints=as_widths(figure_width_mm), paper=read_paper().words,
        command=call.command, env=env, features=features, html=html, include=as_names(include),
    )  # fmt: skip
    found = job.run(call.watch)
    if single:
        call.watch.finish(job.folder, [one for one in REPORT.files if (job.folder / one).exists()])
        return found.reports[0]
    for failed, why in found.failed.items():
        call.watch.note(f"not reported: {failed}: {why}")
    call.watch.finish(job.folder, [*REPORTS.files, "and a folder for each slice"])
    return found


def _refuse_words(what: Any, everything: bool, keywords: SceneKeywords, env: Scene) -> None:
    """Raise ValueError unless exactly one subject is given, and if its environment does not exist."""
    from ..envs.registry import refuse_unknown

    if (what is None) != everything:
        raise ValueError("report takes a slice's folder, an environment, or --all for every figure of the gallery")
    if isinstance(what, str) and not Path(what).exists():
        spec_of(what, keywords)
    elif (isinstance(what, str | Path) or what is None) and (more := set(keywords) - {"device"}):
        raise ValueError(
            f"report takes {', '.join(sorted(more))} only for an environment to sample; leave them out for a slice"
        )
    if isinstance(env, str):
        refuse_unknown(env)


def _figures(root: Path) -> list[ReportedSlice]:
    """Return the gallery's slices that are sampled. Raises ValueError where none is."""
    from ..gallery.figures import read_figures
    from ..jobs.report import ReportedSlice

    there = [ReportedSlice.of(root / figure.id) for figure in read_figures() if _is_finished(root / figure.id)]
    if not there:
        raise ValueError(f"{root} contains no figures yet; `landscape gallery compute` samples them")
    return there


def _subjects(
    what: Any, root: Path, env: Scene, points: int, features: bool, keywords: SceneKeywords
) -> tuple[list[ReportedSlice], Scene]:
    """Return a slice, an environment's figures, or a slice sampled now if it has no figures; and its simulator."""
    from ..gallery.figures import read_figures
    from ..jobs.report import ReportedSlice, sample_subject
    from ..landscapes.slice import Slice

    if isinstance(what, Slice):
        if what.folder is None:
            raise ValueError("report takes a slice on disk; this one is only in memory, so call its method report()")
        return [ReportedSlice.of(what.folder)], env or (what.remake() if what.remake else None)
    if isinstance(what, Path) or (isinstance(what, str) and Path(what).exists()):
        return [ReportedSlice.of(Path(what))], env
    call = current()
    if call.on_disk and keywords.keys() <= {"fidelity", "device"}:
        fidelity = keywords.get("fidelity")
        figures = [one for one in read_figures() if one.env == what and fidelity in (None, one.fidelity)]
        if found := [ReportedSlice.of(root / one.id) for one in figures if _is_finished(root / one.id)]:
            return found, env
    made = environment(what, keywords)
    return [sample_subject(made, points, call.command, call.watch, features=features)], made


def _is_finished(folder: Path) -> bool:
    from ..jobs.folder import SLICE_STORE
    from ..landscapes.storage.paths import is_finished, is_slice
    from ..landscapes.storage.store import SliceStore

    store = folder / SLICE_STORE
    return is_finished(store) and is_slice(store) and not SliceStore.open(store).pending()
