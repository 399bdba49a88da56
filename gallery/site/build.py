"""The static site: what is in the figures' data, as pages that need no network and no server.

Whatever of `surface.png`, `.html`, `.gltf` and `.glb` lies in a figure's folder beside what `..files` names is shown,
too. Runs are laid over every slice of their environment and options; trade-offs are shown with every slice of theirs.

`manifest.json` lists all of it for programs. Its `files` are all that the site has: a folder is built anew only where
it holds nothing else.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from ... import __version__
from ...envs.registry import entries
from ...landscapes.identity import plane_of, stored_identity, stored_provenance
from ...landscapes.measures.card import Card
from ...landscapes.storage.arrays import parameters_of
from ...landscapes.storage.files import check_ours, placing, resolve
from ...landscapes.storage.paths import is_slice
from ...landscapes.storage.records import reading
from ...landscapes.storage.store import SliceStore, open_slice
from ..companions import Companion, read_companions
from ..figures import Figure
from ..files import (
    COMPANION_PICTURE,
    COMPANION_TABLE,
    MEASURES,
    PICTURE,
    QUALITY,
    QUALITY_TABLE,
    REMAKE,
    REPORT,
    STORE,
    SURFACES,
    SWEEP_FILM,
    THUMBNAIL,
    dark_name,
)
from ..paper import read_paper
from ..parts import changes_since
from .card import place_card
from .downloads import save_slice, save_table
from .front import Front
from .league import LeaguePage, place_league
from .manifest import SCHEMA, FidelityEntry, FigureEntry, Manifest, ModelEntry, as_json
from .measured import place_fidelities, quality_rows, read_report
from .models import place_models
from .page_data import count_numbers, read_episodes, read_measures, read_off_nodes, read_sweep
from .studio import Studio, draws
from .trajectories import lay_runs, read_runs
from .wall import draw_wall, hang

HERE = Path(__file__).parent
MANIFEST, NODES = "manifest.json", "nodes.js"
CARD_PAGE, LEAGUE_PAGE = "card.html", "league.html"


def build_site(
    figures: Sequence[Figure], data: Path, out: Path, follow: Callable[[int], None] = lambda count: None
) -> Manifest:
    """Build the site of the figures that `data` has into `out`, whole or not at all, and return its manifest.

    What is in `out` is replaced if a site built earlier is all that is there. `follow` hears how many figures are
    drawn, before the first is. Raises ValueError where `out` holds anything else, where `data` holds no figure, and,
    naming it, for a file of it that is damaged.
    """
    out = resolve(out)
    _check(out)
    there = [figure for figure in figures if _has_samples(data / figure.id / STORE)]
    if not there:
        raise ValueError(f"{data} holds no slice of a figure; `landscape gallery compute` samples them")
    tables = read_runs(data)
    with placing(out, overwrite=True, check=partial(_check, out)) as new:
        follow(len(there))
        shutil.copytree(HERE / "static", new / "static")
        places = [(data / figure.id, new / figure.id) for figure in there]
        for _, folder in places:
            folder.mkdir()
        with Studio(places) as studio:
            site = _Site.begin(new, data, [figure.env for figure in there], tables, studio)
            shown = [site.write_page(figure, data / figure.id) for figure in there]
            site.write_card(card := place_card(data, new, studio))
            site.write_league(league := place_league(data, new, read_paper()))
            tiles = hang(shown, data, new, studio)
            draw_wall(tiles, data, new)
        return site.write_index(Front(shown, tiles, card, league), [one.id for one in figures if one not in there])


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


def _has_samples(store: Path) -> bool:
    return is_slice(store) and bool((SliceStore.open(store).status() > 0).any())


def _templates() -> Environment:
    pages = Environment(
        loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    pages.filters["number"] = _number
    pages.filters["dark"] = dark_name
    pages.filters["beside"] = _beside
    pages.filters["times"] = lambda text: re.sub(r"(?<=\d) x (?=[\d(])", " \N{MULTIPLICATION SIGN} ", text)
    return pages


def _number(value: Any, digits: int = 4) -> str:
    """Write a number with a minus sign, and anything else as it is."""
    return f"{value:z.{digits}g}".replace("-", "\N{MINUS SIGN}") if isinstance(value, int | float) else str(value)


def _beside(one: Companion, unit: str) -> str:
    """Say what the losses of a slice beside a page's own range over."""
    if one.lowest is None or one.highest is None:
        return f"through {one.through} all failed"
    return f"through {one.through} from {_number(one.lowest)} to {_number(one.highest)}{unit}"


@dataclass(frozen=True)
class Held:
    """A parameter that a slice holds, and at what value."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class _Site:
    """A site under way in `folder`, with what its pages share."""

    folder: Path
    pages: Environment
    tables: Sequence[xr.Dataset]
    fidelities: Mapping[str, Sequence[FidelityEntry]]
    models: Mapping[str, Sequence[ModelEntry]]
    studio: Studio

    @classmethod
    def begin(
        cls, folder: Path, data: Path, envs: Sequence[str], tables: Sequence[xr.Dataset], studio: Studio
    ) -> _Site:
        """Place what the pages of these environments share."""
        studies = place_fidelities(data, folder, envs, studio), place_models(data, folder, envs, studio)
        return cls(folder, _templates(), tables, *studies, studio)

    def write_page(self, figure: Figure, source: Path) -> FigureEntry:
        """Write a slice's page and all it shows, and return its entry in the manifest."""
        folder = self.folder / figure.id
        dataset = open_slice(source / STORE)
        episodes, runs = read_episodes(source, dataset), lay_runs(dataset, self.tables)
        nodes = read_off_nodes(dataset, episodes, runs)
        (folder / NODES).write_text(f"const SLICE = {json.dumps(as_json(nodes), separators=(',', ':'))};\n")
        given = [name for name in (*SURFACES, SWEEP_FILM) if (source / name).exists()]
        given += [name for episode in episodes for name in episode.files]
        given += [name for name in (REPORT, MEASURES, QUALITY) if (source / name).exists()]
        entry = _entry(figure, dataset, source)
        given += [COMPANION_PICTURE] if entry.companions else []
        taken = [*save_slice(dataset, source / STORE, folder), *_save_tables(entry, source, folder)]
        entry = replace(
            entry,
            files=[
                NODES,
                "index.html",
                *taken,
                *_place(given, draws(source, len(dataset["loss"].dims)), source, folder, self.studio),
            ],
            episodes=episodes,
            runs=[run.search() for run in runs],
            fidelities=self.fidelities.get(figure.env, []),
            models=self.models.get(figure.env, []),
        )
        about = {"entry": entry, "held": list(_held_parameters(dataset)), "scene": entries().get(figure.env)}
        about["finer"] = nodes.finer is not None
        (folder / "index.html").write_text(self.pages.get_template("slice.html").render(**about))
        return entry

    def write_card(self, card: Card | None) -> None:
        """Write the page of the report card of gradients, where there is one."""
        if card is not None:
            (self.folder / CARD_PAGE).write_text(self.pages.get_template(CARD_PAGE).render(card=card))

    def write_league(self, page: LeaguePage | None) -> None:
        """Write the page of the league, where there is one."""
        if page is not None:
            (self.folder / LEAGUE_PAGE).write_text(self.pages.get_template(LEAGUE_PAGE).render(page=page))

    def write_index(self, front: Front, missing: Sequence[str]) -> Manifest:
        """Write the front page and the manifest, and return that."""
        manifest = Manifest(SCHEMA, __version__, front.tiles, front.shown, missing, [])
        index = self.pages.get_template("index.html").render(front=front, manifest=manifest, scenes=entries())
        (self.folder / "index.html").write_text(index)
        files = [file.relative_to(self.folder).as_posix() for file in self.folder.rglob("*") if file.is_file()]
        manifest = replace(manifest, files=sorted([*files, MANIFEST]))
        (self.folder / MANIFEST).write_text(json.dumps(as_json(manifest), indent=1) + "\n")
        return manifest


def _place(given: Sequence[str], drawn: Sequence[str], source: Path, folder: Path, studio: Studio) -> list[str]:
    """Copy files of a figure's data, and return their names, those of pictures with those of their dark variants.

    What is `drawn` has its own.
    """
    for name in given:
        shutil.copyfile(source / name, folder / name)
    pictures = [name for name in dict.fromkeys([PICTURE, THUMBNAIL, *given]) if name.endswith(".png")]
    for name in pictures:
        if name not in drawn:
            studio.develop(source / name, folder / name, partial(reading, source / name, REMAKE.format("slices")))
    copied = [name for name in given if name not in pictures]
    return [*copied, *(name for one in pictures for name in (one, dark_name(one)))]


def _save_tables(entry: FigureEntry, source: Path, folder: Path) -> list[str]:
    """Write what a figure's other pictures show as tables, and return their names."""
    tables: dict[str, Sequence[Mapping[str, Any]]] = {COMPANION_TABLE: [asdict(one) for one in entry.companions]}
    if (source / QUALITY).exists() and entry.report is not None:
        tables[QUALITY_TABLE] = quality_rows(source)
    there = {name: rows for name, rows in tables.items() if rows}
    for name, rows in there.items():
        save_table(rows, folder / name)
    return list(there)


def _entry(figure: Figure, dataset: xr.Dataset, source: Path) -> FigureEntry:
    """Return what the manifest says of a slice, but for what other files of the site it goes with."""
    identity, provenance = stored_identity(dataset), stored_provenance(dataset)
    return FigureEntry(
        id=figure.id,
        env=figure.env,
        paper_figure=figure.caption.number,
        page=f"{figure.id}/index.html",
        dims=figure.dims,
        labels=identity["plane"]["labels"],
        through=figure.through,
        says=figure.caption.says,
        searched=figure.searched,
        resolution=identity["plane"]["resolution"],
        loss_unit=provenance.get("loss_unit", ""),
        numbers=count_numbers(dataset),
        command=provenance.get("command") or figure.command(identity.get("device", "auto")),
        python=figure.python(identity.get("device", "auto")),
        identity={name: value for name, value in identity.items() if name != "plane"},
        provenance=provenance,
        files=[],
        episodes=[],
        sweep=read_sweep(source),
        companions=read_companions(source),
        changed=changes_since(identity),
        runs=[],
        measures=read_measures(source),
        report=read_report(source),
        fidelities=[],
        models=[],
    )


def _held_parameters(dataset: xr.Dataset) -> Iterator[Held]:
    """Yield the parameters that the slice holds."""
    plane = plane_of(dataset)
    varied = plane.basis.any(dim=0).tolist()
    for (name, unit), value, varies in zip(parameters_of(dataset), plane.origin.tolist(), varied, strict=True):
        if not varies:
            yield Held(name, value, unit)
