"""The verbs of `landscape gallery`: compute its figures, list them, build and serve the site."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from .call import current, verb
from .options import ARGUMENT, Data, Device, FidelityName, Names, Scheduler, Side
from .values import as_names

if TYPE_CHECKING:
    from ..gallery.compute import Computed
    from ..gallery.parts import FigureList
    from ..jobs.slices import SliceTable

Site = Annotated[str, Parameter(help="Folder of the site.")]


@verb
def compute(
    *,
    only: Names = (),
    part: Names = (),
    fidelity: FidelityName | None = None,
    device: Device = "auto",
    resolution: Side | None = None,
    scheduler: Scheduler = None,
    data: Data = None,
) -> Computed:
    """Compute the missing data of the figures, after an estimate of the cost.

    The data folder then contains a folder per figure: slice.zarr.zip at the fidelity of the figure, companions.json
    (the same slice through other points), episode-*.mp4 at some of its points, sweep.mp4 at draft fidelity, report.json
    and measures.json. It also contains searches at the fidelity of the figures (runs/), the accuracy and time of each
    environment (studies/) and races of nine methods (league/). Stop at any time: the same command continues from there.
    A figure that fails does not stop the others, and the exit code is then 1.

    Example: landscape gallery compute --only fluid --part slices --device cuda

    Parameters
    ----------
    only
        A figure's id or an environment. It can be repeated. The default is all figures.
    part
        Part to compute: slices, companions (the same slice through other points), sweeps, episodes, searches, reports,
        fidelities, league or league-slices. It can be repeated. The default is all except league, which takes longest.
    fidelity
        Accuracy of the simulation: draft, standard or reference. The default is that of each figure.
    resolution
        Number of points along each axis, for all figures.
    """
    from ..gallery.figures import choose_figures, read_figures

    chosen = choose_figures(read_figures(), as_names(only))
    from ..gallery.compute import Computed, change_figures, compute_parts
    from ..gallery.files import data_folder

    root, watch = data_folder(data), current().watch
    figures = change_figures(chosen, fidelity, resolution, root)  # type: ignore[arg-type] # one number for both axes
    failed = compute_parts(figures, root, watch, parts=as_names(part), device=device, scheduler=scheduler)
    if failed:
        watch.note(
            f"{len(failed)} of {len(figures)} figures failed: {', '.join(failed)}\n"
            f"if a figure was begun with other settings or another model, delete its folder in {root} to sample it "
            "again"
        )
    return Computed(root, len(figures), tuple(failed))


@verb
def list_(
    folder: Annotated[str | Path | None, ARGUMENT] = None, *, where: str | None = None, data: Data = None
) -> FigureList | SliceTable:
    """List the figures and how much of each is computed, or the slices in a folder.

    For a folder it reads the summaries of the slices. It writes one file there, .slices.sqlite, which you can delete.

    Raises ValueError if there is no such folder, or if `where` is not a valid condition.

    Example: landscape gallery list out --where "env = 'branin' and lowest < 0.5"

    Parameters
    ----------
    folder
        A folder with slices, at any depth, to list instead of the figures.
    where
        List only slices that meet this SQLite condition over the columns that `landscape gallery list FOLDER --json`
        prints.
    """
    if folder is not None:
        from ..jobs.slices import find_slices

        return find_slices(Path(folder), where)
    if where is not None:
        raise ValueError("--where selects slices in a folder; give that folder, too")
    from ..gallery.figures import read_figures
    from ..gallery.files import data_folder
    from ..gallery.parts import FigureList, SlicePart

    root = data_folder(data)
    return FigureList(root, tuple((one, SlicePart(one, root, "cpu").state()) for one in read_figures()))


@verb
def build(*, data: Data = None, out: Site = "out/gallery") -> None:
    """Build the site from the computed data, without simulating.

    The folder then contains the whole site: index.html opens it without a network, and manifest.json lists its content
    for programs.

    Example: landscape gallery build --out site
    """
    import shlex
    import time

    from ..gallery.figures import read_figures
    from ..gallery.files import data_folder
    from ..gallery.site import build as site
    from ..landscapes.capacity import size
    from ..landscapes.cost import duration
    from ..landscapes.storage.files import until_full

    watch, start = current().watch, time.perf_counter()
    with until_full(lambda: f"{out} is unchanged"):
        manifest = site.build_site(
            read_figures(),
            data_folder(data),
            Path(out),
            lambda count: watch.note(f"{out}: {count} figures to draw"),
        )
    weight = sum(file.stat().st_size for file in Path(out).rglob("*") if file.is_file())
    missing = f", {len(manifest.missing)} not sampled yet" if manifest.missing else ""
    watch.note(
        f"{len(manifest.figures)} figures{missing}; {size(weight)} in {duration(time.perf_counter() - start)}\n"
        f"open {Path(out) / 'index.html'}, or: landscape gallery serve --out {shlex.quote(out)}"
    )


@verb
def serve(
    *,
    out: Site = "out/gallery",
    port: Annotated[int, Parameter(validator=Number(gte=0, lte=65535))] = 8000,
) -> None:
    """Serve the site to a browser on this machine, until Ctrl-C.

    It writes no file.

    Example: landscape gallery serve --out site --port 0

    Parameters
    ----------
    port
        Port on this machine. 0 picks a free one.
    """
    import contextlib

    from ..gallery.site.server import open_server
    from ..landscapes.plain import printable

    with open_server(out, port) as server, contextlib.suppress(KeyboardInterrupt):
        print(f"{printable(str(out))} is at {server.address}/ until Ctrl-C", flush=True)
        server.serve_forever()
