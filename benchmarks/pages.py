"""What the programs share that write a table of what the gallery keeps into a page of the docs.

A table stands between two marks, <!-- NAME --> and <!-- /NAME -->.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from gradscape.envs.code import code_digest
from gradscape.envs.registry import environment_class
from gradscape.gallery.files import DEVICES, TradeoffFiles
from gradscape.landscapes.storage.records import read_json

ROOT = Path(__file__).parents[1]
DATA, DOCS = ROOT / "gallery" / "data", ROOT / "docs"
UNMEASURED = "not measured since the scene changed"


def records(
    scene: str, files: Callable[[Path, str, str], TradeoffFiles], data: Path = DATA
) -> Iterator[dict[str, Any]]:
    """Yield what is kept of a scene in such files, by device."""
    for device in DEVICES:
        if (path := files(data, scene, device).record).is_file():
            yield read_json(path)


def is_present(scene: str, code: str, engine: str = "warp") -> bool:
    """Say whether the digest of a scene's code is that of the code there is now."""
    return code == code_digest(environment_class(scene), engine)


def written(page: Path, name: str) -> str:
    """Return the table of a name that a page holds; raises ValueError where it has no such marks, or two of them."""
    (found,) = re.findall(rf"<!-- {name} -->\n\n(.*?)\n<!-- /{name} -->", page.read_text(), flags=re.DOTALL)
    return str(found)


def write(text: str, page: Path, name: str) -> None:
    """Put a table into a page, in the place of the one of this name."""
    page.write_text(page.read_text().replace(written(page, name), text))


def settle(text: str, page: Path, name: str, wrong: Sequence[str], *, check: bool, fine: str) -> int:
    """Write the table, or only check the page; print what is `wrong`, or that all is `fine`; return the exit code."""
    if not check:
        write(text, page, name)
    differs = [f"{page}: differs from the records"] if written(page, name) != text else []
    print("\n".join([*wrong, *differs]) or fine)
    return 1 if check and (wrong or differs) else 0
