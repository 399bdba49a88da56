"""The static site: the figures' data as pages that need no network and no server.

A page also shows `surface.png`, `.html`, `.gltf` and `.glb` if they are in the figure's folder. Runs are drawn over
every slice of their environment and options. Trade-offs are shown with every slice of their environment.

`manifest.json` lists all of it for programs. Its `files` are all files of the site. `build_site` replaces a folder only
if it contains nothing else.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment

from ... import __version__
from ...envs.registry import entries
from ...jobs.report import Report
from ...landscapes.convert import to_json
from ...landscapes.draw.pages.card import FILTERS, card_scenes, colour_stops
from ...landscapes.draw.pages.nodes import read_off_nodes
from ...landscapes.draw.pages.rendering import STATIC, number, scripts, templates
from ...landscapes.draw.pages.report import shown_of
from ...landscapes.measures.card import Card
from ...landscapes.measures.verdict import WORDS
from ...landscapes.storage.files import check_ours, placing, resolve
from ...landscapes.storage.paths import is_slice
from ...landscapes.storage.records import reading
from ...landscapes.storage.store import SliceStore, open_slice
from .. import files
from ..figures import Figure
from ..files import LEAGUE
from ..paper import read_paper
from ..records import Companion, read_companions
from .downloads import save_slice, save_table
from .league import LeaguePage, place_league, rank_style
from .page_data import (
    FigureEntry,
    enter_report,
    lay_own,
    quality_rows,
    read_episodes,
    read_report,
    read_runs,
)
from .sizes import give_sizes
from .studies import StudyEntry, place_studies
from .studio import Studio, draws
from .wall import GRADIENTS, SIZES, Tile, answers, draw_wall, make_tiles, place_card, size_class

HERE = Path(__file__).parent
MANIFEST, NODES = "manifest.json", "nodes.js"
CARD_PAGE, LEAGUE_PAGE = "card.html", "league.html"
SCHEMA = 3  # counts up whenever the meaning of a name in the manifest changes


@dataclass(frozen=True)
class Manifest:
    """The contents of a site: environments, slices, studies, slices that are not sampled yet, and files."""

    schema: int
    gradscape: str
    wall: Sequence[Tile]
    figures: Sequence[FigureEntry]
    studies: Mapping[str, Sequence[StudyEntry]]
    missing: Sequence[str]
    files: Sequence[str]


def build_site(
    figures: Sequence[Figure], data: Path, out: Path, follow: Callable[[int], None] = lambda count: None
) -> Manifest:
    """Build the site of the figures in `data` into `out`, whole or not at all, and return its manifest.

    An earlier site in `out` is replaced. `follow` is called with the number of figures before the first is drawn.
    Raises ValueError if `out` contains anything else than a site, if `data` contains no figure, or if a file of `data`
    is damaged.
    """
    out = resolve(out)
    _check(out)
    there = [figure for figure in figures if _has_samples(data / figure.id / files.STORE)]
    if not there:
        raise ValueError(f"{data} contains no slice of a figure; `landscape gallery compute` samples them")
    tables = read_runs(data)
    with placing(out, overwrite=True, check=partial(_check, out)) as new:
        follow(len(there))
        for scripts_of_all in (STATIC, HERE / "static"):
            shutil.copytree(scripts_of_all, new / "static", dirs_exist_ok=True)
        places = [(data / figure.id, new / figure.id) for figure in there]
        for _, folder in places:
            folder.mkdir()
        with Studio(places) as studio:
            envs = [figure.env for figure in there]
            studies = place_studies(data, new, envs, studio)
            card, league = place_card(data, new, studio), place_league(data, new, read_paper())
            site = _Site(new, data, _templates(card, league), studio, tables, studies)
            shown = [site.write_slice(figure) for figure in there]
            tiles = make_tiles(shown, data, new, studio)
            draw_wall(tiles, data, new)
        if card is not None:
            site.write_page(CARD_PAGE, card=card, scenes=card_scenes(card), colours=colour_stops())
        if league is not None:
            site.write_league(league)
        manifest = site.write_index(shown, [one.id for one in figures if one not in there], tiles, card, league)
        give_sizes(new)
        return manifest


def _check(out: Path) -> None:
    """Refuse a folder that contains anything except a site with all files in its manifest."""
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


def _templates(card: Card | None, league: LeaguePage | None) -> Environment:
    """Return the templates, with the pages that every page links to."""
    pages = templates(HERE / "templates")
    doors = (
        ("All landscapes", "index.html", True),
        ("Optimisers", LEAGUE_PAGE, league is not None),
        ("Report card of gradients", CARD_PAGE, card is not None),
        ("Your simulator", "index.html#yours", True),
    )
    pages.globals["doors"] = [(said, page) for said, page, there in doors if there]
    pages.filters |= FILTERS
    pages.filters["dark"] = files.dark_name
    pages.filters["beside"] = _describe_companion
    pages.filters["size"] = size_class
    pages.filters["rank_style"] = rank_style
    return pages


def _describe_companion(one: Companion, unit: str) -> str:
    """Describe the range of the losses of a companion slice."""
    if one.lowest is None or one.highest is None:
        return f"through {one.through} all episodes failed"
    return f"through {one.through} from {number(one.lowest)} to {number(one.highest)}{unit}"


@dataclass(frozen=True)
class _Site:
    """A site that is being built in `folder`, with the data that its pages share."""

    folder: Path
    data: Path
    pages: Environment
    studio: Studio
    tables: Sequence[xr.Dataset]
    studies: Mapping[str, Sequence[StudyEntry]]

    def write_page(self, name: str, template: str = "", **shown: Any) -> None:
        """Write a page from a template, by default the one with its name."""
        (self.folder / name).write_text(self.pages.get_template(template or name).render(**shown))

    def write_slice(self, figure: Figure) -> FigureEntry:
        """Write the page of a slice with all its files, and return its entry in the manifest."""
        source, folder = self.data / figure.id, self.folder / figure.id
        dataset = open_slice(source / files.STORE)
        episodes, runs = read_episodes(source, dataset), lay_own(dataset, self.tables)
        nodes = read_off_nodes(dataset, episodes, runs)
        (folder / NODES).write_text(f"let SLICE = {json.dumps(nodes, separators=(',', ':'))};\n")
        companions, report = read_companions(source), read_report(source)
        given = [name for episode in episodes for name in episode.files]
        given += [files.COMPANION_PICTURE] if companions else []
        tables: dict[str, Sequence[Mapping[str, Any]]] = {files.COMPANION_TABLE: to_json(companions)}
        profile = report.profile if report is not None else None
        if (source / files.QUALITY).exists() and profile is not None:
            tables[files.QUALITY_TABLE] = quality_rows(profile)
        taken = self._place(dataset, source, folder, given, {name: rows for name, rows in tables.items() if rows})
        entry = replace(
            FigureEntry.of(figure, dataset, source),
            files=[NODES, "index.html", *taken],
            episodes=episodes,
            companions=companions,
            runs=[run.search() for run in runs],
            report=enter_report(report) if report is not None else None,
            measures=profile.measures if profile is not None else {},
        )
        self._write_slice_page(entry, dataset, report, nodes)
        return entry

    def _write_slice_page(
        self, entry: FigureEntry, dataset: xr.Dataset, report: Report | None, nodes: Mapping[str, Any]
    ) -> None:
        paper = report.paper if report is not None else None
        said = shown_of(
            dataset,
            report.profile if report is not None else None,
            nodes,
            quoted=paper.words if paper is not None else (),
            where=paper.where if paper is not None else "",
        )
        self.write_page(
            entry.page,
            "slice.html",
            **{**said, "command": entry.command},
            entry=entry,
            stride=1,
            check=None,
            still=files.PICTURE,
            studies=self.studies[entry.env],
            scene=entries().get(entry.env),
            scripts=scripts(len(dataset["loss"].dims)),
        )

    def write_league(self, page: LeaguePage) -> None:
        """Write the page of all races, and a page for each race."""
        self.write_page(LEAGUE_PAGE, page=page)
        for scene in page.league.scenes:
            self.write_page(
                f"{LEAGUE}/{scene.env}.html",
                "league_scene.html",
                scene=scene,
                slice=page.slices.get(scene.env, ""),
                found=page.claims(scene.env),
                python=page.python([scene]),
            )

    def _place(
        self,
        dataset: xr.Dataset,
        source: Path,
        folder: Path,
        given: Sequence[str],
        tables: Mapping[str, Sequence[Mapping[str, Any]]],
    ) -> list[str]:
        """Write a slice and tables, copy the `given` files and other existing ones, and return all names.

        Each picture comes with its dark variant.
        """
        for name, rows in tables.items():
            save_table(rows, folder / name)
        found = (*files.SURFACES, files.SWEEP_FILM, files.REPORT, files.QUALITY)
        given = [*(name for name in found if (source / name).exists()), *given]
        for name in given:
            shutil.copyfile(source / name, folder / name)
        drawn = draws(source, len(dataset["loss"].dims))
        pictures = [name for name in dict.fromkeys([files.PICTURE, files.THUMBNAIL, *given]) if name.endswith(".png")]
        for name in pictures:
            if name not in drawn:
                within = partial(reading, source / name, files.REMAKE.format("slices"))
                self.studio.develop(source / name, folder / name, within)
        copied = [name for name in given if name not in pictures]
        taken = [*save_slice(dataset, source / files.STORE, folder), *tables, *copied]
        return [*taken, *(name for one in pictures for name in (one, files.dark_name(one)))]

    def write_index(
        self,
        shown: Sequence[FigureEntry],
        missing: Sequence[str],
        tiles: Sequence[Tile],
        card: Card | None,
        league: LeaguePage | None,
    ) -> Manifest:
        """Write the front page and the manifest, and return the manifest."""
        manifest = Manifest(SCHEMA, __version__, tiles, shown, self.studies, missing, [])
        said = {word for tile in tiles for word in tile.fitting()} | {word for entry in shown for word in entry.words}
        sizes = {size_class(tile.dim) for tile in tiles}
        self.write_page(
            "index.html",
            manifest=manifest,
            tiles=tiles,
            answers=answers(tiles),
            card=card,
            league=league,
            scenes=entries(),
            groups=[(env, list(group)) for env, group in groupby(shown, key=lambda entry: entry.env)],
            words=[word for word in WORDS if word in said],
            gradients=GRADIENTS,
            engines=sorted({tile.engine for tile in tiles if tile.engine}),
            sizes={name: words for name, words in SIZES.items() if name in sizes},
        )
        there = [file.relative_to(self.folder).as_posix() for file in self.folder.rglob("*") if file.is_file()]
        manifest = replace(manifest, files=sorted([*there, MANIFEST]))
        (self.folder / MANIFEST).write_text(json.dumps(to_json(manifest), indent=1) + "\n")
        return manifest
