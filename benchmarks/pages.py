"""What the programs share that write a table of what the gallery keeps into a page of the docs.

A table stands between two marks, <!-- NAME --> and <!-- /NAME -->.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gradscape.envs.registry import entries, environment_class
from gradscape.gallery.files import DEVICES, TradeoffFiles
from gradscape.jobs.report_tables import markdown
from gradscape.landscapes.storage.records import read_json

ROOT = Path(__file__).parents[1]
DATA, DOCS = ROOT / "gallery" / "data", ROOT / "docs"
UNMEASURED, MISSING = "not measured since the scene changed", "not measured"


def records(
    scene: str, files: Callable[[Path, str, str], TradeoffFiles], data: Path = DATA
) -> Iterator[dict[str, Any]]:
    """Yield what is kept of a scene in such files, by device."""
    for device in DEVICES:
        if (path := files(data, scene, device).record).is_file():
            yield read_json(path)


def scenes() -> list[str]:
    """Return the scenes of ours that are simulated, by name: functions have no fidelities to choose from."""
    ours = sorted(name for name, entry in entries().items() if not entry.extra)  # others' engines promise nothing
    return [name for name in ours if len(environment_class(name).fidelities) > 1]


def is_present(scene: str, model_version: int, engine: str = "warp") -> bool:
    """Say whether a scene's model is still of the version that was measured."""
    return model_version == environment_class(scene).version_on(engine)


def written(page: Path, name: str) -> str:
    """Return the table of a name that a page holds; raises ValueError where it has no such marks, or two of them."""
    text = page.read_text()
    return text[_place(text, name)]


def write(table: str, page: Path, name: str) -> None:
    """Put a table into a page, in the place of the one of this name; raises ValueError as `written` does."""
    text = page.read_text()
    place = _place(text, name)
    page.write_text(text[: place.start] + table + text[place.stop :])


def _place(text: str, name: str) -> slice:
    """Return where between its marks a table stands."""
    (found,) = re.finditer(rf"<!-- {name} -->\n\n(.*?)\n<!-- /{name} -->", text, flags=re.DOTALL)
    return slice(*found.span(1))


def settle_measured(
    about: str, found: Mapping[str, object], head: Sequence[str], rows: Iterable[Sequence[str]], page: Path, name: str
) -> int:
    """Be the program that writes a table of what was `found` of every scene, a text where nothing was measured.

    `about` is its help; return the exit code.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, say what is not so")
    asked = parser.parse_args()
    wrong = [f"{scene}: {one}" for scene, one in found.items() if isinstance(one, str)]
    fine = f"all {len(found)} scenes are measured"
    return settle(markdown(head, [list(row) for row in rows]), page, name, wrong, check=asked.check, fine=fine)


def settle(text: str, page: Path, name: str, wrong: Sequence[str], *, check: bool, fine: str) -> int:
    """Write the table, or only check the page; print what is `wrong`, or that all is `fine`; return the exit code."""
    if not check:
        write(text, page, name)
    differs = [f"{page}: differs from the records"] if written(page, name) != text else []
    print("\n".join([*wrong, *differs]) or fine)
    return 1 if check and (wrong or differs) else 0
