"""Whatever happens to a file of the gallery's data, a site is built without it or refused by its name."""

import json
import shutil
from collections import Counter
from collections.abc import Iterator
from copy import deepcopy
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from gradscape.gallery.site import league, studio, wall
from gradscape.gallery.site.build import build_site
from gradscape.jobs.folder import SLICE_FILE
from gradscape.landscapes.draw.figures import dark

from .conftest import FIGURES

EVERY = 37  # of the damages that are thought of, since each takes a site; with 1 all of them are done


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave pictures out."""
    monkeypatch.setattr(studio, "draw_slice", lambda source, folder: None)
    monkeypatch.setattr(wall, "save_both", lambda picture, path: path.touch())
    monkeypatch.setattr(dark, "save_dark", lambda source, target: target.touch())
    monkeypatch.setattr(league, "save_both", lambda picture, path: path.touch())


def changed(value: Any) -> Iterator[Any]:
    """Yield a JSON value with something in it, at any depth, gone or of another kind."""
    wrong: Any = "x" if isinstance(value, (int, float, dict, list)) or value is None else -7
    yield wrong
    for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        without = deepcopy(value)
        del without[key]
        yield without
        for inner in changed(value[key]):
            yield {**value, key: inner} if isinstance(value, dict) else [*value[:key], inner, *value[key + 1 :]]


def damages(file: Path) -> Iterator[bytes]:
    """Yield what may become of a file: empty, cut short, other bytes in it; of JSON, something else in it too."""
    content = file.read_bytes()
    yield from (b"", content[: len(content) // 2], b"[" * 99999)
    for at in range(0, len(content), max(1, len(content) // 40)) if file.suffix == ".zip" else ():
        yield content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]
    if file.suffix == ".json":
        yield from (json.dumps(one).encode() for one in changed(json.loads(content)))


def refusal(data: Path, out: Path) -> str:
    """Return why a site is not built, nothing where it is."""
    try:
        build_site(FIGURES[2:], data, out)
    except ValueError as error:
        return str(error)
    return ""


def maker(file: Path) -> str:
    """Return the command that makes a file again: a study of a scene is none of the gallery's parts."""
    if file.name == "card.json":
        return f"card --out {file.parent}` measures it again"
    if file.parent.name == "census":
        return f"census {file.stem.removesuffix('-cuda')} --device cuda` measures it again"
    scene, _, study = file.stem.partition("-cuda.")
    return f"study {study} {scene}` measures it again" if study else "gallery compute --part "


@pytest.mark.slow
def test_a_site_is_built_or_refused_by_the_damaged_files_name(undrawn: None, data: Path, tmp_path: Path) -> None:
    kept = shutil.copytree(data, tmp_path / "data", ignore=shutil.ignore_patterns("runs.tmp", "line", "bare"))
    files = [
        path for path in sorted(kept.rglob("*"))
        if path.suffix in (".json", ".zip") and path.name != SLICE_FILE and "cpu" not in path.name
    ]  # fmt: skip
    refused = Counter[Path]()
    for file in files:
        content = file.read_bytes()
        for damage in islice(damages(file), None, None, EVERY):
            file.write_bytes(damage)
            if said := refusal(kept, tmp_path / "site"):
                refused[file] += 1
                assert said.startswith(f"{file} is damaged (")
                assert f"; delete it, and `landscape {maker(file)}" in said
        file.write_bytes(content)
    assert len(refused) == len(files) > 5
    assert not refusal(kept, tmp_path / "site")
