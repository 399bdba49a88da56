"""The wall of landscapes: a slice of every environment, with what many slices of it are like by its census."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from ...envs.registry import entries
from ...landscapes.convert import from_json
from ...landscapes.measures.census import Census
from ...landscapes.measures.classify import GOOD, MISSING, NOISY, OPPOSITE, WORDS, ZERO
from ...landscapes.storage.records import read_json, reading
from ...landscapes.storage.store import open_slice
from ..files import CENSUSES, DEVICES, STORE, WALL_PICTURE, WALL_TABLE
from ..league import save_both
from .downloads import save_table
from .manifest import FigureEntry, Tile, WordShare
from .studio import Studio

GRADIENTS = (GOOD, NOISY, OPPOSITE, ZERO, MISSING)
SHAPES = tuple(word for word in WORDS if word not in GRADIENTS)
FITS = 1 / 3  # of the slices: from this share on a word is said of an environment
REMAKE = "delete it, and `landscape census {} --device {}` measures it anew"


def hang(shown: Sequence[FigureEntry], data: Path, out: Path, studio: Studio) -> list[Tile]:
    """Copy the censuses of these figures' environments into the site, and return a tile for each environment."""
    groups = [(env, list(group)) for env, group in groupby(shown, key=lambda entry: entry.env)]
    return [_tile(env, group, data, out, studio) for env, group in groups]


def _tile(env: str, group: Sequence[FigureEntry], data: Path, out: Path, studio: Studio) -> Tile:
    best = next((one for one in group if len(one.labels) == 2), group[0])
    about: dict[str, Any] = {
        "env": env,
        "figure": best.id,
        "page": best.page,
        "labels": best.labels,
        "dim": dimension(best),
        "engine": str(best.identity.get("engine", "")),
    }
    if found := _place_census(env, data, out, studio):
        census, table, picture = found
        words = [WordShare(word, one.value, one.low, one.high) for word, one in census.words.items()]
        about |= {"picture": picture, "table": table, "command": census.command}
        return Tile(**about, slices=len(census.slices), census=True, words=words)
    reported = [entry.report for entry in group if entry.report is not None]
    said = [{one.word for one in report.words if one.measured} for report in reported]
    words = [WordShare(word, sum(word in one for one in said) / len(said)) for word in WORDS] if said else []
    return Tile(**about, slices=len(said), census=False, words=words)


def dimension(entry: FigureEntry) -> int:
    """Return how many parameters the environment of a slice has."""
    named = entries().get(entry.env)
    return int(named.dim) if named and named.dim.isdigit() else len(entry.identity.get("parameters", entry.dims))


def _place_census(env: str, data: Path, out: Path, studio: Studio) -> tuple[Census, str, str] | None:
    """Copy a census into the site with the table of its slices; return it with where they are, None where none is."""
    for device in DEVICES:
        record = data / CENSUSES / f"{env}-{device}.json"
        picture = record.with_suffix(".png")
        if not record.exists() or not picture.exists():
            continue
        with reading(record, REMAKE.format(env, device)):
            census = from_json(Census, read_json(record))
            rows = list(_rows(census))
        folder = out / CENSUSES
        folder.mkdir(exist_ok=True)
        for one in (record, picture):
            shutil.copyfile(one, folder / one.name)
        studio.develop(picture, folder / picture.name)
        table = f"{env}-{device}.csv"
        save_table(rows, folder / table)
        return census, f"{CENSUSES}/{table}", f"{CENSUSES}/{picture.name}"
    return None


def _rows(census: Census) -> Iterator[Mapping[str, Any]]:
    """Yield what is known of each slice of a census."""
    unit = f" [{census.loss_unit}]" if census.loss_unit else ""
    for one in census.slices:
        low, high = one.range or (None, None)
        measured = dict(zip(census.spreads, one.measures, strict=True))
        place = {"base": one.base, "cut": one.cut, "axes": " x ".join(one.axes)}
        ends = {f"lowest{unit}": low, f"highest{unit}": high, "failed": one.failed}
        yield {**place, **ends, **measured, "words": "; ".join(one.words)}


def draw_wall(tiles: Sequence[Tile], data: Path, out: Path) -> None:
    """Draw the wall, and write its table."""
    from ...landscapes.draw.figures.multiples import Landscape, wall_figure

    hung = [Landscape(tile.env, tile.sentence(SHAPES), open_slice(data / tile.figure / STORE)) for tile in tiles]
    save_both(wall_figure(hung), out / WALL_PICTURE)
    save_table([_row(tile, one) for tile in tiles for one in tile.words], out / WALL_TABLE)


def _row(tile: Tile, one: WordShare) -> Mapping[str, Any]:
    source = "census" if tile.census else "gallery"
    about = {"environment": tile.env, "parameters": tile.dim, "engine": tile.engine, "slices": tile.slices}
    return {**about, "source": source, "word": one.word, "share": one.share, "low": one.low, "high": one.high}
