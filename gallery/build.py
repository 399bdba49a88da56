"""The static site: what is in the figures' data, as pages that need no network and no server.

A figure's folder in the data holds `slice.zarr`; whatever else of these is there gets a section of its own:
`surface.png`, `.html`, `.gltf` or `.glb`, `sweep.mp4` or `.gif`, `episode-ROW-COLUMN.mp4` or `.png` (the node whose
episode it shows), `overlay.json` (trajectories) and `measures.json` (names and numbers).
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from ..landscapes.files import placing
from ..landscapes.job import PICTURE, STORE
from ..landscapes.store import SliceStore, is_slice, open_slice
from .figures import HERE, Figure
from .page_data import episodes, nodes, numbers

MANIFEST, NODES, THUMBNAIL = "manifest.json", "nodes.js", "thumbnail.png"
EXTRAS = ("surface.png", "surface.html", "surface.gltf", "surface.glb", "sweep.mp4", "sweep.gif")


def build_site(figures: Sequence[Figure], data: Path, out: Path) -> dict[str, Any]:
    """Build the site of the figures that `data` has into `out`, whole or not at all, and return its manifest."""
    there = [figure for figure in figures if _sampled(data / figure.id / STORE)]
    if not there:
        raise ValueError(f"{data} holds no slice of a figure; `landscape gallery compute` samples them")
    if out.exists() and any(out.iterdir()) and not (out / MANIFEST).exists():
        raise ValueError(f"{out} holds other files and no gallery; give --out a new or an empty folder")
    pages = Environment(
        loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    with placing(out.resolve(), overwrite=True) as new:
        shutil.copytree(HERE / "static", new / "static")
        entries = [_page(pages, figure, data / figure.id, new / figure.id) for figure in there]
        missing = [figure.id for figure in figures if figure not in there]
        manifest = {"gradscape": version("gradscape"), "figures": entries, "missing": missing}
        (new / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
        groups = [(env, list(group)) for env, group in groupby(entries, key=lambda entry: str(entry["env"]))]
        (new / "index.html").write_text(pages.get_template("index.html").render(groups=groups, manifest=manifest))
    return manifest


def _sampled(store: Path) -> bool:
    return is_slice(store) and bool((SliceStore.open(store).status() > 0).any())


def _page(pages: Environment, figure: Figure, source: Path, folder: Path) -> dict[str, Any]:
    """Write a slice's page and all it shows into `folder`, and return its entry in the manifest."""
    folder.mkdir()
    dataset = open_slice(source / STORE)
    _draw(dataset, source, folder)
    (folder / NODES).write_text(f"const SLICE = {json.dumps(nodes(dataset, source), separators=(',', ':'))};\n")
    extras = [name for name in EXTRAS if (source / name).exists()]
    shown = episodes(source)
    films = [episode[kind] for episode in shown for kind in ("mp4", "png") if kind in episode]
    for name in (*extras, *films):
        shutil.copyfile(source / name, folder / name)
    entry = _entry(figure, dataset) | {"files": [NODES, PICTURE, THUMBNAIL, "index.html", *extras, *films]}
    measures = source / "measures.json"
    about = {
        "entry": entry,
        "episodes": shown,
        "measures": json.loads(measures.read_text()) if measures.exists() else {},
        "origin": _origin(dataset),
    }
    (folder / "index.html").write_text(pages.get_template("slice.html").render(**about))
    return entry


def _entry(figure: Figure, dataset: xr.Dataset) -> dict[str, Any]:
    identity, provenance = dataset.attrs["identity"], dataset.attrs["provenance"]
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
    """Draw a slice; a line's picture is the one made with it, since its events need episodes."""
    from ..landscapes.draw.contour import landscape_figure
    from ..landscapes.draw.page import save
    from ..landscapes.draw.profile import profile_figure
    from ..landscapes.draw.thumbnail import thumbnail_figure

    save(thumbnail_figure(dataset), folder / THUMBNAIL)
    if len(dataset["loss"].dims) == 2:
        save(landscape_figure(dataset), folder / PICTURE)
    elif (source / PICTURE).exists():
        shutil.copyfile(source / PICTURE, folder / PICTURE)
    else:
        save(profile_figure(dataset), folder / PICTURE)


def _origin(dataset: xr.Dataset) -> list[tuple[str, float]]:
    """Return the parameters that the slice holds, and what at."""
    plane = dataset.attrs["identity"]["plane"]
    varied = [any(row[number] for row in plane["basis"]) for number in range(len(plane["origin"]))]
    rows = zip(dataset["dim"].values.tolist(), plane["origin"], varied, strict=True)
    return [(str(name), float(value)) for name, value, varies in rows if not varies]
