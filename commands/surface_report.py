"""What `landscape surface` does and prints."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from ..jobs.folder import SLICE_STORE as SLICE
from ..jobs.folder import run_tables
from ..jobs.folder import store_in as inside
from ..landscapes.storage.files import other_files, tidy
from .terminal import Console

PICTURE, MODEL = "surface.png", "surface.gltf"


def surface(slice_: str, runs: Sequence[str], *, out: str | None, prints: Sequence[float] = ()) -> None:
    """Draw a slice as a surface, with runs on it."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    from ..landscapes.identity import stored_identity
    from ..landscapes.overlay import overlay
    from ..landscapes.storage.store import open_slice

    dataset = open_slice(inside(Path(slice_), SLICE))
    tables = run_tables(runs) if runs else []
    ours = stored_identity(dataset)
    for table in tables:
        theirs = stored_identity(table)
        if any(ours.get(one) != theirs.get(one) for one in ("objective", "options")):
            raise ValueError(
                f"the slice is of {ours.get('objective')} {ours.get('options')}, a run of {theirs.get('objective')} "
                f"{theirs.get('options')}; lay runs over a slice of their own"
            )
    placed = overlay(dataset, tables) if tables else []
    folder = _folder(out, [ours, [stored_identity(table) for table in tables]], str(ours["objective"]))
    from ..landscapes.draw.figures.page import save_prints
    from ..landscapes.draw.render.surface import save_surface, surface_figure

    with console.status("drawing"):
        save_surface(dataset, placed, folder / PICTURE, folder / MODEL)
        printed = save_prints(lambda width: surface_figure(dataset, placed, width=width), folder / PICTURE, prints)
    tidy(folder)
    console.print(f"{folder}: {', '.join([PICTURE, MODEL, *printed])}", markup=False)


def _folder(out: str | None, content: list[object], objective: str) -> Path:
    if out is None:
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:6]
        return Path("out") / f"surface-{objective}-{digest}"
    folder = Path(out)
    if other_files(folder, (PICTURE, MODEL), PICTURE):
        raise ValueError(f"{folder} holds other files; give --out a new or an empty folder")
    return folder
