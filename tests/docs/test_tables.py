"""Tables of README and the pages hold what the gallery's records say, of every scene of ours."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from docs.pages import tables
from docs.pages.tables import MISSING, OTHERS, SURFACES, UNCOUNTED, UNMEASURED, kept, scenes, settle, studies

from gradscape.envs.registry import entries, environment_class
from gradscape.gallery.files import DATA
from gradscape.landscapes.checks.causes import causes
from gradscape.landscapes.storage.records import read_json, write_record
from gradscape.studies.claims import CLAIMS
from gradscape.studies.fidelity import FidelityRecord
from gradscape.studies.model import ModelRecord
from gradscape.studies.samples import Bootstrap
from gradscape.studies.variants import StudyRecord

pytestmark = pytest.mark.docs


def lines(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|\n ").split(" | ")] for line in table.splitlines()[2:]]


def test_pages_hold_the_records() -> None:
    assert list(settle(check=True)) == [], "`python -m docs.pages.tables` writes the tables"


def test_a_table_that_differs_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for page, _ in tables.TABLES:
        (tmp_path / page).parent.mkdir(exist_ok=True)
        text = (tables.ROOT / page).read_text()
        for found, other in (
            ("| `torus` |", "| `taurus` |"),
            ("| `flip` |", "| `flap` |"),
            ("| clipped |", "| cut |"),
            ("| `turbo` |", "| `tribe` |"),
            ("`l-bfgs-b` ", "`l-bfgs-c` "),
        ):
            text = text.replace(found, other)
        (tmp_path / page).write_text(text)
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    assert len(list(settle(check=False))) == len(tables.TABLES)
    assert list(settle(check=True)) == []


def test_every_cause_has_a_row_by_its_name_and_no_remedy_is_lost() -> None:
    rows = {row[0]: row[1:] for row in lines(tables.known_causes())}
    assert set(rows) == {one.name for one in causes()}
    assert rows["memory growth"][0] == "warns"
    assert rows["float32 grain"][0] == "fails, warns"
    assert "{" not in tables.known_causes()
    for name in ("unconverged solver", "snapped time of impact"):  # of two files
        remedies = [tables.cell(one.remedy) for one in causes() if one.name == name]
        assert len(remedies) == 2
        assert all(one in rows[name][1] for one in remedies)


def test_every_scene_has_a_row_and_every_part_has_one() -> None:
    shown, _, left = tables.short_censuses().partition("\n\n")
    assert {row[0] for row in lines(shown)} | set(re.findall(r"`[\w-]+`", left)) == {f"`{name}`" for name in scenes()}
    for table, rows in ((tables.censuses(), 1), (tables.fidelities(), len(CLAIMS))):
        assert [row[0].strip("`") for row in lines(table)] == [name for name in scenes() for _ in range(rows)]
    assert {row[0].strip("`") for row in lines(tables.margins())} == set(scenes())
    differing = [name for name in scenes() if environment_class(name).presets.get("paper")]
    assert [row[0].strip("`") for row in lines(tables.presets())] == differing
    named = [(name, part.name) for name in sorted(entries()) for part in environment_class(name).model_parts]
    assert [(row[0].strip("`"), row[1]) for row in lines(tables.parts())] == named


def test_a_scene_that_changed_or_was_never_measured_is_said_to_be_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("census/bounce-cpu.json", "studies/bounce-cpu.extremes.json", "studies/bounce-cpu.fidelity.json"):
        record = read_json(DATA / name)
        record["identity"]["model_version"] = 0
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_record(tmp_path / name, record)
    assert kept("census/{}-{}.json", "bounce", tmp_path) == UNMEASURED
    assert kept("census/{}-{}.json", "cartpole", tmp_path) == MISSING
    monkeypatch.setattr(tables, "kept", lambda pattern, scene: kept(pattern, scene, tmp_path))
    monkeypatch.setattr(tables, "studies", lambda kind, scene: studies(kind, scene, tmp_path))
    for table in (tables.censuses, tables.margins, tables.fidelities):
        never = UNCOUNTED if table is tables.censuses else MISSING
        assert all((UNMEASURED if "bounce" in row[0] else never) in row for row in lines(table()))
    assert all(row[-1] == UNMEASURED for row in lines(tables.parts()))


def test_a_fidelity_or_a_part_whose_settings_changed_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    def edited(kind: str, scene: str) -> list[StudyRecord] | str:
        found = studies(kind, scene)
        if isinstance(found, str):
            return found
        other = {"horizon": 7.0}
        return [
            replace(one, variants=tuple(replace(row, options=other) for row in one.variants))
            if isinstance(one, FidelityRecord)
            else replace(one, parts=tuple(replace(part, options=other) for part in one.parts))
            for one in found if isinstance(one, FidelityRecord | ModelRecord)
        ]  # fmt: skip

    monkeypatch.setattr(tables, "studies", edited)
    for table in (tables.fidelities, tables.parts):
        assert {row[-1] for row in lines(table())} == {UNMEASURED}


def test_a_claim_that_breaks_is_named_with_what_it_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    (record,) = studies("fidelity", "torus")
    assert isinstance(record, FidelityRecord)
    low = Bootstrap(0.5, 0.5, 0.5)
    rows = [
        replace(row, comparison=replace(row.comparison, gradient=replace(row.comparison.gradient, cosine=low)))
        for row in record.variants
    ]
    worse = replace(record, variants=tuple(rows))
    for found, said in ((record, "kept"), (worse, "short in cosine")):
        monkeypatch.setattr(
            tables, "studies", lambda kind, scene, found=found: [found] if scene == "torus" else MISSING
        )
        assert {row[-1] for row in lines(tables.fidelities()) if row[0] == "`torus`"} == {said}


def test_a_slice_has_one_surface_at_most() -> None:
    surface = {word for words in SURFACES.values() for word in words}
    for path in sorted((DATA / "census").glob("*.json")):
        for words in (surface, *OTHERS.values()):
            assert all(len(set(words) & set(one["words"])) < 2 for one in read_json(path)["slices"])


def test_what_readme_and_the_page_on_races_say_of_the_league_is_what_its_records_say() -> None:
    """Sentences are written by hand: of whom is first, where that moves, and how many races are at draft."""
    league = tables.kept_league()
    first = [scene.env for scene in league.scenes if scene.lead.is_first]
    at_cost = [scene.env for scene in league.scenes if scene.equal_cost.lead.is_first]
    moved = {scene.env: scene.moved_to for scene in league.scenes if scene.moved_to}
    assert first == ["cartpole", "pinball-16", "swing-stiffness", "torus"]
    assert set(at_cost) - set(first) == {"pinch"}
    assert moved == {
        "fluid": ("turbo",),
        "swing-velocity": ("adam",),
        "table": ("turbo",),
        "triple-move": ("adam", "l-bfgs-b"),
    }
    assert sum(scene.fidelity == "draft" for scene in league.scenes) == 12
    ours, cost = (one[0] for one in (league.overall, league.overall_at_equal_cost))
    said = [f"{one.rank:.1f} {one.low:.1f} {one.high:.1f}" for one in (ours, cost)]
    assert (ours.method, cost.method, said) == ("l-bfgs-b", "l-bfgs-b", ["2.3 1.7 3.1", "2.7 1.9 3.6"])
