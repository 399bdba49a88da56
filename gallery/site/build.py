"""The static site: what is in the figures' data, as pages that need no network and no server.

A figure's folder in the data holds `slice.zarr`; whatever else of these is there gets a section of its own:
`surface.png`, `.html`, `.gltf` or `.glb`; `sweep.mp4` with `sweep.json` (label, low, high, fidelity, frames,
resolution, command); `episodes.json`, a list of nodes (row, column, why, loss, status), each with
`episode-ROW-COLUMN.mp4` and `.webp`, its last frame; `report.json`, `measures.json` (names and numbers) and
`gradient-quality.png`, of `landscape report`. Runs in `runs/ENVIRONMENT-OPTIONS/` are laid over every slice of their
environment and options; `tradeoff/ENVIRONMENT-DEVICE.json` and `.png` are shown with every slice of theirs.

`manifest.json` lists all of it for programs; `schema` counts up whenever the meaning of a name in it changes. Its
`files` are all that the site has: a folder is built anew only where it holds nothing else.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from ... import __version__
from ...envs.registry import entries
from ...jobs.slice import PICTURE, STORE
from ...landscapes.identity import plane_of, stored_identity, stored_provenance
from ...landscapes.storage.arrays import parameters_of
from ...landscapes.storage.files import placing, resolve
from ...landscapes.storage.ownership import check_ours
from ...landscapes.storage.paths import is_slice
from ...landscapes.storage.records import reading
from ...landscapes.storage.store import SliceStore, open_slice
from ..figures import HERE, Figure
from ..runs import FOLDER
from .measured import MEASURES, QUALITY, REPORT, dark_name, place_tradeoffs, read_report
from .page_data import REMAKE, nodes, numbers, read_episodes, read_measures, read_sweep
from .trajectories import read_runs, trajectories

SCHEMA = 2
MANIFEST, NODES, THUMBNAIL, SWEEP = "manifest.json", "nodes.js", "thumbnail.png", "sweep.mp4"
SURFACES = ("surface.png", "surface.html", "surface.gltf", "surface.glb")
POINTS = ("u", "v", "loss", "radius", "path", "hidden")  # of a trajectory, for the map alone


def build_site(
    figures: Sequence[Figure], data: Path, out: Path, follow: Callable[[int], None] = lambda count: None
) -> dict[str, Any]:
    """Build the site of the figures that `data` has into `out`, whole or not at all, and return its manifest.

    What is in `out` is replaced if a site built earlier is all that is there; anything else is refused. `follow`
    hears how many figures are drawn, before the first is.
    """
    out = resolve(out)
    _check(out)
    there = [figure for figure in figures if _sampled(data / figure.id / STORE)]
    if not there:
        raise ValueError(f"{data} holds no slice of a figure; `landscape gallery compute` samples them")
    pages, tables = _templates(), read_runs(data / FOLDER)
    with placing(out, overwrite=True, check=partial(_check, out)) as new:
        follow(len(there))
        shutil.copytree(HERE / "static", new / "static")
        traded = place_tradeoffs(data, new, [figure.env for figure in there])
        made = [_page(pages, figure, data / figure.id, new / figure.id, tables, traded) for figure in there]
        missing = [figure.id for figure in figures if figure not in there]
        manifest = {"schema": SCHEMA, "gradscape": __version__, "figures": made, "missing": missing}
        groups = [(env, list(group)) for env, group in groupby(made, key=lambda entry: str(entry["env"]))]
        index = pages.get_template("index.html").render(groups=groups, manifest=manifest, scenes=entries())
        (new / "index.html").write_text(index)
        files = [file.relative_to(new).as_posix() for file in new.rglob("*") if file.is_file()]
        manifest["files"] = sorted([*files, MANIFEST])
        (new / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    return manifest


def _check(out: Path) -> None:
    """Refuse a folder that holds anything but a site whose manifest lists all of it."""
    if not out.exists():
        return
    if not out.is_dir():
        raise ValueError(f"{out} is a file; give --out a new or an empty folder")
    try:
        listed = json.loads((out / MANIFEST).read_text())
        ours = frozenset(listed["files"] if {"schema", "gradscape"} <= listed.keys() else ())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        ours = frozenset()  # none, or of an earlier version, which listed no files
    check_ours(out, ours.__contains__, f"a gallery by its {MANIFEST}")


def _templates() -> Environment:
    pages = Environment(
        loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    pages.filters["number"] = _number
    pages.filters["dark"] = dark_name
    pages.filters["times"] = lambda text: re.sub(r"(?<=\d) x (?=[\d(])", " \N{MULTIPLICATION SIGN} ", text)
    return pages


def _number(value: Any, digits: int = 4) -> str:
    """Write a number with a minus sign, and anything else as it is."""
    return f"{value:z.{digits}g}".replace("-", "\N{MINUS SIGN}") if isinstance(value, int | float) else str(value)


def _sampled(store: Path) -> bool:
    return is_slice(store) and bool((SliceStore.open(store).status() > 0).any())


def _page(
    pages: Environment,
    figure: Figure,
    source: Path,
    folder: Path,
    tables: Sequence[xr.Dataset],
    traded: Mapping[str, list[dict[str, Any]]],
) -> dict[str, Any]:
    """Write a slice's page and all it shows into `folder`, and return its entry in the manifest."""
    from ...landscapes.draw.figures.dark import save_dark

    folder.mkdir()
    dataset = open_slice(source / STORE)
    _draw(dataset, source, folder)
    shown, runs = read_episodes(source, dataset), trajectories(dataset, tables)
    (folder / NODES).write_text(f"const SLICE = {json.dumps(nodes(dataset, shown, runs), separators=(',', ':'))};\n")
    sweep = read_sweep(source) if (source / SWEEP).exists() else None
    surfaces = [name for name in SURFACES if (source / name).exists()]
    films = [episode[kind] for episode in shown for kind in ("mp4", "webp") if kind in episode]
    reported = [name for name in (REPORT, MEASURES, QUALITY) if (source / name).exists()]
    given = [*surfaces, *([] if sweep is None else [SWEEP]), *films, *reported]
    for name in given:
        shutil.copyfile(source / name, folder / name)
    pictures = [PICTURE, THUMBNAIL, *(name for name in given if name.endswith(".png"))]
    for name in pictures:
        if not (folder / dark_name(name)).exists():
            with reading(source / name, REMAKE.format("slices")):
                save_dark(folder / name, folder / dark_name(name))
    copied = [name for name in given if name not in pictures]
    entry = _entry(figure, dataset) | {
        "files": [NODES, "index.html", *copied, *(name for one in pictures for name in (one, dark_name(one)))],
        "episodes": shown,
        "sweep": sweep,
        "runs": [{name: value for name, value in run.items() if name not in POINTS} for run in runs],
        "measures": read_measures(source / MEASURES),
        "report": read_report(source),
        "tradeoffs": traded.get(figure.env, []),
    }
    about = {"entry": entry, "held": _held(dataset), "scene": entries().get(figure.env)}
    (folder / "index.html").write_text(pages.get_template("slice.html").render(**about))
    return entry


def _entry(figure: Figure, dataset: xr.Dataset) -> dict[str, Any]:
    identity, provenance = stored_identity(dataset), stored_provenance(dataset)
    return {
        "id": figure.id,
        "env": figure.env,
        "paper_figure": figure.number,
        "page": f"{figure.id}/index.html",
        "dims": list(figure.dims),
        "labels": identity["plane"]["labels"],
        "through": figure.through,
        "says": figure.says,
        "resolution": identity["plane"]["resolution"],
        "loss_unit": provenance.get("loss_unit", ""),
        "numbers": numbers(dataset),
        "command": provenance.get("command") or figure.command(identity.get("device", "auto")),
        "identity": {name: value for name, value in identity.items() if name != "plane"},
        "provenance": provenance,
    }


def _draw(dataset: xr.Dataset, source: Path, folder: Path) -> None:
    """Draw a slice for light and for dark; a line's picture is the one made with it, since its events need episodes."""
    from ...landscapes.draw.figures.contour import landscape_figure
    from ...landscapes.draw.figures.dark import darken
    from ...landscapes.draw.figures.page import save
    from ...landscapes.draw.figures.profile import profile_figure
    from ...landscapes.draw.figures.thumbnail import thumbnail_figure

    drawn = {THUMBNAIL: thumbnail_figure(dataset)}
    if len(dataset["loss"].dims) == 1 and (source / PICTURE).exists():
        shutil.copyfile(source / PICTURE, folder / PICTURE)
    else:
        drawn[PICTURE] = (landscape_figure if len(dataset["loss"].dims) == 2 else profile_figure)(dataset)
    for name, picture in drawn.items():
        save(picture, folder / name)
        darken(picture)
        save(picture, folder / dark_name(name))


def _held(dataset: xr.Dataset) -> list[tuple[str, float, str]]:
    """Return the parameters that the slice holds, at what value and in what unit."""
    plane = plane_of(dataset)
    varied = plane.basis.any(dim=0).tolist()
    rows = zip(parameters_of(dataset), plane.origin.tolist(), varied, strict=True)
    return [(name, value, unit) for (name, unit), value, varies in rows if not varies]
