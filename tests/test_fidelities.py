"""docs/fidelities.md holds what the kept trade-offs say of every named fidelity, and which scenes changed since."""

import copy
from pathlib import Path
from typing import Any

import pytest
from benchmarks import fidelities
from benchmarks.fidelities import Row, changed, kept, short, table
from benchmarks.pages import DATA, UNMEASURED, write, written

from gradscape.envs.registry import environment_class
from gradscape.landscapes.measures.choice import CLAIMS
from gradscape.landscapes.storage.records import read_json, write_record


def test_the_page_holds_the_records() -> None:
    wanted = table(fidelities.before(), kept())
    assert written(fidelities.PAGE, fidelities.NAME) == wanted, "`python -m benchmarks.fidelities` writes the page"


def test_every_scene_was_measured_before_and_is_now() -> None:
    pairs = {(scene, claim.name) for scene in fidelities.scenes() for claim in CLAIMS}
    assert len(pairs) == 32
    assert {(row.scene, row.name) for row in fidelities.before()} == pairs
    assert {(row.scene, row.name) for row in kept()} == pairs


def test_the_page_names_the_fidelities_that_were_not_measured_since_their_scene_changed() -> None:
    lines = written(fidelities.PAGE, fidelities.NAME).splitlines()
    said = [line.split(" | ")[:2] for line in lines if UNMEASURED in line]
    assert [" ".join((scene.strip("| `"), name)) for scene, name in said] == changed(kept())


@pytest.fixture
def records(tmp_path: Path) -> dict[str, Any]:
    """Return a record of the present scene whose fidelities keep their claims, which `save` puts into a folder."""
    found: dict[str, Any] = read_json(DATA / "tradeoff" / "torus-cuda.json")
    kind = environment_class("torus")
    found["identity"]["model_version"] = kind.version_on("warp")
    for rung in found["rungs"]:
        if rung["name"] in ("draft", "standard"):
            rung["fidelity"] = kind.fidelities[rung["name"]].record()
    return found


def save(folder: Path, record: dict[str, Any]) -> list[Row]:
    path = folder / "tradeoff" / "torus-cuda.json"
    path.parent.mkdir(exist_ok=True)
    write_record(path, record)
    return kept(folder)


def test_a_claim_that_breaks_is_named_with_what_it_lacks(records: dict[str, Any], tmp_path: Path) -> None:
    assert short(save(tmp_path, records)) == []
    for rung in records["rungs"]:
        if rung["name"] == "standard":
            rung["loss_error"]["p95_relative"]["value"] = 0.06
    assert short(save(tmp_path, records)) == ["torus standard: 2 times what may lack in error"]


def test_settings_other_than_the_scenes_are_named(records: dict[str, Any], tmp_path: Path) -> None:
    assert changed(save(tmp_path, records)) == []
    other = copy.deepcopy(records)
    for rung in other["rungs"]:
        rung["fidelity"]["dt"] *= 1.7
    assert changed(save(tmp_path, other)) == ["torus draft", "torus standard"]


def test_a_variant_with_the_settings_of_a_name_counts_as_it(records: dict[str, Any], tmp_path: Path) -> None:
    for rung in records["rungs"]:
        if rung["name"] == "draft":
            rung["name"] = rung["fidelity"]["name"] = "draft-dt-x2"
            rung["gradient"]["cosine"]["value"] = 0.5
        elif rung["name"] == "standard-dt-x0.5":
            rung["name"] = rung["fidelity"]["name"] = "draft"  # what had the name
    (row,) = [row for row in save(tmp_path, records) if row.name == "draft"]
    assert row.present
    assert row.comparison.gradient.cosine.value == 0.5


def test_a_scene_whose_model_is_another_is_named_and_its_numbers_are_not_shown(
    records: dict[str, Any], tmp_path: Path
) -> None:
    old = save(tmp_path, records)
    records["identity"]["model_version"] = 0
    for rung in records["rungs"]:
        rung["gradient"]["cosine"]["value"] = 0.5
    new = save(tmp_path, records)
    assert changed(new) == ["torus draft", "torus standard"]
    (line,) = [line for line in table(old, new).splitlines() if line.startswith("| `torus` | draft")]
    assert line.endswith(f"| kept → {UNMEASURED} |")
    assert "0.500" not in line


def test_a_number_that_moved_is_shown_before_and_now(records: dict[str, Any], tmp_path: Path) -> None:
    old = save(tmp_path, records)
    for rung in records["rungs"]:
        rung["gradient"]["cosine"]["value"] = 0.5
    lines = [line for line in table(old, save(tmp_path, records)).splitlines() if line.startswith("| `torus` | draft")]
    (line,) = lines
    assert "→ 0.500" in line
    assert line.endswith("| kept → short in cosine |")
    assert "| `assembly` | draft |  |  |  |  |  | not measured |" in table([], [])


def test_a_chaotic_scenes_gradients_promise_nothing(
    records: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for rung in records["rungs"]:
        rung["gradient"]["cosine"]["value"] = -0.5
    assert len(short(save(tmp_path, records))) == 2
    monkeypatch.setitem(fidelities.CHAOTIC, "torus", "measured")
    assert short(save(tmp_path, records)) == []
    assert "kept, chaotic" in table([], save(tmp_path, records))


def test_the_page_is_checked_and_written(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(fidelities.PAGE.read_text().replace("| `torus` |", "| `taurus` |"))
    wanted = table(fidelities.before(), kept())
    assert written(page, fidelities.NAME) != wanted
    write(wanted, page, fidelities.NAME)
    assert written(page, fidelities.NAME) == wanted
    assert page.read_text() == fidelities.PAGE.read_text()
