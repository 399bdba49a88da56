"""The page of a report: one file for anyone's slice, with runs and a check where they are given."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..landscapes.checks.diagnosis import Diagnosis
from ..landscapes.checks.finding import Finding
from ..landscapes.convert import from_json, to_json
from ..landscapes.draw.pages.nodes import EpisodeShown
from ..landscapes.draw.pages.report import CheckShown, data_link, report_page
from ..landscapes.identity import plane_of
from ..landscapes.objective import Status
from ..landscapes.storage.files import replacing
from ..landscapes.storage.floor_map import open_floor_map
from ..landscapes.storage.records import read_json, reading
from ..landscapes.storage.store import open_slice
from .episode import film_episode
from .folder import CHECK, run_tables
from .watch import Watch

if TYPE_CHECKING:
    import xarray as xr
    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Environment
    from .report import Report

FILM_PIXELS, FILM_FRAMES = 320, 60  # height of a film, and most frames


def save_page(
    report: Report, path: Path, *, include: Sequence[str | Path] = (), env: Environment | None = None,
    watch: Watch | None = None,
) -> None:  # fmt: skip
    """Write the page of a report.

    `include` are folders of runs, races and checks that the page also shows. If the environment has episodes, the page
    has films of those at the lowest and the highest loss.

    Raises ValueError if the slice is not on disk, if a folder contains none of these, or if a run searched other
    parameters.
    """
    if report.store is None:
        raise ValueError("the page of a report shows its slice, but that is not on disk; sample it into a folder")
    watch, dataset = watch or Watch(), open_slice(report.store)
    checks = [folder for folder in map(Path, include) if (folder / CHECK.files[0]).exists()]
    others = [str(folder) for folder in include if Path(folder) not in checks]
    quoted = report.paper
    with watch.busy(f"{report.name}: writing its page"):
        page = report_page(
            dataset,
            report.profile,
            title=report.name,
            record=to_json(report),
            picture=_draw(dataset),
            quoted=quoted.words if quoted else (),
            where=quoted.where if quoted else "",
            runs=run_tables(others) if others else (),
            episodes=list(_film(env, dataset)) if env is not None else (),
            check=_read_check(checks[0]) if checks else None,
            floor=open_floor_map(report.store, dataset),
        )
        with replacing(path) as partial:
            partial.write_text(page, encoding="utf-8")


def _draw(dataset: xr.Dataset) -> bytes:
    from ..landscapes.draw.figures.contour import landscape_figure
    from ..landscapes.draw.figures.profile import profile_figure

    return (landscape_figure if dataset["loss"].ndim == 2 else profile_figure)(dataset)._repr_png_()


def _read_check(folder: Path) -> CheckShown:
    path = folder / CHECK.files[0]
    with reading(path, "run the check again, or leave it out"):
        found: Any = read_json(path)
        diagnoses = [from_json(Diagnosis, one) for one in found["diagnoses"]]
        return CheckShown(bool(found["passed"]), diagnoses, [from_json(Finding, one) for one in found["checks"]])


def _film(env: Environment, dataset: xr.Dataset) -> Iterator[EpisodeShown]:
    """Yield the episodes at the lowest and the highest loss of a slice, where the environment has some to draw."""
    plane, loss = plane_of(dataset), np.atleast_2d(dataset["loss"].transpose("v", "u", missing_dims="ignore"))
    if not np.isfinite(loss).any():
        return
    for why, place in (("lowest loss", np.nanargmin(loss)), ("highest loss", np.nanargmax(loss))):
        row, column = (int(one) for one in np.unravel_index(int(place), loss.shape))
        along = torch.stack([axis[at] for axis, at in zip(plane.axes(), (column, row), strict=False)])
        if (links := film_links(env, plane.lift(along[None])[0])) is None:
            return
        at = dict(zip(plane.labels, plane.to_values(along).tolist(), strict=True))
        yield EpisodeShown(row, column, why, float(loss[row, column]), Status.OK.name, at, *links)


def film_links(env: Environment, x: Float[Tensor, " dim"]) -> tuple[str, str] | None:
    """Return links that hold a film of the episode at a point and a picture of its end, None where it has none."""
    try:
        episode = env.episode(x)
    except ValueError:  # it has none to draw
        return None
    if not episode.parts:
        return None
    with tempfile.TemporaryDirectory() as folder:
        film, still = film_episode(episode, Path(folder) / "episode", height=FILM_PIXELS, frames=FILM_FRAMES)
        return data_link(film.read_bytes(), "video/mp4"), data_link(still.read_bytes(), "image/webp")
