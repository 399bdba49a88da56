"""docs/parts.md has a row for every part that a scene names, with what the kept study says of it."""

from dataclasses import replace
from pathlib import Path

from benchmarks import parts
from benchmarks.pages import DATA, UNMEASURED, written
from benchmarks.parts import HEAD, NAME, PAGE, rows, studies

from gradscape.envs.registry import entries, environment_class
from gradscape.jobs.report_tables import markdown
from gradscape.landscapes.storage.records import read_json, write_record


def test_the_page_holds_the_studies() -> None:
    wanted = markdown(HEAD, list(rows(studies())))
    assert written(PAGE, NAME) == wanted, "`python -m benchmarks.parts` writes the page"


def test_every_simulated_scene_names_its_parts_and_each_has_a_row() -> None:
    named = {(name, part.name) for name in entries() for part in environment_class(name).model_parts}
    assert {(line[0].strip("`"), line[1]) for line in rows({})} == named
    ours = [name for name, entry in entries().items() if not entry.extra]
    assert {scene for scene, _ in named} == {name for name in ours if len(environment_class(name).fidelities) > 1}


def test_a_part_that_was_measured_otherwise_or_of_other_code_is_said_to_be_so(tmp_path: Path) -> None:
    study = studies()["bounce"]
    first, *others = study.parts
    line = next(line for line in rows({"bounce": study}) if line[:2] == ["`bounce`", first.name])
    assert line[-1] == first.verdict
    other = replace(study, parts=(replace(first, options={"mu": 0.1}), *others))
    line = next(line for line in rows({"bounce": other}) if line[:2] == ["`bounce`", first.name])
    assert line[3:] == ["", "", "", "", UNMEASURED]
    record = read_json(DATA / "tradeoff" / "bounce-cpu.model.json")
    record["identity"]["model_version"] = 0
    (tmp_path / "tradeoff").mkdir()
    write_record(tmp_path / "tradeoff" / "bounce-cpu.model.json", record)
    assert parts.studies(tmp_path) == {}
