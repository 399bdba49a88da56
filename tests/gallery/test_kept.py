"""Records that the gallery keeps are what was written, and name no folder of whoever measured them."""

from pathlib import Path

import pytest

from gradscape.landscapes.storage.records import read_json

DATA = Path(__file__).parents[2] / "gallery" / "data"
RECORDS = [path for folder in ("tradeoff", "extremes", "census") for path in sorted((DATA / folder).glob("*.json"))]


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_kept_record_is_whole_and_its_command_is_anybodys(path: Path) -> None:
    record = read_json(path)
    assert path.name.startswith(f"{record['env']}-{record['identity']['device']}")
    for command in (record["command"], record["provenance"]["command"]):
        assert command.startswith(("landscape ", f"gradscape.{path.parent.name}("))  # of the command line, of Python
        assert " /" not in command


def test_every_picture_has_its_record() -> None:
    pictures = {
        path.with_suffix(".json")
        for folder in ("tradeoff", "extremes", "census")
        for path in (DATA / folder).glob("*.png")
    }
    assert pictures == set(RECORDS)
