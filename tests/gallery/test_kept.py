"""Records that the gallery keeps are what was written, and name no folder of whoever measured them."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gradscape.landscapes.storage.records import read_json

DATA = Path(__file__).parents[2] / "gallery" / "data"
RECORDS = [path for folder in ("studies", "census") for path in sorted((DATA / folder).glob("*.json"))]


def test_a_kept_record_is_whole_and_its_command_is_anybodys() -> None:
    for path in RECORDS:
        record = read_json(path)
        assert path.name.startswith(f"{record['env']}-{record['identity']['device']}"), path
        for command in (record["command"], record["provenance"]["command"]):
            assert command.startswith(("landscape ", f"gradscape.{path.parent.name}(")), path  # typed, or of Python
            assert " /" not in command, path


def texts(value: Any) -> Iterator[str]:
    """Yield every text in a JSON value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from texts(inner)


def test_no_text_of_what_is_kept_names_a_folder_of_a_machine() -> None:
    files = sorted(DATA.rglob("*.json"))
    assert len(files) > 500
    named = [(path.relative_to(DATA), text) for path in files for text in texts(json.loads(path.read_text()))
             if re.search(r"(?:^|[\s=])/\w", text)]  # fmt: skip
    assert named == []


def test_every_picture_has_its_record() -> None:
    pictures = {path.with_suffix(".json") for folder in ("studies", "census") for path in (DATA / folder).glob("*.png")}
    assert pictures == set(RECORDS)
