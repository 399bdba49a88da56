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
    wrong = []
    for path in RECORDS:
        record = read_json(path)
        begins = ("landscape ", f"gradscape.{path.parent.name}(")  # of the command line, of Python
        commands = (record["command"], record["provenance"]["command"])
        named = path.name.startswith(f"{record['env']}-{record['identity']['device']}")
        if not named or not all(command.startswith(begins) and " /" not in command for command in commands):
            wrong.append((path.name, commands))
    assert wrong == []


def texts(value: Any) -> Iterator[str]:
    """Yield every text in a JSON value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from texts(inner)


def test_no_text_of_what_is_kept_names_a_folder_of_a_machine() -> None:
    kept = {path: texts(json.loads(path.read_text())) for path in sorted(DATA.rglob("*.json"))}
    named = [(path, text) for path, found in kept.items() for text in found if re.search(r"(?:^|[\s=])/\w", text)]
    assert named == []


def test_every_picture_has_its_record() -> None:
    pictures = {path.with_suffix(".json") for folder in ("studies", "census") for path in (DATA / folder).glob("*.png")}
    assert pictures == set(RECORDS)
