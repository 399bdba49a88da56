"""`landscape report`: what landscapes are like, in numbers and in words, beside the paper's."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .arguments import Data, Device, Fidelity, Json, Of, Print, Seed

if TYPE_CHECKING:
    from ..jobs.report import ReportedSlice
    from ..jobs.report_record import Report, Reports
    from .terminal import Bars


def report_(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="[SLICE|ENV]",
            help="Folder of a slice, or an environment: its figures of the gallery, else a slice that is "
            "sampled for it.",
        ),
    ] = None,
    env: Of = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Report on every figure of the gallery that is sampled.")
    ] = False,
    fidelity: Fidelity = None,
    device: Device = "auto",
    points: Annotated[
        int, typer.Option(min=2, help="Number of points along each axis at which new evaluations test gradients.")
    ] = 6,
    seed: Seed = 0,
    data: Data = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results. The default is named after the report, under out/.")
    ] = None,
    print_: Print = None,
    json_: Json = False,
) -> None:
    """Measure one landscape: minima, flatness, jumps, correlation and gradient quality, with a verdict in words.

    The folder then holds report.json, measures.json, gradient-quality.png and gradient-quality.npz (the data of the
    picture). Several slices have a folder each, beside report.json and the table report.md. Stop at any time: the same
    command goes on with the next slice. With --all a slice that fails is named at the end, and the exit code is 1.
    docs/measures.md explains each number.

    Example: landscape report out/fluid-6-8-draft-24x24-4e5ab2
    """
    _refuse_words(what, everything, fidelity, device, env)
    from ..gallery.files import data_folder
    from ..gallery.paper import read_paper
    from ..jobs.report import ReportJob
    from .terminal import Bars, command_line

    bars, root = Bars(), data_folder(data)
    subjects = _figures(root) if what is None else _subjects(what, root, fidelity, device, points, bars)
    single = what is not None and len(subjects) == 1
    how: dict[str, Any] = {"points": points, "seed": seed, "out": Path(out) if out else None, "device": device}
    how |= {"prints": print_ or [], "paper": read_paper().words, "command": command_line(), "env": env}
    job = ReportJob.open(subjects, what=Path(what or "all").name, single=single, **how)
    found = job.run(bars)
    if single:
        _show(found.reports[0], job.folder, as_json=json_)
    else:
        _show_several(found, job.folder, bars, as_json=json_)


def _refuse_words(what: str | None, everything: bool, fidelity: str | None, device: str, env: str | None) -> None:
    """Raise ValueError unless it is said what to report on, once, and for an environment that there is not."""
    from ..envs.registry import refuse_unknown

    if (what is None) != everything:
        raise ValueError("report takes a slice's folder, an environment, or --all for every figure of the gallery")
    if what is not None and not Path(what).exists():
        refuse_unknown(what, fidelity=fidelity, device=device)
    if env is not None:
        refuse_unknown(env)


def _figures(root: Path) -> list[ReportedSlice]:
    """Return the gallery's slices that are sampled. Raises ValueError where none is."""
    from ..gallery.figures import read_figures
    from ..jobs.report import ReportedSlice

    there = [ReportedSlice.of(root / figure.id) for figure in read_figures() if _is_finished(root / figure.id)]
    if not there:
        raise ValueError(f"{root} holds no figures yet; `landscape gallery compute` samples them")
    return there


def _subjects(what: str, root: Path, fidelity: str | None, device: str, points: int, bars: Bars) -> list[ReportedSlice]:
    """Return a slice, or an environment's figures, or a slice sampled now for want of any."""
    from ..envs.registry import make
    from ..gallery.figures import read_figures
    from ..jobs.report import ReportedSlice, sample_subject
    from .terminal import command_line

    if Path(what).exists():
        return [ReportedSlice.of(Path(what))]
    figures = [figure for figure in read_figures() if figure.env == what and fidelity in (None, figure.fidelity)]
    if found := [ReportedSlice.of(root / figure.id) for figure in figures if _is_finished(root / figure.id)]:
        return found
    return [sample_subject(make(what, fidelity=fidelity, device=device), points, command_line(), bars)]


def _is_finished(folder: Path) -> bool:
    from ..jobs.folder import SLICE_STORE
    from ..landscapes.storage.paths import is_slice
    from ..landscapes.storage.store import SliceStore

    return is_slice(folder / SLICE_STORE) and not SliceStore.open(folder / SLICE_STORE).pending()


def _show(report: Report, folder: Path, *, as_json: bool) -> None:
    """Print one slice's measures and verdict."""
    from .terminal import Console, print_json, table

    if as_json:
        print_json(report.record(), folder=str(folder))
        return
    console = Console(highlight=False)
    found = table("measure", "value, 95 % interval", title=f"{report.name} ({report.env})")
    for name, text in report.measures.items():
        found.add_row(name, text)
    console.print(found)
    for line in report.verdict_lines():
        console.print(line)


def _show_several(found: Reports, folder: Path, bars: Bars, *, as_json: bool) -> None:
    """Print a row for each slice; leave with 1 where one failed."""
    from ..jobs.folder import REPORTS
    from ..jobs.report_tables import HEADINGS, slice_rows
    from .terminal import Console, print_json, table

    bars.note(f"{folder}: {', '.join(REPORTS.files)}, and a folder of each slice")
    if as_json:
        print_json(found.record(), folder=str(folder))
    else:
        rows = table(*HEADINGS, title="what landscapes are like")
        for row in slice_rows(found.reports):
            rows.add_row(*row)
        Console().print(rows)
    _name_failures(found.failed, bars)


def _name_failures(failed: dict[str, str], bars: Bars) -> None:
    for name, why in failed.items():
        bars.note(f"not reported: {name}: {why}")
    if failed:
        raise typer.Exit(1)
