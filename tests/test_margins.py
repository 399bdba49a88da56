"""docs/measures.md has a row for every scene, with how near the kept extremes say its step is to the limit."""

from pathlib import Path

from benchmarks import margins
from benchmarks.margins import HEAD, NAME, PAGE, rows
from benchmarks.pages import DATA, MISSING, UNMEASURED, written

from gradscape.envs.registry import entries, environment_class
from gradscape.jobs.report_tables import markdown
from gradscape.landscapes.storage.records import read_json, write_record


def test_the_page_holds_the_margins() -> None:
    wanted = markdown(HEAD, list(rows(margins.margins())))
    assert written(PAGE, NAME) == wanted, "`python -m benchmarks.margins` writes the page"


def test_every_scene_of_ours_has_a_row() -> None:
    ours = {name for name, entry in entries().items() if not entry.extra}
    scenes = {name for name in ours if len(environment_class(name).fidelities) > 1}
    assert {line[0].strip("`") for line in rows(margins.margins())} == scenes


def test_a_row_says_what_its_record_says(tmp_path: Path) -> None:
    record = read_json(DATA / "extremes" / "bounce-cpu.json")
    (tmp_path / "extremes").mkdir()
    write_record(tmp_path / "extremes" / "bounce-cpu.json", record)
    lines = [line for line in rows(margins.margins(tmp_path)) if line[0] == "`bounce`"]
    steps = [limit for limit in record["limits"] if limit["knob"] == "dt"]
    assert [line[2] for line in lines] == [limit["precision"] for limit in steps]
    assert [float(line[3]) for line in lines] == [float(f"{limit['base']:.3g}") for limit in steps]


def test_a_scene_that_changed_or_was_never_measured_is_said_to_be_so(tmp_path: Path) -> None:
    record = read_json(DATA / "extremes" / "bounce-cpu.json")
    record["identity"]["model_version"] = 0
    (tmp_path / "extremes").mkdir()
    write_record(tmp_path / "extremes" / "bounce-cpu.json", record)
    found = margins.margins(tmp_path)
    assert (found["bounce"], found["cartpole"]) == (UNMEASURED, MISSING)
